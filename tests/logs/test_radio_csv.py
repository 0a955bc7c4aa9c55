import contextlib

import foreign_logs as foreign
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from synthetic_logs import make_flight

from cfb_mjx.errors import CfbError
from cfb_mjx.logs import FORMATS, read_log, read_radio_csv

STATE, IMU, MOTOR = list(foreign.STATE), list(foreign.IMU), list(foreign.MOTOR)
STATE_Z = list(foreign.STATE_Z)
FIELDS = ("position", "velocity", "quaternion", "body_rate", "specific_force")


@pytest.fixture(scope="module")
def flight():
    return make_flight(duration=4.0, rate=100.0)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "radio-20260801.csv"


@pytest.fixture(scope="module")
def small(tmp_path_factory) -> bytes:
    file = tmp_path_factory.mktemp("radio") / "small.csv"
    foreign.write_radio_csv(file, make_flight(duration=0.3, rate=100.0), [STATE + IMU + MOTOR])
    return file.read_bytes()


def test_round_trip_of_one_block(flight, path):
    foreign.write_radio_csv(path, flight, [STATE + IMU + MOTOR + ["pm.vbat"]])
    log = read_log(path)
    assert "radio_csv" in FORMATS
    assert np.abs(log.time - flight.time).max() < 1e-9
    for field in FIELDS:
        assert np.abs(getattr(log, field) - getattr(flight, field)).max() < 2e-6, field
    assert np.abs(log.command - flight.command).max() <= 0.51 / 65535
    assert np.abs(log.battery_voltage - flight.battery_voltage).max() < 1e-6
    assert (log.metadata["format"], log.name, log.metadata["warnings"]) == ("radio_csv", "radio-20260801", [])
    assert log.metadata["merging"]["time_of_first_row"] == 4.0


def test_compressed_state_and_windows_line_ends(flight, path):
    foreign.write_radio_csv(path, flight, [STATE_Z + MOTOR], line_end="\r\n", header="timestamp")
    log = read_log(path)
    for field, step in zip(FIELDS, (6e-4, 6e-4, 1.3e-3, 6e-4, 0.04), strict=True):
        assert np.abs(getattr(log, field) - getattr(flight, field)).max() < step, field


