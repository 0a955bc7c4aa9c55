"""What a real flight adds to the model: noise of the sensors, and what pushes the drone unknown to anyone."""

from __future__ import annotations

from dataclasses import dataclass, replace


@dataclass(frozen=True)
class Conditions:
    """What a real flight adds to the model. Standard deviations of white noise per row, and rms of what wanders.

    What wanders is an Ornstein-Uhlenbeck process, one per axis.

    Attributes:
        gyro: rad/s.
        accelerometer: m/s^2.
        rotor: of the measured rotor speed, rad/s.
        measured_rotors: whether rotor speed is logged.
        row: time between rows of the log, s. At 2 ms every command of the stabiliser is in the log; at 4 ms every
            other one is not, and because it answers the gyro's noise, a fit then takes for the drone's what is the
            log's (``docs/identification.md``).
        position: of the estimator, m.
        velocity: of the estimator, m/s.
        attitude: of the estimator, rad.
        disturbance: unmodelled torque over inertia, rad/s^2.
        force_disturbance: unmodelled force over mass along body z, m/s^2.
        rotor_disturbance: error of the steady rotor speed (battery, load), rad/s.
        correlation_time: of all that wanders, s.
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
        """The same sensors without noise or disturbance."""
        levels = [name for name in vars(self) if name not in ("measured_rotors", "row", "correlation_time")]
        return replace(self, **dict.fromkeys(levels, 0.0))
