"""MCAP files of others: JSON and protobuf messages, by the fields of common schemas and by names of one's own."""

import numpy as np
import pytest
from foreign_logs import json_channels, stamp, write_channels, wxyz, xyz
from google.protobuf import descriptor_pb2
from synthetic_logs import make_flight

from cfb_mjx.errors import CfbError
from cfb_mjx.logs import FORMATS, mcap_schema, read_log, write_mcap
from cfb_mjx.logs.proposal import UnknownNames


@pytest.fixture(scope="module")
def flight():
    return make_flight(duration=4.0, rate=200.0)


def motors_class():
    """A message of a lab's own: ``repeated float pwm``, ``double vbat``."""
    file = descriptor_pb2.FileDescriptorProto(name="lab/motors.proto", package="lab", syntax="proto3")
    message = file.message_type.add(name="Motors")
    message.field.add(name="pwm", number=1, label=3, type=2, json_name="pwm")
    message.field.add(name="vbat", number=2, label=1, type=1, json_name="vbat")
    described = descriptor_pb2.FileDescriptorSet(file=[file]).SerializeToString()
    return described, mcap_schema.message_class("lab.Motors", described)


def same(log, flight, fields=("position", "velocity", "quaternion", "body_rate", "specific_force")):
    rows = np.searchsorted(flight.time, log.time - log.time[0] + flight.time[0] - 1e-6)
    assert len(log) > len(flight) - 3
    for field in fields:
        assert np.abs(getattr(log, field) - getattr(flight, field)[rows]).max() < 1e-6, field
    assert np.abs(log.command - flight.command[rows]).max() < 1e-4


@pytest.mark.parametrize("transform", [False, True])
def test_common_schemas_in_json(flight, tmp_path, transform):
    path = tmp_path / "flight.mcap"
    write_channels(path, json_channels(flight, transform))
    log = read_log(path)
    assert log.metadata["format"] == "foxglove"
    assert "foxglove" in FORMATS
    same(log, flight)


def test_protobuf_with_messages_of_its_own(flight, tmp_path):
    """Poses as Foxglove publishes them, motors in a message that only the file describes."""
    described = mcap_schema.descriptor_set("foxglove.PoseInFrame")
    pose_class = mcap_schema.message_class("foxglove.PoseInFrame", described)

    def pose(row, t):
        now = stamp(t, ("seconds", "nanos"))
        body = {"position": xyz(flight.position[row]), "orientation": wxyz(flight.quaternion[row])}
        return pose_class(timestamp=now, frame_id="world", pose=body).SerializeToString()

    own, motors = motors_class()
    channels = json_channels(flight) | {
        "/cf1/pose": (
            "foxglove.PoseInFrame",
            "protobuf",
            described,
            [(t, pose(row, t)) for row, t in enumerate(flight.time)],
        ),
        "/cf1/log": (
            "lab.Motors",
            "protobuf",
            own,
            [
                (t, motors(pwm=u, vbat=3.9).SerializeToString())
                for t, u in zip(flight.time, flight.command, strict=True)
            ],
        ),
    }
    path = tmp_path / "flight.mcap"
    write_channels(path, channels)
    with pytest.raises(UnknownNames, match=r"position, .*command") as error:
        read_log(path)
    mapping = tmp_path / "mine.yaml"
    mapping.write_text(error.value.mapping)
    log = read_log(path, mapping=mapping)
    same(log, flight)
    assert log.battery_voltage[0] == pytest.approx(3.9)
    assert any("messages without a time of their own" in note for note in log.metadata["notes"])


def test_late_recording_does_not_move_stamped_messages(flight, tmp_path):
    path = tmp_path / "flight.mcap"
    write_channels(path, json_channels(flight), late=0.3)
    same(read_log(path), flight)


def test_two_poses_are_not_guessed_between(flight, tmp_path):
    channels = json_channels(flight)
    channels["/target/pose"] = channels["/cf1/pose"]
    path = tmp_path / "flight.mcap"
    write_channels(path, channels)
    with pytest.raises(CfbError, match=r"/cf1/pose and /target/pose both hold pose\.x; say which .* --mapping FILE"):
        read_log(path)


def test_what_is_missing_is_named(flight, tmp_path):
    channels = json_channels(flight)
    del channels["/cf1/log"]
    path = tmp_path / "flight.mcap"
    write_channels(path, channels)
    with pytest.raises(CfbError, match="no logged variables for command"):
        read_log(path)


def test_damage_is_named_and_what_is_whole_is_kept(flight, tmp_path):
    path = tmp_path / "flight.mcap"
    write_channels(path, json_channels(flight))
    data = path.read_bytes()
    path.write_bytes(data[:60])
    with pytest.raises(CfbError, match="MCAP"):
        read_log(path)
    spoiled = bytearray(data)
    spoiled[len(data) // 3] ^= 0xFF
    path.write_bytes(bytes(spoiled))
    with pytest.raises(CfbError, match="damaged"):
        read_log(path)


def test_own_files_stay_own(flight, tmp_path):
    path = tmp_path / "own.mcap"
    write_mcap(flight, path)
    assert read_log(path).metadata["format"] == "mcap"


def test_channels_without_a_schema(flight, tmp_path):
    """``Channel(topic, message_encoding="json")`` of Foxglove's own library has none."""
    path = tmp_path / "flight.mcap"
    write_channels(path, json_channels(flight), described=False)
    same(read_log(path), flight)
