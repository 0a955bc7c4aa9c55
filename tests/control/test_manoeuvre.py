"""Flips as manoeuvres: when phases change, angles that do not jump, and knobs in files."""

import math
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cfb_mjx.control.manoeuvre import (
    CATCH,
    CLIMB,
    TURN,
    Knobs,
    Manoeuvre,
    ManoeuvreFile,
    load_manoeuvre,
    roll_angle,
    save_manoeuvre,
    shipped_manoeuvres,
    unwrapped,
)
from cfb_mjx.control.neural import NeuralController
from cfb_mjx.envs import Layout, StateEstimate
from cfb_mjx.envs.flip import FLIP_LAYOUT
from cfb_mjx.errors import CfbError

HOLDER = NeuralController.random(jax.random.PRNGKey(0), Layout(integral=True), (8,))
TURNER = NeuralController.random(jax.random.PRNGKey(1), FLIP_LAYOUT, (8,))
KNOBS = Knobs(climb_m=2.0, climb_s=0.08, turn_s=0.16, speed_mps=1.0, rate_radps=17.0)


def estimate(velocity=0.0, roll=0.0, position=0.0) -> StateEstimate:
    q = Rotation.from_rotvec([roll, 0, 0]).as_quat()[[3, 0, 1, 2]]
    return StateEstimate(jnp.full(3, position), jnp.array([0.0, 0.0, velocity]), jnp.asarray(q), jnp.zeros(3))


def phases(knobs: Knobs, estimates: list[StateEstimate]) -> list[int]:
    controller = Manoeuvre(HOLDER, TURNER, knobs)
    memory, found = controller.start(estimates[0], jnp.full(4, 0.55)), []
    advance = jax.jit(lambda memory, seen: controller.command(memory, seen))
    for one in estimates:
        memory, command = advance(memory, one)
        assert np.all((command >= 0) & (command <= 1))
        found.append(int(memory.phase))
    return found


def test_phases_end_with_their_times():
    # 0.08 s are ten commands of 8 ms, 0.16 s twenty.
    assert phases(KNOBS, [estimate()] * 40) == [CLIMB] * 10 + [TURN] * 20 + [CATCH] * 10


def test_the_climb_ends_with_its_speed():
    seen = [estimate(0.3 * i) for i in range(12)]
    found = phases(KNOBS._replace(climb_mps=1.0), seen)
    assert found.index(TURN) == 4


def test_the_turn_ends_with_its_angle_over_more_than_one_turn():
    # A quarter of a radian per command; the turn begins at the command of index 10.
    seen = [estimate(roll=0.25 * max(0, i - 10)) for i in range(60)]
    found = phases(KNOBS._replace(turn_s=9.0, turn_rad=9.9), seen)
    assert found.index(TURN) == 10
    assert found.index(CATCH) == 10 + 40


def test_each_phase_flies_the_policy_it_should():
    controller = Manoeuvre(HOLDER, TURNER, KNOBS)
    seen = estimate(0.2, 0.1, 0.3)
    memory = controller.start(seen, jnp.full(4, 0.55))
    _, climbing = controller.command(memory, seen)
    raised = replace_position(seen, seen.position - jnp.array([0.0, 0.0, 2.0]))
    np.testing.assert_allclose(climbing, HOLDER.command(HOLDER.start(raised, 0.55), raised)[1], rtol=1e-6)
    _, turning = controller.command(memory._replace(phase=jnp.asarray(TURN)), seen)
    asked = jnp.array([KNOBS.speed_mps, KNOBS.rate_radps])
    np.testing.assert_allclose(turning, TURNER.command(TURNER.start(seen, 0.55), seen, asked)[1], rtol=1e-6)
    _, catching = controller.command(memory._replace(phase=jnp.asarray(CATCH)), seen)
    np.testing.assert_allclose(catching, HOLDER.command(HOLDER.start(seen, 0.55), seen)[1], rtol=1e-6)


