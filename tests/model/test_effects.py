"""What holds for every effect: neutral vanishes, derivatives exist, batches and steps agree, mappings survive."""

from __future__ import annotations

import dataclasses
import functools
import re
from dataclasses import replace
from pathlib import Path

import helpers
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from cfb_mjx.errors import CfbError
from cfb_mjx.model import CATALOGUE, Effect, ParasiticDrag, Quadrotor, State, begin, rollout, specific_force, step
from cfb_mjx.model.effects import (
    PayloadSwing,
    Reading,
    RegressionDilution,
    ResidualFormula,
    RotorDrag,
    effect_from_mapping,
    effect_to_mapping,
    overrides,
)
from cfb_mjx.model.effects.formula import TERMS
from cfb_mjx.model.quadrotor import advance, prepare, remembering
from cfb_mjx.model.state import unstack
from cfb_mjx.model.vector import Vec
from cfb_mjx.parameters import load_model_file

AIR_ONLY, DRAG = ("gust", "jet"), 0.03
ABOVE = [0.03, 0.02, 1.4, 0.2, *[0.0] * 14, 0.3, 0.0, -3.1, 0.1, *[0.0] * 14]
"""Another drone, as the memory of `Downwash` holds it, above where the flights begin."""
STEP = 1e-5
"""Of the difference quotients, as a share of the prior's width."""
INSIDE = (0.7, 0.4, 0.6, 0.8)
"""Shares of the prior at which effects are strong, component by component."""
# They share what one worker compiled.
ONE_WORKER = pytest.mark.xdist_group("effects")


def _one(model):
    return jax.tree.map(lambda x: x[None], model)


def _at(name: str, place: tuple[float, ...]) -> Effect:
    """The effect with every field at these shares of its prior, components in turn."""
    kind = CATALOGUE[name]
    values = {}
    for key, (low, high) in kind.prior.items():
        shape = getattr(kind.neutral(), key).shape
        values[key] = low + (high - low) * np.resize(place, shape)
    if name == "jet":
        # Towards where the drones fly, or they would not feel it.
        values["origin"] = [-0.5, -0.2, 0.9] + 0.05 * values["origin"]
        values["direction"] = [1.0, 0.3, 0.1] + 0.1 * values["direction"]
    return kind(**values)


def _direction(name: str) -> Effect:
    """Over every prior's width, components unlike each other."""
    there, here = _at(name, (1.0, 0.4, 0.8, 0.6)), _at(name, (0.0,))
    if name == "gust":
        # No quantity: waves by the dozen turn as it grows.
        there = replace(there, seed=here.seed)
    return jax.tree.map(lambda b, a: b - a, there, here)


def _moved(effect: Effect, by: Effect, share: float) -> Effect:
    return jax.tree.map(lambda x, d: x + share * d, effect, by)


@pytest.mark.parametrize("name", sorted(CATALOGUE))
def test_every_effect_describes_itself(name):
    kind = CATALOGUE[name]
    neutral = kind.neutral()
    fields = {field.name for field in dataclasses.fields(neutral)}
    assert kind.name == name
    assert set(kind.units) == fields == set(kind.prior)
    assert kind.source
    assert all(low < high for low, high in kind.prior.values())
    assert isinstance(neutral, Effect)
    assert kind.strengths
    assert set(kind.strengths) <= fields
    for strength in kind.strengths:
        np.testing.assert_array_equal(getattr(neutral, strength), 0)
        assert kind.prior[strength][0] <= 0 <= kind.prior[strength][1]
    assert kind.probes
    for probe in kind.probes:
        assert set(probe) <= fields - set(kind.strengths)
        assert all(kind.prior[key][0] <= value <= kind.prior[key][1] for key, value in probe.items())


