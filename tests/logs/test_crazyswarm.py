import contextlib

import foreign_logs as foreign
import numpy as np
import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from synthetic_logs import make_flight

from cfb_mjx.errors import CfbError
from cfb_mjx.logs import FORMATS, read_crazyswarm, read_log, write_mcap

IMU, MOTOR = list(foreign.IMU), list(foreign.MOTOR)
STATE = list(foreign.STATE)
TOPICS = {"imu": IMU, "motors": MOTOR, "state": STATE}


@pytest.fixture(scope="module")
def flight():
    return make_flight(duration=6.0, rate=100.0)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "bag_0.mcap"


@pytest.fixture
def topics(tmp_path):
    file = tmp_path / "crazyflies.yaml"
    foreign.write_crazyflies_yaml(file, TOPICS)
    return file


def whole_bag(flight, robot="cf231", **options):
    bag = foreign.Bag(**options)
    for name, variables in TOPICS.items():
        bag.custom(f"/{robot}/{name}", flight, variables)
    bag.status(f"/{robot}/status", flight, every=50)
    return bag


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    folder = tmp_path_factory.mktemp("bag")
    flight = make_flight(duration=0.3, rate=100.0)
    bag = foreign.Bag()
    bag.custom("/cf231/imu", flight, IMU + MOTOR)
    bag.pose("/cf231/pose", flight)
    bag.write(folder / "small.mcap")
    foreign.write_crazyflies_yaml(folder / "crazyflies.yaml", {"imu": IMU + MOTOR})
    return (folder / "small.mcap").read_bytes(), folder / "crazyflies.yaml"


def test_round_trip_of_custom_topics(flight, path, topics):
    whole_bag(flight).write(path)
    log = read_log(path, topics_yaml=topics)
    assert "crazyswarm" in FORMATS
    assert np.abs(log.time - flight.time).max() < 1e-9
    for field in ("position", "velocity", "quaternion", "body_rate", "specific_force", "command"):
        assert np.abs(getattr(log, field) - getattr(flight, field)).max() < 2e-6, field
    assert np.abs(log.battery_voltage - flight.battery_voltage).max() < 0.011  # every 0.5 s, falling by 0.02 V/s
    assert log.metadata["format"] == "crazyswarm"
    assert log.metadata["robot"] == "cf231"
    assert log.metadata["clock"]["of"] == "firmware"
    assert log.metadata["merging"]["time_of_first_row"] == 100.0
    assert log.metadata["warnings"] == []


def test_poses_are_brought_onto_the_firmware_clock(path, tmp_path):
    """Packets take 4 to 9 ms and the computer's clock runs 200 ppm fast; the pose lands within 2 ms of its row."""
    flight = make_flight(duration=24.0, rate=50.0, excitation=0.2)
    late = np.random.default_rng(1).uniform(0.004, 0.009, len(flight)) + 200e-6 * flight.time
    bag = foreign.Bag()
    bag.custom("/cf231/imu", flight, IMU + MOTOR, late=lambda k: late[k])
    bag.pose("/cf231/pose", flight, late=lambda k: 0.004 + 200e-6 * flight.time[k])
    bag.write(path)
    foreign.write_crazyflies_yaml(tmp_path / "crazyflies.yaml", {"imu": IMU + MOTOR})
    log = read_log(path, topics_yaml=tmp_path / "crazyflies.yaml")
    assert log.metadata["clock"]["drift_ppm"] == pytest.approx(200, abs=30)
    assert log.metadata["clock"]["scatter_ms"] < 1.0
    assert 1.0 < log.metadata["clock"]["median_lateness_ms"] < 4.0
    assert log.metadata["merging"]["held"]["pose"]["mean_age_ms"] < 1.0
    same = np.searchsorted(flight.time, log.time + flight.time[-1] - log.time[-1] - 1e-6)
    assert np.abs(log.quaternion - flight.quaternion[same]).max() < 1e-9
    assert log.metadata["variables"]["velocity"] == {"derived": "position"}
    assert np.abs(log.velocity[2:-2] - flight.velocity[same][2:-2]).max() < 0.03


