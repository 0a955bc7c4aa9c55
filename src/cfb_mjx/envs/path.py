"""Paths to track: positions as functions of time, and what they ask of a drone.

A path is any function from a time [s] to a position (3,) [m] that JAX can differentiate. It begins at its origin.
"""

from __future__ import annotations

import math
from pathlib import Path as File
from typing import NamedTuple, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.interpolate import make_interp_spline

from cfb_mjx.documents import told
from cfb_mjx.errors import CfbError
from cfb_mjx.files import read_bytes
from cfb_mjx.model.state import AnyArray


@runtime_checkable
class Path(Protocol):
    """A position as a function of time."""

    def __call__(self, time_s: Float[AnyArray, ""], /) -> Float[Array, "3"]:
        """Return the position, m."""
        ...


class Harmonics(eqx.Module):
    """Sums of sines and cosines of one frequency and its multiples; all arrays may carry batch axes.

    The phase grows smoothly from rest during the first ``ramp_s`` seconds: a drone can begin it in hover.
    """

    rate: Float[AnyArray, ""]
    """Rate of the fundamental, rad/s."""
    sine: Float[AnyArray, "harmonics 3"]
    """Amplitudes of the sines, m."""
    cosine: Float[AnyArray, "harmonics 3"]
    ramp_s: Float[AnyArray, ""]

    def __call__(self, time_s: Float[AnyArray, ""]) -> Float[Array, "3"]:
        """Return the position, m."""
        share = jnp.clip(time_s / jnp.maximum(self.ramp_s, 1e-6), 0.0, 1.0)
        late = self.ramp_s * (share - share**3 + share**4 / 2)
        angles = self.rate * (time_s - late) * jnp.arange(1, len(self.sine) + 1)
        return jnp.sin(angles) @ self.sine + (jnp.cos(angles) - 1) @ self.cosine


def figure_eight(width_m: float = 2.0, lap_s: float = 2.0, ramp_s: float = 2.0) -> Harmonics:
    """Gerono's figure eight in a horizontal plane: ``width_m`` along x, half of that along y.

    Args:
        width_m: its width, m.
        lap_s: time for one lap, s.
        ramp_s: duration of its beginning, during which it gathers speed from rest, s.
    """
    sine = np.zeros((2, 3))
    sine[0, 0], sine[1, 1] = width_m / 2, width_m / 4
    return Harmonics(*(jnp.asarray(x, float) for x in (2 * np.pi / lap_s, sine, np.zeros((2, 3)), ramp_s)))


class Polynomials(eqx.Module):
    """Polynomials one after another, as in the firmware's high-level commander. After the last, the path stands."""

    start_s: Float[AnyArray, " pieces"]
    """Time at which each polynomial begins, s."""
    coefficients: Float[AnyArray, "pieces 3 powers"]
    """Coefficients of x, y and z, m, of the time since the polynomial began; lowest power first."""
    end_s: Float[AnyArray, ""]

    def __call__(self, time_s: Float[AnyArray, ""]) -> Float[Array, "3"]:
        """Return the position, m."""
        time_s = jnp.clip(time_s, 0.0, self.end_s)
        piece = jnp.clip(jnp.searchsorted(jnp.asarray(self.start_s), time_s, side="right") - 1, 0)
        since, own = time_s - jnp.asarray(self.start_s)[piece], jnp.asarray(self.coefficients)[piece]
        result = jnp.zeros(3, own.dtype)
        for power in range(own.shape[-1] - 1, -1, -1):
            result = result * since + own[:, power]
        return result


class Slowed(eqx.Module):
    """Another path, at another speed."""

    path: Path
    timescale: Float[AnyArray, ""]

    def __call__(self, time_s: Float[AnyArray, ""]) -> Float[Array, "3"]:
        """Return the position, m."""
        return self.path(time_s / self.timescale)


def slowed(path: Path, timescale: float) -> Path:
    """The same path with all times multiplied by ``timescale``, as in the firmware's commander: 2 is half as fast."""
    return path if timescale == 1 else Slowed(path, jnp.asarray(timescale, float))


def through(points: Float[AnyArray, "points 3"], times_s: Float[AnyArray, " points"]) -> Polynomials:
    """Smoothest path of degree 7 through points, which begins and ends at rest.

    Position to sixth derivative are continuous.

    Args:
        points: points, m.
        times_s: their times, s, increasing from 0.

    Raises:
        CfbError: fewer than two points, or times that do not increase from 0.
    """
    points, times = np.asarray(points, float), np.asarray(times_s, float)
    if len(points) < 2 or len(times) != len(points) or times[0] != 0 or np.any(np.diff(times) <= 0):
        raise CfbError(f"a path needs two points or more, at times that increase from 0; found {told(times.tolist())}.")
    rest = [(order, np.zeros(3)) for order in (1, 2, 3)]
    spline = make_interp_spline(times, points, k=7, bc_type=(rest, rest))
    # Its polynomials join where its knots are.
    starts = np.unique(spline.t)[:-1]
    powers = [spline.derivative(order)(starts) / math.factorial(order) for order in range(8)]
    return Polynomials(jnp.asarray(starts), jnp.asarray(np.stack(powers, axis=-1)), jnp.asarray(times[-1]))


