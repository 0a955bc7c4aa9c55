"""Which drones of a swarm are in whose wake: what the effect `Downwash` of every drone is told of the others.

Every drone of a swarm of up to `FEW` sees every other. In a larger swarm it sees the `NEIGHBOURS` drones whose wakes
are strongest near it, chosen anew every `SEARCHED_S` seconds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from cfb_mjx.errors import CfbError
from cfb_mjx.model import rotors
from cfb_mjx.model.effects import Downwash
from cfb_mjx.model.effects.downwash import FORECAST, MOMENTUM, Other
from cfb_mjx.model.quadrotor import Prepared, Quadrotor, begin
from cfb_mjx.model.state import AnyArray, Components, State, stacked, unstack
from cfb_mjx.model.vector import Vec, rotate, up_axis

FEW = 4
"""Largest swarm of which every drone sees every other."""
NEIGHBOURS = 4
SEARCHED_S, MARGIN = 0.1, 0.1
"""Longest time between two choices of neighbours, s; width that is added to the wakes in this choice, m."""
WINDOW = 32


def require_drones(models: Quadrotor, count: int) -> None:
    """Raise unless the models have a leading axis of so many drones."""
    if models.parameters.mass.ndim != 1 or len(models.parameters.mass) != count:
        raise CfbError(
            f"the models of a swarm have a leading axis of drones: there are {count}, the mass has shape "
            f"{models.parameters.mass.shape}."
        )


def interact(models: Quadrotor) -> bool:
    """Whether the drones act on each other by their wakes."""
    return any(isinstance(effect, Downwash) for effect in models.effects)


def begin_among(model: Quadrotor, state: State, others: int) -> State:
    """Add the memory of a long steady flight to a state without memory, with room for so many other drones."""
    at = unstack(begin(model, state), Vec(0.0, 0.0, 0.0))
    unseen = Vec(*(jnp.zeros_like(at.rotor_speed[0]),) * (3 * sum(FORECAST)))
    return replace(state, memory=stacked(_told(model, at.memory, [unseen] * others)))


def _place(model: Quadrotor) -> int:
    return next(i for i, effect in enumerate(model.effects) if isinstance(effect, Downwash))


def _told(model: Quadrotor, memory: tuple, others: Sequence[Vec]) -> tuple:
    """Memory of all effects of a model with these other drones."""
    return tuple(tuple(others) if i == _place(model) else own for i, own in enumerate(memory))


def wake_of(prepared: Prepared, at: Components) -> Other:
    """A drone as others see it, except that the wake and its derivative are multiplied by the root of the mass.

    It accelerates under thrust and gravity and turns with its body rate.
    """
    lever = rotate(at.quaternion, Vec.unstack(prepared.parameters.center_of_gravity))
    thrust = rotors.loads_at(prepared.rotors, at.rotor_speed, 0.0 * at.rotor_speed).thrust.sum()
    lifts = thrust > 0
    size = jnp.where(lifts, jnp.sqrt(jnp.where(lifts, thrust, 1.0)), 0.0)
    up = up_axis(at.quaternion)
    acceleration = up * (thrust / prepared.parameters.mass) - Vec(0.0, 0.0, prepared.parameters.gravity)
    turning = rotate(at.quaternion, at.body_rate).cross(up)
    path, wake = (at.position - lever, at.velocity, acceleration), (-size * up, -size * turning)
    return Other(path, wake)


def _seen_by(prepared: Prepared, other: Other) -> Other:
    """Another drone as the memory of this one holds it."""
    root = 1 / jnp.sqrt(prepared.parameters.mass)
    return other._replace(wake=tuple(part * root for part in other.wake))


def shown(prepared: Prepared, at: Components, others: Sequence[Other]) -> Components:
    """A drone that has seen where the others (`wake_of`) are and point now."""
    seen = [_seen_by(prepared, other).memory() for other in others]
    return replace(at, memory=_told(prepared.model, at.memory, seen))


def sense(prepared: Prepared, at: Components, near: Int[AnyArray, "drones neighbours"]) -> Components:
    """Show every drone where its neighbours are and point now.

    Args:
        prepared: the drones, leading axis (drones,).
        at: their states, likewise.
        near: indices of the neighbours of each.
    """
    wakes = jax.vmap(wake_of)(prepared, at)

    def one(own, at, near):
        return shown(own, at, [jax.tree.map(lambda x, j=j: x[j], wakes) for j in near])

    return jax.vmap(one)(prepared, at, near)


def all_others(count: int) -> np.ndarray:
    """Indices of all other drones for each of so many, (count, count - 1)."""
    return np.array([[j for j in range(count) if j != i] for i in range(count)], int).reshape(count, count - 1)


def divisor(number: int, most: float) -> int:
    """Largest divisor of a number that is not above ``most``; 1 if there is none."""
    return next((n for n in range(min(number, int(most + 1e-6)), 0, -1) if number % n == 0), 1)


def neighbours(prepared: Prepared, at: Components) -> tuple[Array, Array]:
    """Indices (drones, NEIGHBOURS) of the strongest wakes near each drone, and the speed of the next strongest, m/s.

    Only the `WINDOW` next drones on either side, sorted along x, are looked at, so that the cost grows no faster than
    the swarm. Wakes are widened for the choice by the distance that two drones may approach each other until the next
    one.
    """
    wakes = jax.lax.stop_gradient(jax.vmap(wake_of)(prepared, at))
    place, wake = wakes.path[0], wakes.wake[0]
    x = place[0]
    count = len(x)
    order = jnp.argsort(x)
    offsets = np.array([k for k in range(-min(WINDOW, count - 1), min(WINDOW, count - 1) + 1) if k])
    ranks = jnp.argsort(order)[:, None] + offsets
    there = (ranks >= 0) & (ranks < count)
    others = order[jnp.clip(ranks, 0, count - 1)]

    def speeds(own, here, others, there, wider):
        effect = own.model.effects[_place(own.model)]
        effect = replace(effect, width=effect.width + wider)

        def one(other):
            begun, wake = effect.wake_at(here, other, own.parameters)
            air = effect.air_velocity(here - begun, wake)
            return air.dot(air)

        squares = jax.vmap(one)(jax.tree.map(lambda x: x[others], _seen_by(own, wakes)))
        return jnp.where(there, squares, -1.0)

    now, soon = (
        jax.vmap(speeds, in_axes=(0, 0, 0, 0, None))(prepared, place, others, there, wider) for wider in (0.0, MARGIN)
    )
    likely = jnp.maximum(now, soon)
    near = []
    for _ in range(min(NEIGHBOURS, count - 1)):
        near.append(jnp.argmax(likely, axis=1)[:, None])
        likely = jnp.where(jnp.arange(len(offsets)) == near[-1], -1.0, likely)
    left = jnp.sqrt(jnp.where(likely < 0, 0.0, now).max())
    if count > WINDOW + 1:
        # At the distance r beside a vertical axis, wherever along it, a wake is no faster than 0.505 w / r.
        apart = x[order][WINDOW + 1 :] - x[order][: -WINDOW - 1]
        strength = jnp.sqrt(wake.dot(wake).max() / MOMENTUM)
        left = jnp.maximum(left, 0.505 * strength / jnp.maximum(apart.min(), 1e-3))
    return jnp.take_along_axis(others, jnp.concatenate(near, axis=1), axis=1), left