def test_24_bit_overflow_between_topics(flight, path, topics):
    """One topic starts before the firmware's stamp overflows, the other after it."""
    bag = foreign.Bag(boot=2**24 / 1000 - 1.0)
    bag.custom("/cf231/imu", flight, IMU)
    bag.custom("/cf231/motors", flight, MOTOR)
    bag.custom("/cf231/state", flight.slice(2.0, 9.0), STATE)
    bag.write(path)
    log = read_log(path, topics_yaml=topics)
    truth = flight.slice(2.0, 9.0)
    assert np.abs(log.time - (truth.time - 2.0)).max() < 1e-6
    assert np.abs(log.position - truth.position).max() < 2e-6
    assert np.abs(log.body_rate - truth.body_rate).max() < 2e-6


def test_without_firmware_time_stamps(flight, path, topics):
    bag = foreign.Bag()
    for name, variables in TOPICS.items():
        bag.custom(f"/cf231/{name}", flight, variables, stamped=False)
    bag.write(path)
    log = read_log(path, topics_yaml=topics)
    assert log.metadata["clock"] == {"of": "computer"}
    assert any("no topic has firmware time stamps" in note for note in log.metadata["notes"])
    assert np.abs(log.time - flight.time).max() < 1e-6


def test_computer_clock_that_was_set_is_flagged(path, tmp_path):
    flight = make_flight(duration=24.0, rate=50.0, excitation=0.2)
    bag = foreign.Bag()
    bag.custom("/cf231/imu", flight, IMU + MOTOR, late=lambda k: 0.004 + 0.3 * (flight.time[k] > 12.0))
    bag.pose("/cf231/pose", flight, late=lambda k: 0.004 + 0.3 * (flight.time[k] > 12.0))
    bag.write(path)
    foreign.write_crazyflies_yaml(tmp_path / "crazyflies.yaml", {"imu": IMU + MOTOR})
    log = read_log(path, topics_yaml=tmp_path / "crazyflies.yaml")
    assert "clock wandered" in log.metadata["warnings"][0]


def test_odometry_is_read_with_its_peculiarities(flight, path, topics):
    bag = foreign.Bag()
    bag.odometry("/cf231/odom", flight)
    bag.custom("/cf231/imu", flight, IMU)
    bag.custom("/cf231/motors", flight, MOTOR)
    bag.write(path)
    log = read_log(path, topics_yaml=topics)
    assert np.abs(log.velocity - flight.velocity).max() < 1e-6  # from body axes
    assert log.metadata["warnings"][0].startswith("position, velocity, quaternion come from Odometry")
    assert log.metadata["variables"]["velocity"]["frame"] == "body"


def test_compressed_quaternion_needs_doubles(flight, path, tmp_path):
    variables = list(foreign.STATE_Z)
    file = tmp_path / "crazyflies.yaml"
    foreign.write_crazyflies_yaml(file, {"z": variables, "motors": MOTOR})
    for doubles in (True, False):
        bag = foreign.Bag(doubles=doubles)
        bag.custom("/cf231/z", flight, variables)
        bag.custom("/cf231/motors", flight, MOTOR)
        bag.write(path)
        if doubles:
            assert np.abs(read_log(path, topics_yaml=file).quaternion - flight.quaternion).max() < 1.3e-3
        else:
            with pytest.raises(CfbError, match=r"quaternion \(missing .*stateEstimateZ.quat was sent as float32"):
                read_log(path, topics_yaml=file)


def test_several_robots(flight, path, topics):
    bag = whole_bag(flight)
    bag.pose("/cf5/pose", flight.replace(position=flight.position + 1.0))
    bag.write(path)
    with pytest.raises(CfbError, match=r"several robots \(found: cf231, cf5\); choose one with --robot NAME"):
        read_log(path, topics_yaml=topics)
    with pytest.raises(CfbError, match="no robot 'cf7' in the bag; its robots are cf231, cf5"):
        read_log(path, topics_yaml=topics, robot="cf7")
    log = read_log(path, topics_yaml=topics, robot="/cf231")
    assert np.abs(log.position - flight.position).max() < 2e-6


