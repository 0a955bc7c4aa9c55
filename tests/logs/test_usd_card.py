import contextlib
import struct
import zlib

import foreign_logs as foreign
import numpy as np
import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from synthetic_logs import make_flight

from cfb_mjx.errors import CfbError
from cfb_mjx.files import shipped
from cfb_mjx.logs import FORMATS, load_mapping, read_log, read_usd_card, rotation, write_mcap
from cfb_mjx.logs.assembly import decompress_quaternion
from cfb_mjx.logs.flight_log import FlightLog
from cfb_mjx.logs.variables import UNITS

FULL = foreign.STATE | foreign.IMU | foreign.MOTOR | foreign.RPM | foreign.BATTERY
RECORD = 10 + 4 * (10 + 6 + 4 + 1) + 2 * 4  # bytes of a record of these in version 2
COMPRESSED = foreign.STATE_Z | foreign.MOTOR
# Half a step of what carries each field in the file, in SI units.
FULL_RESOLUTION = {
    "position": 1e-6,  # the synthetic flight drifts to 20 m
    "velocity": 1e-6,
    "quaternion": 5e-8,
    "body_rate": 5e-7,
    "specific_force": 2e-6,
    "command": 0.51 / 65535,
    "rotor_speed": 0.51 * 2 * np.pi / 60,
    "battery_voltage": 3e-7,
}
COMPRESSED_RESOLUTION = {
    "position": 0.51e-3,
    "velocity": 0.51e-3,
    "quaternion": 1.3e-3,
    "body_rate": 0.51e-3,
    "specific_force": 0.04,  # rotated with the coarse quaternion: 9.81 times its 0.2 degrees
    "command": 0.51 / 65535,
}


@pytest.fixture
def path(tmp_path):
    return tmp_path / "log00"


@pytest.fixture(scope="module")
def small() -> bytes:
    return foreign.usd_card_bytes([foreign.event(make_flight(duration=0.4, rate=100.0), FULL)])


def save(path, *events, **options):
    path.write_bytes(foreign.usd_card_bytes(events, **options))
    return path


def assert_close(log, truth, resolution):
    for field, step in resolution.items():
        difference = np.abs(getattr(log, field) - getattr(truth, field)).max()
        assert difference <= step, f"{field}: {difference}"


@pytest.mark.parametrize("version", [1, 2])
def test_round_trip_of_both_versions(flight, path, version):
    log = read_log(save(path, foreign.event(flight, FULL), version=version))
    assert "usd_card" in FORMATS
    assert np.abs(log.time - flight.time).max() < 1e-9
    assert_close(log, flight, FULL_RESOLUTION)
    assert (log.name, log.metadata["format"], log.observation_delay) == ("log00", "usd_card", None)
    assert log.metadata["warnings"] == log.metadata["notes"] == []
    assert log.metadata["usd_card"] == {"version": version, "checksum": "ok", "records": {"fixedFrequency": len(log)}}
    assert log.metadata["merging"]["time_of_first_row"] == 12.5
    assert log.metadata["firmware"]["version"] is None
    assert "battery compensation" in log.metadata["firmware"]["command"]


def test_compressed_state(flight, path):
    """int16 millimetres, a 32-bit quaternion, milliradians with the old pitch, acceleration in world axes."""
    log = read_log(save(path, foreign.event(flight, COMPRESSED)))
    assert_close(log, flight, COMPRESSED_RESOLUTION)
    assert log.rotor_speed is None
    assert log.battery_voltage is None


def test_float16(flight, path):
    variables = {v: "e" if v.startswith(("gyro", "acc", "pm")) else kind for v, kind in FULL.items()}
    log = read_log(save(path, foreign.event(flight, variables)))
    largest = np.abs(flight.body_rate).max()
    coarse = {"body_rate": 5e-4 * largest, "specific_force": 5e-4 * 12.0, "battery_voltage": 5e-4 * 4.0}
    assert_close(log, flight, FULL_RESOLUTION | coarse)


