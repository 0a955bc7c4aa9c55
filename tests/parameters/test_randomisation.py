"""Randomisation: the paper's ranges, draws inside them and up to their edges, physical inertias, stable streams."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cfb_mjx.errors import CfbError
from cfb_mjx.parameters import SPECIFICATIONS, load_model_file, load_randomisation, sample_parameters

COUNT = 4000
# The ranges: half-width, relative to the nominal value or absolute, one draw for all motors or one each.
PAPER = {
    "mass": (0.10, True, False),
    "inertia": (0.20, True, False),
    "motor_time_constant": (0.20, True, True),
    "motor_gain": (0.20, True, True),
    "thrust_scale": (0.20, True, False),
    "torque_scale": (0.20, True, False),
    "center_of_gravity": (0.01, False, False),
    "attitude_offset": (np.radians(15), False, False),
}


@pytest.fixture(scope="module")
def nominal():
    return load_model_file("cfb").parameters()


@pytest.fixture(scope="module")
def draws(nominal):
    keys = jax.random.split(jax.random.key(0), COUNT)
    return jax.jit(jax.vmap(lambda key: sample_parameters(key, nominal, load_randomisation("paper"))))(keys)


def test_the_papers_ranges():
    ranges = dict(load_randomisation("paper").ranges)
    assert set(ranges) == set(PAPER)
    for name, (width, relative, shared) in PAPER.items():
        np.testing.assert_allclose(ranges[name].half_width, width, rtol=1e-12)
        assert (ranges[name].relative, ranges[name].shared) == (relative, shared), name
    assert load_randomisation() == load_randomisation("paper")


@pytest.mark.parametrize("name", sorted(SPECIFICATIONS))
def test_bounds_are_respected_and_reached(name, draws, nominal):
    values, center = np.asarray(getattr(draws, name)), np.asarray(getattr(nominal, name))
    if name not in PAPER:
        assert np.all(values == center)
        return
    width, relative, shared = PAPER[name]
    change = values / center - 1 if relative else values - center
    assert np.abs(change).max() <= width * (1 + 1e-9)
    if name == "inertia":  # its largest moment is limited by the triangle inequality
        assert np.all(change[:, :2].max(axis=0) > 0.97 * width)
        assert np.all(change.min(axis=0) < -0.97 * width)
    else:
        assert np.all(change.max(axis=0) > 0.97 * width)
        assert np.all(change.min(axis=0) < -0.97 * width)
        assert np.all(np.abs(change.mean(axis=0)) < 0.05 * width)
    if values.ndim == 2:
        spread = np.ptp(change, axis=1)
        assert np.all(spread < 1e-12) if shared else np.median(spread) > 0.2 * width


def test_drawn_inertia_is_always_physical(draws):
    inertia = np.asarray(draws.inertia)
    assert np.all(inertia > 0)
    assert np.all(2 * inertia.max(axis=1) <= inertia.sum(axis=1) * (1 + 1e-12))
    # Without the correction some draws of this drone would break the inequality: the correction acts.
    assert np.any(2 * inertia.max(axis=1) >= inertia.sum(axis=1) * (1 - 1e-12))


def test_ranges_are_independent(draws):
    columns = [np.asarray(draws.mass)[:, None], np.asarray(draws.motor_gain)[:, :1], draws.motor_time_constant[:, :1]]
    columns += [draws.thrust_scale, draws.torque_scale, draws.center_of_gravity, draws.attitude_offset]
    columns += [draws.inertia[:, :2]]
    correlation = np.corrcoef(np.concatenate(columns, axis=1).T)
    assert np.abs(correlation - np.eye(len(correlation))).max() < 0.08  # 5 sigma for 4000 draws


def test_adding_a_range_leaves_the_other_draws_alone(nominal):
    paper = load_randomisation("paper")
    fewer = type(paper)("fewer", tuple(item for item in paper.ranges if item[0] in ("mass", "attitude_offset")))
    key = jax.random.key(5)
    for name in ("mass", "attitude_offset"):
        np.testing.assert_array_equal(
            getattr(sample_parameters(key, nominal, fewer), name), getattr(sample_parameters(key, nominal, paper), name)
        )


def test_same_key_same_drone(nominal):
    sample = jax.jit(sample_parameters)
    a, b, c = (sample(jax.random.key(k), nominal) for k in (1, 1, 2))
    assert eqx.tree_equal(a, b)
    assert not np.any(a.mass == c.mass)


def test_magnitude_scales_the_ranges(nominal):
    key = jax.random.key(3)
    sample = jax.jit(lambda magnitude: sample_parameters(key, nominal, None, magnitude))
    assert eqx.tree_equal(sample(0.0), nominal)
    full, half = sample(1.0), sample(0.5)
    np.testing.assert_allclose(half.mass - nominal.mass, (full.mass - nominal.mass) / 2, rtol=1e-9)
    np.testing.assert_allclose(half.attitude_offset, full.attitude_offset / 2, rtol=1e-9)


def test_identification_ranges(nominal):
    ranges = dict(load_randomisation("identification").ranges)
    assert ranges["center_of_gravity"].half_width == (0.002,)
    assert all(r.half_width == (0.02,) for name, r in ranges.items() if name != "center_of_gravity")
    keys = jax.random.split(jax.random.key(0), 200)
    drawn = jax.vmap(lambda key: sample_parameters(key, nominal, load_randomisation("identification")))(keys)
    assert np.abs(drawn.mass / nominal.mass - 1).max() <= 0.02 * (1 + 1e-9)
    assert jnp.all(drawn.attitude_offset == 0)


def test_the_other_reading_of_motor_dynamics_leaves_the_gain_alone(nominal):
    """With it, what a command of hover lifts varies by what the paper gives thrust."""
    both, lag = (dict(load_randomisation(name).ranges) for name in ("paper", "paper-lag"))
    assert set(both) - set(lag) == {"motor_gain"}
    assert all(lag[name] == both[name] for name in lag)
    drawn = sample_parameters(jax.random.key(1), nominal, load_randomisation("paper-lag"))
    assert jnp.all(drawn.motor_gain == nominal.motor_gain)
    assert not jnp.any(drawn.motor_time_constant == nominal.motor_time_constant)


def test_latencies_are_the_paper_s_ranges_and_one_more(nominal):
    plain, late = (dict(load_randomisation(name).ranges) for name in ("paper", "paper-latency"))
    assert set(late) - set(plain) == {"pose_delay"}
    assert all(late[name] == plain[name] for name in plain)
    keys = jax.random.split(jax.random.key(0), 500)
    drawn = jax.vmap(lambda key: sample_parameters(key, nominal, load_randomisation("paper-latency")))(keys)
    assert jnp.all(drawn.pose_delay > 0)
    assert drawn.pose_delay.min() < 0.1 * nominal.pose_delay
    assert drawn.pose_delay.max() > 1.9 * nominal.pose_delay


def _ranges(text):
    return f"format: cfb_mjx randomisation 1\nranges:\n  {text}\n"


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("", "mapping"),
        ("format: other\n", "format"),
        ("format: cfb_mjx randomisation 1\nspread: {}\n", "spread"),
        ("format: cfb_mjx randomisation 1\nranges: [mass]\n", "ranges"),
        (_ranges("weight: {half_width: 0.1, unit: relative}"), "ranges.weight"),
        (_ranges("mass: 0.1"), "ranges.mass"),
        (_ranges("mass: {half_width: 0.1, unit: relative, shape: normal}"), "ranges.mass.shape"),
        (_ranges("mass: {half_width: 0.1}"), "ranges.mass.unit"),
        (_ranges("mass: {half_width: 0.1, unit: g}"), "ranges.mass.unit"),
        (_ranges("mass: {unit: relative}"), "ranges.mass.half_width"),
        (_ranges("mass: {half_width: -0.1, unit: relative}"), "ranges.mass.half_width"),
        (_ranges("mass: {half_width: 1.0, unit: relative}"), "ranges.mass.half_width"),
        (_ranges("mass: {half_width: .nan, unit: relative}"), "ranges.mass.half_width"),
        (_ranges("mass: {half_width: .inf, unit: kg}"), "ranges.mass.half_width"),
        (_ranges("mass: {half_width: much, unit: kg}"), "ranges.mass.half_width"),
        (_ranges("mass: {half_width: true, unit: kg}"), "ranges.mass.half_width"),
        (_ranges("mass: {half_width: [], unit: kg}"), "ranges.mass.half_width"),
        (_ranges("inertia: {half_width: [0.1, 0.1], unit: relative}"), "ranges.inertia.half_width"),
        (_ranges("mass: {half_width: 0.1, unit: relative, shared: perhaps}"), "ranges.mass.shared"),
        (_ranges("mass: {half_width: 0.1, unit: relative}\n  mass: {half_width: 0.2, unit: relative}"), "mass"),
    ],
)
def test_unusable_files_are_refused_with_file_and_key(text, named, tmp_path):
    path = tmp_path / "spread.yaml"
    path.write_text(text)
    with pytest.raises(CfbError, match=r"spread\.yaml") as caught:
        load_randomisation(path)
    assert named in str(caught.value)


def test_a_range_may_have_its_former_name(tmp_path):
    path = tmp_path / "spread.yaml"
    path.write_text(_ranges("observation_delay: {half_width: 0.5, unit: relative}"))
    assert [name for name, _ in load_randomisation(path).ranges] == ["pose_delay"]
    both = "observation_delay: {half_width: 0.5, unit: relative}\n  pose_delay: {half_width: 0.5, unit: relative}"
    path.write_text(_ranges(both))
    with pytest.raises(CfbError, match=r"spread\.yaml: ranges\.observation_delay and ranges\.pose_delay"):
        load_randomisation(path)


def test_an_unknown_name_is_told_apart_from_a_broken_installation():
    with pytest.raises(CfbError, match="papre") as caught:
        load_randomisation("papre")
    assert "paper" in str(caught.value)
    assert "reinstall" not in str(caught.value)


def test_a_missing_file_is_refused_by_name(tmp_path):
    with pytest.raises(CfbError, match=r"none\.yaml"):
        load_randomisation(tmp_path / "none.yaml")


def test_absolute_ranges_that_allow_impossible_drones_never_yield_one(nominal, tmp_path):
    """A mass of 40 g +- 100 g: refused, or limited, but no negative mass may come out."""
    path = tmp_path / "spread.yaml"
    path.write_text(_ranges("mass: {half_width: 0.1, unit: kg}"))
    keys = jax.random.split(jax.random.key(0), 200)
    try:
        spread = load_randomisation(path)
        masses = jax.vmap(lambda key: sample_parameters(key, nominal, spread).mass)(keys)
    except CfbError:
        return
    assert np.all(np.asarray(masses) > 0)
