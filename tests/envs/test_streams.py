"""Everything that an episode draws has a random stream of its own."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from itertools import combinations

import equinox as eqx
import helpers
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats
from scipy.spatial.transform import Rotation

from cfb_mjx.envs import FlipStarts, FlipTask, Starts, TargetTask, reset, step
from cfb_mjx.envs.episode import Streams, mildness
from cfb_mjx.envs.task import QUIET
from cfb_mjx.model import Quadrotor
from cfb_mjx.model.rotors import hover_rotor_speed
from cfb_mjx.parameters import load_randomisation

pytestmark = pytest.mark.haste

COUNT = 20_000
# A body of nearly equal moments: none that is drawn breaks the triangle inequality, which is mended afterwards.
DRONE = eqx.tree_at(
    lambda m: m.parameters.inertia, Quadrotor.from_file("cfb-guards"), jnp.array([3.0e-5, 3.2e-5, 3.4e-5])
)
PAPER, NEAR = load_randomisation("paper"), 0.5
TASKS = {
    "TargetTask": TargetTask(randomisation=PAPER, graded=0.5, starts=Starts(near=NEAR)),
    "FlipTask": FlipTask(randomisation=PAPER, graded=0.5, starts=FlipStarts(entering=0.0)),
}
KEYS = jax.random.split(jax.random.PRNGKey(7), COUNT)


@pytest.mark.parametrize("task", TASKS.values(), ids=TASKS)
def test_no_key_of_an_episode_is_used_twice(task, monkeypatch):
    uses = helpers.watch_keys(monkeypatch)
    with jax.disable_jit():
        episode = reset(task, DRONE, jax.random.PRNGKey(3))
        for _ in range(2):
            episode, _ = step(task, episode, jnp.full(4, 0.5))
    assert uses.count > 15
    assert uses.of_no_key_twice()


def test_mild_drones_weigh_what_the_others_do():
    mass = _draws("TargetTask")["mass"]
    mild = _draws("TargetTask")["mildness"] < 1
    assert abs(np.mean(mild) - 0.5) < 5 * 0.5 / COUNT**0.5
    assert abs(np.mean(mild[mass > 0]) - np.mean(mild[mass < 0])) < 5 / COUNT**0.5
    flown = jax.jit(jax.vmap(lambda key: reset(TASKS["TargetTask"], DRONE, key).model.parameters.mass))(KEYS)
    # A uniform +-10 %, of which half is scaled by a uniform number: its standard deviation is 4.7 %.
    assert abs(np.mean(flown) / DRONE.parameters.mass - 1) < 5 * 0.047 / COUNT**0.5


@pytest.mark.parametrize("task", TASKS)
def test_all_that_is_drawn_is_distributed_as_stated(task):
    drawn = _draws(task)
    random = np.random.default_rng(1)
    scale = random.uniform(size=COUNT) * np.where(random.uniform(size=COUNT) < NEAR, 0.1, 1.0)
    share = random.uniform(size=COUNT)
    scaled = {"distance": scale * np.sqrt(share), "tilt": scale * share}
    for name, values in drawn.items():
        if name == "mildness":
            found = stats.kstest(values[values < 1], stats.uniform.cdf)
        elif name.startswith("noise"):
            found = stats.kstest(values, stats.norm.cdf)
        elif name.startswith("rotor"):
            continue
        elif task == "TargetTask" and name in ONE_SCALE:
            found = stats.ks_2samp(values, scaled.get(name, scale * (2 * share - 1)))
        else:
            found = stats.kstest(values, stats.uniform(-1, 2).cdf)
        assert found.pvalue > 1e-5, name
    assert len(drawn) > 50


@pytest.mark.parametrize("task", TASKS)
def test_all_that_is_drawn_is_pairwise_independent(task):
    assert dependent(_draws(task)) == []


def test_the_study_of_independence_sees_what_was_wrong():
    """Mild or not by the key of the mass, and a dependence that no correlation shows."""
    of_mass = jax.vmap(lambda key: jax.random.fold_in(Streams.of(key).drone, 0))(KEYS)
    mass = _draws("TargetTask")["mass"]
    assert dependent({"mildness": np.asarray(_mildness(of_mass)), "mass": mass}) == [("mildness", "mass")]
    assert dependent({"mass": mass, "off": np.abs(mass)}) == [("mass", "off")]


ONE_SCALE = ("distance", "height", "tilt", "yaw", *(f"{what} {i}" for what in ("velocity", "rate") for i in range(3)))
"""Of the target task's starts, all of one episode scaled by one difficulty, which is meant (`Starts`)."""
ONE_SPEED = tuple(f"rotor {i}" for i in range(4))
"""Rotors of one drone run at much the same speed."""


def dependent(drawn: dict[str, np.ndarray]) -> list[tuple[str, str]]:
    """Pairs that depend on each other, by ranks and by a table of 5 x 5 quantiles; a false one in ten thousand runs."""
    names, columns = [*drawn], [*drawn.values()]
    pairs = [*combinations(range(len(names)), 2)]
    level = 1e-4 / (2 * len(pairs))
    rho = np.corrcoef(np.stack([stats.rankdata(x) for x in columns]))
    limit = stats.norm.isf(level / 2) / COUNT**0.5
    # Mild or not: half of the values are one number, and so one bin.
    cuts = [np.unique(np.quantile(x, np.linspace(0, 1, 6)[1:-1])) for x in columns]
    bins = [np.eye(len(c) + 1)[np.searchsorted(c, x)] for c, x in zip(cuts, columns, strict=True)]
    found = []
    for i, j in pairs:
        pair = {names[i], names[j]}
        scaled = pair <= {*ONE_SCALE, *ONE_SPEED}
        if pair == {"distance", "tilt"} or pair <= {*ONE_SPEED}:
            continue
        # Of numbers of one scale and either sign the ranks are not correlated, only less evenly spread.
        if abs(rho[i, j]) > limit * (1.4 if scaled else 1.0):
            found.append((names[i], names[j]))
        elif not scaled:
            table = bins[i].T @ bins[j]
            table = table[table.any(axis=1)][:, table.any(axis=0)]
            if stats.chi2_contingency(table).pvalue < level:
                found.append((names[i], names[j]))
    return found


