"""Drones that fly together: against drones that fly alone, and against `rollout_swarm`."""

from __future__ import annotations

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cfb_mjx.control import find_controller
from cfb_mjx.envs import TargetTask, figure_eight
from cfb_mjx.envs.task import QUIET, with_room
from cfb_mjx.errors import CfbError
from cfb_mjx.model import Quadrotor, rollout
from cfb_mjx.model.effects import Downwash
from cfb_mjx.model.swarm import rollout_swarm
from cfb_mjx.train.flight import Flight, fly
from cfb_mjx.train.together import Follow, closest_m, cross, fly_together, with_wake
from cfb_mjx.view import flight_figures

KEY = jax.random.PRNGKey(3)


@pytest.fixture(scope="module")
def drone() -> Quadrotor:
    return Quadrotor.from_file("cfb-guards")


@pytest.fixture(scope="module")
def track(drone):
    return find_controller("track", drone)


def at(place):
    """Path that stays at a place."""
    return eqx.Partial(lambda place, time: place + 0.0 * time, jnp.asarray(place))


@eqx.filter_jit
def flown(controller, task, drone, ways, seconds=1.0):
    return fly_together(controller, task, drone, KEY, ways, seconds)


def test_drones_far_apart_fly_alone(drone, track):
    task = with_room(TargetTask(), drone)
    ways = [at([0.0, 0.0, 1.0]), eqx.Partial(lambda time: figure_eight(lap_s=3.0)(time) + jnp.array([9.0, 0.0, 0.0]))]
    together = flown(track, task, with_wake(drone), ways)
    for i, key in enumerate(jax.random.split(KEY, 2)):
        start = drone.hover_state(ways[i](jnp.zeros(())))
        alone = jax.jit(lambda key, i=i, start=start: fly(track, task, drone, key, 1.0, start, path=ways[i]))(key)
        np.testing.assert_allclose(together.position[i], alone.position, atol=1e-9)
        np.testing.assert_allclose(together.command[i], alone.command, atol=1e-7)


def test_the_wake_is_that_of_a_swarm(drone, track):
    """The commands of the flight, flown again without a controller."""
    task = with_room(TargetTask(noise=QUIET), drone)
    washed = replace(drone, effects=(Downwash(coefficient=0.008),))
    ways = [at([0.0, 0.0, 0.5]), at([0.06, 0.0, 0.0])]
    together = flown(track, task, washed, ways)
    pair = jax.tree.map(lambda x: jnp.stack([x, x]), washed)
    start = jax.vmap(drone.hover_state)(jnp.stack([way(jnp.zeros(())) for way in ways]))
    commands = jnp.swapaxes(together.command, 0, 1)
    again = rollout_swarm(pair, start, commands, hold=washed.steps_per_command(track.control_dt_s)).state
    free = jax.vmap(rollout, in_axes=(None, 0, 1), out_axes=1)
    free = free(replace(drone, dt=track.control_dt_s, substeps=2), start, commands)
    # Later the small difference grows, for nobody flies the same commands again. Between two commands the flight
    # extrapolates the other drone's motion.
    soon, flown_there = slice(0, 25), jnp.swapaxes(together.position, 0, 1)
    np.testing.assert_allclose(again.position[soon], flown_there[soon], atol=1e-4)
    assert np.abs(free.position[soon] - flown_there[soon]).max() > 5e-3


def test_a_follower_stays_beside_its_leader(drone, track):
    task = with_room(TargetTask(), drone)
    offset = (0.4, 0.0, -0.2)
    # The second is the leader of both others.
    ways = [Follow(1, offset), figure_eight(lap_s=6.0), Follow(1, (-0.4, 0.0, -0.2))]
    together = flown(track, task, drone, ways, 4.0)
    away = np.asarray(together.position[0] - together.position[1]) - np.array(offset)
    assert np.linalg.norm(away, axis=1).max() < 0.02
    np.testing.assert_allclose(together.watched[0], together.position[1] + jnp.array(offset), atol=1e-6)
    assert float(closest_m(together)) == pytest.approx(np.hypot(0.4, 0.2), abs=0.02)


@pytest.mark.parametrize(
    ("ways", "said"),
    [
        (
            [at([0.0, 0.0, 1.0]), Follow(2, (0.0, 0.0, 0.5))],
            "drone 1 follows drone 2; it must be one with a path, from 0 to 1",
        ),
        ([at([0.0, 0.0, 1.0]), Follow(1, (0.0, 0.0, 0.5))], "drone 1 follows drone 1"),
        ([Follow(1, (0.0, 0.0, 1.0)), Follow(0, (0.0, 0.0, 0.5))], "drone 0 follows drone 1"),
    ],
)
def test_leaders_that_cannot_be_are_refused(drone, track, ways, said):
    with pytest.raises(CfbError, match=said):
        fly_together(track, with_room(TargetTask(), drone), drone, KEY, ways, 1.0)


def test_one_drone_alone_is_near_to_none(drone, track):
    task = with_room(TargetTask(noise=QUIET), drone)
    assert np.isinf(closest_m(flown(track, task, with_wake(drone), [at([0.0, 0.0, 1.0])], 0.1)))
    with pytest.raises(CfbError, match="nothing flies"):
        fly_together(track, task, drone, KEY, [], 1.0)


def test_a_stronger_wake_pushes_the_lower_drone_further(drone, track):
    keys = jax.random.split(KEY, 2)
    task = TargetTask(noise=QUIET)
    worst = [
        float(cross(track, task, replace(drone, effects=(Downwash(coefficient=c),)), keys)[0].largest_distance_m.max())
        for c in (0.0, 0.02)
    ]
    assert worst[0] < 0.01
    assert worst[1] > 2 * worst[0]


def test_a_figure_shows_the_distance_of_every_follower_from_its_own_leader(tmp_path, monkeypatch):
    """It showed all flights' distances from the target of the first."""
    targets = jnp.arange(2.0)[:, None, None] + jnp.zeros((2, 5, 3))
    zero, ones = 0 * targets, jnp.ones((2, 5, 4))
    there = Flight(targets, zero, ones, zero, ones, zero[..., 0] > 0, targets)
    seen = []
    drawn = flight_figures._over_time
    monkeypatch.setattr(flight_figures, "_over_time", lambda *given: seen.append(given[3]) or drawn(*given))
    flight_figures.track_figure(there, 0.01, tmp_path / "tracked.png")
    np.testing.assert_array_equal(dict(seen[0])["error, mm"], np.zeros((2, 5)))
