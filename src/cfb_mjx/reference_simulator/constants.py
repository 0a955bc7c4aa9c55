"""Nominal constants of the drone and of the clock of the simulation, independent of the library (SI units)."""

from __future__ import annotations

import numpy as np

GRAVITY = 9.81
MASS = 0.044
INERTIA = (3.3e-5, 3.6e-5, 5.9e-5)
MOTOR_LAG = 0.05
MOTOR_GAIN = 2900.0
ROTOR_INERTIA = 0.5e-7
SPEED_SCALE = 2900.0  # rad/s; the rotor curves are polynomials of Omega / SPEED_SCALE
HALF = 0.0707 / 2
BLADE_RADIUS = 0.0275
AIR_DENSITY = 1.2

# Front-right, back-right, back-left, front-left; shape (4, 1) broadcasts over lanes.
ROTOR_X = HALF * np.array([[1.0], [-1.0], [-1.0], [1.0]])
ROTOR_Y = HALF * np.array([[-1.0], [-1.0], [1.0], [1.0]])
YAW = np.array([[-1.0], [1.0], [-1.0], [1.0]])

TICK = 0.002  # s between commands
SUBSTEPS = 2  # RK4 steps per tick
ROW_TICKS = 2  # a row of the log every 4 ms: every second command is not logged
POSE_TICKS = 4  # pose and velocity are 8 ms late
SETPOINT_TICKS = 5  # set-points change at 100 Hz
WARM_UP_TICKS = 1000  # before the log starts, so that the controller is in trim


def thrust_curve(speed: np.ndarray) -> np.ndarray:
    """Thrust of a rotor, N, at ``speed`` rad/s."""
    s = speed / SPEED_SCALE
    return np.maximum(s * (-0.043 + s * (0.562 - 0.23 * s)), 0.0)


def torque_curve(speed: np.ndarray) -> np.ndarray:
    """Magnitude of a rotor's drag torque, N m, at ``speed`` rad/s."""
    s = speed / SPEED_SCALE
    return s * (2.9e-4 + s * (8.7e-4 - 3.4e-4 * s))


_GRID = np.linspace(0.15, 1.0, 8501) * SPEED_SCALE
HOVER_SPEED = float(np.interp(MASS * GRAVITY / 4, thrust_curve(_GRID), _GRID))
HOVER_THRUST = MASS * GRAVITY / 4
