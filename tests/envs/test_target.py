"""The target task: the paper's reward by hand, what the controller sees and when, and drones drawn at every episode."""

import math
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from cfb_mjx.envs import PAPER_REWARD, Layout, Noise, Starts, TargetReward, TargetTask, observe, reset, step
from cfb_mjx.envs.observation import StateEstimate, frame, observation, remember, start
from cfb_mjx.envs.task import QUIET
from cfb_mjx.errors import CfbError
from cfb_mjx.model import Quadrotor, State, rollout
from cfb_mjx.parameters import load_randomisation

pytestmark = pytest.mark.haste

DRONE = Quadrotor.from_file("cfb-guards")
QUIET_TASK = TargetTask(noise=QUIET)
RANDOM_TASK = TargetTask(randomisation=load_randomisation("paper"))


def state_at(position=(0, 0, 0), velocity=(0, 0, 0), rotation=None, rate=(0, 0, 0)) -> State:
    xyzw = (rotation or Rotation.identity()).as_quat()
    arrays = [np.asarray(x, float) for x in (position, velocity, xyzw[[3, 0, 1, 2]], rate, (1594.0,) * 4)]
    return State(*map(jnp.asarray, arrays))


def test_the_papers_reward_by_hand():
    # Thrusts typed in from eq. 8 at s = u, as K = sigma: the lever of each rotor is l/2 = 0.03535 m.
    command = np.array([0.55, 0.56, 0.57, 0.60])
    f = -0.23 * command**3 + 0.562 * command**2 - 0.043 * command
    torque = 0.03535 * np.array([-f[0] - f[1] + f[2] + f[3], -f[0] + f[1] + f[2] - f[3]])
    turn = Rotation.from_rotvec([0.4, -0.2, 0.3])
    q = turn.as_quat()[[3, 0, 1, 2]]
    at = state_at((1, -2, 2), (3, 0, 4), turn, (0, 6, 8))
    wanted = (
        (1 - 3 / 10)
        + 0.05 * (1 - 5 / 10)
        + 0.15 * (1 - np.linalg.norm(q - [1, 0, 0, 0]) / 2)
        + 0.15 * 0.0
        + 0.02 * max(0, 1 - np.linalg.norm(torque) / 0.01)
    )
    got = PAPER_REWARD(at, jnp.zeros(3), jnp.asarray(command), DRONE.parameters)
    assert np.isclose(got, wanted, atol=1e-5)
    same_attitude = eqx.tree_at(lambda s: s.quaternion, at, -at.quaternion)
    assert np.isclose(PAPER_REWARD(same_attitude, jnp.zeros(3), jnp.asarray(command), DRONE.parameters), got)


def test_near_rewards_rest_at_the_target():
    hover = jnp.full(4, 0.55)

    def more(position, velocity, turn=None):
        at = state_at(position, velocity, turn)
        given = [TargetReward(near=near)(at, jnp.zeros(3), hover, DRONE.parameters) for near in (3.0, 0.0)]
        return float(given[0] - given[1])

    assert np.isclose(more((0, 0, 0), (0, 0, 0)), 3.0, atol=1e-5)
    # One width, and one speed, away: half of it each alone, a third together.
    assert np.isclose(more((0.25, 0, 0), (0, 0, 0)), 1.5, atol=1e-5)
    assert np.isclose(more((0, 0, 0), (0, 0.24, 0.32)), 1.5, atol=1e-5)
    assert np.isclose(more((0, 0, 0.25), (0.4, 0, 0)), 1.0, atol=1e-5)
    # |q - 1| = 2 sin(angle / 4) = 0.5
    assert np.isclose(more((0, 0, 0), (0, 0, 0), Rotation.from_rotvec([0, 0, 4 * np.arcsin(0.25)])), 1.5, atol=1e-5)
    assert TargetReward(near=3.0).largest - TargetReward(near=0.0).largest == 3.0


@pytest.mark.parametrize(
    ("velocity", "rate", "failed"),
    [((9.9, 0, 0), (0, 0, 29.9), False), ((8, 0, 6.1), (0, 0, 0), True), ((0, 0, 0), (0, -30.1, 0), True)],
)
def test_too_fast_ends_the_episode_and_costs_300(velocity, rate, failed):
    reward = PAPER_REWARD
    at = state_at(velocity=velocity, rate=rate)
    hover = jnp.full(4, 0.55)
    assert bool(reward.failed(at)) == failed
    kept = replace(reward, failure=0.0)(at, jnp.zeros(3), hover, DRONE.parameters)
    assert np.isclose(reward(at, jnp.zeros(3), hover, DRONE.parameters), kept - 300 * failed)


