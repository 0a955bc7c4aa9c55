"""The firmware's PID: signs against the library's own geometry, and flights of the library's drone with late poses."""

import math
import warnings

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from firmware_pid import Drone, Firmware, flight
from scipy.spatial.transform import Rotation

from cfb_mjx.control import FirmwarePid, Setpoint, init, resume, step
from cfb_mjx.firmware.pid import COUNTS, DT, mix
from cfb_mjx.model import DelayLine, Quadrotor, State
from cfb_mjx.model.quadrotor import step as fly_step
from cfb_mjx.parameters import load_model_file
from cfb_mjx.view.spread import tilt_deg

PARAMETERS = load_model_file("cfb-guards").parameters()
DRONE = Quadrotor(PARAMETERS, dt=DT, integrator="rk4")
# Paper eq. 6 and 7, typed in: what a unit of thrust (or of rotor torque) of M1..M4 turns.
ROLL, PITCH, YAW = np.array([-1, -1, 1, 1.0]), np.array([-1, 1, 1, -1.0]), np.array([-1, 1, -1, 1.0])
DELAY = 0.008


@eqx.filter_jit
def fly(pid: FirmwarePid, start: State, setpoint: Setpoint, steps: int = 2000):
    """States and commands of a flight whose controller sees pose and velocity 8 ms late."""

    def tick(carry, _):
        state, line, memory = carry
        line = line.push(state)
        measured = eqx.tree_at(lambda s: s.body_rate, line.read(DELAY), state.body_rate)
        memory, command = step(pid, memory, measured, setpoint)
        return (fly_step(DRONE, state, command), line, memory), (state, command)

    carry = (start, DelayLine.filled(start, DT, DELAY), init(pid, start))
    return jax.lax.scan(tick, carry, None, length=steps)[1]


def turned(roll=0.0, pitch=0.0, yaw=0.0, rate=(0.0, 0.0, 0.0)) -> State:
    """Hover with small rotations (rad) about one axis and a body rate."""
    angles = np.array([roll, pitch, yaw])
    angle = np.linalg.norm(angles)
    axis = angles / angle if angle else angles
    quaternion = jnp.asarray(np.append(np.cos(angle / 2), np.sin(angle / 2) * axis))
    state = DRONE.hover_state()
    return eqx.tree_at(lambda s: (s.quaternion, s.body_rate), state, (quaternion, jnp.asarray(rate, float)))


@pytest.mark.parametrize(("axis", "pattern"), [*enumerate((ROLL, PITCH, YAW))])
def test_a_wanted_turn_gives_the_motor_pattern_that_turns_that_way(axis, pattern):
    pid, level = FirmwarePid.hovering(PARAMETERS), turned()
    wanted = {key: 0.1 * (i == axis) for i, key in enumerate(("roll", "pitch", "yaw"))}
    _, command = step(pid, init(pid, level), level, Setpoint.tilted(**wanted, thrust=0.55))
    change = np.asarray(command) - 0.55
    assert pattern @ change > 1e-3
    # Nothing about the other axes, nothing along z.
    others = [p for p in (ROLL, PITCH, YAW, np.ones(4)) if p is not pattern]
    np.testing.assert_allclose([p @ change for p in others], 0, atol=1e-12)


@pytest.mark.parametrize(("axis", "pattern"), [*enumerate((ROLL, PITCH, YAW))])
def test_a_turn_and_a_rate_are_answered_by_turning_back(axis, pattern):
    pid = FirmwarePid.hovering(PARAMETERS)
    hover = Setpoint.hover(DRONE.hover_state().position)
    angle = {key: 0.1 * (i == axis) for i, key in enumerate(("roll", "pitch", "yaw"))}
    for state in (turned(**angle), turned(rate=tuple(0.5 * (i == axis) for i in range(3)))):
        _, command = step(pid, init(pid, state), state, hover)
        assert pattern @ np.asarray(command) < -1e-3


