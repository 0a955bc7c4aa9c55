"""Fly controllers along paths, and measure how far from them they are."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from cfb_mjx.control.controllers import Controller
from cfb_mjx.envs.path import Path as Way
from cfb_mjx.envs.path import Polynomials, demand, figure_eight, random_spline, read_path, slowed
from cfb_mjx.envs.target import TargetTask
from cfb_mjx.envs.task import with_room
from cfb_mjx.errors import CfbError
from cfb_mjx.model.quadrotor import Quadrotor
from cfb_mjx.train.flight import Flight, fly, off_target


class Tracking(NamedTuple):
    """Measurements of the tracking of a path, per drone."""

    mean_distance_m: Float[Array, "*drones"]
    """Mean distance from the target, which moves."""
    largest_distance_m: Float[Array, "*drones"]
    peak_speed_mps: Float[Array, "*drones"]
    failed: Bool[Array, "*drones"]


TRACKED_S, SETTLED_S = 10.0, 4.0
"""Duration of the tracking of a path that has no end, and the initial time that is not counted."""


class Course(NamedTuple):
    """A path and how it is tracked."""

    path: Way
    seconds: float = TRACKED_S
    settled_s: float = SETTLED_S
    """Initial time that is not counted, s."""


def find_course(name: str | Path, seed: int = 0, timescale: float = 1.0) -> Course:
    """Return a path by its name, or from a trajectory file.

    Args:
        name: ``figure-eight`` (2 m by 1 m in 2 s), ``random`` (a smooth path through random points), or a CSV file in
            the format of uav_trajectories.
        seed: seed of the random points.
        timescale: factor on all times, as in the firmware: 2 is half as fast.

    Raises:
        CfbError: no such path, a file of another format, or a timescale that is not positive.
    """
    require_timescale(timescale)
    if name == "figure-eight":
        return Course(slowed(figure_eight(), timescale), TRACKED_S * timescale, SETTLED_S * timescale)
    if name != "random" and Path(name).suffix != ".csv":
        raise CfbError(f"{name}: no such path; give figure-eight, random, or a trajectory file (.csv).")
    path: Polynomials = random_spline(seed) if name == "random" else read_path(name)
    return Course(slowed(path, timescale), float(path.end_s) * timescale + 1.0, 0.0)


def require_timescale(timescale: float) -> None:
    """Raise unless a factor on times is positive."""
    if not (np.isfinite(timescale) and timescale > 0):
        raise CfbError(f"timescale = {timescale}: must be positive; 2 flies a path half as fast.")


def demanded(course: Course) -> dict[str, float]:
    """Largest speed [m/s], thrust in weights and rate [rad/s] that a path asks of a drone without drag."""
    found = demand(course.path, jnp.arange(0.0, course.seconds, 0.01))
    return {key: float(jnp.max(getattr(found, key))) for key in ("speed_mps", "thrust_to_weight", "rate_radps")}


def track(
    controller: Controller,
    task: TargetTask,
    nominal: Quadrotor,
    keys: PRNGKeyArray,
    path: Way | None = None,
    seconds: float = TRACKED_S,
    settled_s: float = SETTLED_S,
) -> tuple[Tracking, Flight]:
    """Track a path from hover at its beginning.

    Args:
        controller: the controller; those that do not see ahead are given a target that moves.
        task: determines the drones and the noise.
        nominal: the nominal drone.
        keys: one key per flight.
        path: the path, which begins at rest; default: a figure eight, 2 m by 1 m in 2 s (`cfb_mjx.envs.figure_eight`).
        seconds: duration, s.
        settled_s: initial time that is not counted, s.

    Returns:
        The measurements and the flights, with ``watched`` the target.
    """
    path = figure_eight() if path is None else path
    return _track(controller, with_room(task, nominal), nominal, keys, path, seconds, settled_s)


@eqx.filter_jit
def _track(controller, task, nominal, keys, path, seconds, settled_s):
    start = nominal.hover_state(path(jnp.zeros(())))
    flown = jax.vmap(lambda key: fly(controller, task, nominal, key, seconds, start, path=path))(keys)
    distance = off_target(flown, controller.control_dt_s, settled_s)
    speed = jnp.linalg.norm(flown.velocity, axis=-1)[:, -distance.shape[1] :].max(axis=1)
    return Tracking(distance.mean(axis=1), distance.max(axis=1), speed, flown.failed[:, -1]), flown