@pytest.mark.parametrize("seed", range(4))
def test_compressed_quaternions(seed):
    q = np.random.default_rng(seed).normal(size=(300, 4))
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    back = decompress_quaternion(np.array([foreign.compress_quaternion(v) for v in q]))
    angle = np.linalg.norm(rotation.rotation_vector(rotation.multiply(rotation.conjugate(q), back)), axis=1)
    assert np.abs(np.linalg.norm(back, axis=1) - 1).max() < 1e-12
    assert np.rad2deg(angle.max()) < 0.25
    assert np.isnan(decompress_quaternion(np.array([np.nan, -1.0, 2.0**32]))).all()


@pytest.mark.parametrize("variables", [FULL, COMPRESSED], ids=["float", "compressed"])
def test_units_and_frames_by_physics(path, variables):
    """At rest the specific force is 9.81 m/s^2 upwards; in flight gyro and attitude, velocity and position agree."""
    n = 300
    tilt = np.array([np.cos(0.3), 0.0, np.sin(0.3), 0.0])  # nose down by 34 degrees, lying on a slope
    rest = FlightLog(
        time=np.arange(n) / 100,
        position=np.zeros((n, 3)),
        velocity=np.zeros((n, 3)),
        quaternion=np.tile(tilt, (n, 1)),
        body_rate=np.zeros((n, 3)),
        specific_force=rotation.to_body(np.tile(tilt, (n, 1)), np.tile([0.0, 0.0, 9.81], (n, 1))),
        command=np.zeros((n, 4)),
    )
    still = {v: k for v, k in variables.items() if "rpm" not in v and v != "pm.vbat"}
    log = read_log(save(path, foreign.event(rest, still)), keep_ground=True)
    assert np.abs(np.linalg.norm(log.specific_force, axis=1) - 9.81).max() < 1e-3
    assert np.abs(rotation.to_world(log.quaternion, log.specific_force) - [0.0, 0.0, 9.81]).max() < 0.04
    flight = make_flight(duration=4.0)
    log = read_log(save(path, foreign.event(flight, variables)))
    a, b = slice(None, -25, 25), slice(25, None, 25)
    turned = rotation.rotation_vector(rotation.multiply(rotation.conjugate(log.quaternion[a]), log.quaternion[b]))
    means = np.array([log.body_rate[i : i + 26].mean(axis=0) for i in range(0, len(log) - 25, 25)])
    slope = np.sum(turned / 0.1 * means, axis=0) / np.sum(means**2, axis=0)
    assert np.abs(slope - 1.0).max() < 0.1  # every axis on its own: a wrong sign would give -1
    moved = log.position[b] - log.position[a]
    speeds = np.array([log.velocity[i : i + 26].mean(axis=0) for i in range(0, len(log) - 25, 25)])
    assert np.abs(moved - 0.1 * speeds).max() < 0.01


def test_events_at_different_rates_are_held(flight, path):
    """Pose every 8 ms and 1.5 ms late, motors with it, battery every 0.4 s: held onto the gyro's rows."""
    events = [
        foreign.event(flight, foreign.BATTERY, name="slow", identifier=3, every=100, delay=0.001),
        foreign.event(flight, foreign.STATE, name="estimate", identifier=7, every=2, delay=0.0015),
        foreign.event(flight, foreign.IMU | foreign.MOTOR),
    ]
    log = read_log(save(path, *events))
    assert len(log) == len(flight) - 1  # the first row has no pose yet
    truth = flight.rows(np.arange(1, len(flight)))
    assert_close(log, truth, {k: FULL_RESOLUTION[k] for k in ("body_rate", "specific_force", "command")})
    source = (np.arange(1, len(flight)) - 1) // 2 * 2
    assert np.abs(log.position - flight.position[source]).max() < 1e-6
    merging = log.metadata["merging"]
    assert merging["rows_of"] == "fixedFrequency"
    assert merging["dropped_rows"] == merging["held"]["estimate"]["rows_before_first"] == 1
    held = merging["held"]["estimate"]
    assert held["interval_ms"] == pytest.approx(8.0)
    assert held["mean_age_ms"] == pytest.approx(4.5, abs=0.01)
    assert held["max_age_ms"] == pytest.approx(6.5)
    assert any("4.5 ms old on average" in note for note in log.metadata["notes"])
    assert log.battery_voltage[0] == pytest.approx(flight.battery_voltage[0], abs=1e-6)


