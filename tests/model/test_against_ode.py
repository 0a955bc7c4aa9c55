"""The simulator against SciPy's DOP853 on the paper's equations (see `helpers`), with held commands."""

from __future__ import annotations

import equinox as eqx
import helpers
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cfb_mjx.model import ParasiticDrag, Quadrotor, specific_force
from cfb_mjx.model.quadrotor import integrate_commanded, prepare
from cfb_mjx.model.state import stack, unstack
from cfb_mjx.model.vector import Vec


@pytest.fixture(scope="module")
def coarse():
    """160 ms of commands held for 16 ms; rotors stay above 229 rad/s, where the thrust clamp has its kink."""
    y, _ = helpers.aggressive_manoeuvre(0.2, seed=1)
    commands = np.random.default_rng(4).uniform(0.15, 1.0, (10, 4))
    return y, commands


@pytest.fixture(scope="module")
def coarse_truth(coarse, drones):
    y, commands = coarse
    return np.array([helpers.fly(helpers.constants_of(drone), y, commands, 0.016) for drone in drones])


@eqx.filter_jit
def _fly_in_steps(models, state, commands, dt, hold):
    """`rollout` with step and hold as numbers known at run time: one compilation serves every step size."""

    def fly(model):
        prepared = prepare(model, dt)
        center = prepared.parameters.center_of_gravity

        def one(components, row):
            components = jax.lax.fori_loop(0, hold, lambda _, c: integrate_commanded(prepared, c, row), components)
            return components, components

        return stack(jax.lax.scan(one, unstack(state, center), Vec.unstack(commands))[1], center)

    return jax.vmap(fly)(models)


# Measured orders. Constant mean loads in a step leave the correlation of thrust with attitude, hence 2 with "mean".
@pytest.mark.parametrize(
    ("integrator", "rotor_loads", "order"),
    [
        ("leapfrog", "instant", 2),
        ("leapfrog", "mean", 2),
        ("euler", "instant", 1),
        ("euler", "mean", 1),
        ("rk4", "instant", 4),
        ("rk4", "mean", 2),
    ],
)
def test_error_falls_at_the_integrators_order(integrator, rotor_loads, order, coarse, coarse_truth, fleet):
    y, commands = coarse
    steps = np.array([0.008, 0.004, 0.002, 0.001])
    errors = {name: [] for name in ("position", "velocity", "quaternion", "body_rate")}
    for dt in steps:
        model = Quadrotor(fleet, integrator=integrator, rotor_loads=rotor_loads)
        hold = jnp.asarray(round(0.016 / dt))
        flown = helpers.pack(_fly_in_steps(model, helpers.state_of(y), jnp.asarray(commands), jnp.asarray(dt), hold))
        np.testing.assert_allclose(
            helpers.part(flown, "rotor_speed"), helpers.part(coarse_truth, "rotor_speed"), rtol=1e-9
        )
        for name, values in errors.items():
            values.append(np.linalg.norm(helpers.part(flown - coarse_truth, name), axis=-1)[:, -1])
    for name, values in errors.items():
        for drone in range(3):
            slope = helpers.order_of(steps, np.array(values)[:, drone])
            print(f"{integrator} {rotor_loads} drone {drone} {name}: order {slope:.2f}")
            assert order - 0.3 < slope < order + 0.5, f"{name} of drone {drone}: order {slope:.2f}"


@pytest.fixture(scope="module")
def flips(drones):
    """200 ms at 250 Hz over the full command range, from several seeds and drones, and the truth."""
    cases = []
    for seed in range(2):
        y, commands = helpers.aggressive_manoeuvre(0.2, seed=seed)
        truth = np.array([helpers.fly(helpers.constants_of(drone), y, commands, 0.004) for drone in drones])
        cases.append((y, commands, truth))
    return cases


def test_the_flips_are_aggressive(flips):
    for _, commands, truth in flips:
        assert np.abs(helpers.part(truth, "body_rate")).max() > 15
        assert commands.min() == 0.0
        assert commands.max() == 1.0


@pytest.mark.parametrize(("rotor_loads", "position_mm", "attitude_deg"), [("instant", 1e-3, 1e-3), ("mean", 1.0, 0.2)])
def test_rk4_at_4_ms_follows_a_flip(rotor_loads, position_mm, attitude_deg, flips, fleet, fly_fleet):
    model = Quadrotor(fleet, integrator="rk4", rotor_loads=rotor_loads)
    for y, commands, truth in flips:
        flown = helpers.pack(fly_fleet(model, helpers.state_of(y), jnp.asarray(commands)))
        distance = np.linalg.norm(helpers.part(flown - truth, "position"), axis=-1)
        angle = helpers.attitude_error(helpers.part(flown, "quaternion"), helpers.part(truth, "quaternion"))
        assert 1e3 * distance.max() < position_mm
        assert np.degrees(angle.max()) < attitude_deg


