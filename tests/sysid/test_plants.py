"""The independent plants: their physics against SciPy and hand-written laws, their logs against what they declare."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from cfb_mjx.reference_simulator import EFFECTS, OUTSIDE, Case, effects, fly_campaigns, physics
from cfb_mjx.reference_simulator import constants as c
from cfb_mjx.reference_simulator.airframe import PLAIN_ROWS, SPEED, P, Q, V, W, advance, derivative
from cfb_mjx.reference_simulator.manoeuvres import MANOEUVRES
from cfb_mjx.reference_simulator.sensors import QUIET, row_ticks
from cfb_mjx.reference_simulator.simulation import Lane, simulate

# They share fixtures and compiled programs.
pytestmark = pytest.mark.xdist_group("plants")

GRAVITY = np.array([0, 0, -c.GRAVITY])
OFF_CENTRE = {"mass": 0.05, "cog": np.array([0.003, -0.002, -0.004])}


def rotation(q):
    """Body to world; ``q`` (..., 4) is [w, x, y, z]."""
    return Rotation.from_quat(np.roll(q, -1, axis=-1)).as_matrix()


def held(count=1, **values):
    """What the loop holds over a tick, without disturbances."""
    nothing = {
        "gain": np.full((4, count), c.MOTOR_GAIN),
        "push": np.zeros((3, count)),
        "twist": np.zeros((3, count)),
        "gust": np.zeros((2, count)),
        "phase": np.zeros(count),
    }
    return SimpleNamespace(**(nothing | values))


def state(rng):
    """A drone in the middle of a manoeuvre, (17, 1)."""
    x = np.zeros((PLAIN_ROWS, 1))
    x[P, 0], x[V, 0] = [0.3, -0.2, 1.1], rng.normal(0, 1.5, 3)
    x[Q, 0] = Rotation.from_rotvec(rng.normal(0, 0.3, 3)).as_quat(scalar_first=True)
    x[W, 0], x[SPEED, 0] = rng.normal(0, 2, 3), rng.uniform(1200, 2000, 4)
    return x


def reference(x, u, mass, inertia, cog):
    """Rate of change from the coupled 6 x 6 Newton-Euler equations of the rotors' centre."""
    q, w, speed = x[6:10], x[10:13], x[13:17]
    r = rotation(q)
    s = speed / 2900
    thrust = -0.23 * s**3 + 0.562 * s**2 - 0.043 * s
    speed_rate = (2900 * u - speed) / 0.05
    yaw = np.array([-1, 1, -1, 1]) @ (0.5e-7 * speed_rate + 1e-4 * (-3.4 * s**3 + 8.7 * s**2 + 2.9 * s))
    half = 0.03535
    moment = np.array([half * thrust @ [-1, -1, 1, 1], half * thrust @ [-1, 1, 1, -1], yaw])
    force = np.array([0, 0, thrust.sum()])
    hat = np.array([[0, -cog[2], cog[1]], [cog[2], 0, -cog[0]], [-cog[1], cog[0], 0]])
    about = inertia + mass * (cog @ cog * np.eye(3) - np.outer(cog, cog))
    matrix = np.block([[mass * np.eye(3), -mass * hat], [mass * hat, about]])
    weight = mass * r.T @ GRAVITY
    right = np.concatenate(
        [
            force + weight - mass * np.cross(w, np.cross(w, cog)),
            moment + np.cross(cog, weight) - np.cross(w, about @ w),
        ]
    )
    solved = np.linalg.solve(matrix, right)
    q_rate = 0.5 * np.array([-q[1:] @ w, *(q[0] * w + np.cross(q[1:], w))])
    return np.concatenate([x[3:6], r @ solved[:3], q_rate, solved[3:], speed_rate]), solved[:3] - r.T @ GRAVITY


@pytest.mark.parametrize("changes", [{}, OFF_CENTRE])
def test_motion_is_that_of_dop853(changes):
    rng = np.random.default_rng(0)
    drone = physics.nominal() | {name: np.asarray(value) for name, value in changes.items()}
    p, x = physics.stack([drone]), state(rng)
    own = (float(drone["mass"]), drone["inertia"], drone["cog"])
    exact = x[:, 0]
    for _ in range(100):
        u = rng.uniform(0.45, 0.65, 4)
        _, specific = derivative(p, x, u[:, None], held(), 0.0)
        np.testing.assert_allclose(specific[:, 0], reference(x[:, 0], u, *own)[1], atol=1e-9)
        for _ in range(c.SUBSTEPS):
            x, _ = advance(p, x, u[:, None], held(), 0.0, c.TICK / c.SUBSTEPS)
        exact = solve_ivp(
            lambda t, y, u=u: reference(y, u, *own)[0], (0, c.TICK), exact, method="DOP853", rtol=1e-10, atol=1e-12
        ).y[:, -1]
    exact[Q] /= np.linalg.norm(exact[Q])
    scale = np.repeat([1, 1, 1, 1, 100], [3, 3, 4, 3, 4])
    np.testing.assert_allclose(x[:, 0] / scale, exact / scale, atol=1e-6)