def _sensed(model: Quadrotor, state: State) -> State:
    """The state once a log has told a voltage, a time and another drone: only then do some effects show."""
    memory = [jax.tree.map(Vec.unstack, memory) for memory in begin(model, state).memory]
    told = (jnp.asarray(x, jnp.result_type(float)) for x in (3.9, 6.0))
    reading = Reading(*told, (Vec.unstack(jnp.asarray(ABOVE, jnp.result_type(float))),))
    memory = [effect.sense(each, reading) for effect, each in zip(model.effects, memory, strict=True)]
    memory = jax.tree.map(lambda v: v.stack(), tuple(memory), is_leaf=lambda x: isinstance(x, Vec))
    return dataclasses.replace(state, memory=memory)


@functools.partial(jax.jit, compiler_options=helpers.QUICK_COMPILE)
def _study(effects, directions, parameters, state, commands):
    """For a batch of effects: the trajectories, a number that sums each up, and its derivatives in both modes."""

    def summary(effects):
        model = Quadrotor(parameters, effects)
        flown = rollout(model, _sensed(model, state), commands)
        total = 0.0
        for part, weight in zip(helpers.NAMES, (1.0, 0.5, 2.0, 0.1, 1e-3), strict=True):
            last = getattr(flown, part)[-1]
            # Weights unlike each other, or rotors and axes would cancel.
            total += weight * jnp.sum(last * jnp.arange(1.0, 1 + last.size))
        return total, flown

    reverse = jax.vmap(jax.value_and_grad(summary, has_aux=True))(effects)
    forward = jax.vmap(lambda x, d: jax.jvp(summary, (x,), (d,), has_aux=True)[1])(effects, directions)
    return *reverse, forward


@functools.partial(jax.jit, compiler_options=helpers.QUICK_COMPILE)
def _stepped(model, state, commands):
    def one(state, command):
        state = step(model, state, command)
        return state, state

    return jax.lax.scan(one, _sensed(model, state), commands)[1]


@pytest.fixture(scope="module")
def manoeuvre():
    y, commands = helpers.aggressive_manoeuvre(0.1)
    y[5] = -1.0  # some effects show in descent alone
    return helpers.state_of(y), jnp.asarray(commands)


def _alone(effect: Effect) -> tuple[Effect, ...]:
    """Every effect of the catalogue, all but this one neutral: whatever the effect, the same program flies it.

    Beside what does nothing but move the air there is a drag to feel it.
    """
    drag = RotorDrag(DRAG) if effect.name in AIR_ONLY else RotorDrag.neutral()
    given = {type(drag): drag, type(effect): effect}
    return tuple(given.get(type(other), other) for other in _neutrals())


@functools.cache
def _neutrals() -> tuple[Effect, ...]:
    return tuple(kind.neutral() for kind in CATALOGUE.values())


@pytest.fixture(scope="module")
def studied(guards, manoeuvre):
    """What `_study` finds, by name: the effect neutral and neutral moved a little; inside its prior and moved a little
    there and back; then every probe with no strength."""
    effects, directions, rows = [], [], {}
    for name, kind in CATALOGUE.items():
        direction, inside = _direction(name), _at(name, INSIDE)
        # No drone is in a jet by chance.
        neutral = replace(inside, speed=jnp.zeros(())) if name == "jet" else kind.neutral()
        mine = [neutral, _moved(neutral, direction, STEP), inside]
        mine += [_moved(inside, direction, STEP), _moved(inside, direction, -STEP)]
        mine += [dataclasses.replace(neutral, **probe) for probe in kind.probes]
        rows[name] = slice(len(effects), len(effects) + len(mine))
        effects += [_alone(effect) for effect in mine]
        still = jax.tree.map(np.zeros_like, _alone(neutral))
        directions += [tuple(direction if type(x) is kind else x for x in still)] * len(mine)
    batches = [jax.tree.map(lambda *x: np.stack(x), *each) for each in (effects, directions)]
    (value, flown), reverse, forward = _study(*batches, guards, *manoeuvre)
    found = flown, value, reverse, forward
    return {name: jax.tree.map(lambda x, r=r: np.asarray(x[r]), found) for name, r in rows.items()}