_mildness = jax.jit(jax.vmap(lambda key: mildness(TASKS["TargetTask"], key)))
HOVERING = DRONE.hover_state((0.0, 0.0, 0.0))


@cache
def _draws(name: str) -> dict[str, np.ndarray]:
    """Every quantity of `COUNT` episodes, scaled to what is stated of it: [-1, 1], or a standard deviation of one."""
    task = TASKS[name]

    @jax.jit
    @jax.vmap
    def begun(key):
        episode = reset(task, DRONE, key)
        calm = replace(task, randomisation=None)
        still = reset(calm, DRONE, key, HOVERING)
        # What one step adds to the same one without noise.
        kicked, quiet = (step(t, still, jnp.full(4, 0.5))[0].state for t in (calm, replace(calm, noise=QUIET)))
        kicks = kicked.velocity - quiet.velocity, kicked.body_rate - quiet.body_rate
        hover = hover_rotor_speed(episode.model.changed_parameters())
        return episode.model.parameters, episode.state, episode.setpoint, still.estimate, kicks, hover

    parameters, state, setpoint, seen, kicks, hover = jax.tree.map(np.asarray, begun(KEYS))
    factor = np.asarray(_mildness(jax.vmap(lambda key: Streams.of(key).mildness)(KEYS)))
    drawn, noise = {"mildness": factor}, task.noise
    for parameter, width in PAPER.ranges:
        mean, values = np.asarray(getattr(DRONE.parameters, parameter)), np.asarray(getattr(parameters, parameter))
        change = (values / mean - 1 if width.relative else values - mean) / width.half_width[0]
        columns = (change.reshape(COUNT, -1).T / factor)[: 1 if width.shared else None]
        drawn |= {f"{parameter} {i}".removesuffix(" 0"): x for i, x in enumerate(columns)}
    drawn |= _flip_start(task, state, setpoint) if isinstance(task, FlipTask) else _target_start(task.starts, state)
    drawn |= {name: x / x.max() - 1 for name, x in zip(ONE_SPEED, (state.rotor_speed / hover).T, strict=True)}
    turned = Rotation.from_quat(seen.quaternion[:, [1, 2, 3, 0]]).as_rotvec()
    parts = {
        "position": seen.position / noise.position_m,
        "velocity": seen.velocity / noise.velocity_mps,
        "attitude": turned / noise.attitude_rad,
        "rate": seen.body_rate / noise.rate_radps,
        # Two in a control step.
        "kicks of velocity": kicks[0] / (2**0.5 * noise.state_velocity_mps),
        "kicks of rate": kicks[1] / (2**0.5 * noise.state_rate_radps),
    }
    return drawn | {f"noise of {part} {i}": x[:, i] for part, x in parts.items() for i in range(3)}


def _columns(name: str, values: np.ndarray) -> dict[str, np.ndarray]:
    return {f"{name} {i}": x for i, x in enumerate(values.T)}


def _angle(y, x) -> np.ndarray:
    return np.arctan2(y, x) / np.pi


def _target_start(starts, state) -> dict[str, np.ndarray]:
    x, y, z = state.position.T
    w, qx, qy, qz = state.quaternion.T
    half_yaw = _angle(qz, w)
    return {
        "heading": _angle(y, x),
        "axis of tilt": (_angle(qy, qx) - half_yaw + 1) % 2 - 1,
        "distance": np.hypot(x, y) / starts.distance_m,
        "height": z / starts.height_m,
        "tilt": np.arctan2(np.hypot(qx, qy), np.hypot(w, qz)) * 2 / np.radians(starts.tilt_deg),
        "yaw": 2 * np.pi * half_yaw / np.radians(starts.yaw_deg),
        **_columns("velocity", state.velocity / starts.speed_mps),
        **_columns("rate", state.body_rate / starts.rate_radps),
    }


def _flip_start(task, state, setpoint) -> dict[str, np.ndarray]:
    """All in the middle of a turn."""
    starts = task.starts
    asked = [task.setpoints.speed_mps, task.setpoints.rate_radps]
    yaw, pitch, roll = Rotation.from_quat(state.quaternion[:, [1, 2, 3, 0]]).as_euler("ZYX").T
    vx, vy, vz = state.velocity.T
    return {
        **{f"asked {i}": (2 * x - sum(w)) / np.ptp(w) for i, (x, w) in enumerate(zip(setpoint.T, asked, strict=True))},
        "sideways 0": vx / starts.level_mps,
        "sideways 1": vy / (2 * starts.level_mps),
        "climb": (2 * vz - starts.climb_mps + starts.fall_mps) / (starts.climb_mps + starts.fall_mps),
        "roll": roll / np.pi,
        "pitch": pitch / starts.tilt_rad,
        "heading": yaw / starts.tilt_rad,
        "turning 1": state.body_rate[:, 1] / starts.rate_radps,
        "turning 2": state.body_rate[:, 2] / starts.rate_radps,
    }
