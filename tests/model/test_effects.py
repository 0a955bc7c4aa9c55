"""The effect interface and parasitic drag: neutral vanishes, closed forms hold, mappings survive a round trip."""

from __future__ import annotations

import helpers
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cfb_mjx.errors import CfbError
from cfb_mjx.model import CATALOGUE, Effect, ParasiticDrag, Quadrotor
from cfb_mjx.model.effects import effect_from_mapping, effect_to_mapping


def _one(model):
    return jax.tree.map(lambda x: x[None], model)


@pytest.mark.parametrize("name", sorted(CATALOGUE))
def test_every_effect_describes_itself(name):
    kind = CATALOGUE[name]
    neutral = kind.neutral()
    fields = set(vars(neutral))
    assert kind.name == name
    assert set(kind.units) == fields == set(kind.prior)
    assert kind.source
    assert all(low < high for low, high in kind.prior.values())
    assert isinstance(neutral, Effect)


@pytest.mark.parametrize("name", sorted(CATALOGUE))
@pytest.mark.parametrize("integrator", ["euler", "rk4"])
def test_neutral_effects_change_nothing(name, integrator, guards, fly_fleet):
    y, commands = helpers.aggressive_manoeuvre(0.1)
    arguments = helpers.state_of(y), jnp.asarray(commands)
    without = fly_fleet(_one(Quadrotor(guards, integrator=integrator)), *arguments)
    neutral = fly_fleet(_one(Quadrotor(guards, (CATALOGUE[name].neutral(),), integrator=integrator)), *arguments)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12), neutral, without)


@pytest.fixture(scope="module")
def fall(guards, fly_fleet):
    """Falling level with the rotors off for 4 s with the given drag."""

    def fly(linear, quadratic, velocity=(0.0, 0.0, 0.0)):
        model = Quadrotor(guards, (ParasiticDrag(linear, quadratic),), integrator="rk4")
        y = np.zeros(17)
        y[3:6], y[6] = velocity, 1.0
        return helpers.pack(fly_fleet(_one(model), helpers.state_of(y), jnp.zeros((1000, 4))))[0]

    return fly


def test_linear_drag_relaxes_to_terminal_velocity(fall):
    weight, c = 0.044 * 9.81, 0.1
    flown = fall(c, 0.0)
    t = 0.004 * np.arange(1, 1001)
    np.testing.assert_allclose(flown[:, 5], -weight / c * (1 - np.exp(-c * t / 0.044)), rtol=1e-8)


def test_quadratic_drag_relaxes_to_terminal_velocity(fall):
    weight, c = 0.044 * 9.81, 0.02
    flown = fall(0.0, c)
    t, terminal = 0.004 * np.arange(1, 1001), np.sqrt(weight / c)
    np.testing.assert_allclose(flown[:, 5], -terminal * np.tanh(9.81 * t / terminal), rtol=1e-8)


def test_drag_acts_per_axis_and_only_slows(fall):
    flown = fall([0.05, 0.0, 0.0], [0.0, 0.02, 0.0], (3.0, -2.0, 0.0))
    t = 0.004 * np.arange(1, 1001)
    np.testing.assert_allclose(flown[:, 3], 3.0 * np.exp(-0.05 * t / 0.044), rtol=1e-8, atol=1e-12)
    np.testing.assert_allclose(flown[:, 4], -2.0 / (1 + 2.0 * 0.02 * t / 0.044), rtol=1e-8)
    np.testing.assert_allclose(flown[:, 5], -9.81 * t, rtol=1e-9)
    assert np.all(np.diff(np.abs(flown[:, 3])) <= 0)
    # At the rotors' centre, which is the centre of gravity here: no torque.
    np.testing.assert_allclose(helpers.part(flown, "body_rate"), 0, atol=1e-12)


def test_mapping_round_trip():
    drag = ParasiticDrag(linear=[0.1, 0.2, 0.3], quadratic=0.01)
    again = effect_from_mapping(effect_to_mapping(drag), "here")
    jax.tree.map(np.testing.assert_array_equal, again, drag)
    partial = effect_from_mapping({"name": "parasitic_drag", "parameters": {"linear": 0.1}}, "here")
    np.testing.assert_array_equal(partial.quadratic, 0)
    np.testing.assert_array_equal(partial.linear, jnp.full(3, 0.1))


@pytest.mark.parametrize(
    ("item", "word"),
    [
        ({"name": "warp_drive"}, "warp_drive"),
        ({"name": ["parasitic_drag"]}, "parasitic_drag"),
        ({"name": "parasitic_drag", "parameter": {}}, "parameter"),
        ({"name": "parasitic_drag", "parameters": {"cubic": 1.0}}, "cubic"),
        ({"name": "parasitic_drag", "parameters": {"linear": float("nan")}}, "linear"),
        ({"name": "parasitic_drag", "parameters": {"linear": "strong"}}, "linear"),
        ({"name": "parasitic_drag", "parameters": {"linear": [1.0, 2.0]}}, "linear"),
        ({"name": "parasitic_drag", "parameters": {"linear": None}}, "linear"),
        ({"name": "parasitic_drag", "parameters": 3}, "parameters"),
    ],
)
def test_unusable_mappings_are_refused_with_file_and_key(item, word):
    with pytest.raises(CfbError, match=r"drone\.yaml") as caught:
        effect_from_mapping(item, "drone.yaml")
    assert word in str(caught.value)