@pytest.fixture(scope="module")
def without(guards, manoeuvre, fly_fleet):
    """The same flight without effects, by integrator, and with a drag alone."""
    models = {integrator: Quadrotor(guards, integrator=integrator) for integrator in ("leapfrog", "rk4")}
    models["drag"] = Quadrotor(guards, (RotorDrag(DRAG),))
    return {name: helpers.pack(fly_fleet(_one(model), *manoeuvre))[0] for name, model in models.items()}


@ONE_WORKER
@pytest.mark.parametrize("name", sorted(CATALOGUE))
def test_neutral_effects_change_nothing(name, studied, without):
    flown, plain = helpers.pack(studied[name][0]), without["drag" if name in AIR_ONLY else "leapfrog"]
    for row in (0, *range(5, len(flown))):
        np.testing.assert_allclose(flown[row], plain, rtol=1e-12, atol=1e-12)
    assert np.abs(flown[2] - plain).max() > 1e-6, "the test would not see it"


@ONE_WORKER
def test_all_neutral_effects_change_nothing_with_rk4(guards, manoeuvre, fly_fleet, without):
    flown = helpers.pack(fly_fleet(_one(Quadrotor(guards, _neutrals(), integrator="rk4")), *manoeuvre))[0]
    np.testing.assert_allclose(flown, without["rk4"], rtol=1e-12, atol=1e-12)


@ONE_WORKER
@pytest.mark.parametrize("name", sorted(CATALOGUE))
def test_derivatives_exist_and_agree_with_differences(name, studied):
    _, value, reverse, forward = studied[name]
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(reverse))
    mine = next(effect for effect in reverse if effect.name == name)
    products = jax.tree.map(lambda g, d: np.sum((g * d).reshape(len(g), -1), axis=-1), mine, _direction(name))
    np.testing.assert_allclose(sum(jax.tree.leaves(products)), forward, rtol=1e-8, atol=1e-8)
    # At neutral the quotient is one-sided: a delay or a lag cannot be negative.
    np.testing.assert_allclose(forward[0], (value[1] - value[0]) / STEP, rtol=1e-3, atol=1e-6)
    np.testing.assert_allclose(forward[2], (value[3] - value[4]) / (2 * STEP), rtol=1e-5, atol=1e-6)
    assert abs(forward[0]) > 1e-6, "a search that starts at neutral would not find it"


@ONE_WORKER
@pytest.mark.parametrize("name", sorted(CATALOGUE))
def test_a_batched_rollout_is_every_effect_stepped(name, studied, guards, manoeuvre):
    """Steps alone keep the memory's structure, equal a rollout, and equal it without ``vmap``."""
    alone = _stepped(Quadrotor(guards, _alone(_at(name, INSIDE))), *manoeuvre)
    batched = jax.tree.map(lambda x: x[2], studied[name][0])
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9), alone, batched)


def _flown(parameters, effects) -> np.ndarray:
    """Three long steps without compiling: each effect beside others makes another program."""
    y, commands = helpers.aggressive_manoeuvre(0.1)
    model = Quadrotor(parameters, effects, dt=0.01)
    prepared = prepare(model)
    at = unstack(begin(model, helpers.state_of(y)), prepared.parameters.center_of_gravity)
    for command in commands[::8][:3]:
        at = advance(prepared, at, Vec.unstack(jnp.asarray(command)))
    return np.asarray(jax.tree.leaves(remembering(at, ())))


@pytest.fixture(scope="module")
def strong() -> dict[str, Effect]:
    """Every effect there is, strong."""
    formula = np.random.default_rng(0).uniform(-1e-4, 1e-4, (6, len(TERMS)))
    dilution = RegressionDilution(0.5, 5e-4, 4.0, 3.0, 1.0)
    everything = {name: _at(name, INSIDE) for name in CATALOGUE}
    return everything | {"residual_formula": ResidualFormula(formula, 1e-3), "regression_dilution": dilution}


@ONE_WORKER
@pytest.mark.parametrize("seed", range(3))
def test_the_order_of_all_effects_means_nothing(seed, strong, guards):
    """A list and its reverse: every two effects change places."""
    names = np.random.default_rng(seed).permutation(sorted(strong))
    there, back = (_flown(guards, tuple(strong[name] for name in order)) for order in (names, names[::-1]))
    np.testing.assert_allclose(back, there, rtol=1e-13, atol=1e-13)


