"""Landing: the target's way down, what stops the motors, what is measured, and a platform that moves."""

import importlib.util
from dataclasses import replace
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import least_squares

from cfb_mjx.control.controllers import find_controller
from cfb_mjx.envs import StateEstimate, TargetTask
from cfb_mjx.envs.path import derivative
from cfb_mjx.envs.task import with_room
from cfb_mjx.model import Quadrotor, State
from cfb_mjx.model.effects import GroundEffect
from cfb_mjx.optional import not_none
from cfb_mjx.parameters import load_randomisation
from cfb_mjx.train.flight import fly
from cfb_mjx.train.landing import (
    BELOW_M,
    CRAWL_M,
    CRAWL_MPS,
    CUSHION,
    DESCENT_MPS,
    LANDING_S,
    Descent,
    Lander,
    clearance,
    drawn,
    land,
    touch_down,
    with_floor,
)

pytestmark = pytest.mark.xdist_group("training")

DRONE = Quadrotor.from_file("cfb-guards")
TASK = TargetTask()
DT = 0.008
LEVEL = jnp.array([1.0, 0.0, 0.0, 0.0])
PAD = jnp.array([0.0, 0.0, 0.014])


@pytest.fixture(scope="module")
def landings():
    return land(find_controller("track", DRONE), TASK, DRONE, jax.random.split(jax.random.PRNGKey(1), 4))


def test_the_shipped_policy_lands_softly_and_stays(landings):
    measured, flown = landings
    assert np.all(measured.landed)
    assert 0.03 < np.min(measured.vertical_speed_mps) < np.max(measured.vertical_speed_mps) < 0.15
    assert np.max(measured.distance_m) < 0.01
    np.testing.assert_allclose(flown.position[:, -1, 2], PAD[2], atol=1e-3)
    # It was up there before.
    assert np.min(flown.position[:, 0, 2]) > 0.85


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (lambda f: f._replace(position=f.position + jnp.array([0.15, 0.0, 0.0])), "beside the pad"),
        (lambda f: f._replace(position=f.position + jnp.array([0.0, 0.0, 0.1])), "in the air"),
        (lambda f: f._replace(velocity=6.0 * f.velocity), "too fast"),
        (lambda f: f._replace(velocity=f.velocity + jnp.array([0.05, 0.0, 0.0])), "slides"),
        (lambda f: f._replace(quaternion=f.quaternion.at[:, -1].set(jnp.array([0.0, 1.0, 0.0, 0.0]))), "on its back"),
        (lambda f: f._replace(command=f.command.at[:, -1].set(0.2)), "motors on"),
        (lambda f: f._replace(failed=~f.failed), "a limit was exceeded"),
    ],
)
def test_other_ends_are_no_landings(landings, change, why):
    flown = landings[1]
    measured = touch_down(change(flown), DT)
    assert not np.any(measured.landed), why
    assert np.all(np.isnan(measured.tilt_deg)) == (why == "in the air")


@eqx.filter_jit
def _flown(controller, path, drone, key, stop):
    lander = Lander(controller, path, lambda time: path.pad, path.end_s)
    start = drone.hover_state(path.start)
    flown = fly(lander, with_room(TASK, DRONE), drone, key, LANDING_S, start, path=path, stop=stop)
    return jax.tree.map(lambda x: x[None], flown)


def test_a_drone_whose_motors_do_not_stop_has_not_landed():
    path, key = Descent(jnp.array([0.3, 0.0, 1.0]), PAD), jax.random.PRNGKey(2)
    drone = with_floor(DRONE)
    flown = _flown(find_controller("track", DRONE), path, drone, key, None)
    assert not touch_down(flown, DT).landed[0]
    assert np.min(np.asarray(flown.position)[..., 2]) < 0.03


def test_the_motors_stop_beneath_the_firmwares_loop_too():
    measured, flown = land(find_controller("track-rates", DRONE), TASK, DRONE, jax.random.PRNGKey(3)[None])
    assert measured.landed[0]
    # Its rate loop would go on to turn the motors.
    assert np.all(np.asarray(flown.command)[0, -100:] == 0)


class Idle(eqx.Module):
    """A controller that commands half thrust."""

    control_dt_s: float = DT

    def start(self, estimate, command):
        return None

    def command(self, memory, estimate):
        return None, jnp.full(4, 0.5)


@pytest.mark.parametrize(
    ("height", "speed", "after_s", "stops"),
    [(0.005, 0.0, 0.2, True), (0.005, -0.1, 0.2, False), (0.03, 0.0, 0.2, False), (0.005, 0.0, 0.05, False),
     (0.03, 0.0, 3.1, True)],
)  # fmt: skip
def test_what_stops_the_motors(height, speed, after_s, stops):
    """Estimates are relative to the target, 20 cm above a pad that rises at 0.2 m/s; the target ends after 3 s."""

    def pad(time):
        return jnp.array([0.0, 0.0, 0.2]) * time

    lander = Lander(Idle(), lambda time: pad(time) + jnp.array([0.0, 0.0, 0.2]), pad, jnp.asarray(3.0))
    zero = jnp.zeros(3)
    seen = StateEstimate(zero.at[2].set(height - 0.2), zero.at[2].set(0.2 + speed), LEVEL, zero)

    def one(memory, _):
        return lander.command(memory, seen)

    memory, _ = jax.lax.scan(one, lander.start(seen, jnp.zeros(4)), length=round(after_s / DT))
    assert bool(Lander.stopped(memory)) is stops


