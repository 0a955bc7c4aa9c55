"""Every number has one declared range: beyond the hard limits it is refused by name, wherever it comes from."""

from __future__ import annotations

import dataclasses
import re
import warnings
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from cfb_mjx.envs import TargetTask
from cfb_mjx.envs.episode import reset
from cfb_mjx.errors import CfbError, CfbWarning
from cfb_mjx.model import Quadrotor, rollout, step
from cfb_mjx.model.effects import KNOWN, Payload, PayloadSwing, RotorDrag, effect_from_mapping, effect_to_mapping
from cfb_mjx.parameters import (
    SPECIFICATIONS,
    Limits,
    Parameters,
    Randomisation,
    load_model_file,
    load_randomisation,
    preset_names,
    require_possible,
    sample_parameters,
    save_model_file,
)
from cfb_mjx.parameters.randomisation import Range
from cfb_mjx.sysid.identification.result import Fit
from cfb_mjx.sysid.refinement import free_numbers, plausible_numbers
from cfb_mjx.sysid.sensor_faults import ATTRIBUTES, LIMITS, SensorFaults
from cfb_mjx.sysid.tracing.hypothesis import bounds
from cfb_mjx.train.config import load_config
from cfb_mjx.train.flying import load_plants
from cfb_mjx.train.run import Training

GUARDS = load_model_file("cfb-guards")
NOMINAL = GUARDS.parameters()
MODEL = Quadrotor(NOMINAL)
FIELDS = [(name, field.name) for name, kind in sorted(KNOWN.items()) for field in dataclasses.fields(kind)]
QUICK = settings(max_examples=20, deadline=None, derandomize=True)


def beyond(limits: Limits) -> st.SearchStrategy[float]:
    """Numbers outside the hard limits by more than rounding, and those that are none."""
    clear = 1e-3 * max(abs(limits.hard_low), abs(limits.hard_high))
    below = st.floats(max_value=limits.hard_low - clear, allow_infinity=False)
    above = st.floats(min_value=limits.hard_high + clear, allow_infinity=False)
    return below | above | st.sampled_from([-1e300, 1e300])


def inside(low: float, high: float) -> st.SearchStrategy[float]:
    return st.floats(low, high)


def refused(act, *needles: str) -> None:
    with pytest.raises(CfbError) as caught:
        act()
    assert "\n" not in str(caught.value)
    for needle in needles:
        assert needle in str(caught.value)


def spoilt(key: str, number: float, component: int) -> np.ndarray:
    """The preset's value with one component replaced."""
    value = GUARDS.entries[key].value.copy()
    value.reshape(-1)[component % value.size] = number
    return value


@pytest.mark.parametrize("key", SPECIFICATIONS)
def test_a_parameter_that_cannot_be_is_refused_by_name(key, tmp_path_factory):
    folder = tmp_path_factory.mktemp("models")

    @QUICK
    @given(number=beyond(SPECIFICATIONS[key].limits), component=st.integers(0, 3))
    def check(number, component):
        value = spoilt(key, number, component)
        changed = replace(GUARDS.entries[key], value=value)
        save_model_file(replace(GUARDS, entries={**GUARDS.entries, key: changed}), folder / "drone.yaml")
        refused(lambda: load_model_file(folder / "drone.yaml"), "drone.yaml", f"parameters.{key}", "must")
        text = ",".join(map(repr, np.atleast_1d(value).tolist()))
        refused(lambda: load_model_file("cfb-guards", [f"{key}={text}"]), f"parameters.{key}", "must")
        fields = {name: getattr(NOMINAL, name) for name in SPECIFICATIONS}
        refused(lambda: Parameters(**fields | {key: value}), f"parameters.{key}")

    check()


@pytest.mark.parametrize("key", SPECIFICATIONS)
def test_a_parameter_that_can_be_is_taken_and_survives(key, tmp_path_factory):
    path, specification = tmp_path_factory.mktemp("models") / "drone.yaml", SPECIFICATIONS[key]
    limits = specification.limits
    shape = specification.shape or (1,)

    @QUICK
    @given(numbers=st.lists(inside(limits.hard_low, limits.hard_high), min_size=shape[0], max_size=shape[0]))
    def check(numbers):
        value = np.array(numbers) if specification.shape else np.array(numbers[0])
        assume(specification.together is None or specification.together(value))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", CfbWarning)
            save_model_file(GUARDS.with_values("a test", **{key: value}), path)
            read = load_model_file(path)
        np.testing.assert_array_equal(read.entries[key].value, value)
        np.testing.assert_array_equal(np.asarray(getattr(read.parameters(), key)), value)

    check()


