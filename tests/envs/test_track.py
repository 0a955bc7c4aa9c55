"""Paths, the task of tracking them, and policies that command the firmware's loops."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import make_interp_spline

from cfb_mjx.control import NeuralController
from cfb_mjx.control.closed_loop import rollout_closed_loop
from cfb_mjx.control.controllers import find_controller
from cfb_mjx.control.policy_file import load_policy
from cfb_mjx.envs import (
    Layout,
    TargetTask,
    TrackTask,
    demand,
    figure_eight,
    observe,
    random_spline,
    read_path,
    reset,
    slowed,
    step,
    through,
)
from cfb_mjx.envs.task import QUIET
from cfb_mjx.envs.track import _path
from cfb_mjx.errors import CfbError
from cfb_mjx.firmware.actions import ACTIONS
from cfb_mjx.model import Quadrotor
from cfb_mjx.train.config import load_config
from cfb_mjx.train.flight import fly
from cfb_mjx.train.tracking import find_course, track

DRONE = Quadrotor.from_file("cfb-guards")
TASK = TrackTask()


def derivatives(path, time, h=1e-4):
    """Velocity and acceleration by central differences."""
    before, now, after = (np.asarray(path(jnp.asarray(time + x))) for x in (-h, 0.0, h))
    return (after - before) / (2 * h), (after - 2 * now + before) / h**2


def test_the_figure_eight_is_as_wide_and_fast_as_it_says():
    path = figure_eight(2.0, 2.0, ramp_s=2.0)
    assert np.abs(derivatives(path, 1e-3)[0]).max() < 1e-4
    lap = np.asarray(jax.vmap(path)(jnp.arange(5.0, 7.0, 0.001)))
    np.testing.assert_allclose([np.ptp(lap[:, 0]), np.ptp(lap[:, 1])], [2.0, 1.0], atol=1e-4)
    np.testing.assert_allclose(path(jnp.asarray(7.0)), path(jnp.asarray(5.0)), atol=1e-9)
    # In its middle, where it crosses itself: pi along x and along y for a lap of 2 s.
    speed = float(jnp.max(demand(path, jnp.arange(5.0, 7.0, 0.001)).speed_mps))
    assert speed == pytest.approx(np.sqrt(2) * np.pi, rel=1e-4)


def test_demands_are_those_of_a_circle():
    def circle(time):
        return jnp.stack([0.5 * jnp.cos(4.0 * time), 0.5 * jnp.sin(4.0 * time), 0.0 * time])

    found = demand(circle, jnp.asarray([0.3, 1.0]))
    pull = 0.5 * 4.0**2
    np.testing.assert_allclose(found.speed_mps, 2.0)
    np.testing.assert_allclose(found.thrust_to_weight, np.hypot(pull, 9.81) / 9.81)
    np.testing.assert_allclose(found.tilt_rad, np.arctan(pull / 9.81))
    # The thrust goes round the vertical at this tilt.
    np.testing.assert_allclose(found.rate_radps, 4.0 * np.sin(np.arctan(pull / 9.81)))


@given(st.integers(0, 1000), st.floats(0.0, 5.0))
@settings(max_examples=20, deadline=None)
def test_a_path_through_points_is_scipys_spline(seed, time):
    path = random_spline(seed, points=8, leg_s=0.8)
    points = np.asarray(jax.vmap(path)(0.8 * jnp.arange(8)))
    rest = [(order, np.zeros(3)) for order in (1, 2, 3)]
    spline = make_interp_spline(0.8 * np.arange(8), points, k=7, bc_type=(rest, rest))
    np.testing.assert_allclose(path(jnp.asarray(time)), spline(time), atol=1e-9)
    assert np.linalg.norm(points[0]) < 1e-12


def test_a_slowed_path_needs_less():
    fast, slow = random_spline(1), slowed(random_spline(1), 2.0)
    times = jnp.arange(0.0, 5.0, 0.05)
    np.testing.assert_allclose(demand(slow, 2 * times).speed_mps, demand(fast, times).speed_mps / 2, atol=1e-9)


def write(path, rows) -> str:
    names = ["duration", *(f"{axis}^{power}" for axis in ("x", "y", "z", "yaw") for power in range(8))]
    lines = [",".join(names)] + [",".join(f"{x:.9g}" for x in row) + "," for row in rows]
    path.write_text("\n".join(lines))
    return str(path)


def piece(duration, x=(), y=(), z=(), yaw=()):
    return [duration, *(c for axis in (x, y, z, yaw) for c in (*axis, *[0.0] * (8 - len(axis))))]


def test_trajectories_of_uav_trajectories_are_read(tmp_path):
    """Lines end with a comma, as that project writes them."""
    file = write(tmp_path / "there.csv", [piece(1.0, (0, 0, 1)), piece(2.0, (1, 2, -0.5), z=(0, 0.1))])
    path = read_path(file)
    np.testing.assert_allclose(path(jnp.asarray(0.5)), [0.25, 0, 0])
    np.testing.assert_allclose(path(jnp.asarray(2.0)), [2.5, 0, 0.1])
    np.testing.assert_allclose(path(jnp.asarray(9.0)), [3.0, 0, 0.2])


@pytest.mark.parametrize(
    ("rows", "said"),
    [
        ([piece(1.0, (0, 1)), piece(1.0, (2,))], "do not join"),
        ([piece(-1.0, (0, 1))], "positive duration"),
        ([piece(1.0, (0, 1), yaw=(0, 1))], "yaw"),
        ([piece(1.0, (0, 1))[:-3]], "33"),
        ([], "33"),
    ],
)
def test_trajectories_that_cannot_be_flown_are_refused(rows, said, tmp_path):
    with pytest.raises(CfbError, match=said):
        read_path(write(tmp_path / "bad.csv", rows))


def test_other_files_and_names_are_refused(tmp_path):
    (tmp_path / "log.csv").write_text("time,x,y\n0,1,2\n")
    with pytest.raises(CfbError, match="is not a trajectory"):
        read_path(tmp_path / "log.csv")
    with pytest.raises(CfbError, match="no such path"):
        find_course("circle")
    with pytest.raises(CfbError, match="timescale"):
        find_course("figure-eight", timescale=0.0)
    with pytest.raises(CfbError, match="times that increase"):
        through(np.zeros((2, 3)), np.zeros(2))


def test_drawn_paths_need_no_more_than_they_may():
    def largest(key):
        path = _path(TASK.draw_setpoint(key))
        found = demand(path, jnp.arange(0.0, 6.0, 0.02))
        return found.thrust_to_weight.max(), jnp.abs(jax.vmap(path)(jnp.arange(0.0, 6.0, 0.02))).max()

    thrust, size = jax.jit(jax.vmap(largest))(jax.random.split(jax.random.PRNGKey(0), 200))
    # The task looks at 24 times of a lap.
    assert thrust.max() < 1.05 * TASK.paths.thrust_to_weight
    assert np.median(thrust) < 1.9 < thrust.max()
    assert 1.0 < size.max() < 3 * TASK.paths.size_m


def test_an_episode_follows_its_path():
    episode = reset(TASK, DRONE, jax.random.PRNGKey(3), target=(1.0, 2.0, 3.0))
    path, begun = _path(episode.setpoint), float(episode.setpoint[0])
    for i in range(3):
        now = begun + 0.008 * i
        np.testing.assert_allclose(episode.target, path(jnp.asarray(now)) + jnp.array([1.0, 2, 3]), atol=1e-6)
        np.testing.assert_allclose(
            TASK.target_velocity(episode.setpoint), derivatives(path, now)[0], atol=1e-5, rtol=1e-5
        )
        shown = np.asarray(TASK.shown(episode.setpoint)).reshape(-1, 3)
        for ahead, row in zip(TASK.layout.preview_s, shown, strict=True):
            np.testing.assert_allclose(row, path(jnp.asarray(now + ahead)) - path(jnp.asarray(now)), atol=1e-6)
        episode, _ = step(TASK, episode, episode.model.hover_command())
    assert observe(TASK, episode).shape == (TASK.layout.size,)


def test_a_drone_begins_with_what_its_path_needs():
    still = replace(
        TASK, starts=replace(TASK.starts, distance_m=0.0, height_m=0.0, speed_mps=0.0, tilt_deg=0.0, yaw_deg=0.0)
    )
    episode = reset(still, DRONE, jax.random.PRNGKey(5))
    velocity, pull = derivatives(_path(episode.setpoint), float(episode.setpoint[0]))
    np.testing.assert_allclose(episode.state.velocity, velocity, atol=1e-5)
    _, x, y, z = q = np.asarray(episode.state.quaternion)
    w = q[0]
    up = np.array([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])
    force = pull + np.array([0, 0, 9.81])
    np.testing.assert_allclose(up, force / np.linalg.norm(force), atol=1e-5)


def test_a_reward_is_largest_on_the_path():
    at = reset(TASK, DRONE, jax.random.PRNGKey(5))
    on = replace(at.state, position=at.target, velocity=TASK.target_velocity(at.setpoint))
    best = TASK.judge(on, at.target, at.setpoint, at.motors, DRONE.parameters)
    late = replace(on, velocity=jnp.zeros(3))
    off = replace(on, position=at.target + 0.1)
    for worse in (late, off):
        assert TASK.judge(worse, at.target, at.setpoint, at.motors, DRONE.parameters) < best - 0.1


@pytest.mark.parametrize("action", [name for name in ACTIONS if name != "motors"])
def test_outputs_reach_what_they_ask_for(action):
    """The firmware's loops make of each output what its name and unit say, within two seconds."""
    layout = Layout(action=action)
    task = TargetTask(layout=layout, noise=QUIET, episode_s=10.0)
    outputs = ACTIONS[action].outputs
    wanted = {
        "body_rates": (0.5495, 0.0, 0.0, 1.0),
        "attitude": (0.5495, 0.1, -0.1, 0.3),
        "velocity": (0.3, -0.2, 0.1, 0.3),
        "position": (0.3, -0.2, 0.1, 0.3),
    }[action]
    u = jnp.asarray([(x - each.low) / (each.high - each.low) for x, each in zip(wanted, outputs, strict=True)])
    start = DRONE.hover_state((0.0, 0.0, 0.0))

    def one(episode, _):
        return step(task, episode, u)[0], None

    episode = jax.jit(lambda e: jax.lax.scan(one, e, length=500)[0])(reset(task, DRONE, jax.random.PRNGKey(0), start))
    w, x, y, z = np.asarray(episode.state.quaternion)
    roll, pitch = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)), np.arcsin(2 * (w * y - z * x))
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    if action == "body_rates":
        np.testing.assert_allclose(episode.state.body_rate, wanted[1:], atol=0.02)
    if action == "attitude":
        np.testing.assert_allclose([roll, pitch, yaw], wanted[1:], atol=0.02)
    if action == "velocity":
        np.testing.assert_allclose(episode.state.velocity, wanted[:3], atol=0.05)
        assert yaw == pytest.approx(0.3, abs=0.02)
    if action == "position":
        np.testing.assert_allclose(episode.state.position, wanted[:3], atol=0.02)
    assert episode.model.dt == 0.002
    assert episode.motors.shape == (4,)