def test_free_fall_keeps_momentum_and_energy_of_the_spin():
    x = state(np.random.default_rng(1))
    x[SPEED] = 0
    p, inertia = physics.stack([physics.nominal()]), np.array(c.INERTIA)
    momentum, energy, start = (
        rotation(x[Q, 0]) @ (inertia * x[W, 0]),
        inertia @ x[W, 0] ** 2,
        x.copy(),
    )
    for _ in range(500):
        x, specific = advance(p, x, np.zeros((4, 1)), held(), 0.0, 0.001)
        np.testing.assert_allclose(specific, 0, atol=1e-15)
    np.testing.assert_allclose(x[P, 0], start[P, 0] + 0.5 * start[V, 0] + 0.125 * GRAVITY, atol=1e-9)
    np.testing.assert_allclose(rotation(x[Q, 0]) @ (inertia * x[W, 0]), momentum, rtol=1e-8)
    assert inertia @ x[W, 0] ** 2 == pytest.approx(energy, rel=1e-9)


def test_gyroscopic_torque_does_no_work_and_is_that_of_the_rotors_momentum():
    x = state(np.random.default_rng(2))
    plain, spinning = physics.nominal(), physics.nominal()
    effects.apply("gyroscopic", np.random.default_rng(0), spinning, 1.0)
    u = np.full((4, 1), 0.55)
    rates = [derivative(physics.stack([d]), x, u, held(), 0.0)[0][W, 0] for d in (plain, spinning)]
    torque = np.array(c.INERTIA) * (rates[1] - rates[0])
    # A rotor's torque on the body is opposite to its own turning.
    momentum = spinning["gyro_inertia"] * -(np.array([-1, 1, -1, 1]) @ x[SPEED, 0]) * np.array([0, 0, 1])
    np.testing.assert_allclose(torque, -np.cross(x[W, 0], momentum), atol=1e-15)
    assert np.abs(torque).max() > 1e-6
    assert abs(torque @ x[W, 0]) < 1e-12


def lane(manoeuvre="lateral", seconds=3.0, every=1, seed=5, **changes):
    """A flight without sensor noise."""
    drone = physics.nominal() | {name: np.asarray(value, dtype=float) for name, value in changes.items()}
    setpoints = MANOEUVRES[manoeuvre](np.random.default_rng(seed), seconds, 1.0)
    rows = np.arange(50, len(setpoints) * c.SETPOINT_TICKS, every)
    return Lane(drone, QUIET, setpoints, rows, 3.7, np.zeros(3), np.random.default_rng(seed))


@pytest.fixture(scope="module")
def quiet():
    """Rows at every tick of a plain drone, one with delayed commands, and two with faulty columns."""
    changes = [{}, {"delay_ms": 6}, {"delay_ms": 7}, {"extra_delay": 12}, {"motor_shift": 5}, {"motor_shift": -4}]
    flights = simulate([lane(**change) for change in changes])
    assert not any(flight.crashed for flight in flights)
    return flights


def test_accelerometer_and_gyro_are_those_of_the_motion(quiet):
    late, step = c.POSE_TICKS, c.TICK
    pose, inertial = quiet[0].pose[late:], quiet[0].inertial[:-late]
    turn = rotation(pose[:, 6:])
    wanted = np.einsum("nij,nj->ni", turn, inertial[:, 3:6]) + GRAVITY
    velocity = pose[:, 3:6]
    # Acceleration jumps with the commands only through the yaw torque; central differences see it smooth.
    np.testing.assert_allclose((velocity[2:] - velocity[:-2]) / (2 * step), wanted[1:-1], atol=0.02)
    assert np.abs(velocity).max() > 1.5
    turned = Rotation.from_matrix(np.swapaxes(turn[:-2], 1, 2) @ turn[2:]).as_rotvec() / (2 * step)
    np.testing.assert_allclose(turned, inertial[1:-1, :3], atol=0.02)
    np.testing.assert_allclose(pose[1:, :3] - pose[:-1, :3], step / 2 * (velocity[1:] + velocity[:-1]), atol=1e-5)


