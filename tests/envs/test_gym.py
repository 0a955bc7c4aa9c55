"""The Gymnasium environments: its own checker, and the same flights as the functions they wrap."""

from dataclasses import replace

import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from cfb_mjx.envs import FlipTask, TargetTask
from cfb_mjx.envs.gym import TargetEnv, TargetVectorEnv
from cfb_mjx.errors import CfbError

SHORT = replace(TargetTask(), episode_s=0.04)


# Positions and rates have no bounds, which it finds worth a warning.
@pytest.mark.filterwarnings("ignore:.*A Box observation space (min|max)imum value is")
@pytest.mark.parametrize("task", [TargetTask(), FlipTask()])
def test_gymnasiums_checker_finds_nothing(task):
    check_env(TargetEnv(task), skip_render_check=True)


def test_many_fly_end_and_begin_anew():
    env = TargetVectorEnv(3, SHORT)
    seen, _ = env.reset(seed=4)
    again, _ = TargetVectorEnv(3, SHORT).reset(seed=4)
    np.testing.assert_array_equal(seen, again)
    assert env.observation_space.contains(seen)
    hover = np.full((3, 4), 0.1, np.float32)
    for _ in range(4):
        seen, reward, failed, timed_out, info = env.step(hover)
        assert reward.shape == (3,)
        assert not failed.any()
        assert not timed_out.any()
        assert not info
    seen, _, failed, timed_out, info = env.step(hover)
    assert timed_out.all()
    assert not failed.any()
    assert info["final_obs"].shape == seen.shape
    assert not np.allclose(info["final_obs"], seen)
    # Anew: the next five steps are an episode again.
    assert not env.step(hover)[3].any()


def test_one_drone_shows_its_last_observation():
    env = TargetEnv(SHORT)
    seen, _ = env.reset(seed=1)
    path = [seen]
    for _ in range(5):
        seen, _, _, timed_out, _ = env.step(np.full(4, 0.1, np.float32))
        path.append(seen)
    assert timed_out
    # Forty milliseconds of flight move it by centimetres, a new episode by more.
    assert np.abs(path[-1][:3] - path[-2][:3]).max() < 0.2


def test_a_step_before_a_reset_is_refused():
    with pytest.raises(CfbError, match="call reset"):
        TargetVectorEnv(1, SHORT).step(np.zeros((1, 4)))


def test_seeds_count():
    env = TargetVectorEnv(2, SHORT)
    assert not np.allclose(env.reset(seed=1)[0], env.reset(seed=2)[0])
