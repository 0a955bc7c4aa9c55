"""Model-predictive control of ``examples/mpc.py``: it flies to a target through the derivatives of its model."""

from __future__ import annotations

import importlib.util
import sys
from dataclasses import replace
from pathlib import Path

import equinox as eqx
import jax
import numpy as np
import pytest

from cfb_mjx.control.controllers import Controller
from cfb_mjx.envs import TargetTask, with_room
from cfb_mjx.model import Quadrotor
from cfb_mjx.optional import not_none
from cfb_mjx.train.flight import fly

DRONE = Quadrotor.from_file("cfb-guards")
HEAVY = replace(DRONE, parameters=replace(DRONE.parameters, mass=1.1 * DRONE.parameters.mass))


@pytest.fixture(scope="module")
def example():
    path = Path(__file__).resolve().parents[2] / "examples" / "mpc.py"
    spec = not_none(importlib.util.spec_from_file_location("mpc_example", path))
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look their module up
    not_none(spec.loader).exec_module(module)
    vars(module).update(STEPS=15)  # a shorter horizon, which is faster
    return module


@pytest.fixture(scope="module")
def flown():
    """Positions in a flight of 1.5 s to a target 0.5 m away."""
    start, task = DRONE.hover_state((-0.5, 0.0, 0.0)), with_room(TargetTask(), DRONE)

    @eqx.filter_jit
    def one(controller: Controller, drone: Quadrotor):
        return fly(controller, task, drone, jax.random.PRNGKey(0), 1.5, start).position

    return one


def test_it_flies_to_the_target_and_stays_there(example, flown):
    """Without derivatives it would repeat the hover command, 0.5 m away."""
    controller = example.Mpc.of(DRONE)
    assert isinstance(controller, Controller)
    position = np.asarray(flown(controller, DRONE))
    assert position[:, 0].max() < 0.01
    assert np.linalg.norm(position[-20:], axis=1).max() < 0.005


def test_the_right_model_holds_a_drone_that_the_wrong_one_lets_sag(example, flown):
    wrong, right = (np.asarray(flown(example.Mpc.of(model), HEAVY))[-20:] for model in (DRONE, HEAVY))
    assert np.linalg.norm(right, axis=1).max() < 0.005
    assert wrong[:, 2].max() < -0.005
