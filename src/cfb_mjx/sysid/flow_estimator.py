"""What an on-board estimator with a flow deck does to the logged attitude: tilt that no gyro ever saw.

Such a Kalman filter compares the velocity it predicts with what the flow says, and corrects its velocity and its
attitude alike. Where the prediction leaves out the drag that the accelerometer feels across the thrust, or the flow is
stretched, the two never agree, and the logged attitude leans away from the true one. Along each horizontal axis, with
the lean e of the logged attitude beyond the true one, the error u of the estimated velocity against the flow's, and two
gains K and L,

    e' = -K u,   u' = (a - r c) - s (a - g e) - L u

where a is the specific force turned by the logged attitude (a - g e is the true acceleration), c its part across the
thrust, r the share of that part which the prediction ignores and s the scale of the flow. So e follows
((s - 1) a + r c) / (s g) through a second-order low-pass of natural frequency sqrt(K s g) and damping ratio
L / (2 sqrt(K s g)).

The Crazyflie's filter is that of M. Mueller, M. Hamer, R. D'Andrea, Fusing ultra-wideband range measurements with
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
"""s over which the attitude is compared with the gyro."""
STRIDE = 5
"""Every so many rows a span begins that counts."""
LEAST_SPANS = 100
"""In all logs together; fewer say nothing."""
LOW, HIGH = (0.2, 0.1, -2.0), (40.0, 20.0, 3.0)
STARTS = ((1.5, 1.0, 0.5), (5.0, 1.0, 0.5), (12.0, 1.0, 0.5))
"""Natural frequency, rad/s, damping ratio and share ignored: bounds, and where the search begins."""


@dataclass(frozen=True)
class FlowEstimator:
    """Of an on-board estimator, as its attitude, the gyro and the accelerometer tell.

    Attributes:
        scale: of the flow, as given.
        natural_frequency: of its corrections of the tilt, rad/s.
        damping_ratio: of these.
        ignored: share of the specific force across the thrust that its prediction leaves out.
        ignored_std: standard deviation of that share.
        corrected: rms tilt that the estimator adds to what the gyro saw within `SPAN`, rad.
        explained: share of that variance which this estimator explains.
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
    """A log on an even grid: horizontal specific force and its part across the thrust, m/s^2, and tilt beyond the
    gyro's, rad, all (n, 2)."""

    step: float
    force: np.ndarray
    across: np.ndarray
    beyond: np.ndarray
    begins: np.ndarray
    """Rows at which spans begin."""

    @property
    def rows(self) -> int:
        return max(2, round(SPAN / self.step))

    def over_spans(self, lean: np.ndarray) -> np.ndarray:
        """What (n, 2) gained over the spans, beside its mean."""
        gained = lean[self.begins + self.rows] - lean[self.begins]
        return gained - gained.mean(axis=0)


def fit_flow_estimator(logs: Sequence[FlightLog], scale: float = 1.0, ignored: float | None = None) -> FlowEstimator:
    """Fit an estimator to how the logged attitude departs from the gyro.

    Neither a model of the drone nor position and velocity take part. A stretched flow and ignored drag turn the
    attitude much alike where all motion is of one frequency, so only one of the two is fitted.

    Args:
        logs: flights with attitude, gyro and accelerometer, of one estimator.
        scale: of the flow.
        ignored: share of the specific force across the thrust that the prediction leaves out; None: fitted.

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
    # Spans overlap: so many of them tell what one does.
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
    # A constant turn in body axes is the gyro's bias.
    about = to_world(quaternion[1:], more - np.median(more, axis=0))
    about = np.cumsum(np.concatenate([np.zeros((1, 3)), about]), axis=0)
    # To turn about y by a little is to lean along x; about x, along -y.
    beyond = np.stack([about[:, 1], -about[:, 0]], axis=1)
    rows = max(2, round(SPAN / step))
    begins = np.arange(0, max(len(grid) - rows, 0), STRIDE)
    for gap in log.gaps():
        begin, end = log.time[gap], log.time[gap + 1]
        begins = begins[(grid[begins] > end) | (grid[begins + rows] < begin)]
    force, across = (to_world(quaternion, x)[:, :2] for x in (felt, felt * [1.0, 1.0, 0.0]))
    return _Seen(step, force, across, beyond, begins)


def _lean(one: _Seen, scale: float, frequency: float, damping: float, ignored: float) -> np.ndarray:
    """Lean of the logged attitude beyond the true one, (n, 2) rad."""
    target = ((scale - 1) * one.force + ignored * one.across) / (scale * GRAVITY)
    low_pass = bilinear([frequency**2], [1.0, 2 * damping * frequency, frequency**2], 1 / one.step)
    return lfilter(*low_pass, target, axis=0, zi=lfilter_zi(*low_pass)[:, None] * target[:1])[0]
