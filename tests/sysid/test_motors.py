"""Motors on their own: constants come back from flights and bench steps; what cannot be told gets no number."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from motor_bench import record, steps
from plant import Plant, fly

from cfb_mjx.errors import CfbError
from cfb_mjx.logs import read_log
from cfb_mjx.logs.bench_tables import record_of
from cfb_mjx.parameters import load_model_file
from cfb_mjx.sysid.rotors.motor_filter import ROWS, first_guess, gather, maximise
from cfb_mjx.sysid.rotors.motors import chi_square_tail, common_lag, fit_motors, replay
from cfb_mjx.sysid.rotors.supply import fit_with_sag

# They share fixtures and compiled programs.
pytestmark = pytest.mark.xdist_group("motors")

NOMINAL = load_model_file("cfb-guards").parameters()
REAL = Path(__file__).resolve().parents[3] / "shared" / "real" / "fit"
LAGS = ("spin_up_time_constant", "spin_down_time_constant", "dead_time")


@pytest.fixture(scope="module")
def flights():
    """Two drones under feedback, pushed by a wandering torque nobody models."""
    plant = Plant(
        mass=np.full(2, 0.044),
        inertia=np.tile([3.3e-5, 3.6e-5, 5.9e-5], (2, 1)),
        rotor_inertia=np.full(2, 5e-8),
        lag=np.array([0.042, 0.058]),
        gain=np.array([2700.0, 3100.0]),
    )
    return plant, fly(plant, 12.0, seed=5, disturbance=4.0)


def test_gain_and_time_constant_come_back_from_flights_under_feedback(flights):
    plant, logs = flights
    found = fit_motors([record_of(logs[0])], NOMINAL).common
    assert found.extras == frozenset()  # the plant has neither
    for name, truth in (("motor_time_constant", plant.lag[0]), ("motor_gain", plant.gain[0])):
        assert found.estimates[name].value == pytest.approx(truth, rel=0.02)
        assert abs(found.estimates[name].value - truth) < 4 * found.estimates[name].std
    assert abs(found.optimum.whiteness) < 0.05


def test_bad_packets_and_gaps_cost_rows_but_no_accuracy(flights):
    plant, logs = flights
    rng = np.random.default_rng(0)
    speed = np.where(rng.uniform(size=logs[1].rotor_speed.shape) < 0.05, np.nan, logs[1].rotor_speed)
    log = logs[1].replace(rotor_speed=speed).rows((logs[1].time < 5) | (logs[1].time > 5.2))
    whole, holed = gather([record_of(logs[1])]), gather([record_of(log)])
    assert 0.9 < holed.rows / whole.rows < 0.97
    # No piece reaches over the gap.
    assert np.diff(holed.tracks.time[: len(holed.motor)], axis=1).max() < 0.0045
    names = ("motor_time_constant", "motor_gain")
    found = maximise(holed, names, first_guess(holed, 0.05, 2900.0, 0.0))
    for name, truth in (("motor_time_constant", plant.lag[1]), ("motor_gain", plant.gain[1])):
        assert found.value(name) == pytest.approx(truth, rel=0.02)


@pytest.fixture(scope="module")
def asymmetric():
    """Four motors on a bench: up 40 ms, down 70 ms, dead 6 ms, affine, with drift and noise; M2 is weaker."""
    rng = np.random.default_rng(1)
    made = record(steps(rng, 8.0), rng, 0.04, 0.07, 0.006, 2000.0, 500.0, wander=15.0, motors=(1, 2))
    weaker = made.rotor_speed * [1.0, 0.97]
    return replace(made, rotor_speed=weaker)


def test_spin_up_spin_down_and_dead_time_come_back_from_bench_steps(asymmetric):
    found = fit_motors([asymmetric], NOMINAL, offset=True, asymmetric=True, dead_time=True, per_motor=True)
    for group in (found.common, *found.motors.values()):
        for name, truth in zip(LAGS, (0.04, 0.07, 0.006), strict=True):
            assert group.estimates[name].value == pytest.approx(truth, rel=0.1)
            assert group.estimates[name].std < 0.05 * truth
    for number, factor in ((1, 1.0), (2, 0.97)):
        assert found.motors[number].estimates["motor_gain"].value == pytest.approx(2000 * factor, rel=0.02)
        assert found.motors[number].estimates["motor_speed_offset"].value == pytest.approx(500 * factor, abs=30)
    assert all(t.supported for t in found.common.tests)
    # The one constant a plain model can have lies between, and includes the dead time.
    value, std = found.values("motor_time_constant")
    assert value.shape == std.shape == (4,)
    assert np.all((value > 0.05) & (value < 0.07))
    assert all(r.rms < 40 for r in replay(found))


def test_extras_that_are_there_are_allowed_for_without_being_asked():
    """A plain model would explain the dead time by its noise and answer 80 ms."""
    rng = np.random.default_rng(2)
    found = fit_motors([record(steps(rng, 8.0), rng, 0.04, 0.07, 0.006, wander=15.0)], NOMINAL).common
    assert found.extras == {"asymmetric", "dead_time"}
    assert found.estimates["motor_gain"].value == pytest.approx(2900, rel=0.01)
    assert found.estimates["motor_time_constant"].value == pytest.approx(0.06, rel=0.05)
    assert not {t.name: t for t in found.tests}["offset"].supported


def test_intervals_are_as_wide_as_the_errors():
    names = ("motor_gain", *LAGS)
    truth = {"motor_gain": 2900.0, **dict(zip(LAGS, (0.04, 0.06, 0.005), strict=True))}
    scores = []
    # From the truth on: where the search starts is not what is tested here.
    start = np.array([np.log(2900), 0.0, *np.log([0.04, 0.06]), 0.5, *np.log([5, 3, 15])])
    for seed in range(14):
        rng = np.random.default_rng(100 + seed)
        data = gather([record(steps(rng, 4.0), rng, 0.04, 0.06, 0.005, wander=15.0)])
        found = maximise(data, names, start)
        scores.append([(found.value(n) - truth[n]) / found.std(n) for n in names])
    scores = np.array(scores)
    assert np.abs(scores).max() < 4.5
    assert np.all(np.abs(scores.mean(axis=0)) < 1.0)
    assert np.all((scores.std(axis=0) > 0.4) & (scores.std(axis=0) < 1.6))


def test_constant_commands_tell_no_lag_and_gain_and_offset_only_together():
    rng = np.random.default_rng(3)
    made = record(np.full(2000, 0.55), rng, wander=20.0)
    found = fit_motors([made], NOMINAL, offset=True, asymmetric=True, dead_time=True).common
    assert found.estimates == {}
    assert set(found.unidentifiable) == {*LAGS, "motor_gain", "motor_speed_offset"}
    # 2900 * 0.55 = 1595, and 20 rad/s of drift.
    assert re.search("only together: (15[89]|160)", found.unidentifiable["motor_gain"])
    assert not any(t.supported for t in found.tests)


def test_steps_in_one_direction_tell_that_time_constant_only():
    rng = np.random.default_rng(4)
    rising = np.repeat(np.linspace(0.2, 0.9, 12), 150)
    data = gather([record(rising, rng, 0.04, 0.07, wander=10.0)])
    found = maximise(data, (*LAGS[:2], "motor_gain"), first_guess(data, 0.05, 2900.0, 0.0))
    assert found.uncertainty.names == ["spin_down_time_constant"]
    assert found.value("spin_up_time_constant") == pytest.approx(0.04, rel=0.1)
    # The nearest single constant is that of the direction that was seen.
    assert common_lag(found, data)[0] == pytest.approx(found.value("spin_up_time_constant"), rel=1e-3)


def test_refusals():
    rng = np.random.default_rng(5)
    made = record(steps(rng, 2.0), rng)
    with pytest.raises(CfbError, match=r"bench.*which motor"):
        fit_motors([made], NOMINAL, per_motor=True)
    short = replace(made, time=made.time[:30], command=made.command[:30], rotor_speed=made.rotor_speed[:30])
    with pytest.raises(CfbError, match=r"bench.*too few"):
        fit_motors([short], NOMINAL)


def test_long_recordings_are_cut_and_every_row_is_judged_once():
    rng = np.random.default_rng(6)
    data = gather([record(steps(rng, 8.0), rng)])
    assert data.tracks.time.shape == (32, ROWS)
    assert data.rows == 2000 - 50  # all but the first warm-up of 0.2 s


def test_chi_square_tail():
    # 95 % points from tables.
    assert chi_square_tail(3.841, 1) == pytest.approx(0.05, rel=1e-3)
    assert chi_square_tail(7.815, 3) == pytest.approx(0.05, rel=1e-3)


@pytest.mark.skipif(not REAL.is_dir(), reason="needs the real flights in ../shared/real")
def test_a_real_flight_spins_up_faster_than_down_and_is_affine():
    log = read_log(REAL / "square_20251017_run3.parquet")
    found = fit_motors([record_of(log)], NOMINAL, offset=True, asymmetric=True, dead_time=True).common
    up, down, dead = (found.estimates[name].value for name in LAGS)
    assert 0.02 < up < 0.035 < down < 0.06
    assert abs(dead) < 0.003
    assert found.estimates["motor_speed_offset"].value > 300
    assert {t.name for t in found.tests if t.supported} == {"asymmetric", "dead_time", "offset"}


def test_how_far_motors_follow_the_battery_comes_back_with_their_constants():
    """Three flights on a battery that empties: a slope of 0.6, and gains as they are at 3.7 V."""
    slope, records = 0.6, []
    for number in range(3):
        rng = np.random.default_rng(40 + number)
        command = steps(rng, 8.0)
        voltage = 4.0 - 0.2 * number - 0.2 * np.linspace(0, 1, len(command))
        driven = command * (1 + slope * (voltage - 3.7) / 3.7)
        made = record(driven, rng, 0.045, 0.045, wander=10.0, motors=(1, 2, 3, 4))
        commands = np.tile(command[:, None], 4)
        records.append(replace(made, name=f"flight {number}", command=commands, battery_voltage=voltage))
    found, sag = fit_with_sag(records, NOMINAL)
    assert sag.slope == pytest.approx(slope, abs=0.06)
    assert abs(sag.slope - slope) < 4 * sag.std
    np.testing.assert_allclose(found.values("motor_gain")[0], 2900.0, rtol=0.01)
    np.testing.assert_allclose(found.values("motor_time_constant")[0], 0.045, rtol=0.05)
    # Without a voltage nobody can tell, and the motors are fitted all the same.
    plain, none = fit_with_sag([replace(r, battery_voltage=None) for r in records[:1]], NOMINAL)
    assert none is None
    assert len(plain.motors) == 4
