"""Tasks as MuJoCo Playground sees them; `pip install '.[playground]'` brings it."""

from __future__ import annotations

import functools
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cfb_mjx.envs import TargetTask
from cfb_mjx.envs.brax_env import BraxEnv, wrap
from cfb_mjx.errors import CfbError
from cfb_mjx.parameters import load_randomisation
from cfb_mjx.train.brax_compat import brax_ppo

with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    pytest.importorskip("mujoco_playground", reason="MuJoCo Playground is not installed (400 MB; extra `playground`)")
    from brax.training.agents.ppo import networks
    from mujoco_playground import MjxEnv, registry, wrapper

    from cfb_mjx.envs.playground import CfbEnv, default_config

pytestmark = pytest.mark.haste


@pytest.fixture(autouse=True)
def _single():
    with jax.enable_x64(False):
        yield


@pytest.fixture(scope="module")
def env():
    with jax.enable_x64(False):
        return registry.load("CfbTarget", config_overrides={"model": "cfb", "magnitude": 0.5})


def test_it_is_one_of_playgrounds_and_flies_what_brax_flies(env):
    assert isinstance(env, MjxEnv)
    assert env.observation_size == {"state": (60,), "privileged_state": (51,)}
    assert (env.dt, env.sim_dt, env.n_substeps) == (0.008, 0.004, 2)
    other = BraxEnv(TargetTask(randomisation=load_randomisation("paper"), magnitude=0.5), "cfb")
    key, action = jax.random.PRNGKey(3), jnp.array([0.1, -0.2, 0.3, 0.0])
    mine, theirs = (jax.jit(e.step)(jax.jit(e.reset)(key), action) for e in (env, other))
    np.testing.assert_array_equal(mine.obs["state"], theirs.obs["state"])
    np.testing.assert_array_equal(mine.data.qpos[:3], theirs.pipeline_state.state.position)
    np.testing.assert_array_equal(mine.data.qvel[3:], theirs.pipeline_state.state.body_rate)
    assert mine.reward == theirs.reward


@pytest.mark.parametrize(("wrapped", "anew"), [(wrapper.wrap_for_brax_training, False), (wrap, True)])
def test_episodes_begin_anew_in_either_way(env, wrapped, anew):
    """Playground's wrapper goes back to the first drone; ours takes another."""
    own = wrapped(env, episode_length=4)
    state, step = jax.jit(own.reset)(jax.random.split(jax.random.PRNGKey(1), 3)), jax.jit(own.step)
    first = state.data.episode.model.parameters.mass
    for _ in range(4):
        state = step(state, jnp.zeros((3, 4)))
    assert jnp.all(state.done == 1)
    same = state.data.episode.model.parameters.mass == first
    assert jnp.all(~same if anew else same)


def test_brax_trains_it_in_playgrounds_way(env):
    factory = functools.partial(
        networks.make_ppo_networks,
        policy_hidden_layer_sizes=(8,),
        value_hidden_layer_sizes=(8,),
        policy_obs_key="state",
        value_obs_key="privileged_state",
    )
    with brax_ppo() as train:
        _, params, metrics = train(
            env,
            num_timesteps=64,
            num_envs=4,
            unroll_length=4,
            batch_size=4,
            num_minibatches=1,
            num_updates_per_batch=1,
            episode_length=8,
            num_eval_envs=4,
            network_factory=factory,
            wrap_env_fn=wrapper.wrap_for_brax_training,
        )
    assert np.isfinite(metrics["eval/episode_reward"])
    assert all(bool(jnp.all(jnp.isfinite(x))) for x in jax.tree.leaves(params[1]))


def test_what_would_change_nothing_is_refused(env):
    given = functools.partial(wrapper.wrap_for_brax_training, env, randomization_fn=lambda m: (m, None))
    with pytest.raises(CfbError, match="`randomisation` and `magnitude`"):
        given().reset(jax.random.split(jax.random.PRNGKey(1), 3))
    with pytest.raises(CfbError, match=r"ctrl_dt = 0\.02"):
        CfbEnv(config_overrides={"ctrl_dt": 0.02})


def test_the_second_task_and_no_randomisation():
    flip = registry.load("CfbFlip", config_overrides={"randomisation": ""})
    masses = jax.vmap(flip.reset)(jax.random.split(jax.random.PRNGKey(0), 3)).data.episode.model.parameters.mass
    assert len(set(masses.tolist())) == 1
    assert registry.get_default_config("CfbFlip") == default_config()
