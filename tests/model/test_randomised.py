"""Drones drawn whole: parameters and effects, from ranges and from the spread that a model's numbers have."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cfb_mjx.errors import CfbError
from cfb_mjx.model import Quadrotor, require_possible, rollout_final, sample_drone
from cfb_mjx.model.effects import Gust, RotorDrag, Wind
from cfb_mjx.model.randomised import differences
from cfb_mjx.parameters import (
    Randomisation,
    load_model_file,
    load_randomisation,
    sample_parameters,
    save_model_file,
)
from cfb_mjx.parameters.model_file import Entry

COUNT = 4000


@pytest.fixture(scope="module")
def of_type(tmp_path_factory):
    """A type of drone whose drag, hub moment and motors differ from drone to drone, written and read again."""
    file = load_model_file("cfb")
    gain = file.entries["motor_gain"]
    entry = Entry(gain.value, gain.source, spread=0.02 * gain.value)
    effects = (
        {"name": "rotor_drag", "parameters": {"coefficient": 0.015}, "spread": {"coefficient": 0.002}},
        {
            "name": "blade_flapping",
            "parameters": {"coefficient": -6e-4, "climb": [-0.2, 0.0], "anisotropy": 0.1, "power": 1.0},
            "spread": {"coefficient": 5e-5, "climb": [0.1, 0.0]},
        },
    )
    path = tmp_path_factory.mktemp("type") / "type.yaml"
    save_model_file(replace(file, name="mine", entries={**file.entries, "motor_gain": entry}, effects=effects), path)
    return path


@pytest.fixture(scope="module")
def nominal(of_type):
    return Quadrotor.from_file(load_model_file(of_type))


@pytest.fixture(scope="module")
def drawn(of_type, nominal):
    ranges = load_randomisation(of_type)
    keys = jax.random.split(jax.random.key(0), COUNT)
    return jax.jit(jax.vmap(lambda key: sample_drone(key, nominal, ranges)))(keys)


def test_drones_differ_by_the_spread(drawn, nominal):
    drag, hub = drawn.effects
    mean, std = float(nominal.effects[0].coefficient), 0.002
    assert np.mean(drag.coefficient) == pytest.approx(mean, abs=4 * std / np.sqrt(COUNT))
    assert np.std(drag.coefficient) == pytest.approx(std, rel=0.05)
    assert np.std(hub.climb, axis=0) == pytest.approx([0.1, 0.0], rel=0.05)
    assert np.ptp(hub.power) == 0
    gain = np.asarray(drawn.parameters.motor_gain)
    assert gain.std(axis=0) / gain.mean(axis=0) == pytest.approx([0.02] * 4, rel=0.05)
    # One number says nothing of another, nor one motor of the next.
    table = np.column_stack([drag.coefficient, hub.coefficient, hub.climb[:, 0], gain])
    assert np.abs(np.corrcoef(table.T) - np.eye(7)).max() < 5 / np.sqrt(COUNT)


def test_a_key_is_a_drone_and_another_range_changes_no_other_draw(of_type, nominal):
    ranges, key = load_randomisation(of_type), jax.random.key(3)
    one = sample_drone(key, nominal, ranges)
    again = sample_drone(key, nominal, replace(ranges, effects=ranges.effects[:1]))
    assert float(one.effects[0].coefficient) == float(again.effects[0].coefficient)
    assert float(again.effects[1].coefficient) == float(nominal.effects[1].coefficient)
    jax.tree.map(np.testing.assert_array_equal, one, sample_drone(key, nominal, ranges))
    still = sample_drone(key, nominal, ranges, 0.0)
    jax.tree.map(np.testing.assert_array_equal, still, nominal)


def test_drawn_drones_fly_side_by_side_as_they_fly_alone(of_type, nominal):
    ranges, keys = load_randomisation(of_type), jax.random.split(jax.random.key(1), 3)
    commands = jnp.tile(nominal.hover_command() * 1.02, (50, 1))
    state = nominal.hover_state()

    def fly(key):
        return rollout_final(sample_drone(key, nominal, ranges), state, commands).position

    together = jax.jit(jax.vmap(fly))(keys)
    alone = jnp.stack([fly(key) for key in keys])
    np.testing.assert_allclose(together, alone, rtol=1e-5, atol=1e-7)
    assert np.ptp(np.asarray(together)[:, 2]) > 1e-4


def test_differences_count_in_half_widths(of_type, nominal, drawn):
    ranges = load_randomisation(of_type)
    found = np.asarray(jax.vmap(lambda drone: differences(nominal, drone, ranges))(drawn))
    assert found.shape == (COUNT, 4 + 1 + 1 + 2)
    assert np.all(np.abs(found) <= 1 + 1e-9)
    assert found[:, :-1].std(axis=0) == pytest.approx(np.full(7, 1 / np.sqrt(3)), rel=0.05)
    assert np.all(found[:, -1] == 0)
    shared = load_randomisation("paper")
    drone = sample_drone(jax.random.key(2), nominal, shared)
    change = float(drone.parameters.motor_gain[0] / nominal.parameters.motor_gain[0] - 1) / 0.2
    assert np.isclose(np.asarray(differences(nominal, drone, shared)), change).sum() == 1


def test_parameters_alone_draw_as_before(nominal):
    paper, key = load_randomisation("paper"), jax.random.key(5)
    drone = sample_drone(key, nominal, paper)
    expected = sample_parameters(key, nominal.parameters, paper)
    jax.tree.map(np.testing.assert_array_equal, drone.parameters, expected)


def test_impossible_or_meaningless_ranges_are_refused(of_type, nominal):
    ranges = load_randomisation(of_type)
    bare = Quadrotor.from_file("cfb")
    with pytest.raises(CfbError, match="varies rotor_drag, which this drone does not have; add it to the model"):
        sample_drone(jax.random.key(0), bare, ranges)
    with pytest.raises(CfbError, match="varies effects, which are not parameters; draw with sample_drone"):
        sample_parameters(jax.random.key(0), nominal.parameters, ranges)
    with pytest.raises(CfbError, match=r"--magnitude = 40: randomisation 'mine' could then draw"):
        require_possible(nominal, ranges, 40.0, "--magnitude")
    effect, field, spread = ranges.effects[0]
    wide = Randomisation("wide", (), ((effect, field, replace(spread, half_width=(0.03,))),))
    with pytest.raises(CfbError, match=r"rotor_drag.coefficient outside .* at most 0.\d+ fits"):
        sample_drone(jax.random.key(0), nominal, wide)
    lost = jax.jit(lambda magnitude: sample_drone(jax.random.key(0), nominal, wide, magnitude))(-100.0)
    assert np.isnan(lost.effects[0].coefficient)
    with pytest.raises(CfbError, match="model cfb: no number has a spread between drones"):
        load_randomisation("cfb")


@pytest.fixture
def windy(tmp_path):
    path = tmp_path / "windy.yaml"
    path.write_text(
        "format: cfb_mjx randomisation 1\nname: windy\n"
        "ranges: {mass: {half_width: 0.1, unit: relative}}\n"
        "effects:\n  wind: {velocity: {half_width: [2.0, 2.0, 0.5], unit: m/s}}\n"
        "  rotor_drag: {coefficient: {half_width: 0.5, unit: relative}}\n"
        "  gust: {seed: {half_width: 40, unit: '1'}}\n"
    )
    return path


def test_a_file_varies_effects(windy):
    ranges = load_randomisation(windy)
    drone = Quadrotor(
        load_model_file("cfb-guards").parameters(),
        (Wind([0.0, 0.0, 0.0], 0.0), RotorDrag(0.02), Gust([0.5, 0.5, 0.2], 1.0, 50.0)),
    )
    drones = jax.vmap(lambda key: sample_drone(key, drone, ranges))(jax.random.split(jax.random.key(1), 1000))
    wind, drag, gust = drones.effects
    for values, center, width in (
        (wind.velocity, np.zeros(3), np.array([2.0, 2.0, 0.5])),
        (drag.coefficient[:, None], 0.02, 0.01),
        (gust.seed[:, None], 50.0, 40.0),
    ):
        share = (np.asarray(values) - center) / width
        assert np.all(np.abs(share) <= 1 + 1e-9)
        assert np.all(share.max(axis=0) > 0.95)
        assert np.all(share.min(axis=0) < -0.95)
    shares = np.asarray(jax.vmap(lambda one: differences(drone, one, ranges))(drones))
    assert shares.shape == (1000, 1 + 3 + 1 + 1)
    np.testing.assert_allclose(shares.std(axis=0), 1 / np.sqrt(3), rtol=0.05)


@pytest.mark.parametrize(
    ("was", "now", "word"),
    [
        ("unit: m/s", "unit: km/h", "wind.velocity.unit must be 'relative' or 'm/s', found 'km/h'"),
        ("velocity:", "speed:", "wind has no field speed; it has velocity, conductance, felt"),
        ("[2.0, 2.0, 0.5]", "[2.0, 2.0]", r"wind.velocity.half_width must have 1 or 3 numbers"),
        ("  wind:", "  drag:", "varies drag, which this drone does not have"),
        ("half_width: 40", "half_width: -1", "effects.gust.seed.half_width = -1 must be zero or positive"),
        (", unit: m/s", "", "effects.wind.velocity.unit must be 'relative' or the field's unit"),
        ("unit: m/s", "unit: m/s, shared: true", "unknown key 'effects.wind.velocity.shared'"),
        ("  gust: {seed: {half_width: 40, unit: '1'}}", "  gust: 3", "'effects' must be a mapping of effects"),
    ],
)
def test_a_file_that_varies_effects_wrongly_is_refused(windy, was, now, word):
    text = windy.read_text()
    assert was in text
    windy.write_text(text.replace(was, now, 1))
    effects = (Wind([0.0, 0.0, 0.0], 0.0), RotorDrag(0.02), Gust([0.5, 0.5, 0.2], 1.0, 50.0))
    drone = Quadrotor(load_model_file("cfb-guards").parameters(), effects)
    with pytest.raises(CfbError, match=word):
        sample_drone(jax.random.key(0), drone, load_randomisation(windy))


def test_the_shipped_type_draws_drones_that_fly():
    nominal, ranges = Quadrotor.from_file("cfb-fleet"), load_randomisation("cfb-fleet")
    require_possible(nominal, ranges)
    keys = jax.random.split(jax.random.key(4), 500)
    drones = jax.jit(jax.vmap(lambda key: sample_drone(key, nominal, ranges)))(keys)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(drones))
    effects = {type(effect).name: effect for effect in drones.effects}
    assert np.all(np.asarray(effects["blade_flapping"].coefficient) < 0)
    assert np.all(np.asarray(effects["rotor_drag"].coefficient) > 0)
    hover = np.asarray(jax.vmap(lambda drone: drone.hover_command())(drones))
    assert np.all((hover > 0.2) & (hover < 0.9))
    assert np.ptp(hover.mean(axis=1)) > 0.02
    assert np.ptp(np.asarray(effects["cog_offset"].offset), axis=0).min() > 1e-5


def test_a_spread_about_zero_is_drawn_in_the_numbers_own_unit(tmp_path):
    file = load_model_file("cfb")
    place = Entry(np.zeros(3), "by symmetry", spread=np.array([1e-3, 1e-3, 0.0]))
    save_model_file(replace(file, entries={**file.entries, "center_of_gravity": place}), tmp_path / "type.yaml")
    ((name, spread),) = load_randomisation(tmp_path / "type.yaml").ranges
    assert (name, spread.relative) == ("center_of_gravity", False)
    assert spread.half_width == pytest.approx((np.sqrt(3) * 1e-3, np.sqrt(3) * 1e-3, 0.0))


@pytest.mark.parametrize(
    ("spread", "complaint"),
    [
        ({"coefficient": "wide"}, r"effects\.rotor_drag\.spread\.coefficient = 'wide' must be 1 finite"),
        ({"coefficient": -0.1}, r"spread\.coefficient = -0\.1 must be 1 finite number\(s\), zero or positive"),
        ({"coefficient": [0.1, 0.2]}, r"spread\.coefficient = \[0\.1, 0\.2\] must be 1 finite"),
        ({"coeficient": 0.1}, r"unknown key 'effects\.rotor_drag\.spread\.coeficient'"),
        (0.1, r"effects\.rotor_drag\.spread must be a mapping, found 0\.1"),
    ],
)
def test_a_spread_that_is_none_is_refused_with_its_place(of_type, spread, complaint):
    file = load_model_file(of_type)
    effects = ({"name": "rotor_drag", "parameters": {"coefficient": 0.015}, "spread": spread},)
    with pytest.raises(CfbError, match=complaint):
        Quadrotor.from_file(replace(file, effects=effects))


def test_a_declared_effect_may_leave_out_what_is_neutral(of_type):
    """Its spread too: what is left out does not differ from drone to drone."""
    file = load_model_file(of_type)
    effects = ({"name": "blade_flapping", "parameters": {"coefficient": -6e-4}, "spread": {"coefficient": 5e-5}},)
    nominal = Quadrotor.from_file(replace(file, effects=effects))
    assert nominal.effects[0].power == type(nominal.effects[0]).neutral().power
