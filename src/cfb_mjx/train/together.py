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

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from cfb_mjx.control.controllers import Controller
from cfb_mjx.envs.episode import Episode
from cfb_mjx.envs.path import Path as Way
from cfb_mjx.envs.path import figure_eight, slowed, through
from cfb_mjx.envs.target import TargetTask
from cfb_mjx.envs.task import with_room
from cfb_mjx.errors import CfbError
from cfb_mjx.model.effects import Downwash
from cfb_mjx.model.quadrotor import Quadrotor, prepare
from cfb_mjx.model.state import stacked, unstack
from cfb_mjx.model.wakes import interact, shown, wake_of
from cfb_mjx.train.flight import Flight, Rows, fly, horizons_s, off_target, rows_along
from cfb_mjx.train.tracking import Course, require_timescale

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
        The flights, axes (drones, steps), with ``watched`` the target after every command.

    Raises:
        CfbError: there are no drones, or one follows another that does not exist or itself follows.
    """
    if not ways:
        raise CfbError("nothing flies: give a path or Follow for each drone.")
    steps, count = round(seconds / controller.control_dt_s), len(ways)
    leaders, offsets, along = np.arange(count), np.zeros((count, 3)), []
    for i, way in enumerate(ways):
        path = way
        if isinstance(way, Follow):
            path = ways[way.leader] if 0 <= way.leader < count else way
            leaders[i], offsets[i] = way.leader, way.offset
        if isinstance(path, Follow):
            raise CfbError(f"drone {i} follows drone {leaders[i]}; it must be one with a path, from 0 to {count - 1}.")
        along.append(rows_along(controller, path, steps))
    rows = jax.tree.map(lambda *x: jnp.stack(x), *along)
    rows = Rows(rows.target + offsets[:, None], rows.ahead, rows.later + offsets[:, None])
    starts = jax.vmap(lambda place: replace(nominal.hover_state(place), memory=()))(rows.target[:, 0])
    horizons = jnp.asarray(horizons_s(controller))[:, None]

    def one(key, start, rows, leader, offset):
        own = jax.lax.axis_index(_AXIS)

        def between(episode: Episode, row: Rows) -> tuple[Episode, Rows]:
            prepared = prepare(episode.model)
            at = unstack(episode.state, prepared.parameters.center_of_gravity)
            everyone = jax.lax.all_gather(wake_of(prepared, at), _AXIS)
            others = [jax.tree.map(lambda x, k=k: x[(own + k) % count], everyone) for k in range(1, count)]
            if interact(episode.model):
                memory = stacked(shown(prepared, at, others).memory)
                episode = replace(episode, state=replace(episode.state, memory=memory))
            position, velocity, pull = (part.stack() for part in jax.tree.map(lambda x: x[leader], everyone).path)
            ahead = None
            if row.ahead is not None:
                ahead = (velocity * horizons + pull * (horizons**2 / 2)).reshape(-1)
            follows = leader != own
            seen = Rows(position + offset, ahead, position + offset)
            return episode, jax.tree.map(lambda led, given: jnp.where(follows, led, given), seen, row)

        return fly(controller, task, nominal, key, seconds, start, path=rows, between=between)

    keys = jax.random.split(key, count)
    flown = jax.vmap(one, axis_name=_AXIS)(keys, starts, rows, jnp.asarray(leaders), jnp.asarray(offsets))
    # A follower should have reached the place beside where its leader is now, not where it was before the command.
    beside = flown.position[leaders] + jnp.asarray(offsets)[:, None]
    return flown._replace(watched=jnp.where((leaders != np.arange(count))[:, None, None], beside, flown.watched))


class Together(NamedTuple):
    """Measurements of the second of two drones that fly together, per flight."""

    mean_distance_m: Float[Array, "*flights"]
    """Mean distance from its target."""
    largest_distance_m: Float[Array, "*flights"]
    closest_m: Float[Array, "*flights"]
    """Least distance between the two drones."""
    failed: Bool[Array, "*flights"]
    """Whether one of the two exceeded a limit."""


BELOW_M, ACROSS_M, SWAP_S, SWAPS = 0.3, 1.2, 2.5, 4
"""The second drone flies so far below the first. They exchange places at such a distance, in such a time, so often."""
LAP_S, FOLLOWED_S, GATHERED_S = 8.0, 16.0, 4.0
"""Lap of the leader's figure eight, duration of the flight, and initial time that is not counted, s."""
WAKE = 0.008
"""Coefficient of the `Downwash` of a model that has none, N s^2/m^2: least squares to the force on a Crazyflie 2.1 that
crosses below another, in the flights published with G. Shi, W. Honig, Y. Yue, S.-J. Chung, Neural-Swarm, ICRA 2020."""


