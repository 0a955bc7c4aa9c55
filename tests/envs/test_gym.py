"""The Gymnasium environments: its own checker, and the same flights as the functions they wrap."""

import os
import subprocess
import sys
from dataclasses import replace
from functools import partial

import equinox as eqx
import gymnasium
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers import vector

from cfb_mjx.envs import FlipTask, Starts, TargetTask
from cfb_mjx.envs.gym import DIVERGED, FAST, TargetEnv, TargetVectorEnv
from cfb_mjx.errors import CfbError
from cfb_mjx.model import Quadrotor
from cfb_mjx.parameters import load_randomisation

pytestmark = pytest.mark.haste

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
        assert "final_obs" not in info
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


@pytest.fixture(scope="module")
def one():
    return TargetEnv(SHORT)


@pytest.fixture(scope="module")
def three():
    return TargetVectorEnv(3, replace(SHORT, randomisation=load_randomisation("paper")))


def test_a_step_before_a_reset_is_refused():
    with pytest.raises(CfbError, match="call reset"):
        TargetVectorEnv(1, SHORT).step(np.zeros((1, 4)))
    with pytest.raises(ResetNeeded, match="call reset"):
        TargetEnv(SHORT).step(np.zeros(4))


def test_a_step_past_the_end_is_refused(one):
    one.reset(seed=0)
    while not one.step(np.full(4, 0.1))[3]:
        pass
    with pytest.raises(ResetNeeded, match="call reset before step"):
        one.step(np.full(4, 0.1))
    one.reset()
    one.step(np.full(4, 0.1))


@pytest.mark.parametrize("action", [np.zeros(3), np.zeros((1, 4)), 0.5, "full", [[0.0], [0.0, 1.0]], None])
def test_an_action_of_another_shape_is_refused_in_a_sentence(one, three, action):
    one.reset(seed=0)
    with pytest.raises(CfbError, match=r"^TargetEnv: an action must be 4 numbers, .*, found .*\.$"):
        one.step(action)
    three.reset(seed=0)
    with pytest.raises(CfbError, match=r"^TargetVectorEnv: an action must be 3 x 4 numbers, .*, found .*\.$"):
        three.step(action)


@pytest.mark.parametrize("number", [np.nan, np.inf])
def test_an_action_that_is_not_finite_is_refused_at_once(one, three, number):
    actions = np.zeros((3, 4))
    actions[1, 2] = number
    three.reset(seed=0)
    with pytest.raises(CfbError, match="TargetVectorEnv: an action must be finite, found"):
        three.step(actions)
    one.reset(seed=0)
    with pytest.raises(CfbError, match="TargetEnv: an action must be finite, found"):
        one.step(actions[1])


def test_what_the_controller_does_not_see_is_in_the_info(three):
    _, info = three.reset(seed=5)
    mass = info["parameters"]["mass"]
    assert mass.shape == (3,)
    assert len(np.unique(mass)) == 3
    places = [info["position"]]
    for _ in range(4):
        *_, info = three.step(np.full((3, 4), 0.1))
        places.append(info["position"])
        np.testing.assert_allclose(np.linalg.norm(info["quaternion"], axis=1), 1, rtol=1e-5)
        assert info["rotor_speed"].shape == (3, 4)
        np.testing.assert_array_equal(info["parameters"]["mass"], mass)
        np.testing.assert_allclose(places[-1], places[-2] + 0.008 * info["velocity"], atol=2e-3)
    *_, info = three.step(np.full((3, 4), 0.1))
    # The truth of what ended, and of what has begun.
    np.testing.assert_array_equal(info["final_info"]["parameters"]["mass"], mass)
    np.testing.assert_allclose(info["final_info"]["position"], 2 * places[-1] - places[-2], atol=4e-3)
    assert not np.any(info["parameters"]["mass"] == mass)
    assert "failure" not in info["final_info"]


def test_a_drone_that_fails_says_why():
    drone = Quadrotor.from_file("cfb-guards")
    fast = replace(SHORT, starts=Starts(near=0.0, speed_mps=1e5))
    failing = TargetEnv(fast, drone)
    failing.reset(seed=3)
    _, reward, failed, _, info = failing.step(np.zeros(4))
    assert failed
    assert info["failure"] == FAST
    # A rotor that turns the faster the faster it turns: its speed overflows within a step.
    broken = eqx.tree_at(lambda m: m.parameters.motor_time_constant, drone, jnp.full(4, -1e-6))
    env = TargetVectorEnv(2, SHORT, broken)
    env.reset(seed=3)
    seen, reward, failed, timed_out, info = env.step(np.zeros((2, 4)))
    assert failed.all()
    assert not timed_out.any()
    assert info["final_info"]["failure"].tolist() == [DIVERGED] * 2
    assert (reward == -300).all()
    for numbers in (seen, info["final_obs"], info["final_info"]["position"], info["final_info"]["rotor_speed"]):
        assert np.isfinite(numbers).all()


def test_environments_without_a_seed_are_not_alike():
    many = [TargetVectorEnv(1, SHORT).reset()[0] for _ in range(2)]
    assert not np.any(many[0] == many[1])
    single = [TargetEnv(SHORT).reset()[0] for _ in range(2)]
    assert not np.any(single[0] == single[1])


@pytest.mark.parametrize("seed", [[1, 2], [1, 2, -3], -1, 2**32, 1.5, "one", True])
def test_other_seeds_are_refused_in_a_sentence(three, seed):
    with pytest.raises(CfbError, match=r"TargetVectorEnv: seed must be one whole number .*, or a list .*, found .*\.$"):
        three.reset(seed=seed)


# Half of the drones soon fail, the others' time is up after five commands.
MIXED = replace(SHORT, randomisation=load_randomisation("paper"), starts=Starts(near=0.5, rate_radps=60.0))