@ONE_WORKER
@pytest.mark.parametrize("hook", ["change", "command", "motors", "rotors", "body"])
def test_the_order_of_any_two_effects_means_nothing(hook, strong, guards):
    """Of all that act on the same thing; a drag goes along, for what moves the air."""
    drag = ParasiticDrag(0.02, 0.01)
    mine = [name for name, effect in strong.items() if overrides(effect, hook)]
    # Those that only add to the wrench were all tried together; here come those that use what others leave.
    late = [name for name in mine if hook != "body" or type(strong[name]).rank > 0 or name in ("thrust_tilt", "wind")]
    for one, other in sorted({tuple(sorted((one, other))) for one in late for other in mine if one != other}):
        pair = strong[one], strong[other], drag
        np.testing.assert_allclose(
            _flown(guards, pair[::-1]), _flown(guards, pair), rtol=1e-13, atol=1e-13, err_msg=f"{one}, {other}"
        )


def test_two_forces_that_follow_from_all_others_are_refused(guards):
    with pytest.raises(CfbError, match="payload_swing and payload_swing each follow from all other forces"):
        Quadrotor(guards, (PayloadSwing(0.002, 0.1), PayloadSwing(0.002, 0.2)))


@pytest.mark.parametrize("name", ["gust", "jet"])
def test_air_that_nothing_feels_is_refused(name, guards):
    with pytest.raises(CfbError, match=f"{name}: the air moves, but no effect of the model feels it; add rotor_drag"):
        Quadrotor(guards, (_at(name, INSIDE), PayloadSwing.neutral()))


def test_a_wind_of_an_earlier_file_is_the_force_it_was():
    """Fitted beside a drag that did not feel it."""
    old, new = ({"velocity": 1.0, "conductance": conductance} for conductance in (0.02, 0.0))
    felt = [float(effect_from_mapping({"name": "wind", "parameters": values}, "").felt) for values in (old, new)]
    assert felt == [0.0, 1.0]


def test_a_wind_in_a_file_that_does_nothing_is_refused():
    """Without a conductance, and without a drag for it to act on."""
    wind = {"name": "wind", "parameters": {"velocity": [1.0, 0.0, 0.0], "conductance": 0.0}}
    drag = {"name": "rotor_drag", "parameters": {"coefficient": 0.02}}
    assert Quadrotor.from_file(replace(load_model_file("cfb-guards"), effects=(wind, drag))).effects
    with pytest.raises(CfbError, match=r"cfb-guards: wind: the air moves, but no effect .* or a conductance"):
        Quadrotor.from_file(replace(load_model_file("cfb-guards"), effects=(wind,)))


def test_the_rotors_momentum_of_an_earlier_file_is_kept(guards):
    """`gyroscopic` used to have a rotor's inertia of its own, beside the model's."""
    old = {"name": "gyroscopic", "parameters": {"rotor_inertia": 2e-7}}
    assert float(effect_from_mapping(old, "old.yaml", guards).scale) == pytest.approx(2e-7 / 5e-8)
    for parameters in (None, replace(guards, rotor_inertia=0.0)):
        with pytest.raises(CfbError, match=r"old\.yaml: .*rotor_inertia is now a factor .* write scale instead"):
            effect_from_mapping(old, "old.yaml", parameters)
    with pytest.raises(CfbError, match="write scale instead"):
        effect_from_mapping({"name": "gyroscopic", "parameters": {"rotor_inertia": "small"}}, "old.yaml", guards)
    file = replace(load_model_file("cfb-guards"), effects=(old,))
    assert float(Quadrotor.from_file(file).effects[0].scale) == pytest.approx(4.0)


