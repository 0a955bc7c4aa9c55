"""Converters for the fields of effects, and geometry of the drone that several effects share."""

from __future__ import annotations

from collections.abc import Callable

import jax.numpy as jnp
from jaxtyping import Array

from cfb_mjx.model import rotors
from cfb_mjx.model.effects.base import Condition
from cfb_mjx.model.vector import Vec
from cfb_mjx.parameters.parameters import Parameters

HOVER_SPEED = 1594.0
"""Rotor speed, rad/s, at which coefficients that grow with rotor speed are given: hover of the drone with guards."""


def number(value) -> Array:
    """Convert a field that is one number."""
    return jnp.asarray(value, jnp.result_type(float))


def vector(size: int) -> Callable[..., Array]:
    """Converter of a field with ``size`` components; a single number is used for all, leading axes are a batch."""

    def convert(value) -> Array:
        value = number(value)
        return jnp.broadcast_to(value, (*value.shape[:-1], size))

    return convert


def hub_positions(parameters: Parameters) -> tuple[Vec, Vec]:
    """x and y of the four rotor hubs relative to their centre, body axes, m."""
    half = parameters.rotor_spacing / 2
    return half * Vec(*rotors.POSITION_SIGNS_X), half * Vec(*rotors.POSITION_SIGNS_Y)


def hub_velocities(condition: Condition) -> tuple[Vec, Vec, Vec]:
    """Velocity of the four rotor hubs through the air, v + omega x r_i, by body axis, m/s.

    The air is assumed to be the same at all four.
    """
    x, y = hub_positions(condition.parameters)
    (vx, vy, vz), (wx, wy, wz) = condition.airspeed_body, condition.body_rate
    return vx + wz * -y, vy + wz * x, vz + wx * y + wy * -x


def command_before(rotor_speed: Vec, parameters: Parameters) -> Vec:
    """Commands, 0 to 1, of a long steady flight at ``rotor_speed`` (rad/s)."""
    steady = (rotor_speed - parameters.motor_speed_offset) / parameters.motor_gain
    return steady.map(lambda u: jnp.clip(u, 0.0, 1.0))


def mean_hover_ratio(condition: Condition):
    """Mean rotor speed over `HOVER_SPEED`."""
    return condition.rotor_speed.sum() * (0.25 / HOVER_SPEED)
