"""MCAP files of others: JSON and protobuf messages, by the fields of common schemas and by names of one's own."""

import json

import numpy as np
import pytest
from google.protobuf import descriptor_pb2
from mcap.writer import Writer
from synthetic_logs import make_flight

from cfb_mjx.errors import CfbError
from cfb_mjx.logs import FORMATS, mcap_schema, read_log, write_mcap
from cfb_mjx.logs.proposal import UnknownNames

START = 1_772_419_726_250_000_000


@pytest.fixture(scope="module")
def flight():
    return make_flight(duration=4.0, rate=200.0)


def xyz(v):
    return dict(zip("xyz", map(float, v), strict=True))


def wxyz(q):
    return dict(zip("wxyz", map(float, q), strict=True))


def stamp(t, names=("sec", "nsec")):
    now = START + round(t * 1e9)
    return dict(zip(names, divmod(now, 1_000_000_000), strict=True))


def motors_class():
    """A message of a lab's own: ``repeated float pwm``, ``double vbat``."""
    file = descriptor_pb2.FileDescriptorProto(name="lab/motors.proto", package="lab", syntax="proto3")
    message = file.message_type.add(name="Motors")
    message.field.add(name="pwm", number=1, label=3, type=2, json_name="pwm")
    message.field.add(name="vbat", number=2, label=1, type=1, json_name="vbat")
    described = descriptor_pb2.FileDescriptorSet(file=[file]).SerializeToString()
    return described, mcap_schema.message_class("lab.Motors", described)


def write(path, channels, late=0.0):
    """``channels``: topic to (schema name, encoding, description, payloads by time)."""
    with open(path, "wb") as file:
        writer = Writer(file)
        writer.start(profile="", library="a lab's recorder")
        for topic, (name, encoding, described, payloads) in channels.items():
            kind = "jsonschema" if encoding == "json" else "protobuf"
            schema = writer.register_schema(name=name, encoding=kind, data=described)
            channel = writer.register_channel(topic=topic, message_encoding=encoding, schema_id=schema)
            for t, data in payloads:
                writer.add_message(channel, log_time=START + round((t + late) * 1e9), data=data, publish_time=0)
        writer.finish()


def as_json(log, make):
    return [(t, json.dumps(make(row, t)).encode()) for row, t in enumerate(log.time)]


def common(log, transform=False, motors="motor"):
    def pose(row, t):
        return {
            "timestamp": stamp(t),
            "frame_id": "world",
            "pose": {"position": xyz(log.position[row]), "orientation": wxyz(log.quaternion[row])},
        }

    def placed(row, t):
        inner = {"translation": xyz(log.position[row]), "rotation": wxyz(log.quaternion[row])}
        return {"timestamp": stamp(t), "parent_frame_id": "world", "child_frame_id": "cf", "transform": inner}

    def imu(row, t):
        return {
            "header": {"stamp": stamp(t, ("sec", "nanosec")), "frame_id": "cf"},
            "angular_velocity": xyz(log.body_rate[row]),
            "linear_acceleration": xyz(log.specific_force[row]),
        }

    named = lambda row, t: {  # noqa: E731
        "timestamp": stamp(t), motors: {f"m{i}": float(round(65535 * u)) for i, u in enumerate(log.command[row], 1)}
    }  # fmt: skip
    velocity = lambda row, t: {"timestamp": stamp(t), "velocity": xyz(log.velocity[row])}  # noqa: E731
    place = ("FrameTransform", placed) if transform else ("foxglove.PoseInFrame", pose)
    return {
        "/tf" if transform else "/cf1/pose": (place[0], "json", b"{}", as_json(log, place[1])),
        "/cf1/imu": ("Imu", "json", b"{}", as_json(log, imu)),
        "/cf1/velocity": ("Twist", "json", b"{}", as_json(log, velocity)),
        "/cf1/log": ("Log", "json", b"{}", as_json(log, named)),
    }


def same(log, flight, fields=("position", "velocity", "quaternion", "body_rate", "specific_force")):
    rows = np.searchsorted(flight.time, log.time - log.time[0] + flight.time[0] - 1e-6)
    assert len(log) > len(flight) - 3
    for field in fields:
        assert np.abs(getattr(log, field) - getattr(flight, field)[rows]).max() < 1e-6, field
    assert np.abs(log.command - flight.command[rows]).max() < 1e-4


@pytest.mark.parametrize("transform", [False, True])
def test_common_schemas_in_json(flight, tmp_path, transform):
    path = tmp_path / "flight.mcap"
    write(path, common(flight, transform))
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
    channels = common(flight) | {
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
    write(path, channels)
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
    write(path, common(flight), late=0.3)
    same(read_log(path), flight)


def test_two_poses_are_not_guessed_between(flight, tmp_path):
    channels = common(flight)
    channels["/target/pose"] = channels["/cf1/pose"]
    path = tmp_path / "flight.mcap"
    write(path, channels)
    with pytest.raises(CfbError, match=r"/cf1/pose and /target/pose both hold pose\.x; say which .* --mapping FILE"):
        read_log(path)


def test_what_is_missing_is_named(flight, tmp_path):
    channels = common(flight)
    del channels["/cf1/log"]
    path = tmp_path / "flight.mcap"
    write(path, channels)
    with pytest.raises(CfbError, match="no logged variables for command"):
        read_log(path)


def test_damage_is_named_and_what_is_whole_is_kept(flight, tmp_path):
    path = tmp_path / "flight.mcap"
    write(path, common(flight))
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