def test_all_effects_together_keep_float32(guards, manoeuvre):
    with jax.enable_x64(False):
        cast = functools.partial(jax.tree.map, lambda x: jnp.asarray(np.asarray(x, np.float32)))
        effects = tuple(cast(_at(name, INSIDE)) for name in CATALOGUE)
        flown = _stepped(Quadrotor(cast(guards), effects), *cast(manoeuvre))
        assert all(leaf.dtype == jnp.float32 for leaf in jax.tree.leaves(flown))
        assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(flown))


def test_effects_may_carry_batch_axes(guards):
    """A batch of effects makes a batch of changed parameters, of one drone and of a batch of drones."""
    fleet = jax.tree.map(lambda x: jnp.stack([x, 1.1 * x]), guards)
    for name in CATALOGUE:
        effects = [_at(name, (share, 0.4, 0.6, 0.8)) for share in (0.7, 0.3)]
        batch = jax.tree.map(lambda *x: jnp.stack(x), *effects)
        for parameters in (guards, fleet):
            # What moves the air is refused where nothing feels it.
            changed = Quadrotor(parameters, (batch, RotorDrag.neutral())).changed_parameters()
            for i, effect in enumerate(effects):
                drone = guards if parameters is guards else jax.tree.map(lambda x, i=i: x[i], fleet)
                wanted = Quadrotor(drone, (effect, RotorDrag.neutral())).changed_parameters()
                for got, one, base in zip(*map(jax.tree.leaves, (changed, wanted, drone)), strict=True):
                    got = got if got.ndim == base.ndim else got[i]
                    np.testing.assert_allclose(got, one, rtol=1e-12)


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


@pytest.mark.parametrize("cross", [0.0, 1.0])
def test_drag_across_the_axes(guards, cross):
    """Of a bluff body against the velocity as a whole; with axes on their own along each."""
    model = Quadrotor(guards, (ParasiticDrag(0.0, [0.01, 0.01, 0.01], cross),))
    y = np.zeros(17)
    y[3:6], y[6] = (3.0, -4.0, 0.0), 1.0
    felt = np.asarray(specific_force(model, helpers.state_of(y)))
    wanted = -0.01 * (5.0 * y[3:6] if cross else np.abs(y[3:6]) * y[3:6]) / 0.044
    np.testing.assert_allclose(felt, wanted, rtol=1e-9, atol=1e-9)


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


@pytest.mark.parametrize("name", sorted(CATALOGUE))
def test_mapping_round_trip(name):
    effect = _at(name, INSIDE)
    again = effect_from_mapping(effect_to_mapping(effect), "here")
    assert type(again) is type(effect)
    jax.tree.map(np.testing.assert_array_equal, again, effect)
    left_out = effect_from_mapping({"name": name}, "here")
    jax.tree.map(np.testing.assert_array_equal, left_out, CATALOGUE[name].neutral())


def test_what_a_mapping_leaves_out_is_neutral():
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


@ONE_WORKER
def test_a_predictor_answers_small_torques_by_less(guards):
    """At rest alpha = torque / inertia: what a small and a large torque turn, with the effect and without."""
    pushes = np.array([[2e-5, 1e-5, 3e-5], [4e-3, -3e-3, 2e-3]])
    knee, dilution = 5e-4, 0.9
    turned = []
    for effects in ((), (RegressionDilution(dilution, knee, reversion=0.0, turning=1e3, time_constant=1.0),)):
        found = []
        for push in pushes:
            model = Quadrotor(guards, (pushed(push), *effects), dt=1e-4)
            found.append(rollout(model, model.hover_state(), model.hover_command()[None]).body_rate[-1])
        turned.append(np.array(found))
    size = pushes[:, 0] ** 2 + pushes[:, 1] ** 2
    kept = 1 - dilution * knee**2 / (knee**2 + size)
    assert kept[0] < 0.11
    assert kept[1] > 0.98
    np.testing.assert_allclose(turned[1][:, :2], kept[:, None] * turned[0][:, :2], rtol=1e-4)
    np.testing.assert_allclose(turned[1][:, 2], turned[0][:, 2], rtol=1e-6)
    neutral = RegressionDilution.neutral()
    assert effect_from_mapping(effect_to_mapping(neutral), "drone.yaml") == neutral
    assert "regression_dilution" not in CATALOGUE


