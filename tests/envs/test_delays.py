"""How late what a controller sees is: pose and gyro, set and drawn, and never less because a buffer is too short."""

from __future__ import annotations

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cfb_mjx.control.controllers import find_controller, has_lumped_delay
from cfb_mjx.envs import Starts, TargetTask, reset, step, with_room
from cfb_mjx.envs.gym import TargetVectorEnv
from cfb_mjx.envs.task import QUIET
from cfb_mjx.errors import CfbError
from cfb_mjx.model import Quadrotor, State
from cfb_mjx.parameters import Randomisation
from cfb_mjx.parameters.randomisation import Range
from cfb_mjx.train.flight import fly

pytestmark = pytest.mark.haste

DRONE = Quadrotor.from_file("cfb-guards")
TASK = TargetTask(noise=QUIET)


def late(pose: float, gyro: float = 0.0, model: Quadrotor = DRONE) -> Quadrotor:
    where = lambda m: (m.parameters.pose_delay, m.parameters.gyro_delay)  # noqa: E731
    return eqx.tree_at(where, model, (jnp.asarray(pose), jnp.asarray(gyro)))


# Without weight and thrust it moves on at 1 m/s along x, and without torque its rate grows by what is pushed: nothing.
COASTING = State.at_rest((0.0, 0.0, 0.0), jnp.zeros(4))
COASTING = eqx.tree_at(lambda s: s.velocity, COASTING, jnp.array([1.0, 0.0, 0.0]))


def weightless(model: Quadrotor) -> Quadrotor:
    return eqx.tree_at(lambda m: m.parameters.gravity, model, jnp.asarray(0.0))


@pytest.mark.parametrize(("lumped", "pose"), [(True, 0.014), (False, 0.04)])
def test_drawn_delays_are_flown_however_long_they_are(lumped, pose):
    """Drawn about 14 ms, up to 21 ms, and about 40 ms, up to 60 ms."""
    ranges = (("pose_delay", Range((0.5,), True, False)), ("gyro_delay", Range((0.8,), True, False)))
    task = replace(TASK, randomisation=Randomisation("delays", ranges), lumped_delay=lumped)
    drone = weightless(late(pose, 0.004))

    @jax.jit
    @jax.vmap
    def seen(key):
        episode = reset(task, drone, key, COASTING)
        episode, _ = jax.lax.scan(lambda e, _: (step(task, e, jnp.zeros(4))[0], None), episode, length=10)
        p = episode.model.parameters
        return episode.state.position[0] - episode.estimate.position[0], p.pose_delay, p.gyro_delay

    age, drawn, gyro = seen(jax.random.split(jax.random.PRNGKey(0), 200))
    np.testing.assert_allclose(age, drawn, atol=1e-9)
    assert drawn.max() > 1.45 * pose
    assert gyro.min() < 0.0012
    assert gyro.max() > 0.0068
    assert abs(np.corrcoef(drawn, gyro)[0, 1]) < 0.3


def test_jitter_makes_every_reading_late_by_another_time():
    """Uniform up to 12 ms beyond the 8 ms of the model; the gyro on the drone does not share it."""
    task = replace(TASK, noise=replace(QUIET, pose_jitter_s=0.012), lumped_delay=False)
    drone = weightless(late(0.008))

    @jax.jit
    def ages(key):
        def one(episode, _):
            episode, _ = step(task, episode, jnp.zeros(4))
            return episode, episode.state.position[0] - episode.estimate.position[0]

        return jax.lax.scan(one, reset(task, drone, key, COASTING), length=400)[1]

    age = np.asarray(ages(jax.random.PRNGKey(0)))[10:]
    assert age.min() == pytest.approx(0.008, abs=5e-4)
    assert age.max() == pytest.approx(0.02, abs=5e-4)
    assert age.std() == pytest.approx(0.012 / np.sqrt(12), rel=0.1)
    assert abs(np.corrcoef(age[1:], age[:-1])[0, 1]) < 0.15
    with pytest.raises(CfbError, match=r"can be 0\.02 s"):
        reset(replace(task, longest_delay_s=0.01), drone, jax.random.PRNGKey(0))