@pytest.mark.parametrize("key", SPECIFICATIONS)
def test_what_is_unusual_is_warned_of_by_name_and_what_is_usual_is_not(key):
    limits = SPECIFICATIONS[key].limits
    for hard, soft in ((limits.hard_low, limits.soft_low), (limits.hard_high, limits.soft_high)):
        if hard == soft:
            continue
        with pytest.warns(CfbWarning, match=rf"model cfb-guards: parameters\.{key}.* unusual"):
            SPECIFICATIONS[key].limits.check((hard + soft) / 2, f"model cfb-guards: parameters.{key}", "1", warn=True)
        limits.check(soft, key, "1", warn=True)


@pytest.mark.parametrize(("name", "field"), FIELDS)
def test_every_number_of_every_effect_has_limits(name, field):
    """A new field without limits is an error: effects in files would go unchecked."""
    kind = KNOWN[name]
    limits, neutral = kind.limits[field], np.asarray(getattr(kind.neutral(), field))
    assert limits.usual(neutral).all(), "neutral must be usual"
    low, high = kind.prior[field]
    assert limits.soft_low <= low < high <= limits.soft_high, "a search must not look where values are unusual"
    assert all(limits.holds(bound) for bound in bounds(name, field)), "a search must not end where a file is refused"
    assert set(kind.limits) == set(kind.units)


@pytest.mark.parametrize(("name", "field"), FIELDS)
def test_a_number_of_an_effect_that_cannot_be_is_refused_by_name(name, field, tmp_path_factory):
    kind, path = KNOWN[name], tmp_path_factory.mktemp("models") / "drone.yaml"
    shape = getattr(kind.neutral(), field).shape

    @QUICK
    @given(number=beyond(kind.limits[field]), component=st.integers(0, 10))
    def check(number, component):
        value = np.array(getattr(kind.neutral(), field))
        value.reshape(-1)[component % value.size] = number
        item = {"name": name, "parameters": {field: value.tolist()}}
        refused(lambda: effect_from_mapping(item, "drone.yaml"), "drone.yaml", f"effects.{name}.parameters.{field}")
        save_model_file(replace(GUARDS, effects=(item,)), path)
        read = load_model_file(path)  # as the commands do: first the file, then the drone
        refused(lambda: Quadrotor.from_file(read), "drone.yaml", f"effects.{name}.parameters.{field}")
        values = {f.name: getattr(kind.neutral(), f.name) for f in dataclasses.fields(kind)}
        refused(lambda: kind(**values | {field: jnp.broadcast_to(number, shape)}), f"{name}.{field}")

    check()


@pytest.mark.parametrize(("name", "field"), FIELDS)
def test_a_number_of_an_effect_that_can_be_is_taken_and_survives(name, field):
    limits, shape = KNOWN[name].limits[field], getattr(KNOWN[name].neutral(), field).shape

    @QUICK
    @given(number=inside(limits.hard_low, limits.hard_high))
    def check(number):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", CfbWarning)
            effect = effect_from_mapping({"name": name, "parameters": {field: number}}, "drone.yaml")
            again = effect_from_mapping(effect_to_mapping(effect), "drone.yaml")
        np.testing.assert_array_equal(getattr(effect, field), np.full(shape, number))
        assert eqx.tree_equal(effect, again)

    check()


@pytest.mark.parametrize(("name", "key"), [(name, key) for name, keys in ATTRIBUTES.items() for key in keys])
def test_sensor_faults_that_cannot_be_are_refused_by_name(name, key):
    first = next(iter(ATTRIBUTES[name]))

    @QUICK
    @given(number=beyond(LIMITS[ATTRIBUTES[name][key]]))
    def check(number):
        item = {"name": name, "parameters": {first: 1.0} | {key: number}}
        refused(
            lambda: SensorFaults.from_mappings([item], "drone.yaml"), f"drone.yaml: effects.{name}.parameters.{key}"
        )

    check()


