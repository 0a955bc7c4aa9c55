"""Each effect against physics done apart from the library: closed forms, SciPy, conservation laws."""

from __future__ import annotations

import dataclasses
import functools

import equinox as eqx
import helpers
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from cfb_mjx.model import Quadrotor, State, begin, rollout, rotors, step
from cfb_mjx.model.effects import (
    CATALOGUE,
    BatterySag,
    BladeFlapping,
    CogOffset,
    CommandDelay,
    Condition,
    EscRateLimit,
    GroundEffect,
    Gust,
    Gyroscopic,
    Inertia,
    InertiaProducts,
    InflowThrust,
    Jet,
    MotorAsymmetry,
    MotorGainMismatch,
    MotorHysteresis,
    Motors,
    MotorSecondOrder,
    MotorThermalDrift,
    MotorTimeConstant,
    ParasiticDrag,
    Payload,
    PayloadSwing,
    PositionMoment,
    RateDamping,
    Reading,
    RotorDrag,
    ThrustScale,
    ThrustTilt,
    TorqueScale,
    TranslationalLift,
    VortexRing,
    WallEffect,
    Wind,
)
from cfb_mjx.model.quadrotor import conditions, loaded, prepare
from cfb_mjx.model.state import unstack
from cfb_mjx.model.vector import Vec
from cfb_mjx.parameters import load_model_file

# They share what one worker compiled.
ONE_WORKER = pytest.mark.xdist_group("effects_physics")


def _batch(models):
    return jax.tree.map(lambda *x: jnp.stack(x), *models)


# Forces and torques on the body: every effect alone, and all together, against an ODE written rotor by rotor.

AIR = {
    "inflow_thrust": InflowThrust(0.02),
    "translational_lift": TranslationalLift(0.002),
    "vortex_ring": VortexRing(0.005, 1.2),
    "ground_effect": GroundEffect(0.15, 0.15),
    "wall_effect": WallEffect(-0.2, 0.25, [0.0, -2.0, 1.0], 0.8),
    "gyroscopic": Gyroscopic(4.0),
    "thrust_tilt": ThrustTilt([0.04, -0.03], 0.05),
    "rotor_drag": RotorDrag(0.04),
    "parasitic_drag": ParasiticDrag(0.0, 0.01),
    "blade_flapping": BladeFlapping(8e-4, [0.3, -0.2], 0.2, 1.7, 0.3, -0.15),
    "wind": Wind([2.0, -1.0, 0.5], 0.03),
    "rate_damping": RateDamping(1.5e-4),
    "position_moment": PositionMoment([4e-4, -3e-4]),
    "gust": Gust([2.0, 1.0, 0.5], time_scale=0.05, seed=3.0),
    "jet": Jet(5.0, origin=[0.2, -0.5, 0.15], direction=[0.6, 0.1, 0.2], width=0.2),
}
MOVED = ("rotor_drag", "parasitic_drag", "inflow_thrust", "translational_lift", "vortex_ring", "blade_flapping")
"""Effects without which moving air does nothing."""


def _air(y, time, on):
    """Velocity of the air at the rotors' centre, world. The gust is that of the library, held through a step."""
    air = np.zeros(3)
    if "wind" in on:
        air += [2.0, -1.0, 0.5]
    if "gust" in on:
        air += np.asarray(AIR["gust"].at(time).stack())
    if "jet" in on:
        axis = np.array([0.6, 0.1, 0.2]) / np.linalg.norm([0.6, 0.1, 0.2])
        away = y[:3] - [0.2, -0.5, 0.15]
        ahead = away @ axis
        beside = np.linalg.norm(np.cross(axis, away))
        half = 0.2 + 0.1 * max(ahead, 0.0)
        air += axis * 5.0 * 0.2 / half * 2 ** -((beside / half) ** 2) / (1 + np.exp(-4 * ahead / 0.2))
    return air


def _wrench(constants, y, on, time, conductance=0.03):
    """Force and torque about the rotors' centre that the effects ``on`` add to the rotors', body axes."""
    matrix, rate, speed = helpers.rotation_matrix(y[6:10]), y[10:13], y[13:17]
    air = matrix.T @ _air(y, time, on)
    v = matrix.T @ y[3:6] - air
    plain, _ = helpers.rotor_forces(constants, speed)
    force, torque = np.zeros(3), np.zeros(3)
    for i in range(4):
        arm = constants.rotor_spacing / 2 * np.array([helpers.ROTOR_X[i], helpers.ROTOR_Y[i], 0.0])
        at_hub = v + np.cross(rate, arm)
        thrust = plain[i]
        if "inflow_thrust" in on:
            thrust -= 0.02 * speed[i] / 1594 * at_hub[2]
        if "translational_lift" in on:
            thrust += 0.002 * np.hypot(at_hub[0], at_hub[1]) ** 2
        if "vortex_ring" in on:
            hover = 1.2 * speed[i] / 1594
            share = min(max(at_hub[2] / hover, -2.0), 0.0)
            thrust -= 0.005 * speed[i] / 1594 * hover * np.polyval([-0.655, -1.718, -1.372, -1.125, 0.0], share)
        if "ground_effect" in on:
            height = y[2] + (matrix @ arm)[2]
            thrust *= 1 + 0.15 * (0.15**2 + 0.1**2) / (0.15**2 + height**2)
        if "wall_effect" in on:
            place = y[:3] + matrix @ arm
            away = max(0.8 - place @ [0.0, -2.0, 1.0] / 5**0.5, 0.0)
            thrust *= 1 - 0.2 * (0.25**2 + 0.1**2) / (0.25**2 + away**2)
        here = np.array([0.0, 0.0, thrust - plain[i]])
        if "thrust_tilt" in on:
            round_ = np.cross([0.0, 0.0, 1.0], arm) / np.linalg.norm(arm)
            here += thrust * (np.array([0.04, -0.03, 0.0]) + 0.05 * round_)
        if "rotor_drag" in on:
            here[:2] -= 0.04 / 4 * speed[i] / 1594 * at_hub[:2]
        force += here
        torque += np.cross(arm, here)
        if "gyroscopic" in on:
            # A rotor that pushes the body about +z turns about -z. Four times the inertia of a rotor.
            torque -= np.cross(rate, [0.0, 0.0, -helpers.YAW[i] * 2e-7 * speed[i]])
    if "parasitic_drag" in on:
        force -= 0.01 * np.abs(v) * v
    if "blade_flapping" in on:
        along_x, along_y = np.exp(np.array([0.3, -0.2]) * v[2])
        hub = np.array([-0.8 * v[1] * along_y, 1.2 * v[0] * along_x, 0.0]) + 0.3 * v * [1.0, 1.0, 0.0]
        torque += 8e-4 * (speed.mean() / 1594) ** 1.7 * np.exp(-0.15 * np.sqrt(v[0] ** 2 + v[1] ** 2 + 1e-4)) * hub
    if "rate_damping" in on:
        torque -= 1.5e-4 * speed.mean() / 1594 * rate * [1.0, 1.0, 0.0]
    if "wind" in on:
        force += conductance * matrix.T @ [2.0, -1.0, 0.5]
    if "position_moment" in on:
        # As blade flapping of an airspeed that grows with the distance from the middle.
        place = y[:3] + matrix @ constants.center_of_gravity
        airspeed = matrix.T @ [4e-4 * place[0], -3e-4 * place[1], 0.0]
        torque += speed.mean() / 1594 * np.cross([0.0, 0.0, 1.0], airspeed)
    return force, torque


