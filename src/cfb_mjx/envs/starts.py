"""How episodes begin: from hover beside the target to a throw upside down six metres away."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from cfb_mjx.model.quadrotor import Quadrotor
from cfb_mjx.model.rotors import hover_rotor_speed
from cfb_mjx.model.state import State
from cfb_mjx.model.vector import Vec, multiply


@dataclass(frozen=True)
class Starts:
    """Largest values of the initial state. Every episode draws one difficulty d in [0, 1] that scales all of them.

    In a share ``near`` of the episodes d is below 0.1; in the rest it is uniform.
    """

    near: float = 0.2
    distance_m: float = 6.5
    height_m: float = 2.0
    """Largest vertical distance."""
    speed_mps: float = 4.0
    tilt_deg: float = 180.0
    yaw_deg: float = 60.0
    rate_radps: float = 6.0
    rotor_speed: float = 0.4
    """Largest relative deviation from hover speed."""


def draw(starts: Starts, model: Quadrotor, target: Float[Array, "3"], key: PRNGKeyArray) -> State:
    """Draw an initial state of ``model``; a pure function of ``key``."""
    parts = jax.random.uniform(key, (18,), jnp.result_type(float))
    near = parts[0] < starts.near
    difficulty = jnp.where(near, 0.1 * parts[1], parts[1])
    level = _direction(parts[2])
    distance = difficulty * starts.distance_m * jnp.sqrt(parts[3])
    height = difficulty * starts.height_m * (2 * parts[4] - 1)
    position = target + jnp.append(distance * level, height)
    velocity = difficulty * starts.speed_mps * (2 * parts[5:8] - 1)
    tilt = jnp.radians(difficulty * starts.tilt_deg * parts[8])
    axis = _direction(parts[9])
    yaw = jnp.radians(difficulty * starts.yaw_deg * (2 * parts[10] - 1))
    tilted = jnp.concatenate([jnp.cos(tilt / 2)[None], jnp.sin(tilt / 2) * axis, jnp.zeros(1)])
    body_rate = difficulty * starts.rate_radps * (2 * parts[11:14] - 1)
    spread = 1 + difficulty * starts.rotor_speed * (2 * parts[14:18] - 1)
    rotor_speed = hover_rotor_speed(model.changed_parameters()) * spread
    # Rotate the tilted drone about the world's vertical.
    turn = Vec(jnp.cos(yaw / 2), 0.0, 0.0, jnp.sin(yaw / 2))
    return State(position, velocity, multiply(turn, Vec.unstack(tilted)).stack(), body_rate, rotor_speed)


def _direction(unit: Float[Array, ""]) -> Float[Array, "2"]:
    angle = 2 * jnp.pi * unit
    return jnp.stack([jnp.cos(angle), jnp.sin(angle)])
