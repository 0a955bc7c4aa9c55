"""Several drones in the air together: each under its own controller, in the wakes of the others.

    ways = [figure_eight(2.0, 4.0), Follow(0, (0.0, 0.0, -0.5))]    # the second flies half a metre below the first
    flown = fly_together(controller, task, drone, key, ways, 8.0)   # a Flight, axes (drones, steps)

The drones act on each other by the effect `Downwash` of the model, exchanged before every command. They do not collide;
`closest_m` says how near they came, and a `Scene` has contacts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from cfb_mjx.control.controllers import Controller
from cfb_mjx.envs.episode import Episode
from cfb_mjx.envs.path import Path as Way
from cfb_mjx.envs.target import TargetTask
from cfb_mjx.errors import CfbError
from cfb_mjx.model.quadrotor import Quadrotor, prepare
from cfb_mjx.model.state import stacked, unstack
from cfb_mjx.model.wakes import interact, seen_by, sensing, wake_of
from cfb_mjx.train.flying import Flight, Rows, fly, rows_along

_AXIS = "drones that fly together"


class Follow(NamedTuple):
    """Stay beside another drone, which sends its position, velocity and acceleration."""

    leader: int
    """Number of the other drone."""
    offset: tuple[float, float, float]
    """Place relative to it, world axes, m."""


def fly_together(
    controller: Controller,
    task: TargetTask,
    nominal: Quadrotor,
    key: PRNGKeyArray,
    ways: Sequence[Way | Follow],
    seconds: float,
) -> Flight:
    """Fly several drones once, each from hover at the beginning of its path. Use ``vmap`` over ``key``.

    Args:
        controller: the controller of all drones. One that sees ahead sees a leader's motion continued with its
            present acceleration.
        task: determines the drones and the noise; with room for its delays (`cfb_mjx.envs.task.with_room`).
        nominal: the nominal drone. Without the effect `Downwash` the drones do not act on each other.
        key: determines drones and noise.
        ways: what each drone does: a path in the world, or `Follow`.
        seconds: duration, s.

    Returns:
        The flights, axes (drones, steps), with ``watched`` the target.

    Raises:
        CfbError: a drone follows one that does not exist or itself follows.
    """
    steps, count = round(seconds / controller.control_dt_s), len(ways)
    leaders, offsets = np.arange(count), np.zeros((count, 3))
    for i, way in enumerate(ways):
        if isinstance(way, Follow):
            if not 0 <= way.leader < count or isinstance(ways[way.leader], Follow):
                raise CfbError(
                    f"drone {i} follows drone {way.leader}; it must be one with a path, from 0 to {count - 1}."
                )
            leaders[i], offsets[i] = way.leader, way.offset
    along = [rows_along(controller, _of_leader(ways, i), steps) for i in range(count)]
    rows = jax.tree.map(lambda *x: jnp.stack(x), *along)
    rows = Rows(rows.target + offsets[:, None], rows.ahead, rows.later + offsets[:, None])
    starts = jax.vmap(lambda place: replace(nominal.hover_state(place), memory=()))(rows.target[:, 0])
    horizons = jnp.asarray(getattr(getattr(controller, "layout", None), "preview_s", ()))

    def one(key, start, rows, leader, offset):
        own = jax.lax.axis_index(_AXIS)

        def between(episode: Episode, row: Rows) -> tuple[Episode, Rows]:
            prepared = prepare(episode.model)
            at = unstack(episode.state, prepared.parameters.center_of_gravity)
            everyone = jax.lax.all_gather(wake_of(prepared, at), _AXIS)
            others = [jax.tree.map(lambda x, k=k: x[(own + k) % count], everyone) for k in range(1, count)]
            if interact(episode.model):
                memory = sensing(episode.model, at.memory, [seen_by(prepared, other).memory() for other in others])
                episode = replace(episode, state=replace(episode.state, memory=stacked(memory)))
            position, velocity, pull = (part.stack() for part in jax.tree.map(lambda x: x[leader], everyone).path)
            ahead = None
            if row.ahead is not None:
                ahead = (velocity * horizons[:, None] + pull * (horizons[:, None] ** 2 / 2)).reshape(-1)
            follows = leader != own
            seen = Rows(position + offset, ahead, position + offset)
            return episode, jax.tree.map(lambda led, given: jnp.where(follows, led, given), seen, row)

        return fly(controller, task, nominal, key, seconds, start, path=rows, between=between)

    keys = jax.random.split(key, count)
    return jax.vmap(one, axis_name=_AXIS)(keys, starts, rows, jnp.asarray(leaders), jnp.asarray(offsets))


def _of_leader(ways: Sequence[Way | Follow], number: int) -> Way:
    way = ways[number]
    return _of_leader(ways, way.leader) if isinstance(way, Follow) else way


def closest_m(flown: Flight) -> Float[Array, "*flights"]:
    """Least distance between two drones that fly together, m; axes of the flights (..., drones, steps)."""
    count = flown.position.shape[-3]
    pairs = [(i, j) for i in range(count) for j in range(i)]
    apart = [jnp.linalg.norm(flown.position[..., i, :, :] - flown.position[..., j, :, :], axis=-1) for i, j in pairs]
    return jnp.min(jnp.stack(apart), axis=(0, -1))
