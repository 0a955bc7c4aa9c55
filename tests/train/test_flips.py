"""Flips: their measures on made-up flights, the shipped ones in simulation and in another simulator, and the search."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cfb_mjx.control.manoeuvre import CATCH, CLIMB, TURN, Manoeuvre, load_manoeuvre
from cfb_mjx.control.policy_file import load_policy
from cfb_mjx.deploy.deployment import find_deployment
from cfb_mjx.envs import TargetTask
from cfb_mjx.envs.task import QUIET
from cfb_mjx.errors import CfbError
from cfb_mjx.logs.gate import judge
from cfb_mjx.model import Quadrotor
from cfb_mjx.parameters import load_randomisation
from cfb_mjx.train.config import FlipTrainingConfig, config_from, load_config
from cfb_mjx.train.flight import Flight, flight_log, fly
from cfb_mjx.train.flips import FLIP_S, FLIPS, Goal, bounds, flips, measure, replay, search, shortfall
from cfb_mjx.train.run import POLICY, Training, train
from tests import helpers

pytestmark = pytest.mark.xdist_group("training")

DRONE = Quadrotor.from_file("cfb-guards")
WILD = TargetTask(randomisation=load_randomisation("paper"))


def shipped(name: str) -> Manoeuvre:
    return find_deployment(name).controller


def keys(count: int):
    return jax.random.split(jax.random.PRNGKey(3), count)


def test_what_a_made_up_flip_measures():
    """Two turns in 0.8 s, caught from 1.2 s on: the rate falls to a tenth in 0.2 s, the fall ends after 0.4 s."""
    dt = 0.01
    time = dt * (1 + np.arange(400))
    angle = 4 * np.pi * np.clip((time - 0.4) / 0.8, 0, 1)
    xyzw = Rotation.from_rotvec(np.outer(angle, [1, 0, 0])).as_quat()
    rate = np.zeros((400, 3))
    rate[:, 0] = np.where(time <= 1.2, 15.0, 15.0 * np.clip(1 - (time - 1.2) / 0.2, 0.1, 1))
    height = np.where(time <= 1.2, 1.5 * np.sin(np.pi * time / 1.2) - 0.2, 0.06)
    velocity = np.zeros((400, 3))
    velocity[:, 2] = np.where(time <= 1.2, -3.0, np.minimum(0, -3.0 + (time - 1.2) * 7.5 + 1e-9))
    position = np.zeros((400, 3))
    position[:, 2] = height
    phase = np.where(time <= 0.4, CLIMB, np.where(time <= 1.2 + 1e-9, TURN, CATCH))
    flown = Flight(position, velocity, xyzw[:, [3, 0, 1, 2]], rate, np.zeros((400, 4)), np.zeros(400, bool), phase)
    found = measure(jax.tree.map(lambda x: jnp.asarray(x)[None], flown), dt)
    np.testing.assert_allclose(found.rotations, 2, atol=0.02)
    np.testing.assert_allclose(found.vertical_extent_m, height.max() - height.min(), rtol=1e-6)
    np.testing.assert_allclose(found.rate_stop_s, 0.18, atol=dt)
    np.testing.assert_allclose(found.vertical_stop_s, 0.4, atol=dt)
    np.testing.assert_allclose(found.fall_mps, 3.0)
    np.testing.assert_allclose(found.return_error_m, 0.06, rtol=1e-5)
    assert found.completed(2).tolist() == [True]
    assert found.completed(1).tolist() == [False]
    assert found.completed(2, floor_m=0.1).tolist() == [False]
    goal = Goal(2)
    assert float(shortfall(goal, found)[0]) < 0.03
    assert float(shortfall(replace(goal, rate_stop_s=0.1), found)[0]) > 0.1
    assert float(shortfall(replace(goal, fall_mps=3.5), found)[0]) > 0.4


@pytest.mark.parametrize("name", ["double-flip", "double-flip-paper"])
def test_double_flips_keep_the_papers_numbers(name):
    found, flown = flips(shipped(name), TargetTask(), DRONE, keys(8))
    # As a log: nothing but the rotors pushes, along the body's z axis, and its signals agree.
    dt = shipped(name).control_dt_s
    log = flight_log(flown, dt, name)
    turning = np.abs(log.body_rate[:, 0]) > 10.0
    assert np.abs(log.specific_force[turning, :2].mean(axis=0)).max() < 0.1
    assert judge(log).problem is None
    # An accelerometer that is late by half a row turns with the drone; that is no wrong axis.
    turned = log.specific_force - 0.5 * dt * np.cross(log.body_rate, log.specific_force)
    assert judge(log.replace(specific_force=turned)).problem is None
    assert np.all(found.completed(2))
    np.testing.assert_allclose(found.rotations, 2, atol=0.03)
    assert np.max(found.vertical_extent_m) <= 1.8
    # About 1000 deg/s.
    assert 900 < np.degrees(np.min(found.peak_rate_radps)) < np.degrees(np.max(found.peak_rate_radps)) < 1200
    assert np.max(found.rate_stop_s) <= 0.35
    assert np.max(found.vertical_stop_s) <= 0.6
    assert np.max(found.return_error_m) <= 0.1
    assert np.all((flown.command >= 0) & (flown.command <= 1))
    if name == "double-flip-paper":
        assert np.min(found.fall_mps) >= 3.3


@pytest.mark.parametrize(("name", "least"), [("flip", 0.95), ("double-flip", 0.9)])
def test_random_drones_complete_flips(name, least):
    # Of 4096 drones docs/flips.md counts 99 and 97 in a hundred.
    found, _ = flips(shipped(name), WILD, DRONE, keys(64))
    assert np.mean(found.completed(FLIPS[name])) >= least


def test_the_commands_alone_lead_along_the_same_way_in_another_simulator():
    """No thrust but what the commands give: SciPy's integrator and equations of its own fly them again."""
    dt, steps = 0.008, 190
    drone = replace(DRONE, integrator="rk4", dt=0.002, substeps=1)
    start = drone.hover_state((0.0, 0.0, 0.0))
    flown = fly(shipped("double-flip"), TargetTask(noise=QUIET), drone, jax.random.PRNGKey(0), steps * dt, start)
    assert np.ptp(np.asarray(flown.quaternion)[:, 1]) > 1.5
    commands = np.asarray(flown.command, float)
    again = helpers.fly(helpers.constants_of(drone.parameters), helpers.pack(start), commands, dt)
    apart = np.linalg.norm(helpers.part(again, "position") - np.asarray(flown.position), axis=1)
    assert apart.max() < 0.002