def test_rows_of_the_gyro_where_the_fixed_frequency_lacks_it(flight, path):
    fixed = foreign.event(flight, foreign.BATTERY, every=25)
    fast = {k: v for k, v in FULL.items() if k != "pm.vbat"}
    fast = foreign.event(flight, fast, name="estimator", identifier=4)
    log = read_log(save(path, fixed, fast))
    assert log.metadata["merging"]["rows_of"] == "estimator"
    assert len(log) == len(flight)


def test_a_pause_of_one_event_becomes_a_gap(flight, path):
    pose = foreign.event(flight, foreign.STATE, name="estimate", identifier=7, every=2)
    keep = (pose.time < 3.0) | (pose.time > 3.5)
    pose.time, pose.columns = pose.time[keep], [c[keep] for c in pose.columns]
    log = read_log(save(path, foreign.event(flight, foreign.IMU | foreign.MOTOR), pose))
    assert len(log.gaps()) == 1
    assert 0.45 < np.diff(log.time).max() < 0.5
    assert log.metadata["merging"]["held"]["estimate"]["rows_too_old"] == log.metadata["merging"]["dropped_rows"] > 100


def test_velocity_is_derived_when_it_was_not_logged(flight, path):
    variables = {k: v for k, v in FULL.items() if not k.startswith("stateEstimate.v")}
    log = read_log(save(path, foreign.event(flight, variables)))
    inner = slice(1, -1)
    assert np.abs(log.velocity[inner] - flight.velocity[inner]).max() < 4e-3
    assert log.metadata["variables"]["velocity"] == {"derived": "position"}
    assert any("central differences" in warning for warning in log.metadata["warnings"])


def test_euler_angles_and_body_velocity(flight, path):
    data = foreign.firmware_variables(flight)
    body = np.einsum("nij,ni->nj", foreign.rotation_matrices(flight.quaternion), flight.velocity)
    data |= {f"kalman.stateP{a}": body[:, i] for i, a in enumerate("XYZ")}
    names = [*"xyz"]
    variables = {f"stateEstimate.{a}": "f" for a in names} | {f"kalman.stateP{a.upper()}": "f" for a in names}
    variables |= {f"stabilizer.{a}": "f" for a in ("roll", "pitch", "yaw")} | foreign.IMU | foreign.MOTOR
    log = read_log(save(path, foreign.event(flight, variables, source=data)))
    assert_close(log, flight, {"quaternion": 1e-6, "velocity": 1e-5})


def test_invalid_rotor_speeds(flight, path):
    speed = flight.rotor_speed.copy()
    speed[10:13, 2] = np.nan
    log = read_log(save(path, foreign.event(flight.replace(rotor_speed=speed), FULL)))
    assert np.array_equal(np.isnan(log.rotor_speed), np.isnan(speed))


def test_missing_variables_are_listed(flight, path):
    variables = {k: v for k, v in FULL.items() if k not in ("gyro.y", "motor.m3")}
    save(path, foreign.event(flight, variables))
    with pytest.raises(CfbError, match=r"no logged variables for command \(missing motor.m3\). Found: acc.x, ") as e:
        read_log(path)
    assert "mapping" in str(e.value)


