"""Topics of a flight log in MCAP and their protobuf messages, defined in code (no generated files).

The pose uses Foxglove's published message, with the field names and numbers of
https://github.com/foxglove/foxglove-sdk (schemas/proto/foxglove), so that Foxglove and rerun draw it. The other topics
have one small message each.
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

METADATA_RECORD = "cfb_mjx.flight_log"
FORMAT_VERSION = "1"
CONVENTIONS = (
    "SI units. World: z up. Body: x forward, y left, z up. Pose: body to world. body_rate and specific_force in body "
    "axes, velocity in world axes. Motors m1 front-right, m2 back-right, m3 back-left, m4 front-left. "
    "command in [0, 1]; rotor_speed in rad/s, NaN where invalid. timestamp: the row's time."
)


class Topic(NamedTuple):
    """One channel: its topic, protobuf message, the `FlightLog` field it carries and the message's number fields."""

    topic: str
    message: str
    field: str
    columns: tuple[str, ...]
    frame: str | None


_XYZ, _MOTORS = ("x", "y", "z"), ("m1", "m2", "m3", "m4")
POSE = "/pose"  # the only topic with two fields: position and quaternion
TOPICS = (
    Topic("/velocity", "cfb_mjx.Velocity", "velocity", _XYZ, "world"),
    Topic("/body_rate", "cfb_mjx.BodyRate", "body_rate", _XYZ, "body"),
    Topic("/specific_force", "cfb_mjx.SpecificForce", "specific_force", _XYZ, "body"),
    Topic("/command", "cfb_mjx.Command", "command", _MOTORS, None),
    Topic("/rotor_speed", "cfb_mjx.RotorSpeed", "rotor_speed", _MOTORS, None),
    Topic("/battery", "cfb_mjx.Battery", "battery_voltage", ("voltage",), None),
)
MESSAGES = {POSE: "foxglove.PoseInFrame"} | {t.topic: t.message for t in TOPICS}

_TIMESTAMP = "google.protobuf.Timestamp"
_FILES = {
    "google/protobuf/timestamp.proto": (_TIMESTAMP, [("seconds", "int64"), ("nanos", "int32")]),
    "foxglove/Vector3.proto": ("foxglove.Vector3", [(c, "double") for c in "xyz"]),
    "foxglove/Quaternion.proto": ("foxglove.Quaternion", [(c, "double") for c in "xyzw"]),
    "foxglove/Pose.proto": (
        "foxglove.Pose",
        [("position", "foxglove.Vector3"), ("orientation", "foxglove.Quaternion")],
    ),
    "foxglove/PoseInFrame.proto": (
        "foxglove.PoseInFrame",
        [("timestamp", _TIMESTAMP), ("frame_id", "string"), ("pose", "foxglove.Pose")],
    ),
} | {
    f"{t.message.replace('.', '/')}.proto": (
        t.message,
        # The frame is part of the message because MCAP viewers show messages, not documentation.
        [
            ("timestamp", _TIMESTAMP),
            *((c, "double") for c in t.columns),
            *([("frame_id", "string")] if t.frame else []),
        ],
    )
    for t in TOPICS
}


@functools.cache
def descriptor_set(message: str) -> bytes:
    """Serialised FileDescriptorSet of a message and everything it refers to, dependencies first."""
    from google.protobuf import descriptor_pb2

    home = {name: path for path, (name, _) in _FILES.items()}
    result = descriptor_pb2.FileDescriptorSet()
    done = set()

    def add(name: str):
        path = home[name]
        if path in done:
            return
        done.add(path)
        package, _, short = name.rpartition(".")
        file = descriptor_pb2.FileDescriptorProto(name=path, package=package, syntax="proto3")
        definition = file.message_type.add(name=short)
        for number, (field, kind) in enumerate(_FILES[path][1], start=1):
            entry = definition.field.add(name=field, number=number, label=1, json_name=field)
            if kind in home:
                add(kind)
                entry.type, entry.type_name = entry.TYPE_MESSAGE, f".{kind}"
                if home[kind] not in file.dependency:
                    file.dependency.append(home[kind])
            else:
                entry.type = getattr(entry, f"TYPE_{kind.upper()}")
        result.file.append(file)

    add(message)
    return result.SerializeToString(deterministic=True)


@functools.lru_cache(maxsize=16)
def message_class(name: str, descriptors: bytes) -> type[Any]:
    """The Python class of a message from a serialised FileDescriptorSet, in a separate descriptor pool.

    For damaged or incomplete descriptors, protobuf raises errors of several types; the reader turns them into a
    `CfbError`.
    """
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

    pool = descriptor_pool.DescriptorPool()
    for file in descriptor_pb2.FileDescriptorSet.FromString(descriptors).file:
        pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(name))
