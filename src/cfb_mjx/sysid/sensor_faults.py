"""Sensor faults of a recording: lags, scales and time shifts of columns, which are removed before a model is judged."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from cfb_mjx.errors import CfbError
from cfb_mjx.logs import FlightLog
from cfb_mjx.logs.resample import interpolate
from cfb_mjx.logs.rotation import tidy
from cfb_mjx.model import State
from cfb_mjx.model.effects import SENSOR_FAULTS
from cfb_mjx.parameters import Limits
from cfb_mjx.sysid.velocity_stretch import VelocityStretch
from cfb_mjx.sysid.windows import Windows

ATTRIBUTES = {
    "sensor_delay": {"delay": "delay"},
    "sensor_velocity_scale": {
        "scale": "velocity_scale",
        "vertical": "vertical_scale",
        "rise": "velocity_rise",
        "fade": "velocity_fade",
        "with_attitude": "with_attitude",
    },
    "sensor_gyro_lowpass": {"lag": "gyro_lag"},
    "sensor_gyro_scale": {"scale": "gyro_scale"},
    "sensor_time_shift": {"shift": "motor_shift"},
}
"""Attributes of `SensorFaults` that hold the parameters of each fault of `SENSOR_FAULTS`."""
LIMITS = {
    "delay": Limits(-0.5, 1.0, -0.05, 0.1),
    "velocity_scale": Limits(0.1, 10.0, 0.5, 2.0),
    "vertical_scale": Limits(0.1, 10.0, 0.5, 2.0),
    "velocity_rise": Limits(0.0, 1e3, 0.0, 30.0),
    "velocity_fade": Limits(1e-3, 1e6, 0.01, 1e3),
    "with_attitude": Limits(1.0, 1.0, 1.0, 1.0),
    "gyro_lag": Limits(-0.1, 1.0, -0.01, 0.05),
    "gyro_scale": Limits(0.1, 10.0, 0.5, 2.0),
    "motor_shift": Limits(-1.0, 1.0, -0.06, 0.06),
}
"""Limits of each attribute."""
FORMS = ("rise", "fade", "with_attitude")
"""Parameters that have no meaning without another parameter of the same fault."""
STRETCH_STEP = 0.05
"""Time step at which a stretched velocity is integrated in a window, s: far below the time constants of a stretch."""


@dataclass(frozen=True)
class SensorFaults:
    """Faults of a recording chain; the default values are healthy.

    Attributes:
        delay: age of pose and velocity beyond the declared observation delay, s.
        velocity_scale: logged over true horizontal velocity; also vertical, unless ``vertical_scale`` is given.
        vertical_scale: logged over true vertical velocity, for estimators (optical flow, for instance) that stretch
            only one of the two.
        velocity_rise: time constant with which the scale appears in the velocity column, s (`VelocityStretch`); None:
            immediately.
        velocity_fade: time constant with which it fades again, s; None: never.
        with_attitude: 1 if the attitude leans consistently with the velocity, as with an estimator that corrects both
            by the same flow. The drone's motion is then taken as logged, and only the position moves less than the
            velocity. None: the attitude is right and only the velocity is wrong.
        gyro_lag: lag of the gyro column, s.
        gyro_scale: logged over true body rate.
        motor_shift: delay of the command and rotor-speed columns relative to all others, s (negative: early).
    """

    delay: float = 0.0
    velocity_scale: float = 1.0
    vertical_scale: float | None = None
    velocity_rise: float | None = None
    velocity_fade: float | None = None
    with_attitude: float | None = None
    gyro_lag: float = 0.0
    gyro_scale: float = 1.0
    motor_shift: float = 0.0

    @property
    def healthy(self) -> bool:
        """Whether there are no faults."""
        return self == SensorFaults()

    @property
    def stretch(self) -> VelocityStretch:
        """Stretch of the velocity column along the world axes."""
        vertical = self.velocity_scale if self.vertical_scale is None else self.vertical_scale
        scale = np.array([self.velocity_scale, self.velocity_scale, vertical])
        return VelocityStretch(scale, self.velocity_rise or 0.0, self.velocity_fade)

    @property
    def as_logged(self) -> SensorFaults:
        """Faults that remain if columns are used as logged: a stretch of the velocity, with a consistent attitude."""
        if self.stretch.none:
            return SensorFaults()
        return replace(self, delay=0.0, gyro_lag=0.0, gyro_scale=1.0, motor_shift=0.0, with_attitude=1.0)

    def unstretched(self, log: FlightLog) -> FlightLog:
        """Make velocity and position of a log consistent, using no later rows.

        The stretch is removed from the velocity or, if the attitude leans consistently with it, applied to the
        position.
        """
        stretch = self.stretch
        if stretch.none:
            return log
        if self.with_attitude is None:
            return log.replace(velocity=stretch.undone(log.time, log.velocity))
        return log.replace(position=stretch.followed(log.position, stretch.memory(log.time, log.velocity)))

    def stretched(
        self, began: tuple[np.ndarray, np.ndarray], step: np.ndarray, position: np.ndarray, velocity: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Inverse of `unstretched` for predictions.

        Args:
            began: velocities and estimator memories at the windows' starts, from `began`.
            step: (H,) time steps, s.
            position: (W, H, 3) m.
            velocity: (W, H, 3) m/s.

        Returns:
            Positions and velocities as this chain records them.
        """
        first, memory = began
        velocity = np.concatenate([first[:, None], velocity], axis=1)
        if self.with_attitude is None:
            return position, self.stretch.done(memory, step, velocity)[:, 1:]
        carried = self.stretch.carried(memory, step, velocity)[:, 1:]
        return self.stretch.left(position, carried), velocity[:, 1:]

    def repaired(self, log: FlightLog) -> FlightLog:
        """The log that a healthy chain would have recorded.

        Rows whose replacements lie in a gap or beyond the ends of the log are removed.
        """
        if self.healthy:
            return log
        log = self.unstretched(log)
        time = log.time
        gaps = log.gaps()
        changes = {}

        def later(values, by):
            return interpolate(time, values, time + by)

        if self.delay:
            changes["position"] = later(log.position, self.delay)
            changes["quaternion"] = tidy(later(tidy(log.quaternion), self.delay))
            changes["velocity"] = later(log.velocity, self.delay)
        if self.gyro_lag:
            changes["body_rate"] = later(log.body_rate, self.gyro_lag)
        if self.gyro_scale != 1.0:
            changes["body_rate"] = changes.get("body_rate", log.body_rate) / self.gyro_scale
        if self.motor_shift:
            # A command between rows is the mean of both, weighted by the share of the interval each would be held.
            changes["command"] = later(log.command, self.motor_shift)
            if log.rotor_speed is not None:
                changes["rotor_speed"] = later(log.rotor_speed, self.motor_shift)
        low, high = min(0.0, self.motor_shift), max(self.delay, self.gyro_lag, self.motor_shift)
        begin, end = time[gaps], time[gaps + 1]
        crossing = (time[:, None] + high > begin) & (time[:, None] <= begin)
        crossing |= (time[:, None] + low < end) & (time[:, None] >= end)
        keep = (time + high <= time[-1]) & (time + low >= time[0]) & ~crossing.any(axis=1)
        return log.replace(**changes).rows(keep)

    def reached(self, horizons: tuple[float, ...]) -> tuple[float, ...]:
        """Ascending times after a window's start at which predictions are needed for `as_recorded`, s."""
        between = () if self.stretch.constant else np.arange(STRETCH_STEP, max(horizons), STRETCH_STEP)
        lags = (0.0, self.delay, self.gyro_lag)
        return tuple(sorted({self._instant(h, lag) for h in (*horizons, *between) for lag in lags}))

    def began(self, log: FlightLog, windows: Windows, delay: float) -> tuple[np.ndarray, np.ndarray]:
        """Velocities (W, 3) and estimator memories (W, 2, 3) at the windows' starts, for `as_recorded`.

        Args:
            log: as recorded.
            windows: of the repaired log.
            delay: declared age of pose and velocity, s.
        """
        carried = self.stretch.memory(log.time, log.velocity).reshape(len(log), 6)
        memory = interpolate(log.time, carried, windows.start + delay + self.delay)
        return windows.velocity, memory.reshape(len(windows), 2, 3)

    def as_recorded(self, predicted: State, horizons: tuple[float, ...], began: tuple[np.ndarray, np.ndarray]) -> State:
        """Apply the faults to predictions: the states (W, H, ...) that this chain records at the horizons.

        Args:
            predicted: states at the times of `reached`.
            horizons: prediction horizons, s.
            began: velocities and estimator memories at the windows' starts, from `began`.
        """
        if self.healthy:
            return predicted
        times = self.reached(horizons)
        pose = [times.index(self._instant(h, self.delay)) for h in horizons]
        gyro = [times.index(self._instant(h, self.gyro_lag)) for h in horizons]
        step = np.diff(times, prepend=0.0)
        position, velocity = self.stretched(began, step, np.asarray(predicted.position), np.asarray(predicted.velocity))
        return State(
            position[:, pose],
            velocity[:, pose],
            predicted.quaternion[:, pose],
            predicted.body_rate[:, gyro] * self.gyro_scale,
            predicted.rotor_speed[:, gyro],
        )

    @staticmethod
    def _instant(horizon: float, lag: float) -> float:
        return round(max(horizon - lag, 0.001), 9)

    def to_mappings(self) -> list[dict]:
        """The faults as listed among the effects of a model file."""
        found = []
        for name, fault in SENSOR_FAULTS.items():
            values = {key: getattr(self, attribute) for key, attribute in ATTRIBUTES[name].items()}
            values = {key: value for key, value in values.items() if value is not None}
            if any(value != fault.healthy for key, value in values.items() if key not in FORMS):
                found.append({"name": name, "parameters": values})
        return found

    @classmethod
    def from_mappings(cls, items: Iterable[Mapping], where: str) -> SensorFaults:
        """Read the faults among the effects of a model file.

        Args:
            items: effects of the file.
            where: name of the file, for messages.

        Raises:
            CfbError: a fault lacks its parameter, has an unknown one, or a value is impossible.

        Warns:
            CfbWarning: a value is unusual.
        """
        found = {}
        for item in items:
            name = item.get("name")
            if name not in SENSOR_FAULTS:
                continue
            values = item.get("parameters")
            values = values if isinstance(values, Mapping) else {}
            known = ATTRIBUTES[name]
            for key in dict.fromkeys([SENSOR_FAULTS[name].parameter, *values]):
                value = values.get(key)
                if (
                    key not in known
                    or not isinstance(value, int | float)
                    or isinstance(value, bool)
                    or not math.isfinite(value)
                ):
                    raise CfbError(
                        f"{where}: effects.{name}.parameters.{key} = {value!r} is not valid; {name} has"
                        f" {' and '.join(known)}, each of which must be a finite number."
                    )
                unit = "1" if "scale" in known[key] or key == "with_attitude" else "s"
                LIMITS[known[key]].check(value, f"{where}: effects.{name}.parameters.{key}", unit, warn=True)
                found[known[key]] = float(value)
        return cls(**found)


HEALTHY = SensorFaults()
