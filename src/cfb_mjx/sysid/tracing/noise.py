"""White noise of the sensors, from the logs alone."""

from __future__ import annotations

import numpy as np

from cfb_mjx.logs import FlightLog
from cfb_mjx.sysid.identification.flight_data import white_noise


def sensor_noise(logs: list[FlightLog], least_gyro: float = 1e-3) -> dict[str, np.ndarray]:
    """White noise of gyro (3), velocity, accelerometer and rotor speed rows, medians over the logs.

    ``least_gyro`` is the lowest level believed of a gyro, rad/s: behind a low-pass its rows look better than they are.
    """

    def level(pick):
        found = [np.atleast_1d(white_noise(pick(log))) for log in logs if pick(log) is not None]
        return np.median(found, axis=0) if found else None

    speed = level(lambda log: log.rotor_speed)
    return {
        "gyro": np.maximum(level(lambda log: log.body_rate), least_gyro),
        "velocity": np.maximum(np.mean(level(lambda log: log.velocity)), 1e-3),
        "accelerometer": np.maximum(np.mean(level(lambda log: log.specific_force)), 1e-2),
        "rotor": np.array(10.0) if speed is None else np.maximum(np.nanmean(speed), 1.0),
    }