def test_the_page_says_what_may_be():
    page = (Path(__file__).resolve().parents[2] / "docs" / "model.md").read_text()
    for key, specification in SPECIFICATIONS.items():
        unit, limits = specification.unit, specification.limits
        spans = f"{limits.hard_low:g} to {limits.hard_high:g} | {limits.soft_low:g} to {limits.soft_high:g}"
        assert f"| `{key}` | {unit} | {spans} |" in page
    named = re.sub(r"\s+", " ", page)
    assert f'`cfb_mjx.model.effects.KNOWN["payload"].limits["mass"]` is `{KNOWN["payload"].limits["mass"]}`' in named


def test_values_of_the_issue_are_refused():
    """Each of these was flown."""
    for item in (
        {"name": "payload", "parameters": {"mass": -0.044}},
        {"name": "payload_swing", "parameters": {"length": 0.0}},
        {"name": "battery_sag", "parameters": {"lag": 0.0}},
        {"name": "command_delay", "parameters": {"delay": 100.0}},
        {"name": "wind", "parameters": {"velocity": [1e300, 0.0, 0.0]}},
    ):
        refused(lambda item=item: Quadrotor.from_file(replace(GUARDS, effects=(item,))), f"effects.{item['name']}")
    refused(lambda: GUARDS.with_values("scales", mass=1000.0), "parameters.mass")


def test_grams_are_recognised():
    refused(lambda: load_model_file("cfb-guards", ["mass=38.5"]), "parameters.mass = 38.5", "in kg, 38.5 g is 0.0385")
    refused(lambda: GUARDS.with_values("a table", motor_gain=22206.0), "22206 rpm is 2325.41")
    refused(lambda: PayloadSwing(mass=5.0, length=0.2), "in kg, 5 g is 0.005")


def test_what_laboratories_do_is_usual():
    """None of these says a word (warnings are errors)."""
    for mass in (0.027, 0.0385, 0.15):
        GUARDS.with_values("scales", mass=mass, center_of_gravity=[0.02, -0.02, 0.02], observation_delay=0.05)
    for item in (
        {"name": "payload", "parameters": {"mass": 0.044 / 3, "height": -0.05, "offset": [0.03, -0.03]}},
        {"name": "payload_swing", "parameters": {"mass": 0.044 / 3, "length": 1.5}},
        {"name": "cog_offset", "parameters": {"offset": [-0.02, 0.02]}},
        {"name": "wind", "parameters": {"velocity": [8.0, 0.0, -1.0]}},
        {"name": "command_delay", "parameters": {"delay": 0.03}},
    ):
        Quadrotor.from_file(replace(GUARDS, effects=(item,)))


@pytest.mark.parametrize("name", preset_names())
def test_presets_say_nothing(name):
    Quadrotor.from_file(name)
    SensorFaults.from_mappings(load_model_file(name).effects, name)


def test_shipped_plants_say_nothing():
    assert load_plants(GUARDS)


def test_a_plant_that_cannot_be_is_refused_with_its_file(tmp_path):
    text = (
        "format: cfb_mjx plants 1\nplants: [{name: late, effects: [{name: command_delay, parameters: {delay: 4}}]}]\n"
    )
    (tmp_path / "fleet.yaml").write_text(text)
    named = "fleet.yaml: plant late: effects.command_delay.parameters.delay = 4", "4 ms is 0.004"
    refused(lambda: load_plants(GUARDS, tmp_path / "fleet.yaml"), *named)


def test_no_fit_may_look_where_a_file_is_refused():
    physics = [name for name in KNOWN if name != "regression_dilution"]
    for number in (*plausible_numbers(NOMINAL, physics), *free_numbers(tuple(KNOWN))):
        limits = KNOWN[number.effect].limits[number.field]
        assert limits.holds(number.low), number
        assert limits.holds(number.high), number


def test_traced_numbers_pass_every_constructor():
    lifted = jax.jit(lambda mass: Payload(mass=mass, height=0.0).mass)(-1.0)
    assert lifted == -1.0
    slopes = jax.vmap(jax.grad(lambda c: RotorDrag(coefficient=c).coefficient))(jnp.array([0.1, 20.0]))
    np.testing.assert_array_equal(slopes, 1.0)


