"""Flying many drones as one operation must mean what the same steps mean, drone by drone, derivatives included."""

from __future__ import annotations

import functools
import importlib
import subprocess
import sys

import equinox as eqx
import helpers
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cfb_mjx.engine.batching import LANES, grouped
from cfb_mjx.model import ParasiticDrag, Quadrotor, begin, rollout, rollout_final, step
from cfb_mjx.model.effects.catalogue import CATALOGUE
from cfb_mjx.model.vector import Vec
from cfb_mjx.parameters import load_randomisation, sample_parameters

# The package's attribute of this name is the function.
rollouts = importlib.import_module("cfb_mjx.model.rollout")
HOLD, ROWS = 5, 4
KINDS = list(CATALOGUE.values())
# They share what one worker compiled.
pytestmark = pytest.mark.xdist_group("fleet")


@pytest.fixture(scope="module")
def model(guards) -> Quadrotor:
    return Quadrotor(guards, (ParasiticDrag(linear=0.02, quadratic=0.01),))


def _states(model, drones: int):
    random = np.random.default_rng(4)
    y = np.tile(helpers.aggressive_manoeuvre(0.1, seed=7)[0], (drones, 1))
    y[:, :6] += random.normal(0, 0.3, (drones, 6))
    y[:, 10:13] += random.normal(0, 0.5, (drones, 3))
    return jax.vmap(helpers.state_of)(jnp.asarray(y))


def _commands(drones: int):
    return jnp.asarray(np.random.default_rng(5).uniform(0.3, 0.8, (drones, ROWS, 4)))


def _models(model, drones: int):
    keys = jax.random.split(jax.random.key(1), drones)
    drawn = jax.vmap(lambda key: sample_parameters(key, model.parameters, load_randomisation("paper")))(keys)
    grown = jax.tree.map(lambda x: x * (1 + 0.1 * jnp.arange(drones).reshape(drones, *[1] * x.ndim)), model.effects)
    return eqx.tree_at(lambda m: (m.parameters, m.effects), model, (drawn, grown))


def _fly(model, state, commands):
    return rollout_final(model, state, commands, hold=HOLD)


def _fly_keeping(model, state, commands):
    return rollout(model, state, commands, hold=HOLD, every=2)


def _after_every_step(model, state, commands):
    def one(state, row):
        state = step(model, state, row)
        return state, state

    return jax.lax.scan(one, begin(model, state), jnp.repeat(commands, HOLD, axis=0))[1]


def _by_steps(model, state, commands):
    return jax.tree.map(lambda x: x[-1], _after_every_step(model, state, commands))


quick_steps = jax.jit(_by_steps, compiler_options=helpers.QUICK_COMPILE)


def _close(found, expected, rtol=1e-9, atol=1e-12):
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=rtol, atol=atol), found, expected)


def _is_together(function, *arguments) -> bool:
    return "fly[" in str(jax.make_jaxpr(function)(*arguments))


def test_few_steps_are_flown_apart(model):
    state, commands = model.hover_state(), _commands(1)[0]
    assert _is_together(_fly, model, state, commands)
    assert _is_together(_fly_keeping, model, state, commands)
    for short in (rollout, rollout_final):
        assert not _is_together(functools.partial(short, hold=1), model, state, commands)


class _Products(ParasiticDrag):
    """What XLA does not put into one function: a matrix product."""

    def body(self, wrench, at):
        turned = jnp.eye(3) @ wrench.torque.stack()
        return type(wrench)(wrench.force, Vec.unstack(turned))


def test_effects_of_the_users_own_are_flown_apart(guards):
    model = Quadrotor(guards, (_Products(linear=0.0, quadratic=0.0),))
    states, commands = _states(model, 3), _commands(3)
    assert not _is_together(_fly, model, model.hover_state(), commands[0])
    flown = jax.jit(jax.vmap(_fly, in_axes=(None, 0, 0)))(model, states, commands)
    bare = jax.jit(jax.vmap(_fly, in_axes=(None, 0, 0)))(Quadrotor(guards), states, commands)
    _close(flown.position, bare.position)