def random_spline(seed: int, points: int = 8, size_m: float = 1.0, leg_s: float = 0.8) -> Polynomials:
    """Path through random points, from its origin, at rest at both ends.

    Args:
        seed: seed of the points.
        points: number of points, with the origin.
        size_m: largest distance of a point from the origin along each axis, half of that along z, m.
        leg_s: time from one point to the next, s.
    """
    drawn = np.random.default_rng(seed).uniform(-size_m, size_m, (points, 3)) * (1.0, 1.0, 0.5)
    drawn[0] = 0.0
    return through(drawn, leg_s * np.arange(points))


_HEADER = ["duration", *(f"{axis}^{power}" for axis in ("x", "y", "z", "yaw") for power in range(8))]


def read_path(file: str | File) -> Polynomials:
    """Read a trajectory in the format of Crazyswarm and uav_trajectories: a duration and 32 coefficients per line.

    Yaw is left out, because policies hold their heading; a file with a changing yaw is refused.

    Args:
        file: CSV file.

    Raises:
        CfbError: the file has another format, or its polynomials do not join.
    """
    lines = [line for line in read_bytes(file).decode(errors="replace").splitlines() if line.strip()]
    names = [name.strip().lower().strip('"') for name in lines[0].split(",")] if lines else []
    if [name for name in names if name] != _HEADER:
        raise CfbError(f"{file}: is not a trajectory; its first line must be {','.join(_HEADER[:3])} ... yaw^7.")
    try:
        rows = np.array([[float(x) for x in line.split(",") if x.strip()] for line in lines[1:]])
    except ValueError:
        raise CfbError(f"{file}: a line of the trajectory is not 33 numbers.") from None
    if rows.ndim != 2 or rows.shape[1] != 33 or not np.all(np.isfinite(rows)) or np.any(rows[:, 0] <= 0):
        raise CfbError(f"{file}: every line of a trajectory needs 33 finite numbers, the first a positive duration.")
    coefficients = rows[:, 1:].reshape(-1, 4, 8)
    if np.any(np.abs(coefficients[:, 3]) > 1e-6):
        raise CfbError(f"{file}: the yaw of this trajectory changes; policies hold their heading, so set it to zero.")
    starts = np.concatenate([[0.0], np.cumsum(rows[:, 0])])
    ends = np.einsum("pad,pd->pa", coefficients[:, :3], rows[:, :1] ** np.arange(8))
    gaps = np.abs(ends[:-1] - coefficients[1:, :3, 0])
    if np.any(gaps > 0.01):
        piece = int(np.argmax(gaps.max(axis=1)))
        raise CfbError(f"{file}: polynomials {piece + 1} and {piece + 2} do not join: {gaps.max():.3f} m apart.")
    return Polynomials(jnp.asarray(starts[:-1]), jnp.asarray(coefficients[:, :3]), jnp.asarray(starts[-1]))


class Demand(NamedTuple):
    """What a path asks of a drone without drag, at each of its times."""

    speed_mps: Float[AnyArray, " times"]
    thrust_to_weight: Float[AnyArray, " times"]
    tilt_rad: Float[AnyArray, " times"]
    rate_radps: Float[AnyArray, " times"]
    """Rate at which the thrust has to change its direction."""


def derivative(of: Path) -> Path:
    """Return the derivative of a path by time: its velocity; of that, its acceleration."""
    return lambda time_s: jax.jvp(of, (time_s,), (jnp.ones_like(time_s),))[1]


def demand(path: Path, times_s: Float[AnyArray, " times"], gravity: float = 9.81) -> Demand:
    """Return what a path asks of a drone, from the derivatives of the path (differential flatness).

    Args:
        path: the path.
        times_s: times, s.
        gravity: gravitational acceleration, m/s^2.
    """
    velocity = derivative(path)
    acceleration = derivative(velocity)

    def thrust(time):
        return acceleration(time) + jnp.array([0.0, 0.0, gravity])

    def direction(time):
        force = thrust(time)
        return force / jnp.linalg.norm(force)

    def one(time):
        force = thrust(time)
        size = jnp.linalg.norm(force)
        turning = jnp.linalg.norm(derivative(direction)(time))
        return Demand(jnp.linalg.norm(velocity(time)), size / gravity, jnp.arccos(force[2] / size), turning)

    return jax.vmap(one)(jnp.asarray(times_s))