def test_sparse_blocks_are_held_onto_the_gyro(flight, path):
    foreign.write_radio_csv(path, flight, [STATE, IMU, MOTOR], every=[5, 1, 2])
    log = read_log(path)
    rows = np.arange(len(flight))
    assert len(log) == len(flight)
    assert np.abs(log.body_rate - flight.body_rate).max() < 1e-6
    assert np.abs(log.position - flight.position[rows // 5 * 5]).max() < 2e-6
    assert np.abs(log.command - flight.command[rows // 2 * 2]).max() <= 0.51 / 65535
    held = log.metadata["merging"]["held"]
    assert log.metadata["merging"]["rows_of"] == "block of gyro.x"
    assert held["block of stateEstimate.x"]["interval_ms"] == pytest.approx(50.0)
    assert held["block of stateEstimate.x"]["mean_age_ms"] == pytest.approx(20.0)
    assert held["block of motor.m1"]["max_age_ms"] == pytest.approx(10.0)


def test_lost_packets_become_a_gap(flight, path):
    foreign.write_radio_csv(path, flight, [STATE, IMU + MOTOR])
    lines = path.read_text().splitlines(keepends=True)
    path.write_text("".join(lines[:101] + lines[120:]))
    log = read_log(path)
    assert len(log.gaps()) == 1
    assert log.metadata["merging"]["held"] == {}  # filled in the same rows, so they are one stream


def test_24_bit_time_stamp_overflows(flight, path):
    foreign.write_radio_csv(path, flight, [STATE + IMU + MOTOR], start_ms=2**24 - 1500)
    log = read_log(path)
    assert np.abs(log.time - flight.time).max() < 1e-9
    assert any("overflowed 1 times" in note for note in log.metadata["notes"])


@pytest.mark.parametrize(("unit", "factor"), [("s", 1e-3), ("us", 1e3)])
def test_time_in_another_unit(flight, path, unit, factor):
    foreign.write_radio_csv(path, flight, [STATE + IMU + MOTOR])
    lines = [line.split(",", 1) for line in path.read_text().splitlines()]
    path.write_text("".join(f"{t if i == 0 else float(t) * factor},{rest}\n" for i, (t, rest) in enumerate(lines)))
    with pytest.raises(
        CfbError, match=r"read in ms, the time advances by .* so it is in another unit; give --time-unit "
    ):
        read_log(path)
    assert np.abs(read_log(path, time_unit=unit).time - flight.time).max() < 1e-6
    with pytest.raises(CfbError, match="--time-unit must be one of"):
        read_log(path, time_unit="minutes")


def test_last_line_without_a_break_is_left_out(flight, path):
    foreign.write_radio_csv(path, flight, [STATE + IMU + MOTOR])
    path.write_bytes(path.read_bytes()[:-3])  # the last number loses its last digits
    log = read_log(path)
    assert len(log) == len(flight) - 1
    assert "last row may be cut short" in log.metadata["warnings"][0]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t: t.replace("Timestamp", "when", 1), "there is no time column"),
        (lambda t: t.replace("motor.m1", "motor.a", 1), r"command \(missing motor.m1\).* Found: acc.x"),
        (lambda t: t.replace("\n4010,", "\n,", 1), "column Timestamp has no value in row 1"),
        (lambda t: t.replace("\n4010,", "\nfour,", 1), "column Timestamp holds 'four' in row 1"),
        (lambda t: t.replace("\n4010,", "\n3010,", 1), "goes back from 4.000 s to 3.010 s"),
        (lambda t: t.splitlines()[0] + "\n", "no logged variables for position"),
        (lambda t: "\n".join(t.splitlines()[:2]) + "\n", "1 of 1 rows"),
        (lambda t: t.replace("\n4030,", "\n4030,1,", 1), "row 3 .* has 22 cells, the header has 21"),
    ],
)
def test_refusals(flight, path, change, message):
    foreign.write_radio_csv(path, flight, [STATE + IMU + MOTOR])
    path.write_text(change(path.read_text()))
    with pytest.raises(CfbError, match=message):
        read_log(path)


def test_columns_nobody_asked_for(flight, path):
    foreign.write_radio_csv(path, flight, [STATE + IMU + MOTOR])
    lines = path.read_text().splitlines()
    path.write_text("".join(f"{line},{'radio.rssi' if i == 0 else 40},{'note' if i == 0 else 'ok'}\n"
                            for i, line in enumerate(lines)))  # fmt: skip
    log = read_log(path)
    assert any("radio.rssi" in note for note in log.metadata["notes"])
    assert len(read_radio_csv(path)) == len(flight)


@settings(max_examples=100, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_structural_damage_raises_nothing_but_cfb_error(small, tmp_path, data):
    broken = bytearray(small)
    for _ in range(data.draw(st.integers(1, 3))):
        at = data.draw(st.integers(0, max(0, len(broken) - 1)))
        match data.draw(st.sampled_from(["flip", "cut", "delete", "insert"])):
            case "flip":
                broken[at : at + 1] = data.draw(st.binary(min_size=1, max_size=1))
            case "cut":
                broken = broken[:at]
            case "delete":
                del broken[at : at + data.draw(st.integers(1, 50))]
            case "insert":
                broken[at:at] = data.draw(st.binary(max_size=10))
    file = tmp_path / "log.csv"
    file.write_bytes(broken)
    with contextlib.suppress(CfbError):
        read_log(file, format="radio_csv")


@pytest.mark.parametrize("cut", range(1, 60, 3))
def test_a_cut_file_gives_whole_rows_or_nothing(small, path, cut):
    path.write_bytes(small)
    truth = read_log(path)
    path.write_bytes(small[:-cut])
    with contextlib.suppress(CfbError):
        log = read_log(path)
        assert np.array_equal(log.body_rate, truth.body_rate[: len(log)])
        assert log.metadata["warnings"] or len(log) == len(truth) - 1


def table(path, columns, header=True):
    rows = zip(*columns.values(), strict=True)
    lines = [",".join(columns)] if header else []
    path.write_text("\n".join([*lines, *(",".join(str(cell) for cell in row) for row in rows), ""]))


def firmware(flight):
    """The flight by names of the firmware."""
    columns = {}
    for names, values in (
        (STATE, np.concatenate([flight.position, flight.velocity, flight.quaternion], axis=1)),
        (IMU, np.concatenate([np.degrees(flight.body_rate), flight.specific_force / 9.81], axis=1)),
        (MOTOR, np.round(65535 * flight.command)),
    ):
        columns |= dict(zip(names, values.T, strict=True))
    return columns


def same(log, flight, tolerance=1e-5):
    for field in FIELDS:
        assert np.abs(getattr(log, field) - getattr(flight, field)).max() < tolerance, field


def test_names_with_something_before_them(flight, path):
    """``cf3/gyro.x``, and ``est_stateEstimate_x`` as a merge of blocks names them; set-points are no measurement."""
    ticks = {"Timestamp": np.round(1e3 * flight.time)}
    for prefix, joined in (("cf3/", "."), ("est_", "_")):
        named = {prefix + name.replace(".", joined): values for name, values in firmware(flight).items()}
        wrong = {f"sp_{name.replace('.', '_')}": 0 * values for name, values in firmware(flight).items()}
        table(path, ticks | wrong | named)
        same(read_log(path), flight)


def test_two_drones_in_one_table(flight, path):
    columns = {"Timestamp": np.round(1e3 * flight.time)}
    for drone, shift in (("cf1", 0.0), ("cf2", 1.0)):
        columns |= {
            f"{drone}/{name}": values + shift * (name == "stateEstimate.x") for name, values in firmware(flight).items()
        }
    table(path, columns)
    with pytest.raises(CfbError, match=r"several drones \(cf1, cf2\); choose one with --robot cf1"):
        read_log(path)
    assert np.abs(read_log(path, robot="cf2").position - flight.position - [1.0, 0.0, 0.0]).max() < 1e-9
    with pytest.raises(CfbError, match="has no columns of cf7, only those of cf1, cf2"):
        read_log(path, robot="cf7")


def test_one_value_per_line_without_a_header(flight, path):
    lines = [
        f"{1e3 * t:.3f},{name},{values[row]!r}"
        for row, t in enumerate(flight.time)
        for name, values in ((n, v.tolist()) for n, v in firmware(flight).items())
    ]
    path.write_text("\n".join([*lines, ""]))
    log = read_log(path)
    same(log, flight)
    assert any("no header" in note for note in log.metadata["notes"])


def test_flights_of_nanobench(flight, path):
    """Motion capture under the bare names, scalar last, and the drone's own sensors; the gyro in rad/s."""
    vector = lambda stem, v: {stem.format(a): c for a, c in zip("xyz", v.T, strict=True)}  # noqa: E731
    state = {f"est_{n.replace('.', '_')}": v + 0.3 for n, v in firmware(flight).items() if n.startswith("stateE")}
    columns = {"t": [f"{1772419726.25 + t:.9f}" for t in flight.time]} | vector("p{}", flight.position)
    columns |= {f"q{a}": flight.quaternion[:, i] for a, i in zip("xyzw", (1, 2, 3, 0), strict=True)}
    columns |= vector("v{}", flight.velocity) | vector("w{}_vicon", flight.body_rate)
    columns |= vector("imu_acc_{}", flight.specific_force / 9.81) | vector("imu_gyro_{}", flight.body_rate)
    columns |= {f"motor_motor_m{i}": np.round(65535 * u) for i, u in enumerate(flight.command.T, 1)}
    table(path, columns | state | {"pwr_pm_vbat": flight.battery_voltage})
    log = read_log(path)
    same(log, flight)
    assert log.metadata["variables"]["mapping"] == "nanobench"
    assert np.abs(log.battery_voltage - flight.battery_voltage).max() < 1e-9
