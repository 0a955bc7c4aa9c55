"""Any controller in place of the built-in one: what it sees, and how it is called. Arrays are (k, F), SI units."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from cfb_mjx.reference_simulator.airframe import P, Q, V
from cfb_mjx.reference_simulator.controller import POSITION, VELOCITY, YAW_ANGLE, YAW_RATE


@dataclass(frozen=True)
class Seen:
    """Late, noisy estimates relative to a set-point that moves and turns: at rest on it they are those of hover."""

    position: np.ndarray
    """(3, F) minus the set-point's, in axes turned by its heading, m."""
    velocity: np.ndarray
    """(3, F) minus the set-point's, same axes, m/s."""
    quaternion: np.ndarray
    """(4, F) [w, x, y, z], body to those axes."""
    body_rate: np.ndarray
    """(3, F) minus the set-point's yaw rate, rad/s."""


@dataclass(frozen=True)
class OtherController:
    """A controller of F lanes.

    Attributes:
        every: ticks from one command to the next; commands are held in between.
        fly: memory (None at first) and `Seen` to memory and commands (4, F) in [0, 1]. The set-points' dither is added
            after it.
    """

    every: int
    fly: Callable[[Any, Seen], tuple[Any, np.ndarray]]


def relative(goal: np.ndarray, late: np.ndarray, gyro: np.ndarray) -> Seen:
    """What a controller is shown.

    Args:
        goal: (17, F) set-point.
        late: (10, F) position, velocity, quaternion.
        gyro: (3, F) as old as ``late``.
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
    """World vectors (3, F) in axes turned by ``heading`` (F,) about the vertical."""
    cos, sin = np.cos(heading), np.sin(heading)
    return np.stack([cos * vector[0] + sin * vector[1], cos * vector[1] - sin * vector[0], vector[2]])