def _truth(constants, y, commands, on):
    m, cx = constants.mass, helpers.cross_matrix(constants.center_of_gravity)
    about_center = np.diag(constants.inertia) - m * cx @ cx
    inverse = np.linalg.inv(np.block([[m * np.eye(3), -m * cx], [m * cx, about_center]]))
    rows = []
    for k, command in enumerate(commands):
        basic = helpers.ode(constants, command)

        def rates(t, y, basic=basic, time=0.004 * k):
            added = inverse @ np.concatenate(_wrench(constants, y, on, time))
            rate = basic(t, y)
            rate[3:6] += helpers.rotation_matrix(y[6:10]) @ added[:3]
            rate[10:13] += added[3:]
            return rate

        y = solve_ivp(rates, (0.0, 0.004), y, method="DOP853", rtol=1e-9, atol=1e-10, first_step=0.002).y[:, -1]
        rows.append(y)
    return np.array(rows)


@pytest.fixture(scope="module")
def low_flight():
    y, commands = helpers.aggressive_manoeuvre(0.08, seed=2)
    # Low, and sinking into its own wake.
    y[:3], y[5] = (0.6, -0.4, 0.2), -0.7
    return y, commands


@pytest.fixture(scope="module")
def in_air(off_center, low_flight, fly_fleet):
    """Flown with no effect, every effect alone, and all of them, by name; the centre of gravity is off centre."""
    y, commands = low_flight
    cases = {"none": (), **{name: (name,) for name in AIR}, "all": tuple(AIR)}
    # In moving air alone nothing would happen.
    cases |= {name: (name, *MOVED) for name in ("gust", "jet")}
    cases["still"] = MOVED
    models = []
    for on in cases.values():
        effects = tuple(effect if name in on else type(effect).neutral() for name, effect in AIR.items())
        models.append(Quadrotor(off_center, effects, integrator="rk4"))
    flown = helpers.pack(fly_fleet(_batch(models), helpers.state_of(y), jnp.asarray(commands)))
    return {name: (on, rows) for (name, on), rows in zip(cases.items(), flown, strict=True)}


@ONE_WORKER
@pytest.mark.parametrize("name", [*AIR, "all"])
def test_wrench_follows_the_ode(name, in_air, off_center, low_flight):
    on, flown = in_air[name]
    truth = _truth(helpers.constants_of(off_center), *low_flight, on)
    for part, tolerance in (("position", 1e-6), ("velocity", 1e-4), ("body_rate", 1e-3)):
        assert np.abs(helpers.part(flown - truth, part)).max() < tolerance, part
    seen = np.abs(flown - in_air["still" if name in ("gust", "jet") else "none"][1])
    assert helpers.part(seen, "position").max() > 1e-5 or helpers.part(seen, "body_rate").max() > 1e-2


def test_inflow_damps_roll_at_its_closed_form(guards, fly_fleet):
    """Hub i moves with p y_i, so the torque is -c l^2 p at hover and p dies exponentially."""
    coefficient = 0.02
    model = Quadrotor(guards, (InflowThrust(coefficient),), integrator="rk4")
    state = dataclasses.replace(model.hover_state(), body_rate=jnp.array([2.0, 0.0, 0.0]))
    flown = fly_fleet(_batch([model]), state, jnp.tile(model.hover_command(), (50, 1)))
    hover = float(state.rotor_speed[0]) / 1594
    rate = coefficient * hover * float(guards.rotor_spacing) ** 2 / float(guards.inertia[0])
    t = 0.004 * np.arange(1, 51)
    np.testing.assert_allclose(flown.body_rate[0, :, 0], 2.0 * np.exp(-rate * t), rtol=1e-7)
    np.testing.assert_allclose(flown.body_rate[0, :, 1:], 0, atol=1e-12)


def _felt(parameters, effects, state):
    """Force and torque about the rotors' centre, body axes."""
    model = Quadrotor(parameters, effects)
    prepared = prepare(model)
    at = unstack(begin(model, state), prepared.parameters.center_of_gravity)
    loads = rotors.loads_at(prepared.rotors, at.rotor_speed, 0.0 * at.rotor_speed)
    wrench = loaded(model, prepared.parameters, loads, conditions(prepared, at, at.rotor_speed))
    return np.concatenate([wrench.force.stack(), wrench.torque.stack()])


@pytest.mark.parametrize("name", [name for name, kind in CATALOGUE.items() if kind.feels_air])
def test_moving_air_does_what_moving_through_still_air_does(name, off_center):
    """Galilean invariance: at rest in air that moves, and moving the other way through still air."""
    effect, air = (
        {"parasitic_drag": ParasiticDrag([0.01, 0.02, 0.03], 0.01, 0.5)}.get(name, AIR[name]),
        [2.0, -1.0, 0.5],
    )
    y, _ = helpers.aggressive_manoeuvre(0.01, seed=4)
    still = helpers.state_of(y)
    there = dataclasses.replace(still, velocity=still.velocity - jnp.array(air))
    moving, resting = _felt(off_center, (effect,), there), _felt(off_center, (effect, Wind(air, 0.0)), still)
    np.testing.assert_allclose(resting, moving, rtol=1e-12, atol=1e-15)
    assert np.abs(_felt(off_center, (effect,), still) - moving).max() > 1e-6


def test_a_conductance_is_the_drag_of_what_no_other_effect_describes(off_center):
    """Alone it is the constant force it always was; at zero beside a drag the drag carries the wind."""
    y, _ = helpers.aggressive_manoeuvre(0.01, seed=4)
    state, air = helpers.state_of(y), np.array([2.0, -1.0, 0.5])
    matrix = helpers.rotation_matrix(y[6:10])

    def force(*effects):
        return matrix @ (_felt(off_center, effects, state) - _felt(off_center, (), state))[:3]

    np.testing.assert_allclose(force(Wind(air, 0.02)), 0.02 * air, rtol=1e-9)
    drag = ParasiticDrag(0.02, 0.0)
    np.testing.assert_allclose(force(Wind(air, 0.0), drag) - force(drag), 0.02 * air, rtol=1e-9)
    assert force(Wind(air, 0.0)) == pytest.approx(0.0, abs=1e-15)
    # As a search has it: a force, whatever drag there is.
    np.testing.assert_allclose(force(Wind(air, 0.02, felt=0.0), drag) - force(drag), 0.02 * air, rtol=1e-9)


