"""ROS bags: recognise them, and decode the messages that hold a flight.

MCAP, the storage of ROS 2 since Iron, is read with its checksums. Bags in sqlite3 (Humble and before) and ROS 1 bags
have no checksums; they are read with the library `rosbags <https://gitlab.com/ternaris/rosbags>`_.
"""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Any, NamedTuple, cast

from cfb_mjx.errors import CfbError
from cfb_mjx.files import read_bytes, scratch
from cfb_mjx.logs import mcap_stream
from cfb_mjx.logs.mcap_stream import MAGIC

SQLITE, ROS1 = b"SQLite format 3\0", b"#ROSBAG V2.0"
_LOG_DATA = "std_msgs/Header header\nuint32 timestamp\nfloat{}[] values\n"
"""Definition of Crazyswarm2's own message, because bags in sqlite3 do not describe their messages."""

GENERIC = "crazyflie_interfaces/LogDataGeneric"
GENERIC_1 = "crazyflie_driver/GenericLogData"
"""Message of Crazyswarm 1, which has no firmware time stamp."""
POSE, ODOMETRY, STATUS = "geometry_msgs/PoseStamped", "nav_msgs/Odometry", "crazyflie_interfaces/Status"
IMU = "sensor_msgs/Imu"
_XYZ_QUATERNION = ("x", "y", "z", "qw", "qx", "qy", "qz")
# Message type to the variables read from it; those of a custom log topic come from the crazyflies.yaml.
VARIABLES = {
    GENERIC: (),
    GENERIC_1: (),
    POSE: tuple(f"pose.{c}" for c in _XYZ_QUATERNION),
    ODOMETRY: tuple(f"odom.{c}" for c in (*_XYZ_QUATERNION, "vx", "vy", "vz", "wx", "wy", "wz")),
    STATUS: ("status.battery_voltage",),
    IMU: tuple(f"imu.{c}" for c in ("wx", "wy", "wz", "ax", "ay", "az")),
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

    This is taken from the summary; for an unfinished file, which has none, from the profile.
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
        return _profile(head) == b"ros2"
    # An IMU alone does not identify a bag of Crazyswarm.
    kinds = [kind.replace("/", "/msg/").encode() for kind in VARIABLES if kind != IMU]
    if b"ros2" in summary and any(kind in summary for kind in kinds):
        return True
    # In a file that lost a part, the stored position of the summary is wrong, so search the whole file.
    return _profile(head) == b"ros2" and any(kind in data for data in [read_bytes(path)] for kind in kinds)


def _profile(head: bytes) -> bytes:
    return head[21 : 21 + int.from_bytes(head[17:21], "little")]


def read_messages(data: bytes, path: Path, warnings: list[str]) -> list[BagMessage]:
    """Messages of the types in `VARIABLES`, in file order.

    Args:
        data: content of the file.
        path: the file, for messages.
        warnings: receives what could not be read after the first message.

    Raises:
        CfbError: nothing could be read, or a message has another encoding.
    """
    from mcap_ros2.decoder import DecoderFactory

    factory, foreign = DecoderFactory(), set()

    def decoder_of(channel, schema):
        if schema is None or schema.name.replace("/msg/", "/") not in VARIABLES or channel.topic.count("/") < 2:
            return None
        decode = factory.decoder_for(channel.message_encoding, schema)
        if decode is None:
            foreign.add(f"{channel.topic} ({channel.message_encoding}, {schema.encoding})")
        return decode

    out = [
        BagMessage(
            m.channel.topic,
            m.schema.name.replace("/msg/", "/"),
            m.logged_ns,
            m.content,
            re.search(rb"float32\[\]\s+values", m.schema.data) is not None,
        )
        for m in mcap_stream.messages(data, path, warnings, decoder_of)
    ]
    if foreign:
        raise CfbError(
            f"{path}: {', '.join(sorted(foreign))} is not encoded as CDR with ros2msg descriptions, the only encoding "
            "that this library reads; record the bag again with a newer rosbag2 (storage mcap)."
        )
    return out


class Bag(NamedTuple):
    """Messages of a bag, its storage format in words, and whether checksums cover its values."""

    messages: list[BagMessage]
    storage: str
    checked: bool


def read_bag(path: Path, warnings: list[str]) -> Bag:
    """Messages of the types in `VARIABLES`, of a file or of the folder of a ROS 2 bag.

    Args:
        path: the file or folder.
        warnings: receives what could not be read after the first message.

    Raises:
        CfbError: nothing could be read.
    """
    if path.is_dir():
        return _read_folder(path, warnings)
    head = read_bytes(path, 16)
    if head.startswith(MAGIC):
        data = read_bytes(path)
        return Bag(read_messages(data, path, warnings), "a ROS 2 bag (MCAP)", not mcap_stream.lacks_checksums(data))
    if head.startswith(SQLITE):
        return Bag(_by_rosbags(path, ".db3", warnings), "a ROS 2 bag in sqlite3 storage", False)
    if head.startswith(ROS1):
        return Bag(_by_rosbags(path, ".bag", warnings), "a ROS 1 bag", False)
    raise CfbError(f"{path}: this is not a ROS bag; give the .mcap, .db3 or .bag, or the folder of a ROS 2 bag.")


def _read_folder(path: Path, warnings: list[str]) -> Bag:
    files = sorted(f for f in path.iterdir() if f.suffix in (".mcap", ".db3"))
    if not files:
        packed = ", ".join(sorted(f.name for f in path.iterdir() if f.suffix == ".zstd"))
        way = f"unpack {packed} with unzstd" if packed else "give the folder that the recorder wrote"
        raise CfbError(f"{path}: this folder of a ROS 2 bag holds no .mcap and no .db3; {way}.")
    bags = [read_bag(file, warnings) for file in files]
    return Bag([m for bag in bags for m in bag.messages], bags[0].storage, all(bag.checked for bag in bags))


def _by_rosbags(path: Path, suffix: str, warnings: list[str]) -> list[BagMessage]:
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    kind = "crazyflie_interfaces/msg/LogDataGeneric"
    stores = {}
    for bits in (32, 64):
        stores[bits] = get_typestore(Stores.ROS2_HUMBLE)
        stores[bits].register(get_types_from_msg(_LOG_DATA.format(bits), kind))
    out: list[BagMessage] = []
    try:
        with scratch() as folder:
            # rosbags chooses the format by the file's ending.
            link = Path(folder) / f"bag{suffix}"
            link.symlink_to(path.resolve())
            with AnyReader([link], default_typestore=stores[32]) as reader:
                described = any(c.msgdef.data for c in reader.connections)
                wanted = [
                    c
                    for c in reader.connections
                    if (name := c.msgtype.replace("/msg/", "/")) in VARIABLES
                    and c.topic.count("/") >= 2
                    # The fields of Status differ between versions.
                    and (described or name != STATUS)
                ]
                for connection, logged, raw in reader.messages(connections=wanted):
                    # Any, because the classes of messages are generated while reading.
                    content: Any = cast(Any, reader.deserialize(raw, connection.msgtype))
                    single = False
                    if connection.msgtype == kind:
                        single = content.values.dtype.itemsize == 4
                        if not described and single and len(stores[32].serialize_cdr(content, kind)) < len(raw) - 4:
                            content, single = stores[64].deserialize_cdr(raw, kind), False
                    name = connection.msgtype.replace("/msg/", "/")
                    out.append(BagMessage(connection.topic, name, logged, content, single))
    except Exception as error:  # damaged bytes raise errors of sqlite, struct, codecs and lookups
        reason = str(error).splitlines()[0][:160] if str(error) else type(error).__name__
        if not out:
            what = "ROS 2 bag in sqlite3 storage" if suffix == ".db3" else "ROS 1 bag"
            raise CfbError(f"{path}: this {what} cannot be read ({reason}); copy it again.") from None
        warnings.append(f"the bag is damaged or cut short ({reason}); what follows in it was left out.")
    return out