def replace_position(seen: StateEstimate, position) -> StateEstimate:
    return StateEstimate(position, seen.velocity, seen.quaternion, seen.body_rate)


def test_the_integral_of_the_catch_begins_with_the_catch():
    controller = Manoeuvre(HOLDER, TURNER, KNOBS)
    seen = estimate(position=0.2)
    memory = controller.start(seen, jnp.full(4, 0.55))
    for i in range(32):
        memory, _ = controller.command(memory, seen)
        assert bool(jnp.any(memory.catch.integral != 0)) == (i >= 30)


def test_roll_angle_and_turns_are_scipys():
    angle = np.linspace(-0.4, 14.0, 300)
    q = Rotation.from_rotvec(np.outer(angle, [1, 0, 0])).as_quat()[:, [3, 0, 1, 2]]
    np.testing.assert_allclose(unwrapped(roll_angle(jnp.asarray(q))), angle, atol=1e-5)
    both_signs = q * np.where(np.arange(300) % 2, 1, -1)[:, None]
    np.testing.assert_allclose(unwrapped(roll_angle(jnp.asarray(both_signs))), angle, atol=1e-5)


def test_policies_that_do_not_belong_are_refused():
    with pytest.raises(CfbError, match="flip policy with set-points"):
        Manoeuvre(HOLDER, HOLDER, KNOBS)
    slow = NeuralController.random(jax.random.PRNGKey(1), replace(FLIP_LAYOUT, control_dt_s=0.016), (8,))
    with pytest.raises(CfbError, match=r"0\.016"):
        Manoeuvre(HOLDER, slow, KNOBS)


@pytest.mark.parametrize("name", shipped_manoeuvres())
def test_shipped_manoeuvres_load(name):
    found = load_manoeuvre(name)
    assert found.rotations in (1, 2, 3)
    assert found.description


def test_knobs_survive_a_file(tmp_path):
    save_manoeuvre(ManoeuvreFile(2, KNOBS, "by hand", "target-adaptive"), tmp_path / "m.yaml")
    again = load_manoeuvre(tmp_path / "m.yaml")
    assert again == ManoeuvreFile(2, KNOBS, "by hand", "target-adaptive")
    assert again.knobs.turn_rad == math.inf
    changed = load_manoeuvre(tmp_path / "m.yaml", ("climb_s=0.5", "climb_mps=3"))
    assert changed.knobs == KNOBS._replace(climb_s=0.5, climb_mps=3.0)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("rotations: 2", "knobs must be a mapping"),
        ("rotations: two\nknobs: {}", "rotations must be a whole number"),
        ("rotations: 2\nholder: 3\nknobs: {}", "holder must be a policy's name or file"),
        ("rotations: 2\nknobs: {climb_m: 1}", "knobs.climb_s is missing"),
        ("rotations: 2\nknobs: {climb_x: 1}", "unknown key 'knobs.climb_x'"),
        ("rotations: 2\nknobs: {climb_m: far, climb_s: 1, turn_s: 1, speed_mps: 0, rate_radps: 9}", "must be a number"),
        ("rotations: 2\nknobs: {climb_m: 1, climb_s: -1, turn_s: 1, speed_mps: 0, rate_radps: 9}", "negative"),
        ("rotations: 2\nknobs: {climb_m: .inf, climb_s: 1, turn_s: 1, speed_mps: 0, rate_radps: 9}", "finite"),
    ],
)
def test_bad_knobs_are_named(text, said, tmp_path):
    (tmp_path / "m.yaml").write_text(f"format: cfb_mjx manoeuvre 1\n{text}\n")
    with pytest.raises(CfbError, match=r"m\.yaml") as caught:
        load_manoeuvre(tmp_path / "m.yaml")
    assert said in str(caught.value)


@pytest.mark.parametrize("change", ["climb_s", "speed=3", "climb_s=fast"])
def test_bad_changes_are_refused(change):
    with pytest.raises(CfbError, match="climb_s"):
        load_manoeuvre("double-flip", (change,))
