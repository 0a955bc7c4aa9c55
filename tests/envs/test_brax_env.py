"""Tasks as Brax sees them: its own wrappers and trainers, with their defaults where they have any."""

from __future__ import annotations

import functools
import warnings

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cfb_mjx.control import brax_controller
from cfb_mjx.envs import FlipTask, Noise, TargetTask, observe, reset, step
from cfb_mjx.envs.brax_env import EACH, BraxEnv, wrap
from cfb_mjx.envs.flip import FLIP_LAYOUT
from cfb_mjx.errors import CfbError
from cfb_mjx.parameters import load_randomisation
from cfb_mjx.train.brax_compat import brax_ppo

with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    from brax.envs.wrappers import training
    from brax.training.agents.ppo import networks

pytestmark = pytest.mark.haste

TASK = TargetTask(randomisation=load_randomisation("paper"), episode_s=0.08)


@pytest.fixture(autouse=True)
def _single():
    with jax.enable_x64(False):
        yield


def _masses(state) -> np.ndarray:
    return np.asarray(state.pipeline_state.model.parameters.mass)


def _flown(env, drones: int, commands: int):
    """States after each command of zeros, the first before any."""
    step_ = jax.jit(env.step)
    states = [jax.jit(env.reset)(jax.random.split(jax.random.PRNGKey(0), drones))]
    for _ in range(commands):
        states.append(step_(states[-1], jnp.zeros((drones, 4))))
    return states


def test_it_flies_what_the_task_flies():
    env, key = BraxEnv(TASK), jax.random.PRNGKey(3)
    state, episode = jax.jit(env.reset)(key), reset(env.task, env.sys, key)
    action = jnp.array([0.1, -0.2, 0.3, 0.0])
    after, (flown, outcome) = jax.jit(env.step)(state, action), step(env.task, episode, 0.5 * (1 + action))
    np.testing.assert_allclose(state.obs["state"], observe(env.task, episode), atol=1e-6)
    np.testing.assert_allclose(after.obs["state"], observe(env.task, flown), atol=1e-5)
    np.testing.assert_allclose(after.reward, outcome.reward, rtol=1e-5)
    assert env.observation_size == {name: x.shape[-1] for name, x in after.obs.items()}
    assert env.dt == 0.008


@pytest.mark.parametrize("task", [TASK, FlipTask(layout=FLIP_LAYOUT, episode_s=0.08)])
def test_brax_wraps_it_as_its_own(task):
    states = _flown(training.wrap(BraxEnv(task), episode_length=10), 3, 12)
    assert [float(s.done.max()) for s in states] == [0] * 10 + [1, 0, 0]
    np.testing.assert_array_equal(states[10].info["truncation"], 1.0)
    # As Brax does it: for ever the same drones.
    np.testing.assert_array_equal(_masses(states[0]), _masses(states[12]))


def test_every_episode_has_a_drone_of_its_own():
    states = _flown(wrap(BraxEnv(TASK), episode_length=10), 4, 3 * 10 + 1)
    episodes = [_masses(states[i]) for i in (0, 10, 20, 30)]
    assert len(np.unique(np.stack(episodes))) == 16
    for i in (0, 10, 20):
        for k in range(i, i + 10):
            np.testing.assert_array_equal(_masses(states[k]), episodes[i // 10])
    # What is seen with an episode's end is how the next one begins, of which nothing has been flown.
    np.testing.assert_array_equal(states[10].pipeline_state.count, 0)
    np.testing.assert_array_equal(states[10].info["truncation"], 1.0)
    seen = jax.vmap(functools.partial(observe, TASK))(states[10].pipeline_state)
    np.testing.assert_allclose(states[10].obs["state"], seen, atol=1e-6)
    assert EACH < 10


def test_randomised_in_the_way_of_brax():
    def heavier(drone):
        masses = jnp.array([0.03, 0.04, 0.05])
        return _with_mass(drone, masses), _with_mass(jax.tree.map(lambda _: None, drone), 0)

    env = wrap(BraxEnv(TargetTask(episode_s=0.08)), 10, 1, heavier)
    states = _flown(env, 3, 12)
    np.testing.assert_allclose(_masses(states[11]), [0.03, 0.04, 0.05])


def _with_mass(model, mass):
    return eqx.tree_at(lambda m: m.parameters.mass, model, mass, is_leaf=lambda x: x is None)


SMALL = {"num_envs": 8, "episode_length": 10, "seed": 1, "num_evals": 2, "num_eval_envs": 4}
FACTORY = functools.partial(
    networks.make_ppo_networks,
    policy_hidden_layer_sizes=(16, 16),
    value_hidden_layer_sizes=(16,),
    activation=jnp.tanh,
    policy_obs_key="state",
    value_obs_key="privileged_state",
)


def _same_policy(policy, params, normalized: bool) -> None:
    env = BraxEnv(TASK)
    obs = jax.vmap(env.reset)(jax.random.split(jax.random.PRNGKey(5), 6)).obs
    action, _ = policy(obs, jax.random.PRNGKey(0))
    controller = brax_controller(params, TASK.layout, normalized=normalized)
    np.testing.assert_allclose(jax.vmap(controller.act)(obs["state"]), 0.5 * (1 + action), atol=2e-5)


def test_ppo_of_brax_trains_it_and_the_policy_becomes_a_controller():
    seen = []
    with brax_ppo() as train:
        make_policy, params, metrics = train(
            BraxEnv(TASK),
            num_timesteps=320,
            unroll_length=5,
            batch_size=8,
            num_minibatches=2,
            normalize_observations=True,
            network_factory=FACTORY,
            progress_fn=lambda steps, metrics: seen.append(steps),
            bootstrap_on_timeout=True,
            wrap_env_fn=wrap,
            **SMALL,
        )
    assert seen[0] == 0
    assert seen[-1] >= 320
    assert np.isfinite(metrics["eval/episode_reward"])
    assert metrics["eval/episode_distance_m"] > 0
    _same_policy(make_policy(params, deterministic=True), params, True)
    # Brax returns statistics of what was seen also where its policy does not use them.
    plain = networks.make_inference_fn(FACTORY({"state": (60,), "privileged_state": (51,)}, 4))
    _same_policy(plain(params, deterministic=True), params, False)


def test_sac_of_brax_runs_on_it():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from brax.training.agents.sac import train as sac
    env = BraxEnv(TargetTask(noise=Noise(), episode_s=0.08), asymmetric=False)
    with brax_ppo():
        _, params, metrics = sac.train(
            env, num_timesteps=128, min_replay_size=16, max_replay_size=256, batch_size=8, **SMALL
        )
    assert np.isfinite(metrics["eval/episode_reward"])
    with pytest.raises(CfbError, match="brax_controller"):
        brax_controller(params, FLIP_LAYOUT, normalized=False, activation="relu")
