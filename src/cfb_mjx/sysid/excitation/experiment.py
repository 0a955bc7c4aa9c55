"""Simulated flights that repeat a manoeuvre (hover, open loop, catch, return), as a log and as true states.

The control loop runs every 2 ms, like the attitude loop of the firmware. The open-loop commands change every 4 ms.

The conditions of a flight (noise of the sensors, unknown disturbances) are those of a real one.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, ClassVar, Protocol

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from cfb_mjx.logs import FlightLog
from cfb_mjx.model.delay import DelayLine
from cfb_mjx.model.effects import Condition, Effect, Wrench
from cfb_mjx.model.quadrotor import Quadrotor, begin, specific_force, step
from cfb_mjx.model.state import State
from cfb_mjx.model.vector import Vec
from cfb_mjx.sysid.excitation.manoeuvres import STEP, stepped


@dataclass(frozen=True)
class Conditions:
    """Sensor noise and disturbances of a flight.

    Sensor noise is white, with the given standard deviation per row. Each disturbance is an Ornstein-Uhlenbeck process
    per axis, with the given rms.

    Attributes:
        gyro: noise, rad/s.
        accelerometer: noise, m/s^2.
        rotor: noise of the measured rotor speed, rad/s.
        measured_rotors: whether rotor speed is logged.
        row: time between rows of the log, s. At 2 ms the log contains every command of the stabiliser. At 4 ms every
            other command is missing; as the commands respond to the gyro's noise, this biases a fit
            (``docs/identification.md``).
        position: noise of the estimator, m.
        velocity: noise of the estimator, m/s.
        attitude: noise of the estimator, rad.
        disturbance: unmodelled torque over inertia, rad/s^2.
        force_disturbance: unmodelled force over mass along body z, m/s^2.
        rotor_disturbance: error of the steady rotor speed (battery, load), rad/s.
        correlation_time: of all disturbances, s.
    """

    gyro: float = 0.02
    accelerometer: float = 0.1
    rotor: float = 3.0
    measured_rotors: bool = False
    row: float = 0.002
    position: float = 0.5e-3
    velocity: float = 0.01
    attitude: float = 1e-3
    disturbance: float = 4.0
    force_disturbance: float = 0.5
    rotor_disturbance: float = 10.0
    correlation_time: float = 0.3

    @property
    def calm(self) -> Conditions:
        """The same conditions without noise and disturbances."""
        levels = [name for name in vars(self) if name not in ("measured_rotors", "row", "correlation_time")]
        return replace(self, **dict.fromkeys(levels, 0.0))


TICK = 0.002
"""Period of the control loop, s."""
SETTLE, BRAKING, CATCH, RETURN = 1.0, 1.2, 2.0, 2.5
"""Phases of a flight, s: hover before the first manoeuvre; braking after the handover; time from the handover until the
drone should have settled, holding the position where it stopped; return to the start."""
_RETURN_SPEED = 0.5


class Stabiliser(Protocol):
    """Controller that flies the drone outside the manoeuvre: pure functions of a memory (any pytree).

    It is called every `TICK`.
    """

    def start(self, measurement: State) -> Any:
        """Memory at the first measurement."""

    def resume(self, memory: Any, measurement: State) -> Any:
        """Memory when taking over after the manoeuvre, during which the controller was not called."""

    def command(self, memory: Any, measurement: State, position: Array, yaw: Array) -> tuple[Any, Array]:
        """New memory, and command (4,) to hold ``position``, m, world axes, and ``yaw``, rad."""
        ...


@dataclass(frozen=True)
class Experiment:
    """A simulated flight.

    Attributes:
        log: the log that would be recorded, with pose and velocity delayed by the model's ``pose_delay`` and the gyro
            by ``gyro_delay``.
        time: (n,) s, every `TICK`.
        state: true states at ``time``.
        command: (n, 4) applied from ``time`` on.
        starts: (repetitions,) index of the first tick of each manoeuvre.
        length: number of ticks of a manoeuvre.
    """

    log: FlightLog
    time: np.ndarray
    state: State
    command: np.ndarray
    starts: np.ndarray
    length: int


def fly(
    model: Quadrotor,
    stabiliser: Stabiliser,
    sequence: np.ndarray,
    repetitions: int = 5,
    conditions: Conditions = Conditions(),
    height: float = 1.5,
    seed: int = 0,
    name: str = "excitation",
) -> Experiment:
    """Simulate a flight: hover, then ``repetitions`` times the open-loop sequence, catch, and return to the start.

    Args:
        model: the drone; it is integrated with RK4 in steps of `TICK`, regardless of its own options.
        stabiliser: controller outside the manoeuvre; it is not called during the manoeuvre.
        sequence: (m, 4) commands, each held for `STEP` seconds.
        repetitions: number of manoeuvres in the flight.
        conditions: noise and disturbances.
        height: of the hover, m.
        seed: of noise and disturbances.
        name: of the log.
    """
    model = stepped(model, dt=TICK)
    hold = round(STEP / TICK)
    open_loop = np.repeat(np.asarray(sequence, dtype=float), hold, axis=0)
    settle, brake, catch, back = (round(t / TICK) for t in (SETTLE, BRAKING, CATCH, RETURN))
    m = len(open_loop)
    cycle = m + catch + back
    starts = settle + cycle * np.arange(repetitions)
    n = settle + cycle * repetitions
    phase = np.zeros(n, dtype=int)
    fixed = np.zeros((n, 4))
    for start in starts:
        phase[start : start + m] = OPEN
        phase[start + m] = HANDOVER
        phase[start + m + 1 : start + m + brake] = BRAKE
        phase[start + m + catch : start + cycle] = BACK
        fixed[start : start + m] = open_loop
    flown = _flown(model, stabiliser, model.hover_state((0.0, 0.0, height)), phase, fixed, conditions, seed, name)
    return Experiment(*flown, starts, m)


def follow(
    model: Quadrotor,
    stabiliser: Stabiliser,
    path: np.ndarray,
    conditions: Conditions = Conditions(),
    seed: int = 0,
    name: str = "path",
) -> Experiment:
    """Simulate a flight along a path, starting in hover at its first point.

    Args:
        model: the drone; it is integrated with RK4 in steps of `TICK`, regardless of its own options.
        stabiliser: controller.
        path: (n, 4) set-points x, y, z, m, and yaw, rad, one per `TICK`.
        conditions: noise and disturbances.
        seed: of noise and disturbances.
        name: of the log.
    """
    model = stepped(model, dt=TICK)
    path = np.asarray(path, dtype=float)
    start = model.hover_state(tuple(path[0, :3]))
    phase = np.full(len(path), FOLLOW)
    flown = _flown(model, stabiliser, start, phase, path, conditions, seed, name)
    return Experiment(*flown, np.zeros(1, dtype=int), len(path))


def _flown(model: Quadrotor, stabiliser: Stabiliser, start: State, phase, fixed, conditions: Conditions, seed, name):
    """Simulate a flight with given phases; return log, time, true states and commands."""
    n = len(phase)
    rng = np.random.default_rng(seed)
    widths = {"gyro": 3, "pose": 9, "torque": 3, "force": 1, "rotor": 4}
    draws = {name: rng.normal(size=(n, width)) for name, width in widths.items()}
    levels = {k: jnp.asarray(v) for k, v in vars(conditions).items() if not isinstance(v, bool)}
    state, measured, command, force = jax.tree.map(
        np.asarray, _simulate(model, stabiliser, start, levels, (phase, fixed, draws), _longest_delay(model))
    )
    time = np.arange(n) * TICK
    log = _log(time, state, measured, command, force, conditions, rng, float(model.parameters.pose_delay), name)
    return log, time, state, command


OPEN, HANDOVER, BRAKE, BACK, FOLLOW = 1, 2, 3, 4, 5
"""Phases of a flight; 0 is holding a position. The fixed inputs are commands during `OPEN` and set-points during
`FOLLOW`."""


class _Push(Effect):
    """A force and a torque on the body, constant during a step."""

    name: ClassVar[str] = "push"
    force: Float[Array, "3"]
    torque: Float[Array, "3"]

    def body(self, wrench: Wrench, condition: Condition) -> Wrench:
        return Wrench(wrench.force + Vec.unstack(self.force), wrench.torque + Vec.unstack(self.torque))


def _longest_delay(model: Quadrotor) -> float:
    return max(float(model.parameters.pose_delay), float(model.parameters.gyro_delay))


@eqx.filter_jit
def _simulate(model: Quadrotor, stabiliser, start: State, levels: dict, inputs, longest_delay: float):
    p = model.parameters
    keep = jnp.exp(-TICK / levels["correlation_time"])
    # One process per axis of torque, per force and per rotor; the first draw initialises it in its stationary state.
    wander = jnp.concatenate([jnp.full(3, levels["disturbance"]), levels["force_disturbance"][None]])
    wander = jnp.concatenate([wander, jnp.full(4, levels["rotor_disturbance"])])

    def observe(late: State, body_rate, draws) -> State:
        a, b, c = (draws["pose"][3 * i : 3 * i + 3] for i in range(3))
        turned = late.quaternion + 0.5 * levels["attitude"] * _times(late.quaternion, c)
        return State(
            late.position + levels["position"] * a,
            late.velocity + levels["velocity"] * b,
            turned / jnp.linalg.norm(turned),
            body_rate + levels["gyro"] * draws["gyro"],
            late.rotor_speed,
        )

    def tick(carry, row):
        state, line, memory, target, wandering = carry
        phase, fixed, draws = row
        line = line.push(state)
        rate = DelayLine(line.samples.body_rate, TICK).read(p.gyro_delay)
        measured = observe(line.read(p.pose_delay), rate, draws)
        memory = jax.tree.map(
            lambda new, old: jnp.where(phase == HANDOVER, new, old),
            stabiliser.resume(memory, measured),
            memory,
        )
        # While braking, the position set-point is the current position, so only the velocity is controlled.
        target = jnp.where((phase == HANDOVER) | (phase == BRAKE), measured.position, target)
        home = start.position - target
        way = jnp.minimum(1.0, _RETURN_SPEED * TICK / jnp.maximum(jnp.linalg.norm(home), 1e-9))
        target = target + jnp.where(phase == BACK, way, 0.0) * home
        follows = phase == FOLLOW
        target = jnp.where(follows, fixed[:3], target)
        moved, wanted = stabiliser.command(memory, measured, target, jnp.where(follows, fixed[3], 0.0))
        is_open = phase == OPEN
        memory = jax.tree.map(lambda new, old: jnp.where(is_open, old, new), moved, memory)
        command = jnp.clip(jnp.where(is_open, fixed, wanted), 0.0, 1.0)
        fresh = jnp.concatenate([draws["torque"], draws["force"], draws["rotor"]])
        wandering = keep * wandering + jnp.sqrt(1 - keep**2) * wander * fresh
        push = _Push(p.mass * wandering[3] * jnp.array([0.0, 0.0, 1.0]), p.inertia * wandering[:3])
        disturbed = eqx.tree_at(
            lambda q: (q.parameters.motor_speed_offset, q.effects),
            model,
            (p.motor_speed_offset + wandering[4:], (*model.effects, push)),
        )
        force = specific_force(disturbed, state)
        return (step(disturbed, state, command), line, memory, target, wandering), (state, measured, command, force)

    first = jax.tree.map(lambda x: x[0], inputs[2])
    memory = stabiliser.start(start)
    wandering = wander * jnp.concatenate([first["torque"], first["force"], first["rotor"]])
    # The push has no memory, but a state needs an entry for each effect.
    pushed = eqx.tree_at(lambda q: q.effects, model, (*model.effects, _Push(jnp.zeros(3), jnp.zeros(3))))
    begun = begin(pushed, eqx.tree_at(lambda s: s.memory, start, (), is_leaf=lambda x: isinstance(x, tuple)))
    carry = (begun, DelayLine.filled(begun, TICK, longest_delay), memory, start.position, wandering)
    return jax.lax.scan(tick, carry, jax.tree.map(jnp.asarray, inputs))[1]


def _times(quaternion, small):
    """Product of a quaternion with [0, small]."""
    w, v = quaternion[0], quaternion[1:]
    return jnp.concatenate([-(v @ small)[None], w * small + jnp.cross(v, small)])


def _log(time, state, measured, command, force, conditions: Conditions, rng, delay, name) -> FlightLog:
    rows = slice(None, None, max(round(conditions.row / TICK), 1))
    speed = None
    if conditions.measured_rotors:
        true = state.rotor_speed[rows]
        speed = true + conditions.rotor * rng.normal(size=true.shape)
    force = force[rows] + conditions.accelerometer * rng.normal(size=force[rows].shape)
    return FlightLog(
        time=time[rows],
        position=measured.position[rows],
        velocity=measured.velocity[rows],
        quaternion=measured.quaternion[rows],
        body_rate=measured.body_rate[rows],
        specific_force=force,
        command=command[rows],
        rotor_speed=speed,
        metadata={"name": name, "source": "cfb excite", "format": "simulated", "observation_delay": delay},
    )
