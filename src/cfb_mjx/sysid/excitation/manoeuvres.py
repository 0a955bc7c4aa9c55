"""Manoeuvres for identification: open-loop command sequences around hover, and their limits.

Paths for a position controller excite some effects and not others.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from cfb_mjx.errors import CfbError
from cfb_mjx.model.quadrotor import Quadrotor
from cfb_mjx.model.rollout import rollout
from cfb_mjx.model.rotors import TORQUE_SIGNS
from cfb_mjx.model.state import AnyArray, State
from cfb_mjx.model.vector import Vec, up_axis

STEP = 0.004
"""Time for which each row of a sequence is held, s."""
_ROLL, _PITCH, _YAW = np.array(TORQUE_SIGNS)
_THERE_AND_BACK = np.array([1.0, -1.0, -1.0, 1.0])
"""Quarters of a doublet pair; after it, rate and angle are both near zero."""
MARGIN = 0.75
"""Share of every limit that the undisturbed manoeuvre may use. The rest is for disturbances, because there is no
feedback."""
_BRAKING = 3.0
"""Assumed vertical deceleration by the stabiliser, m/s^2; the firmware's thrust limit allows 8 in level attitude."""


@dataclass(frozen=True)
class Limits:
    """Limits of a manoeuvre, from its start until the stabiliser has taken over.

    Attributes:
        rate: largest norm of the body rate, rad/s.
        tilt_deg: largest angle between the body's z axis and the vertical, deg.
        altitude_loss: largest loss of height since the start, including the distance needed to stop sinking, m.
        end_rate: largest norm of the body rate at the handover, rad/s.
        end_tilt_deg: largest tilt at the handover, deg.
        command: lowest and highest command, in [0, 1].
    """

    rate: float = 12.0
    tilt_deg: float = 50.0
    altitude_loss: float = 0.5
    end_rate: float = 5.0
    end_tilt_deg: float = 35.0
    command: tuple[float, float] = (0.05, 0.95)

    def __post_init__(self):
        for name in ("rate", "tilt_deg", "altitude_loss", "end_rate", "end_tilt_deg"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0):
                raise CfbError(f"the limit on {name.replace('_', ' ')} must be positive, found {value:g}.")

    def shares(self, asked: Demand) -> Demand:
        """Every quantity of ``asked`` as a share of its limit."""

        def lean(angle_deg):
            return 1 - np.cos(np.radians(angle_deg))

        return Demand(
            asked.rate / self.rate,
            asked.lean / lean(self.tilt_deg),
            asked.altitude_loss / self.altitude_loss,
            asked.end_rate / self.end_rate,
            asked.end_lean / lean(self.end_tilt_deg),
        )


class Demand(eqx.Module):
    """Quantities that are limited, for an undisturbed flight, or their shares of the limits (`Limits.shares`)."""

    rate: Float[AnyArray, "*n"]
    """Norm of the body rate, rad/s."""
    lean: Float[AnyArray, "*n"]
    """1 - cos of the tilt; the angle itself is not differentiable at zero."""
    altitude_loss: Float[AnyArray, "*n"]
    """Loss of height since the start, including the distance needed to stop sinking, m."""
    end_rate: Float[AnyArray, "*k"]
    """Norm of the body rate at the handover, rad/s."""
    end_lean: Float[AnyArray, "*k"]
    """1 - cos of the tilt at the handover."""


def flown(model: Quadrotor, commands: Float[Array, "n 4"]) -> State:
    """Simulate an undisturbed flight from hover at height zero; states (n,) after each row of ``commands``."""
    return rollout(model, model.hover_state((0.0, 0.0, 0.0)), commands)


def demand(path: State) -> Demand:
    """Limited quantities of a flight, row by row and at the end; differentiable."""
    rate = jnp.linalg.norm(path.body_rate + 1e-9, axis=1)  # the norm is not differentiable at zero
    lean = 1 - up_axis(Vec.unstack(path.quaternion))[2]
    sinking = jnp.maximum(-path.velocity[:, 2], 0.0)
    lost = -path.position[:, 2] + sinking**2 / (2 * _BRAKING)
    return Demand(rate, lean, lost, rate[-1], lean[-1])


def stepped(model: Quadrotor, **choices) -> Quadrotor:
    """The model with one RK4 step per row of a sequence, unless ``choices`` say otherwise."""
    return Quadrotor(model.parameters, model.effects, model.body, **({"dt": STEP, "integrator": "rk4"} | choices))