def test_an_episode_without_noise_is_a_rollout():
    start = state_at((0.3, 0, 1), (0.5, -0.2, 0), Rotation.from_rotvec([0.2, 0.1, 0]), (1, 0, -1))
    commands = jnp.asarray(np.random.default_rng(0).uniform(0.4, 0.7, (25, 4)))
    episode = reset(QUIET_TASK, DRONE, jax.random.PRNGKey(0), start)
    one = eqx.filter_jit(lambda e, u: step(QUIET_TASK, e, u)[0])
    for u in commands:
        episode = one(episode, u)
    alone = rollout(DRONE, start, commands, hold=2)
    for name in ("position", "velocity", "quaternion", "body_rate", "rotor_speed"):
        np.testing.assert_allclose(getattr(episode.state, name), getattr(alone, name)[-1], rtol=1e-9, atol=1e-12)


def test_estimates_are_eight_milliseconds_old_and_turned_by_the_offset():
    offset = np.array([0.1, -0.15, 0.2])
    drone = eqx.tree_at(lambda m: m.parameters.attitude_offset, DRONE, jnp.asarray(offset))
    start = state_at((0.3, 0, 1), (2, -1, 0.5), Rotation.from_rotvec([0.2, 0.1, 0]), (3, 1, -2))
    target = np.array([1.0, 2.0, 3.0])
    episode = reset(QUIET_TASK, drone, jax.random.PRNGKey(0), start, target)
    commands = jnp.asarray(np.random.default_rng(1).uniform(0.4, 0.7, (10, 4)))
    for u in commands:
        episode, _ = step(QUIET_TASK, episode, u)
    # Two steps of 4 ms earlier: after nine commands of 8 ms.
    before = rollout(drone, start, commands[:9], hold=2)
    np.testing.assert_allclose(episode.estimate.position, before.position[-1] - target, atol=1e-12)
    np.testing.assert_allclose(episode.estimate.body_rate, before.body_rate[-1], atol=1e-12)
    true = Rotation.from_quat(np.asarray(before.quaternion[-1])[[1, 2, 3, 0]])
    seen = Rotation.from_quat(np.asarray(episode.estimate.quaternion)[[1, 2, 3, 0]])
    np.testing.assert_allclose((true.inv() * seen).as_rotvec(), offset, atol=1e-9)


def test_the_observation_is_the_contract():
    layout = Layout(past_estimates=2, estimate_stride=2, past_commands=3, integral=True)
    task = replace(QUIET_TASK, layout=layout)
    episode = reset(task, DRONE, jax.random.PRNGKey(3))
    estimates, commands = [episode.estimate], []
    for u in np.random.default_rng(2).uniform(0.4, 0.7, (4, 4)):
        episode, _ = step(task, episode, jnp.asarray(u))
        estimates.append(episode.estimate)
        commands.append(u)

    def frame(e):
        matrix = Rotation.from_quat(np.asarray(e.quaternion)[[1, 2, 3, 0]]).as_matrix()
        distance = np.linalg.norm(e.position)
        position = matrix.T @ e.position / distance * np.arcsinh(distance / 0.1)
        speed = np.linalg.norm(e.velocity)
        velocity = matrix.T @ e.velocity / speed * 0.5 * np.arcsinh(speed / 0.5)
        return np.concatenate([position, velocity / 2.0, matrix.ravel(), e.body_rate / 10.0])

    integral = sum(0.008 * np.clip(e.position, -0.3, 0.3) for e in estimates[:-1])
    wanted = np.concatenate(
        [frame(e) for e in estimates[::-2]] + [2 * u - 1 for u in commands[:-4:-1]] + [integral / 0.6]
    )
    got = observe(task, episode)
    assert got.shape == (layout.size,)
    np.testing.assert_allclose(got, wanted, atol=1e-9)


def test_far_targets_look_no_farther_than_the_limit():
    at = state_at((30.0, 40.0, 0.0))
    shown = observe(QUIET_TASK, reset(QUIET_TASK, DRONE, jax.random.PRNGKey(0), at))
    np.testing.assert_allclose(shown[:3], np.array([0.6, 0.8, 0.0]) * np.arcsinh(8.0 / 0.1), atol=1e-9)
    straight = replace(QUIET_TASK, layout=Layout(position_scale_m=1.0, position_bend_m=0.0))
    shown = observe(straight, reset(straight, DRONE, jax.random.PRNGKey(0), at))
    np.testing.assert_allclose(shown[:3], [4.8, 6.4, 0.0], atol=1e-9)