def test_a_gust_has_the_spectrum_it_states():
    """Over many seeds: zero mean, the intensity, the exponential autocorrelation, and axes that know nothing of
    each other."""
    lags = np.arange(0.0, 4.0, 0.1)

    def path(seed):
        return jax.vmap(lambda t: Gust([2.0, 1.0, 0.5], 0.5, seed).at(t).stack())(0.5 * jnp.arange(0.0, 12.0, 0.1))

    gust = np.asarray(jax.jit(jax.vmap(path))(jnp.arange(1000.0))) / [2.0, 1.0, 0.5]
    np.testing.assert_allclose(gust.mean((0, 1)), 0.0, atol=0.03)
    np.testing.assert_allclose(gust.std((0, 1)), 1.0, atol=0.02)
    known = [np.mean(gust[:, :80] * gust[:, k : 80 + k], axis=(0, 1)) for k in range(len(lags))]
    np.testing.assert_allclose(known, np.exp(-lags)[:, None] * np.ones(3), atol=0.06)
    assert np.abs(np.corrcoef(gust[:, ::10].reshape(-1, 3).T) - np.eye(3)).max() < 0.05
    # And one seed is as unlike the next as any.
    assert abs(np.mean(gust[1:, 0] * gust[:-1, 0])) < 0.1


def test_a_jet_keeps_its_momentum_and_halves_at_its_width():
    parameters = prepare(Quadrotor(load_model_file("cfb-guards").parameters())).parameters
    jet = Jet(5.0, origin=[1.0, 0.0, 0.0], direction=[0.0, 2.0, 0.0], width=0.2, spreading=0.1)
    zero = Vec(*jnp.zeros(3))

    def air(x, z, y):
        place = Vec(*map(jnp.asarray, (x, y, z)))
        level = Vec(1.0, 0.0, 0.0, 0.0)
        return jet.air(Condition(place, zero, zero, zero, level, zero, Vec(*jnp.zeros(4)), parameters))

    def along(r, y):
        return float(air(1.0 + r, 0.0, y)[1])

    for far in (0.5, 2.0, 4.0):
        half = 0.2 + 0.1 * far
        assert along(half, far) == pytest.approx(0.5 * along(0.0, far), rel=1e-6)
        r = np.linspace(0.0, 5 * half, 200)
        flux = np.trapezoid([along(x, far) ** 2 * x for x in r], r)
        # Of a Gaussian: the speed at the fan squared, times its width squared, over 4 ln 2.
        assert flux == pytest.approx(25.0 * 0.04 / (4 * np.log(2)), rel=1e-3)
    # Far away it has slowed down as 1 / distance; behind the fan nothing moves.
    assert along(0.0, 8.0) / along(0.0, 3.0) == pytest.approx(0.5, rel=1e-6)
    assert abs(along(0.0, -0.5)) < 1e-3
    assert [float(air(1.0, 0.0, 1.0)[i]) for i in (0, 2)] == [0.0, 0.0]


def test_gyroscopic_torque_does_no_work(guards, fly_fleet):
    """A body in free rotation with rotors of unequal speed: its energy and the total angular momentum stay."""
    nothing = jnp.zeros(3)
    free = eqx.tree_at(
        lambda p: (p.gravity, p.thrust_polynomial, p.torque_polynomial), guards, (jnp.zeros(()), nothing, nothing)
    )
    model = Quadrotor(free, (Gyroscopic(4.0),), integrator="rk4", dt=0.002)
    speed = np.array([1000.0, 2000.0, 500.0, 2500.0])
    y = np.zeros(17)
    y[6], y[10:13], y[13:] = 1.0, [8.0, -5.0, 3.0], speed
    flown = helpers.pack(fly_fleet(_batch([model]), helpers.state_of(y), jnp.tile(speed / 2900, (250, 1))))[0]
    rate, inertia = helpers.part(flown, "body_rate"), np.asarray(guards.inertia)
    np.testing.assert_allclose((rate**2) @ inertia, (y[10:13] ** 2) @ inertia, rtol=1e-6)
    own = 2e-7 * np.array([0.0, 0.0, 1.0]) * np.sum([1, -1, 1, -1] * speed)
    total = [helpers.rotation_matrix(q) @ (inertia * w + own) for q, w in zip(flown[:, 6:10], rate, strict=True)]
    np.testing.assert_allclose(total, np.tile(inertia * y[10:13] + own, (250, 1)), rtol=1e-5, atol=1e-9)
    # What the body alone has of it does not stay: the rotors take part.
    assert np.ptp(np.linalg.norm(inertia * rate, axis=1)) > 0.02 * np.linalg.norm(inertia * y[10:13])


# The drone itself.


def test_effects_on_parameters_are_those_written_by_hand(guards):
    cases = [
        (ThrustScale(0.1), "thrust_scale", np.full(4, 1.1)),
        (TorqueScale(-0.2), "torque_scale", np.full(4, 0.8)),
        (Inertia([0.1, -0.1, 0.2]), "inertia", np.asarray(guards.inertia) * [1.1, 0.9, 1.2]),
        (CogOffset([0.01, -0.02]), "center_of_gravity", [0.01, -0.02, 0.0]),
        (MotorGainMismatch([0.1, 0.0, -0.1, 0.05]), "motor_gain", 2900 * np.array([1.1, 1.0, 0.9, 1.05])),
        (MotorTimeConstant(0.5), "motor_time_constant", np.full(4, 0.075)),
    ]
    for effect, name, wanted in cases:
        changed = Quadrotor(guards, (effect,)).changed_parameters()
        np.testing.assert_allclose(getattr(changed, name), wanted, rtol=1e-14)
        back = eqx.tree_at(lambda p, n=name: getattr(p, n), changed, getattr(guards, name))
        jax.tree.map(np.testing.assert_array_equal, back, guards)


