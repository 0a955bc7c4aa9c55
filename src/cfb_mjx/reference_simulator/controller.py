"""The simulator's cascaded controller: position, velocity, attitude, rate, mixing. Arrays are (k, F), SI units.

Any other controller with the same interface can take its place.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np

from cfb_mjx.reference_simulator import constants as c
from cfb_mjx.reference_simulator.airframe import P, Q, V, rotation_of, turn_back

# Columns of a set-point.
POSITION, VELOCITY, ACCELERATION = slice(0, 3), slice(3, 6), slice(6, 9)
YAW_ANGLE, YAW_RATE, RATES, DITHER = 9, 10, slice(11, 13), slice(13, 17)
SETPOINT_COLUMNS = 17


def column(*values: float) -> np.ndarray:
    return np.array(values)[:, None]


POSITION_GAIN = column(1.8, 1.8, 2.5)
VELOCITY_GAIN = column(3.2, 3.2, 5.0)
VELOCITY_INTEGRAL = column(1.2, 1.2, 2.0)
VELOCITY_STORE = column(3.0, 3.0, 5.0)  # m/s^2
ATTITUDE_GAIN, YAW_GAIN = 6.5, 3.0
RATE_GAIN, RATE_INTEGRAL, RATE_STORE = column(18.0, 18.0, 9.0), column(48.0, 48.0, 15.0), column(60.0, 60.0, 25.0)
RATE_DAMPING = column(0.5, 0.5, 0.0)
TILT_LIMIT = np.tan(np.radians(42.0))
YAW_AUTHORITY = 70.0  # rad/s^2 per unit of command, about hover
INERTIA = column(*c.INERTIA)
GYRO_KEEP = np.exp(-2 * np.pi * 80.0 * c.TICK)
SLOPE_KEEP = np.exp(-2 * np.pi * 25.0 * c.TICK)

# Inverse of the thrust curve in the operating range, as a cubic in the root of the thrust.
_S = np.linspace(0.2, 1.0, 200)
_ROOT = np.sqrt(c.thrust_curve(_S * c.SPEED_SCALE))
INVERSE = np.polyfit(_ROOT, _S, 3)


class Controller:
    """Controllers of F drones, with their state."""

    def __init__(self, lanes: int):
        self.velocity_store = np.zeros((3, lanes))
        self.rate_store = np.zeros((3, lanes))
        self.rate = np.zeros((3, lanes))
        self.slope = np.zeros((3, lanes))

    def __call__(self, goal: np.ndarray, seen: SimpleNamespace, gyro: np.ndarray) -> np.ndarray:
        """Return commands (4, F) for set-points (17, F), delayed estimates ``seen`` and gyro (3, F)."""
        acceleration = self._position_loop(goal, seen)
        rotation = rotation_of(seen.quaternion)
        collective, wanted = self._attitude_loop(goal, acceleration, rotation)
        return self._rate_loop(goal, collective, wanted, gyro)

    def _position_loop(self, goal, seen):
        wanted = goal[VELOCITY] + np.clip(POSITION_GAIN * (goal[POSITION] - seen.position), -2.0, 2.0)
        error = wanted - seen.velocity
        self.velocity_store += c.TICK * VELOCITY_INTEGRAL * np.clip(error, -0.5, 0.5)
        np.clip(self.velocity_store, -VELOCITY_STORE, VELOCITY_STORE, out=self.velocity_store)
        return goal[ACCELERATION] + VELOCITY_GAIN * error + self.velocity_store

    def _attitude_loop(self, goal, acceleration, rotation):
        up = np.clip(acceleration[2] + c.GRAVITY, 3.0, 18.0)
        side = np.sqrt(acceleration[0] ** 2 + acceleration[1] ** 2)
        shrink = np.minimum(1.0, TILT_LIMIT * up / (side + 1e-9))
        thrust = np.stack([acceleration[0] * shrink, acceleration[1] * shrink, up])
        local = turn_back(rotation, thrust)
        size = np.sqrt((local**2).sum(0))
        heading = np.arctan2(rotation[1, 0], rotation[0, 0])
        off = goal[YAW_ANGLE] - heading
        off = np.arctan2(np.sin(off), np.cos(off))
        wanted = np.empty_like(thrust)
        wanted[0] = np.clip(-ATTITUDE_GAIN * local[1] / size + goal[RATES][0], -8.0, 8.0)
        wanted[1] = np.clip(ATTITUDE_GAIN * local[0] / size + goal[RATES][1], -8.0, 8.0)
        wanted[2] = np.clip(YAW_GAIN * off + goal[YAW_RATE], -4.5, 4.5)
        return np.maximum(local[2], 2.5), wanted

    def _rate_loop(self, goal, collective, wanted, gyro):
        previous = self.rate
        self.rate = GYRO_KEEP * previous + (1 - GYRO_KEEP) * gyro
        self.slope = SLOPE_KEEP * self.slope + (1 - SLOPE_KEEP) / c.TICK * (self.rate - previous)
        error = wanted - self.rate
        self.rate_store += c.TICK * RATE_INTEGRAL * error
        np.clip(self.rate_store, -RATE_STORE, RATE_STORE, out=self.rate_store)
        turn = RATE_GAIN * error + self.rate_store - RATE_DAMPING * self.slope
        torque = INERTIA * np.clip(turn, -150.0, 150.0)
        share = 0.25 * c.MASS * collective + 0.25 * (torque[0] / c.ROTOR_Y - torque[1] / c.ROTOR_X)
        root = np.sqrt(np.clip(share, 0.003, 0.28))
        command = INVERSE[3] + root * (INVERSE[2] + root * (INVERSE[1] + root * INVERSE[0]))
        command = command + c.YAW * np.clip(turn[2] / YAW_AUTHORITY, -0.15, 0.15) + goal[DITHER]
        return np.rint(np.clip(command, 0.05, 1.0) * 65535) / 65535


@dataclass(frozen=True)
class Seen:
    """Delayed, noisy estimates relative to a moving and turning set-point; at the set-point they are those of hover."""

    position: np.ndarray
    """Position minus the set-point's, (3, F), in axes rotated by its heading, m."""
    velocity: np.ndarray
    """Velocity minus the set-point's, (3, F), in the same axes, m/s."""
    quaternion: np.ndarray
    """Rotation from body to these axes, (4, F), [w, x, y, z]."""
    body_rate: np.ndarray
    """Body rate minus the set-point's yaw rate, (3, F), rad/s."""


