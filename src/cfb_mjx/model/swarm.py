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

from dataclasses import replace
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from cfb_mjx.engine import primitive
from cfb_mjx.engine.lanes import System
from cfb_mjx.errors import CfbError
from cfb_mjx.model.quadrotor import Prepared, Quadrotor, advance, prepare
from cfb_mjx.model.rollout import SYSTEM, fits_one_kernel, fly_rows, require_kept
from cfb_mjx.model.state import Components, State, stack, unstack
from cfb_mjx.model.vector import Vec
from cfb_mjx.model.wakes import (
    FEW,
    NEIGHBOURS,
    SEARCHED_S,
    begin_among,
    divisor,
    interact,
    neighbours,
    require_drones,
    sense,
    shown,
    wake_of,
)

EXCHANGED_S = 0.02
"""Longest time between two exchanges of the drones' states in a swarm of more than `FEW`, s. A smaller one is a single
system of the engine, whose compile time grows with the square of the number."""


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
    if not interact(models):
        raise CfbError("the drones of a swarm act on each other by their wakes: add the effect downwash to the models.")
    require_drones(models, count)
    if count > FEW:
        return _many(models, state, commands, hold, every)
    each = [(_one(models, i), _one(state, i)) for i in range(count)]
    prepared = tuple(prepare(model) for model, _ in each)
    dtype = jnp.result_type(models.parameters.mass, state.position, commands)
    start = tuple(
        unstack(begin_among(model, own, count - 1), p.parameters.center_of_gravity)
        for p, (model, own) in zip(prepared, each, strict=True)
    )
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


def _stepped(prepared: tuple[Prepared, ...], states: tuple[Components, ...], row: Array, plain: bool):
    wakes = [wake_of(p, at) for p, at in zip(prepared, states, strict=True)]
    moved = []
    for i, (own, at) in enumerate(zip(prepared, states, strict=True)):
        at = shown(own, at, [wake for j, wake in enumerate(wakes) if j != i])
        moved.append(advance(replace(own, wrench_once=plain), at, Vec.unstack(row[4 * i : 4 * i + 4])))
    return tuple(moved)


def _prepared(models: tuple[Quadrotor, ...]) -> tuple[Prepared, ...]:
    return tuple(eqx.tree_at(lambda p: p.model.parameters, prepare(model), None) for model in models)


_SYSTEM = System(_prepared, _stepped)


def _many(models: Quadrotor, state: State, commands: Array, hold: int, every: int) -> Swarm:
    """A swarm in which every drone sees its neighbours only, and extrapolates their motion between exchanges."""
    steps, count = commands.shape[:2]
    exchanged = divisor(every, EXCHANGED_S / (hold * models.dt))
    searched = divisor(every // exchanged, SEARCHED_S / EXCHANGED_S)
    prepared = jax.vmap(prepare)(models)
    start = jax.vmap(lambda model, own: begin_among(model, own, min(NEIGHBOURS, count - 1)))(models, state)
    start = jax.vmap(lambda p, own: unstack(own, p.parameters.center_of_gravity))(prepared, start)
    dtype = jnp.result_type(models.parameters.mass, state.position, commands)
    start = jax.tree.map(lambda x: x.astype(dtype), start)
    fits = fits_one_kernel(_one(models, 0))

    def flown(model, own, at, rows):
        if fits:
            return primitive.fly(SYSTEM, model, at, rows, hold)
        return fly_rows(own, at, Vec.unstack(rows), hold)

    def exchange(near):
        def one(at, rows):
            at = sense(prepared, at, near)
            return jax.vmap(flown, in_axes=(0, 0, 0, 1))(models, prepared, at, rows), None

        return one

    def search(carry, rows):
        at, neglected = carry
        near, left = neighbours(prepared, at)
        at = jax.lax.scan(exchange(near), at, rows)[0]
        return (at, jnp.maximum(neglected, left.astype(neglected.dtype))), None

    def some(carry, rows):
        carry = jax.lax.scan(search, carry, rows)[0]
        return carry, carry[0]

    rows = commands.reshape(steps // every, every // (searched * exchanged), searched, exchanged, count, 4)
    (_, neglected), kept = jax.lax.scan(some, (start, jnp.zeros((), dtype)), rows)
    center = prepared.parameters.center_of_gravity
    return Swarm(jax.vmap(jax.vmap(stack), in_axes=(0, None))(kept, center), neglected)