def test_an_environment_flies_the_delay_of_its_model():
    in_world = replace(TASK, starts=Starts(near=0.0), layout=replace(TASK.layout, body_position=False))
    env = TargetVectorEnv(16, in_world, late(0.030))
    _, info = env.reset(seed=0)
    true = [info["position"]]
    for _ in range(8):
        seen, *_, info = env.step(np.zeros((16, 4)))
        true.append(info["position"])
    # 30 ms are three steps of control and three quarters.
    between = 0.25 * true[-4] + 0.75 * true[-5]
    moved = np.abs(true[-1] - true[-5]).max(axis=1)
    shown = seen[:, :3]
    assert np.linalg.norm(between, axis=1).max() < TASK.layout.position_limit_m
    # Shown as 0.1 m asinh(d / 0.1 m), in tenths of a metre.
    distance = np.linalg.norm(seen[:, :3], axis=1, keepdims=True)
    shown = 0.1 * np.sinh(distance) * seen[:, :3] / distance
    assert np.abs(shown - between).max() < 0.002
    assert moved.max() > 0.05


def test_the_gyro_is_as_late_as_the_pose_or_by_a_delay_of_its_own():
    start = eqx.tree_at(lambda s: s.body_rate, DRONE.hover_state(), jnp.array([3.0, -2.0, 1.0]))
    commands = jnp.asarray(np.random.default_rng(0).uniform(0.3, 0.8, (8, 4)))
    for lumped, gyro, ago in ((True, 0.016, 3), (False, 0.0, 0), (False, 0.016, 2)):
        task, drone = replace(TASK, lumped_delay=lumped), late(0.024, gyro)
        path = [reset(task, drone, jax.random.PRNGKey(0), start)]
        one = eqx.filter_jit(lambda e, u, t=task: step(t, e, u)[0])
        for u in commands:
            path.append(one(path[-1], u))
        np.testing.assert_allclose(path[-1].estimate.position, path[-4].state.position, atol=1e-9)
        np.testing.assert_allclose(path[-1].estimate.velocity, path[-4].state.velocity, atol=1e-9)
        np.testing.assert_allclose(path[-1].estimate.body_rate, path[-1 - ago].state.body_rate, atol=1e-9)


def test_a_delay_without_room_is_refused_by_name():
    tight, key = replace(TASK, longest_delay_s=0.016), jax.random.PRNGKey(0)
    with pytest.raises(CfbError, match=r"longest_delay_s = 0\.016 s, but pose_delay can be 0\.03 s"):
        reset(tight, late(0.030), key, COASTING)
    with pytest.raises(CfbError, match=r"pose_delay or gyro_delay can be 0\.02 s"):
        reset(replace(tight, lumped_delay=False), late(0.008, 0.020), key, COASTING)
    relative = Randomisation("gyro", (("gyro_delay", Range((0.5,), True, False)),))
    with pytest.raises(CfbError, match=r"ranges\.gyro_delay is relative, and gyro_delay is 0"):
        reset(replace(TASK, lumped_delay=False, randomisation=relative), DRONE, key, COASTING)

    def started(task):
        return jax.jit(lambda model: reset(task, model, key, COASTING).estimate.position)

    with pytest.raises(CfbError, match="traced model"):
        started(TASK)(late(0.030))
    assert started(with_room(TASK, late(0.030)))(late(0.030)).shape == (3,)
    # What nobody could know while compiling is at least no number.
    assert np.isnan(started(with_room(TASK, DRONE))(late(0.030))).all()


def test_the_firmwares_pid_flies_on_a_late_pose_as_long_as_its_gyro_is_its_own():
    drone = late(0.016)
    start = drone.hover_state((0.3, 0.0, 0.0))
    assert not has_lumped_delay("pid")
    assert has_lumped_delay("target")

    def swing(lumped):
        task = replace(TASK, lumped_delay=lumped)
        flown = jax.jit(lambda key: fly(find_controller("pid", drone), task, drone, key, 4.0, start))(
            jax.random.PRNGKey(0)
        )
        last = len(flown.command) * 3 // 4
        return float(jnp.abs(flown.body_rate[last:, :2]).max())

    # Two milliseconds of control: rates of 4 to 5 rad/s for ever where the gyro is as late.
    assert swing(False) < 0.05
    assert swing(True) > 2.0
