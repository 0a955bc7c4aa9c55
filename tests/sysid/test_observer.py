"""The disturbance observer: causal, right where the disturbance is known, useful under one, harmless without."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from plant import Plant, fly

from cfb_mjx.errors import CfbError
from cfb_mjx.logs import FlightLog, read_log
from cfb_mjx.model import Quadrotor
from cfb_mjx.model.effects import BladeFlapping
from cfb_mjx.parameters import load_model_file
from cfb_mjx.sysid import evaluate
from cfb_mjx.sysid.nanodrone import (
    QUANTITIES,
    STRIDE,
    Contestant,
    benchmark,
    benchmark_score,
    levels_of,
    scaled,
    score,
    tune_observer,
)
from cfb_mjx.sysid.observer import Observer, fit_observer, observe

# They share fixtures and compiled programs.
pytestmark = pytest.mark.xdist_group("observer")

DELAY = 0.008
VALIDATION = Path(__file__).resolve().parents[3] / "shared" / "real" / "validation"
GUARDS = Quadrotor.from_file("cfb-guards")
LIKELY = Observer(
    gyro=0.02,
    accelerometer=0.3,
    rate_share=0.0,
    torque=(5.0, 5.0, 1.5),
    torque_time=0.3,
    trim=(2.0, 2.0, 1.0),
    trim_time=10.0,
    force_share=0.0,
    force=(0.5, 0.5, 0.5),
    force_time=0.8,
    rotor_offset=25.0,
    rotor_offset_time=0.3,
)
"""A model right but for what wanders."""
STEADY = dataclasses.replace(LIKELY, trim=(10.0, 10.0, 5.0), trim_time=30.0, force_time=30.0, rotor_offset_time=30.0)
"""For errors that stay: shorter times would shrink what is found."""
PLANT = dataclasses.replace(
    LIKELY,
    torque=(8.0, 8.0, 2.0),
    torque_time=0.08,
    trim=(0.1, 0.1, 0.1),
    force=(0.05, 0.05, 0.05),
    rotor=3.0,
    rotor_walk=1.0,
    rotor_offset=0.5,
)
"""What the plant is like: a torque with a corner at 2 Hz, and motors that do as the model says."""


def flight(seconds=4.0, seed=1, **options) -> FlightLog:
    return fly(Plant(), seconds, seed, **options)[0]


@pytest.fixture(scope="module")
def calm() -> FlightLog:
    return flight()


@pytest.fixture(scope="module")
def disturbed() -> FlightLog:
    return flight(disturbance=8.0)


def turned(**values) -> Quadrotor:
    return Quadrotor.from_file(load_model_file("cfb-guards").with_values("test", **values))


@pytest.mark.parametrize("measured", [True, False])
def test_nothing_after_a_row_changes_what_is_known_there(disturbed, measured):
    last = 600
    rng = np.random.default_rng(0)
    late = int(DELAY / 0.004) + 1  # pose rows up to here are read, late as they are

    def garbled(values, first):
        out = np.array(values)
        out[first:] = np.abs(rng.normal(size=out[first:].shape))
        return out

    quaternion = garbled(disturbed.quaternion, last + 1 + late)
    quaternion[last + 1 + late :] /= np.linalg.norm(quaternion[last + 1 + late :], axis=1, keepdims=True)
    spoilt = disturbed.replace(
        position=garbled(disturbed.position, last + 1 + late),
        velocity=garbled(disturbed.velocity, last + 1 + late),
        quaternion=quaternion,
        body_rate=garbled(disturbed.body_rate, last + 1),
        specific_force=garbled(disturbed.specific_force, last + 1),
        command=garbled(disturbed.command, last + 1),
        rotor_speed=garbled(disturbed.rotor_speed, last + 1),
    )
    model = Quadrotor(GUARDS.parameters, (BladeFlapping(-5e-4, 0.0),))  # so that velocity matters too
    before, after = (observe(model, log, DELAY, Observer(), measured) for log in (disturbed, spoilt))
    for name in vars(before):
        a, b = getattr(before, name), getattr(after, name)
        np.testing.assert_array_equal(a[: last + 1], b[: last + 1], err_msg=name)
        assert not np.array_equal(a[last + 1 :], b[last + 1 :]) or not np.any(a), name


def test_an_invalid_rotor_speed_is_filled_from_the_past(calm):
    speed = np.array(calm.rotor_speed)
    speed[500:502, 1] = np.nan
    later = speed.copy()
    later[502:] += 100.0
    a, b = (observe(GUARDS, calm.replace(rotor_speed=s), DELAY, Observer()) for s in (speed, later))
    np.testing.assert_array_equal(a.torque[:502], b.torque[:502])
    assert np.isfinite(a.torque).all()


def test_a_constant_torque_and_force_are_found():
    log, mass, beside = flight(6.0, noise=0.1), 0.044 * 1.05, 0.002
    thrust = 0.044 * np.mean(log.specific_force[500:, 2])
    # The model would pitch by weight times lever; the drone does not.
    found = observe(turned(center_of_gravity=[beside, 0.0, 0.0]), log, DELAY, STEADY)
    turning = np.mean((found.torque + found.trim)[500:], axis=0)
    expected = -thrust * beside / 3.6e-5
    np.testing.assert_allclose(turning, [0.0, expected, 0.0], atol=0.03 * abs(expected))
    # The model is 5 % too heavy.
    found = observe(turned(mass=mass), log, DELAY, STEADY)
    assert np.mean(found.force[500:, 2]) == pytest.approx(thrust / 0.044 - thrust / mass, rel=0.03)


def test_a_wrong_steady_rotor_speed_is_found(calm):
    found = observe(turned(motor_gain=2800.0), calm, DELAY, STEADY)
    wanted = 100.0 * np.mean(calm.command[300:], axis=0)
    np.testing.assert_allclose(np.mean(found.rotor_offset[300:], axis=0), wanted, rtol=0.05)
    assert np.mean(np.abs(found.rotor_speed[300:] - calm.rotor_speed[300:])) < 8.0  # 3 rad/s are noise


def errors(log, model=GUARDS, observer=None):
    return evaluate(model, [log], observer=observer)


KEYS = ("attitude_mean_deg@0.2s", "attitude_mean_deg@0.5s", "velocity_mean_mps@0.5s", "rate_mean_radps@0.5s")


def test_it_helps_a_model_that_misses_something(disturbed):
    # A wandering torque, and a centre of gravity that is not where the model believes it to be.
    found = errors(disturbed, turned(center_of_gravity=[0.001, -0.001, 0.0]), Observer())
    for variant in ("commands_in", "rotor_speed_in"):
        plain, helped = found.metrics(variant), found.metrics(f"{variant}_observer")
        for key in KEYS:
            assert helped[key] < 0.6 * plain[key], (variant, key)


def test_it_helps_under_a_wandering_torque_alone(disturbed):
    found = errors(disturbed, observer=PLANT)
    for variant in ("commands_in", "rotor_speed_in"):
        plain, helped = found.metrics(variant), found.metrics(f"{variant}_observer")
        assert helped["attitude_mean_deg@0.1s"] < 0.85 * plain["attitude_mean_deg@0.1s"], variant
        for key in KEYS:
            assert helped[key] < 1.02 * plain[key], (variant, key)


def test_it_does_no_harm_without_a_disturbance(calm):
    # With levels that fit: none. With the defaults, which expect real motors and torques: little beside hold.
    for observer, extra in ((dataclasses.replace(PLANT, torque=(0.1, 0.1, 0.1)), 0.01), (Observer(), 0.1)):
        found = errors(calm, observer=observer)
        for variant in ("commands_in", "rotor_speed_in"):
            plain, helped, hold = (found.metrics(v) for v in (variant, f"{variant}_observer", "hold"))
            for key in KEYS:
                assert helped[key] < plain[key] + extra * hold[key], (variant, key)


def test_without_rotor_speeds_and_behind_gaps(disturbed):
    keep = np.ones(len(disturbed), dtype=bool)
    keep[300:325] = False
    found = errors(disturbed.replace(rotor_speed=None).rows(keep), observer=Observer()).to_json()
    assert found["rotor_speed_in_observer"] is None
    assert np.isfinite(list(found["commands_in_observer"].values())).all()


def test_json_has_the_variants_only_when_asked_for(calm):
    assert "commands_in_observer" not in errors(calm).to_json()
    found = json.loads(json.dumps(errors(calm, observer=Observer()).to_json()))
    for block in (found, found["logs"]["plant0"], found["intervals"]):
        assert set(block["commands_in_observer"]) == set(block["commands_in"])
        assert set(block["rotor_speed_in_observer"]) == set(block["rotor_speed_in"])


def test_levels_are_fitted(disturbed):
    found = fit_observer(GUARDS, [disturbed])
    assert found.gyro == pytest.approx(0.02, rel=0.2)  # as the plant's sensors are
    # A corner at 2 Hz and 8 rad/s^2, a quarter of it about z.
    assert found.torque_time == pytest.approx(0.08, rel=0.4)
    assert found.torque[0] == pytest.approx(8.0, rel=0.3)
    assert found.torque[2] == pytest.approx(2.0, rel=0.5)


def test_tuning_finds_what_predicts_and_leaves_the_rest(disturbed):
    deaf = dataclasses.replace(PLANT, torque=(0.5, 0.5, 0.2))
    groups = {"disturbed": [disturbed]}
    steps = []
    levels = [("torque", None), ("accelerometer", None)]
    found = tune_observer(GUARDS, groups, deaf, levels=levels, factors=(4.0,), progress=steps.append)
    assert found.torque[0] >= 2.0
    assert found.torque[0] / deaf.torque[0] == pytest.approx(found.torque[2] / 0.2)
    assert dataclasses.replace(found, torque=deaf.torque, accelerometer=deaf.accelerometer) == deaf
    assert score(GUARDS, groups, found) < score(GUARDS, groups, deaf) - 0.01
    assert steps[0].startswith("torque x 4")


def test_tuning_may_be_judged_by_the_benchmark(disturbed):
    every = disturbed.rows(np.arange(0, len(disturbed), 2))
    hundred = every.replace(time=0.01 * np.arange(len(every)))
    groups, deaf = {"disturbed": [hundred]}, dataclasses.replace(PLANT, torque=(0.5, 0.5, 0.2))
    found = tune_observer(GUARDS, groups, deaf, levels=[("torque", None)], factors=(4.0,), judge=benchmark_score)
    rows = benchmark([hundred], {"tuned": Contestant(GUARDS, found), "deaf": Contestant(GUARDS, deaf)}, STRIDE)["rows"]
    sums = {n: [rows[n][f"{q}_sum_{u}"] for q, u in QUANTITIES.items()] for n in ("tuned", "deaf")}
    assert benchmark_score(GUARDS, groups, found) == pytest.approx(np.mean(np.log(sums["tuned"])))
    assert found.torque != deaf.torque
    assert np.prod(sums["tuned"]) < np.prod(sums["deaf"])


def test_one_axis_of_a_level_moves_alone():
    found = scaled(LIKELY, ("torque", 2), 2.0)
    assert found.torque == (5.0, 5.0, 3.0)
    assert ("torque", 2) in levels_of(LIKELY)
    assert ("gyro", None) in levels_of(LIKELY)


def test_tuning_without_flights_is_refused():
    with pytest.raises(CfbError, match="needs flights"):
        tune_observer(GUARDS, {})
    with pytest.raises(CfbError, match="needs flights"):
        tune_observer(GUARDS, {}, judge=benchmark_score)


@pytest.mark.skipif(not VALIDATION.is_dir(), reason="needs the real flights in ../shared/real")
def test_it_helps_on_a_real_flight():
    model = turned(mass=0.045, motor_gain=2000.0, motor_speed_offset=450.0)
    found = errors(read_log(VALIDATION / "square_20251017_run4.parquet"), model, Observer())
    for variant in ("commands_in", "rotor_speed_in"):
        plain, helped = found.metrics(variant), found.metrics(f"{variant}_observer")
        assert helped["attitude_mean_deg@0.2s"] < 0.9 * plain["attitude_mean_deg@0.2s"]
        assert helped["velocity_mean_mps@0.5s"] < plain["velocity_mean_mps@0.5s"]
