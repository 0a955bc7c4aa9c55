"""The shipped policies do what they are shipped for; docs/controllers.md has the full measurements."""

import jax
import numpy as np
import pytest
import yaml

from cfb_mjx.control.controllers import find_controller
from cfb_mjx.control.neural import NeuralController
from cfb_mjx.control.policy_file import load_policy, shipped_policies
from cfb_mjx.envs import TargetTask
from cfb_mjx.model import Quadrotor
from cfb_mjx.parameters import load_randomisation
from cfb_mjx.train.config import config_from, load_config
from cfb_mjx.train.flying import hover, six_metres
from cfb_mjx.train.judge import Judge

pytestmark = pytest.mark.xdist_group("training")

DRONE = Quadrotor.from_file("cfb-guards")


def controller_of(name: str) -> NeuralController:
    policy = load_policy(name)
    assert policy.training["config"]["seed"] == 0
    return policy.controller


@pytest.mark.parametrize("name", ["target", "target-adaptive"])
def test_it_hovers_on_the_nominal_drone(name):
    measured, _ = hover(controller_of(name), TargetTask(), DRONE, jax.random.split(jax.random.PRNGKey(3), 8))
    assert not np.any(measured.failed)
    assert np.mean(measured.mean_distance_m) < 0.025
    assert np.mean(measured.command_std) < 0.02


@pytest.mark.parametrize(("name", "within_m"), [("target-adaptive", 0.06), ("target", 0.075)])
def test_random_drones_are_held_within_centimetres(name, within_m):
    task = TargetTask(randomisation=load_randomisation("paper"))
    measured, _ = hover(controller_of(name), task, DRONE, jax.random.split(jax.random.PRNGKey(3), 32))
    assert not np.any(measured.failed)
    assert np.median(measured.mean_distance_m) < within_m


@pytest.mark.parametrize(("name", "config"), [("target", "target-2"), ("target-adaptive", "target-adaptive-2")])
def test_policies_are_made_by_what_is_shipped(name, config):
    assert config_from(load_policy(name).training["config"], "policy") == load_config(config)


def test_the_policy_of_ppo_begins_with_the_defaults():
    first = yaml.safe_load((shipped_policies()["target"].parent / "config-1.yaml").read_text())
    assert config_from(first, "first part") == load_config("target")


@pytest.mark.parametrize("name", ["target", "target-adaptive"])
def test_it_does_not_swing_where_sensors_are_later_or_noisier(name):
    found = Judge(plants=None, random_drones=0).with_sensors(controller_of(name))
    assert [there["failed"] for there in found.values()] == [0, 0, 0]
    late, all_late, noisy = (there["command_std"] for there in found.values())
    assert max(late, all_late) < 0.04
    assert noisy < 0.03


def test_the_firmware_needs_its_gyro_on_the_drone_and_not_its_pose():
    """Its rate loop is fast and its position loop slow: of what the judge changes, late rates alone make it swing."""
    late_pose, all_late, _ = (
        Judge(plants=None, random_drones=0).with_sensors(find_controller("pid", DRONE), False).values()
    )
    assert late_pose["failed"] == 0
    assert late_pose["command_std"] < 0.05
    assert all_late["command_std"] > 0.15


def test_six_metres_in_two_seconds():
    measured, _ = six_metres(controller_of("target"), TargetTask(), DRONE, jax.random.split(jax.random.PRNGKey(3), 4))
    assert np.all(np.asarray(measured.arrival_s) <= 2.0)
    assert np.all(np.asarray(measured.peak_speed_mps) >= 5.0)
    assert not np.any(measured.failed)