def test_rotor_speed_is_exact(flips, drones, fleet, fly_fleet):
    """Eq. 5 with held commands is an exponential; DOP853 is too coarse a reference for 1e-12, the formula is not."""
    model = Quadrotor(fleet, integrator="rk4", rotor_loads="mean")
    y, commands, truth = flips[0]
    flown = helpers.part(helpers.pack(fly_fleet(model, helpers.state_of(y), jnp.asarray(commands))), "rotor_speed")
    np.testing.assert_allclose(flown, helpers.part(truth, "rotor_speed"), rtol=1e-9)
    for drone, got in zip(drones, flown, strict=True):
        c = helpers.constants_of(drone)
        speed = helpers.part(y, "rotor_speed")
        for i, command in enumerate(commands):
            steady = c.motor_gain * command + c.motor_speed_offset
            speed = steady + (speed - steady) * np.exp(-0.004 / c.motor_time_constant)
            np.testing.assert_allclose(got[i], speed, rtol=1e-12)


def test_drag_follows_the_ode(flips, off_center, fly_fleet):
    """The effect acts at the rotors' centre, also where the centre of gravity is elsewhere."""
    drag = ParasiticDrag(linear=[0.03, 0.02, 0.04], quadratic=[0.005, 0.02, 0.01])
    model = Quadrotor(off_center, effects=(drag,), integrator="rk4", rotor_loads="instant")
    y, commands, undragged = flips[0]
    constants = helpers.constants_of(off_center, {"linear": drag.linear, "quadratic": drag.quadratic})
    truth = helpers.fly(constants, y, commands, 0.004)
    batched = jax.tree.map(lambda x: x[None], model)
    flown = helpers.pack(fly_fleet(batched, helpers.state_of(y), jnp.asarray(commands)))[0]
    # |v| v has a kink where a component passes zero, so the order drops a little there.
    assert np.abs(helpers.part(flown - truth, "position")).max() < 1e-5
    assert np.abs(helpers.part(flown - truth, "body_rate")).max() < 1e-4
    assert np.abs(helpers.part(truth - undragged[1], "position")).max() > 1e-3


@pytest.mark.parametrize("time", [0.1, 0.4])
def test_euler_is_off_by_half_a_step_of_velocity(time, fleet, fly_fleet):
    """Constant vertical acceleration a: semi-implicit Euler ends dt/2 x a x t too far, velocity exact."""
    dt, command = 0.004, 0.8
    model = Quadrotor(fleet, integrator="euler", rotor_loads="instant")
    y = np.zeros(17)
    y[6] = 1.0
    y[13:] = 2900.0 * command  # nominal drone: steady from the start
    commands = jnp.full((100, 4), command)
    flown = helpers.pack(fly_fleet(model, helpers.state_of(y), commands))[0, round(time / dt) - 1]
    thrust, _ = helpers.rotor_forces(helpers.Constants(), y[13:])
    acceleration = thrust.sum() / 0.044 - 9.81
    assert flown[5] == pytest.approx(acceleration * time, rel=1e-9)
    error = flown[2] - 0.5 * acceleration * time**2
    assert error / (dt / 2 * acceleration * time) == pytest.approx(1.0, abs=1e-6)


def test_specific_force_is_the_acceleration_of_the_rotors_centre_without_gravity(off_center):
    """A tumbling drone with its centre of gravity elsewhere, against the coupled Newton-Euler equations."""
    y, _ = helpers.aggressive_manoeuvre(0.1)
    constants = helpers.constants_of(off_center)
    # Commands at which the rotors keep their speed: no reactive torque.
    steady = (helpers.part(y, "rotor_speed") - constants.motor_speed_offset) / constants.motor_gain
    acceleration = helpers.ode(constants, steady)(0.0, y)[3:6] + np.array([0.0, 0.0, constants.gravity])
    felt = helpers.rotation_matrix(helpers.part(y, "quaternion")).T @ acceleration
    assert np.abs(felt[:2]).min() > 0.1
    np.testing.assert_allclose(specific_force(Quadrotor(off_center), helpers.state_of(y)), felt, rtol=1e-9)
