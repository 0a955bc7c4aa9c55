"""The flip task: the paper's reward by hand, how flips begin, and what the policy sees."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from cfb_mjx.envs import FlipReward, FlipTask, Setpoints, observe, reset, step
from cfb_mjx.envs.task import QUIET
from cfb_mjx.model import Quadrotor, State
from cfb_mjx.parameters import load_randomisation

DRONE = Quadrotor.from_file("cfb-guards")
TASK = FlipTask(noise=QUIET)
ASKED = (2.0, 15.0)


def state_at(velocity=(0, 0, 0), rotation=None, rate=(0, 0, 0)) -> State:
    xyzw = (rotation or Rotation.identity()).as_quat()
    arrays = [np.asarray(x, float) for x in ((0, 0, 0), velocity, xyzw[[3, 0, 1, 2]], rate, (1594.0,) * 4)]
    return State(*map(jnp.asarray, arrays))


def test_the_papers_reward_by_hand():
    turn = Rotation.from_rotvec([2.0, 0.3, -0.4])
    velocity, rate = np.array([0.5, -1.0, 3.0]), np.array([14.0, 1.0, -2.0])
    along = turn.inv().apply(velocity) - [0, 0, 2.0]
    axis = turn.apply([1, 0, 0]) - [1, 0, 0]
    wanted = (
        0.6 * (1 - np.linalg.norm(along) / 20)
        + 0.15 * (1 - np.linalg.norm(axis) / 3)
        + 1.0 * (1 - np.linalg.norm([-1.0, 1.0, -2.0]) / 20)
    )
    got = FlipReward()(state_at(velocity, turn, rate), jnp.array(ASKED))
    np.testing.assert_allclose(got, wanted, rtol=1e-6)


def test_at_the_set_points_a_step_is_worth_most():
    turn = Rotation.from_rotvec([2.5, 0, 0])
    at = state_at(turn.apply([0, 0, ASKED[0]]), turn, (ASKED[1], 0, 0))
    np.testing.assert_allclose(FlipReward()(at, jnp.array(ASKED)), TASK.largest_reward, rtol=1e-5)
    np.testing.assert_allclose(TASK.errors(at, jnp.zeros(3), jnp.array(ASKED)), 0, atol=1e-5)


@pytest.mark.parametrize(("velocity", "rate", "failed"), [((0, 0, 9.9), 29.9, False), ((0, 0, 10.1), 0, True)])
def test_too_fast_ends_the_episode_and_costs_300(velocity, rate, failed):
    at, reward = state_at(velocity, rate=(rate, 0, 0)), FlipReward()
    assert bool(TASK.failed(at)) == failed
    kept = replace(reward, failure=0.0)(at, jnp.array(ASKED))
    np.testing.assert_allclose(reward(at, jnp.array(ASKED)), kept - 300 * failed, rtol=1e-6)


def test_the_policy_sees_no_position_and_its_set_points():
    start = state_at((1.0, -2.0, 0.5), Rotation.from_rotvec([1.0, 0.4, 0.2]), (3, 1, -2))
    shown = observe(TASK, reset(TASK, DRONE, jax.random.PRNGKey(0), start, setpoint=ASKED))
    assert shown.shape == (TASK.layout.size,) == (15 * 2 + 24 + 2,)
    np.testing.assert_allclose(shown[-2:], [ASKED[0] / 3, ASKED[1] / 10], rtol=1e-6)
    along = Rotation.from_rotvec([1.0, 0.4, 0.2]).inv().apply([1.0, -2.0, 0.5])
    np.testing.assert_allclose(shown[:3], along / 3, rtol=1e-5)
    elsewhere = eqx.tree_at(lambda s: s.position, start, jnp.array([3.0, 4.0, 5.0]))
    again = observe(TASK, reset(TASK, DRONE, jax.random.PRNGKey(0), elsewhere, setpoint=ASKED))
    np.testing.assert_allclose(again, shown, rtol=1e-6)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**31 - 1))
def test_episodes_begin_within_what_is_asked(seed):
    task = replace(TASK, setpoints=Setpoints((-1.0, 2.0), (9.0, 20.0)))
    episode = _begin(task, jax.random.PRNGKey(seed))
    speed, rate = episode.setpoint
    assert -1 <= speed <= 2
    assert 9 <= rate <= 20
    np.testing.assert_allclose(np.linalg.norm(episode.state.quaternion), 1, rtol=1e-6)
    starts = task.starts
    assert -starts.fall_mps <= episode.state.velocity[2] <= starts.climb_mps
    assert episode.state.body_rate[0] <= 1.2 * rate + starts.rate_radps
    assert not task.failed(episode.state)


_begin = eqx.filter_jit(lambda task, key: reset(task, DRONE, key))


def test_half_of_the_episodes_enter_level_and_the_rest_are_turning():
    begin = jax.jit(jax.vmap(lambda key: reset(TASK, DRONE, key).state))
    states = begin(jax.random.split(jax.random.PRNGKey(0), 2000))
    roll, pitch, yaw = Rotation.from_quat(np.asarray(states.quaternion)[:, [1, 2, 3, 0]]).as_euler("xyz").T
    entering = (np.abs(roll) <= TASK.starts.tilt_rad + 1e-6) & (states.velocity[:, 2] >= 0)
    # Of those that turn, some look as if they entered.
    assert 0.5 < entering.mean() < 0.6
    assert np.all(np.abs(pitch) <= TASK.starts.tilt_rad + 1e-6)
    assert np.all(np.abs(yaw) <= TASK.starts.tilt_rad + 1e-6)
    np.testing.assert_allclose(
        np.histogram(roll[~entering], 6, (-np.pi, np.pi))[0] / (~entering).sum(), 1 / 6, atol=0.06
    )


def test_each_episode_has_its_own_drone_and_flies():
    task = FlipTask(randomisation=load_randomisation("paper"))
    keys = jax.random.split(jax.random.PRNGKey(0), 16)

    @jax.jit
    def fly(key):
        episode = reset(task, DRONE, key)
        after, outcome = step(task, episode, jnp.full(4, 0.6))
        return episode.model.parameters.mass, after.count, outcome.reward

    mass, count, reward = jax.vmap(fly)(keys)
    assert len(np.unique(mass)) == 16
    assert np.all(count == 1)
    assert np.all(np.isfinite(reward))
