"""Rotor paths and step means against numerical quadrature, and invariants of random flights."""

from __future__ import annotations

import equinox as eqx
import helpers
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad

from cfb_mjx.model import Quadrotor, rotor_speed_history, rotors
from cfb_mjx.model.quadrotor import integrate_measured, prepare
from cfb_mjx.model.state import stack, unstack
from cfb_mjx.model.vector import Vec
from cfb_mjx.parameters import load_model_file

QUICK = settings(max_examples=25, deadline=None, derandomize=True)
PARAMETERS = eqx.tree_at(
    lambda p: (p.motor_time_constant, p.thrust_scale, p.torque_scale, p.motor_speed_offset),
    load_model_file("cfb-guards").parameters(),
    tuple(
        jnp.array(x)
        for x in ([0.03, 0.05, 0.07, 0.1], [0.9, 1.0, 1.1, 1.2], [1.2, 1.0, 0.8, 0.9], [0.0, 50.0, 100.0, 5.0])
    ),
)
CONSTANTS = helpers.constants_of(PARAMETERS)
four = lambda low, high: st.lists(st.floats(low, high), min_size=4, max_size=4).map(np.array)  # noqa: E731


@jax.jit
def _path(speed, target, dt):
    return rotors.path_to(rotors.prepare(PARAMETERS, dt), Vec.unstack(speed), Vec.unstack(target))


@jax.jit
def _straight(start, end, dt):
    return rotors.path_between(rotors.prepare(PARAMETERS, dt), Vec.unstack(start), Vec.unstack(end))


def _loads(speed):
    """Thrust without the clamp (the documented exception for means) and torque, all rotors."""
    s = speed / CONSTANTS.reference_rotor_speed
    powers = np.array([s**3, s**2, s])
    return (
        CONSTANTS.thrust_scale * (CONSTANTS.thrust_polynomial @ powers),
        CONSTANTS.torque_scale * (CONSTANTS.torque_polynomial @ powers),
    )


def _mean(function, dt):
    if dt == 0:
        return function(0.0)
    return np.array([quad(lambda t, i=i: function(t)[i], 0, dt, epsabs=0, epsrel=1e-11)[0] for i in range(4)]) / dt


