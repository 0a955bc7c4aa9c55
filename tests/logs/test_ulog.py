"""PX4's logs: axes with z down become z up, motors come into order, damage is named."""

import foreign_logs as foreign
import numpy as np
import pytest
from synthetic_logs import make_flight

from cfb_mjx.errors import CfbError
from cfb_mjx.logs import read_log


@pytest.fixture(scope="module")
def flight():
    return make_flight(duration=2.0, rate=200.0)


def test_a_flight_of_px4(flight, tmp_path):
    path = tmp_path / "flight.ulg"
    path.write_bytes(foreign.ulog(flight))
    log = read_log(path)
    assert log.metadata["format"] == "ulog"
    assert np.abs(log.time - flight.time).max() < 1e-6
    for field in ("position", "velocity", "quaternion", "body_rate", "specific_force", "command"):
        assert np.abs(getattr(log, field) - getattr(flight, field)).max() < 1e-5, field


def test_what_holds_no_flight(flight, tmp_path):
    path = tmp_path / "flight.ulg"
    path.write_bytes(foreign.ulog(flight, ("vehicle_attitude", "battery_status")))
    with pytest.raises(CfbError, match="the PX4 ULog: no logged variables for position"):
        read_log(path)
    path.write_bytes(b"ULog\x01\x12\x35\x01" + bytes(30))
    with pytest.raises(CfbError, match="PX4 ULog"):
        read_log(path)


def test_a_log_that_was_cut_is_read_up_to_its_end(flight, tmp_path):
    path = tmp_path / "flight.ulg"
    whole = foreign.ulog(flight)
    path.write_bytes(whole[: len(whole) * 6 // 10])
    assert 0.4 * len(flight) < len(read_log(path)) < len(flight)


def test_descriptions_alone_are_not_damage(flight, tmp_path):
    path = tmp_path / "flight.ulg"
    path.write_bytes(b"ULog\x01\x12\x35\x01" + bytes(8) + (40).to_bytes(2, "little") + b"B" + bytes(40))
    with pytest.raises(CfbError, match="the PX4 ULog holds no data"):
        read_log(path)