def rows(duration: float) -> int:
    """Number of rows of a sequence of ``duration`` seconds.

    Raises:
        CfbError: the duration is shorter than 0.1 s or longer than 2 s.
    """
    if not 0.1 <= duration <= 2.0:
        raise CfbError(f"an open-loop manoeuvre lasts 0.1 to 2 s, found {duration:g} s; it is flown without feedback.")
    return round(duration / STEP)


def roll_pitch(duration: float = 0.5) -> np.ndarray:
    """Doublet pair about x, then about y (n, 4), as command changes of unit amplitude: for J_x and J_y."""
    n = rows(duration)
    half = n // 2
    return np.concatenate([_doublets(half, _ROLL), _doublets(n - half, _PITCH)])


def all_axes(duration: float = 0.5) -> np.ndarray:
    """Doublet pairs about x and y, a quarter of the time each, then about z (n, 4), as changes of unit amplitude."""
    n = rows(duration)
    quarter = n // 4
    return np.concatenate([_doublets(quarter, _ROLL), _doublets(quarter, _PITCH), _doublets(n - 2 * quarter, _YAW)])


def single_motor(duration: float = 0.5, motor: int = 0) -> np.ndarray:
    """Doublet pair of one motor (n, 4), as command changes of unit amplitude: for J_z and J_m.

    The motor's acceleration turns the body about z in the opposite direction (paper eq. 7). Unlike with a yaw command
    of all four motors, the drone also rolls and pitches by known amounts.
    """
    return _doublets(rows(duration), np.eye(4)[motor])


def multisine(duration: float, seed: int = 0, lines: int = 5) -> np.ndarray:
    """Sums of sines with random phases (n, 4), at different frequencies for each motor, with a maximum of one.

    Args:
        duration: s.
        seed: of the phases.
        lines: number of sines per motor.
    """
    n = rows(duration)
    rng = np.random.default_rng(seed)
    time = np.arange(n)[:, None, None] * STEP
    # The sequence contains whole periods of every sine.
    frequency = (1 + np.arange(4)[None, :, None] + 4 * np.arange(lines)[None, None, :]) / (4 * n * STEP) * 4
    waves = np.sin(2 * np.pi * frequency * time + rng.uniform(0, 2 * np.pi, (1, 4, lines))).sum(-1)
    return waves / np.abs(waves).max()


def scaled(model: Quadrotor, shape: np.ndarray, limits: Limits, margin: float = MARGIN) -> np.ndarray:
    """Hover plus the largest multiple of ``shape`` that keeps the limits.

    Args:
        model: the drone.
        shape: (n, 4) changes of the command.
        limits: of the manoeuvre.
        margin: share of every limit that may be used.

    Returns:
        Commands (n, 4).

    Raises:
        CfbError: the drone cannot hover within the command range, or the limits leave no room for a motion that exceeds
            the noise.
    """
    hover = hovering(model, limits)
    low, high = limits.command
    change = np.abs(shape).max(axis=0) > 0
    room = min(np.min(high - hover[change]), np.min(hover[change] - low)) / np.abs(shape).max()
    heights = np.linspace(0.0, room, 201)
    asked = worst(model, hover + heights[:, None, None] * shape, limits)
    # Use the largest height before the first violation; larger ones may be admissible again but are not wanted.
    first_bad = int(np.argmax(asked > margin)) if np.any(asked > margin) else len(heights)
    height = heights[max(first_bad - 1, 0)]
    if height * np.abs(shape).max() < 0.01:
        raise CfbError(
            f"the limits (body rate {limits.rate:g} rad/s, altitude loss {limits.altitude_loss:g} m) leave no room for "
            "a manoeuvre; allow more."
        )
    return hover + height * shape


def hovering(model: Quadrotor, limits: Limits) -> np.ndarray:
    """Commands (4,) of hover.

    Raises:
        CfbError: the commands lie outside the limits.
    """
    hover = np.asarray(model.hover_command(), dtype=float)
    if not np.all((hover > limits.command[0] + 0.02) & (hover < limits.command[1] - 0.02)):
        raise CfbError(
            f"this model hovers at commands {np.array2string(hover, precision=2)}, outside the range "
            f"{limits.command[0]:g} to {limits.command[1]:g} of a manoeuvre; check its mass and thrust."
        )
    return hover


def worst(model: Quadrotor, commands: np.ndarray, limits: Limits) -> np.ndarray:
    """Largest share of a limit (k,) that each sequence of commands (k, n, 4) uses; at most 1 is allowed."""
    return np.max(jax.tree.leaves(limits.shares(_peaks(stepped(model), jnp.asarray(commands)))), axis=0)