@ONE_WORKER
def test_a_predictor_expects_the_body_rate_to_return(guards):
    """Without a torque a roll fades as exp(-dilution reversion t); a yaw, which is spared, does not."""
    model = Quadrotor(guards, (RegressionDilution(0.8, 1.0, reversion=5.0, turning=1e3, time_constant=1.0),), dt=1e-3)
    for axis, kept in ((0, np.exp(-0.8 * 5.0 * 0.3)), (2, 1.0)):
        start = replace(model.hover_state(), body_rate=0.5 * jnp.eye(3)[axis])
        flown = rollout(model, start, jnp.tile(model.hover_command(), (300, 1))).body_rate[-1]
        assert flown[axis] == pytest.approx(0.5 * kept, rel=5e-3)


@ONE_WORKER
def test_a_predictor_answers_more_the_harder_a_flight_has_turned(guards):
    """A constant torque, by an adaptive integrator of SciPy: the same push counts for more as the flight goes on."""
    inertia, push = float(guards.inertia[0]), 2e-4
    dilution, reversion, turning, lasting = 0.95, 4.0, 0.2, 0.5

    def roll(_, x):
        rate, turned = x
        unanswered = dilution / (1 + (push / 1e-3) ** 2 + turned / turning**2)
        return [(1 - unanswered) * push / inertia - unanswered * reversion * rate, (rate**2 - turned) / lasting]

    expected = solve_ivp(roll, (0, 1), [0.0, 0.0], rtol=1e-9, t_eval=[0.1, 0.5, 1.0]).y[0]
    effect = RegressionDilution(dilution, 1e-3, reversion, turning, lasting)
    model = Quadrotor(guards, (pushed([push, 0.0, 0.0]), effect), dt=1e-3)
    flown = rollout(model, model.hover_state(), jnp.tile(model.hover_command(), (1000, 1))).body_rate[:, 0]
    np.testing.assert_allclose(flown[np.array([99, 499, 999])], expected, rtol=1e-2)
    assert expected[2] - expected[1] > 3 * (expected[1] - expected[0])


def pushed(torque) -> ResidualFormula:
    """A constant torque, N m, as an effect."""
    constant = np.zeros((6, len(TERMS)))
    constant[:3, list(TERMS).index("1")] = torque
    return ResidualFormula(constant, 0.0)


PAGE = (Path(__file__).resolve().parents[2] / "docs" / "effects.md").read_text()


def test_the_page_lists_the_catalogue_as_it_is():
    """Names, units and ranges: every effect has one row, and every row an effect."""
    rows = dict(re.findall(r"^\| `(\w+)` \| .* \| (.*?) \| .*? \|$", PAGE, flags=re.M))
    rows = {name: row for name, row in rows.items() if " to " in row}
    assert set(CATALOGUE) == set(rows)
    for name, kind in CATALOGUE.items():
        fields = dict(re.findall(r"(\**\w+\**)(?: \([^)]*\))?: ([^;]*)", rows[name]))
        assert {field.strip("*") for field in fields} == set(kind.prior)
        assert {field.strip("*") for field in fields if "*" in field} == set(kind.strengths)
        for field, text in fields.items():
            unit, span = re.fullmatch(r"(.*?)(?: per rotor)?, (.*)", text).groups()
            assert unit == kind.units[field.strip("*")]
            assert tuple(map(float, span.split(" to "))) == kind.prior[field.strip("*")]


def test_the_python_on_the_page_runs():
    scope = {}
    for block in re.findall(r"```python\n(.*?)```", PAGE, flags=re.S):
        exec(compile(block, "docs/effects.md", "exec", dont_inherit=True), scope)
    pulled = step(scope["tethered"], State.at_rest((1.0, 0.0, 0.0)), jnp.zeros(4))
    np.testing.assert_allclose(pulled.velocity, [-0.5 / 0.044 * 0.004, 0.0, -9.81 * 0.004], rtol=1e-12)