@dataclass(frozen=True)
class OtherController:
    """A controller of F drones.

    Attributes:
        every: ticks between commands; commands are held in between.
        fly: function from memory (None at first) and `Seen` to new memory and commands (4, F) in [0, 1]. The dither of
            the set-points is added to its commands.
    """

    every: int
    fly: Callable[[Any, Seen], tuple[Any, np.ndarray]]


def relative(goal: np.ndarray, late: np.ndarray, gyro: np.ndarray) -> Seen:
    """Return the estimates relative to a set-point.

    Args:
        goal: set-point, (17, F).
        late: delayed position, velocity and quaternion, (10, F).
        gyro: body rate with the same delay, (3, F).
    """
    heading = goal[YAW_ANGLE]
    w, x, y, z = late[Q]
    half_cos, half_sin = np.cos(0.5 * heading), np.sin(0.5 * heading)
    turned = np.stack(
        [
            half_cos * w + half_sin * z,
            half_cos * x + half_sin * y,
            half_cos * y - half_sin * x,
            half_cos * z - half_sin * w,
        ]
    )
    rate = gyro.copy()
    rate[2] -= goal[YAW_RATE]
    return Seen(_turned(late[P] - goal[POSITION], heading), _turned(late[V] - goal[VELOCITY], heading), turned, rate)


def _turned(vector, heading):
    """World vectors (3, F) in axes rotated by ``heading`` (F,) about the vertical."""
    cos, sin = np.cos(heading), np.sin(heading)
    return np.stack([cos * vector[0] + sin * vector[1], cos * vector[1] - sin * vector[0], vector[2]])