def test_derivatives_go_through_the_firmwares_rate_loop():
    task = TargetTask(layout=Layout(action="body_rates"), noise=QUIET)
    begun = reset(task, DRONE, jax.random.PRNGKey(0), DRONE.hover_state((0.0, 0.0, 0.0)))

    @jax.jit
    def height(u):
        episode = begun
        for _ in range(3):
            episode, _ = step(task, episode, u)
        return episode.state.velocity[2] + episode.state.body_rate[0]

    u, h = jnp.asarray([0.56, 0.51, 0.5, 0.5]), 1e-6
    slopes = [(height(u.at[i].add(h)) - height(u.at[i].add(-h))) / (2 * h) for i in range(4)]
    np.testing.assert_allclose(jax.grad(height)(u), slopes, rtol=1e-5, atol=1e-7)
    assert np.abs(slopes[:2]).min() > 1e-3


@pytest.mark.parametrize(("name", "within_m"), [("track", 0.03), ("track-rates", 0.03)])
def test_shipped_policies_track_a_figure_eight_of_two_metres_in_two_seconds(name, within_m):
    measured, _ = track(find_controller(name, DRONE), TargetTask(), DRONE, jax.random.split(jax.random.PRNGKey(1), 4))
    assert not np.any(measured.failed)
    assert np.all(np.asarray(measured.mean_distance_m) < within_m)


