"""The two bodies against each other, and the MJX body against MuJoCo C on the same compiled MJCF."""

from __future__ import annotations

import helpers
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from cfb_mjx.errors import CfbError
from cfb_mjx.model import MjxBody, Quadrotor, RigidBody, rollout

# They share fixtures and compiled programs.
pytestmark = pytest.mark.xdist_group("bodies")

CENTER = 0.014  # height of the rotors' centre above the floor when the drone stands on its feet, m


def _random_flight(steps: int = 500) -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(8)
    y, _ = helpers.aggressive_manoeuvre(0.1, seed=5)
    return y, random.uniform(0.0, 1.0, (steps, 4))


@pytest.mark.parametrize("integrator", ["leapfrog", "euler", "rk4"])
def test_bodies_agree_over_two_seconds_of_random_commands(integrator, fleet):
    y, commands = _random_flight()
    fly = jax.jit(jax.vmap(rollout, in_axes=(0, None, None)), compiler_options=helpers.QUICK_COMPILE)
    flown = [
        helpers.pack(
            fly(Quadrotor(fleet, body=body, integrator=integrator), helpers.state_of(y), jnp.asarray(commands))
        )
        for body in (RigidBody(), MjxBody(floor=False))
    ]
    assert np.abs(helpers.part(flown[0], "body_rate")).max() > 10
    assert np.abs(helpers.part(flown[0] - flown[1], "position")).max() < 1e-5
    angle = helpers.attitude_error(helpers.part(flown[0], "quaternion"), helpers.part(flown[1], "quaternion"))
    assert angle.max() < 1e-5


def _mujoco_c(model: mujoco.MjModel, y: np.ndarray, commands: np.ndarray) -> np.ndarray:
    """`mj_step` with the rotors' wrench computed in NumPy and held over each step; nominal drone."""
    constants = helpers.Constants()
    data = mujoco.MjData(model)
    data.qpos[:] = np.concatenate([helpers.part(y, "position"), helpers.part(y, "quaternion")])
    data.qvel[:] = np.concatenate([helpers.part(y, "velocity"), helpers.part(y, "body_rate")])
    speed = helpers.part(y, "rotor_speed").copy()
    trajectory = []
    for command in commands:
        steady = constants.motor_gain * command
        rate = (steady - speed) / constants.motor_time_constant
        force, torque = helpers.rotor_wrench(constants, speed, rate)
        data.qfrc_applied[:] = np.concatenate([helpers.rotation_matrix(data.qpos[3:]) @ force, torque])
        mujoco.mj_step(model, data)
        speed = steady + (speed - steady) * np.exp(-model.opt.timestep / constants.motor_time_constant)
        trajectory.append(np.concatenate([data.qpos[:3], data.qvel[:3], data.qpos[3:], data.qvel[3:], speed]))
    return np.array(trajectory)


def test_the_compiled_mjcf_holds_the_papers_drone():
    for floor in (True, False):
        model = MjxBody(floor=floor).mujoco_model
        body = model.body("cfb")
        assert body.mass[0] == pytest.approx(0.044)
        np.testing.assert_allclose(body.inertia, [3.3e-5, 3.6e-5, 5.9e-5])
        np.testing.assert_allclose(body.iquat, [1, 0, 0, 0])
        np.testing.assert_allclose(body.ipos, 0)
        assert model.opt.timestep == 0.004
        assert model.opt.integrator == mujoco.mjtIntegrator.mjINT_EULER


def test_inverse_weights_equal_mujocos(guards):
    """Contact softness scales with body_invweight0, which `prepare` overwrites without mj_setConst."""
    body = MjxBody(floor=True)
    prepared = body.prepare(guards, 0.004)
    # The compiled model still says what mj_setConst computed from the MJCF.
    np.testing.assert_allclose(prepared.model.body_invweight0[1], body.mujoco_model.body("cfb").invweight0, rtol=1e-9)


def test_the_mass_matrix_is_diagonal_in_every_state_as_the_contact_free_body_takes_it(guards):
    body = MjxBody(floor=False)
    ours = body.prepare(guards, 0.004).mass_diagonal
    data = mujoco.MjData(body.mujoco_model)
    matrix = np.zeros((6, 6))
    for seed in range(20):
        random = np.random.default_rng(seed)
        data.qpos[:3], data.qpos[3:] = random.normal(size=3), random.normal(size=4)
        data.qpos[3:] /= np.linalg.norm(data.qpos[3:])
        mujoco.mj_forward(body.mujoco_model, data)
        mujoco.mj_fullM(body.mujoco_model, data, matrix)
        np.testing.assert_allclose(matrix, np.diag(ours), rtol=1e-9, atol=1e-15)


def test_mjx_follows_mujoco_c_in_free_flight(guards):
    y, commands = _random_flight(250)
    body = MjxBody(floor=False)
    model = Quadrotor(guards, body=body, integrator="euler", rotor_loads="instant")
    fly = jax.jit(rollout, compiler_options=helpers.QUICK_COMPILE)
    flown = helpers.pack(fly(model, helpers.state_of(y), jnp.asarray(commands)))
    np.testing.assert_allclose(flown, _mujoco_c(body.mujoco_model, y, commands), rtol=1e-8, atol=1e-8)


