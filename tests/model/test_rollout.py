"""Batching, compiling, holding, keeping and chunking must not change what is computed; nor may precision."""

from __future__ import annotations

import contextlib
import functools
import warnings

import equinox as eqx
import helpers
import jax
import jax.numpy as jnp
import jaxtyping
import numpy as np
import pytest

from cfb_mjx.errors import CfbError
from cfb_mjx.model import (
    DelayLine,
    MjxBody,
    ParasiticDrag,
    Quadrotor,
    State,
    in_chunks,
    rollout,
    rollout_final,
    step,
)
from cfb_mjx.parameters import Parameters, load_model_file, sample_parameters

STEPS = 6
quick = functools.partial(jax.jit, compiler_options=helpers.QUICK_COMPILE)
jitted = quick(rollout, static_argnames=("hold", "every"))
jitted_final = quick(rollout_final, static_argnames="hold")
jitted_step = quick(step)


@pytest.fixture(scope="module")
def model(guards) -> Quadrotor:
    return Quadrotor(guards, (ParasiticDrag(linear=0.02, quadratic=0.01),))


@pytest.fixture(scope="module")
def flight():
    y, commands = helpers.aggressive_manoeuvre(0.1, seed=7)
    return helpers.state_of(y), jnp.asarray(commands[:STEPS])


@contextlib.contextmanager
def jaxtyping_disabled():
    jaxtyping.config.update("jaxtyping_disable", True)
    try:
        yield
    finally:
        jaxtyping.config.update("jaxtyping_disable", False)


def _close(a, b, rtol=1e-12):
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, rtol=rtol, atol=1e-12), a, b)


def _index(tree, i):
    return jax.tree.map(lambda x: x[i], tree)


def test_rollout_is_repeated_steps(model, flight):
    state, commands = flight
    states = jitted(model, state, commands)
    for i, command in enumerate(commands):
        state = jitted_step(model, state, command)
        _close(_index(states, i), state)
    _close(jitted_final(model, flight[0], commands), state)


def test_jit_changes_nothing(model, flight):
    with jax.disable_jit():
        plain = rollout(model, flight[0], flight[1][:2])
    _close(_index(jitted(model, *flight), slice(0, 2)), plain)


@pytest.fixture(scope="module")
def batch(model, flight):
    """Four drones, states and command sequences, all different."""
    keys = jax.random.split(jax.random.key(1), 4)
    parameters = jax.vmap(lambda key: sample_parameters(key, model.parameters))(keys)
    models = eqx.tree_at(
        lambda m: (m.parameters, m.effects),
        model,
        (parameters, jax.tree.map(lambda x: x * jnp.arange(1.0, 5.0).reshape(4, *[1] * x.ndim), model.effects)),
    )
    states = jax.tree.map(lambda x: x + 0.1 * jnp.arange(4.0)[:, None], flight[0])
    commands = jnp.asarray(np.random.default_rng(0).uniform(0, 1, (4, STEPS, 4)))
    return models, states, commands


def test_vmap_equals_a_loop(batch):
    models, states, commands = batch
    batched = quick(jax.vmap(rollout))(models, states, commands)
    for i in range(4):
        _close(_index(batched, i), jitted(_index(models, i), _index(states, i), commands[i]))


def test_vmap_over_one_argument_at_a_time(model, flight, batch):
    models, states, commands = batch
    state, sequence = flight
    for axes, arguments in (
        ((0, None, None), (models, state, sequence)),
        ((None, 0, None), (model, states, sequence)),
        ((None, None, 2), (model, state, jnp.moveaxis(commands, 0, 2))),
    ):
        batched = quick(jax.vmap(rollout, in_axes=axes))(*arguments)
        one = [_index(a, 2) if axis == 0 else a for a, axis in zip(arguments, axes, strict=True)]
        if axes[2] == 2:
            one[2] = commands[2]
        _close(_index(batched, 2), jitted(*one))


def test_hold_repeats_each_command(model, flight):
    state, commands = flight
    held = jitted(model, state, commands[::2], hold=2)
    repeated = jitted(model, state, jnp.repeat(commands[::2], 2, axis=0))
    _close(held, _index(repeated, slice(1, None, 2)))
    _close(jitted_final(model, state, commands[::2], hold=2), _index(repeated, -1))


@pytest.mark.parametrize("every", [2, 3, STEPS])
def test_every_keeps_some_states(every, model, flight):
    _close(jitted(model, *flight, every=every), _index(jitted(model, *flight), slice(every - 1, None, every)))


@pytest.mark.parametrize(("hold", "every"), [(0, 1), (1, 0), (1, 4)])
def test_impossible_hold_and_every_are_refused(hold, every, model, flight):
    with pytest.raises(ValueError, match="cannot be kept"):
        rollout(model, *flight, hold=hold, every=every)


def test_substeps_are_shorter_steps(model, flight):
    state, commands = flight
    coarse = Quadrotor(model.parameters, model.effects, substeps=2)
    fine = Quadrotor(model.parameters, model.effects, dt=0.002)
    _close(jitted(coarse, state, commands), jitted(fine, state, commands, hold=2))


def test_commands_are_clipped(model, flight):
    state, commands = flight
    wild = commands.at[:, 0].set(1.7).at[:, 1].set(-0.4)
    _close(jitted(model, state, wild), jitted(model, state, jnp.clip(wild, 0.0, 1.0)))


