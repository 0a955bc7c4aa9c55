"""Search for the noise levels of an `Observer` that give the best predictions.

The maximum-likelihood levels (`cfb_mjx.sysid.observer.fit_observer`) describe the disturbances up to the next row. Over
half a second most of these decay, and a model's errors in fast manoeuvres are not disturbances. Therefore the levels
that predict best respond less to fast changes.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from cfb_mjx.errors import CfbError
from cfb_mjx.logs import FlightLog
from cfb_mjx.model import Quadrotor
from cfb_mjx.sysid.evaluation import OBSERVED, evaluate
from cfb_mjx.sysid.nanodrone import QUANTITIES, Contestant, benchmark
from cfb_mjx.sysid.observer import Observer
from cfb_mjx.sysid.sensor_faults import HEALTHY, SensorFaults

FACTORS = (2.0, 1.5)
"""Factors of the search: levels are multiplied and divided by the first until nothing improves, then by the next."""
LEAST = 1e-3
"""Smallest decrease of the score by a step."""
HORIZON = 0.5
"""Prediction horizon of the score, s."""
STRIDE = 10
"""Number of rows between windows in `benchmark_score`."""

Level = tuple[str, int | None]
"""Name of a field of `Observer`, and the axis; None: all axes, or a field without axes."""


def levels_of(observer: Observer) -> list[Level]:
    """All levels: (field, None) for every field, and (field, axis) for each axis of fields that have axes."""
    found: list[Level] = []
    for field in dataclasses.fields(observer):
        value = getattr(observer, field.name)
        found.append((field.name, None))
        if isinstance(value, tuple):
            found += [(field.name, axis) for axis in range(len(value))]
    return found


def scaled(observer: Observer, level: Level, factor: float) -> Observer:
    """The observer with one level (one axis, or all) multiplied by a factor."""
    name, axis = level
    value = getattr(observer, name)
    if isinstance(value, tuple):
        changed = tuple(factor * x if axis is None or i == axis else x for i, x in enumerate(value))
    else:
        changed = factor * value
    return dataclasses.replace(observer, **{name: changed})


def score(
    model: Quadrotor, groups: Mapping[str, Sequence[FlightLog]], observer: Observer, faults: SensorFaults = HEALTHY
) -> float:
    """Mean logarithm of the mean attitude and velocity errors at `HORIZON`, over groups and kinds of prediction.

    Args:
        model: the drone.
        groups: flights by kind of flight; all groups have the same weight.
        observer: noise levels to judge.
        faults: of the sensors.

    Raises:
        CfbError: there is no group, or a group without a prediction window.
    """
    if not groups:
        raise CfbError("Tuning an observer needs flights.")
    logs = []
    for flights in groups.values():
        found = evaluate(model, flights, horizons=(HORIZON,), observer=observer, faults=faults, keep_diverged=True)
        for metrics in filter(None, map(found.metrics, OBSERVED)):
            logs += [metrics[f"{q}@{HORIZON:g}s"] for q in ("attitude_mean_deg", "velocity_mean_mps")]
    return float(np.mean(np.log(logs)))


def benchmark_score(
    model: Quadrotor, groups: Mapping[str, Sequence[FlightLog]], observer: Observer, faults: SensorFaults = HEALTHY
) -> float:
    """Mean logarithm of the nano-drone benchmark's sums (`cfb_mjx.sysid.nanodrone`), over groups and quantities.

    Args:
        model: the drone.
        groups: flights by kind of flight; all groups have the same weight.
        observer: noise levels to judge.
        faults: of the sensors.

    Raises:
        CfbError: there is no group, or a flight does not suit the benchmark.
    """
    if not groups:
        raise CfbError("Tuning an observer needs flights.")
    contestant = Contestant(model, observer, faults)
    logs = []
    for flights in groups.values():
        row = benchmark(flights, {"tuned": contestant}, STRIDE)["rows"]["tuned"]
        logs += [row[f"{quantity}_sum_{unit}"] for quantity, unit in QUANTITIES.items()]
    return float(np.mean(np.log(logs)))


def tune_observer(
    model: Quadrotor,
    groups: Mapping[str, Sequence[FlightLog]],
    observer: Observer | None = None,
    faults: SensorFaults = HEALTHY,
    levels: Sequence[Level] | None = None,
    factors: Sequence[float] = FACTORS,
    progress: Callable[[str], None] = lambda _: None,
    judge: Callable[..., float] = score,
) -> Observer:
    """Minimise a score over the noise levels by coordinate descent.

    Args:
        model: the drone, with the effects with which it will be used; run with x64 enabled.
        groups: flights that are not used for evaluation, by kind of flight. All groups have the same weight, so many
            gentle flights do not outweigh a few aggressive ones.
        observer: initial levels.
        faults: of the sensors.
        levels: levels to tune; by default all.
        factors: factors of the steps, the largest first.
        progress: called with a message after each accepted step.
        judge: score to minimise, `score` or `benchmark_score`.

    Raises:
        CfbError: there are no flights, or a group has no prediction window.
    """
    best = observer or Observer()
    lowest = judge(model, groups, best, faults)
    moving = levels_of(best) if levels is None else levels

    def moved(level: Level, step: float) -> bool:
        nonlocal best, lowest
        before = lowest
        while (other := judge(model, groups, tried := scaled(best, level, step), faults)) < lowest - LEAST:
            best, lowest = tried, other
            progress(f"{level[0]}{'' if level[1] is None else f'[{level[1]}]'} x {step:.3g}: {lowest:.4f}")
        return lowest < before

    for factor in factors:
        # A list rather than a generator, so that every level is tried in every round.
        while any([moved(level, factor) or moved(level, 1 / factor) for level in moving]):
            pass
    return best
