"""PX4's logs: axes with z down become z up, motors come into order, damage is named."""

import struct

import numpy as np
import pytest
from synthetic_logs import make_flight

from cfb_mjx.errors import CfbError
from cfb_mjx.logs import read_log

TOPICS = {
    "vehicle_local_position": "uint64_t timestamp;float x;float y;float z;float vx;float vy;float vz;",
    "vehicle_attitude": "uint64_t timestamp;float[4] q;",
    "sensor_combined": "uint64_t timestamp;float[3] gyro_rad;float[3] accelerometer_m_s2;",
    "actuator_motors": "uint64_t timestamp;float[4] control;",
    "battery_status": "uint64_t timestamp;float voltage_v;",
}
DOWN = np.array([1.0, -1.0, -1.0])


@pytest.fixture(scope="module")
def flight():
    return make_flight(duration=2.0, rate=200.0)


def message(kind, body):
    return struct.pack("<HB", len(body), ord(kind)) + body


def ulog(log, topics=tuple(TOPICS)):
    """The flight as PX4 writes it: north east down, forward right down, its own motor order."""
    values = {
        "vehicle_local_position": np.concatenate([log.position * DOWN, log.velocity * DOWN], axis=1),
        "vehicle_attitude": log.quaternion * [1, 1, -1, -1],
        "sensor_combined": np.concatenate([log.body_rate * DOWN, log.specific_force * DOWN], axis=1),
        "actuator_motors": log.command[:, [0, 2, 3, 1]],
        "battery_status": log.battery_voltage[:, None],
    }
    data = b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0) + message("B", bytes(40))
    data += b"".join(message("F", f"{name}:{TOPICS[name]}".encode()) for name in topics)
    data += b"".join(message("A", struct.pack("<BH", 0, i) + name.encode()) for i, name in enumerate(topics))
    for row, time in enumerate(log.time):
        for i, name in enumerate(topics):
            numbers = values[name][row].astype("<f4").tobytes()
            data += message("D", struct.pack("<HQ", i, round(1e6 * (5 + time))) + numbers)
    return data


def test_a_flight_of_px4(flight, tmp_path):
    path = tmp_path / "flight.ulg"
    path.write_bytes(ulog(flight))
    log = read_log(path)
    assert log.metadata["format"] == "ulog"
    assert np.abs(log.time - flight.time).max() < 1e-6
    for field in ("position", "velocity", "quaternion", "body_rate", "specific_force", "command"):
        assert np.abs(getattr(log, field) - getattr(flight, field)).max() < 1e-5, field


def test_what_holds_no_flight(flight, tmp_path):
    path = tmp_path / "flight.ulg"
    path.write_bytes(ulog(flight, ("vehicle_attitude", "battery_status")))
    with pytest.raises(CfbError, match="the PX4 ULog: no logged variables for position"):
        read_log(path)
    path.write_bytes(b"ULog\x01\x12\x35\x01" + bytes(30))
    with pytest.raises(CfbError, match="PX4 ULog"):
        read_log(path)


def test_a_log_that_was_cut_is_read_up_to_its_end(flight, tmp_path):
    path = tmp_path / "flight.ulg"
    whole = ulog(flight)
    path.write_bytes(whole[: len(whole) * 6 // 10])
    assert 0.4 * len(flight) < len(read_log(path)) < len(flight)
