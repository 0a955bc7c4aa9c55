"""The state of the drone: 17 numbers, and the memory of effects."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from cfb_mjx.model.vector import Vec, rotate

AnyArray = Array | np.ndarray


class State(eqx.Module):
    """State of the drone, or a batch or trajectory of states (leading axes). Conventions: ``docs/conventions.md``."""

    position: Float[AnyArray, "*batch 3"]
    """Centre of the rotors, world, m."""
    velocity: Float[AnyArray, "*batch 3"]
    """Velocity of the rotors' centre, world, m/s."""
    quaternion: Float[AnyArray, "*batch 4"]
    """Attitude [w, x, y, z], body to world, unit norm."""
    body_rate: Float[AnyArray, "*batch 3"]
    """Angular velocity, body axes, rad/s."""
    rotor_speed: Float[AnyArray, "*batch 4"]
    """Rotor speeds, motors M1..M4, rad/s."""
    memory: Any = ()
    """Memory of the effects (`cfb_mjx.model.Effect.start`), one entry per effect; empty means long steady flight."""

    @classmethod
    def at_rest(
        cls,
        position: ArrayLike | Sequence[Any] = (0.0, 0.0, 0.0),
        rotor_speed: ArrayLike | Sequence[Any] = 0.0,
    ) -> State:
        """Level, motionless, at ``position`` [m] with the given rotor speed(s) [rad/s]."""
        dtype = jnp.result_type(float)
        return cls(
            position=jnp.asarray(position, dtype),
            velocity=jnp.zeros(3, dtype),
            quaternion=jnp.array([1.0, 0.0, 0.0, 0.0], dtype),
            body_rate=jnp.zeros(3, dtype),
            rotor_speed=jnp.broadcast_to(jnp.asarray(rotor_speed, dtype), (4,)),
        )


class Components(eqx.Module):
    """State in the simulator's form: one array per number, and the centre of gravity in place of the rotors' centre.

    Newton's law for the centre of gravity is not coupled to the rotation. This makes a step cheaper, and its
    first-order errors smaller, than integrating the rotors' centre; both bodies do so. `State` describes the rotors'
    centre, the point that logs report.
    """

    position: Vec
    """Position of the centre of gravity, world, m."""
    velocity: Vec
    """Velocity of the centre of gravity, world, m/s."""
    quaternion: Vec
    body_rate: Vec
    rotor_speed: Vec
    memory: Any = ()


def unstack(state: State, center_of_gravity: Vec | AnyArray) -> Components:
    """Convert a state to components, given the centre of gravity in body axes [m]."""
    center_of_gravity = Vec.unstack(center_of_gravity)
    quaternion, body_rate = Vec.unstack(state.quaternion), Vec.unstack(state.body_rate)
    return Components(
        Vec.unstack(state.position) + rotate(quaternion, center_of_gravity),
        Vec.unstack(state.velocity) + rotate(quaternion, body_rate.cross(center_of_gravity)),
        quaternion,
        body_rate,
        Vec.unstack(state.rotor_speed),
        jax.tree.map(Vec.unstack, state.memory),
    )


def stack(state: Components, center_of_gravity: Vec | AnyArray) -> State:
    """Convert components to a state; the inverse of `unstack`."""
    center_of_gravity = Vec.unstack(center_of_gravity)
    lever = rotate(state.quaternion, center_of_gravity)
    lever_velocity = rotate(state.quaternion, state.body_rate.cross(center_of_gravity))
    return State(
        (state.position - lever).stack(),
        (state.velocity - lever_velocity).stack(),
        state.quaternion.stack(),
        state.body_rate.stack(),
        state.rotor_speed.stack(),
        stacked(state.memory),
    )


def stacked(memory: Any) -> Any:
    """Memory of effects as arrays, from components."""
    return jax.tree.map(lambda x: x.stack(), memory, is_leaf=lambda x: isinstance(x, Vec))
