"""Whether a velocity column is stretched at all frequencies or in a band of them, told by the slope of its position.

A constant scale is what close-loop looks for. Where it is found, an estimator that follows a stretched flow slowly, and
is pulled back by its position, stretches only what lies between (`VelocityStretch`); this fits that band, and takes it
only if flights it was not fitted to bear it out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares
from scipy.signal import butter, lfilter, sosfiltfilt

from cfb_mjx.logs import FlightLog
from cfb_mjx.logs.resample import interpolate
from cfb_mjx.sysid.sensor_faults import SensorFaults
from cfb_mjx.sysid.velocity_stretch import lag_weights

SLOW = 4.0
"""Hz; the slope of a position shows no faster motion."""
MARGIN = 2.0
"""Beside the ends of a flight and of its gaps, s: there the filters say nothing."""
LEAST_FLIGHTS = 3
"""Each in turn is judged by a fit to the others."""
BETTER, SURE = 0.1, 3.0
"""Share of the error's variance that the band must take off where it was not fitted, and standard deviations of it."""
LOW, HIGH = (-0.5, 0.01, 0.05), (0.5, 2.0, 60.0)
START = (0.1, 0.3, 0.8)
"""Share of the logged velocity, rise and fade, s: bounds, and where the search begins."""


@dataclass(frozen=True)
class _Seen:
    """One flight on an even grid: horizontal velocity as logged and, where it counts, what it has over the slope."""

    step: float
    velocity: np.ndarray
    over: np.ndarray
    counts: np.ndarray

    def missed(self, numbers: Sequence[float] | np.ndarray) -> np.ndarray:
        """Left of ``over`` by a band (share, rise, fade)."""
        share, rise, fade = numbers
        slow = _lagged(self.velocity, self.step, rise)
        return self._left(share * (slow - _lagged(slow, self.step, fade)))

    def missed_by_scale(self, share: float) -> np.ndarray:
        """Left of it where all motion is stretched alike."""
        return self._left(share * self.velocity)

    def _left(self, stretch: np.ndarray) -> np.ndarray:
        return (self.over - _slow(stretch, self.step))[self.counts].ravel()


def with_band(faults: SensorFaults, logs: Sequence[FlightLog]) -> SensorFaults:
    """The same faults, a horizontal scale of the velocity replaced by a band where that is clearly what it is.

    Args:
        faults: as sensors compared with each other tell (`check_sensors`).
        logs: the flights, as recorded.
    """
    if faults.velocity_scale == 1.0:
        return faults
    seen = [one for one in (_seen(log) for log in logs if log.duration > 2 * MARGIN) if one.counts.any()]
    if len(seen) < LEAST_FLIGHTS:
        return faults
    gains = np.array([_gain([x for x in seen if x is not one], one) for one in seen])
    if gains.mean() < BETTER or gains.mean() < SURE * gains.std(ddof=1) / np.sqrt(len(gains)):
        return faults
    share, rise, fade = _fit(seen)
    return replace(
        faults,
        velocity_scale=float(1 / (1 - share)),
        vertical_scale=float(faults.stretch.scale[2]),
        velocity_rise=float(rise),
        velocity_fade=float(fade),
    )


def explained(faults: SensorFaults, log: FlightLog) -> float:
    """Share of the variance of what a horizontal velocity has over the slope of its position, below `SLOW`, that some
    faults take out of it."""
    before, after = _seen(log), _seen(faults.unstretched(log))
    return float(1 - np.mean(after.over[after.counts] ** 2) / np.mean(before.over[before.counts] ** 2))


def _gain(others: list[_Seen], judged: _Seen) -> float:
    """By which share a band leaves less of a flight than a scale, both fitted to other flights."""
    along = [_slow(one.velocity, one.step)[one.counts].ravel() for one in others]
    over = [one.missed_by_scale(0.0) for one in others]
    share = float(sum(x @ y for x, y in zip(along, over, strict=True)) / sum(x @ x for x in along))
    even, band = judged.missed_by_scale(share), judged.missed(_fit(others))
    return float(1 - (band @ band) / (even @ even))


def _fit(seen: list[_Seen]) -> np.ndarray:
    return least_squares(
        lambda x: np.concatenate([one.missed(x) for one in seen]), START, bounds=(LOW, HIGH), x_scale=START
    ).x


def _seen(log: FlightLog) -> _Seen:
    step = log.nominal_interval
    grid = np.arange(log.time[0], log.time[-1], step)
    place, velocity = (interpolate(log.time, x, grid)[:, :2] for x in (log.position, log.velocity))
    counts = (grid > grid[0] + MARGIN) & (grid < grid[-1] - MARGIN)
    for gap in log.gaps():
        counts &= (grid < log.time[gap] - MARGIN) | (grid > log.time[gap + 1] + MARGIN)
    return _Seen(step, velocity, _slow(velocity - np.gradient(place, step, axis=0), step), counts)


def _slow(values: np.ndarray, step: float) -> np.ndarray:
    return sosfiltfilt(butter(2, min(SLOW, 0.2 / step), fs=1 / step, output="sos"), values, axis=0)


def _lagged(values: np.ndarray, step: float, time: float) -> np.ndarray:
    keep, last, now = lag_weights(step, time)
    return lfilter([now, last], [1.0, -keep], values, axis=0, zi=(1.0 - now) * values[:1])[0]