def test_a_mapping_of_ones_own(flight, path, tmp_path):
    document = yaml.safe_load(shipped("configs", "logs", "crazyflie.yaml").read_text())
    document["name"] = "mine"
    document["fields"]["body_rate"].insert(
        0, {"variables": ["my.p", "my.q", "my.r"], "unit": "rad/s", "sign": [1, -1, 1]}
    )
    document["firmware"] = {"version": "2026.05", "battery_compensation": False, "thrust_limit": 0.2}
    document["observation_delay"] = 0.004
    own = tmp_path / "mine.yaml"
    own.write_text(yaml.safe_dump(document))
    data = foreign.firmware_variables(flight)
    data |= {"my.p": flight.body_rate[:, 0], "my.q": -flight.body_rate[:, 1], "my.r": flight.body_rate[:, 2]}
    variables = foreign.STATE | foreign.IMU | foreign.MOTOR | dict.fromkeys(("my.p", "my.q", "my.r"), "f")
    save(path, foreign.event(flight, variables, source={**data, "gyro.x": 0 * data["gyro.x"]}))
    log = read_log(path, mapping=own)
    assert_close(log, flight, {"body_rate": 5e-7})
    assert log.observation_delay == 0.004
    assert log.metadata["firmware"]["version"] == "2026.05"
    assert log.metadata["firmware"]["battery_compensation"] is False
    assert log.metadata["variables"]["mapping"] == "mine"
    assert log.metadata["variables"]["body_rate"]["sign"] == [1, -1, 1]


