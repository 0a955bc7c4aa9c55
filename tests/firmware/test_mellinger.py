"""The firmware's Mellinger controller: against the article written out in NumPy, its signs, and flights."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from cfb_mjx.firmware.mellinger import Mellinger, MellingerState, attitude_error, init, step
from cfb_mjx.firmware.pid import DT
from cfb_mjx.model import DelayLine, Quadrotor, State
from cfb_mjx.model.quadrotor import step as fly_step
from cfb_mjx.parameters import load_model_file

DRONE = Quadrotor(load_model_file("cfb-guards").parameters(), dt=DT, integrator="rk4")
# Counts of M1..M4 per count of roll about +x, pitch about +y, yaw about +z: the geometry of paper eqs. 6 and 7.
ROLL, PITCH, YAW = np.array([-1, -1, 1, 1.0]) / 2, np.array([-1, 1, 1, -1.0]) / 2, np.array([-1, 1, -1, 1.0])


def measured(position=(0, 0, 0), velocity=(0, 0, 0), rotation=None, rate=(0, 0, 0)) -> State:
    xyzw = (rotation or Rotation.identity()).as_quat()
    return State(*(jnp.asarray(np.asarray(x, float)) for x in (position, velocity, xyzw[[3, 0, 1, 2]], rate, (0,) * 4)))


def by_the_article(p, v, rotation, rate, before, wanted, yaw):
    """One step from empty integrals: Mellinger and Kumar 2011, eqs. 6 to 10, and the firmware's numbers, in NumPy."""
    error = np.asarray(wanted) - p
    f = np.array([0.4, 0.4, 1.25]) * error - np.array([0.2, 0.2, 0.4]) * v + 0.05 * error * DT
    f = f + np.array([0, 0, 0.0393 * 9.81])
    r = rotation.as_matrix()
    z = f / np.linalg.norm(f)
    y = np.cross(z, [np.cos(yaw), np.sin(yaw), 0])
    y /= np.linalg.norm(y)
    wanted_axes = np.column_stack([np.cross(y, z), y, z])
    skew = wanted_axes.T @ r - r.T @ wanted_axes
    e = np.array([skew[2, 1], skew[0, 2], skew[1, 0]])
    moment = -np.array([7e4, 7e4, 6e4]) * e - np.array([2e4, 2e4, 1.2e4]) * rate
    moment += 200 * (before - rate) / DT * [1, 1, 0] - np.array([0, 0, 500]) * e * DT
    moment = np.clip(moment, -32000, 32000)
    thrust = 132000 * (f @ r[:, 2])
    counts = thrust + ROLL * moment[0] + PITCH * moment[1] + YAW * moment[2]
    counts -= max(counts.max() - 65535, 0)
    # Without thrust along the body's axis the firmware does not turn either.
    return np.clip(counts, 7000, 65535) / 65535 if thrust > 0 else np.full(4, 7000 / 65535)


triples = st.tuples(*[st.floats(-1, 1)] * 3)


@settings(max_examples=60, deadline=None)
@given(triples, triples, triples, triples, st.floats(-3, 3))
def test_a_step_is_the_articles(position, velocity, turn, rate, yaw):
    rotation, rate, before = Rotation.from_rotvec(turn), 2 * np.array(rate), np.array([0.3, -0.2, 0.1])
    memory = MellingerState(jnp.zeros(3), jnp.zeros(3), jnp.asarray(before))
    at = measured(position, velocity, rotation, rate)
    command = _stepped(Mellinger(), memory, at, jnp.zeros(3), yaw)[1]
    wanted = by_the_article(np.array(position), np.array(velocity), rotation, rate, before, np.zeros(3), yaw)
    np.testing.assert_allclose(command, wanted, atol=1e-9)


_stepped = jax.jit(step)


@pytest.mark.parametrize("turn", [(0.3, 0, 0), (0, -0.4, 0), (0.2, 0.1, -0.5)])
def test_the_attitude_error_is_twice_the_sine_of_small_turns(turn):
    q = Rotation.from_rotvec(turn).as_quat()[[3, 0, 1, 2]]
    error = attitude_error(jnp.asarray(q), jnp.eye(3))
    angle = np.linalg.norm(turn)
    np.testing.assert_allclose(error, 2 * np.sin(angle) * np.array(turn) / angle, atol=1e-12)


@pytest.mark.parametrize(
    ("at", "pattern"),
    [
        (measured(rotation=Rotation.from_euler("x", 0.2)), -ROLL),
        (measured(rotation=Rotation.from_euler("y", 0.2)), -PITCH),
        (measured(rotation=Rotation.from_euler("z", 0.2)), -YAW),
        (measured(rate=(0.2, 0, 0)), -ROLL),
        (measured(rate=(0, 0.2, 0)), -PITCH),
        (measured(rate=(0, 0, 0.2)), -YAW),
        # Too far forward: nose up, backwards; too far left: right side down.
        (measured(position=(0.3, 0, 0)), -PITCH),
        (measured(position=(0, 0.3, 0)), ROLL),
    ],
)
def test_it_turns_against_errors(at, pattern):
    _, command = step(Mellinger(), MellingerState(*[jnp.zeros(3)] * 2, at.body_rate), at, jnp.zeros(3))
    difference = np.asarray(command) - np.mean(command)
    np.testing.assert_allclose(difference / np.abs(difference).max(), pattern / np.abs(pattern).max(), atol=1e-6)


