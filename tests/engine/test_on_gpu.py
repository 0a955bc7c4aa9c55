"""What a GPU computes, beside float64 on the CPU of the same machine. Skipped where there is none.

float32 rounds to 6e-8 of a number; half a second of flips lets that grow to some 1e-4 of the largest one.
"""

from __future__ import annotations

import functools

import equinox as eqx
import helpers
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_gpu_kernel import _all_effects, _has_kernel, _single, _spread

from cfb_mjx.control.closed_loop import rollout_closed_loop
from cfb_mjx.control.policy_file import load_policy
from cfb_mjx.engine import gpu
from cfb_mjx.model import MjxBody, Quadrotor, rollout, rollout_final
from cfb_mjx.parameters import load_randomisation, sample_parameters

pytestmark = [
    pytest.mark.skipif(jax.default_backend() != "gpu", reason="there is no GPU here"),
    pytest.mark.filterwarnings("ignore:The Pallas Triton backend is deprecated:DeprecationWarning"),
]


def _beside_float64(function, *arguments, share=1e-3):
    """Compare with the same function of doubles on the CPU."""
    flown = jax.jit(lambda *a: function(*a))(*arguments)
    cpu = jax.devices("cpu")[0]
    double = jax.tree.map(lambda x: jax.device_put(np.asarray(x, float), cpu) if eqx.is_array(x) else x, arguments)
    exact = jax.jit(lambda *a: function(*a))(*double)
    assert jax.tree.structure(flown) == jax.tree.structure(exact)
    worst = 0.0
    for got, expected in zip(jax.tree.leaves(flown), jax.tree.leaves(exact), strict=True):
        assert got.dtype == jnp.float32
        assert expected.dtype == jnp.float64
        worst = max(worst, float(np.abs(got - np.asarray(expected)).max() / max(np.abs(expected).max(), 1e-3)))
    print(f"{worst:.1e} of the largest number")
    assert worst < share


def _kernel_in(function, *arguments) -> bool:
    return _has_kernel(jax.jit(lambda *a: function(*a)).trace(*arguments))


@pytest.fixture(scope="module")
def flight():
    y, commands = helpers.aggressive_manoeuvre(0.5, seed=3)
    return _single((helpers.state_of(y), commands))


def test_the_kernel_is_chosen_here():
    assert gpu.kernel_is_chosen()


@pytest.mark.parametrize("what", ["nominal", "all effects", "rk4", "randomised", "kept", "a batch of batches"])
def test_open_loop(what, guards, flight):
    model, (state, commands) = _single(Quadrotor(guards)), flight
    fly, axes, drones = rollout_final, (None, 0, None), 200
    if what == "all effects":
        model = _all_effects(guards)
    if what == "rk4":
        model = _single(Quadrotor(guards, integrator="rk4", rotor_loads="mean", substeps=2))
    if what == "kept":
        fly = functools.partial(rollout, every=25)
    states = _spread(state, drones)
    if what == "randomised":
        keys = jax.random.split(jax.random.key(0), drones)
        draw = jax.vmap(lambda key: sample_parameters(key, guards, load_randomisation()))
        model, axes = _single(Quadrotor(draw(keys))), (0, 0, None)
    together = jax.vmap(fly, axes)
    if what == "a batch of batches":
        states = jax.tree.map(lambda x: x.reshape(10, 20, *x.shape[1:]), states)
        together = jax.vmap(together, axes)
    assert _kernel_in(together, model, states, commands)
    _beside_float64(together, model, states, commands)


def test_gradient_by_everything(guards, flight):
    model, (state, commands) = _single(Quadrotor(guards)), flight

    def loss(model, states, commands):
        final = jax.vmap(rollout_final, (None, 0, None))(model, states, commands)
        return sum(jnp.mean(x * x) for x in (final.position, final.velocity, final.quaternion, final.body_rate))

    _beside_float64(jax.grad(loss, argnums=(0, 1, 2)), model, _spread(state, 20), commands[:50])


def test_a_policy_in_the_loop(guards):
    controller = _single(load_policy("target").controller)
    model = _single(Quadrotor(guards))
    states = _spread(model.hover_state(), 200)
    away = 0.3 * jax.random.normal(jax.random.key(2), (200, 3), jnp.float32)
    states = eqx.tree_at(lambda s: s.position, states, away)
    fly = jax.vmap(lambda m, p, s: rollout_closed_loop(m, p, s, 60, every=30).state, (None, None, 0))
    _beside_float64(fly, model, controller, states)


def test_mjx(guards, flight):
    """In doubles, which MJX computes wherever jax is set to them."""
    state, commands = jax.tree.map(lambda x: np.asarray(x, float), flight)
    fly = jax.jit(jax.vmap(rollout_final, (None, 0, None)))
    given = Quadrotor(guards, body=MjxBody(floor=False)), jax.tree.map(np.asarray, _spread(state, 20)), commands[:50]
    flown, exact = (
        fly(*jax.device_put(jax.tree.map(lambda x: np.asarray(x, float), given), jax.devices(d)[0]))
        for d in ("gpu", "cpu")
    )
    for got, expected in zip(jax.tree.leaves(flown), jax.tree.leaves(exact), strict=True):
        np.testing.assert_allclose(got, expected, rtol=1e-9, atol=1e-9)
