"""Every bad input is refused with one sentence that names the file, the fault and the remedy; no good one is."""

import numpy as np
import pytest
from synthetic_logs import make_flight, same_data

from cfb_mjx.errors import CfbError
from cfb_mjx.logs import read_log, rotation, validate, write_tabular


def put(values, row, value):
    values = values.copy()
    values[row] = value
    return values


def scaled(field, factor):
    return lambda log: log.replace(**{field: getattr(log, field) * factor})


BAD = {
    # name: (what is done to a good log, what the message must say)
    "one row": (lambda g: g.rows(slice(0, 1)), ["1 row,", "at least 2"]),
    "no row": (lambda g: g.rows(slice(0, 0)), ["0 rows", "at least 2"]),
    "duplicate time": (lambda g: g.replace(time=put(g.time, 7, g.time[6])), ["row 7", "repeats", "duplicates"]),
    "time begins anew": (
        lambda log: log.replace(time=np.where(np.arange(len(log)) < 300, log.time, log.time - log.time[300])),
        ("several recordings", "split it there"),
    ),
    "time goes back": (lambda g: g.replace(time=put(g.time, 7, 0.001)), ["row 7", "earlier", "sort"]),
    "time in ms": (scaled("time", 1e3), ["t looks like milliseconds", "divide it by 1e3"]),
    "time in us": (scaled("time", 1e6), ["t looks like microseconds", "divide it by 1e6"]),
    "time in ns": (scaled("time", 1e9), ["t looks like nanoseconds", "divide it by 1e9"]),
    "NaN in time": (lambda g: g.replace(time=put(g.time, 3, np.nan)), ["column t", "row 3"]),
    "NaN in gyro": (lambda g: g.replace(body_rate=put(g.body_rate, (5, 1), np.nan)), ["column wy", "row 5", "NaN"]),
    "infinite velocity": (
        lambda g: g.replace(velocity=put(g.velocity, (9, 2), np.inf)),
        ["column vz", "infinite", "row 9"],
    ),
    "NaN in voltage": (lambda g: g.replace(battery_voltage=put(g.battery_voltage, 4, np.nan)), ["vbat", "row 4"]),
    "infinite rotor": (lambda g: g.replace(rotor_speed=put(g.rotor_speed, (2, 3), np.inf)), ["omega4", "row 2"]),
    "quaternion not unit": (
        lambda g: g.replace(quaternion=put(g.quaternion, 3, 1.1 * g.quaternion[3])),
        ["row 3", "norm 1.1", "quaternion columns", "[w, x, y, z]"],
    ),
    "quaternion zero": (lambda g: g.replace(quaternion=g.quaternion * 0), ["row 0", "norm 0", "[w, x, y, z]"]),
    "quaternion scalar last": (
        lambda g: g.replace(quaternion=g.quaternion[:, [1, 2, 3, 0]]),
        ["scalar-last", "reorder", "--fix quaternion=xyzw"],
    ),
    "quaternion inverted": (
        lambda g: g.replace(quaternion=rotation.conjugate(g.quaternion)),
        ["world to body", "negate"],
    ),
    "quaternion both": (
        lambda g: g.replace(quaternion=rotation.conjugate(g.quaternion)[:, [1, 2, 3, 0]]),
        ["scalar-last and world to body", "negate"],
    ),
    "gyro in deg/s": (scaled("body_rate", 180 / np.pi), ["wx wy wz", "degrees per second", "pi/180"]),
    "force in g": (
        scaled("specific_force", 1 / 9.81),
        ["ax ay az", "in g; multiply it by 9.81", "--fix accelerometer-unit=g"],
    ),
    "force in mg": (scaled("specific_force", 1000 / 9.81), ["ax ay az", "in mg", "--fix accelerometer-unit=mg"]),
    "force without gravity": (scaled("specific_force", 1e-3), ["ax ay az", "gravity included"]),
    "force upside down": (
        scaled("specific_force", -1.0),
        ["along z", "forward, left, up", "--fix accelerometer-axes="],
    ),
    "command PWM": (scaled("command", 65535), ["u1..u4", "65535", "divide"]),
    "command percent": (scaled("command", 100), ["u1..u4", "percent", "divide"]),
    "command too large": (lambda g: g.replace(command=put(g.command, (8, 2), 1.2)), ["u3 is 1.2", "row 8", "[0, 1]"]),
    "command negative": (lambda g: g.replace(command=put(g.command, (8, 0), -0.1)), ["u1 is -0.1", "row 8", "[0, 1]"]),
    "position in mm": (scaled("position", 1000.0), ["px py pz", "millimetres", "divide it by 1000"]),
    "position in cm": (scaled("position", 100.0), ["px py pz", "centimetres", "divide it by 100"]),
    "velocity in mm/s": (scaled("velocity", 1000.0), ["vx vy vz", "mm/s", "divide it by 1000"]),
    "velocity in cm/s": (scaled("velocity", 100.0), ["vx vy vz", "cm/s", "divide it by 100"]),
    "rotor rpm": (scaled("rotor_speed", 30 / np.pi), ["omega1..omega4", "rpm", "2 pi / 60"]),
    "rotor erpm": (scaled("rotor_speed", 180 / np.pi), ["omega1..omega4", "electrical rpm", "2 pi / 360"]),
    "rotor spike": (
        lambda g: g.replace(rotor_speed=put(g.rotor_speed, (6, 1), 7e3)),
        ["omega2 is 7000", "row 6", "NaN"],
    ),
    "rotor signed": (lambda g: g.replace(rotor_speed=g.rotor_speed * [1, -1, 1, -1]), ["omega2", "magnitudes"]),
    "battery in mV": (scaled("battery_voltage", 1000), ["vbat", "millivolts"]),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_input_is_refused_in_one_sentence(flight, name):
    damage, fragments = BAD[name]
    with pytest.raises(CfbError) as error:
        validate(damage(flight), "folder/flight.parquet")
    message = str(error.value)
    assert message.startswith("folder/flight.parquet: ")
    for fragment in fragments:
        assert fragment in message
    assert message.endswith(".")
    assert "\n" not in message


@pytest.mark.parametrize("name", sorted(set(BAD) - {"NaN in voltage"}))
def test_the_same_through_a_file(flight, tmp_path, name):
    path = tmp_path / "flight.parquet"
    write_tabular(BAD[name][0](flight.slice(0.0, 3.0)), path)
    with pytest.raises(CfbError, match=r"flight\.parquet: "):
        read_log(path)


def test_a_battery_read_now_and_then_is_held(flight, tmp_path):
    path = tmp_path / "flight.parquet"
    now_and_then = np.where(np.arange(len(flight)) % 25 == 3, flight.battery_voltage, np.nan)
    write_tabular(flight.replace(battery_voltage=now_and_then), path)
    log = read_log(path)
    assert (log.battery_voltage[:28] == flight.battery_voltage[3]).all()
    assert (log.battery_voltage[28:53] == flight.battery_voltage[28]).all()
    assert any("vbat" in note for note in log.metadata["notes"])


GOOD = {
    "quiet hover": {"excitation": 0.0, "noise": 0.05},
    "perfect hover": {"excitation": 0.0},
    "gentle": {"excitation": 0.05, "noise": 0.02},
    "moderate, noisy": {"excitation": 0.3, "noise": 0.1},
    "wild": {"excitation": 3.0},
    "100 Hz": {"rate": 100.0},
    "irregular with gaps": {"jitter": 0.8, "drop": [(1.0, 1.3), (2.0, 2.05)]},
    "two rows": {"duration": 0.008},
    "twenty rows": {"duration": 0.08, "noise": 0.1},
}


@pytest.mark.parametrize("name", GOOD)
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_good_logs_pass(name, seed):
    log = make_flight(**({"duration": 4.0} | GOOD[name] | {"seed": seed}))
    assert same_data(validate(log, "x"), log)


def test_a_few_invalid_rotor_speeds_pass(flight):
    log = flight.replace(rotor_speed=put(flight.rotor_speed, (slice(10, 20), 1), np.nan))
    assert np.isnan(validate(log, "x").rotor_speed).sum() == 10


def test_a_tumble_with_free_fall_passes(flight):
    log = flight.slice(0, 3)
    log = log.replace(specific_force=np.where(log.time[:, None] < 1.0, 0.0, log.specific_force))
    validate(log, "x")


def test_quaternions_become_unit_and_continuous(flight):
    flipped = flight.quaternion * np.where(np.arange(len(flight)) % 3 == 0, -1.03, 1.0)[:, None]
    log = validate(flight.replace(quaternion=flipped), "x")
    assert np.abs(np.linalg.norm(log.quaternion, axis=1) - 1).max() < 1e-12
    assert (np.sum(log.quaternion[1:] * log.quaternion[:-1], axis=1) > 0).all()
    assert same_data(validate(log, "x"), log)  # nothing left to tidy


def test_commands_a_rounding_error_outside_are_clipped(flight):
    log = validate(flight.replace(command=put(flight.command, (0, 0), 1.0 + 1e-7)), "x")
    assert log.command.max() == 1.0