def test_topics_yaml_missing_or_wrong(flight, path, topics, tmp_path):
    whole_bag(flight).write(path)
    with pytest.raises(CfbError, match=r"no logged variables for .* crazyflies.yaml \(--topics-yaml FILE\)"):
        read_log(path)
    document = yaml.safe_load(topics.read_text())
    document["robots"]["cf231"]["firmware_logging"]["custom_topics"]["imu"]["vars"].pop()
    wrong = tmp_path / "wrong.yaml"
    wrong.write_text(yaml.safe_dump(document))
    with pytest.raises(CfbError, match="message 0 of imu has 6 values, but the file of --topics-yaml names 5"):
        read_log(path, topics_yaml=wrong)
    document["robots"]["cf231"]["firmware_logging"]["custom_topics"]["imu"]["vars"] = "gyro.x"
    wrong.write_text(yaml.safe_dump(document))
    with pytest.raises(CfbError, match=r"robots.cf231.firmware_logging.custom_topics.imu.vars must list the names"):
        read_log(path, topics_yaml=wrong)
    wrong.write_text("robots: 3\n")
    with pytest.raises(CfbError, match="robots must be a mapping, found int"):
        read_log(path, topics_yaml=wrong)
    with pytest.raises(CfbError, match="there is no such file"):
        read_log(path, topics_yaml=tmp_path / "none.yaml")


def test_a_bag_is_told_from_a_log_of_ours(flight, path, topics, tmp_path):
    whole_bag(flight).write(path)
    log = read_log(path, topics_yaml=topics)
    ours = tmp_path / "ours.mcap"
    write_mcap(log, ours)
    assert read_log(ours).metadata["format"] == "mcap"
    assert read_log(ours).metadata["robot"] == "cf231"
    with pytest.raises(CfbError, match="no pose, odometry or log topic"):
        read_log(ours, format="crazyswarm")


def test_a_bag_without_checksums_says_so(flight, path, topics):
    whole_bag(flight).write(path, enable_crcs=False)
    log = read_log(path, topics_yaml=topics)
    assert any("no checksums" in note for note in log.metadata["notes"])


def test_unreadable_bags(path, tmp_path, small):
    with pytest.raises(CfbError, match="there is no such file"):
        read_crazyswarm(path)
    path.write_bytes(b"")
    with pytest.raises(CfbError, match="this is not a ROS bag"):
        read_crazyswarm(path)
    path.unlink()
    with pytest.raises(CfbError, match=r"holds no \.mcap and no \.db3"):
        read_crazyswarm(tmp_path)
    path.write_bytes(small[0][:60])
    with pytest.raises(CfbError, match="cut short"):
        read_log(path, topics_yaml=small[1])


def test_an_unfinished_bag_is_read_up_to_its_end(flight, path, topics):
    whole_bag(flight).write(path)
    truth = read_log(path, topics_yaml=topics)
    data = path.read_bytes()
    path.write_bytes(data[: len(data) * 6 // 10])
    log = read_log(path, topics_yaml=topics)
    assert 100 < len(log) < len(truth)
    assert np.array_equal(log.body_rate, truth.body_rate[: len(log)])
    assert "MCAP file is cut short" in log.metadata["warnings"][0]


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_no_damage_goes_unnoticed(small, tmp_path, data):
    """Refused, or read with a warning, or what was damaged is not part of the flight and nothing has changed."""
    whole, topics = small
    path = tmp_path / "small.mcap"
    path.write_bytes(whole)
    truth = read_log(path, topics_yaml=topics)
    broken = bytearray(whole)
    for _ in range(data.draw(st.integers(1, 3))):
        at = data.draw(st.integers(0, max(0, len(broken) - 1)))
        match data.draw(st.sampled_from(["flip", "cut", "delete"])):
            case "flip":
                broken[at : at + 1] = data.draw(st.binary(min_size=1, max_size=1))
            case "cut":
                broken = broken[:at]
            case "delete":
                del broken[at : at + data.draw(st.integers(1, 100))]
    path.write_bytes(broken)
    log = None
    with contextlib.suppress(CfbError):
        log = read_log(path, format="crazyswarm", topics_yaml=topics)
    if log is not None and not log.metadata["warnings"]:
        for field in ("time", "position", "quaternion", "body_rate", "specific_force", "command"):
            assert np.array_equal(getattr(log, field), getattr(truth, field)), field