@pytest.fixture(scope="module")
def falling():
    """Rollout of three drones at once on the floor model: compiled once for all tests below."""
    body = MjxBody(floor=True)
    compiled = jax.jit(jax.vmap(rollout, in_axes=(0, 0, None)), compiler_options=helpers.QUICK_COMPILE)

    def fly(parameters, states, commands, integrator="leapfrog"):
        return helpers.pack(compiled(Quadrotor(parameters, body=body, integrator=integrator), states, commands))

    return fly


def _batch(*states):
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *(helpers.state_of(y) for y in states))


def _still(height: float, rotation_vector=(0.0, 0.0, 0.0)) -> np.ndarray:
    angle = np.linalg.norm(rotation_vector)
    y = np.zeros(17)
    y[2] = height
    y[6:10] = (
        [1, 0, 0, 0] if angle == 0 else [np.cos(angle / 2), *(np.sin(angle / 2) / angle * np.array(rotation_vector))]
    )
    return y


OFF = np.zeros((500, 4))


@pytest.fixture(scope="module")
def landings(falling, guards, off_center):
    """Two seconds without power: dropped level from 0.3 m, dropped tilted by 100 deg, dropped level off centre."""
    tilted = _still(0.3, np.radians(100) * np.array([0.8, 0.6, 0.0]))
    starts = (_still(0.3), tilted, _still(0.3))
    parameters = jax.tree.map(lambda *leaves: jnp.stack(leaves), guards, guards, off_center)
    return falling(parameters, _batch(*starts), jnp.asarray(OFF))


def test_dropped_level_it_comes_to_rest_level(landings):
    for flown in (landings[0], landings[2]):
        end = flown[-1]
        assert end[2] == pytest.approx(CENTER, abs=1e-3)
        # Penetration of the feet at rest and, below, on impact.
        assert CENTER - end[2] < 1e-3
        assert np.abs(helpers.part(end, "velocity")).max() < 1e-3
        assert np.abs(helpers.part(end, "body_rate")).max() < 1e-2
        assert helpers.rotation_matrix(helpers.part(end, "quaternion"))[2, 2] > np.cos(np.radians(1))


def test_dropped_on_its_side_it_tips_over_and_rests(landings):
    end = landings[1, -1]
    up = helpers.rotation_matrix(helpers.part(end, "quaternion"))[2, 2]
    assert abs(up) > np.cos(np.radians(10))  # no longer on its edge
    assert np.abs(helpers.part(end, "velocity")).max() < 1e-2
    assert np.abs(helpers.part(end, "body_rate")).max() < 0.1
    assert 0.0 < end[2] < 0.03


def test_mjx_follows_mujoco_c_onto_the_floor(falling, guards):
    starts = (_still(0.3), _still(0.3, np.radians(100) * np.array([0.8, 0.6, 0.0])))
    parameters = jax.tree.map(lambda *leaves: jnp.stack(leaves), guards, guards)
    flown = falling(parameters, _batch(*starts), jnp.asarray(OFF), "euler")
    model = MjxBody(floor=True).mujoco_model
    for y, ours in zip(starts, flown, strict=True):
        theirs = _mujoco_c(model, y, OFF)
        distance = np.linalg.norm(helpers.part(ours - theirs, "position"), axis=-1)
        angle = helpers.attitude_error(helpers.part(ours, "quaternion"), helpers.part(theirs, "quaternion"))
        # MuJoCo C starts its contact solver from the last step's solution, MJX here does not: both converge, so they
        # differ by the solvers' tolerance only, which the bounces of the tilted landing amplify.
        assert distance.max() < 1e-5
        assert angle.max() < np.radians(0.01)


@pytest.mark.parametrize(
    ("mjcf", "word"),
    [
        ("<mujoco><worldbody/></mujoco>", "free joint"),
        ("<mujoco><worldbody><body name='cfb'><freejoint/></body></worldbody></mujoco>", "mass"),
        ("not xml", "compile"),
        (
            "<mujoco><worldbody><body name='cfb'><freejoint/><geom size='1'/><body name='leg'><geom size='1'/></body>"
            "</body></worldbody></mujoco>",
            "child",
        ),
        ("<mujoco><worldbody><body name='x'><freejoint/><geom size='1'/></body></worldbody></mujoco>", "cfb"),
    ],
)
def test_an_unusable_mjcf_is_refused_by_name(mjcf, word, tmp_path):
    path = tmp_path / "drone.xml"
    path.write_text(mjcf)
    with pytest.raises(CfbError, match=r"drone\.xml") as caught:
        MjxBody(mjcf=path)
    assert word in str(caught.value)


def test_a_missing_mjcf_is_refused_by_name(tmp_path):
    with pytest.raises(CfbError, match=r"missing\.xml"):
        MjxBody(mjcf=tmp_path / "missing.xml")


def test_bodies_compare_by_what_they_are():
    assert RigidBody() == RigidBody()
    assert hash(RigidBody()) == hash(RigidBody())
    assert MjxBody(floor=True) == MjxBody(floor=True) != MjxBody(floor=False)
    assert hash(MjxBody(floor=True)) == hash(MjxBody(floor=True))
