"""Comparison of the sensors with each other, without a model of the drone: biases, lags and scales.

The integrated gyro must match the change of the attitude, the integrated accelerometer the change of the velocity, and
the integrated velocity the change of the position. A mismatch is a sensor fault, not physics. Faults found here are
removed before the search for effects.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import norm

from cfb_mjx.logs import FlightLog
from cfb_mjx.logs.resample import interpolate
from cfb_mjx.logs.rotation import tidy
from cfb_mjx.logs.rotation import to_world as rotate
from cfb_mjx.model.effects import SENSOR_FAULTS
from cfb_mjx.sysid.flight import with_gyro_in_time
from cfb_mjx.sysid.sensor_faults import ATTRIBUTES, SensorFaults

SHORT, LONG = 0.12, 0.6
"""Time spans of the comparisons, s: short ones for lags, long ones for biases and scales."""
LAGS = np.arange(-0.024, 0.0681, 0.004)
"""Lags that are tried, s."""


@dataclass(frozen=True)
class Kinematics:
    """Result of `compare_sensors` for one log.

    Attributes:
        gyro_bias: (3,) rad/s.
        accelerometer_bias: (3,) m/s^2, body axes.
        attitude_lag: lag of the attitude behind the gyro beyond the declared delay, s.
        velocity_lag: lag of the velocity behind the accelerometer beyond the declared delay, s.
        velocity_scale: velocity over the derivative of the position.
        horizontal_scale: the same for the horizontal components only.
        vertical_scale: the same for the vertical component only.
        gyro_scale: gyro over the angular rate of the attitude.
        weight: (6,) inverse variances of the two lags and the four scales, in this order, for pooling over logs.
    """

    gyro_bias: np.ndarray
    accelerometer_bias: np.ndarray
    attitude_lag: float
    velocity_lag: float
    velocity_scale: float
    horizontal_scale: float
    vertical_scale: float
    gyro_scale: float
    weight: np.ndarray


def compare_sensors(log: FlightLog, delay: float, gyro_delay: float, gravity: float = 9.81) -> Kinematics:
    """Compare the sensors of one log.

    Args:
        log: the flight.
        delay: declared age of pose and velocity, s.
        gyro_delay: declared age of the gyro's reading, s.
        gravity: m/s^2.
    """
    log = with_gyro_in_time(log, gyro_delay)
    step = log.nominal_interval
    grid = np.arange(log.time[0], log.time[-1], step)
    covered = _covered(log, grid)

    def at(values, shift=0.0):
        return interpolate(log.time, values, grid + shift)

    quaternion = tidy(at(tidy(log.quaternion), delay))
    velocity, position = at(log.velocity, delay), at(log.position, delay)
    world = rotate(quaternion, at(log.specific_force)) - [0, 0, gravity]
    gyro = at(log.body_rate)

    long = max(4, round(LONG / step))
    ok_long = _spans(covered, long, 0.1, step)
    gyro_bias = _gyro_bias(quaternion, gyro, long, step, ok_long)
    accelerometer_bias = _accelerometer_bias(quaternion, velocity, world, long, step, ok_long)
    scale, scale_weight = _scale(position, velocity, long, step, ok_long)
    horizontal, horizontal_weight = _scale(position[:, :2], velocity[:, :2], long, step, ok_long)
    vertical, vertical_weight = _scale(position[:, 2:], velocity[:, 2:], long, step, ok_long)

    short = max(4, round(SHORT / step))
    ok = _spans(covered, short, LAGS[-1] + step, step)
    turned = _turned(quaternion, short)
    gyro_sum = _integral(gyro - gyro_bias, step)
    attitude_lag, attitude_weight = _lag(lambda lag: turned - _span(gyro_sum, short, lag, step), ok)
    gyro_scale, gyro_weight = _ratio(_span(gyro_sum, short, attitude_lag, step), turned, ok, short)
    gained = (velocity[short:] - velocity[:-short]) / scale

    def unexplained(lag):
        # Attitude and velocity have the same lag, so only the accelerometer is shifted in time.
        force = at(log.specific_force, -lag) - accelerometer_bias
        return gained - _span(_integral(rotate(quaternion, force) - [0, 0, gravity], step), short, 0.0, step)

    velocity_lag, velocity_weight = _lag(unexplained, ok)
    return Kinematics(
        gyro_bias,
        accelerometer_bias,
        attitude_lag,
        velocity_lag,
        scale,
        horizontal,
        vertical,
        # The attitude is noisier than the gyro, so regress the attitude on the gyro and invert the slope.
        1 / gyro_scale,
        np.array([attitude_weight, velocity_weight, scale_weight, horizontal_weight, vertical_weight, gyro_weight]),
    )


def _covered(log: FlightLog, grid: np.ndarray) -> np.ndarray:
    """Whether each instant lies outside all gaps."""
    gaps = log.gaps()
    edges = np.zeros(len(grid) + 1, dtype=int)
    np.add.at(edges, np.searchsorted(grid, log.time[gaps] - 0.02, side="right"), 1)
    np.add.at(edges, np.searchsorted(grid, log.time[gaps + 1] + 0.02), -1)
    return np.cumsum(edges[:-1]) == 0


def _spans(covered: np.ndarray, rows: int, margin: float, step: float) -> np.ndarray:
    """Mask (n - rows,) of the starts of spans that touch no gap, with ``margin`` seconds on both sides."""
    reach = int(np.ceil(margin / step))
    bad = np.concatenate([[0], np.cumsum(~covered)])
    starts = np.arange(len(covered) - rows)
    low, high = starts - reach, starts + rows + reach
    inside = (low >= 0) & (high < len(covered))
    return inside & (bad[np.clip(high, 0, len(covered) - 1)] - bad[np.clip(low, 0, len(covered) - 1)] == 0)


def _integral(values: np.ndarray, step: float) -> np.ndarray:
    begin = np.zeros((1, values.shape[1]))
    return np.concatenate([begin, np.cumsum(0.5 * (values[1:] + values[:-1]) * step, axis=0)])


def _span(total: np.ndarray, rows: int, lag: float, step: float) -> np.ndarray:
    """Differences of an integral over spans of ``rows`` rows, shifted ``lag`` seconds earlier."""
    index = np.arange(len(total))
    moved = interpolate(index, total, index - lag / step)
    return moved[rows:] - moved[:-rows]


def _turned(quaternion: np.ndarray, rows: int) -> np.ndarray:
    """Rotation vectors over spans of ``rows`` rows, in body axes at the middle.

    To second order they equal the integral of the gyro, without a commutator term.
    """
    p, q = quaternion[:-rows], quaternion[rows:]
    w = np.sum(p * q, axis=1)
    vector = p[:, :1] * q[:, 1:] - q[:, :1] * p[:, 1:] - np.cross(p[:, 1:], q[:, 1:])
    vector = np.where(w[:, None] < 0, -vector, vector)
    size = np.linalg.norm(vector, axis=1)
    angle = 2 * np.arctan2(size, np.abs(w))
    return vector * (angle / np.maximum(size, 1e-12))[:, None]


def _gyro_bias(quaternion, gyro, rows, step, ok) -> np.ndarray:
    # Chain short spans, because rotation vectors do not add up over long ones.
    short = max(2, rows // 8)
    missing = _span(_integral(gyro, step), short, 0.0, step) - _turned(quaternion, short)
    ok = np.append(ok, np.zeros(rows - short, dtype=bool)) if len(ok) < len(missing) else ok[: len(missing)]
    return np.mean(missing[ok], axis=0) / (short * step) if ok.any() else np.zeros(3)


def _accelerometer_bias(quaternion, velocity, world, rows, step, ok) -> np.ndarray:
    missing = _span(_integral(world, step), rows, 0.0, step) - (velocity[rows:] - velocity[:-rows])
    axes = [_integral(rotate(quaternion, np.tile(np.eye(3)[i], (len(quaternion), 1))), step) for i in range(3)]
    columns = np.stack([_span(axis, rows, 0.0, step) for axis in axes], axis=-1)
    if ok.sum() < 3 * rows:
        return np.zeros(3)
    pick = np.flatnonzero(ok)[:: max(1, rows // 8)]
    a, b = columns[pick].reshape(-1, 3), missing[pick].reshape(-1)
    # Plausible biases are below 0.2 m/s^2. Level flight cannot separate the magnitude of gravity from a bias along z.
    return np.linalg.solve(a.T @ a + np.eye(3) * 1e-9, a.T @ b)


def _scale(position, velocity, rows, step, ok) -> tuple[float, float]:
    """Ratio of the velocity to the derivative of the position, and its inverse variance."""
    return _ratio(position[rows:] - position[:-rows], _span(_integral(velocity, step), rows, 0.0, step), ok, rows)


def _ratio(moved, said, ok, rows) -> tuple[float, float]:
    """Slope of ``said`` on ``moved`` over spans of ``rows`` rows, and its inverse variance."""
    pick = np.flatnonzero(ok)[:: max(1, rows // 4)]
    if len(pick) < 8:
        return 1.0, 0.0
    x, y = moved[pick].reshape(-1), said[pick].reshape(-1)
    scale = float(x @ y / (x @ x))
    left = y - scale * x
    return scale, float(x @ x / max(np.mean(left**2), 1e-12)) / 4


def _lag(missing, ok) -> tuple[float, float]:
    """Lag with the smallest mean square of ``missing``, interpolated by a parabola, and its inverse variance."""
    if ok.sum() < 50:
        return 0.0, 0.0
    losses = np.array([np.mean(missing(lag)[ok] ** 2) for lag in LAGS])
    best = int(np.clip(np.argmin(losses), 1, len(LAGS) - 2))
    before, here, after = losses[best - 1 : best + 2]
    curve = before - 2 * here + after
    width = LAGS[1] - LAGS[0]
    lag = LAGS[best] + (0.5 * width * (before - after) / curve if curve > 0 else 0.0)
    samples = ok.sum() / 8
    return float(lag), float(samples * max(curve, 0.0) / width**2 / max(here, 1e-12))


SMALLEST = {
    "sensor_delay": 0.003,
    "sensor_gyro_lowpass": 0.0025,
    "sensor_velocity_scale": 0.01,
    "sensor_gyro_scale": 0.08,
}
"""Faults smaller than this are ignored, because every estimator and filter has some. An estimated attitude rotates up
to 6 % further than a healthy gyro measures; motion capture of the same flights shows that the gyro is right."""
SURE = 5.0
"""Significance that a fault needs, in standard deviations."""
_BIAS_NOISE = 0.008
"""Standard error of an accelerometer bias from one flight, m/s^2. Biases that scatter no more than this are pooled."""


@dataclass(frozen=True)
class Finding:
    """One sensor fault.

    Attributes:
        name: of the fault, as in `SENSOR_FAULTS`.
        value: of its parameter.
        std: standard deviation of the value.
        vertical: vertical scale of the velocity and its standard deviation, if it differs from the horizontal one.
    """

    name: str
    value: float
    std: float
    vertical: tuple[float, float] | None = None

    @property
    def p_value(self) -> float:
        """Two-sided p-value of the hypothesis that there is no fault."""
        pairs = [(self.value, self.std)] + ([self.vertical] if self.vertical else [])
        healthy = SENSOR_FAULTS[self.name].healthy
        return min(float(2 * norm.sf(abs(value - healthy) / std)) for value, std in pairs)

    @property
    def parameters(self) -> dict[str, float]:
        """Values by name, as in a model file."""
        return self._by_name(0)

    @property
    def uncertainty(self) -> dict[str, float]:
        """Standard deviations by the same names."""
        return self._by_name(1)

    def _by_name(self, which: int) -> dict[str, float]:
        found = {SENSOR_FAULTS[self.name].parameter: (self.value, self.std)[which]}
        return found | ({"vertical": self.vertical[which]} if self.vertical else {})


@dataclass(frozen=True)
class SensorCheck:
    """Result of `check_sensors` for a campaign.

    Attributes:
        faults: of the recording chain.
        findings: the faults, one by one, with their uncertainty.
        measured: value and standard deviation of every quantity examined.
        gyro_bias: (3,) rad/s, by log name.
        accelerometer_bias: (3,) m/s^2, by log name.
    """

    faults: SensorFaults
    findings: list[Finding]
    measured: dict[str, tuple[float, float]]
    gyro_bias: dict[str, np.ndarray]
    accelerometer_bias: dict[str, np.ndarray]

    def corrected(self, log: FlightLog) -> FlightLog:
        """A flight of this campaign with faults and biases removed."""
        log = self.faults.repaired(log)
        return log.replace(
            body_rate=log.body_rate - self.gyro_bias.get(log.name, 0.0),
            specific_force=log.specific_force - self.accelerometer_bias.get(log.name, 0.0),
        )


def check_sensors(logs: list[FlightLog], delay: float, gyro_delay: float) -> SensorCheck:
    """Compare the sensors of a campaign's flights with each other, and find their faults and biases.

    Args:
        logs: flights of one drone.
        delay: declared age of pose and velocity, s.
        gyro_delay: declared age of the gyro's reading, s.
    """
    kinematics = [compare_sensors(log, delay, gyro_delay) for log in logs]
    vertical = _own_vertical_scale(kinematics)
    if vertical is not None:
        # First make the scale equal along all axes, so that the other comparisons are valid.
        ratio = vertical[0] / _pooled(kinematics, "horizontal_scale", 3)[0]
        even = SensorFaults(vertical_scale=ratio)
        kinematics = [compare_sensors(even.unstretched(log), delay, gyro_delay) for log in logs]
    pooled = {
        "attitude_lag": _pooled(kinematics, "attitude_lag", 0),
        "velocity_lag": _pooled(kinematics, "velocity_lag", 1),
        "velocity_scale": _pooled(kinematics, "velocity_scale", 2),
        "gyro_scale": _pooled(kinematics, "gyro_scale", 5),
    }
    turn, gain, (scale, scale_std), gyro_scale = pooled.values()
    looked = {
        "sensor_delay": gain,
        "sensor_gyro_lowpass": _gyro_lag(turn, gain),
        "sensor_velocity_scale": (scale, scale_std),
        "sensor_gyro_scale": gyro_scale,
    }
    findings = lags(turn, gain)
    if _away("sensor_velocity_scale", scale, scale_std) or vertical:
        findings.append(Finding("sensor_velocity_scale", scale, scale_std, vertical))
    if _away("sensor_gyro_scale", *gyro_scale):
        findings.append(Finding("sensor_gyro_scale", *gyro_scale))
    faults = SensorFaults(**{ATTRIBUTES[f.name][key]: x for f in findings for key, x in f.parameters.items()})
    if not faults.healthy:
        # Estimate the biases again, from the repaired flights.
        kinematics = [compare_sensors(faults.repaired(log), delay, gyro_delay) for log in logs]
    names = [log.name for log in logs]
    return SensorCheck(
        faults,
        findings,
        looked,
        dict(zip(names, [k.gyro_bias for k in kinematics], strict=True)),
        dict(zip(names, _shrunk(np.array([k.accelerometer_bias for k in kinematics])), strict=True)),
    )


def lags(turn: tuple[float, float], gain: tuple[float, float]) -> list[Finding]:
    """Attribute the measured lags to the pose, the gyro, or both; a gyro's own lag cannot be negative.

    Args:
        turn: lag of the attitude behind the gyro (the pose's lag minus the gyro's) and its standard deviation, s.
        gain: lag of the velocity behind the accelerometer (the pose's lag) and its standard deviation, s. It is far
            less accurate than ``turn``, because of shocks too short for the accelerometer.
    """
    gyro = _gyro_lag(turn, gain)
    late, slow = _away("sensor_delay", *gain), _away("sensor_gyro_lowpass", *gyro) and gyro[0] > 0
    if late and slow:
        return [Finding("sensor_delay", *gain), Finding("sensor_gyro_lowpass", *gyro)]
    if not (late or _away("sensor_delay", *turn)):
        return [Finding("sensor_gyro_lowpass", *gyro)] if slow else []
    if not late and turn[0] < 0 and abs(gain[0]) < abs(gyro[0]):
        # Either the gyro lags or the pose is younger than declared; the velocity is closer to the former.
        return [Finding("sensor_gyro_lowpass", -turn[0], turn[1])]
    # With a healthy gyro both comparisons measure the same delay; combine them by inverse variance.
    weight = np.array([1 / turn[1] ** 2, 1 / gain[1] ** 2])
    value = float(weight @ [turn[0], gain[0]] / weight.sum())
    return [Finding("sensor_delay", value, float(weight.sum() ** -0.5))]


def _gyro_lag(turn: tuple[float, float], gain: tuple[float, float]) -> tuple[float, float]:
    """Lag of the gyro and its standard deviation, s: the pose's lag minus that of the attitude behind the gyro."""
    return gain[0] - turn[0], float(np.hypot(turn[1], gain[1]))


def _away(name: str, value: float, std: float, healthy: float | None = None) -> bool:
    """Whether a fault is large enough to be removed, and significant."""
    away = abs(value - (SENSOR_FAULTS[name].healthy if healthy is None else healthy))
    return away > SMALLEST[name] and away > SURE * std


def _own_vertical_scale(kinematics: list[Kinematics]) -> tuple[float, float] | None:
    """Vertical scale of the velocity and its standard deviation if it differs from the horizontal one, else None."""
    (across, across_std), (up, up_std) = (
        _pooled(kinematics, "horizontal_scale", 3),
        _pooled(kinematics, "vertical_scale", 4),
    )
    if not _away("sensor_velocity_scale", up, float(np.hypot(up_std, across_std)), across):
        return None
    return up, up_std


def _pooled(kinematics: list[Kinematics], name: str, index: int) -> tuple[float, float]:
    """Weighted mean over the flights, with a standard deviation that also covers their scatter."""
    values = np.array([getattr(k, name) for k in kinematics])
    weights = np.array([k.weight[index] for k in kinematics])
    total = weights.sum()
    if total <= 0:
        return (1.0 if name.endswith("_scale") else 0.0), np.inf
    mean = float(weights @ values / total)
    used = weights > 0.01 * weights.max()
    chi = float(np.sum(weights[used] * (values[used] - mean) ** 2) / max(used.sum() - 1, 1))
    return mean, float(np.sqrt(max(chi, 1.0) / total))


def _shrunk(biases: np.ndarray) -> np.ndarray:
    """Shrink the flights' biases to their median, as far as their scatter is explained by the estimation error."""
    common = np.median(biases, axis=0)
    scatter = np.var(biases, axis=0)
    share = np.maximum(0.0, 1 - _BIAS_NOISE**2 / np.maximum(scatter, 1e-12))
    return common + share * (biases - common)
