"""Write a flight log as MCAP: self-describing protobuf channels that Foxglove, rerun and this library can read."""

from __future__ import annotations

import json
import os
from pathlib import Path

from cfb_mjx.files import replacing
from cfb_mjx.logs import mcap_schema
from cfb_mjx.logs.flight_log import FlightLog, to_nanoseconds


def write_mcap(log: FlightLog, path: str | os.PathLike) -> None:
    """Write a log as MCAP: chunked, zstd-compressed, with checksums. Values survive bit for bit, times to 1 ns.

    Args:
        log: the flight. ``rotor_speed`` and ``battery_voltage`` are written only if they were measured.
        path: the file. An existing file is replaced only when the new one is complete.

    Raises:
        CfbError: the folder is missing or the file cannot be written.
    """
    from mcap.writer import CompressionType, Writer

    path = Path(path)
    with replacing(path) as temporary, open(temporary, "wb") as stream:
        writer = Writer(stream, compression=CompressionType.ZSTD, enable_data_crcs=True)
        writer.start(profile="", library="cfb_mjx")
        writer.add_metadata(
            mcap_schema.METADATA_RECORD,
            {
                "format_version": mcap_schema.FORMAT_VERSION,
                "conventions": mcap_schema.CONVENTIONS,
                "metadata": json.dumps(dict(log.metadata), allow_nan=False),
            },
        )
        _write_messages(writer, log)
        writer.finish()


def _write_messages(writer, log: FlightLog) -> None:
    seconds, nanos = (a.tolist() for a in to_nanoseconds(log.time))
    # MCAP's log time is unsigned, so it is shifted for a log that starts before zero. Messages keep their time stamps.
    shift = -min(seconds[0], 0) if seconds else 0
    channels = [_pose_channel(writer, log)]
    channels += [_channel(writer, t, log) for t in mcap_schema.TOPICS if getattr(log, t.field) is not None]
    for row, (second, nano) in enumerate(zip(seconds, nanos, strict=True)):
        stamp = (second + shift) * 1_000_000_000 + nano
        for channel, message, fill in channels:
            message.timestamp.seconds, message.timestamp.nanos = second, nano
            fill(row)
            writer.add_message(
                channel, log_time=stamp, publish_time=stamp, data=message.SerializeToString(), sequence=row
            )


def _register(writer, topic: str):
    name = mcap_schema.MESSAGES[topic]
    descriptors = mcap_schema.descriptor_set(name)
    schema = writer.register_schema(name=name, encoding="protobuf", data=descriptors)
    channel = writer.register_channel(topic=topic, message_encoding="protobuf", schema_id=schema)
    return channel, mcap_schema.message_class(name, descriptors)()


def _pose_channel(writer, log: FlightLog):
    channel, message = _register(writer, mcap_schema.POSE)
    message.frame_id = "world"
    position, orientation = message.pose.position, message.pose.orientation
    positions, quaternions = log.position.tolist(), log.quaternion.tolist()

    def fill(row: int) -> None:
        position.x, position.y, position.z = positions[row]
        orientation.w, orientation.x, orientation.y, orientation.z = quaternions[row]

    return channel, message, fill


def _channel(writer, topic: mcap_schema.Topic, log: FlightLog):
    channel, message = _register(writer, topic.topic)
    if topic.frame:
        message.frame_id = topic.frame
    rows = getattr(log, topic.field).reshape(len(log), len(topic.columns)).tolist()

    def fill(row: int) -> None:
        for column, value in zip(topic.columns, rows[row], strict=True):
            setattr(message, column, value)

    return channel, message, fill