def test_payload_is_two_bodies_in_one(guards):
    """Mass, centre and inertia of the sum, taken about the rotors' centre and brought to the common centre."""
    base = eqx.tree_at(lambda p: p.center_of_gravity, guards, jnp.array([0.0, 0.0, 0.004]))
    changed = Quadrotor(base, (Payload(0.012, -0.03),)).changed_parameters()
    m, extra = 0.044, 0.012
    assert float(changed.mass) == pytest.approx(m + extra, rel=1e-14)
    center = (m * 0.004 - extra * 0.03) / (m + extra)
    np.testing.assert_allclose(changed.center_of_gravity, [0, 0, center], rtol=1e-12)
    about_rotors = np.asarray(guards.inertia)[:2] + m * 0.004**2 + extra * 0.03**2
    np.testing.assert_allclose(changed.inertia[:2], about_rotors - (m + extra) * center**2, rtol=1e-12)
    np.testing.assert_allclose(changed.inertia[2], guards.inertia[2], rtol=1e-14)


def test_payload_beside_the_axis_is_two_bodies_in_one(guards):
    """The moments about each axis of two point masses about their common centre, and of the drone about its own."""
    place, m, extra = np.array([0.004, -0.006, -0.02]), 0.044, 0.01
    changed = Quadrotor(guards, (Payload(extra, place[2], place[:2]),)).changed_parameters()
    center = extra * place / (m + extra)
    np.testing.assert_allclose(changed.center_of_gravity, center, rtol=1e-12)
    added = np.zeros(3)
    for mass, at in ((m, np.zeros(3)), (extra, place)):
        x, y, z = at - center
        added += mass * np.array([y**2 + z**2, x**2 + z**2, x**2 + y**2])
    np.testing.assert_allclose(changed.inertia, np.asarray(guards.inertia) + added, rtol=1e-12)


@pytest.mark.parametrize("integrator", ["rk4", "leapfrog"])
def test_products_of_inertia_fly_as_the_ode_does(guards, fly_fleet, integrator):
    """The whole tensor in the coupled equations about the rotors' centre, the centre of gravity beside it."""
    relative, center = np.array([0.1, -0.2, 0.15]), np.array([0.003, -0.002, 0.004])
    moments = np.asarray(guards.inertia)
    tensor = np.diag(moments)
    for share, (i, j) in zip(relative, ((0, 1), (0, 2), (1, 2)), strict=True):
        tensor[i, j] = tensor[j, i] = share * np.sqrt(moments[i] * moments[j])
    beside = eqx.tree_at(lambda p: p.center_of_gravity, guards, jnp.asarray(center))
    model = Quadrotor(beside, (InertiaProducts(relative),), dt=0.002, integrator=integrator)
    y, commands = helpers.aggressive_manoeuvre(0.1, interval=0.002, seed=3)
    flown = helpers.pack(fly_fleet(_batch([model]), helpers.state_of(y), jnp.asarray(commands)))[0]
    diagonal = helpers.constants_of(beside)
    truth = helpers.fly(dataclasses.replace(diagonal, inertia=tensor), y, commands, 0.002)
    without = helpers.fly(diagonal, y, commands, 0.002)
    missed, made = (np.abs(helpers.part(truth - x, "body_rate")).max() for x in (flown, without))
    # Leapfrog sees the rates before the kick: first order in what the products make of them.
    assert missed < (1e-6 if integrator == "rk4" else 0.02) * made


def test_a_body_that_lies_askew_spins_as_in_mujoco(guards, fly_fleet):
    """Free of forces, against MuJoCo's own integrator and its full inertia."""
    moments = np.asarray(guards.inertia)
    products = np.array([0.06, -0.08, 0.05]) * np.sqrt(moments[[0, 0, 1]] * moments[[1, 2, 2]])
    numbers = " ".join(map(repr, map(float, (*moments, *products))))
    body = f'<body><freejoint/><inertial pos="0 0 0" mass="0.044" fullinertia="{numbers}"/></body>'
    options = '<option gravity="0 0 0" timestep="0.0005" integrator="RK4"/>'
    theirs = mujoco.MjModel.from_xml_string(f"<mujoco>{options}<worldbody>{body}</worldbody></mujoco>")
    data = mujoco.MjData(theirs)
    data.qvel[3:] = 9.0, -6.0, 4.0
    for _ in range(1000):
        mujoco.mj_step(theirs, data)
    still = guards
    for name in ("gravity", "thrust_scale", "torque_scale", "rotor_inertia"):
        still = eqx.tree_at(lambda p, n=name: getattr(p, n), still, jnp.zeros_like(getattr(guards, name)))
    model = Quadrotor(still, (InertiaProducts([0.06, -0.08, 0.05]),), dt=0.001, integrator="rk4")
    y = np.zeros(17)
    y[6], y[10:13] = 1.0, (9.0, -6.0, 4.0)
    ours = helpers.pack(fly_fleet(_batch([model]), helpers.state_of(y), jnp.zeros((500, 4))))[0, -1]
    np.testing.assert_allclose(helpers.part(ours, "body_rate"), data.qvel[3:], atol=1e-6)
    assert helpers.attitude_error(ours[6:10][None], data.qpos[3:][None]).max() < 1e-6
    # The principal axes' own spin would be another.
    assert np.abs(data.qvel[3:] - [9.0, -6.0, 4.0]).max() > 1.0


# Commands and motors.


@functools.partial(jax.jit, compiler_options=helpers.QUICK_COMPILE)
def _received(effect, parameters, speed, steps, commands):
    """What the motors get of ``commands`` held for ``steps``, one motor map for all."""
    model = Quadrotor(parameters, (effect,))
    memory = begin(model, State.at_rest(rotor_speed=speed)).memory[0]

    def one(memory, row):
        dt, command = row
        memory = jax.tree.map(Vec.unstack, memory)
        command, memory = effect.command(Vec.unstack(command), memory, dt, parameters)
        return jax.tree.map(lambda v: v.stack(), memory, is_leaf=lambda x: isinstance(x, Vec)), command.stack()

    return jax.lax.scan(one, memory, (steps, commands))[1]


@pytest.fixture(scope="module")
def uneven():
    """Commands held for uneven times, some of them none; before the first: 0.5 for ever."""
    random = np.random.default_rng(5)
    steps = random.uniform(0.002, 0.006, 60)
    steps[::7] = 0.0
    return steps, random.uniform(0.0, 1.0, (60, 4))


@pytest.mark.parametrize("delay", [0.0, 0.003, 0.004, 0.0101])
def test_delayed_commands_are_exact_means(delay, uneven, guards):
    """Mean of u(t - delay) over a step = difference of the integral of u at its delayed ends."""
    steps, commands = uneven
    got = _received(CommandDelay(delay), guards, jnp.full(4, 1450.0), steps, commands)
    t = np.concatenate([[-1.0, 0.0], np.cumsum(steps)])
    integral = np.concatenate([[np.full(4, -0.5)], np.zeros((1, 4)), np.cumsum(commands * steps[:, None], axis=0)])
    begins = np.concatenate([[0.0], np.cumsum(steps)[:-1]]) - delay
    for motor in range(4):
        area = np.interp(begins + steps, t, integral[:, motor]) - np.interp(begins, t, integral[:, motor])
        held = steps > 0
        np.testing.assert_allclose(np.asarray(got)[held, motor], area[held] / steps[held], rtol=1e-9, atol=1e-12)