@settings(max_examples=50, deadline=None)
@given(st.floats(-3, 1), st.floats(-3, 1))
def test_small_lengths_are_shown_as_they_are_and_large_ones_by_their_logarithm(near, far):
    near, far = sorted((10.0**near, 10.0**far))

    def shown(what, unit):
        at = dict.fromkeys(("position", "velocity", "body_rate"), jnp.zeros(3))
        layout = Layout(position_limit_m=20.0, position_bend_m=0.1, velocity_bend_mps=0.1, velocity_scale_mps=0.1)
        index = {"position": 1, "velocity": 4}[what]
        along = jnp.array([0.0, 1.0, 0.0]) * unit
        return frame(layout, StateEstimate(**at | {what: along}, quaternion=jnp.array([1.0, 0.0, 0.0, 0.0])))[index]

    for what in ("position", "velocity"):
        assert 0 < shown(what, near) <= near / 0.1 + 1e-9
        if near < 0.01:
            assert shown(what, near) > 0.998 * near / 0.1
        # A factor in length is at most a sum of its logarithm.
        assert 0 <= shown(what, far) - shown(what, near) <= math.log(far / near) + 1e-9
        assert float(jax.grad(lambda y, what=what: shown(what, y))(0.0)) == pytest.approx(1 / 0.1)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**31 - 1), st.floats(0, 1.5))
def test_every_episode_flies_another_drone_within_the_ranges(seed, magnitude):
    drawn = _drawn(jax.random.split(jax.random.PRNGKey(seed)), magnitude)
    mean = DRONE.parameters
    ratio = np.asarray(drawn.parameters.thrust_scale)
    assert np.all(np.abs(ratio - 1) <= 0.2 * magnitude + 1e-12)
    assert np.all(np.abs(drawn.parameters.mass / mean.mass - 1) <= 0.1 * magnitude + 1e-12)
    assert np.all(np.abs(drawn.parameters.attitude_offset) <= np.radians(15) * magnitude + 1e-12)
    if magnitude > 0.01:
        assert not np.allclose(ratio[0], ratio[1], rtol=1e-9)
        assert len(set(ratio[0].tolist())) == 4


@jax.jit
def _drawn(keys, magnitude):
    return jax.vmap(lambda key: reset(RANDOM_TASK, DRONE, key, magnitude=magnitude).model)(keys)


@pytest.mark.parametrize("near", [0.3, 0.5])
def test_starts_reach_as_far_as_they_say_and_as_many_as_asked_begin_nearby(near):
    task = TargetTask(starts=Starts(near=near))
    states = jax.jit(jax.vmap(lambda key: reset(task, DRONE, key).state))(jax.random.split(jax.random.PRNGKey(0), 4000))
    level = np.linalg.norm(states.position[:, :2], axis=1)
    assert 6.0 < level.max() <= 6.5
    assert np.abs(states.position[:, 2]).max() <= 2.0
    # Of the others 0.1 + 0.09: difficulty times the root of a uniform number below a tenth.
    assert np.mean(level < 0.65) == pytest.approx(near + 0.19 * (1 - near), abs=0.03)
    up = Rotation.from_quat(np.asarray(states.quaternion)[:, [1, 2, 3, 0]]).as_matrix()[:, 2, 2]
    assert up.min() < -0.95
    np.testing.assert_allclose(np.linalg.norm(states.quaternion, axis=1), 1, atol=1e-12)
    # What hovers beside the target keeps its height for a moment: rotors carry the weight.
    assert np.all(np.asarray(states.rotor_speed) > 0.5 * 1594)


def test_noise_has_the_size_it_says():
    noise = Noise(0.0, 0.0, 0.01, 0.02, 0.03, 0.04)
    task = TargetTask(noise=noise)
    start = DRONE.hover_state((0.0, 0.0, 0.0))
    seen = jax.jit(jax.vmap(lambda key: reset(task, DRONE, key, start).estimate))(
        jax.random.split(jax.random.PRNGKey(0), 20000)
    )
    turned = Rotation.from_quat(np.asarray(seen.quaternion)[:, [1, 2, 3, 0]]).as_rotvec()
    for values, std in ((seen.position, 0.01), (seen.velocity, 0.02), (turned, 0.03), (seen.body_rate, 0.04)):
        np.testing.assert_allclose(np.std(values, axis=0), std, rtol=0.03)


