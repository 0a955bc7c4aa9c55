"""Fit of the frequency band in which a velocity column is stretched, by comparison with the derivative of the position.

The sensor check finds a constant scale. An estimator that follows a stretched flow slowly, and is pulled back by its
position, stretches only a band of frequencies (`VelocityStretch`). The band is fitted if a scale was found, and
accepted only if flights to which it was not fitted confirm it.
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
"""Highest frequency of the comparison, Hz; the derivative of the position is too noisy for faster motion."""
MARGIN = 2.0
"""Margin at the ends of a flight and of its gaps, s, where the filters are not valid."""
LEAST_FLIGHTS = 3
"""Smallest number of flights; each in turn is judged by a fit to the others."""
BETTER, SURE = 0.1, 3.0
"""Share of the error's variance that the band must remove in flights to which it was not fitted, and the significance
of this share in standard deviations."""
LOW, HIGH = (-0.5, 0.01, 0.05), (0.5, 2.0, 60.0)
START = (0.1, 0.3, 0.8)
"""Bounds and initial values of the share of the logged velocity, of rise, s, and of fade, s."""


@dataclass(frozen=True)
class _Seen:
    """One flight on an even grid.

    Attributes:
        step: of the grid, s.
        velocity: (n, 2) horizontal velocity as logged, m/s.
        over: (n, 2) logged velocity minus the derivative of the position, low-passed, m/s.
        counts: (n,) rows that are compared.
    """

    step: float
    velocity: np.ndarray
    over: np.ndarray
    counts: np.ndarray

    def missed(self, numbers: Sequence[float] | np.ndarray) -> np.ndarray:
        """Part of ``over`` that a band (share, rise, fade) does not explain."""
        share, rise, fade = numbers
        slow = _lagged(self.velocity, self.step, rise)
        return self._left(share * (slow - _lagged(slow, self.step, fade)))

    def missed_by_scale(self, share: float) -> np.ndarray:
        """Part of ``over`` that a constant scale does not explain."""
        return self._left(share * self.velocity)

    def _left(self, stretch: np.ndarray) -> np.ndarray:
        return (self.over - _slow(stretch, self.step))[self.counts].ravel()


def with_band(faults: SensorFaults, logs: Sequence[FlightLog]) -> SensorFaults:
    """Replace a constant horizontal scale of the velocity by a band if that is clearly better.

    Args:
        faults: from the comparison of the sensors (`check_sensors`).
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
    """Share of the variance of velocity minus position derivative, horizontal and below `SLOW`, that faults explain."""
    before, after = _seen(log), _seen(faults.unstretched(log))
    return float(1 - np.mean(after.over[after.counts] ** 2) / np.mean(before.over[before.counts] ** 2))


def _gain(others: list[_Seen], judged: _Seen) -> float:
    """Share by which a band leaves less residual variance of a flight than a scale, both fitted to other flights."""
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