def test_a_step_without_duration_shows_the_command_of_its_instant(guards):
    steps = jnp.array([0.004, 0.004, 0.0, 0.0, 0.004])
    commands = jnp.tile(jnp.array([0.1, 0.2, 0.3, 0.4, 0.6])[:, None], (1, 4))
    got = _received(CommandDelay(0.006), guards, jnp.full(4, 1450.0), steps, commands)
    # At 8 ms: what was given at 2 ms. What is given for no time acts for no time.
    np.testing.assert_allclose(got[:, 0], [0.5, 0.3, 0.1, 0.1, 0.15], rtol=1e-12)


@pytest.mark.parametrize(("dt", "substeps"), [(0.001, 1), (0.004, 4), (0.004, 1)])
def test_the_longest_delay_is_flown_at_any_step(dt, substeps, guards):
    """20 ms, the largest of the range: what the motors got is what was commanded then, step for step."""
    steps = round(0.1 / dt)
    commands = np.random.default_rng(2).uniform(0.0, 1.0, (steps, 4))
    model = Quadrotor(guards, (CommandDelay(0.020),), dt=dt, substeps=substeps)
    prompt = Quadrotor(guards, dt=dt, substeps=substeps)
    start = State.at_rest(rotor_speed=jnp.full(4, 1450.0))
    late, at_once = (rollout(m, start, jnp.asarray(commands)).rotor_speed for m in (model, prompt))
    ago = round(0.020 / dt)
    np.testing.assert_allclose(late[:ago], 1450.0, rtol=1e-9)
    np.testing.assert_allclose(late[ago:], at_once[:-ago], rtol=1e-9)


def test_a_delay_outlasts_any_number_of_commands(guards):
    """Commands every millisecond through a memory made for steps of 4 ms: less sharp, and as late as it says."""
    ramp = jnp.linspace(0.0, 1.0, 101)[:, None] * jnp.ones(4)
    got = _received(CommandDelay(0.020), guards, jnp.full(4, 1.0), jnp.full(101, 0.001), ramp)
    at = 0.01 * (np.arange(101) - 20)
    np.testing.assert_allclose(np.asarray(got)[30:, 0], at[30:], atol=0.01 * 20 / 7)
    assert abs(np.mean(np.asarray(got)[30:, 0] - at[30:])) < 0.01


def test_delay_shifts_the_rotors_by_exactly_the_delay(guards, fly_fleet):
    rows = (0, 3, 5)
    models = [Quadrotor(guards, (CommandDelay(0.004 * n),)) for n in rows]
    _, commands = helpers.aggressive_manoeuvre(0.1)
    flown = fly_fleet(_batch(models), models[0].hover_state(), jnp.asarray(commands)).rotor_speed
    for n, speed in zip(rows, flown, strict=True):
        np.testing.assert_allclose(speed[n:], flown[0][: len(commands) - n], rtol=1e-9)
        np.testing.assert_allclose(speed[:n], models[0].hover_state().rotor_speed[0], rtol=1e-9)


def test_rate_limit_ramps(uneven, guards):
    """A ramp of 1 / slowness that stops at the command: its mean over each step, from many small steps."""
    steps, commands = uneven
    got = np.asarray(_received(EscRateLimit(0.02), guards, jnp.full(4, 1450.0), steps, commands))
    output, count, reached = np.full(4, 0.5), 2000, 0
    for dt, command, mean in zip(steps, commands, got, strict=True):
        begin_, path = output, []
        for k in range(count):
            limit = (k + 0.5) / count * dt / 0.02
            path.append(begin_ + np.clip(command - begin_, -limit, limit))
        output = begin_ + np.clip(command - begin_, -dt / 0.02, dt / 0.02)
        reached += np.sum(output == command)
        if dt > 0:
            np.testing.assert_allclose(mean, np.mean(path, axis=0), atol=1e-6)
    assert 0 < reached < commands.size


@pytest.mark.parametrize("velocity", [[1.2, -0.7, 0.4], [0.0, 2.0, 0.0]])
def test_a_hub_moment_with_a_cross_part_is_one_that_is_turned(guards, velocity):
    """By an angle whose tangent it is, however the drone moves."""
    c, s = np.cos(0.4), np.sin(0.4)
    still = State.at_rest(rotor_speed=jnp.full(4, 1594.0))
    state = dataclasses.replace(still, velocity=jnp.asarray(velocity))
    straight = _felt(guards, (BladeFlapping(2e-4, 0.0),), state)[3:]
    turned = _felt(guards, (BladeFlapping(2e-4 * c, 0.0, cross=s / c),), state)[3:]
    np.testing.assert_allclose(turned, np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) @ straight, rtol=1e-9, atol=1e-18)


