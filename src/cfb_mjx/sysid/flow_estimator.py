"""Model of the tilt error that an on-board estimator with a flow deck adds to the logged attitude.

Such a Kalman filter compares its predicted velocity with the flow measurement and corrects both velocity and attitude.
If the prediction ignores the drag across the thrust that the accelerometer measures, or if the flow is stretched, the
two never agree, and the logged attitude leans away from the true one. For each horizontal axis, let e be the lean of
the logged attitude relative to the true one, u the error of the estimated velocity relative to the flow, and K and L
two gains. Then

    e' = -K u,   u' = (a - r c) - s (a - g e) - L u

where a is the specific force rotated by the logged attitude (a - g e is the true acceleration), c its part across the
thrust, r the share of c that the prediction ignores, and s the scale of the flow. So e is
((s - 1) a + r c) / (s g) through a second-order low-pass of natural frequency sqrt(K s g) and damping ratio
L / (2 sqrt(K s g)).

The filter of the Crazyflie is that of M. Mueller, M. Hamer, R. D'Andrea, Fusing ultra-wideband range measurements with
accelerometers and rate gyroscopes for quadrocopter state estimation, ICRA 2015. In flight its firmware predicts from
thrust alone: r = 1.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares
from scipy.signal import bilinear, lfilter, lfilter_zi

from cfb_mjx.errors import CfbError
from cfb_mjx.logs import FlightLog
from cfb_mjx.logs.resample import interpolate
from cfb_mjx.logs.rotation import conjugate, exponential, multiply, rotation_vector, tidy, to_world

GRAVITY = 9.81
SPAN = 0.5
"""Time span over which attitude and gyro are compared, s."""
STRIDE = 5
"""Number of rows between the starts of two spans."""
LEAST_SPANS = 100
"""Minimum number of spans in all logs together."""
LOW, HIGH = (0.2, 0.1, -2.0), (40.0, 20.0, 3.0)
STARTS = ((1.5, 1.0, 0.5), (5.0, 1.0, 0.5), (12.0, 1.0, 0.5))
"""Bounds and initial values of natural frequency, rad/s, damping ratio, and ignored share."""


@dataclass(frozen=True)
class FlowEstimator:
    """Parameters of an on-board estimator, fitted to its attitude, the gyro and the accelerometer.

    Attributes:
        scale: of the flow, as given.
        natural_frequency: of the corrections of the tilt, rad/s.
        damping_ratio: of the corrections of the tilt.
        ignored: share of the specific force across the thrust that the prediction ignores.
        ignored_std: standard deviation of that share.
        corrected: rms tilt that the estimator adds to that of the gyro within `SPAN`, rad.
        explained: share of the variance of this tilt that the fit explains.
    """

    scale: float
    natural_frequency: float
    damping_ratio: float
    ignored: float
    ignored_std: float
    corrected: float
    explained: float


@dataclass(frozen=True)
class _Seen:
    """A log on an even grid of n rows.

    Attributes:
        step: of the grid, s.
        force: (n, 2) horizontal specific force, m/s^2.
        across: (n, 2) horizontal part of the specific force across the thrust, m/s^2.
        beyond: (n, 2) accumulated tilt of the attitude beyond that of the gyro, rad.
        begins: rows at which spans begin.
    """

    step: float
    force: np.ndarray
    across: np.ndarray
    beyond: np.ndarray
    begins: np.ndarray

    @property
    def rows(self) -> int:
        """Number of rows of a span."""
        return max(2, round(SPAN / self.step))

    def over_spans(self, lean: np.ndarray) -> np.ndarray:
        """Changes of a tilt (n, 2) over the spans, minus their mean."""
        gained = lean[self.begins + self.rows] - lean[self.begins]
        return gained - gained.mean(axis=0)


def fit_flow_estimator(logs: Sequence[FlightLog], scale: float = 1.0, ignored: float | None = None) -> FlowEstimator:
    """Fit the parameters of an on-board estimator to the deviation of the logged attitude from the gyro.

    No model of the drone, position or velocity is needed. If all motion has one frequency, a stretched flow and ignored
    drag have nearly the same effect on the attitude. Therefore the scale is given and not fitted.

    Args:
        logs: flights with attitude, gyro and accelerometer, of one estimator.
        scale: of the flow.
        ignored: share of the specific force across the thrust that the prediction ignores; None: it is fitted.

    Raises:
        CfbError: too little flight without a gap.
    """
    seen = [one for one in (_seen(log) for log in logs if log.duration > 2 * SPAN) if len(one.begins)]
    if sum(len(one.begins) for one in seen) < LEAST_SPANS:
        names = ", ".join(log.name for log in logs) or "no logs"
        raise CfbError(f"{names}: too little flight without a gap to compare the attitude with the gyro.")
    measured = np.concatenate([one.over_spans(one.beyond) for one in seen])
    free = 2 if ignored is not None else 3

    def missed(numbers):
        frequency, damping, share = numbers if ignored is None else (*numbers, ignored)
        leans = (one.over_spans(_lean(one, scale, frequency, damping, share)) for one in seen)
        return (np.concatenate(list(leans)) - measured).ravel()

    bounds = LOW[:free], HIGH[:free]
    found = min((least_squares(missed, start[:free], bounds=bounds) for start in STARTS), key=lambda fit: fit.cost)
    # The spans overlap; this is the number of spans per independent one.
    repeats = seen[0].rows / STRIDE
    spread = np.linalg.pinv(found.jac.T @ found.jac) * np.mean(found.fun**2) * repeats
    return FlowEstimator(
        scale=scale,
        natural_frequency=float(found.x[0]),
        damping_ratio=float(found.x[1]),
        ignored=float(found.x[2]) if ignored is None else ignored,
        ignored_std=float(np.sqrt(spread[2, 2])) if ignored is None else 0.0,
        corrected=float(np.sqrt(np.mean(np.sum(measured**2, axis=1)))),
        explained=float(1 - np.mean(found.fun**2) / np.mean(measured**2)),
    )


def _seen(log: FlightLog) -> _Seen:
    step = log.nominal_interval
    delay = log.metadata.get("observation_delay") or 0.0
    grid = np.arange(log.time[0], log.time[-1] - delay, step)
    quaternion = tidy(interpolate(log.time, tidy(log.quaternion), grid + delay))
    rate, felt = interpolate(log.time, log.body_rate, grid), interpolate(log.time, log.specific_force, grid)
    turned = exponential(0.5 * (rate[1:] + rate[:-1]) * step)
    more = rotation_vector(multiply(conjugate(turned), multiply(conjugate(quaternion[:-1]), quaternion[1:])))
    # Remove the gyro's bias: a constant rotation in body axes.
    about = to_world(quaternion[1:], more - np.median(more, axis=0))
    about = np.cumsum(np.concatenate([np.zeros((1, 3)), about]), axis=0)
    # A small rotation about y is a lean along x; one about x is a lean along -y.
    beyond = np.stack([about[:, 1], -about[:, 0]], axis=1)
    rows = max(2, round(SPAN / step))
    begins = np.arange(0, max(len(grid) - rows, 0), STRIDE)
    for gap in log.gaps():
        begin, end = log.time[gap], log.time[gap + 1]
        begins = begins[(grid[begins] > end) | (grid[begins + rows] < begin)]
    force, across = (to_world(quaternion, x)[:, :2] for x in (felt, felt * [1.0, 1.0, 0.0]))
    return _Seen(step, force, across, beyond, begins)


def _lean(one: _Seen, scale: float, frequency: float, damping: float, ignored: float) -> np.ndarray:
    """Modelled lean (n, 2) of the logged attitude relative to the true one, rad."""
    target = ((scale - 1) * one.force + ignored * one.across) / (scale * GRAVITY)
    low_pass = bilinear([frequency**2], [1.0, 2 * damping * frequency, frequency**2], 1 / one.step)
    return lfilter(*low_pass, target, axis=0, zi=lfilter_zi(*low_pass)[:, None] * target[:1])[0]