@pytest.mark.parametrize("yaw", [0.0, 1.0, 3.0])
def test_a_wanted_place_is_leaned_towards_whatever_the_heading(yaw):
    pid, state = FirmwarePid.hovering(PARAMETERS), turned(yaw=yaw)
    aim = np.array([0.3, -0.2])
    _, command = step(pid, init(pid, state), state, Setpoint.hover(state.position + jnp.array([*aim, 0.0]), yaw))
    torque = np.array([ROLL @ command, PITCH @ command])
    # A torque about (x, y) leans towards (y, -x) of the body.
    lean = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]) @ [torque[1], -torque[0]]
    assert lean @ aim > 0.99 * np.linalg.norm(lean) * np.linalg.norm(aim)


def test_numbers_of_one_step_worked_out_by_hand():
    # 0.01 rad roll error = 0.57296 deg; attitude: 6 x + 3 x 0.002 = 3.4412 deg/s; rate: (200 + 400 x 0.002) x = 691.0.
    pid, level = FirmwarePid.hovering(PARAMETERS), turned()
    _, command = step(pid, init(pid, level), level, Setpoint.tilted(roll=0.01, thrust=0.5))
    error = np.degrees(0.01)
    torque = (200 + 400 * DT) * (6 + 3 * DT) * error
    np.testing.assert_allclose(np.asarray(command), 0.5 + ROLL * torque / 2 / COUNTS, rtol=1e-12)
    # Damping acts on the measured change of the rate, not on the error.
    turning = turned(rate=(0.1, 0.0, 0.0))
    _, command = step(pid, init(pid, level), turning, Setpoint.tilted(thrust=0.5))
    rate = np.degrees(0.1)
    torque = -((200 + 400 * DT) + 2.5 / DT) * rate
    np.testing.assert_allclose(np.asarray(command), 0.5 + ROLL * torque / 2 / COUNTS, rtol=1e-12)


def test_saturation_lowers_all_motors_alike_and_keeps_them_turning():
    command = np.asarray(mix(jnp.asarray(60000.0), jnp.array([20000.0, 0.0, 0.0]), 7000.0))
    np.testing.assert_allclose(command[2:] - command[:2], 20000 / COUNTS, rtol=1e-12)
    assert command.max() == pytest.approx(1.0)
    assert np.asarray(mix(jnp.asarray(0.0), jnp.zeros(3), 7000.0)) == pytest.approx(7000 / COUNTS)


def test_hover_stays_where_it_is():
    pid, start = FirmwarePid.hovering(PARAMETERS), DRONE.hover_state()
    states, _ = fly(pid, start, Setpoint.hover(start.position))
    assert np.abs(np.asarray(states.position) - start.position).max() < 0.01


def test_the_firmwares_own_thrust_base_sinks_and_the_integrator_brings_it_back():
    pid = FirmwarePid(thrust_base=jnp.asarray(30000.0))
    start = DRONE.hover_state()
    states, _ = fly(pid, start, Setpoint.hover(start.position))
    height = np.asarray(states.position[:, 2]) - 1.0
    assert -0.15 < height.min() < -0.03
    assert abs(height[-1]) < 0.04


def test_a_metre_to_the_side_is_reached():
    pid, start = FirmwarePid.hovering(PARAMETERS), DRONE.hover_state()
    goal = start.position + jnp.array([1.0, 0.0, 0.0])
    states, _ = fly(pid, start, Setpoint.hover(goal))
    position = np.asarray(states.position)
    assert np.linalg.norm(position[-1] - goal) < 0.03
    assert position[:, 0].max() < 1.15
    assert tilt_deg(np.asarray(states.quaternion)).max() < 22
    assert np.linalg.norm(states.velocity, axis=1).max() < 1.3


def test_it_recovers_from_a_tilt_of_30_degrees_turning_at_3_radians_per_second():
    pid = FirmwarePid.hovering(PARAMETERS)
    start = turned(roll=np.radians(24), pitch=np.radians(18), rate=(3.0, -2.0, 1.0))
    states, commands = fly(pid, start, Setpoint.hover(start.position))
    late = np.asarray(states.position)[-200:]
    assert np.abs(late - start.position).max() < 0.05
    assert tilt_deg(np.asarray(states.quaternion))[500:].max() < 10
    assert np.isfinite(commands).all()
    assert commands.min() >= 0
    assert commands.max() <= 1


