"""Conditions of a simulated real flight: noise of the sensors, and unknown disturbances."""

from __future__ import annotations

from dataclasses import dataclass, replace


@dataclass(frozen=True)
class Conditions:
    """Sensor noise and disturbances of a flight.

    Sensor noise is white, with the given standard deviation per row. Each disturbance is an Ornstein-Uhlenbeck process
    per axis, with the given rms.

    Attributes:
        gyro: noise, rad/s.
        accelerometer: noise, m/s^2.
        rotor: noise of the measured rotor speed, rad/s.
        measured_rotors: whether rotor speed is logged.
        row: time between rows of the log, s. At 2 ms the log contains every command of the stabiliser. At 4 ms every
            other command is missing; as the commands respond to the gyro's noise, this biases a fit
            (``docs/identification.md``).
        position: noise of the estimator, m.
        velocity: noise of the estimator, m/s.
        attitude: noise of the estimator, rad.
        disturbance: unmodelled torque over inertia, rad/s^2.
        force_disturbance: unmodelled force over mass along body z, m/s^2.
        rotor_disturbance: error of the steady rotor speed (battery, load), rad/s.
        correlation_time: of all disturbances, s.
    """

    gyro: float = 0.02
    accelerometer: float = 0.1
    rotor: float = 3.0
    measured_rotors: bool = False
    row: float = 0.002
    position: float = 0.5e-3
    velocity: float = 0.01
    attitude: float = 1e-3
    disturbance: float = 4.0
    force_disturbance: float = 0.5
    rotor_disturbance: float = 10.0
    correlation_time: float = 0.3

    @property
    def calm(self) -> Conditions:
        """The same conditions without noise and disturbances."""
        levels = [name for name in vars(self) if name not in ("measured_rotors", "row", "correlation_time")]
        return replace(self, **dict.fromkeys(levels, 0.0))