# Contradictions: numbers that each can be, and together cannot.


def test_an_inertia_that_effects_make_impossible_is_refused():
    item = {"name": "inertia", "parameters": {"relative": [0.0, 0.0, 1.0]}}
    refused(
        lambda: Quadrotor.from_file(replace(GUARDS, effects=(item,))),
        "cfb-guards",
        "inertia",
        "impossible for a rigid body",
    )
    with pytest.warns(CfbWarning, match="impossible for a rigid body"):  # an estimate errs, and comes with how much
        Quadrotor.from_file(replace(GUARDS, effects=(item | {"uncertainty": {"relative": [0.1, 0.1, 0.9]}},)))
    Quadrotor.from_file(replace(GUARDS, effects=(item,), kind="predictor"))


def test_a_drone_that_cannot_hover_is_warned_of():
    """Four rotors at full command lift 4 (0.562 - 0.23 - 0.043) N = 1.156 N, the weight of 117.8 g."""
    Quadrotor.from_file(GUARDS.with_values("scales", mass=0.1178))
    with pytest.warns(CfbWarning, match="cannot hover"):
        Quadrotor.from_file(GUARDS.with_values("scales", mass=0.1179))
    item = {"name": "payload", "parameters": {"mass": 0.05}}
    loaded = replace(GUARDS.with_values("scales", mass=0.07), effects=(item,))
    with pytest.warns(CfbWarning, match=r"cannot hover.*1\.18 N.*1\.16 N"):
        Quadrotor.from_file(loaded)


# Randomisation.


@pytest.mark.parametrize("key", SPECIFICATIONS)
def test_ranges_are_refused_exactly_where_a_draw_could_leave_what_can_be(key):
    keys = jax.random.split(jax.random.key(0), 50)
    specification, center = SPECIFICATIONS[key], np.asarray(getattr(NOMINAL, key))
    free = specification.limits.hard_low < 0 and specification.together is None

    @settings(max_examples=6, deadline=None, derandomize=True)
    @given(width=st.floats(0.01, 0.99), relative=st.booleans(), magnitude=st.floats(0.1, 30.0))
    def check(width, relative, magnitude):
        relative = relative or not free
        width = width if relative else width * specification.limits.hard_high
        spread = Randomisation("mine", ((key, Range((width,), relative, False)),))
        reach = magnitude * width * (np.abs(center) if relative else 1.0)
        can = all(specification.limits.holds(center + side * reach).all() for side in (-1, 1))
        if key in ("thrust_polynomial", "torque_polynomial"):
            can = can and (center - reach).sum() > 0
        if not can:
            refused(lambda: sample_parameters(keys[0], NOMINAL, spread, magnitude), key, "mine", "at most")
            return
        value = jax.vmap(lambda k: getattr(sample_parameters(k, NOMINAL, spread, magnitude), key))(keys)
        assert np.isfinite(value).all()
        assert specification.limits.holds(np.asarray(value)).all()

    check()


def test_the_largest_magnitude_that_fits_is_named_and_fits():
    with pytest.raises(CfbError, match=r"magnitude = 6: randomisation 'paper'.*at most (\S+) fits") as caught:
        sample_parameters(jax.random.key(0), NOMINAL, magnitude=6.0)
    most = float(str(caught.value).split("at most ")[1].split()[0])
    paper = load_randomisation("paper")
    require_possible(NOMINAL, paper, most)
    refused(lambda: require_possible(NOMINAL, paper, most + 0.002, "--magnitude"), "--magnitude = ")
    keys = jax.random.split(jax.random.key(1), 2000)
    drawn = jax.vmap(lambda key: sample_parameters(key, NOMINAL, paper, most))(keys)
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(drawn))
    assert (drawn.thrust_scale >= 0).all()


