"""Swarms: drones in one world, each in the wakes of those above it.

    swarm = jax.tree.map(lambda x: jnp.stack([x] * 2), model)     # two drones of one kind
    flown = rollout_swarm(swarm, state, commands)                 # commands (steps, 2, 4)

Drones act on each other through the effect `Downwash`, which every model must have. At each step a drone sees where the
others are now. A swarm of up to `FEW` drones is one system of the engine: every drone sees every other, and ``vmap``
over swarms is as fast as over drones. In a larger swarm every drone sees the `NEIGHBOURS` drones whose wakes are
strongest near it, chosen anew every `SEARCHED_S` seconds; between two exchanges, every `EXCHANGED_S` seconds, it
extrapolates their motion.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from cfb_mjx.engine import primitive
from cfb_mjx.engine.lanes import System
from cfb_mjx.errors import CfbError
from cfb_mjx.model import rotors
from cfb_mjx.model.effects import Downwash
from cfb_mjx.model.effects.downwash import FORECAST, MOMENTUM, Other
from cfb_mjx.model.quadrotor import Prepared, Quadrotor, advance, begin, prepare
from cfb_mjx.model.rollout import SYSTEM, fits_one_kernel, fly_rows, require_kept
from cfb_mjx.model.state import Components, State, stack, unstack
from cfb_mjx.model.vector import Vec, rotate, up_axis

FEW = 4
"""Largest swarm that is one system of the engine. Its compile time grows with the square of the number."""
NEIGHBOURS = 4
EXCHANGED_S, SEARCHED_S, MARGIN = 0.02, 0.1, 0.1
"""In larger swarms: longest time between two exchanges of the drones' states, s, and between two choices of neighbours;
width that is added to the wakes in this choice, m."""
WINDOW = 32


class Swarm(NamedTuple):
    """Result of `rollout_swarm`."""

    state: State
    """State of every drone after every ``every``-th command, leading axes (commands // every, drones)."""
    neglected: Float[Array, ""]
    """Greatest speed of the air, m/s, in the wake of a drone that was not among the neighbours; 0 in small swarms."""


def rollout_swarm(
    models: Quadrotor, state: State, commands: Float[Array, "steps drones 4"], *, hold: int = 1, every: int = 1
) -> Swarm:
    """Fly a swarm and return the states after every ``every``-th command.

    Use ``jax.vmap`` for many swarms; the result is differentiable with respect to all arguments.

    Args:
        models: the drones; every array has the leading axis (drones,). Every model has a `Downwash`.
        state: initial states, leading axis (drones,).
        commands: motor commands of every drone, in [0, 1].
        hold: number of steps of ``models.dt`` for which each command is held.
        every: number of commands per returned state; must divide ``steps``.

    Raises:
        CfbError: the models have no downwash, or have no axis of drones.
        ValueError: ``hold`` or ``every`` is below one, or ``every`` does not divide ``steps``.
    """
    steps, count = commands.shape[:2]
    require_kept(steps, hold, every)
    if not any(isinstance(effect, Downwash) for effect in models.effects):
        raise CfbError("the drones of a swarm act on each other by their wakes: add the effect downwash to the models.")
    if models.parameters.mass.ndim != 1 or len(models.parameters.mass) != count:
        raise CfbError(
            f"the models of a swarm have a leading axis of drones: commands are for {count}, the mass has shape "
            f"{models.parameters.mass.shape}."
        )
    if count > FEW:
        return _many(models, state, commands, hold, every)
    each = [(_one(models, i), _one(state, i)) for i in range(count)]
    prepared = tuple(prepare(model) for model, _ in each)
    dtype = jnp.result_type(models.parameters.mass, state.position, commands)
    start = tuple(_begun(p, model, own, count - 1) for p, (model, own) in zip(prepared, each, strict=True))
    start = jax.tree.map(lambda x: x.astype(dtype), start)
    rows = commands.reshape(steps, 4 * count)
    if all(fits_one_kernel(model) for model, _ in each):
        kept = primitive.fly(_SYSTEM, tuple(model for model, _ in each), start, rows, hold, every)
    else:
        step = jax.checkpoint(lambda states, row: _stepped(prepared, states, row, True), prevent_cse=False)

        def some(states, rows):
            states = jax.lax.scan(lambda states, row: (_held(step, states, row, hold), None), states, rows)[0]
            return states, states

        kept = jax.lax.scan(some, start, rows.reshape(steps // every, every, -1))[1]
    flown = [stack(own, p.parameters.center_of_gravity) for own, p in zip(kept, prepared, strict=True)]
    return Swarm(jax.tree.map(lambda *x: jnp.stack(x, axis=1), *flown), jnp.zeros((), dtype))


def _held(step, states, row, hold: int):
    return step(states, row) if hold == 1 else jax.lax.scan(lambda s, _: (step(s, row), None), states, length=hold)[0]


def _one(tree, index: int):
    return jax.tree.map(lambda x: x[index], tree)


def _begun(prepared: Prepared, model: Quadrotor, state: State, others: int) -> Components:
    """Components of a state, with room for so many other drones."""
    found = unstack(begin(model, state), prepared.parameters.center_of_gravity)
    zero = jnp.zeros_like(found.rotor_speed[0])
    return replace(found, memory=_sensing(model, found.memory, [Vec(*(zero,) * (3 * sum(FORECAST)))] * others))


def _place(model: Quadrotor) -> int:
    return next(i for i, effect in enumerate(model.effects) if isinstance(effect, Downwash))


def _sensing(model: Quadrotor, memory: tuple, others: Sequence[Vec]) -> tuple:
    """Memory of all effects of a model with these other drones."""
    return tuple(tuple(others) if i == _place(model) else own for i, own in enumerate(memory))


def _wake(prepared: Prepared, at: Components) -> Other:
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


def _stepped(prepared: tuple[Prepared, ...], states: tuple[Components, ...], row: Array, plain: bool):
    wakes = [_wake(p, at) for p, at in zip(prepared, states, strict=True)]
    moved = []
    for i, (own, at) in enumerate(zip(prepared, states, strict=True)):
        others = [_seen_by(own, wake).memory() for j, wake in enumerate(wakes) if j != i]
        at = replace(at, memory=_sensing(own.model, at.memory, others))
        moved.append(advance(replace(own, wrench_once=plain), at, Vec.unstack(row[4 * i : 4 * i + 4])))
    return tuple(moved)


def _prepared(models: tuple[Quadrotor, ...]) -> tuple[Prepared, ...]:
    return tuple(eqx.tree_at(lambda p: p.model.parameters, prepare(model), None) for model in models)


_SYSTEM = System(_prepared, _stepped)


def _many(models: Quadrotor, state: State, commands: Array, hold: int, every: int) -> Swarm:
    """A swarm in which every drone sees its neighbours only, and extrapolates their motion between exchanges."""
    steps, count = commands.shape[:2]
    exchanged = _divisor(every, EXCHANGED_S / (hold * models.dt))
    searched = _divisor(every // exchanged, SEARCHED_S / EXCHANGED_S)
    prepared = jax.vmap(prepare)(models)
    start = jax.vmap(lambda p, model, own: _begun(p, model, own, min(NEIGHBOURS, count - 1)))(prepared, models, state)
    dtype = jnp.result_type(models.parameters.mass, state.position, commands)
    start = jax.tree.map(lambda x: x.astype(dtype), start)
    fits = fits_one_kernel(_one(models, 0))

    def flown(model, own, at, rows):
        if fits:
            return primitive.fly(SYSTEM, model, at, rows, hold)
        return fly_rows(own, at, Vec.unstack(rows), hold)

    def exchange(near):
        def one(at, rows):
            wakes = jax.vmap(_wake)(prepared, at)

            def sensing(own, at, near):
                others = [_seen_by(own, jax.tree.map(lambda x, j=j: x[j], wakes)).memory() for j in near]
                return replace(at, memory=_sensing(own.model, at.memory, others))

            at = jax.vmap(sensing)(prepared, at, near)
            return jax.vmap(flown, in_axes=(0, 0, 0, 1))(models, prepared, at, rows), None

        return one

    def search(carry, rows):
        at, neglected = carry
        near, left = _neighbours(prepared, at)
        at = jax.lax.scan(exchange(near), at, rows)[0]
        return (at, jnp.maximum(neglected, left.astype(neglected.dtype))), None

    def some(carry, rows):
        carry = jax.lax.scan(search, carry, rows)[0]
        return carry, carry[0]

    rows = commands.reshape(steps // every, every // (searched * exchanged), searched, exchanged, count, 4)
    (_, neglected), kept = jax.lax.scan(some, (start, jnp.zeros((), dtype)), rows)
    center = prepared.parameters.center_of_gravity
    return Swarm(jax.vmap(jax.vmap(stack), in_axes=(0, None))(kept, center), neglected)


def _divisor(number: int, most: float) -> int:
    """Largest divisor of a number that is not above ``most``; 1 if there is none."""
    return next((n for n in range(min(number, int(most + 1e-6)), 0, -1) if number % n == 0), 1)


def _neighbours(prepared: Prepared, at: Components) -> tuple[Array, Array]:
    """Indices (drones, NEIGHBOURS) of the strongest wakes near each drone, and the speed of the next strongest, m/s.

    Only the `WINDOW` next drones on either side, sorted along x, are looked at, so that the cost grows no faster than
    the swarm. Wakes are widened for the choice by the distance that two drones may approach each other until the next
    one.
    """
    wakes = jax.lax.stop_gradient(jax.vmap(_wake)(prepared, at))
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