@pytest.mark.parametrize(("flight", "ticks"), [(0, 0), (1, 3)])
def test_motors_follow_the_commands_after_the_declared_delay(quiet, flight, ticks):
    command, speed = quiet[flight].motors[:, :4], quiet[flight].motors[:, 4:]
    goal = c.MOTOR_GAIN * command[: len(command) - ticks]
    expected = goal + (speed[ticks:] - goal) * np.exp(-c.TICK / c.MOTOR_LAG)
    np.testing.assert_allclose(speed[ticks + 1 :], expected[:-1], atol=1e-4)


def test_a_delay_may_end_within_a_tick(quiet):
    command, speed = c.MOTOR_GAIN * quiet[2].motors[:, :4], quiet[2].motors[3:, 4:]
    keep = np.exp(-0.5 * c.TICK / c.MOTOR_LAG)
    middle = command[:-4] + (speed[1:] - command[:-4]) * keep  # 7 ms: still the older command for 1 ms
    after = command[1:-3] + (middle - command[1:-3]) * keep
    np.testing.assert_allclose(speed[2:], after[:-1], atol=1e-4)


def test_faulty_columns_are_those_of_the_same_flight_at_another_time(quiet):
    plain, delayed, shifted, early = quiet[0], quiet[3], quiet[4], quiet[5]
    np.testing.assert_array_equal(delayed.pose[12:], plain.pose[:-12])
    np.testing.assert_array_equal(delayed.motors, plain.motors)
    np.testing.assert_array_equal(shifted.motors[5:], plain.motors[:-5])
    np.testing.assert_array_equal(early.motors[:-4], plain.motors[4:])
    np.testing.assert_array_equal(early.inertial, plain.inertial)


def test_rows_are_irregular_and_drop_out():
    ticks = row_ticks(np.random.default_rng(0), 8000, True, False)
    steps = np.diff(ticks) * c.TICK
    assert steps.min() > 0
    assert np.std(steps) == pytest.approx(1.3e-3, rel=0.2)
    assert np.diff(row_ticks(np.random.default_rng(0), 8000, False, True)).max() * c.TICK >= 0.02


CASES = [Case("none", 1), *(Case(name, 10 + i, ((name, 1.0),)) for i, name in enumerate(EFFECTS))]


@pytest.fixture(scope="module")
def campaigns():
    return fly_campaigns(CASES, duration_scale=0.1)


def test_every_effect_flies(campaigns):
    for case, campaign in zip(CASES, campaigns, strict=True):
        expected = [] if case.name == "none" else [OUTSIDE if case.name.startswith(OUTSIDE) else case.name]
        assert campaign.truth["labels"] == expected
        assert len(campaign.fit) in (6, 7)
        assert len(campaign.held_out) == 4
        assert max(campaign.truth["tries"]) <= 3, campaign.truth
        json.dumps(campaign.truth)
        for log in campaign.fit + campaign.held_out:
            assert log.observation_delay == 0.008
            assert np.all(np.diff(log.time) > 0)
            assert np.isfinite(log.position).all()
            assert log.position[:, 2].min() > -0.01
            assert np.abs(log.body_rate).max() < 15
            assert log.battery_voltage.min() > 2.9


def test_a_campaign_does_not_depend_on_those_beside_it(campaigns):
    alone = fly_campaigns([CASES[2]], duration_scale=0.1)[0]
    for one, other in zip(alone.fit + alone.held_out, campaigns[2].fit + campaigns[2].held_out, strict=True):
        assert one.name == other.name
        for column in ("time", "position", "quaternion", "body_rate", "specific_force", "command"):
            np.testing.assert_array_equal(getattr(one, column), getattr(other, column))


def test_mixtures_and_any_outside_effect_can_be_drawn():
    mixture = Case("mixture", 3, (("payload", 0.5), ("cog_offset", 0.5), (OUTSIDE, 0.3)))
    drone = physics.nominal()
    for order, (name, strength) in enumerate(mixture.effects):
        effects.apply(name, np.random.default_rng([3, order]), drone, strength)
    assert mixture.labels == ["cog_offset", "outside", "payload"]
    assert np.linalg.eigvalsh(drone["inertia"]).min() > 0
    assert drone["mass"] > c.MASS