def test_the_state_is_kicked_in_every_simulation_step():
    task = TargetTask(noise=Noise(0.001, 0.001, 0.0, 0.0, 0.0, 0.0))
    start = DRONE.hover_state((0.0, 0.0, 0.0))

    def flown(key):
        episode = reset(task, DRONE, key, start)
        return step(task, episode, DRONE.hover_command())[0].state

    after = jax.jit(jax.vmap(flown))(jax.random.split(jax.random.PRNGKey(0), 20000))
    # Two kicks of one thousandth each per control step.
    np.testing.assert_allclose(np.std(after.body_rate, axis=0), 0.001 * 2**0.5, rtol=0.03)
    np.testing.assert_allclose(np.std(after.velocity, axis=0), 0.001 * 2**0.5, rtol=0.03)


def test_the_control_step_must_fit_the_simulation():
    task = TargetTask(layout=Layout(control_dt_s=0.01))
    with pytest.raises(CfbError, match=r"control_dt_s = 0.01 is not a multiple"):
        task.hold(DRONE)


@pytest.mark.parametrize(("body_position", "body_velocity"), [(True, False), (False, True)])
def test_position_and_velocity_have_axes_of_their_own_choice(body_position, body_velocity):
    turn = Rotation.from_rotvec([0.4, -0.7, 1.1])
    position, velocity = np.array([1.0, -2.0, 0.5]), np.array([0.3, 0.2, -0.4])
    layout = Layout(
        position_scale_m=1.0,
        position_bend_m=0.0,
        velocity_scale_mps=1.0,
        velocity_bend_mps=0.0,
        body_position=body_position,
        body_velocity=body_velocity,
    )
    quaternion = jnp.asarray(turn.as_quat()[[3, 0, 1, 2]])
    shown = frame(layout, StateEstimate(jnp.asarray(position), jnp.asarray(velocity), quaternion, jnp.zeros(3)))
    np.testing.assert_allclose(shown[:3], turn.inv().apply(position) if body_position else position, atol=1e-9)
    np.testing.assert_allclose(shown[3:6], turn.inv().apply(velocity) if body_velocity else velocity, atol=1e-9)


def test_commands_before_the_first_are_shown_as_those_after_it():
    """From -1 to 1, as 2 u - 1; the newest first."""
    layout, zero = Layout(past_commands=3), jnp.zeros(3)
    at = StateEstimate(zero, zero, jnp.array([1.0, 0.0, 0.0, 0.0]), zero)
    memory = start(layout, at, jnp.array([0.5, 0.6, 0.75, 1.0]))
    np.testing.assert_allclose(memory.commands, [[0.0, 0.2, 0.5, 1.0]] * 3, atol=1e-12)
    memory = remember(layout, memory, at, jnp.array([0.0, 0.25, 0.5, 0.75]))
    np.testing.assert_allclose(memory.commands, [[-1.0, -0.5, 0.0, 0.5], *[[0.0, 0.2, 0.5, 1.0]] * 2], atol=1e-12)


def test_the_integral_and_the_set_points_are_shown_in_their_units():
    """An error of 0.2 m for 400 steps of 8 ms is 0.64 m s, beyond the limit of 0.6; one of 5 m counts as 0.3 m."""
    layout = Layout(past_estimates=0, past_commands=0, integral=True, setpoint_scales=(2.0, 20.0))
    at = dict.fromkeys(("velocity", "body_rate"), jnp.zeros(3))
    at = StateEstimate(jnp.array([0.2, -0.1, 5.0]), quaternion=jnp.array([1.0, 0.0, 0.0, 0.0]), **at)

    def after(steps):
        memory = jax.lax.fori_loop(
            0, steps, lambda _, m: remember(layout, m, at, jnp.full(4, 0.5)), start(layout, at, 0.5)
        )
        return observation(layout, memory, at, jnp.array([3.0, 10.0]))[-5:]

    np.testing.assert_allclose(after(10), [0.016 / 0.6, -0.008 / 0.6, 0.024 / 0.6, 1.5, 0.5], rtol=1e-9)
    np.testing.assert_allclose(after(400), [1.0, -0.32 / 0.6, 1.0, 1.5, 0.5], rtol=1e-9)