@pytest.mark.parametrize("mode", AutoresetMode)
def test_it_flies_as_gymnasiums_own_vector_of_single_drones(mode):
    seeds = [3, 1, 4, 1, 5]
    ours = TargetVectorEnv(5, MIXED, autoreset_mode=mode.value)
    theirs = SyncVectorEnv([partial(TargetEnv, MIXED)] * 5, autoreset_mode=mode)
    numbers, ends = np.random.default_rng(0), np.zeros(5, int)
    seen = [env.reset(seed=seeds)[0] for env in (ours, theirs)]
    np.testing.assert_allclose(*seen, atol=1e-5)
    np.testing.assert_array_equal(seen[0][1], seen[0][3])
    for _ in range(25):
        actions = numbers.uniform(-1, 1, (5, 4))
        actions[3] = actions[1]
        one, other = ours.step(actions), theirs.step(actions)
        for a, b in zip(one[:4], other[:4], strict=True):
            np.testing.assert_allclose(a, b, atol=1e-4)
        over = one[2] | one[3]
        ends += over
        assert one[4].keys() == other[4].keys()
        if mode == AutoresetMode.SAME_STEP and over.any():
            for i in np.flatnonzero(over):
                np.testing.assert_allclose(one[4]["final_obs"][i], other[4]["final_obs"][i], atol=1e-4)
        if mode == AutoresetMode.DISABLED and over.any():
            with pytest.raises(ResetNeeded, match="episodes are over"):
                ours.step(actions)
            begun = [env.reset(options={"reset_mask": over.copy()})[0] for env in (ours, theirs)]
            np.testing.assert_allclose(*begun, atol=1e-4)
    assert ends.min() >= 4
    assert ends.max() > ends.min()


def test_the_first_reset_begins_all_and_a_mask_is_checked():
    env = TargetVectorEnv(2, SHORT, autoreset_mode="Disabled")
    with pytest.raises(ResetNeeded, match="first reset"):
        env.reset(options={"reset_mask": np.array([True, False])})
    with pytest.raises(CfbError, match="reset_mask must be 2 booleans"):
        env.reset(options={"reset_mask": np.array([True])})
    with pytest.raises(CfbError, match=r"autoreset_mode must be one of NextStep, .*, found 'never'"):
        TargetVectorEnv(2, SHORT, autoreset_mode="never")


@pytest.mark.filterwarnings("ignore:.*A Box observation space (min|max)imum value is")
def test_gymnasium_makes_them_by_name_and_its_wrappers_work():
    one = gymnasium.make("cfb_mjx/Flip-v0", model="cfb")
    seen, _ = one.reset(seed=2)
    assert seen.shape == (FlipTask().layout.size,)
    many = gymnasium.make_vec("cfb_mjx/Target-v0", num_envs=3, task=SHORT, autoreset_mode="NextStep")
    assert isinstance(many.unwrapped, TargetVectorEnv)
    many = vector.NormalizeReward(vector.NormalizeObservation(vector.RecordEpisodeStatistics(many)))
    many.reset(seed=0)
    lengths = []
    for _ in range(12):
        *_, info = many.step(np.full((3, 4), -0.2))
        lengths += list(info["episode"]["l"][info["_episode"]]) if "episode" in info else []
    assert lengths == [5] * 6


FORKED = """
import warnings
warnings.simplefilter("ignore")
from dataclasses import replace
from gymnasium.vector import AsyncVectorEnv
from cfb_mjx.envs import TargetTask
from cfb_mjx.envs.gym import TargetEnv
from cfb_mjx.errors import CfbError
many = AsyncVectorEnv([TargetEnv, TargetEnv], context="fork")
try:
    many.reset(seed=0)
except CfbError as error:
    print(error)
many.close(terminate=True)
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork here")
def test_environments_in_forked_processes_say_so_instead_of_waiting():
    done = subprocess.run(
        [sys.executable, "-c", FORKED], capture_output=True, text=True, timeout=120, env={**os.environ}, check=False
    )
    assert 'context="spawn"' in done.stdout, done.stderr


def test_seeds_count():
    env = TargetVectorEnv(2, SHORT)
    assert not np.allclose(env.reset(seed=1)[0], env.reset(seed=2)[0])


def test_only_episodes_that_were_used_are_drawn_again():
    many = TargetVectorEnv(100, TargetTask(), autoreset_mode="Disabled")
    many.reset(seed=0)
    drawn, redraw = [], many._programs.redraw

    def counted(nominal, keys, waiting, which, numbers, places):
        drawn.append((which.nonzero()[0].tolist(), len(numbers)))
        return redraw(nominal, keys, waiting, which, numbers, places)

    many._programs = many._programs._replace(redraw=counted)
    # The first reset has used all; then three of them are needed, and three again.
    few = np.isin(np.arange(100), (3, 50, 99))
    for _ in range(2):
        many.reset(options={"reset_mask": few})
    assert drawn == [(list(range(100)), 100), ([3, 50, 99], 64)]


def test_drones_fly_the_same_episodes_however_many_are_drawn_again_at_once():
    """80 of 200 take two blocks; the last drone's episodes are those of a drone alone."""
    many, alone = (TargetVectorEnv(n, TargetTask(), autoreset_mode="Disabled") for n in (200, 1))
    seeds = list(range(200))
    many.reset(seed=seeds)
    alone.reset(seed=seeds[-1:])
    ended = np.arange(200) >= 120
    for _ in range(3):
        seen, _ = many.reset(options={"reset_mask": ended})
        only, _ = alone.reset()
        np.testing.assert_allclose(seen[-1], only[0], rtol=1e-6, atol=1e-6)
