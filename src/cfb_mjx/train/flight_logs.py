"""Write simulated flights as flight logs, for `cfb evaluate`, `cfb fit` and `cfb view`."""

from __future__ import annotations

import numpy as np

from cfb_mjx.errors import CfbError
from cfb_mjx.logs import FlightLog
from cfb_mjx.logs.rotation import to_body
from cfb_mjx.train.flying import Flight, steps_flown


def flight_log(flown: Flight, dt: float, name: str, gravity: float = 9.81, drone: int = 0) -> FlightLog:
    """Convert one flight to a log: true states, without delay or sensor noise, one row per command.

    The specific force is the mean over the control step before a row, as from a filtered accelerometer, in the body
    axes at the middle of that step: in a flip the body turns by a tenth of a radian from there to the end of the step.

    Args:
        flown: flights, axes (drones, steps).
        dt: time between two commands, s.
        name: name of the log.
        gravity: gravitational acceleration, m/s^2.
        drone: index of the drone.

    Raises:
        CfbError: the drone failed so early that its flight has no rows.
    """
    flight = {key: np.asarray(getattr(flown, key), float)[drone] for key in _FIELDS}
    # A row holds the command after it.
    rows = steps_flown(flown, drone) - 1
    if rows < 2:
        raise CfbError(f"{name}: the drone failed at once; there is no flight to log.")
    velocity, quaternion = flight["velocity"], flight["quaternion"][:rows]
    change = np.diff(velocity[:rows], axis=0, prepend=velocity[:1]) / dt
    change[0] = change[1]
    # Same sign as the row before: a quaternion and its negative are the same attitude.
    along = quaternion * np.sign(np.sum(quaternion * np.roll(quaternion, 1, axis=0), axis=1, keepdims=True))
    middle = along + np.roll(quaternion, 1, axis=0)
    middle[0] = quaternion[0]
    middle /= np.linalg.norm(middle, axis=1, keepdims=True)
    return FlightLog(
        time=dt * np.arange(1, rows + 1),
        position=flight["position"][:rows],
        velocity=velocity[:rows],
        quaternion=quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True),
        body_rate=flight["body_rate"][:rows],
        specific_force=to_body(middle, change + np.array([0.0, 0.0, gravity])),
        command=np.clip(flight["command"][1 : rows + 1], 0.0, 1.0),
        rotor_speed=flight["rotor_speed"][:rows],
        metadata={"name": name, "source": "simulated by cfb fly", "format": "simulated", "observation_delay": 0.0},
    )


_FIELDS = ("position", "velocity", "quaternion", "body_rate", "command", "rotor_speed")
