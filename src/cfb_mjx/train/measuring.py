"""Fly a test on one drone or many, and summarise the measurements for JSON: the results of ``cfb fly``."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import PRNGKeyArray

from cfb_mjx.control.controllers import Controller
from cfb_mjx.devices import Devices
from cfb_mjx.envs.target import TargetTask
from cfb_mjx.model.quadrotor import Quadrotor
from cfb_mjx.train.flight import Flight
from cfb_mjx.train.flips import FLIPS, flips
from cfb_mjx.train.flying import hover, recovery, six_metres
from cfb_mjx.train.landing import land
from cfb_mjx.train.together import cross, follow
from cfb_mjx.train.tracking import Course, track

TESTS: dict[str, Callable[..., tuple[Any, Flight]]] = {
    "hover": hover,
    "step": six_metres,
    "recover": recovery,
    "track": track,
    "land": land,
    "cross": cross,
    "follow": follow,
}
"""Tests by name; each takes controller, task, nominal drone and keys, and returns measurements and flights."""

TRACKED = ("track", "cross", "follow")
"""Tests in which a target moves."""
_ENDS = {"recover": "recovered", "land": "landed"}
"""Words for the success of a single flight of a test."""
QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)


def measured(
    test: str,
    controller: Controller,
    task: TargetTask,
    keys: PRNGKeyArray,
    over: Devices,
    course: Course | None = None,
) -> Callable[[Quadrotor], tuple[dict[str, Any], Flight]]:
    """Return a function that flies a test on a drone.

    Args:
        test: name in `TESTS` or `FLIPS`.
        controller: the controller; a manoeuvre for a flip.
        task: determines the drones and the noise; with room for its delays (`cfb_mjx.envs.task.with_room`).
        keys: one key per flight.
        over: devices that share the flights.
        course: what to track, for the tests ``track`` and ``follow``; default: a figure eight.

    Returns:
        A function of the nominal drone that returns the `summary` and the flights, axes (drones, steps).
    """
    flown_by: Callable[..., tuple[Any, Flight]] = flips if test in FLIPS else TESTS[test]
    if course is not None:
        flown_by = partial(flown_by, path=course.path, seconds=course.seconds, settled_s=course.settled_s)
    divided = over.divided(lambda controller, drone, keys: flown_by(controller, task, drone, keys), (None, None, 0), 0)

    def fly(drone: Quadrotor) -> tuple[dict[str, Any], Flight]:
        if over.several:
            found = over.here(eqx.filter_jit(divided)(controller, drone, over.along(over.padded(keys))))
            numbers, flown = jax.tree.map(lambda x: x[: len(keys)], found)
        else:
            numbers, flown = flown_by(controller, task, drone, keys)
        completed = np.asarray(numbers.completed(FLIPS[test])) if test in FLIPS else None
        diverged = ~np.all(np.isfinite(np.asarray(flown.position)), axis=(1, 2))
        return summary(test, {k: np.asarray(v) for k, v in numbers._asdict().items()}, completed, diverged), flown

    return fly


def summary(
    test: str,
    numbers: Mapping[str, np.ndarray],
    completed: np.ndarray | None = None,
    diverged: np.ndarray | None = None,
) -> dict[str, Any]:
    """Summary of a test, for JSON: means over the flights, and for many flights also quantiles and the success rate.

    Flights that diverged count as failed and are left out of the means.

    Args:
        test: name of the test.
        numbers: measurements, one number per flight.
        completed: for flips, whether each flight completed it.
        diverged: whether the state of each flight is not finite at the end; by default none is.
    """
    diverged = np.zeros_like(numbers["failed"]) if diverged is None else diverged
    failed = numbers["failed"] | diverged
    if test == "hover":
        values = {"mean_distance_mm": 1e3 * numbers["mean_distance_m"], "command_std": numbers["command_std"]}
        good = ~failed
    elif test == "step":
        values = {key: numbers[key] for key in ("arrival_s", "peak_speed_mps", "overshoot_m")}
        good = ~failed & np.isfinite(numbers["arrival_s"])
    elif test in TRACKED:
        values = {f"{key}m": 1e3 * x for key, x in numbers.items() if key.endswith("_m")}
        values |= {key: x for key, x in numbers.items() if key.endswith("_mps")}
        good = ~failed
    elif test == "recover":
        values = {key: numbers[key] for key in ("lost_height_m", "final_distance_m")}
        good = numbers["recovered"] & ~diverged
    elif test == "land":
        values = {key: numbers[key] for key in ("vertical_speed_mps", "horizontal_speed_mps", "tilt_deg")}
        values |= {"distance_mm": 1e3 * numbers["distance_m"]}
        good = numbers["landed"] & ~diverged
    else:
        values = {key: value for key, value in numbers.items() if key != "failed"}
        good = completed & ~diverged
    # The numbers of a failed flip are meaningless, and some are infinite; those of a contact that never was are NaN.
    counted = good if completed is not None and good.any() else ~diverged
    counted = counted & ~np.isnan(numbers["tilt_deg"]) if test == "land" else counted
    result: dict[str, Any] = {
        key: _finite(np.mean(value[counted])) if counted.any() else None for key, value in values.items()
    }
    result["failed"] = bool(failed.any())
    if diverged.any():
        result["diverged"] = int(diverged.sum())
    if len(failed) > 1:
        result |= {"failure_rate": float(failed.mean()), "success_rate": float(good.mean())}
        result["quantiles"] = {
            key: {f"{q:g}": _finite(np.quantile(value[good], q)) if good.any() else None for q in QUANTILES}
            for key, value in values.items()
        }
    elif test in _ENDS:
        result[_ENDS[test]] = bool(good[0])
    elif completed is not None:
        result["completed"] = bool(good[0])
    return result


def _finite(number: float | np.floating) -> float | None:
    return float(number) if math.isfinite(number) else None
