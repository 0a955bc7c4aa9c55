"""Swarms against single drones, SciPy, and each other."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from cfb_mjx.errors import CfbError
from cfb_mjx.model import Quadrotor, State, rollout, thrust
from cfb_mjx.model.effects import Downwash
from cfb_mjx.model.swarm import _many, rollout_swarm

PLAIN = Quadrotor.from_file("cfb-guards", dt=0.002)
MODEL = replace(PLAIN, effects=(Downwash(coefficient=0.004),))
pytestmark = pytest.mark.xdist_group("swarm")


def swarm(count: int, model: Quadrotor = MODEL) -> Quadrotor:
    return jax.tree.map(lambda x: jnp.stack([x] * count), model)


def hovering(places, model: Quadrotor = MODEL) -> State:
    hover = model.hover_state()
    return jax.vmap(lambda place: replace(hover, position=place, memory=()))(jnp.asarray(places, float))


def commands(steps: int, count: int, size: float = 0.03) -> jax.Array:
    u = np.random.default_rng(3).normal(size=(steps, count, 4))
    return jnp.asarray(np.clip(np.asarray(MODEL.hover_command()) + size * u, 0.0, 1.0))


def numbers(state: State) -> np.ndarray:
    parts = (state.position, state.velocity, state.quaternion, state.body_rate, state.rotor_speed)
    return np.concatenate([np.asarray(x) for x in parts], axis=-1)


@pytest.mark.parametrize("count", [2, 6])
def test_drones_far_apart_fly_alone(count):
    places = [(10.0 * i, 0.0, 1.0 + i) for i in range(count)]
    u = commands(60, count)
    together = rollout_swarm(swarm(count), hovering(places), u, every=20)
    alone = jax.vmap(lambda s, c: rollout(PLAIN, s, c, every=20), in_axes=(0, 1), out_axes=1)(
        hovering(places, PLAIN), u
    )
    np.testing.assert_allclose(numbers(together.state), numbers(alone), atol=2e-6)


def test_a_drone_sinks_below_another_as_scipy_says():
    """Level, on the axis, rotors steady: m a = -coefficient / 4 * 4 u^2, with u of the formula at the hubs."""
    u = jnp.tile(MODEL.hover_command(), (100, 2, 1))
    flown = rollout_swarm(swarm(2), hovering([(0.0, 0.0, 1.6), (0.0, 0.0, 1.0)]), u, every=25)
    mass, gravity = float(MODEL.parameters.mass), float(MODEL.parameters.gravity)
    hub = float(MODEL.parameters.rotor_spacing) / np.sqrt(2)
    strength = np.sqrt(mass * gravity / (0.805 * np.pi * 1.2))

    def falling(_, y):
        below = 1.6 - y[0]
        half = 0.045 + 0.0767 * below
        speed = strength / half / (1 + 0.41421356 * hub**2 / half**2) ** 2 * 0.5 * (1 + np.tanh(2 * below / 0.045))
        return [y[1], -0.004 * speed**2 / mass]

    times = 0.05 * np.arange(1, 5)
    exact = solve_ivp(falling, (0.0, 0.2), [1.0, 0.0], t_eval=times, rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(flown.state.position[:, 1, 2], exact.y[0], atol=1e-6)
    assert exact.y[0][-1] < 0.99
    np.testing.assert_allclose(flown.state.position[:, 0], np.tile([0.0, 0.0, 1.6], (4, 1)), atol=1e-12)


def test_many_swarms_are_as_one_and_one():
    u, small = commands(40, 2), hovering([(0.0, 0.0, 1.5), (0.05, 0.02, 1.0)])
    moved = [replace(small, position=small.position + jnp.array([0.03 * k, 0.0, 0.0])[None] * k) for k in range(3)]
    batched = jax.jit(jax.vmap(lambda s: rollout_swarm(swarm(2), s, u, every=20).state))(
        jax.tree.map(lambda *x: jnp.stack(x), *moved)
    )
    for k, one in enumerate(moved):
        own = rollout_swarm(swarm(2), one, u, every=20).state
        np.testing.assert_allclose(numbers(jax.tree.map(lambda x, k=k: x[k], batched)), numbers(own), atol=1e-10)


def test_neighbours_and_exchanges_change_little():
    places = [(0.0, 0.0, 2.0), (0.06, 0.0, 1.5), (0.5, 0.1, 1.2), (0.02, 0.05, 1.0)]
    u = commands(100, 4)
    exact = rollout_swarm(swarm(4), hovering(places), u, every=50)
    large = _many(swarm(4), hovering(places), u, 1, 50)
    apart = np.abs(np.asarray(exact.state.position - hovering(places).position)).max()
    assert apart > 0.04
    np.testing.assert_allclose(large.state.position, exact.state.position, atol=0.1 * apart)
    assert float(large.neglected) < 1e-6


def test_a_large_swarm_says_what_it_neglects():
    # Six drones directly above one: two of them are not among its neighbours.
    places = [(0.01 * k, 0.0, 1.3 + 0.3 * k) for k in range(7)]
    flown = rollout_swarm(swarm(7), hovering(places), commands(20, 7), every=10)
    assert 1.0 < float(flown.neglected) < 4.0


def test_the_gradient_is_that_of_finite_differences():
    u = commands(30, 2)

    def height(x):
        state = hovering([(0.0, 0.0, 1.5), (0.0, 0.0, 1.0)])
        state = replace(state, position=state.position.at[1, 0].add(x))
        return rollout_swarm(swarm(2), state, u, every=30).state.position[-1, 1, 2]

    slope = jax.grad(height)(0.07)
    step = 1e-4
    assert float(slope) == pytest.approx(float((height(0.07 + step) - height(0.07 - step)) / (2 * step)), rel=1e-5)
    assert abs(float(slope)) > 1e-4


def test_what_is_missing_is_said():
    with pytest.raises(CfbError, match="add the effect downwash"):
        rollout_swarm(swarm(2, PLAIN), hovering([(0, 0, 1), (0, 0, 2)], PLAIN), commands(4, 2))
    with pytest.raises(CfbError, match="leading axis of drones"):
        rollout_swarm(MODEL, hovering([(0, 0, 1), (0, 0, 2)]), commands(4, 2))
    with pytest.raises(ValueError, match="cannot be kept"):
        rollout_swarm(swarm(2), hovering([(0, 0, 1), (0, 0, 2)]), commands(4, 2), every=3)


def test_a_drone_without_thrust_has_no_wake():
    state = hovering([(0.0, 0.0, 1.5), (0.0, 0.0, 1.0)])
    off = replace(state, rotor_speed=state.rotor_speed.at[0].set(0.0))
    assert float(thrust(MODEL.parameters, jnp.zeros(4)).sum()) == 0.0
    u = jnp.stack([jnp.zeros((20, 4)), jnp.tile(MODEL.hover_command(), (20, 1))], axis=1)
    flown = rollout_swarm(swarm(2), off, u, every=20)
    np.testing.assert_allclose(flown.state.position[-1, 1], [0.0, 0.0, 1.0], atol=1e-9)
