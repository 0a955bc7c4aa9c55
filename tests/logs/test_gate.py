"""A log that contradicts itself is named, with the change that makes its signals agree; a good one is left alone."""

import re

import numpy as np
import pytest
from contradictions import CONTRADICTIONS, shows
from synthetic_logs import make_flight, same_data

from cfb_mjx.errors import CfbError
from cfb_mjx.files import shipped
from cfb_mjx.logs import gate, read_log, validate, write_tabular
from cfb_mjx.logs.fixes import COMMAND_UNITS, candidates, command_fixes, fix_of, motor_fixes
from cfb_mjx.logs.gate import judge


@pytest.fixture(scope="module")
def flown():
    """A shipped flight at a quarter of its rows: every candidate change is compared on every row."""
    log = read_log(shipped("data", "flight_logs", "drag.mcap"))
    return log.rows(slice(0, None, 2)).slice(0.0, 8.0)


@pytest.mark.parametrize("name", CONTRADICTIONS)
def test_a_contradiction_is_named_with_its_remedy(flown, name):
    contradiction = CONTRADICTIONS[name]
    if not shows(flown, contradiction):
        pytest.skip("this flight does not show it")
    with pytest.raises(CfbError) as refusal:
        validate(contradiction.change(flown), "folder/a.csv")
    message = str(refusal.value)
    assert message.startswith("folder/a.csv: ")
    assert "\n" not in message
    assert any(advice in message for advice in contradiction.advice), message
    flags = re.findall(r"--fix ([^\s);]+)", message)
    if flags and "would too" not in message:
        mended = contradiction.change(flown)
        for flag in flags:
            mended = fix_of(flag).apply(mended)
        validate(mended, "a.csv")


def test_most_contradictions_show_in_a_lively_flight(flown):
    assert sum(shows(flown, c) for c in CONTRADICTIONS.values()) > 0.7 * len(CONTRADICTIONS)


@pytest.mark.parametrize("name", ["drag", "figure8", "yaw"])
def test_shipped_flights_agree_with_themselves(name):
    verdict = judge(read_log(shipped("data", "flight_logs", f"{name}.mcap")))
    assert verdict.problem is None
    assert max(r.unexplained for r in verdict.relations if r.moves) < 0.1


def test_a_hover_is_too_gentle_to_tell():
    verdict = judge(make_flight(duration=3.0, excitation=0.0, noise=0.01))
    assert verdict.problem is None
    assert "nothing moves enough" in verdict.summary()
    lively = judge(make_flight(duration=3.0))
    assert lively.summary().startswith("signals agree: displacement x y")


def test_minutes_of_a_flight_that_then_lasts_too_short_to_compare(flown):
    """At 100 Hz ten seconds are a sixth of one."""
    slow = flown.rows(slice(0, None, 3))
    with pytest.raises(CfbError, match=r"times as far as the velocity says; reading the time in min.*time-unit=min"):
        validate(slow.replace(time=slow.time / 60.0), "x")
    validate(slow.slice(0.0, 0.5), "x")


def test_a_copy_is_found_whatever_the_sign_of_its_quaternion(flown):
    twice = np.r_[0:800, 400:800, 800 : len(flown)]
    sign = np.where((np.arange(len(twice)) >= 800) & (np.arange(len(twice)) < 1200), -1.0, 1.0)
    copied = flown.rows(twice).replace(time=np.arange(len(twice)) * flown.nominal_interval)
    copied = copied.replace(quaternion=copied.quaternion * sign[:, None])
    assert "repeat earlier rows" in str(gate._repeated(copied))