@pytest.mark.parametrize("drones", [1, 2 * LANES + 3])
def test_every_drone_flies_as_it_would_alone(drones, model):
    """Also where groups are filled up."""
    models, states, commands = _models(model, drones), _states(model, drones), _commands(drones)
    flown = jax.jit(jax.vmap(_fly))(models, states, commands)
    for i in {0, drones // 2, drones - 1}:
        alone = jax.tree.map(lambda x, i=i: x[i], (models, states, commands))
        _close(jax.tree.map(lambda x, i=i: x[i], flown), quick_steps(*alone))
        _close(_fly(*alone), quick_steps(*alone))


@pytest.mark.parametrize("every", [1, 2])
@pytest.mark.parametrize("drones", [1, LANES + 3])
def test_states_on_the_way_are_those_of_the_steps(drones, every, model):
    models, states, commands = _models(model, drones), _states(model, drones), _commands(drones)
    fly = functools.partial(rollout, hold=HOLD, every=every)
    flown = jax.jit(jax.vmap(fly))(models, states, commands)
    steps = jax.jit(_after_every_step, compiler_options=helpers.QUICK_COMPILE)
    for i in {0, drones - 1}:
        alone = jax.tree.map(lambda x, i=i: x[i], (models, states, commands))
        expected = jax.tree.map(lambda x: x[HOLD * every - 1 :: HOLD * every], steps(*alone))
        _close(jax.tree.map(lambda x, i=i: x[i], flown), expected)
        _close(fly(*alone), expected)


def test_long_flights_compile(model):
    """XLA divides operations that write much between threads, and jaxlib aborts where it does so within a kernel."""
    states, commands = _states(model, LANES), jnp.full((LANES, 700, 4), 0.55)
    together = functools.partial(jax.vmap, in_axes=(None, 0, 0))
    kept = jax.jit(together(rollout))(model, states, commands)
    last = jax.jit(together(rollout_final))(model, states, commands)
    _close(jax.tree.map(lambda x: x[:, -1], kept), last)

    def loss(commands):
        return jnp.sum(together(rollout_final)(model, states, commands).position)

    slopes = jax.jit(jax.grad(loss))(commands)
    # The last command reaches no position any more: the rotors turn up within its step, and push in the next one.
    assert np.all(np.isfinite(slopes))
    assert np.any(slopes[:, :-1] != 0, axis=-1).all()


@pytest.mark.parametrize("axes", [(0, None, None), (None, 0, None), (None, None, 0)], ids=["models", "states", "rows"])
def test_what_is_shared_may_be_anything(axes, model):
    given = (_models(model, 3), _states(model, 3), _commands(3))
    one = (model, _states(model, 1), _commands(1))
    one = (one[0], *(jax.tree.map(lambda x: x[0], x) for x in one[1:]))
    arguments = [many if a == 0 else single for a, many, single in zip(axes, given, one, strict=True)]
    flown = jax.jit(jax.vmap(_fly, in_axes=axes))(*arguments)
    alone = [jax.tree.map(lambda x: x[2], x) if a == 0 else x for a, x in zip(axes, arguments, strict=True)]
    _close(jax.tree.map(lambda x: x[2], flown), quick_steps(*alone))


def test_nested_batches(model):
    """Drones by states, the inner batch sharing the drone and the outer one the states."""
    models, states, commands = _models(model, 2), _states(model, 3), _commands(1)[0]
    both = jax.vmap(jax.vmap(_fly, in_axes=(None, 0, None)), in_axes=(0, None, None))(models, states, commands)
    other = jax.vmap(jax.vmap(_fly, in_axes=(0, None, None)), in_axes=(None, 0, None))(models, states, commands)
    _close(both, jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), other))
    alone = (jax.tree.map(lambda x: x[1], models), jax.tree.map(lambda x: x[2], states), commands)
    _close(jax.tree.map(lambda x: x[1, 2], both), quick_steps(*alone))


def test_constants_of_the_program_are_no_trouble(model):
    """XLA folds what is known while compiling; jaxlib aborts where a marked call is given a constant."""
    state, commands = model.hover_state(), _commands(1)[0]
    states, many = _states(model, LANES + 1), _commands(LANES + 1)
    flown = jax.jit(lambda: (_fly(model, state, commands), jax.vmap(_fly, (None, 0, 0))(model, states, many)))()
    _close(flown[0], quick_steps(model, state, commands))
    slope = jax.jit(lambda: jax.grad(lambda m: jnp.sum(_fly(m, state, commands).position))(model))()
    assert all(np.all(np.isfinite(x)) for x in jax.tree.leaves(slope))