def test_a_traced_magnitude_never_yields_an_impossible_drone():
    """Nothing can be refused there: what could not be is NaN, all else as it would have been."""
    sample = jax.jit(jax.vmap(lambda key, magnitude: sample_parameters(key, NOMINAL, None, magnitude), (0, None)))
    drawn = sample(jax.random.split(jax.random.key(2), 500), 6.0)
    lost = np.isnan(drawn.thrust_scale)
    assert 0.05 < lost.mean() < 0.2  # below -1 / 1.2 of a draw uniform from -1 to 1: a twelfth
    assert (np.asarray(drawn.thrust_scale)[~lost] >= 0).all()
    assert np.isfinite(drawn.mass).all()
    assert np.isfinite(sample(jax.random.split(jax.random.key(2), 500), 1.0).thrust_scale).all()


def test_a_training_whose_ranges_allow_impossible_drones_is_refused():
    config = load_config("target", ("randomisation.magnitude=6",))
    refused(lambda: Training.prepare(config, {}), "randomisation.magnitude = 6", "at most")


# Fits.


def test_a_fit_that_ends_where_nothing_can_be_is_refused_before_it_is_written():
    def fitted(**values):
        drone = eqx.tree_at(
            lambda p: [getattr(p, key) for key in values], NOMINAL, list(map(jnp.asarray, values.values()))
        )
        return Fit.model_file(SimpleNamespace(names=tuple(values), estimates={}, parameters=drone), GUARDS, "a fit")

    refused(lambda: fitted(mass=2e5), "the fit's parameters.mass = 200000", "--parameters")
    refused(lambda: fitted(pose_delay=-0.002), "the fit's parameters.pose_delay = -0.002")
    with pytest.warns(CfbWarning, match=r"the fit's parameters\.mass = 0\.3 is unusual"):
        fitted(mass=0.3)
    assert fitted(mass=0.05).entries["mass"].value == 0.05


def test_an_episode_is_refused_whatever_grade_its_key_would_draw():
    wild = TargetTask(randomisation=load_randomisation("paper"), magnitude=6.0, graded=1.0)
    for seed in range(5):
        refused(lambda seed=seed: reset(wild, MODEL, jax.random.PRNGKey(seed)), "magnitude = 6", "at most")
    refused(
        lambda: jax.jit(jax.vmap(partial(reset, wild, MODEL)))(jax.random.split(jax.random.PRNGKey(0), 2)), "at most"
    )


def test_gymnasium_refuses_ranges_that_allow_impossible_drones():
    gym = pytest.importorskip("cfb_mjx.envs.gym", exc_type=CfbError)
    wild = TargetTask(randomisation=load_randomisation("paper"), magnitude=6.0)
    refused(lambda: gym.TargetVectorEnv(2, wild), "magnitude = 6", "at most")


# Parameters put into a model behind the constructor's back.

ENTRIES = {
    "rollout": lambda model: rollout(model, MODEL.hover_state(), jnp.zeros((2, 4))),
    "step": lambda model: step(model, MODEL.hover_state(), jnp.zeros(4)),
    "hover_state": lambda model: model.hover_state(),
    "hover_command": lambda model: model.hover_command(),
}


@pytest.mark.parametrize("entry", ENTRIES)
def test_what_is_no_array_is_refused_where_the_model_is_first_used(entry):
    number = eqx.tree_at(lambda m: m.parameters.mass, MODEL, 0.045)
    refused(lambda: ENTRIES[entry](number), "parameters.mass = 0.045 is a float", "jnp.asarray")
    listed = eqx.tree_at(lambda m: m.parameters.inertia, MODEL, [1e-5] * 3)
    refused(lambda: ENTRIES[entry](listed), "parameters.inertia")
    short = eqx.tree_at(lambda m: m.parameters.inertia, MODEL, jnp.ones(2))
    refused(lambda: ENTRIES[entry](short), "parameters.inertia has shape (2,); it must be (3,)")
    dragged = eqx.tree_at(lambda m: m.effects, MODEL, (RotorDrag(coefficient=0.01),))
    dragged = eqx.tree_at(lambda m: m.effects[0].coefficient, dragged, 0.02)
    refused(lambda: ENTRIES[entry](dragged), "rotor_drag.coefficient = 0.02 is not an array")


def test_a_batch_of_drones_without_vmap_is_refused():
    many = eqx.tree_at(lambda m: m.parameters.mass, MODEL, jnp.full(3, 0.045))
    refused(lambda: ENTRIES["rollout"](many), "parameters.mass has shape (3,)", "jax.vmap")
