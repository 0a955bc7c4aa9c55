"""Independent oracle: the paper's equations of motion (eqs. 1-10) in plain NumPy, integrated by SciPy's DOP853.

Nothing here calls the library's model code; of the library it reads constants only. The centre-of-gravity offset is
treated differently from the library on purpose: the library moves the centre of gravity and converts, the oracle
solves the coupled Newton-Euler equations of the rotors' centre (6 x 6 mass matrix), so no conversion is shared.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass, field

import jax
import numpy as np
from scipy.integrate import solve_ivp

# Firmware order: front-right, back-right, back-left, front-left; x forward, y left.
ROTOR_X = np.array([1.0, -1.0, -1.0, 1.0])
ROTOR_Y = np.array([-1.0, -1.0, 1.0, 1.0])
YAW = np.array([-1.0, 1.0, -1.0, 1.0])

# For tests that compile much and run little: XLA's fusion makes RK4's gradient take minutes to compile instead of
# seconds. What is computed is the same; the convergence tests compile with the defaults.
QUICK_COMPILE = {"xla_disable_hlo_passes": "fusion", "xla_backend_optimization_level": 0}

NAMES = ("position", "velocity", "quaternion", "body_rate", "rotor_speed")
SLICES = dict(zip(NAMES, (slice(0, 3), slice(3, 6), slice(6, 10), slice(10, 13), slice(13, 17)), strict=True))


@dataclass(frozen=True)
class Constants:
    """The paper's numbers with propeller guards, typed in afresh; `constants_of` reads another drone's."""

    mass: float = 0.044
    inertia: np.ndarray = field(default_factory=lambda: np.array([3.3e-5, 3.6e-5, 5.9e-5]))
    center_of_gravity: np.ndarray = field(default_factory=lambda: np.zeros(3))
    gravity: float = 9.81
    rotor_spacing: float = 0.0707
    rotor_inertia: float = 0.5e-7
    motor_time_constant: np.ndarray = field(default_factory=lambda: np.full(4, 0.05))
    motor_gain: np.ndarray = field(default_factory=lambda: np.full(4, 2900.0))
    motor_speed_offset: np.ndarray = field(default_factory=lambda: np.zeros(4))
    reference_rotor_speed: float = 2900.0
    thrust_polynomial: np.ndarray = field(default_factory=lambda: np.array([-0.23, 0.562, -0.043]))
    torque_polynomial: np.ndarray = field(default_factory=lambda: np.array([-3.4e-4, 8.7e-4, 2.9e-4]))
    thrust_scale: np.ndarray = field(default_factory=lambda: np.ones(4))
    torque_scale: np.ndarray = field(default_factory=lambda: np.ones(4))
    drag_linear: np.ndarray = field(default_factory=lambda: np.zeros(3))
    drag_quadratic: np.ndarray = field(default_factory=lambda: np.zeros(3))


def constants_of(parameters, drag: Mapping[str, object] | None = None) -> Constants:
    """Copy the numbers out of a `Parameters` pytree (and ``linear``, ``quadratic`` of a parasitic drag)."""
    names = [name for name in Constants.__dataclass_fields__ if not name.startswith("drag")]
    values = {name: np.asarray(getattr(parameters, name), dtype=float) for name in names}
    values |= {f"drag_{key}": np.asarray(value, dtype=float) for key, value in (drag or {}).items()}
    return Constants(**values)


def pack(state) -> np.ndarray:
    """The 17 numbers of a `State` (or a trajectory of states: last axis 17)."""
    return np.concatenate([np.asarray(getattr(state, name), dtype=float) for name in NAMES], axis=-1)


def part(y: np.ndarray, name: str) -> np.ndarray:
    """One quantity of packed states."""
    return y[..., SLICES[name]]


def rotation_matrix(q: np.ndarray) -> np.ndarray:
    """Body-to-world matrix of a [w, x, y, z] quaternion, normalised first."""
    w, x, y, z = q / np.linalg.norm(q)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def cross_matrix(c: np.ndarray) -> np.ndarray:
    """[c]x, so that cross_matrix(c) @ b = c x b."""
    x, y, z = c
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def attitude_error(q: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Geodesic angle between attitudes, rad, accurate for small angles too."""
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    reference = reference / np.linalg.norm(reference, axis=-1, keepdims=True)
    sign = np.where(np.sum(q * reference, axis=-1, keepdims=True) < 0, -1.0, 1.0)
    return 4 * np.arcsin(np.clip(np.linalg.norm(q - sign * reference, axis=-1) / 2, 0, 1))