@eqx.filter_jit
def fly(controller: Mellinger, start: State, steps: int = 3000):
    """Positions of a flight to the origin whose controller sees all 8 ms late."""

    def tick(carry, _):
        state, line, memory = carry
        line = line.push(state)
        memory, command = step(controller, memory, line.read(0.008), jnp.zeros(3))
        return (fly_step(DRONE, state, command), line, memory), state.position

    carry = (start, DelayLine.filled(start, DT, 0.008), init(start))
    return jax.lax.scan(tick, carry, None, length=steps)[1]


def test_with_the_firmwares_scale_it_hovers_seven_to_ten_centimetres_too_high():
    end = np.asarray(fly(Mellinger(), DRONE.hover_state((0.0, 0.0, 0.0))))[-1]
    assert 0.07 < end[2] < 0.10
    np.testing.assert_allclose(end[:2], 0, atol=1e-3)
    # In rest forces balance: 132000 counts per newton of what gravity's part leaves after position and full integral.
    force = 0.0393 * 9.81 - 1.25 * end[2] - 0.05 * min(0.4, np.inf)
    hover = 65535 * float(np.mean(DRONE.hover_command()))
    assert abs(132000 * force - hover) < 1000


def test_scaled_to_the_drone_it_holds_its_place():
    controller = Mellinger.hovering(DRONE.parameters)
    path = np.asarray(fly(controller, DRONE.hover_state((0.3, -0.2, 0.1)), 5000))
    assert np.linalg.norm(path[-1]) < 0.05
    assert np.abs(path).max() < 0.5


def test_upside_down_it_stops_pushing_and_forgets():
    at = measured(rotation=Rotation.from_euler("x", 3.0))
    memory, command = step(Mellinger(), MellingerState(jnp.ones(3), jnp.ones(3), at.body_rate), at, jnp.zeros(3))
    np.testing.assert_allclose(command, 7000 / 65535)
    np.testing.assert_array_equal(memory.position, 0)
    np.testing.assert_array_equal(memory.attitude, 0)


def test_wanted_velocity_and_acceleration_by_hand():
    """At the target, level and at rest: F = m (a + g e_z) + k_d v; e_R = -2 F_x / |F| about +y."""
    at = measured()
    wanted = {"velocity": jnp.array([0.1, 0.0, 0.05]), "acceleration": jnp.array([1.0, 0.0, -0.5])}
    _, command = step(Mellinger(), init(at), at, jnp.zeros(3), **wanted)
    x, z = 0.0393 * 1.0 + 0.2 * 0.1, 0.0393 * (9.81 - 0.5) + 0.4 * 0.05
    counts = 132000 * z + PITCH * 70000 * 2 * x / np.hypot(x, z)
    np.testing.assert_allclose(command, counts / 65535, rtol=1e-9)


def test_integrals_of_earlier_steps_count_up_to_their_limits():
    """At the target, level: 0.05 N/(m s) of the position's integral, 500 counts/s of the heading's."""
    at = measured()
    memory, command = step(
        Mellinger(),
        MellingerState(jnp.array([0.0, 0.0, 0.3]), jnp.array([0.0, 0.0, 2.0]), at.body_rate),
        at,
        jnp.zeros(3),
    )
    counts = 132000 * (0.0393 * 9.81 + 0.05 * 0.3) + YAW * 500 * 2.0
    np.testing.assert_allclose(command, counts / 65535, rtol=1e-9)
    np.testing.assert_allclose(memory.attitude, [0.0, 0.0, 2.0])
    full = MellingerState(jnp.array([3.0, -3.0, 3.0]), jnp.array([3.0, -3.0, 2000.0]), at.body_rate)
    memory, _ = step(Mellinger(), full, at, jnp.zeros(3))
    np.testing.assert_allclose(memory.position, [2.0, -2.0, 0.4])
    np.testing.assert_allclose(memory.attitude, [1.0, -1.0, 1500.0])


def test_the_first_step_knows_no_change_of_the_body_rate():
    """Damping alone, without the derivative: 20000 counts s/rad about x."""
    at = measured(rate=(0.2, 0.0, 0.0))
    _, command = step(Mellinger(), init(at), at, jnp.zeros(3))
    np.testing.assert_allclose(command, (132000 * 0.0393 * 9.81 - ROLL * 20000 * 0.2) / 65535, rtol=1e-9)


@pytest.mark.parametrize("gravity", [9.81, 5.0])
def test_scaled_to_the_drone_it_commands_hover_at_its_target(gravity):
    drone = replace(DRONE, parameters=replace(DRONE.parameters, gravity=jnp.asarray(gravity)))
    at = measured()
    _, command = step(Mellinger.hovering(drone.parameters), init(at), at, jnp.zeros(3))
    np.testing.assert_allclose(command, drone.hover_command(), rtol=1e-6)