def test_replayed_open_loop_nothing_is_hidden():
    found = replay(shipped("double-flip"), DRONE)
    assert found.apart_m < 1e-3
    # Four rotors at s = 1 of eq. 8.
    np.testing.assert_allclose(found.model_thrust_n, 4 * (-0.23 + 0.562 - 0.043), rtol=1e-5)
    assert 0.5 * found.model_thrust_n < found.largest_thrust_n <= found.model_thrust_n


def test_a_search_never_does_worse_than_what_it_is_given():
    given, key = shipped("double-flip"), jax.random.PRNGKey(1)
    margin, sizes = Goal(2, "margin"), {"candidates": 4, "plants": 8}
    found = search(given, WILD, DRONE, margin, key, rounds=2, **sizes)
    low, high = bounds(2)
    assert all(a - 1e-6 <= float(x) <= b + 1e-6 for a, x, b in zip(low, found.knobs, high, strict=True))
    assert found.history[1] <= found.history[0] + 1e-3
    # What the shipped one is worth, and its neighbours could not better.
    assert float(found.cost) < 0.5
    fixed = search(given, WILD, DRONE, margin, key, bounds(2, rate_radps=19.0), 1, **sizes)
    np.testing.assert_allclose(fixed.knobs.rate_radps, 19.0, rtol=1e-6)
    with pytest.raises(CfbError, match="randomised drones"):
        search(given, TargetTask(), DRONE, margin, key)
    # Who must stay within a height where none can is as good as lost.
    none = search(given, WILD, DRONE, Goal(2, "within", extent_m=0.1), key, rounds=1, **sizes)
    assert float(none.cost) > float(found.cost) + 0.5


@pytest.mark.parametrize("name", ["flip", "flip-analytic"])
def test_the_shipped_flip_policies_say_where_they_come_from(name):
    policy = load_policy(name)
    assert policy.task == "flip"
    # What it does not say, as it was trained before there was such a setting, is the default.
    assert config_from(policy.training["config"], "policy") == load_config(name)
    assert policy.lumped_delay


def test_the_defaults_are_those_of_the_shipped_training():
    assert replace(load_config("flip"), description="") == FlipTrainingConfig()


@pytest.mark.parametrize("algorithm", ["analytic", "ppo"])
def test_both_algorithms_train_flips(algorithm, tmp_path):
    config = load_config("flip", (*helpers.SMALL_TRAINING, f"algorithm={algorithm}"))
    # Judging is the same for both.
    rows = train(Training.prepare(config, {"cfb_mjx": "test"}), tmp_path, evaluate=algorithm == "ppo")
    assert len(rows) == 2
    assert np.isfinite(rows[-1]["loss"])
    assert algorithm == "analytic" or np.isfinite(rows[-1]["rate_error_radps"])
    policy = load_policy(tmp_path / POLICY)
    assert policy.task == "flip"
    assert policy.controller.layout.setpoint_scales == (3.0, 10.0)


def test_flips_are_over_before_they_are_measured():
    assert all(k.climb_s + k.turn_s + 2 < FLIP_S for k in (load_manoeuvre(name).knobs for name in FLIPS))