@pytest.mark.parametrize("share", [1.0, 0.4])
def test_play_encloses_the_area_of_its_parallelogram(guards, share):
    """A command to and fro by ``size`` drags the output along a loop of area 4 width (size - width)."""
    size, width, count = np.array([0.05, 0.1, 0.2, 0.3]), 0.08, 4000
    command = 0.5 + size * np.sin(np.linspace(0, 4 * np.pi, count + 1))[:, None]
    steps = np.full(count + 1, 1e-3)
    effect = MotorHysteresis(width, share)
    output = np.asarray(_received(effect, guards, jnp.full(4, 1450.0), steps, command))[count // 2 :]
    round_ = command[count // 2 :]
    area = np.abs(np.sum(0.5 * (output[1:] + output[:-1]) * np.diff(round_, axis=0), axis=0))
    np.testing.assert_allclose(area, share * 4 * width * np.maximum(size - width, 0), atol=1e-5)
    # The smallest moves within the play: it is swallowed.
    np.testing.assert_allclose(np.ptp(output[:, 0]), (1 - share) * 2 * size[0], atol=1e-9)


def test_a_limit_of_the_rotors_acceleration_is_that_of_the_equation(guards, fly_fleet):
    """Omega' = clip((K u - Omega) / T, -K / slowness, K / slowness), whatever part of it limits the output."""
    slowness = 0.4
    model = Quadrotor(guards, (EscRateLimit(slowness, rotor=1.0),))
    y = np.zeros(17)
    y[6], y[13:] = 1.0, 1450.0
    commands = np.repeat(np.random.default_rng(8).uniform(0.3, 0.8, (8, 4)), 25, axis=0)
    flown = fly_fleet(_batch([model]), helpers.state_of(y), jnp.asarray(commands)).rotor_speed[0]
    count, speed, limited = 200, np.full(4, 1450.0), 0
    for command, found in zip(commands, flown, strict=True):
        for _ in range(count):
            rate = (2900 * command - speed) / 0.05
            limited += np.sum(np.abs(rate) > 2900 / slowness)
            speed = speed + 0.004 / count * np.clip(rate, -2900 / slowness, 2900 / slowness)
        # A step in which the limit ends is limited as a whole or not at all.
        np.testing.assert_allclose(found, speed, atol=2.0)
    assert 0.1 < limited / (count * commands.size) < 0.9


def test_second_lag_follows_two_lags_in_series(guards, fly_fleet):
    lags = (0.003, 0.012, 0.05)
    dt, each = 0.001, 16
    models = [Quadrotor(guards, (MotorSecondOrder(lag),), dt=dt) for lag in lags]
    y = np.zeros(17)
    y[6], y[13:] = 1.0, 1450.0
    commands = np.random.default_rng(6).uniform(0.2, 1.0, (6, 4))
    flown = helpers.pack(fly_fleet(_batch(models), helpers.state_of(y), jnp.asarray(np.repeat(commands, each, axis=0))))
    for lag, rows in zip(lags, flown, strict=True):
        x = np.full(8, 1450.0)
        for k, command in enumerate(commands):

            def rates(_, x, command=command, lag=lag):
                return np.concatenate([(2900 * command - x[:4]) / lag, (x[:4] - x[4:]) / 0.05])

            x = solve_ivp(rates, (0.0, each * dt), x, method="DOP853", rtol=1e-10, atol=1e-9).y[:, -1]
            # Held at its mean over a step, the lagged target errs by second order in the step.
            np.testing.assert_allclose(rows[each * (k + 1) - 1, 13:], x[4:], atol=0.2)
    assert np.abs(flown[1, :, 13:] - flown[0, :, 13:]).max() > 50


def _steered(effect, parameters, target, speed, memory=()):
    motors = Motors(Vec.unstack(jnp.asarray(target)), Vec(*jnp.full(4, 0.05)))
    return effect.motors(motors, Vec.unstack(jnp.asarray(speed)), memory, jnp.asarray(0.004), parameters)


def test_asymmetry_is_a_time_constant_each_way(guards, fly_fleet):
    motors, _ = _steered(MotorAsymmetry(-0.3, 0.3, 50.0), guards, [2000.0, 1000.0, 1500.0, 1550.0], np.full(4, 1500.0))
    wanted = [0.05 * 0.7, 0.05 * 1.3, 0.05, 0.05 * (1 - 0.3 * np.tanh(1.0))]
    np.testing.assert_allclose(motors.time_constant.stack(), wanted, rtol=1e-6)
    # And in flight: eq. 5 with the other lag, as long as the target is far.
    model = Quadrotor(guards, (MotorAsymmetry(-0.3, 0.3),))
    y = np.zeros(17)
    y[6], y[13:] = 1.0, 1450.0
    flown = fly_fleet(_batch([model]), helpers.state_of(y), jnp.tile(jnp.array([1.0, 0.0, 1.0, 0.0]), (5, 1)))
    t = 0.004 * np.arange(1, 6)
    np.testing.assert_allclose(flown.rotor_speed[0, :, 0], 2900 - 1450 * np.exp(-t / 0.035), rtol=1e-9)
    np.testing.assert_allclose(flown.rotor_speed[0, :, 1], 1450 * np.exp(-t / 0.065), rtol=1e-9)


def _reading(voltage, time):
    return Reading(voltage=jnp.asarray(voltage), time=jnp.asarray(time))


def test_battery_voltage_is_filtered_and_scales_the_target(guards):
    effect = BatterySag(level=0.02, slope=0.8, lag=0.3)
    memory = effect.start(Vec(*jnp.full(4, 1594.0)), guards)
    target = np.array([2000.0, 1500.0, 1000.0, 500.0])

    def factor():
        return np.asarray(_steered(effect, guards, target, target, memory)[0].target.stack()) / target

    memory = effect.sense(memory, _reading(np.nan, 0.0))
    np.testing.assert_allclose(factor(), 1.02, rtol=1e-12)
    # The first reading counts in full, later ones through the lag whatever their spacing.
    memory = effect.sense(memory, _reading(4.1, 0.5))
    np.testing.assert_allclose(factor(), 1.02 + 0.8 * 0.4 / 3.7, rtol=1e-12)
    for time, voltage in ((0.6, 3.8), (0.65, np.nan), (0.8, 3.8), (0.9, 3.8)):
        memory = effect.sense(memory, _reading(voltage, time))
    voltage = 3.8 + 0.3 * np.exp(-0.4 / 0.3)
    np.testing.assert_allclose(factor(), 1.02 + 0.8 * (voltage - 3.7) / 3.7, rtol=1e-9)
    # What a log said stays in predictions that start from it.
    zero = Vec(*jnp.zeros(3))
    at = Condition(zero, zero, zero, zero, Vec(1.0, 0.0, 0.0, 0.0), zero, Vec(*jnp.full(4, 2500.0)), guards, memory)
    for _ in range(50):
        at = dataclasses.replace(at, memory=effect.advance(at, zero, 0.01))
    np.testing.assert_array_equal(at.memory[0][0], memory[0][0])


def test_a_cell_runs_down_as_the_equations_say(guards, fly_fleet):
    """In simulation: charge, voltage under load and rotor speeds by an adaptive integrator of SciPy, to the last
    charge and beyond."""
    capacity, resistance, power, lag = 6.0, 0.12, 8.0, 0.05
    effect = BatterySag(0.02, 0.8, lag, charge=0.9, capacity=capacity, resistance=resistance, power=power)
    model = Quadrotor(guards, (effect,))
    y = np.zeros(17)
    y[6], y[13:] = 1.0, 1450.0
    command = np.array([0.5, 0.6, 0.55, 0.45])
    flown = fly_fleet(_batch([model]), helpers.state_of(y), jnp.broadcast_to(command, (1000, 4)))

    def terminal(charge, speed):
        open_ = np.polyval([0.3201, -0.1178, 0.2156, 3.685], charge) - 1.031 * np.exp(-35 * charge)
        taken = power * np.mean((speed / 1594) ** 3)
        voltage = np.roots([1.0, -open_, resistance * taken]).real.max()
        return voltage, taken / voltage

    def slope(_, x):
        charge, felt, speed = x[0], x[1], x[2:]
        voltage, current = terminal(max(charge, 0.0), speed)
        steady = 2900 * command * (1.02 + 0.8 * (felt - 3.7) / 3.7)
        return [-current / capacity * (charge > 0), (voltage - felt) / lag, *((steady - speed) / 0.05)]

    first = [0.9, terminal(0.9, np.full(4, 1450.0))[0], *np.full(4, 1450.0)]
    times = 0.004 * np.arange(1, 1001)
    known = solve_ivp(slope, (0, 4), first, t_eval=times, rtol=1e-8, atol=1e-8, max_step=0.01).y
    felt, _, charge, _ = (memory[0, :, 0] for memory in flown.memory[0])
    np.testing.assert_allclose(charge, np.maximum(known[0], 0.0), atol=2e-3)
    going = known[0] > 0.01
    np.testing.assert_allclose(felt[going], known[1][going], atol=5e-3)
    np.testing.assert_allclose(flown.rotor_speed[0, going], known[2:].T[going], atol=5.0)
    assert 3.9 > known[1, 5] > known[1, 300] > 3.4
    assert known[0, -1] <= 0.0
    # An empty cell: it neither charges nor turns into a number that means nothing.
    assert float(charge[-1]) == 0.0
    assert 1.3 < float(felt[-1]) < 2.66


def test_a_half_full_cell_carries_hover_at_the_nominal_voltage(guards):
    """So that a fitted level and slope mean in simulation what they meant beside the log."""
    voltage, current = BatterySag.neutral().loaded(jnp.asarray(0.5), Vec(*jnp.full(4, 1594.0)))
    assert float(voltage) == pytest.approx(3.7, abs=0.02)
    # Ten minutes from 350 mAh, more or less.
    assert 8 < 1260 / float(current) / 60 < 14


def test_a_cell_gives_no_more_than_it_can():
    voltage, current = BatterySag(0.0, 1.0, resistance=0.5, power=20.0).loaded(
        jnp.asarray(0.5), Vec(*jnp.full(4, 2900.0))
    )
    assert float(voltage) == pytest.approx(0.5 * 3.803, abs=1e-3)
    assert np.isfinite(float(current))


def test_warm_motors_turn_slower(guards, fly_fleet):
    effect = MotorThermalDrift(drop=0.1, time_constant=2.0)
    model = Quadrotor(guards, (effect,))
    y = np.zeros(17)
    y[6], y[13:] = 1.0, 1450.0
    commands = jnp.broadcast_to(jnp.array([0.5, 0.6, 0.5, 0.45]), (1000, 4))
    flown = fly_fleet(_batch([model]), helpers.state_of(y), commands)

    def slope(t, x, command):
        speed, warmth = x
        return [(2900 * command * (1 - 0.1 * warmth) - speed) / 0.05, ((speed / 1594) ** 3 - warmth) / 2]

    for motor, command in enumerate(commands[0]):
        times = 0.004 * np.arange(1, 1001)
        known = solve_ivp(slope, (0, 4), [1450.0, 0.0], args=(command,), t_eval=times, rtol=1e-9, atol=1e-9).y
        np.testing.assert_allclose(flown.memory[0][0][0, :, motor], known[1], atol=1e-3)
        np.testing.assert_allclose(flown.rotor_speed[0, :, motor], known[0], atol=0.3)
    # A motor that works harder gets warmer, and so slower than the cube of its command would have it.
    assert 1.4 < flown.memory[0][0][0, -1, 1] / flown.memory[0][0][0, -1, 0] < (0.6 / 0.5) ** 3


# The slung load.


@pytest.fixture(scope="module")
def swung(guards, fly_fleet):
    """A level drone whose rotors carry it but not the load, which is let go 2 mm beside it."""
    model = Quadrotor(guards, (PayloadSwing(mass=0.01, length=0.12, damping_ratio=0.05),))
    y = np.zeros(17)
    y[6], y[13:] = 1.0, rotors.hover_rotor_speed(guards)
    state = begin(model, helpers.state_of(y))
    side = 0.002 / 0.12
    state = dataclasses.replace(state, memory=((jnp.array([side, 0.0, -np.sqrt(1 - side**2)]), jnp.zeros(3)),))
    flown = fly_fleet(_batch([model]), state, jnp.broadcast_to(model.hover_command(), (300, 4)))
    return jax.tree.map(lambda x: np.asarray(x[0]), flown)


@ONE_WORKER
def test_slung_load_swings_as_a_pendulum_under_a_free_pivot(swung):
    """r'' = -(h / L) (1 + m / M) r - damping r' with h = F_z / (M + m): both swing about their common centre."""
    along, _ = swung.memory[0]
    natural = np.sqrt(9.81 / 0.12)  # the rotors lift M g: (h / L) (1 + m / M) = g / L
    damping = 0.05 * natural
    frequency = np.sqrt(natural**2 - damping**2)
    # A semi-implicit step reads like a clock that is half a step ahead.
    t = 0.004 * (np.arange(1, 301) + 0.5)
    swing = np.cos(frequency * t) + damping / frequency * np.sin(frequency * t)
    np.testing.assert_allclose(0.12 * along[:, 0], 0.002 * np.exp(-damping * t) * swing, atol=0.01 * 0.002)
    np.testing.assert_allclose(along[:, 1], 0, atol=1e-15)


@ONE_WORKER
def test_slung_load_keeps_momentum_but_for_the_air(swung):
    """The string pulls both ends; only the air's damping takes momentum, 2 zeta sqrt(g / L) m times the way of r."""
    along, turning = swung.memory[0]
    place, speed = 0.12 * along[:, 0], 0.12 * turning[:, 0]
    momentum = 0.044 * swung.velocity[:, 0] + 0.01 * (swung.velocity[:, 0] + speed)
    taken = 0.01 * 2 * 0.05 * np.sqrt(9.81 / 0.12) * (np.concatenate([[0.002], place[:-1]]) - 0.002)
    largest = 0.01 * np.abs(speed).max()
    np.testing.assert_allclose(momentum + taken, 0, atol=2e-3 * largest)
    # Down with what the rotors do not carry of the load.
    fall = -9.81 * 0.01 / 0.054 * 0.004 * np.arange(1, 301)
    np.testing.assert_allclose(swung.velocity[:, 2], fall, rtol=2e-3)
    # The string hangs from the rotors' centre: no torque about it.
    np.testing.assert_allclose(swung.body_rate, 0, atol=1e-12)


@ONE_WORKER
@pytest.mark.parametrize("mass", [0.004, 0.0])
def test_load_followed_beside_a_log_is_found_by_what_the_model_misses(guards, mass):
    """The pull shows where the string points; a load of no weight shows nothing and is left to swing."""
    effect = PayloadSwing(mass=mass, length=0.16, damping_ratio=0.01)
    own, up, still = float(guards.mass), Vec(0.0, 0.0, 9.81), jnp.zeros(1)
    zero = Vec(still[0], still[0], still[0])

    def condition(memory):
        level = Vec(1.0, 0.0, 0.0, 0.0)
        return Condition(zero, zero, zero, zero, level, zero, Vec(*jnp.zeros(4)), guards, memory)

    def pulled(memory):
        along, turning = memory
        return along * (mass / own * (0.16 * turning.dot(turning) - along.dot(up)))

    def row(memories, _):
        there, here, alone = memories
        missed = pulled(there) - pulled(here)
        after = effect.advance(condition(there), zero, 0.004)
        followed = effect.follow(condition(here), zero, missed, 0.004)
        moved = after, followed, effect.advance(condition(alone), zero, 0.004)
        return moved, jnp.stack([(a[0] - b[0]).stack() for a, b in ((after, followed), (after, moved[2]))])

    def hanging(angle):
        return Vec(jnp.sin(angle), still[0], -jnp.cos(angle)), zero

    start = hanging(0.6), hanging(0.0), hanging(0.0)
    _, off = jax.lax.scan(row, start, length=500)
    left = np.linalg.norm(np.asarray(off), axis=-1)[-100:].max(axis=0)
    assert left[1] > 0.4
    np.testing.assert_allclose(left[0], 0.0 if mass else left[1], atol=0.01)


@ONE_WORKER
def test_load_hangs_below_what_the_drone_feels_after_a_gap(guards):
    effect = PayloadSwing(mass=0.004, length=0.16)
    zero = Vec(*jnp.zeros(3))
    memory = Vec(*jnp.array([0.6, 0.0, -0.8])), Vec(*jnp.array([0.0, 3.0, 0.0]))
    at = Condition(zero, zero, zero, zero, Vec(1.0, 0.0, 0.0, 0.0), zero, Vec(*jnp.zeros(4)), guards, memory)
    along, turning = effect.follow(at, Vec(3.0, 0.0, 0.0), zero, 0.4)
    np.testing.assert_allclose(along.stack(), np.array([-3.0, 0.0, -9.81]) / np.hypot(3.0, 9.81), atol=1e-6)
    np.testing.assert_allclose(turning.stack(), 0.0, atol=1e-12)


@ONE_WORKER
def test_wind_drag_tilt_and_a_load_follow_newton(guards, fly_fleet):
    """Composed: drone and load as two bodies with a string between them, for every force the same moving air."""
    m, own, length, ratio, pivot = 0.006, 0.044, 0.2, 0.05, -0.02
    effects = (
        PayloadSwing(m, length, ratio, pivot),
        Wind([2.0, -1.0, 0.5], 0.0),
        ThrustTilt([0.04, -0.03], 0.05),
        InflowThrust(0.02),
        ParasiticDrag(0.0, 0.01),
        RotorDrag(0.04),
    )
    constants, dt, steps = helpers.constants_of(guards), 0.001, 250
    model = Quadrotor(guards, effects, integrator="rk4", dt=dt)
    y, commands = helpers.aggressive_manoeuvre(0.01, seed=7)
    y[13:17] = 1594.0
    command = 0.55 + 0.1 * (commands[0] - commands[0].mean())
    flown = helpers.pack(fly_fleet(_batch([model]), helpers.state_of(y), jnp.broadcast_to(command, (steps, 4))))[0]
    basic = helpers.ode(constants, command)
    on = ("wind", "thrust_tilt", "inflow_thrust", "parasitic_drag", "rotor_drag")
    gravity = np.array([0.0, 0.0, -9.81])

    def rates(t, z):
        y, along, turning = z[:17], z[17:20], z[20:]
        rate = basic(t, y)
        force, torque = _wrench(constants, y, on, 0.0, conductance=0.0)
        matrix = helpers.rotation_matrix(y[6:10])
        free = rate[3:6] + matrix @ force / own
        # m a_load = m g - T n, own a = own free + T n, and n . (a_load - a) = -length |n'|^2. Air damps the load.
        pull = (length * turning @ turning - along @ (free - gravity)) / (1 / m + 1 / own)
        tension = max(pull, 0.0) * along
        rate[3:6] = free + tension / own
        # The string is tied below the rotors' centre.
        torque = torque + np.cross([0.0, 0.0, pivot], matrix.T @ tension)
        rate[10:13] += torque / constants.inertia
        felt = rate[3:6] - gravity
        swing = -(felt - along * (along @ felt)) / length - (turning @ turning) * along
        swing -= 2 * ratio * np.sqrt(9.81 / length) * turning
        return np.concatenate([rate, turning, swing])

    start = np.concatenate([y, [0.0, 0.0, -1.0], np.zeros(3)])
    times = dt * np.arange(1, steps + 1)
    known = solve_ivp(rates, (0.0, times[-1]), start, t_eval=times, method="DOP853", rtol=1e-9, atol=1e-10).y.T
    without = fly_fleet(
        _batch([Quadrotor(guards, effects[1:], integrator="rk4", dt=dt)]),
        helpers.state_of(y),
        jnp.broadcast_to(command, (steps, 4)),
    )
    # The load moves by semi-implicit steps: its share in the flight is right to one percent.
    load = np.abs(known[:, :3] - np.asarray(without.position[0])).max()
    turn = np.abs(known[:, 10:13] - np.asarray(without.body_rate[0])).max()
    assert load > 0.005
    assert turn > 0.5
    for part, tolerance in (("position", 0.01 * load), ("velocity", 0.02), ("body_rate", 0.01 * turn)):
        assert np.abs(helpers.part(flown - known[:, :17], part)).max() < tolerance, part


def test_a_changed_time_constant_changes_the_reactive_torque_too(guards):
    """One step without aerodynamic torque: the yaw rate is J_m / J_zz times the change of the rotor speeds."""
    sign, start = np.array([-1.0, 1.0, -1.0, 1.0]), 1594.0
    target = 2900.0 * (0.55 + 0.1 * sign)
    drone = eqx.tree_at(lambda p: p.torque_scale, guards, jnp.zeros(4))
    # Narrow: each motor is wholly in one direction.
    model = Quadrotor(drone, (MotorAsymmetry(-0.3, 0.3, 0.1),))
    after = step(model, State.at_rest((0.0, 0.0, 1.0), start), jnp.asarray(target / 2900.0))
    lag = 0.05 * np.where(target > start, 0.7, 1.3)
    speed = target + (start - target) * np.exp(-0.004 / lag)
    assert float(after.body_rate[2]) == pytest.approx(0.5e-7 * sign @ (speed - start) / 5.9e-5, rel=2e-3)