MISTAKES = {
    "format": (lambda d: d.update(format="x"), "'format' must be"),
    "field": (lambda d: d["fields"].update(spin=[]), "fields has unknown key 'spin'"),
    "key": (lambda d: d["fields"]["position"][0].update(units="m"), "fields.position has unknown key 'units'"),
    "unit": (lambda d: d["fields"]["position"][0].update(unit="ft"), "unit 'ft' is not one of m, cm, mm"),
    "no unit": (lambda d: d["fields"]["body_rate"][0].pop("unit"), "unit '' is not one of rad/s"),
    "number": (lambda d: d["fields"]["command"][0].update(variables=["a"]), "must list 4 names"),
    "sign": (lambda d: d["fields"]["position"][0].update(sign=[1, 2, 1]), "'sign' must list 3 times"),
    "frame": (lambda d: d["fields"]["body_rate"][0].update(frame="body"), "'frame' is for velocity"),
    "form": (lambda d: d["fields"]["position"][0].update(form="euler"), "'form' is for quaternions"),
    "invalid": (lambda d: d["fields"]["command"][0].update(invalid="x"), "'invalid' must be a list of numbers"),
    "derived": (lambda d: d["fields"]["position"].append({"derived": "velocity"}), "derived: position for velocity"),
    "delay": (lambda d: d.update(observation_delay="8 ms"), "'observation_delay' must be in seconds"),
    "firmware": (lambda d: d["firmware"].update(name="x"), "firmware has unknown key 'name'"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_mistakes_in_a_mapping(tmp_path, mistake):
    change, message = MISTAKES[mistake]
    document = yaml.safe_load(shipped("configs", "logs", "crazyflie.yaml").read_text())
    change(document)
    own = tmp_path / "mine.yaml"
    own.write_text(yaml.safe_dump(document))
    with pytest.raises(CfbError, match=r"mine\.yaml: ") as error:
        load_mapping(own)
    assert message in str(error.value)


def test_a_mapping_that_is_no_mapping(tmp_path):
    own = tmp_path / "mine.yaml"
    for text, message in [("- 1", "must hold a YAML mapping"), ("a: [", "not valid YAML")]:
        own.write_text(text)
        with pytest.raises(CfbError, match=message):
            load_mapping(own)
    with pytest.raises(CfbError, match="no such file"):
        load_mapping(tmp_path / "none.yaml")


def test_wrong_unit_of_the_gyro_in_either_direction(flight, path, tmp_path):
    text = shipped("configs", "logs", "crazyflie.yaml").read_text()
    own = tmp_path / "mine.yaml"
    own.write_text(text.replace("[gyro.x, gyro.y, gyro.z], unit: deg/s", "[gyro.x, gyro.y, gyro.z], unit: rad/s"))
    save(path, foreign.event(flight, FULL))
    with pytest.raises(CfbError, match=r"in degrees per second; multiply it by pi/180.*--fix gyro-unit=deg/s"):
        read_log(path, mapping=own)
    data = foreign.firmware_variables(flight)
    save(path, foreign.event(flight, FULL, source=data | {f"gyro.{a}": np.deg2rad(data[f"gyro.{a}"]) for a in "xyz"}))
    with pytest.raises(CfbError, match=r"attitude turns 5\d\.\d+ times as fast .*--fix gyro-unit=rad/s"):
        read_log(path)


def test_time_that_overflows_repeats_or_goes_back(flight, path):
    log = read_log(save(path, foreign.event(flight, FULL), version=1, start=2**32 / 1000 - 2.0))
    assert np.abs(log.time - flight.time).max() < 1e-6
    assert any("overflowed 1 times" in note for note in log.metadata["notes"])
    twice = foreign.event(flight, FULL)
    twice.time = twice.time.copy()
    twice.time[100] = twice.time[99]
    log = read_log(save(path, twice))
    assert len(log) == len(flight) - 1
    assert any("1 samples repeat the time" in note for note in log.metadata["notes"])
    good = foreign.usd_card_bytes([foreign.event(flight, FULL)])
    header = len(good) - 4 - len(flight) * RECORD
    body = good[:-4] + good[header:-4]  # the same recording once more
    path.write_bytes(body + struct.pack("<I", zlib.crc32(body)))
    with pytest.raises(CfbError, match=r"time of fixedFrequency goes back from 20\.496 s to 12\.500 s"):
        read_log(path)


def test_damaged_value_is_flagged(small, path):
    broken = bytearray(small)
    broken[-100] ^= 0x01
    path.write_bytes(broken)
    log = read_usd_card(path)
    assert log.metadata["usd_card"]["checksum"] == "mismatch"
    assert "checksum does not match" in log.metadata["warnings"][0]


def test_damage_in_the_middle_is_cut_off(small, path):
    truth = read_from(path, small)
    for damage in (b"\xff" * 200, b"\x00" * 200, None):
        place = len(small) - 4 - 10 * RECORD
        broken = small[:place] if damage is None else small[:place] + damage + small[place + 200 :]
        path.write_bytes(broken)
        log = read_log(path)
        assert len(log) == len(truth) - 10
        assert np.array_equal(log.position, truth.position[:-10])
        assert "checksum does not match" in log.metadata["warnings"][0]
    write_mcap(log, path.with_suffix(".mcap"))
    assert read_log(path.with_suffix(".mcap")).metadata["warnings"] == log.metadata["warnings"]


def test_an_interrupted_log_keeps_every_whole_record(small, path):
    truth = read_from(path, small)
    for cut in (4, 5, 30):
        path.write_bytes(small[:-cut])
        log = read_log(path)
        assert len(log) == len(truth) - (cut > 4)
        assert "cut short" in log.metadata["warnings"][0]


def test_an_impossible_value_in_a_damaged_file_ends_it(small, path):
    truth = read_from(path, small)
    broken = bytearray(small)
    place = len(small) - 4 - 10 * RECORD + 10 + 16 * 4  # motor.m1 of the record of row 30
    broken[place : place + 4] = b"\x00\x00\x00\x70"
    path.write_bytes(broken)
    log = read_log(path)
    assert np.array_equal(log.command, truth.command[:30])
    assert "row 30 (0.300 s) holds values that no flight has" in log.metadata["warnings"][1]


def test_a_right_checksum_over_an_invalid_record(small, path):
    truth = read_from(path, small)
    body = small[:-4] + b"\x07\x00" + bytes(20)
    path.write_bytes(body + struct.pack("<I", zlib.crc32(body)))
    log = read_log(path)
    assert np.array_equal(log.position, truth.position)
    assert "checksum is right but the record at byte" in log.metadata["warnings"][0]


def read_from(path, data):
    path.write_bytes(data)
    return read_log(path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d[:3], "header is damaged or cut short"),
        (lambda d: d[:40], "header is damaged or cut short"),
        (lambda d: d[:1] + b"\x09\x00" + d[3:], "version 9, this library reads 1, 2"),
        (lambda d: d[:3] + b"\x00\x00" + d[5:], "lists no event types"),
        (lambda d: d.replace(b"gyro.y(f)", b"gyro.x(f)"), "lists a variable twice"),
        (lambda d: d.replace(b"gyro.y(f)", b"gyro.y(z)"), "is not a variable and its type"),
        (lambda d: d.replace(b"gyro.y(f)", b"gyro.\x00(f)"), "header is damaged"),
        (lambda d: b"\xbc", "header is damaged"),
        (lambda d: d[: -4 - 39 * RECORD], "1 of 1 rows of fixedFrequency"),
    ],
)
def test_damaged_header(small, path, change, message):
    path.write_bytes(change(small))
    with pytest.raises(CfbError, match=message):
        read_log(path)


