"""Noise levels of an `Observer` that predict best, by search over flights nobody judges.

The likeliest levels (`cfb_mjx.sysid.observer.fit_observer`) describe what disturbs the next row. Half a second on,
most of that has faded, and what a model misses in hard turns is no disturbance at all: levels that predict best there
trust quick changes less.
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
"""Steps of the search: levels are multiplied and divided by the first until that helps no more, then by the next."""
LEAST = 1e-3
"""A step must lower the score by this."""
HORIZON = 0.5
"""Seconds ahead at which levels are judged."""
STRIDE = 10
"""Rows from window to window where the benchmark's rules judge."""

Level = tuple[str, int | None]


def levels_of(observer: Observer) -> list[Level]:
    """Every level that may be moved: (field, None), and (field, axis) for each axis of those that have axes."""
    found: list[Level] = []
    for field in dataclasses.fields(observer):
        value = getattr(observer, field.name)
        found.append((field.name, None))
        if isinstance(value, tuple):
            found += [(field.name, axis) for axis in range(len(value))]
    return found


def scaled(observer: Observer, level: Level, factor: float) -> Observer:
    """With one level (all its axes, or one) multiplied."""
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
    """Mean logarithm of the mean attitude and velocity errors at `HORIZON`, every group and kind counting alike.

    Raises:
        CfbError: no group, or one in which no prediction window fits.
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
    """Mean logarithm of the nano-drone benchmark's sums (`cfb_mjx.sysid.nanodrone`), every group and quantity alike.

    Raises:
        CfbError: no group, or a flight that is not of the benchmark.
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
    """Move the levels one after another, again and again, until no step makes predictions better.

    Args:
        model: the drone, with the effects it will be used with; run with x64 enabled.
        groups: flights that will not be judged, by kind of flight, so that many gentle ones do not drown a wild one.
        observer: where to start.
        faults: of the sensors.
        levels: which may be moved; by default all.
        factors: steps, the largest first.
        progress: told about every step taken.
        judge: what to make small, `score` or `benchmark_score`.

    Raises:
        CfbError: no flights, or a group in which no prediction window fits.
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
        # A list: every level has its turn in every round.
        while any([moved(level, factor) or moved(level, 1 / factor) for level in moving]):
            pass
    return best