@pytest.mark.parametrize("size", [1, 3, 4, 7, 100])
def test_in_chunks_equals_vmap(size):
    """7 examples in chunks of 3: the last one is ragged."""

    def function(key, x):
        return {"a": x * jax.random.normal(key, (2,)), "b": x.sum()}

    keys, xs = jax.random.split(jax.random.key(0), 7), jnp.arange(7.0)
    reports = []
    chunked = in_chunks(function, size, keys, xs, progress=lambda done, total: reports.append((done, total)))
    _close(chunked, jax.vmap(function)(keys, xs))
    assert reports[-1] == (7, 7)
    assert [done for done, _ in reports] == sorted({*range(size, 7, size), 7})
    assert all(isinstance(leaf, np.ndarray) for leaf in jax.tree.leaves(chunked))


def test_in_chunks_flies(model, batch):
    models, states, commands = batch
    chunked = in_chunks(rollout_final, 3, models, states, commands)
    _close(chunked, _index(quick(jax.vmap(rollout))(models, states, commands), (slice(None), -1)))


@pytest.mark.parametrize("size", [0, -1])
def test_in_chunks_refuses_empty_chunks(size):
    with pytest.raises(ValueError, match=r"size|time|zero"):
        in_chunks(lambda x: x, size, jnp.arange(3.0))


def test_a_single_precision_drone_hovers_in_single_precision():
    """Also where jax is set to doubles, as in these tests: a closed loop begins with this command."""
    model = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), Quadrotor.from_file("cf21b-500"))
    assert model.hover_command().dtype == jnp.float32


@pytest.mark.parametrize("x64", [False, True])
@pytest.mark.parametrize("body", ["rigid", "mjx", "mjx floor"])
def test_precision_follows_the_setting(x64, body):
    """float32 in, float32 throughout, so that no step silently computes in doubles on a GPU (and the reverse)."""
    dtype = jnp.float64 if x64 else jnp.float32
    choices = {} if body == "rigid" else {"body": MjxBody(floor=body == "mjx floor")}
    with jax.enable_x64(x64):
        for integrator in ("leapfrog", "euler", "rk4") if body == "rigid" else ("leapfrog",):
            model = Quadrotor.from_file("cf21b-500", integrator=integrator, **choices)
            state, commands = model.hover_state(), jnp.full((4, 4), 0.5)
            line = DelayLine.filled(state, 0.004, 0.008)
            fly = functools.partial(rollout, hold=2)
            program, flown = jax.make_jaxpr(fly, return_shape=True)(model, state, commands)
            shapes = [flown, jax.eval_shape(line.read, jnp.asarray(0.005))]
            shapes += [jax.eval_shape(sample_parameters, jax.random.key(0), model.parameters)]
            for leaf in jax.tree.leaves((model, state, shapes)):
                assert leaf.dtype == dtype
            assert ("f64[" in str(program)) == x64


def test_float32_flies_like_float64(model, flight):
    expected = jitted(model, *flight)
    with jax.enable_x64(False):
        cast = functools.partial(jax.tree.map, lambda x: jnp.asarray(np.asarray(x, np.float32)))
        flown = quick(rollout)(cast(model), cast(flight[0]), cast(flight[1]))
        assert all(leaf.dtype == jnp.float32 for leaf in jax.tree.leaves(flown))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5), flown, expected)


@pytest.mark.parametrize(
    ("choice", "word"),
    [
        ({"integrator": "rk5"}, "rk4"),
        ({"rotor_loads": "none"}, "mean"),
        ({"dt": 0.0}, "dt"),
        ({"dt": -0.1}, "dt"),
        ({"dt": float("nan")}, "dt"),
        ({"dt": float("inf")}, "dt"),
        ({"substeps": 0}, "substeps"),
    ],
)
def test_impossible_choices_are_refused(choice, word, guards):
    # The session's type checker would refuse a wrong Literal first; users run without it.
    with jaxtyping_disabled(), pytest.raises(CfbError, match=word):
        Quadrotor(guards, **choice)


def test_presets_carry_their_effects():
    model = Quadrotor.from_file("cf21b-500")
    assert isinstance(model.parameters, Parameters)
    assert isinstance(model.effects[0], ParasiticDrag)
    assert Quadrotor.from_file(load_model_file("cfb")).effects == ()
    assert isinstance(model.hover_state(), State)


@pytest.mark.parametrize(("dt_s", "steps"), [(0.008, 2), (0.004, 1), (0.009, None), (0.010, None), (0.001, None)])
def test_commands_last_a_whole_number_of_steps(dt_s, steps):
    model = Quadrotor.from_file("cfb-guards")
    if steps is None:
        with pytest.raises(CfbError, match="not a multiple of the simulation step"):
            model.steps_per_command(dt_s)
    else:
        assert model.steps_per_command(dt_s) == steps


@pytest.mark.parametrize(("ratio", "said"), [(0.98, True), (1.02, False)])
def test_a_drone_that_cannot_hover_is_said_to_be_too_heavy(ratio, said):
    """Full thrust is four times 0.289 N."""
    mass = 4 * (-0.23 + 0.562 - 0.043) / 9.81 / ratio
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        Quadrotor.from_file(load_model_file("cfb-guards").with_values("a test", mass=mass))
    assert any("cannot hover" in str(w.message) for w in found) == said
