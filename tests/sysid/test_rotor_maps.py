"""Rotor maps against closed forms, and what they say about monotonicity, outliers and motors that differ."""

import numpy as np
import pytest

from cfb_mjx.errors import CfbError
from cfb_mjx.sysid.rotors.rotor_maps import fit_map, shape_of

PAPER_THRUST, PAPER_TORQUE = np.array([-0.23, 0.562, -0.043]), 1e-4 * np.array([-3.4, 8.7, 2.9])


def points(rng, noise, count=60, coefficients=PAPER_THRUST):
    speed = rng.uniform(300, 2800, count)
    s = speed / 2900
    return speed, s * np.polyval(coefficients, s) + noise * rng.normal(size=count)


def test_coefficients_and_covariance_are_the_closed_form():
    speed, value = points(np.random.default_rng(0), 0.002)
    found = fit_map(speed, value, tared=True)
    # y / s is a plain quadratic with weights s: NumPy's own fit of it.
    s = speed / 2900
    expected, covariance = np.polyfit(s, value / s, 2, w=s, cov=True)
    np.testing.assert_allclose(found.coefficients, expected, rtol=1e-9)
    np.testing.assert_allclose(found.covariance, covariance, rtol=1e-7)
    np.testing.assert_allclose(found.residual, value - s * np.polyval(expected, s), atol=1e-12)
    np.testing.assert_allclose(found.curve_std(np.array([0.0])), 0)
    assert found.noise[0] == pytest.approx(0.002, rel=0.2)


def test_given_noise_weighs_the_points():
    rng = np.random.default_rng(1)
    speed, value = points(rng, 0.0)
    std = np.where(speed > 1500, 0.02, 0.001)
    value = value + std * rng.normal(size=len(speed))
    s = speed / 2900
    expected, covariance = np.polyfit(s, value / s, 2, w=s / std, cov="unscaled")
    found = fit_map(speed, value, std=std, tared=True)
    np.testing.assert_allclose(found.coefficients, expected, rtol=1e-8)
    np.testing.assert_allclose(found.covariance, covariance, rtol=1e-7)


def test_robust_fit_ignores_outliers_and_names_them():
    rng = np.random.default_rng(2)
    speed, value = points(rng, 0.001)
    spoilt = [3, 17, 40, 41]
    value[spoilt] += [0.05, -0.04, 0.08, 0.06]
    at = np.linspace(300, 2800, 20)
    truth = at / 2900 * np.polyval(PAPER_THRUST, at / 2900)
    plain, robust = (np.abs(fit_map(speed, value, robust=r).curve(at) - truth).max() for r in (False, True))
    assert robust < 0.0015 < plain
    found = fit_map(speed, value, robust=True)
    assert set(spoilt) == set(found.outliers.tolist())
    assert np.all(found.weight[spoilt] < 0.1)


def test_intervals_of_both_estimators_cover():
    scores = {False: [], True: []}
    for seed in range(150):
        speed, value = points(np.random.default_rng(seed), 0.002, count=40)
        for robust in scores:
            found = fit_map(speed, value, robust=robust, tared=True)
            scores[robust].append((found.coefficients - PAPER_THRUST) / found.std)
    for values in scores.values():
        assert np.all(np.abs(np.std(values, axis=0) - 1) < 0.25)
        assert np.all(np.abs(np.mean(values, axis=0)) < 0.3)


def test_motors_that_differ_are_told_apart():
    rng = np.random.default_rng(3)
    speed, value = points(rng, 0.001, count=80, coefficients=PAPER_THRUST)
    motor = np.tile([1, 2, 3, 4], 20)
    scale = np.array([1.03, 0.98, 1.0, 0.99])
    same = fit_map(speed, value, motor, per_motor=True)
    differ = fit_map(speed, value * scale[motor - 1], motor, per_motor=True)
    assert same.scale_p_value > 0.01
    assert differ.scale_p_value < 1e-6
    assert differ.motors == (1, 2, 3, 4)
    assert differ.scale.mean() == pytest.approx(1)
    np.testing.assert_allclose(differ.scale, scale, atol=4 * differ.scale_std.max())
    assert np.all(differ.scale_std < 0.005)
    assert np.linalg.norm(differ.residual) == pytest.approx(np.linalg.norm(same.residual), rel=0.1)


def test_monotonicity_of_the_papers_curves():
    thrust, torque = shape_of(PAPER_THRUST, (400.0, 2700.0)), shape_of(PAPER_TORQUE, (400.0, 2700.0))
    (negative,) = thrust.negative
    assert negative == pytest.approx((0, 229), abs=1)
    (falling,) = thrust.falling
    assert falling == pytest.approx((0, 114), abs=1)
    assert thrust.increasing_where_measured
    assert all("artefact" in note for note in thrust.notes())
    assert torque.notes() == []


def test_a_curve_that_falls_where_it_was_measured_is_reported():
    found = shape_of(np.array([-0.4, 0.5, 0.0]), (300.0, 2800.0))  # largest at s = 0.83
    assert not found.increasing_where_measured
    assert found.notes() == ["does not increase from 2417 to 2900 rad/s (within the measured range)"]


def test_too_little_for_a_cubic_is_refused():
    with pytest.raises(CfbError, match=r"bench.*4 points"):
        fit_map(np.arange(1, 5) * 500.0, np.ones(4), name="bench")
    with pytest.raises(CfbError, match=r"2 different rotor speeds"):
        fit_map(np.tile([1000.0, 2000.0], 10), np.ones(20), name="bench")
    motor = np.array([1] * 11 + [2])
    with pytest.raises(CfbError, match=r"motor 2 has a single point"):
        fit_map(np.linspace(500, 2700, 12), np.ones(12), motor, per_motor=True, name="bench")


def test_a_scale_that_was_not_tared_is_seen_and_kept_out_of_the_curve():
    """15 mN at every point: without an offset the curve is many of its standard deviations off."""
    rng = np.random.default_rng(12)
    speed, value = points(rng, 0.002)
    found = fit_map(speed, value + 0.015)
    assert abs(found.offset - 0.015) < 3 * found.offset_std
    assert found.offset_std < 0.003
    assert np.all(np.abs(found.coefficients - PAPER_THRUST) < 3 * found.std)
    assert np.abs(found.residual).max() < 0.01
    tared = fit_map(speed, value)
    assert (tared.offset, tared.offset_std) == (0.0, 0.0)


def test_an_offset_too_small_to_be_told_is_in_the_error_bars():
    scores = []
    for seed in range(40):
        speed, value = points(np.random.default_rng(seed), 0.002)
        found = fit_map(speed, value + 0.003)
        scores.append((found.coefficients - PAPER_THRUST) / found.std)
    assert np.mean(np.abs(scores) < 1.96) > 0.88


def test_an_offset_is_common_to_motors_that_differ():
    rng = np.random.default_rng(13)
    speed, value = points(rng, 0.0005, count=120)
    motor = np.tile([1, 2, 3, 4], 30)
    factor = np.array([0.95, 1.0, 1.02, 1.03])
    found = fit_map(speed, value * factor[motor - 1] + 0.01, motor, per_motor=True)
    assert abs(found.offset - 0.01) < 3 * found.offset_std
    assert np.all(np.abs(found.scale - factor) < 3.5 * found.scale_std)