@eqx.filter_jit
def _peaks(model: Quadrotor, commands: Float[Array, "k n 4"]) -> Demand:
    return jax.vmap(lambda u: jax.tree.map(jnp.max, demand(flown(model, u))))(commands)


def _doublets(n: int, direction: np.ndarray) -> np.ndarray:
    quarter = np.minimum(np.arange(n) * 4 // n, 3)
    return _THERE_AND_BACK[quarter][:, None] * direction


SECONDS = 15.0
"""Duration of every path, s."""
HEIGHT = 1.2
"""Height of level paths, m. All paths stay within 1 m of the origin horizontally and do not exceed 2.2 m."""
Path = Float[np.ndarray, "n 4"]
"""Set-points x, y, z, m, and yaw, rad."""


def _steps(time: np.ndarray, values: list[float], duration: float) -> np.ndarray:
    return np.asarray(values)[np.minimum((time // duration).astype(int), len(values) - 1)]


def _there_and_back(time: np.ndarray, reach: float, speeds: tuple[float, ...]) -> np.ndarray:
    """Motion from -reach to reach and back at each of the speeds in turn, then standing still."""
    corners, ends = [0.0], [-reach]
    for speed in speeds:
        for end in (reach, -reach):
            corners.append(corners[-1] + 2 * reach / speed)
            ends.append(end)
    return np.interp(time, corners, ends)


def _level(
    time: np.ndarray,
    x: float | np.ndarray = 0.0,
    y: float | np.ndarray = 0.0,
    z: float | np.ndarray = HEIGHT,
    yaw: float | np.ndarray = 0.0,
) -> Path:
    return np.stack([np.broadcast_to(np.asarray(a, float), time.shape) for a in (x, y, z, yaw)], axis=1)


PATHS: dict[str, tuple[str, Callable[[np.ndarray], Path]]] = {
    "passes along x": (
        "straight passes along x at 0.5, 1 and 2.5 m/s, nose forwards",
        lambda t: _level(t, x=_there_and_back(t, 0.9, (0.5, 1.0, 2.5))),
    ),
    "passes along y": (
        "straight passes along y at 0.5, 1 and 2.5 m/s, flying sideways",
        lambda t: _level(t, y=_there_and_back(t, 0.9, (0.5, 1.0, 2.5))),
    ),
    "climbs": (
        "climbs and dives between 0.6 and 2.2 m at 0.5, 1 and 2 m/s",
        lambda t: _level(t, z=1.4 + _there_and_back(t, 0.8, (0.5, 1.0, 2.0))),
    ),
    "heights": (
        "hover for three seconds each at 0.1, 0.15, 0.25, 0.5 and 1 m",
        lambda t: _level(t, z=_steps(t, [0.1, 0.15, 0.25, 0.5, 1.0], 3.0)),
    ),
    "headings": (
        "hover with the heading turned by 90 degrees every three seconds",
        lambda t: _level(t, yaw=0.5 * np.pi * _steps(t, [0.0, 1.0, 2.0, -1.0, 0.0], 3.0)),
    ),
    "yaw turns": (
        "hover with yaw steps of 120 degrees back and forth",
        lambda t: _level(t, yaw=_steps(t, [0.0, 2.1, 0.0, -2.1] * 4, 1.0)),
    ),
    "stops": (
        "steps of one metre, forwards and sideways in turn, each followed by a hover",
        lambda t: _level(t, x=_steps(t, [0.0, 1.0, 1.0, 0.0, 0.0], 3.0), y=_steps(t, [0.0, 0.0, 1.0, 1.0, 0.0], 3.0)),
    ),
}
"""Paths by name: a description for the pilot, and a function from times (n,), s, to set-points (n, 4)."""


def path(name: str, tick: float) -> Path:
    """Set-points (n, 4) of a path, one per ``tick`` seconds."""
    return PATHS[name][1](np.arange(round(SECONDS / tick)) * tick)


def setpoints_csv(name: str, tick: float = 0.02) -> str:
    """A path as a CSV table of time, s, position, m, and yaw, rad, with a row every ``tick`` seconds."""
    rows = enumerate(path(name, tick))
    lines = ["t,x,y,z,yaw", *(f"{tick * i:.2f}," + ",".join(f"{v:.4f}" for v in row) for i, row in rows)]
    return "\n".join(lines) + "\n"