def _loss(model, state, commands):
    final = _fly(model, state, commands)
    return jnp.sum(final.position**2) + jnp.sum(final.body_rate) + 1e-3 * jnp.sum(final.rotor_speed)


def _together_loss(model, states, commands):
    return jnp.sum(jax.vmap(_loss, in_axes=(None, 0, 0))(model, states, commands))


def _few_loss(few, model, state, commands):
    """By few of the model's numbers: then each step's derivatives are put together by them."""
    parameters = eqx.tree_at(lambda p: (p.mass, p.motor_time_constant), model.parameters, few)
    return _loss(eqx.tree_at(lambda m: m.parameters, model, parameters), state, commands)


def _few_of_each(model, states, commands):
    scale = 1 + 0.1 * jnp.arange(3)
    few = (scale * model.parameters.mass, scale[:, None] * model.parameters.motor_time_constant)
    return jax.vmap(jax.grad(_few_loss), (0, None, 0, 0))(few, model, states, commands)


def _loss_on_the_way(model, state, commands):
    """Every kept state weighs differently."""
    kept = _fly_keeping(model, state, commands)
    weights = 1 + jnp.arange(ROWS // 2)
    return jnp.sum(weights[:, None] * (kept.position**2 + kept.body_rate)) + 1e-3 * jnp.sum(kept.rotor_speed[0])


DERIVATIVES = {
    "on the way": lambda m, s, u: jax.vmap(jax.grad(_loss_on_the_way, argnums=(0, 1, 2)), (None, 0, 0))(m, s, u),
    "on the way, forward": lambda m, s, u: jax.jacfwd(lambda u: jax.vmap(_fly_keeping, (None, 0, 0))(m, s, u))(u),
    "few of each": _few_of_each,
    "grad of vmap": lambda m, s, u: jax.grad(_together_loss, argnums=(0, 1, 2))(m, s, u),
    "vmap of grad": lambda m, s, u: jax.vmap(jax.grad(_loss, argnums=(0, 1, 2)), (None, 0, 0))(m, s, u),
    "jacobian forward": lambda m, s, u: jax.jacfwd(lambda u: jax.vmap(_fly, (None, 0, 0))(m, s, u).position)(u),
    "jacobian reverse": lambda m, s, u: jax.jacrev(lambda m: jax.vmap(_fly, (None, 0, 0))(m, s, u).position)(m),
    "hessian": lambda m, s, u: jax.hessian(
        lambda mass: _together_loss(eqx.tree_at(lambda m: m.parameters.mass, m, mass), s, u)
    )(m.parameters.mass),
}


@pytest.mark.parametrize("name", DERIVATIVES)
def test_derivatives_are_those_of_the_steps(name, model, monkeypatch):
    arguments = (model, _states(model, 3), _commands(3))
    function = DERIVATIVES[name]
    # Once as users compile it, the others quickly: their rules are what is tested.
    options = None if name == "grad of vmap" else helpers.QUICK_COMPILE
    found = jax.jit(function, compiler_options=options)(*arguments)
    monkeypatch.setattr(rollouts, "_MANY", 10**9)
    # A function of its own: the one above would come from the cache of traces.
    expected = jax.jit(lambda *a: function(*a), compiler_options=helpers.QUICK_COMPILE)(*arguments)
    _close(found, expected, rtol=1e-7, atol=1e-9)


def test_derivatives_over_several_groups(model):
    drones = LANES + 9
    states, commands = _states(model, drones), _commands(drones)
    together = jax.jit(jax.grad(_together_loss, argnums=(0, 2)))(model, states, commands)
    each = jax.jit(jax.vmap(jax.grad(_loss, argnums=(0, 2)), in_axes=(None, 0, 0)))(model, states, commands)
    _close(together, (jax.tree.map(lambda x: x.sum(0), each[0]), each[1]), rtol=1e-8, atol=1e-9)


def test_every_effect_flies_together(guards):
    """All of them, with a gradient: jaxlib has to compile them in one kernel."""
    effects = [kind(**{key: 0.9 * low + 0.1 * high for key, (low, high) in kind.prior.items()}) for kind in KINDS]
    arrays, static = eqx.partition(tuple(effects), eqx.is_array)
    states, commands = _states(Quadrotor(guards), 3), _commands(3)

    def function(arrays):
        model = Quadrotor(guards, eqx.combine(arrays, static))
        final = jax.vmap(_fly, in_axes=(None, 0, 0))(model, states, commands)
        return jnp.sum(final.position), final

    slopes, flown = jax.jit(jax.grad(function, has_aux=True))(arrays)
    alone = jax.tree.map(lambda x: x[1], (states, commands))
    expected = quick_steps(Quadrotor(guards, tuple(effects)), *alone)
    for name in helpers.NAMES:
        np.testing.assert_allclose(getattr(flown, name)[1], getattr(expected, name), rtol=1e-9, atol=1e-9)
    assert all(np.all(np.isfinite(x)) for x in jax.tree.leaves(slopes))
    assert sum(np.any(x != 0) for x in jax.tree.leaves(slopes)) > len(KINDS)


def test_float32_stays_float32(model):
    with jax.enable_x64(False):
        cast = jax.tree.map(lambda x: jnp.asarray(np.asarray(x, np.float32)), (model, _states(model, 3), _commands(3)))
        flown = jax.jit(jax.vmap(_fly, in_axes=(None, 0, 0)))(*cast)
        assert all(x.dtype == jnp.float32 for x in jax.tree.leaves(flown))
    expected = jax.vmap(quick_steps, in_axes=(None, 0, 0))(model, _states(model, 3), _commands(3))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-4), flown, expected)


