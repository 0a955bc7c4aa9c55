"""Episodes of any task: on drones drawn anew, seen through late, offset and noisy estimates.

`reset` begins an episode, `observe` gives what the controller sees, `step` flies one command. All are pure functions
of one drone: ``vmap`` them over many. Each episode carries its own drone, so randomisation needs nothing else. What is
wanted of the drone is said by a `Task`: `cfb_mjx.envs.target` and `cfb_mjx.envs.flip`.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from cfb_mjx.envs import observation as seen
from cfb_mjx.envs.observation import Estimate, Layout, Memory
from cfb_mjx.errors import CfbError
from cfb_mjx.model.delay import DelayLine
from cfb_mjx.model.quadrotor import Prepared, Quadrotor, advance, begin, prepare
from cfb_mjx.model.randomised import differences, require_possible, sample_drone
from cfb_mjx.model.rotors import steady_command
from cfb_mjx.model.state import AnyArray, Components, State, stack, unstack
from cfb_mjx.model.vector import Vec, exponential, multiply
from cfb_mjx.parameters import Parameters, Randomisation


@dataclass(frozen=True)
class Noise:
    """Standard deviations. Of the state: added in every simulation step (paper). Of the estimate: in every reading."""

    state_velocity_mps: float = 0.001
    state_rate_radps: float = 0.001
    position_m: float = 0.001
    velocity_mps: float = 0.005
    attitude_rad: float = 0.001
    rate_radps: float = 0.01
    pose_jitter_s: float = 0.0
    """By up to so much every reading is later than the model's ``pose_delay``, drawn anew and uniformly: what a radio
    or a motion capture's network adds."""