def led(timescale: float = 1.0) -> Course:
    """The leader's figure eight of `follow`, 2 m by 1 m, with all times multiplied by a factor.

    Raises:
        CfbError: the factor is not positive.
    """
    require_timescale(timescale)
    return Course(slowed(figure_eight(lap_s=LAP_S), timescale), FOLLOWED_S * timescale, GATHERED_S * timescale)


def with_wake(drone: Quadrotor) -> Quadrotor:
    """The drone with a wake (`WAKE`, if its model has none)."""
    return drone if interact(drone) else replace(drone, effects=(*drone.effects, Downwash(coefficient=WAKE)))


def cross(controller: Controller, task: TargetTask, nominal: Quadrotor, keys: PRNGKeyArray) -> tuple[Together, Flight]:
    """Let two drones exchange places again and again, the second `BELOW_M` below the first.

    Args:
        controller: the controller of both.
        task: determines the drones and the noise.
        nominal: the nominal drone; it is flown `with_wake`.
        keys: one key per flight.

    Returns:
        The measurements and the flights of the second drone.
    """
    times = SWAP_S * np.arange(SWAPS + 1)
    sides = ACROSS_M / 2 * (-1.0) ** np.arange(SWAPS + 1)
    ways = [through(np.stack([x, 0 * x, 0 * x + z], axis=1), times) for x, z in ((sides, BELOW_M), (-sides, 0.0))]
    return _measured(controller, with_room(task, nominal), with_wake(nominal), keys, ways, SWAPS * SWAP_S, 0.0)


def follow(
    controller: Controller,
    task: TargetTask,
    nominal: Quadrotor,
    keys: PRNGKeyArray,
    path: Way | None = None,
    seconds: float = FOLLOWED_S,
    settled_s: float = GATHERED_S,
) -> tuple[Together, Flight]:
    """Let a drone lead along a path, and another follow `BELOW_M` below it; other arguments as for `cross`.

    Args:
        path: the leader's path; default: that of `led`.
        seconds: duration, s.
        settled_s: initial time that is not counted, s.
    """
    path = led().path if path is None else path
    ways = [path, Follow(0, (0.0, 0.0, -BELOW_M))]
    return _measured(controller, with_room(task, nominal), with_wake(nominal), keys, ways, seconds, settled_s)


@eqx.filter_jit
def _measured(controller, task, nominal, keys, ways, seconds, settled_s):
    flown = jax.vmap(lambda key: fly_together(controller, task, nominal, key, ways, seconds))(keys)
    second = jax.tree.map(lambda x: x[:, 1], flown)
    distance = off_target(second, controller.control_dt_s, settled_s)
    failed = flown.failed[..., -1].any(axis=1)
    return Together(distance.mean(axis=1), distance.max(axis=1), closest_m(flown), failed), second


def closest_m(flown: Flight) -> Float[Array, "*flights"]:
    """Least distance between two drones that fly together, m; axes of the flights (..., drones, steps)."""
    count = flown.position.shape[-3]
    if count == 1:
        return jnp.full(flown.position.shape[:-3], jnp.inf)
    pairs = [(i, j) for i in range(count) for j in range(i)]
    apart = [jnp.linalg.norm(flown.position[..., i, :, :] - flown.position[..., j, :, :], axis=-1) for i, j in pairs]
    return jnp.min(jnp.stack(apart), axis=(0, -1))