@pytest.mark.parametrize("size", [1, LANES, LANES + 1, 3 * LANES - 5])
def test_groups_put_examples_back_in_order(size):
    own, shared = jnp.arange(2.0 * size).reshape(2, size), jnp.array([3.0, 5.0])
    found = grouped(lambda a, b: [a * b[:, None], a.sum(0)], [own, shared], (True, False), size)
    np.testing.assert_array_equal(found[0], own * shared[:, None])
    np.testing.assert_array_equal(found[1], own.sum(0))


PROGRAM = """
import jax, jax.numpy as jnp, numpy as np
from cfb_mjx.model import Quadrotor, rollout_final
from jax.sharding import Mesh, NamedSharding, PartitionSpec as P
model = Quadrotor.from_file("cfb-guards")
states = jax.tree.map(lambda x: jnp.tile(x, (512, 1)), model.hover_state())
commands = model.hover_command() * (1 + 0.01 * jax.random.normal(jax.random.key(0), (512, 1, 4)))
fly = lambda m, s, u: jax.vmap(lambda s, u: rollout_final(m, s, u, hold=100))(s, u)
slope = lambda m, s, u: jax.grad(lambda m: jnp.sum(fly(m, s, u).position ** 2))(m).parameters.mass
one = jax.jit(fly)(model, states, commands), jax.jit(slope)(model, states, commands)
over = NamedSharding(Mesh(jax.devices(), ("drones",)), P("drones"))
divided = jax.tree.map(lambda x: jax.device_put(x, over), (states, commands))
compiled = jax.jit(fly).lower(model, *divided).compile()
two = compiled(model, *divided), jax.jit(slope)(model, *divided)
assert len(two[0].position.sharding.device_set) == 2 and not two[0].position.sharding.is_fully_replicated
jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=2e-5, atol=2e-5), one, two)
text = compiled.as_text()
# Every device flies its half of each group: nothing of the flight itself is exchanged or done twice.
assert "f32[64]" in text and "128]" not in text, "the groups were not divided"
print("same")
"""


def test_two_devices_share_every_group(tmp_path):
    environment = {
        "XLA_FLAGS": "--xla_force_host_platform_device_count=2",
        "PATH": "/usr/bin:/bin",
        "JAX_COMPILATION_CACHE_DIR": str(tmp_path),
    }
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM], env=environment, capture_output=True, text=True, timeout=240, check=False
    )
    assert done.stdout.strip().endswith("same"), done.stderr[-2000:]