def test_the_heading_turns_the_short_way():
    pid, start = FirmwarePid.hovering(PARAMETERS), turned(yaw=3.0)
    states, _ = fly(pid, start, Setpoint.hover(start.position, -3.0))
    w, z = np.asarray(states.quaternion[:, 0]), np.asarray(states.quaternion[:, 3])
    yaw = np.unwrap(2 * np.arctan2(z, w))
    assert yaw[-1] == pytest.approx(2 * np.pi - 3.0, abs=0.05)
    assert yaw.max() < 2 * np.pi - 2.8


def test_taking_over_keeps_the_integrators_without_a_kick():
    pid, level = FirmwarePid.hovering(PARAMETERS), turned()
    memory = init(pid, level)
    for _ in range(3):
        memory, _ = step(pid, memory, level, Setpoint.hover(level.position + jnp.array([0.0, 0.0, 0.2])))
    turning = turned(rate=(2.0, 0.0, 0.0))
    again = resume(pid, memory, turning)
    np.testing.assert_array_equal(again.velocity.integral, memory.velocity.integral)
    _, command = step(pid, again, turning, Setpoint.tilted(thrust=0.5))
    # Rate loop alone (integral of the attitude error is zero): no derivative of a jump nobody saw.
    torque = (200 + 400 * DT) * np.degrees(2.0)
    assert ROLL @ np.asarray(command) == pytest.approx(-4 * torque / 2 / COUNTS, rel=1e-9)


def test_batched_and_differentiable():
    level = turned()
    climb = Setpoint.hover(level.position + jnp.array([0.1, 0.0, 0.1]))

    def command(kp, pid):
        pid = eqx.tree_at(lambda p: p.rate.kp, pid, (kp, kp, 120.0))
        return step(pid, init(pid, level), turned(rate=(0.2, 0.0, 0.0)), climb)[1]

    gains, pid = jnp.array([100.0, 200.0, 300.0]), FirmwarePid.hovering(PARAMETERS)
    many = jax.vmap(command, in_axes=(0, None))(gains, pid)
    assert many.shape == (3, 4)
    slope = jax.jacrev(command)(gains[1], pid)
    np.testing.assert_allclose(slope, (many[2] - many[0]) / 200, rtol=1e-9)


def test_float64_after_float32_in_one_process():
    """Constants that jax has met in float32 must not stay so."""

    def flown():
        parameters = load_model_file("cfb-guards").parameters()
        pid, level = FirmwarePid.hovering(parameters), Quadrotor(parameters).hover_state()

        def loop(pid, level):
            return jax.lax.scan(
                lambda memory, _: step(pid, memory, level, Setpoint.hover(level.position)), init(pid, level), length=3
            )[1]

        return eqx.filter_jit(loop)(pid, jax.tree.map(jnp.asarray, level))

    with jax.enable_x64(False), warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Explicitly requested dtype float64")
        single = flown()
    double = flown()
    assert (single.dtype, double.dtype) == (jnp.float32, jnp.float64)
    np.testing.assert_allclose(single, double, rtol=1e-5)


@pytest.mark.parametrize(("goal", "yaw_deg"), [((1.0, 0.0, 0.0), 0.0), ((0.6, -0.8, 0.4), 50.0)])
def test_steps_are_those_of_the_firmwares_loops_written_anew_on_a_drone_written_anew(goal, yaw_deg):
    """Plain Python and SciPy, see the reference: 3 s of flight agree within 0.1 mm of 1 m."""
    constants = {
        "mass": float(PARAMETERS.mass),
        "gravity": float(PARAMETERS.gravity),
        "inertia": np.asarray(PARAMETERS.inertia),
        "spacing": float(PARAMETERS.rotor_spacing),
        "rotor_inertia": float(PARAMETERS.rotor_inertia),
        "gain": np.asarray(PARAMETERS.motor_gain),
        "offset": np.asarray(PARAMETERS.motor_speed_offset),
        "lag": np.asarray(PARAMETERS.motor_time_constant)[0],
        "hover_speed": float(DRONE.hover_state().rotor_speed[0]),
    }
    for what in ("thrust", "torque"):
        cubic = np.append(np.asarray(getattr(PARAMETERS, f"{what}_polynomial")), 0.0)
        constants[what] = lambda speed, cubic=cubic: np.polyval(cubic, speed / float(PARAMETERS.reference_rotor_speed))
    base = COUNTS * float(DRONE.hover_command()[0])
    positions, commands = flight(Drone(constants), base, goal, yaw_deg, 3.0, round(DELAY / DT))

    start = DRONE.hover_state((0.0, 0.0, 0.0))
    setpoint = Setpoint.hover(jnp.array(goal), np.radians(yaw_deg))
    states, given = fly(FirmwarePid.hovering(PARAMETERS), start, setpoint, len(positions))
    assert np.linalg.norm(positions[-1] - goal) < 0.05
    np.testing.assert_allclose(states.position, positions, atol=1e-4)
    np.testing.assert_allclose(given[:500], commands[:500], atol=1e-3)