def test_the_target_comes_down_as_it_says():
    path = drawn(jax.random.PRNGKey(5))
    times = jnp.arange(0.0, LANDING_S, 0.01)
    way, speed = jax.vmap(path)(times), jax.vmap(derivative(path))(times)
    np.testing.assert_allclose(way[0], path.start, atol=1e-12)
    np.testing.assert_allclose(way[-1], PAD.at[2].add(-BELOW_M), atol=1e-9)
    assert 0.9 < path.start[2] < 1.1
    assert np.linalg.norm(path.start[:2]) <= 1.0
    assert np.min(speed[:, 2]) == pytest.approx(-DESCENT_MPS, abs=1e-9)
    near = (way[:, 2] < PAD[2] + CRAWL_M - 0.02) & (way[:, 2] > PAD[2] - BELOW_M + 0.03)
    np.testing.assert_allclose(speed[near, 2], -CRAWL_MPS, atol=1e-9)
    assert path.end_s < LANDING_S - 1.5
    # The speed has no jumps, and neither has the position.
    np.testing.assert_allclose(np.diff(way, axis=0), 0.01 * speed[1:], atol=2e-4)


def test_the_lowest_point_is_that_of_feet_or_guards():
    turned = jnp.array([jnp.cos(jnp.pi / 4), jnp.sin(jnp.pi / 4), 0.0, 0.0])
    back = jnp.array([0.0, 1.0, 0.0, 0.0])
    found = clearance(jnp.array([[0.0, 0.0, 1.0]] * 3), jnp.stack([LEVEL, turned, back]))
    # Feet of 4 mm radius 10 mm below the centre; guards of 32 mm about axes 35.35 mm away, 6 mm thick 4 mm above it.
    np.testing.assert_allclose(1 - found, [0.014, 0.03535 + 0.032, 0.010], atol=1e-9)


def test_the_cushion_is_the_published_formulas():
    """Sanchez-Cuevas, Heredia, Ollero 2017: T/T0 of four rotors of radius r, neighbours d and opposite ones b apart."""
    r, d, z = 0.0275, 0.0707, np.arange(0.014, 0.5, 0.001)
    b, body = d * np.sqrt(2), 2.0
    neighbours = z / (d**2 + 4 * z**2) ** 1.5 + z / (2 * d**2 + 4 * z**2) ** 1.5 / 2
    gain = 1 / (1 - r**2 * (1 / (16 * z**2) + neighbours + 2 * body * z / (b**2 + 4 * z**2) ** 1.5))

    def misses(x):
        return 1 + x[0] * (x[1] ** 2 + 0.1**2) / (x[1] ** 2 + z**2) - gain

    np.testing.assert_allclose(list(CUSHION.values()), least_squares(misses, (0.03, 0.03)).x, rtol=2e-3)


def test_a_models_own_ground_effect_is_kept():
    own = Quadrotor(DRONE.parameters, effects=(GroundEffect(0.2, 0.1),))
    assert with_floor(own).effects == own.effects
    assert [effect.name for effect in with_floor(DRONE).effects] == ["ground_effect"]


def test_drones_with_another_centre_of_gravity_land():
    """MuJoCo refused them: it had taken a shortcut that holds for the nominal drone alone."""
    wild = replace(TASK, randomisation=load_randomisation("paper"), magnitude=0.5)
    controller = find_controller("track", DRONE)
    measured, flown = land(controller, wild, DRONE, jax.random.split(jax.random.PRNGKey(4), 8))
    assert np.mean(measured.landed) > 0.7
    assert np.std(np.asarray(flown.position)[:, -1, 0]) > 1e-3


@pytest.fixture(scope="module")
def example():
    path = Path(__file__).resolve().parents[2] / "examples" / "landing.py"
    spec = not_none(importlib.util.spec_from_file_location("landing_example", path))
    module = importlib.util.module_from_spec(spec)
    not_none(spec.loader).exec_module(module)
    return module


def test_the_platform_carries_a_drone_at_rest(example):
    """By friction: it does not if the platform jumps from place to place, as a mocap body does."""
    drone = Quadrotor.from_file("cfb-guards")
    scene, platform = example.Scene(example.PLATFORM, engine="c"), example.RIDES["both"]
    start = scene.begin(drone, State.at_rest(platform(jnp.zeros(())) + PAD, jnp.zeros(4)))

    def way(change):
        def one(world, time):
            world = scene.step(drone, change(example.moved(world, platform, time)), jnp.zeros(4))
            return world, world.drone.position - platform(time + drone.dt)

        return jax.jit(lambda world: jax.lax.scan(one, world, drone.dt * jnp.arange(1000))[1])(start)

    carried = way(lambda world: world)
    # jaxlib 0.10 used to abort while it compiled this one.
    left = way(lambda world: replace(world, velocities=jnp.zeros(3)))
    # The platform has gone more than half a circle of 0.5 m, and up and down.
    assert np.linalg.norm(carried[:, :2], axis=1).max() < 0.005
    assert np.abs(carried[:, 2] - PAD[2]).max() < 0.002
    assert np.linalg.norm(left[:, :2], axis=1).max() > 0.1


def test_the_policy_lands_on_the_platform_that_moves(example):
    drone = Quadrotor.from_file("cfb-guards")
    scene, controller = example.Scene(example.PLATFORM, engine="c"), find_controller("track", drone)
    flown = jax.jit(lambda key: example.landed(example.RIDES["both"], scene, controller, drone, key))(
        jax.random.PRNGKey(0)
    )
    measured = touch_down(jax.tree.map(lambda x: x[None], flown), DT)
    assert measured.landed[0]
    assert measured.distance_m[0] < 0.03
