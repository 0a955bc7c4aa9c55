"""Closed loops flown together: beside the same loop written out drone by drone, and their derivatives."""

from dataclasses import replace
from functools import partial

import equinox as eqx
import helpers
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cfb_mjx.control import NeuralController, closed_loop, find_controller, rollout_closed_loop
from cfb_mjx.envs.observation import Layout, StateEstimate
from cfb_mjx.errors import CfbError
from cfb_mjx.model import MjxBody, Quadrotor, begin
from cfb_mjx.model.effects import effect_from_mapping
from cfb_mjx.model.quadrotor import step
from cfb_mjx.parameters import load_randomisation, sample_parameters

MODEL = Quadrotor.from_file("cfb-guards")
quick = partial(jax.jit, compiler_options=helpers.QUICK_COMPILE)
LAYOUTS = (
    Layout(),
    Layout(past_estimates=2, estimate_stride=2, past_commands=3, integral=True, body_position=True, body_velocity=True),
    Layout(past_estimates=0, past_commands=0, position=False),
)
CLOSE = {"rtol": 1e-9, "atol": 1e-11}


def network(layout=LAYOUTS[0], seed=0) -> NeuralController:
    """Random, with outputs that move."""
    found = NeuralController.random(jax.random.key(seed), layout, (16, 16))
    return eqx.tree_at(lambda c: c.network.weights[-1], found, replace_fn=lambda w: 30 * w)


def starts(drones, model=MODEL):
    keys = jax.random.split(jax.random.key(3), 3)
    hover = model.hover_state((0.0, 0.0, 0.0))
    states = jax.tree.map(lambda x: jnp.broadcast_to(x, (drones, *x.shape)), hover)
    tilt = jnp.concatenate([jnp.ones((drones, 1)), 0.2 * jax.random.normal(keys[0], (drones, 3))], axis=1)
    return eqx.tree_at(
        lambda s: (s.position, s.velocity, s.quaternion),
        states,
        (
            jax.random.normal(keys[1], (drones, 3)),
            jax.random.normal(keys[2], (drones, 3)),
            tilt / jnp.linalg.norm(tilt, axis=1, keepdims=True),
        ),
    )


def written_out(model, controller, state, commands, target=(0.0, 0.0, 0.0)):
    """One drone, the public step after the public command."""
    hold = round(controller.control_dt_s / model.dt)

    def seen(at):
        return StateEstimate(at.position - jnp.asarray(target), at.velocity, at.quaternion, at.body_rate)

    def one(carry, _):
        state, memory = carry
        memory, command = controller.command(memory, seen(state))
        state = jax.lax.fori_loop(0, hold, lambda _, at: step(model, at, command), state)
        return (state, memory), (state, command)

    state = begin(model, state)
    return jax.lax.scan(one, (state, controller.start(seen(state), model.hover_command())), length=commands)[1]


def states_of(tree, drone):
    return jax.tree.map(lambda x: x[drone], tree)


def equal(a, b):
    assert jax.tree.structure(a) == jax.tree.structure(b)
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, **CLOSE), a, b)


WAYS = ("in one function", "in one per command", "drones by operation")


def go(way, monkeypatch):
    """How drones are flown together: these tests have few, which would all go one way."""
    if way != "in one function":
        monkeypatch.setattr(closed_loop, "FEW", 0)
    if way == "drones by operation":
        monkeypatch.setattr(closed_loop, "LANES", 0)