def test_other_files(path, tmp_path):
    path.write_bytes(b"hello")
    with pytest.raises(CfbError, match="does not begin with 0xBC"):
        read_usd_card(path)
    with pytest.raises(CfbError, match="no such file"):
        read_log(tmp_path / "none", format="usd_card")
    with pytest.raises(CfbError, match="cannot be read"):
        read_usd_card(tmp_path)


def test_unknown_options(small, path):
    path.write_bytes(small)
    with pytest.raises(CfbError, match="usd_card format has no option --robot"):
        read_log(path, robot="cf1")
    assert len(read_log(path, mapping=None, robot=None))


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_no_damage_goes_unnoticed(small, tmp_path, data):
    """Flipped bytes, cut and inserted pieces: refused with one sentence, or read with a warning, never neither."""
    broken = bytearray(small)
    for _ in range(data.draw(st.integers(1, 3))):
        kind, at = data.draw(st.sampled_from("fcdz")), data.draw(st.integers(0, max(0, len(broken) - 1)))
        if kind == "f" and broken:
            broken[at] ^= data.draw(st.integers(1, 255))
        elif kind == "c":
            broken = broken[:at]
        elif kind == "d":
            del broken[at : at + data.draw(st.integers(1, 100))]
        else:
            broken[at:at] = bytes(data.draw(st.integers(1, 100)))
    path = tmp_path / "log00"
    path.write_bytes(broken)
    log = None
    with contextlib.suppress(CfbError):
        log = read_log(path, format="usd_card")
    assert log is None or broken == small or log.metadata["warnings"]


@pytest.mark.parametrize(
    ("field", "unit", "logged", "si"),
    [
        ("position", "mm", 250.0, 0.25),
        ("velocity", "cm/s", 250.0, 2.5),
        ("body_rate", "deg/s", 180.0, np.pi),
        ("body_rate", "mrad/s", 2500.0, 2.5),
        ("specific_force", "g", 2.0, 19.62),
        ("command", "percent", 40.0, 0.4),
        ("command", "pwm16", 65535.0, 1.0),
        ("rotor_speed", "rpm", 60.0, 2 * np.pi),
        # 12 poles are 6 pairs.
        ("rotor_speed", "erpm", 360.0, 2 * np.pi),
        ("battery_voltage", "mV", 3700.0, 3.7),
    ],
)
def test_units_of_mappings_by_hand(field, unit, logged, si):
    assert logged * UNITS[field][unit] == pytest.approx(si, rel=1e-12)
