"""Interface of a controller that replaces the built-in one. Arrays are (k, F), SI units."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from cfb_mjx.reference_simulator.airframe import P, Q, V
from cfb_mjx.reference_simulator.controller import POSITION, VELOCITY, YAW_ANGLE, YAW_RATE


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