# The second layout has all there is; every way flies it.
@pytest.mark.parametrize(
    ("layout", "way"), [*((LAYOUTS[1], way) for way in WAYS), (LAYOUTS[0], WAYS[0]), (LAYOUTS[2], WAYS[2])]
)
def test_many_are_each_as_written_out(layout, way, monkeypatch):
    go(way, monkeypatch)
    controller, states, targets = network(layout), starts(3), jax.random.normal(jax.random.key(4), (3, 3))

    def fly(state, target):
        return rollout_closed_loop(MODEL, controller, state, 6, target=target, every=3)[:2]

    flown = quick(jax.vmap(fly))(states, targets)
    assert flown[1].shape == (3, 2, 4)
    wanted = quick(jax.vmap(lambda s, t: written_out(MODEL, controller, s, 6, t)))(states, targets)
    wanted = jax.tree.map(lambda x: x[:, 2::3], wanted)
    equal(flown, wanted)
    equal(fly(states_of(states, 0), targets[0]), states_of(wanted, 0))
    # The commands are no constants.
    assert np.std(flown[1]) > 0.01


@pytest.mark.parametrize("count", [1, 4, 8])
def test_a_wide_network_flies_few(count):
    """jaxlib 0.12 cannot compile some sums over eight columns and fewer."""
    controller, states = NeuralController.random(jax.random.key(7), LAYOUTS[-1], (64, 64)), starts(count)
    flown = quick(jax.vmap(lambda state: rollout_closed_loop(MODEL, controller, state, 2)[:2]))(states)
    equal(flown, quick(jax.vmap(lambda state: written_out(MODEL, controller, state, 2)))(states))


def drawn(count, model=MODEL):
    keys, ranges = jax.random.split(jax.random.key(5), count), load_randomisation()
    return jax.vmap(
        lambda key: eqx.tree_at(lambda m: m.parameters, model, sample_parameters(key, model.parameters, ranges))
    )(keys)


@pytest.mark.parametrize("way", WAYS)
def test_any_of_the_arguments_may_be_batched_and_batched_again(way, monkeypatch):
    go(way, monkeypatch)
    controller, states = network(), starts(4)
    models, controllers = (
        drawn(4),
        jax.vmap(lambda key: NeuralController.random(key, LAYOUTS[0], (8,)))(jax.random.split(jax.random.key(6), 4)),
    )

    def fly(model, controller, state):
        return rollout_closed_loop(model, controller, state, 3)[:2]

    def alone(model, controller, state):
        return written_out(model, controller, state, 3)

    for axes in ((0, None, 0), (None, 0, None), (0, None, None)):
        arguments = [
            batch if axis == 0 else single
            for axis, batch, single in zip(
                axes, (models, controllers, states), (MODEL, controller, states_of(states, 0)), strict=True
            )
        ]
        equal(*(quick(jax.vmap(f, in_axes=axes))(*arguments) for f in (fly, alone)))
    two = jax.tree.map(lambda x: x[:2], models)
    pairs = [
        quick(jax.vmap(jax.vmap(f, (None, None, 0)), (0, None, None)))(two, controller, states) for f in (fly, alone)
    ]
    equal(*pairs)


def test_more_than_a_group_at_a_time(monkeypatch):
    controller, states = network(), starts(7)

    def fly(state):
        return rollout_closed_loop(MODEL, controller, state, 3)

    monkeypatch.setattr(closed_loop, "FEW", 0)
    whole = quick(jax.vmap(fly))(states)
    monkeypatch.setattr(closed_loop, "at_once", lambda: 3)
    # Functions of their own: the one above would come from the cache of traces.
    equal(quick(jax.vmap(lambda state: fly(state)))(states), whole)
    monkeypatch.setattr(closed_loop, "LANES", 0)
    equal(quick(jax.vmap(lambda state: fly(state)))(states), whole)


@pytest.mark.parametrize("name", ["pid", "mellinger", "target"])
def test_every_controller_flies_and_holds_the_target(name):
    model = Quadrotor.from_file("cfb-guards", dt=0.002)
    controller = find_controller(name, model)
    commands = round(4.0 / controller.control_dt_s)
    target = jnp.array([0.5, 0.2, 1.3])
    fly = jax.vmap(
        lambda p: rollout_closed_loop(model, controller, model.hover_state(p), commands, target=target, every=commands)
    )
    flown = quick(fly)(jnp.array([[0.0, 0.0, 1.0], [1.0, 0.0, 1.0]]))
    distance = np.linalg.norm(flown.state.position[:, -1] - target, axis=-1)
    assert distance.max() < 0.12


