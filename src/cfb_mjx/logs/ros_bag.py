"""ROS 2 bags stored as MCAP: telling them from other files, decoding the messages that hold a flight."""

from __future__ import annotations

import io
import os
import re
from pathlib import Path
from typing import Any, NamedTuple

from cfb_mjx.errors import CfbError

MAGIC = b"\x89MCAP0\r\n"
GENERIC = "crazyflie_interfaces/LogDataGeneric"
POSE, ODOMETRY, STATUS = "geometry_msgs/PoseStamped", "nav_msgs/Odometry", "crazyflie_interfaces/Status"
_XYZ_QUATERNION = ("x", "y", "z", "qw", "qx", "qy", "qz")
# Message type to the variables made of it; those of a custom log topic come from the crazyflies.yaml.
VARIABLES = {
    GENERIC: (),
    POSE: tuple(f"pose.{c}" for c in _XYZ_QUATERNION),
    ODOMETRY: tuple(f"odom.{c}" for c in (*_XYZ_QUATERNION, "vx", "vy", "vz", "wx", "wy", "wz")),
    STATUS: ("status.battery_voltage",),
}


class BagMessage(NamedTuple):
    """One message: topic, type without ``msg``, time of recording (ns), decoded content, whether values are float32."""

    topic: str
    kind: str
    logged_ns: int
    content: Any
    float32: bool


def recognises(path: str | os.PathLike) -> bool:
    """Whether an MCAP is a ROS 2 bag with messages of the types in `VARIABLES`.

    Its summary says so; an unfinished file has none, there the profile decides.
    """
    with open(path, "rb") as file:
        head = file.read(85)  # magic, record type (1 byte), its length (8), length of the profile (4), profile
        end = file.seek(0, os.SEEK_END)
        file.seek(max(0, end - 28))  # start of the summary (8), of its offsets (8), CRC (4), magic
        footer = file.read()
        summary = b""
        if footer.endswith(MAGIC):
            file.seek(min(int.from_bytes(footer[:8], "little"), end))
            summary = file.read()
    if not footer.endswith(MAGIC):
        return head[21 : 21 + int.from_bytes(head[17:21], "little")] == b"ros2"
    return b"ros2" in summary and any(kind.replace("/", "/msg/").encode() in summary for kind in VARIABLES)


def read_messages(data: bytes, path: Path, warnings: list[str]) -> list[BagMessage]:
    """Messages of the types in `VARIABLES` in file order.

    Raises:
        CfbError: nothing could be read, or a message is encoded otherwise. What is lost after something could be read
            goes into ``warnings``.
    """
    from mcap.records import Channel, Message, Schema
    from mcap.stream_reader import StreamReader
    from mcap_ros2.decoder import DecoderFactory

    factory, schemas, channels, out, foreign = DecoderFactory(), {}, {}, [], set()
    try:
        for item in StreamReader(io.BytesIO(data), validate_crcs=True, record_size_limit=len(data)).records:
            if isinstance(item, Schema):
                schemas[item.id] = item
            elif isinstance(item, Channel):
                channels[item.id] = item
            elif isinstance(item, Message):
                channel = channels[item.channel_id]
                schema = schemas[channel.schema_id]
                kind = schema.name.replace("/msg/", "/")
                if kind not in VARIABLES or channel.topic.count("/") < 2:
                    continue
                decode = factory.decoder_for(channel.message_encoding, schema)
                if decode is None:
                    foreign.add(f"{channel.topic} ({channel.message_encoding}, {schema.encoding})")
                    continue
                single = re.search(rb"float32\[\]\s+values", schema.data) is not None
                out.append(BagMessage(channel.topic, kind, item.log_time, decode(item.data), single))
    except Exception as error:  # the MCAP library lets struct, codec and lookup errors of damaged bytes through
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        kind = "cut short" if not data.endswith(MAGIC) else "damaged"
        if not out:
            raise CfbError(f"{path}: the MCAP file is {kind} ({reason}); copy the bag again.") from None
        warnings.append(f"the MCAP file is {kind} ({reason}); what follows in it was left out.")
    if foreign:
        raise CfbError(
            f"{path}: {', '.join(sorted(foreign))} is not encoded as CDR with ros2msg descriptions, which is what this "
            "library reads; record the bag again with a newer rosbag2 (storage mcap)."
        )
    return out


def lacks_checksums(data: bytes) -> bool:
    """Whether a chunk (record type 6) was written without the CRC of its content, or messages (5) outside chunks."""
    position = len(MAGIC)
    while position + 9 <= len(data):
        kind, length = data[position], int.from_bytes(data[position + 1 : position + 9], "little")
        crc = position + 9 + 24  # after two times and the uncompressed size
        if kind == 5 or (kind == 6 and not any(data[crc : crc + 4])):
            return True
        position += 9 + length
    return False
