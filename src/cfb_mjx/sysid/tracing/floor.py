"""The noise floor of a prediction error: what a perfect model would score, its start and the truth being measured."""

from __future__ import annotations

import numpy as np

from cfb_mjx.logs import FlightLog
from cfb_mjx.sysid.evaluation import Evaluation, LogEvaluation
from cfb_mjx.sysid.identification.flight_data import white_noise
from cfb_mjx.sysid.metrics import QUANTITIES
from cfb_mjx.sysid.tracing.whitening import Levels


def noise_floor(evaluation: Evaluation, levels: Levels | None = None) -> dict[str, float]:
    """Floor of the RMS errors, ``<quantity>_rmse_<unit>@<horizon>s``, over all windows of all logs.

    White noise of each column is carried forward to first order: a wrong body rate turns
    the attitude, a wrong attitude tilts the thrust, a wrong velocity moves the position. Commands between two rows and
    what an estimator smoothed are not in it, so it is a lower bound.

    Args:
        evaluation: whose windows and horizons count.
        levels: random forces and torques to carry along with the sensors' noise; None for the sensors alone.
    """
    weights = np.array([len(log.windows) for log in evaluation.logs], dtype=float)
    squares = np.array([_squares(log, evaluation.horizons, levels) for log in evaluation.logs])
    rms = np.sqrt(np.einsum("l,lqh->qh", weights / weights.sum(), squares))
    return {
        f"{quantity}_rmse_{unit}@{horizon:g}s": float(rms[i, k])
        for i, (quantity, unit) in enumerate(QUANTITIES.items())
        for k, horizon in enumerate(evaluation.horizons)
    }


def sensor_levels(log: FlightLog) -> dict[str, np.ndarray]:
    """White noise of a row: position (3) m, velocity (3) m/s, angle () rad, gyro (3) rad/s."""
    # Noise of three angles is twice that of the quaternion's vector part, and leaves its norm alone.
    angle = 2 * np.sqrt(np.sum(white_noise(log.quaternion, log.time) ** 2) / 3)
    columns = {"position": log.position, "velocity": log.velocity, "gyro": log.body_rate}
    return {key: white_noise(values, log.time) for key, values in columns.items()} | {"angle": angle}


def _squares(evaluated: LogEvaluation, horizons: tuple[float, ...], levels: Levels | None) -> np.ndarray:
    """(4, H) mean squared errors of one log, in the order of `QUANTITIES`."""
    log, starts = evaluated.log, evaluated.windows.start
    if not len(starts):
        return np.zeros((4, len(horizons)))
    noise = sensor_levels(log)
    pose, gyro = (_averaging(log.time, starts + late) for late in (evaluated.delay, evaluated.gyro_delay))
    force = float(np.sqrt(np.mean(np.sum(log.specific_force**2, axis=1))))
    out = np.zeros((4, len(horizons)))
    for axis in range(3):
        # An angle about x or y tilts the thrust sideways; one about z moves nothing.
        turn = {0: 1, 1: 0, 2: 2}[axis]
        start = [pose * noise["position"][axis] ** 2, pose * noise["velocity"][axis] ** 2]
        start += [pose * noise["angle"] ** 2, gyro * noise["gyro"][turn] ** 2]
        for k, horizon in enumerate(horizons):
            moved = _carried(np.array(start), horizon, force if axis < 2 else 0.0, levels, axis, turn)
            late = _averaging(log.time, starts + evaluated.delay + horizon)
            seen = late * np.array([noise["position"][axis], noise["velocity"][axis], noise["angle"]]) ** 2
            rate = _averaging(log.time, starts + evaluated.gyro_delay + horizon) * noise["gyro"][turn] ** 2
            out[:, k] += (moved + np.array([*seen, rate])) * [1, 1, np.degrees(1.0) ** 2, 1]
    return out


def _averaging(time: np.ndarray, at: np.ndarray) -> float:
    """Mean factor by which interpolation between two rows changes the variance of their noise."""
    row = np.clip(np.searchsorted(time, at, side="right") - 1, 0, len(time) - 2)
    share = np.clip((at - time[row]) / (time[row + 1] - time[row]), 0.0, 1.0)
    return float(np.mean(share**2 + (1 - share) ** 2))


def _carried(start: np.ndarray, horizon: float, force: float, levels: Levels | None, axis: int, turn: int):
    """(4,) variances of position, velocity, angle and rate along one axis after ``horizon`` seconds."""
    from scipy.linalg import expm

    # Position, velocity, angle, rate, and a wandering acceleration and angular acceleration.
    slope = np.zeros((6, 6))
    slope[0, 1] = slope[2, 3] = slope[1, 4] = slope[3, 5] = 1.0
    slope[1, 2] = force
    first, drive = np.zeros(6), np.zeros(6)
    first[:4] = start
    if levels is not None:
        for index, channel, quantity in ((4, 3 + axis, 1), (5, turn, 3)):
            rate, size = 1 / float(levels.correlation_time[channel]), float(levels.disturbance[channel])
            slope[index, index] = -rate
            first[index], drive[index] = size**2, 2 * rate * size**2
            drive[quantity] = float(levels.walk[channel]) ** 2
    # Van Loan: transition and accumulated covariance from one matrix exponential.
    block = np.block([[-slope, np.diag(drive)], [np.zeros((6, 6)), slope.T]]) * horizon
    both = expm(block)
    transition = both[6:, 6:].T
    return np.diag(transition @ np.diag(first) @ transition.T + transition @ both[:6, 6:])[:4]