EFFECTS = (
    {"name": "command_delay", "parameters": {"delay": 0.006}},
    {"name": "payload_swing", "parameters": {"mass": 0.004, "length": 0.1}},
)


WITH_MEMORY = {"effects": tuple(effect_from_mapping(item, "test") for item in EFFECTS)}


@pytest.mark.parametrize(("changes", "few"), [({"body": MjxBody()}, 8), (WITH_MEMORY, 8), (WITH_MEMORY, 0)])
def test_other_bodies_and_effects_with_a_memory(changes, few, monkeypatch):
    monkeypatch.setattr(closed_loop, "FEW", few)
    model = replace(MODEL, **changes)
    controller, states = network(), starts(2, model)
    flown = quick(jax.vmap(lambda s: rollout_closed_loop(model, controller, s, 3)))(states)
    equal(flown[:2], quick(jax.vmap(lambda s: written_out(model, controller, s, 3)))(states))


def test_going_on_with_the_memory_is_the_same_flight():
    controller, state = network(), states_of(starts(1), 0)
    whole = rollout_closed_loop(MODEL, controller, state, 6)
    first = rollout_closed_loop(MODEL, controller, state, 2)
    rest = rollout_closed_loop(MODEL, controller, jax.tree.map(lambda x: x[-1], first.state), 4, memory=first.memory)
    equal(jax.tree.map(lambda x: x[2:], whole[:2]), rest[:2])
    equal(whole.memory, rest.memory)


def test_derivatives_are_those_of_differences_in_both_modes():
    controller, states = network(), starts(2)

    def loss(mass, weight):
        model = eqx.tree_at(lambda m: m.parameters.mass, MODEL, mass)
        flown = eqx.tree_at(lambda c: c.network.weights[0], controller, weight * controller.network.weights[0])
        end = jax.vmap(lambda s: rollout_closed_loop(model, flown, s, 8, every=8).state.position[-1])(states)
        return jnp.sum(end**2)

    at, step = (MODEL.parameters.mass, jnp.array(1.0)), 1e-5
    reverse = quick(jax.grad(loss, argnums=(0, 1)))(*at)
    forward = quick(jax.jacfwd(loss, argnums=(0, 1)))(*at)
    loss = quick(loss)
    np.testing.assert_allclose(reverse, forward, rtol=1e-9)
    for i in (0, 1):
        up, down = (loss(*(x * (1 + s * step) if j == i else x for j, x in enumerate(at))) for s in (1, -1))
        np.testing.assert_allclose(reverse[i], (up - down) / (2 * step * at[i]), rtol=1e-5)


def test_a_controller_alone_in_another_precision_than_the_drone():
    controller, state = network(), states_of(starts(1), 0)
    coarse = jax.tree.map(lambda x: x.astype(jnp.float32), controller)
    flown = rollout_closed_loop(MODEL, coarse, state, 6)[:2]
    jax.tree.map(
        lambda x, y: np.testing.assert_allclose(x, y, atol=1e-4),
        flown,
        rollout_closed_loop(MODEL, controller, state, 6)[:2],
    )


def test_what_cannot_be_flown_is_refused():
    state = MODEL.hover_state()
    with pytest.raises(CfbError, match="not a multiple of the simulation step"):
        rollout_closed_loop(MODEL, find_controller("pid", MODEL), state, 3)
    with pytest.raises(ValueError, match="cannot be kept every 2"):
        rollout_closed_loop(MODEL, network(), state, 3, every=2)
    with pytest.raises(ValueError, match="set-points"):
        rollout_closed_loop(MODEL, network(Layout(setpoint_scales=(1.0,))), state, 3)