@QUICK
@given(four(300, 3000), four(300, 3000), st.sampled_from([0.0, 1e-6, 0.001, 0.004, 0.02, 0.2]))
def test_means_along_the_exponential(speed, target, dt):
    path = _path(jnp.asarray(speed), jnp.asarray(target), dt)

    def at(t):
        return target + (speed - target) * np.exp(-t / CONSTANTS.motor_time_constant)

    np.testing.assert_allclose(path.start.stack(), speed)
    np.testing.assert_allclose(path.middle.stack(), at(dt / 2), rtol=1e-12)
    np.testing.assert_allclose(path.end.stack(), at(dt), rtol=1e-12)
    for t, rate in ((0, path.rate_start), (dt / 2, path.rate_middle), (dt, path.rate_end)):
        np.testing.assert_allclose(rate.stack(), (target - at(t)) / CONSTANTS.motor_time_constant, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(path.mean.thrust.stack(), _mean(lambda t: _loads(at(t))[0], dt), rtol=1e-7, atol=1e-12)
    np.testing.assert_allclose(path.mean.torque.stack(), _mean(lambda t: _loads(at(t))[1], dt), rtol=1e-7, atol=1e-14)
    if dt > 0:
        # Impulse of the reactive torque: the mean rate times dt is the change of speed.
        np.testing.assert_allclose(path.mean.rate.stack() * dt, at(dt) - speed, rtol=1e-7, atol=1e-9)


@QUICK
@given(four(300, 3000), four(300, 3000), st.sampled_from([0.0, 0.001, 0.01]))
def test_means_along_the_straight_line(start, end, dt):
    path = _straight(jnp.asarray(start), jnp.asarray(end), dt)

    def at(t):
        return start if dt == 0 else start + (end - start) * t / dt

    # Over no time a straight path from start to end still has its mean; nothing is integrated then.
    if dt > 0:
        np.testing.assert_allclose(path.mean.thrust.stack(), _mean(lambda t: _loads(at(t))[0], dt), rtol=1e-10)
        np.testing.assert_allclose(path.mean.torque.stack(), _mean(lambda t: _loads(at(t))[1], dt), rtol=1e-10)
        np.testing.assert_allclose(path.mean.rate.stack(), (end - start) / dt, rtol=1e-12)
    for leaf in jax.tree.leaves(path):
        assert np.all(np.isfinite(leaf))


@QUICK
@given(four(0, 600), four(0, 600))
def test_the_clamped_mean_is_within_the_documented_error(speed, target):
    """Where a rotor crosses 229 rad/s within a 4 ms step, the mean thrust is off by less than 0.8 mN."""
    path = _path(jnp.asarray(speed), jnp.asarray(target), 0.004)
    times = (np.arange(4000) + 0.5) * 1e-6
    at = target + (speed - target) * np.exp(-times[:, None] / CONSTANTS.motor_time_constant)
    exact = np.maximum(np.array([_loads(x)[0] for x in at[::20]]), 0).mean(axis=0)
    assert np.abs(path.mean.thrust.stack() - exact).max() < 0.8e-3 * 1.2  # the largest thrust_scale here
    assert np.all(np.asarray(path.mean.thrust.stack()) >= 0)


def test_history_is_the_exact_response():
    """Irregular rows, commands beyond the range, steady at the first row."""
    times = np.cumsum([0.0, 0.004, 0.004, 0.011, 0.002, 0.03])
    commands = np.random.default_rng(0).uniform(-0.2, 1.2, (6, 4))
    history = np.asarray(rotor_speed_history(PARAMETERS, jnp.asarray(times), jnp.asarray(commands)))
    steady = CONSTANTS.motor_gain * np.clip(commands, 0, 1) + CONSTANTS.motor_speed_offset
    np.testing.assert_allclose(history[0], steady[0])
    speed = steady[0]
    for i in range(5):
        decay = np.exp(-(times[i + 1] - times[i]) / CONSTANTS.motor_time_constant)
        speed = steady[i] + (speed - steady[i]) * decay
        np.testing.assert_allclose(history[i + 1], speed, rtol=1e-12)


@jax.jit
def _measured(state, end):
    prepared = prepare(Quadrotor(PARAMETERS, integrator="rk4", rotor_loads="instant"), 0.004)
    center = prepared.parameters.center_of_gravity
    return stack(integrate_measured(prepared, unstack(state, center), Vec.unstack(end)), center)


@QUICK
@given(four(300, 3000), st.integers(0, 2**31))
def test_measured_steps_keep_the_quaternion_unit_and_end_at_the_measurement(end, seed):
    random = np.random.default_rng(seed)
    y = np.concatenate([random.normal(size=6), random.normal(size=4), 15 * random.normal(size=3), end[::-1]])
    y[6:10] /= np.linalg.norm(y[6:10])
    after = helpers.pack(_measured(helpers.state_of(y), jnp.asarray(end)))
    np.testing.assert_allclose(helpers.part(after, "rotor_speed"), end)
    assert np.linalg.norm(helpers.part(after, "quaternion")) == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize("integrator", ["leapfrog", "euler", "rk4"])
def test_quaternions_stay_unit_in_aggressive_flight(integrator, fleet, fly_fleet):
    y, commands = helpers.aggressive_manoeuvre(2.0, seed=9)
    flown = helpers.pack(fly_fleet(Quadrotor(fleet, integrator=integrator), helpers.state_of(y), jnp.asarray(commands)))
    np.testing.assert_allclose(np.linalg.norm(helpers.part(flown, "quaternion"), axis=-1), 1.0, atol=1e-12)