def test_a_target_that_stands_still_is_held_too():
    controller = load_policy("track").controller
    flown = rollout_closed_loop(DRONE, controller, DRONE.hover_state((0.1, 0.0, 0.0)), 500, every=500)
    assert np.linalg.norm(flown.state.position[-1]) < 0.01


def test_policies_of_set_points_are_refused_where_motors_are_commanded():
    controller = NeuralController.random(jax.random.PRNGKey(0), Layout(action="body_rates"))
    with pytest.raises(CfbError, match="commands the motors, not body_rates"):
        rollout_closed_loop(DRONE, controller, DRONE.hover_state(), 10)


def test_a_path_can_be_a_function_of_ones_own():
    def line(time):
        return jnp.stack([0.2 * time, 0.0 * time, 0.0 * time])

    controller = find_controller("track", DRONE)
    flown = eqx.filter_jit(
        lambda key: fly(controller, TargetTask(), DRONE, key, 3.0, DRONE.hover_state((0.0, 0.0, 0.0)), path=line)
    )(jax.random.PRNGKey(0))
    assert np.linalg.norm(np.asarray(flown.position - flown.watched)[-100:], axis=1).max() < 0.02


@pytest.mark.parametrize(
    "change",
    ["paths.lap_s=[3.0]", "paths.lap_s=[4.0,2.0]", "paths.lap_s=[0.0,2.0]", "paths.size_m=0", "paths.eights=1.5",
     "paths.thrust_to_weight=1.0", "observation.preview_s=[]", "observation.action=torques"],
)  # fmt: skip
def test_paths_that_cannot_be_drawn_are_refused(change):
    with pytest.raises(CfbError, match=change.partition("=")[0]):
        load_config("track", (change,))