QUIET = Noise(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
"""No noise at all."""


@dataclass(frozen=True)
class Task:
    """Everything about a task but the drone. Hashable, so it can be closed over under ``jit``.

    A task of one's own says what its flights ask for, how they begin, what a state is worth and when it is lost.
    """

    layout: Layout = field(default_factory=Layout)
    noise: Noise = field(default_factory=Noise)
    randomisation: Randomisation | None = None
    """What varies from episode to episode; None: nothing does."""
    magnitude: float = 1.0
    """Factor on all ranges of ``randomisation``."""
    graded: float = 0.0
    """Share of the episodes that draw their own factor between 0 and ``magnitude``."""
    episode_s: float = 6.0
    lumped_delay: bool = True
    """The paper's reading: one delay, the model's ``pose_delay``, for pose, velocity and gyro alike. Else the gyro is
    on the drone, as real ones are, and only ``gyro_delay`` late."""
    longest_delay_s: float | None = None
    """The longest delay that any drone of the task has, for which estimates are kept; None: what the model and the
    randomisation say. To be given (`with_room`) where the model is traced."""

    @property
    def episode_steps(self) -> int:
        """Commands in a full episode."""
        return round(self.episode_s / self.layout.control_dt_s)

    def hold(self, model: Quadrotor) -> int:
        """Simulation steps per command; raises as `Quadrotor.steps_per_command`."""
        return model.steps_per_command(self.layout.control_dt_s)

    @property
    def largest_reward(self) -> float:
        """What the best step is worth."""
        raise NotImplementedError

    def draw_setpoint(self, key: PRNGKeyArray) -> Float[Array, " setpoints"]:
        """What an episode asks for beside its target; ``layout.setpoint_scales`` has one scale for each number."""
        return jnp.zeros(0)

    def draw_start(
        self, model: Quadrotor, target: Float[Array, "3"], setpoint: Float[Array, " setpoints"], key: PRNGKeyArray
    ) -> State:
        """A random initial state."""
        raise NotImplementedError

    def judge(
        self,
        state: State,
        target: Float[Array, "3"],
        setpoint: Float[Array, " setpoints"],
        command: Float[Array, "4"],
        parameters: Parameters,
    ) -> Float[Array, ""]:
        """Reward of ``state`` after ``command`` [0 to 1]; what is judged is the true state, not its estimate."""
        raise NotImplementedError

    def failed(self, state: State) -> Bool[Array, ""]:
        """Whether ``state`` ends the episode; one that is not finite does, whatever is said here."""
        raise NotImplementedError

    @property
    def diverged_reward(self) -> float:
        """Reward of the step after which the state is not finite any more."""
        return -300.0

    def errors(
        self, state: State, target: Float[Array, "3"], setpoint: Float[Array, " setpoints"]
    ) -> Float[Array, "errors"]:
        """The distances that the reward falls with, each scaled to about one: what a value network is told."""
        raise NotImplementedError


def longest_delay_s(task: Task, nominal: Quadrotor, magnitude: Float[Array, ""] | float | None = None) -> float | None:
    """The longest delay of what a controller sees, s, of any drone that the task draws about ``nominal``.

    Args:
        task: the task.
        nominal: the drone about which others are drawn; may carry batch axes.
        magnitude: of the randomisation, in place of the task's.

    Returns:
        None where it cannot be known, as the model or the magnitude is traced.

    Raises:
        CfbError: a delay of zero has a relative range, which is none.
    """
    ranges = {} if task.randomisation is None else dict(task.randomisation.ranges)
    magnitude = task.magnitude if magnitude is None else magnitude
    longest = 0.0
    for name in _DELAYS[: 1 if task.lumped_delay else 2]:
        value, spread = getattr(nominal.parameters, name), ranges.get(name)
        if isinstance(value, Tracer) or (spread is not None and isinstance(magnitude, Tracer)):
            return None
        value = float(np.asarray(value).max())
        if spread is not None:
            if spread.relative and value == 0:
                raise CfbError(
                    f"ranges.{name} is relative, and {name} is 0: nothing would vary; give the model one (--set {name}="
                    "0.002), or leave the range out."
                )
            width = float(magnitude) * max(spread.half_width)
            value = value * (1 + width) if spread.relative else value + width
        longest = max(longest, value + (task.noise.pose_jitter_s if name == "pose_delay" else 0.0))
    return longest


_DELAYS = ("pose_delay", "gyro_delay")


_AnyTask = TypeVar("_AnyTask", bound=Task)


def with_room(task: _AnyTask, nominal: Quadrotor) -> _AnyTask:
    """The task with room for late estimates of every drone it draws about ``nominal``, which may then be traced."""
    longest = longest_delay_s(task, nominal)
    return task if longest is None else replace(task, longest_delay_s=longest)


def _room_s(task: Task, nominal: Quadrotor, magnitude) -> float:
    """For how long estimates are kept."""
    longest, room = longest_delay_s(task, nominal, magnitude), task.longest_delay_s
    if room is None:
        if longest is None:
            raise CfbError(
                "reset: the delay of a traced model is not known while compiling; give the task its longest_delay_s, "
                "for instance by with_room(task, model) outside of jit and vmap."
            )
        return longest
    if longest is not None and longest > room * (1 + 1e-6):
        names = " or ".join(_DELAYS[: 1 if task.lumped_delay else 2])
        raise CfbError(
            f"The task keeps estimates for longest_delay_s = {room:g} s, but {names} can be {longest:g} s; raise it or "
            "leave it out."
        )
    return room


class Streams(NamedTuple):
    """One key for each thing that an episode draws: nothing else may be drawn from it, or derived from it.

    A key is told by its place, so a new stream goes last and leaves the draws of the others alone.
    """

    drone: PRNGKeyArray
    start: PRNGKeyArray
    noise: PRNGKeyArray
    first_estimate: PRNGKeyArray
    mildness: PRNGKeyArray
    """Of the factor on the ranges of randomisation."""
    setpoint: PRNGKeyArray

    @classmethod
    def of(cls, key: PRNGKeyArray) -> Streams:
        """Of the episode that ``key`` decides."""
        return cls(*(jax.random.fold_in(key, place) for place in range(len(cls._fields))))


class Pose(eqx.Module):
    """What of the state an estimator could know."""

    position: AnyArray
    velocity: AnyArray
    quaternion: AnyArray
    body_rate: AnyArray


class Episode(eqx.Module):
    """One flight in progress."""

    model: Quadrotor
    """The drone of this episode."""
    state: State
    target: Float[Array, "3"]
    setpoint: Float[Array, " setpoints"]
    """What is asked for beside the target; empty for tasks that ask for nothing else."""
    past: DelayLine
    """Of `Pose`: estimates arrive late."""
    memory: Memory
    estimate: Estimate
    """What the controller sees now."""
    count: Int[Array, ""]
    key: PRNGKeyArray


class Outcome(NamedTuple):
    """What a step led to."""

    reward: Float[Array, ""]
    failed: Bool[Array, ""]
    """The episode is over: too fast, or not finite."""
    timed_out: Bool[Array, ""]
    """The episode is over: its time is up."""
    diverged: Bool[Array, ""]
    """It failed because its state is not finite any more."""


def reset(
    task: Task,
    nominal: Quadrotor,
    key: PRNGKeyArray,
    state: State | None = None,
    target: Float[AnyArray, "3"] | tuple[float, float, float] = (0.0, 0.0, 0.0),
    magnitude: Float[Array, ""] | float | None = None,
    setpoint: Float[AnyArray, " setpoints"] | tuple[float, ...] | None = None,
) -> Episode:
    """Begin an episode.

    Args:
        task: the task.
        nominal: the drone about which this episode's is drawn.
        key: decides the drone, the start and all noise.
        state: where it begins; drawn by default.
        target: position that estimates are relative to, world, m.
        magnitude: of the randomisation, in place of the task's; may be traced.
        setpoint: what is asked for beside the target; drawn by default.

    Raises:
        CfbError: ranges that allow impossible drones (`cfb_mjx.model.require_possible`); or the task has no room
            for the delays that can be drawn, or they are not known as the model is traced.
    """
    room = _room_s(task, nominal, magnitude)
    streams = Streams.of(key)
    model = nominal
    if task.randomisation is not None:
        factor = task.magnitude if magnitude is None else magnitude
        # Asked of the whole magnitude: whether a drone can be must not depend on the grade that this key draws.
        require_possible(nominal, task.randomisation, factor)
        factor = factor * mildness(task, streams.mildness)
        model = sample_drone(streams.drone, nominal, task.randomisation, factor)
    target = jnp.asarray(target, model.parameters.mass.dtype)
    drawn = task.draw_setpoint(streams.setpoint) if setpoint is None else setpoint
    setpoint = jnp.asarray(drawn, target.dtype)
    state = task.draw_start(model, target, setpoint, streams.start) if state is None else state
    state = begin(model, state)
    past = DelayLine.filled(_pose(state), model.dt, room)
    estimate = _estimate(task, model, past, target, streams.first_estimate)
    memory = seen.start(task.layout, estimate, settled_command(model, state))
    return Episode(model, state, target, setpoint, past, memory, estimate, jnp.asarray(0), streams.noise)


def mildness(task: Task, key: PRNGKeyArray) -> Float[Array, ""] | float:
    """Factor in [0, 1] on an episode's randomisation: of a share ``task.graded`` of the episodes uniform, else 1."""
    if not task.graded:
        return 1.0
    which, grade = jax.random.uniform(key, (2,))
    return jnp.where(which < task.graded, grade, 1.0)


def settled_command(model: Quadrotor, state: State) -> Float[Array, "4"]:
    """The command [0 to 1] that keeps the rotors as they turn: what a controller that takes over finds."""
    return jnp.clip(steady_command(model.parameters, state.rotor_speed), 0.0, 1.0)


def choose(condition: Array, yes: Any, no: Any) -> Any:
    """``jnp.where`` on every array of two like pytrees; the condition's axes come first."""
    return jax.tree.map(
        lambda a, b: jnp.where(condition.reshape(condition.shape + (1,) * (a.ndim - condition.ndim)), a, b), yes, no
    )


def observe(task: Task, episode: Episode) -> Float[Array, " size"]:
    """What the controller's network is given now."""
    return seen.observation(task.layout, episode.memory, episode.estimate, episode.setpoint)


def privileged(task: Task, nominal: Quadrotor, episode: Episode) -> Float[Array, " n"]:
    """What a value network may know: true frame, errors, rotor speeds, integral, set-points, how the drone differs.

    The reward falls with lengths of errors, whose tips at zero a small network is slow to form by itself.
    """
    state, parameters = episode.state, episode.model.parameters
    position = state.position - episode.target
    true = seen.frame(task.layout, Estimate(position, state.velocity, state.quaternion, state.body_rate))
    errors = task.errors(state, episode.target, episode.setpoint)
    parts = [true, errors, jnp.sqrt(errors), state.rotor_speed / parameters.reference_rotor_speed]
    parts.append(episode.memory.integral / task.layout.integral_limit_ms)
    if task.layout.setpoint_scales:
        parts.append(episode.setpoint / jnp.asarray(task.layout.setpoint_scales))
    if task.randomisation is not None:
        parts.append(differences(nominal, episode.model, task.randomisation))
    return jnp.concatenate(parts)


def step(
    task: Task, episode: Episode, command: Float[Array, "4"], prepared: Prepared | None = None
) -> tuple[Episode, Outcome]:
    """Fly ``command`` [0 to 1] for one control step.

    Args:
        task: the task.
        episode: the flight so far.
        command: of M1..M4; clipped to [0, 1].
        prepared: `prepare(episode.model)`, where the caller has it already.

    A state that is not finite any more has failed; the episode keeps the last one that was, and what was seen of it.
    """
    model = episode.model
    prepared = prepare(model) if prepared is None else prepared
    command = jnp.clip(command, 0.0, 1.0)
    of_state, of_estimate = jax.random.split(jax.random.fold_in(episode.key, episode.count))
    hold, noise = task.hold(model), task.noise
    scale = jnp.array([noise.state_velocity_mps] * 3 + [noise.state_rate_radps] * 3, command.dtype)
    kicks = scale * jax.random.normal(of_state, (hold, 6), command.dtype)
    row, center = Vec.unstack(command), prepared.parameters.center_of_gravity

    def fly(at: Components, kick: Vec) -> tuple[Components, Components]:
        at = advance(prepared, at, row)
        velocity, body_rate = at.velocity + Vec(*kick[:3]), at.body_rate + Vec(*kick[3:])
        at = Components(at.position, velocity, at.quaternion, body_rate, at.rotor_speed, at.memory)
        return at, at

    # A loop, however short, and arrays put together only after it: else XLA fuses the dynamics into every such array
    # and, on CPU without its multi-output fusion, computes them once for each number in it, twenty times slower.
    moved, passed = jax.lax.scan(fly, unstack(episode.state, center), Vec.unstack(kicks))
    state, poses = stack(moved, center), _pose(stack(passed, center))
    finite = _finite(state)
    state = choose(finite, state, episode.state)
    poses = jax.tree.map(lambda new, old: jnp.where(finite, new, old), poses, _pose(episode.state))
    command = jnp.where(finite, command, 0.0)
    past = episode.past.push_all(poses)
    memory = seen.remember(task.layout, episode.memory, episode.estimate, command)
    estimate = _estimate(task, model, past, episode.target, of_estimate)
    count = episode.count + 1
    after = Episode(model, state, episode.target, episode.setpoint, past, memory, estimate, count, episode.key)
    reward = task.judge(state, episode.target, episode.setpoint, command, model.parameters)
    reward = jnp.where(finite, reward, task.diverged_reward)
    return after, Outcome(reward, task.failed(state) | ~finite, count >= task.episode_steps, ~finite)


def _finite(state: State) -> Bool[Array, ""]:
    parts = (state.position, state.velocity, state.quaternion, state.body_rate, state.rotor_speed)
    return jnp.all(jnp.isfinite(jnp.concatenate(parts)))


def _pose(state: State) -> Pose:
    return Pose(state.position, state.velocity, state.quaternion, state.body_rate)


def _estimate(task: Task, model: Quadrotor, past: DelayLine, target: Array, key: PRNGKeyArray) -> Estimate:
    parameters, noise = model.parameters, task.noise
    delay = parameters.pose_delay
    if noise.pose_jitter_s:
        # Of a key of its own: the noise stays what it is without jitter.
        delay = delay + noise.pose_jitter_s * jax.random.uniform(jax.random.fold_in(key, 1), (), delay.dtype)
    late = past.read(delay)
    if not task.lumped_delay:
        gyro = DelayLine(past.samples.body_rate, past.dt).read(parameters.gyro_delay)
        late = Pose(late.position, late.velocity, late.quaternion, gyro)
    draws = jax.random.normal(key, (12,), late.position.dtype)
    # Between two samples the blend of unit quaternions is a little short.
    q = late.quaternion / jnp.sqrt(jnp.sum(late.quaternion**2))
    turned = Vec.unstack(parameters.attitude_offset + noise.attitude_rad * draws[6:9])
    return Estimate(
        late.position - target + noise.position_m * draws[:3],
        late.velocity + noise.velocity_mps * draws[3:6],
        multiply(Vec.unstack(q), exponential(turned * 0.5)).stack(),
        late.body_rate + noise.rate_radps * draws[9:],
    )