def test_limits_are_those_of_the_firmwares_loops_written_anew():
    """The same measurements, large and small in turns of 0.8 s, to both: every limit acts, and is seen afterwards."""
    rng = np.random.default_rng(2)
    # Errors of position [m], velocity [m/s], roll and pitch [deg], yaw [deg], rate [rad/s].
    calm = (0.01, 0.01, 0.2, 0.3, 0.005)
    turns = [calm, calm, (0.1, 0.05, 2, 5, 0.1), (5, 2, 10, 20, 0.2), (0.3, 0.1, 3, 8, 0.2), (0.2, 0.1, 50, 170, 0.5)]
    turns += [(0.2, 0.1, 2, 5, 0.1), (0.2, 0.1, 5, 10, 12), (0.1, 0.05, 1, 3, 0.1), (0.2, 0.5, 3, 190, 0.3)]
    turns += [(0.1, 0.05, 2, 5, 0.1)]
    count, goal, yaw_deg = 400, np.array([0.3, -0.2, 0.5]), 178.0
    rows = []
    for k, sizes in enumerate(turns * 2):
        position, velocity, rate = (sizes[i] * rng.uniform(-1, 1, 3) for i in (0, 1, 4))
        if sizes is calm:
            # Little but sinking or rising fast: the limits of the collective thrust.
            velocity[2] = (-2.0, 2.0)[k % 2]
        roll, pitch = sizes[2] * rng.uniform(-1, 1, 2)
        wander = np.linspace(0, 1, count)[:, None] * rng.uniform(-0.3, 0.3, 12) + 1
        rows.append(np.array([*position, *velocity, roll, pitch, 0.0, *rate]) * wander)
        # Through the wanted heading, and through half a turn.
        rows[-1][:, 8] = yaw_deg + sizes[3] * np.linspace(-1, 1, count)
    rows = np.concatenate(rows)
    rows[:, :3] += goal

    base = 30000.0
    plain, expected = Firmware(base), []
    for *x, roll, pitch, yaw, p, q, r in rows:
        rates = np.degrees([p, -q, r])
        # Measured yaw lies within half a turn; the firmware's pitch is nose up.
        expected.append(plain(goal, yaw_deg, x[:3], x[3:], roll, -pitch, math.remainder(yaw, 360.0), rates))
    quaternion = Rotation.from_euler("ZYX", rows[:, [8, 7, 6]], degrees=True).as_quat()[:, [3, 0, 1, 2]]
    measured = State(*map(jnp.asarray, (rows[:, :3], rows[:, 3:6], quaternion, rows[:, 9:], np.zeros((len(rows), 4)))))
    pid, first = FirmwarePid(thrust_base=jnp.asarray(base)), jax.tree.map(lambda x: x[0], measured)
    setpoint = Setpoint.hover(jnp.asarray(goal), np.radians(yaw_deg))
    flown = jax.jit(lambda pid: jax.lax.scan(lambda m, at: step(pid, m, at, setpoint), init(pid, first), measured)[1])
    np.testing.assert_allclose(flown(pid), expected, atol=1e-9)


def test_taking_over_keeps_the_integral_of_every_loop():
    pid, level = FirmwarePid.hovering(PARAMETERS), turned()
    loops = ("position", "velocity", "attitude", "rate")
    held = [jnp.array([1.0, 2.0, 3.0]) * (i + 1) for i in range(4)]
    memory = eqx.tree_at(lambda s: [getattr(s, loop).integral for loop in loops], init(pid, level), held)
    again = resume(pid, memory, turned(rate=(2.0, 0.0, 0.0)))
    for loop, integral in zip(loops, held, strict=True):
        np.testing.assert_array_equal(getattr(again, loop).integral, integral)