def test_what_no_change_mends_is_a_warning_with_its_time(flown):
    yaw = np.where((flown.time > 2.0) & (flown.time < 5.0), 1.0, 0.0)
    wandering = flown.replace(body_rate=flown.body_rate + 1.5 * yaw[:, None] * np.sin(3 * flown.time)[:, None])
    log = validate(wandering, "x")
    (warning,) = [w for w in log.metadata["warnings"] if "contradict" in w]
    start, stop = map(float, re.search(r"between ([\d.]+) and ([\d.]+) s", warning).groups())
    assert 1.8 < start < 2.6
    assert 4.4 < stop < 5.3
    assert same_data(log, wandering)
    assert validate(log, "x").metadata["warnings"] == log.metadata["warnings"]  # not said twice
    # What contradicts does not agree as well, and the motors were not compared.
    assert judge(wandering).summary() == "signals agree: displacement x y z, velocity x y z"


@pytest.mark.parametrize("scale", [0.6, 1.6])
def test_a_sensor_that_is_off_by_some_factor_is_a_fault_to_find(flown, scale):
    """Not a unit: identification names it, so the log is read."""
    log = validate(flown.replace(velocity=scale * flown.velocity), "x")
    assert any("contradict" in w and "no change of unit" in w for w in log.metadata["warnings"])


def test_a_derived_signal_is_not_compared_with_its_source(flown):
    log = flown.replace(metadata={"variables": {"body_rate": {"derived": "quaternion"}}})
    assert {r.name for r in judge(log).relations} >= {"displacement", "velocity"}
    assert not [r for r in judge(log).relations if r.name == "attitude"]


def test_fixes_are_made_only_when_asked(flown, tmp_path):
    path = tmp_path / "flight.parquet"
    write_tabular(CONTRADICTIONS["velocity in body axes"].change(flown), path)
    with pytest.raises(CfbError, match="--fix velocity-frame=body"):
        read_log(path)
    log = read_log(path, fix=["velocity-frame=body"])
    assert np.abs(log.velocity - flown.velocity).max() < 1e-9
    assert any("velocity-frame=body" in note for note in log.metadata["notes"])


def test_names_of_fixes():
    named = [f.name for f in (*candidates(), *command_fixes())]
    assert len(set(named)) == len(named) - len(command_fixes())  # commands' units are among the named ones too
    for name in {*named, "motors=2,1,4,3", "motors=inverted", "command-order=4,3,2,1", "rotor-order=2,1,3,4"}:
        assert fix_of(name).name == name
    for name in (
        "nothing",
        "velocity-axes=x,y",
        "velocity-axes=x,y,w",
        "motors=1,1,2,3",
        "time-scale=-1",
        "time-scale=x",
    ):
        with pytest.raises(CfbError, match="there is no such change"):
            fix_of(name)


def test_impossible_magnitudes_are_refused(flown):
    spike = flown.velocity.copy()
    spike[77, 1] = 400.0
    with pytest.raises(CfbError, match=r"velocity reaches 400 m/s in row 77 .*which no flight has \(1 rows in all\)"):
        validate(flown.replace(velocity=spike), "x")


def test_an_order_under_inverted_commands_is_two_changes(flown):
    """Both are named, and both are made: the flag for the order alone would leave the commands inverted."""
    mixed = flown.replace(command=1.0 - flown.command[:, [2, 1, 0, 3]])
    mended, fixes = mixed, motor_fixes((2, 1, 0, 3), -1, "command-order")
    for fix in fixes:
        mended = fix_of(fix.name).apply(mended)
    assert [fix.name for fix in fixes] == ["command-order=3,2,1,4", "motors=inverted"]
    assert np.abs(mended.command - flown.command).max() < 1e-12


@pytest.mark.parametrize(
    ("unit", "logged", "duty"),
    [
        ("percent", 40.0, 0.4),
        ("pwm16", 65535.0, 1.0),
        ("dshot", 2047.0, 1.0),
        ("dshot", 1047.0, 0.5),
        ("dshot", 20.0, 0.0),
        ("us", 1250.0, 0.25),
        ("0-255", 255.0, 1.0),
        ("0-1000", 250.0, 0.25),
        ("1023", 1023.0, 1.0),
    ],
)
def test_commands_in_other_units_by_hand(unit, logged, duty):
    assert COMMAND_UNITS[unit][1](np.array([logged])) == pytest.approx(duty, rel=1e-12)
