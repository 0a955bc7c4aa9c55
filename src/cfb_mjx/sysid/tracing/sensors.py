"""Which sensors are at fault, by comparing them with each other (`kinematics`), pooled over flights."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import norm

from cfb_mjx.logs import FlightLog
from cfb_mjx.model.effects import SENSOR_FAULTS
from cfb_mjx.sysid.sensor_faults import ATTRIBUTES, SensorFaults
from cfb_mjx.sysid.tracing.kinematics import Kinematics, compare_sensors

SMALLEST = {"sensor_delay": 0.003, "sensor_gyro_lowpass": 0.0025, "sensor_velocity_scale": 0.01}
"""Faults below this are left alone: every estimator and filter has some."""
SURE = 5.0
"""Standard deviations a fault must be away from nothing."""
_BIAS_NOISE = 0.008
"""Of an accelerometer bias found from one flight, m/s^2: biases that scatter no more are taken as one."""


@dataclass(frozen=True)
class Finding:
    """One sensor fault: its number, and of a velocity column stretched differently along the vertical that one's."""

    name: str
    value: float
    std: float
    vertical: tuple[float, float] | None = None

    @property
    def p_value(self) -> float:
        """Two-sided, of no fault."""
        pairs = [(self.value, self.std)] + ([self.vertical] if self.vertical else [])
        healthy = SENSOR_FAULTS[self.name].healthy
        return min(float(2 * norm.sf(abs(value - healthy) / std)) for value, std in pairs)

    @property
    def parameters(self) -> dict[str, float]:
        """As in a model file."""
        return self._by_name(0)

    @property
    def uncertainty(self) -> dict[str, float]:
        """Standard deviations, by the same names."""
        return self._by_name(1)

    def _by_name(self, which: int) -> dict[str, float]:
        found = {SENSOR_FAULTS[self.name].parameter: (self.value, self.std)[which]}
        return found | ({"vertical": self.vertical[which]} if self.vertical else {})


@dataclass(frozen=True)
class SensorCheck:
    """What a campaign says about its sensors."""

    faults: SensorFaults
    findings: list[Finding]
    measured: dict[str, tuple[float, float]]
    """Every quantity looked at: value and standard deviation."""
    gyro_bias: dict[str, np.ndarray]
    accelerometer_bias: dict[str, np.ndarray]
    """Per log name, rad/s and m/s^2."""

    def corrected(self, log: FlightLog) -> FlightLog:
        """A flight of this campaign with faults and biases taken out."""
        log = self.faults.repaired(log)
        return log.replace(
            body_rate=log.body_rate - self.gyro_bias.get(log.name, 0.0),
            specific_force=log.specific_force - self.accelerometer_bias.get(log.name, 0.0),
        )


def check_sensors(logs: list[FlightLog], delay: float, gyro_delay: float) -> SensorCheck:
    """Compare the sensors of a campaign's flights with each other.

    Args:
        logs: flights of one drone.
        delay: declared age of pose and velocity, s.
        gyro_delay: declared age of the gyro's reading, s.
    """
    kinematics = [compare_sensors(log, delay, gyro_delay) for log in logs]
    vertical = _own_vertical_scale(kinematics)
    if vertical is not None:
        # Stretched alike along all axes first, so that all else is compared as in any other flight.
        ratio = vertical[0] / _pooled(kinematics, "horizontal_scale", 3)[0]
        even = SensorFaults(vertical_scale=ratio)
        kinematics = [compare_sensors(even.unstretched(log), delay, gyro_delay) for log in logs]
    pooled = {
        "attitude_lag": _pooled(kinematics, "attitude_lag", 0),
        "velocity_lag": _pooled(kinematics, "velocity_lag", 1),
        "velocity_scale": _pooled(kinematics, "velocity_scale", 2),
    }
    turn, gain, (scale, scale_std) = pooled.values()
    looked = {
        "sensor_delay": gain,
        "sensor_gyro_lowpass": _gyro_lag(turn, gain),
        "sensor_velocity_scale": (scale, scale_std),
    }
    findings = lags(turn, gain)
    if _away("sensor_velocity_scale", scale, scale_std) or vertical:
        findings.append(Finding("sensor_velocity_scale", scale, scale_std, vertical))
    faults = SensorFaults(**{ATTRIBUTES[f.name][key]: x for f in findings for key, x in f.parameters.items()})
    if not faults.healthy:
        # Biases again, from repaired flights.
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
    """Lags of the pose, beyond the declared one, and of the gyro, which cannot be ahead of what it measures.

    Args:
        turn: by how much the attitude is behind the gyro, s, and its deviation: the pose's lag less the gyro's.
        gain: by how much the velocity is behind the accelerometer: the pose's lag. Knocks too short for the
            accelerometer make it far less exact than ``turn``.
    """
    gyro = _gyro_lag(turn, gain)
    late, slow = _away("sensor_delay", *gain), _away("sensor_gyro_lowpass", *gyro) and gyro[0] > 0
    if late and slow:
        return [Finding("sensor_delay", *gain), Finding("sensor_gyro_lowpass", *gyro)]
    if not (late or _away("sensor_delay", *turn)):
        return [Finding("sensor_gyro_lowpass", *gyro)] if slow else []
    if not late and turn[0] < 0 and abs(gain[0]) < abs(gyro[0]):
        # Of the two, a slow gyro and a pose younger than declared, the velocity is nearer to the first.
        return [Finding("sensor_gyro_lowpass", -turn[0], turn[1])]
    # With a healthy gyro both comparisons show the same delay; the turn tells it more exactly.
    weight = np.array([1 / turn[1] ** 2, 1 / gain[1] ** 2])
    value = float(weight @ [turn[0], gain[0]] / weight.sum())
    return [Finding("sensor_delay", value, float(weight.sum() ** -0.5))]


def _gyro_lag(turn: tuple[float, float], gain: tuple[float, float]) -> tuple[float, float]:
    """The accelerometer has its own clockwork beside the pose's; the gyro's lag is what is left between the two."""
    return gain[0] - turn[0], float(np.hypot(turn[1], gain[1]))


def _away(name: str, value: float, std: float, healthy: float | None = None) -> bool:
    """Whether a fault is worth taking out, and surely one."""
    away = abs(value - (SENSOR_FAULTS[name].healthy if healthy is None else healthy))
    return away > SMALLEST[name] and away > SURE * std


def _own_vertical_scale(kinematics: list[Kinematics]) -> tuple[float, float] | None:
    """Vertical velocity over slope of height, where that is surely another than horizontally."""
    (across, across_std), (up, up_std) = (
        _pooled(kinematics, "horizontal_scale", 3),
        _pooled(kinematics, "vertical_scale", 4),
    )
    if not _away("sensor_velocity_scale", up, float(np.hypot(up_std, across_std)), across):
        return None
    return up, up_std


def _pooled(kinematics: list[Kinematics], name: str, index: int) -> tuple[float, float]:
    """Weighted mean over the flights, with a deviation that covers their scatter too."""
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
    """Biases of the flights drawn to their common value as far as their scatter is that of the method."""
    common = np.median(biases, axis=0)
    scatter = np.var(biases, axis=0)
    share = np.maximum(0.0, 1 - _BIAS_NOISE**2 / np.maximum(scatter, 1e-12))
    return common + share * (biases - common)