def rotor_forces(constants: Constants, speed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Thrust (clamped at zero, as documented) and aerodynamic torque magnitude of each rotor."""
    s = speed / constants.reference_rotor_speed
    powers = np.array([s**3, s**2, s])
    thrust = np.maximum(constants.thrust_scale * (constants.thrust_polynomial @ powers), 0.0)
    return thrust, constants.torque_scale * (constants.torque_polynomial @ powers)


def rotor_wrench(constants: Constants, speed: np.ndarray, rate: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Force and torque about the rotors' centre, body axes, summed rotor by rotor from r x F."""
    thrust, torque = rotor_forces(constants, speed)
    total = np.zeros(3)
    for i in range(4):
        arm = 0.5 * constants.rotor_spacing * np.array([ROTOR_X[i], ROTOR_Y[i], 0.0])
        total += np.cross(arm, [0.0, 0.0, thrust[i]])
        total[2] += YAW[i] * (torque[i] + constants.rotor_inertia * rate[i])
    return np.array([0.0, 0.0, thrust.sum()]), total


def ode(constants: Constants, command: np.ndarray):
    """Right-hand side y' = f(t, y) with the command held."""
    m, c = constants.mass, constants.center_of_gravity
    cx = cross_matrix(c)
    # Principal moments, or the whole tensor.
    inertia = constants.inertia if np.ndim(constants.inertia) == 2 else np.diag(constants.inertia)
    about_center = inertia - m * cx @ cx
    mass_matrix = np.block([[m * np.eye(3), -m * cx], [m * cx, about_center]])
    inverse = np.linalg.inv(mass_matrix)
    steady = constants.motor_gain * np.clip(command, 0.0, 1.0) + constants.motor_speed_offset
    half = 0.5 * constants.rotor_spacing
    levers = np.stack([half * ROTOR_Y, -half * ROTOR_X])

    def rates(_, y):
        v, q, w, speed = y[3:6], y[6:10], y[10:13], y[13:17]
        speed_rate = (steady - speed) / constants.motor_time_constant
        thrust, torque = rotor_forces(constants, speed)
        matrix = rotation_matrix(q)
        force = m * constants.gravity * -matrix[2]
        force[2] += thrust.sum()
        moment = np.array([*(levers @ thrust), YAW @ (torque + constants.rotor_inertia * speed_rate)])
        # Gravity acts at the centre of gravity, the rotors and the drag at their own centre.
        moment += cx @ (m * constants.gravity * -matrix[2])
        v_body = matrix.T @ v
        force -= (constants.drag_linear + constants.drag_quadratic * np.abs(v_body)) * v_body
        wx = cross_matrix(w)
        bias = np.concatenate([m * wx @ (wx @ c), wx @ (about_center @ w)])
        acceleration = inverse @ (np.concatenate([force, moment]) - bias)
        q_rate = 0.5 * np.concatenate([[-(q[1:] @ w)], q[0] * w + np.cross(q[1:], w)])
        return np.concatenate([v, matrix @ acceleration[:3], q_rate, acceleration[3:], speed_rate])

    return rates


def fly(constants: Constants, y: np.ndarray, commands: np.ndarray, interval: float) -> np.ndarray:
    """States after each command, each held for ``interval`` seconds: (steps, 17)."""
    trajectory = []
    for command in np.asarray(commands, dtype=float):
        # A new integration per command: the right-hand side jumps when the command does.
        solution = solve_ivp(
            ode(constants, command),
            (0.0, interval),
            y,
            method="DOP853",
            rtol=1e-10,
            atol=1e-11,
            first_step=interval / 2,
        )
        y = solution.y[:, -1]
        trajectory.append(y)
    return np.array(trajectory)


def order_of(steps: np.ndarray, errors: np.ndarray) -> float:
    """Slope of log(error) against log(step)."""
    return float(np.polyfit(np.log(steps), np.log(errors), 1)[0])


def aggressive_manoeuvre(duration: float, interval: float = 0.004, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """A flip in progress: initial state (17 numbers) and commands over the full range, new every ``interval``.

    Starts at 12 rad/s about x with some pitch and yaw, then full roll torque in alternating directions with random
    commands in between: body rates of 10 to 20 rad/s, rotor speeds over most of their range.
    """
    random = np.random.default_rng(seed)
    count = round(duration / interval)
    y = np.concatenate([[0, 0, 1], [0.5, -0.3, 1.0], [0.9, 0.3, -0.2, 0.1], [12, -5, 3], [1700, 1500, 1800, 1600]])
    y[6:10] /= np.linalg.norm(y[6:10])
    commands = random.uniform(0.0, 1.0, (count, 4))
    time = np.arange(count) * interval
    phase = np.floor(time / 0.04).astype(int) % 4
    commands[phase == 1] = [1.0, 1.0, 0.0, 0.0]
    commands[phase == 3] = [0.0, 0.0, 1.0, 1.0]
    return y.astype(float), commands


def gentle_manoeuvre(duration: float, interval: float = 0.004, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Flight near hover: commands within a few per cent of it."""
    random = np.random.default_rng(seed)
    count = round(duration / interval)
    y = np.concatenate([[0, 0, 1], [0.3, 0.1, 0.0], [1, 0.03, -0.05, 0.1], [0.3, -0.2, 0.1], np.full(4, 1594.0)])
    y[6:10] /= np.linalg.norm(y[6:10])
    return y.astype(float), 0.55 + random.uniform(-0.05, 0.05, (count, 4))


def state_of(y: np.ndarray):
    """The library's `State` from packed numbers."""
    import jax.numpy as jnp

    from cfb_mjx.model import State

    return State(*(jnp.asarray(part(y, name)) for name in NAMES))


HASTE = {"xla_cpu_use_fusion_emitters": False, "xla_backend_optimization_level": 0}
"""Options of XLA: large programs compile in half to two thirds of the time, and run up to four times slower."""


@functools.cache
def haste() -> dict[str, object]:
    """Those of `HASTE` that the installed XLA knows: of jaxlib 0.12 on, emitters of fusions can no longer be chosen."""
    return {name: value for name, value in HASTE.items() if _known(name, value)}


def _known(name: str, value: object) -> bool:
    try:
        jax.jit(lambda x: x + 1.0).lower(0.0).compile(compiler_options={name: value})
    except jax.errors.JaxRuntimeError as error:
        if "No such compile option" not in str(error):
            raise
        return False
    return True


SMALL_TRAINING = (
    "checkpoints=2",
    "network.hidden=[8, 8]",
    "analytic.drones=4",
    "analytic.updates=4",
    "analytic.horizon_s=0.04",
    "ppo.drones=8",
    "ppo.unroll=4",
    "ppo.steps=128",
    "ppo.minibatches=2",
    "ppo.copies=2",
    "ppo.epochs=2",
    "ppo.value_hidden=[8]",
)
"""Changes that make any training one of seconds."""


class KeyUses:
    """What was done with every random key, from `watch_keys` on."""

    def __init__(self):
        self.of: dict[bytes, list] = {}

    @property
    def count(self) -> int:
        """Keys that were used."""
        return len(self.of)

    def of_no_key_twice(self) -> bool:
        """Every key was drawn from once, or split once, or only other keys were derived from it, each once."""
        return all(
            len(uses) == 1 or (len(set(uses)) == len(uses) and {kind for kind, _ in uses} == {"fold_in"})
            for uses in self.of.values()
        )


def watch_keys(monkeypatch) -> KeyUses:
    """Note what is done with random keys by the functions of ``jax.random`` (outside of ``jit`` and ``vmap``)."""
    seen = KeyUses()

    def watched(name):
        function = getattr(jax.random, name)

        def noted(key, *args, **kwargs):
            use = (name, int(args[0]) if name == "fold_in" else None)
            seen.of.setdefault(np.asarray(key).tobytes(), []).append(use)
            return function(key, *args, **kwargs)

        monkeypatch.setattr(jax.random, name, noted)

    for name in ("split", "fold_in", "uniform", "normal", "randint", "permutation"):
        watched(name)
    return seen
