"""Reader of ROS bags recorded with Crazyswarm2, or with Crazyswarm 1.

The bag describes its messages, but not the names of the variables in a custom log topic
(``crazyflie_interfaces/LogDataGeneric``: header, firmware time stamp in ms, values). They are in the
``crazyflies.yaml`` with which the server was started, under ``firmware_logging: custom_topics: NAME: {frequency,
vars}`` of ``all``, the robot's type or the robot (later ones take precedence, as in IMRCLab/crazyswarm2). Crazyswarm 1
has them as parameters ``genericLogTopic_NAME_Variables``.
"""

from __future__ import annotations

import os
import re
from collections import defaultdict
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from cfb_mjx.documents import load_yaml, told
from cfb_mjx.errors import CfbError
from cfb_mjx.logs.assembly import Import, assemble
from cfb_mjx.logs.flight_log import FlightLog
from cfb_mjx.logs.ros_bag import (
    GENERIC,
    GENERIC_1,
    IMU,
    ODOMETRY,
    POSE,
    STATUS,
    VARIABLES,
    BagMessage,
    read_bag,
)
from cfb_mjx.logs.streams import RADIO_WRAP_MS, Stream, ordered, unwrap
from cfb_mjx.logs.variables import FIELDS, VariableMap, load_mapping

_CRAZYSWARM_1 = re.compile(r"genericLogTopic_(\w+)_Variables")
_TICK = 0.001  # s, resolution of the firmware's time stamps, which limits the alignment of another clock with them
_OVERTAKING = 0.1  # s by which messages may arrive out of order in the bag
_BIN = 5.0  # s, width of the bins in which the fastest packet is used to compare two clocks
_STEPPED = 0.02  # s; if the fastest packets scatter more than this, the computer's clock was adjusted meanwhile


def read_crazyswarm(
    path: str | os.PathLike,
    mapping: str | os.PathLike | VariableMap | None = None,
    topics_yaml: str | os.PathLike | None = None,
    robot: str | None = None,
) -> FlightLog:
    """Read one robot's flight from a bag. `read_log` also validates the content.

    Custom log topics are placed in time by their firmware time stamps. Other messages have only a time stamp of the
    computer. It is converted to the firmware's clock by means of the fastest packets of the custom topics. Messages
    that also came by radio are then right except for their jitter; motion capture is early by the (unknown) shortest
    transmission time of a packet. Without firmware time stamps, the computer's clock is used for all topics.

    Args:
        path: the ``.mcap``, ``.db3`` or ``.bag``, or the folder of a ROS 2 bag.
        mapping: assigns variables to columns of the log; a mapping file, or None for ``configs/logs/crazyflie.yaml``.
            Poses are ``pose.x .. pose.qz``, odometry ``odom.x .. odom.wz``, the battery of Status
            ``status.battery_voltage``.
        topics_yaml: the ``crazyflies.yaml`` used for the flight; without it custom log topics cannot be read.
        robot: name of the robot, the first part of its topics; required if the bag has several.

    Returns:
        The log, not yet validated.

    Raises:
        CfbError: unreadable or damaged file, no or several robots, a custom topic whose number of values differs from
            its number of names, time that goes back, required variables that were not logged, fewer than two rows.
    """
    path = Path(path)
    mapping = mapping if isinstance(mapping, VariableMap) else load_mapping(mapping)
    notes: list[str] = []
    warnings: list[str] = []
    bag = read_bag(path, warnings)
    if not bag.checked:
        notes.append("the bag has no checksums, so damage to values in it would go unnoticed.")
    try:
        return _flight(bag.messages, path, mapping, topics_yaml, robot, notes, warnings)
    except CfbError as error:
        said = str(error).removeprefix(f"{path}: ")
        if said == str(error):
            raise
        raise CfbError(f"{path}: {bag.storage}: {said}") from None


def _flight(
    messages: list[BagMessage],
    path: Path,
    mapping: VariableMap,
    topics_yaml: str | os.PathLike | None,
    robot: str | None,
    notes: list[str],
    warnings: list[str],
) -> FlightLog:
    robot = _robot(messages, robot, path)
    by_topic: dict[str, list[BagMessage]] = defaultdict(list)
    for message in messages:
        if message.topic.startswith(f"/{robot}/"):
            by_topic[message.topic[len(robot) + 2 :]].append(message)
    names = {} if topics_yaml is None else _custom_topics(Path(topics_yaml), robot)
    try:
        read = [_table(topic, group, names, path, notes) for topic, group in by_topic.items()]
    except AttributeError as error:  # a message type with a known name and other fields
        raise CfbError(f"{path}: a message differs from Crazyswarm2's ({error}); record the bag again.") from None
    tables = [t for t in read if t is not None]
    if topics_yaml is None and any(group[0].kind in (GENERIC, GENERIC_1) for group in by_topic.values()):
        notes.append(
            "custom log topics were left out: their variable names are in the crazyflies.yaml (--topics-yaml FILE)."
        )
    streams, clock = _one_clock(tables, path, notes, warnings)
    try:
        imported = Import("crazyswarm", streams, None, notes, warnings, {"robot": robot, "clock": clock})
        log = assemble(imported, mapping, path)
    except CfbError as error:
        left_out = [n for n in notes if "their variable names" in n or "float32" in n]
        raise CfbError(" ".join([str(error), *left_out])) from None
    used = log.metadata["variables"]
    from_odometry = [f for f in FIELDS if f in used and used[f].get("variables", [""])[0].startswith("odom.")]
    if from_odometry:
        warnings.append(
            f"{', '.join(from_odometry)} come from Odometry, which Crazyswarm2's cflib server fills with an inverted "
            "pitch, rates in deg/s and a velocity in body axes; log stateEstimate.* and gyro.* in custom topics."
        )
    return log.replace(metadata={"warnings": warnings})


class _Table(NamedTuple):
    """Messages of one topic: computer time (ns), firmware time (ms; None if unknown) and values by name."""

    topic: str
    stamp_ns: np.ndarray
    ticks_ms: np.ndarray | None
    values: dict[str, np.ndarray]
    float32: bool


def _robot(messages: list[BagMessage], robot: str | None, path: Path) -> str:
    robots = sorted({m.topic.split("/")[1] for m in messages})
    listed = ", ".join(robots) or "none"
    if robot is not None and robot.strip("/") not in robots:
        raise CfbError(f"{path}: there is no robot {robot!r} in the bag; its robots are {listed}.")
    if robot is None and len(robots) != 1:
        what = "holds several robots" if robots else "holds no pose, odometry or log topic like /cf231/pose"
        raise CfbError(f"{path}: the bag {what} (found: {listed}); choose one with --robot NAME.")
    return robots[0] if robot is None else robot.strip("/")


def _custom_topics(path: Path, robot: str) -> dict[str, list[str]]:
    """Custom topic of the robot to the names of its variables."""
    document = load_yaml(path)
    first = {m[1]: (m[0], v) for k, v in document.items() if (m := _CRAZYSWARM_1.fullmatch(str(k))) is not None}
    if first:
        return {name: _names(names, path, key) for name, (key, names) in first.items()}
    robots = _mapping(document.get("robots"), path, "robots")
    own = _mapping(robots.get(robot), path, f"robots.{robot}")
    types, kind = _mapping(document.get("robot_types"), path, "robot_types"), own.get("type")
    if not isinstance(kind, str | int | None):
        raise CfbError(f"{path}: robots.{robot}.type must be a name, found {told(kind)}.")
    topics: dict[str, list[str]] = {}
    blocks = {
        "all": document.get("all"),
        f"robot_types.{kind}": types.get(kind),
        f"robots.{robot}": own,
    }
    for where, block in blocks.items():
        where = f"{where}.firmware_logging"
        logging = _mapping(_mapping(block, path, where).get("firmware_logging"), path, where)
        for name, topic in _mapping(logging.get("custom_topics"), path, f"{where}.custom_topics").items():
            label = f"{where}.custom_topics.{name}"
            topics[str(name)] = _names(_mapping(topic, path, label).get("vars"), path, f"{label}.vars")
    return topics


def _names(names: Any, path: Path, where: str) -> list[str]:
    if not isinstance(names, list) or not names or not all(isinstance(v, str) for v in names):
        raise CfbError(f"{path}: {where} must list the names of the variables.")
    return names


def _mapping(value: Any, path: Path, where: str) -> dict:
    if value is None:
        return {}
    if not isinstance(value, dict):
        raise CfbError(f"{path}: {where} must be a mapping, found {type(value).__name__}.")
    return value


def _table(topic: str, group: list[BagMessage], names: dict, path: Path, notes: list[str]) -> _Table | None:
    kind = group[0].kind
    logged = np.array([m.logged_ns for m in group], dtype=np.uint64).astype(np.int64)
    headers = [m.content.header.stamp for m in group]
    stamps = np.array([int(s.sec) * 1_000_000_000 + int(s.nanosec) for s in headers], dtype=np.int64)
    if (stamps == 0).any():
        notes.append(f"{topic}: headers without a time stamp; the time of recording was used.")
        stamps = logged
    ticks, single = None, False
    if kind in (GENERIC, GENERIC_1):
        if topic not in names:
            if names:
                notes.append(f"{topic}: not in the file of --topics-yaml; left out.")
            return None
        values = _generic(topic, group, names[topic], path)
        ticks = np.array([getattr(m.content, "timestamp", 0) for m in group], dtype=np.int64)
        ticks, single = None if (ticks == 0).all() else ticks, group[0].float32
    else:
        rows = np.array([_row(kind, m.content) for m in group], dtype=np.float64)
        values = dict(zip(VARIABLES[kind], rows.T, strict=True))
    return _Table(topic, stamps, ticks, values, single)


def _generic(topic: str, group: list[BagMessage], names: list[str], path: Path) -> dict[str, np.ndarray]:
    for row, message in enumerate(group):
        if len(message.content.values) != len(names):
            raise CfbError(
                f"{path}: message {row} of {topic} has {len(message.content.values)} values, but the file of "
                f"--topics-yaml names {len(names)} ({', '.join(names)}); give the crazyflies.yaml that was in use."
            )
    rows = np.array([m.content.values for m in group], dtype=np.float64)
    return dict(zip(names, rows.T, strict=True))


def _row(kind: str, message: Any) -> list[float]:
    if kind == STATUS:
        return [message.battery_voltage]
    if kind == IMU:
        w, a = message.angular_velocity, message.linear_acceleration
        return [w.x, w.y, w.z, a.x, a.y, a.z]
    pose = message.pose if kind == POSE else message.pose.pose
    p, q = pose.position, pose.orientation
    row = [p.x, p.y, p.z, q.w, q.x, q.y, q.z]
    if kind == ODOMETRY:
        v, w = message.twist.twist.linear, message.twist.twist.angular
        row += [v.x, v.y, v.z, w.x, w.y, w.z]
    return row


def _one_clock(tables: list[_Table], path: Path, notes: list[str], warnings: list[str]) -> tuple[list[Stream], dict]:
    """Streams on one clock (s): the firmware's if known, else the computer's. Also a report on the conversion."""
    if not tables:
        return [], {"of": "none"}
    origin = min(int(t.stamp_ns.min()) for t in tables)
    computer = [(t.stamp_ns - origin) / 1e9 for t in tables]
    firmware: list[np.ndarray | None] = []
    reference = None
    for table, seconds in zip(tables, computer, strict=True):
        if table.ticks_ms is None:
            firmware.append(None)
            continue
        ticks, wraps = unwrap(table.ticks_ms, RADIO_WRAP_MS)
        # A topic may start after an overflow of the 24-bit counter; add the overflows that it missed.
        lag = float(np.median(seconds - ticks / 1e3))
        reference = lag if reference is None else reference
        ticks = ticks + RADIO_WRAP_MS * round((lag - reference) / (RADIO_WRAP_MS / 1e3))
        if wraps:
            notes.append(f"{table.topic}: the 24-bit time stamp overflowed {wraps} times; this was undone.")
        firmware.append(ticks / 1e3)
    pairs = [(f, c) for f, c in zip(firmware, computer, strict=True) if f is not None]
    if pairs:
        slope, offset, clock = _fastest_packets(*(np.concatenate(p) for p in zip(*pairs, strict=True)))
        if clock["scatter_ms"] > _STEPPED * 1e3:
            warnings.append(
                f"the computer's clock wandered by {clock['scatter_ms']:.0f} ms against the firmware's; poses may not "
                "be in step with the gyro."
            )
        placed = [(c - offset) / slope if f is None else f for f, c in zip(firmware, computer, strict=True)]
    else:
        clock = {"of": "computer"}
        notes.append("no topic has firmware time stamps; rows have the computer's time stamps.")
        placed = computer
    streams = []
    for table, time, ticks in zip(tables, placed, firmware, strict=True):
        slack = _TICK if pairs and ticks is None else Stream.slack
        stream = Stream(table.topic, time, table.values, table.float32, slack)
        streams.append(ordered(stream, path, notes, _OVERTAKING))
    return streams, clock


def _fastest_packets(firmware: np.ndarray, computer: np.ndarray) -> tuple[float, float, dict]:
    """Fit computer time = slope * firmware time + offset to the fastest packet of each 5 s bin.

    Returns:
        Slope, offset (s), and a report on the fit.
    """
    delay = computer - firmware
    bins = np.floor((firmware - firmware.min()) / _BIN).astype(int)
    order = np.lexsort((delay, bins))
    first = order[np.concatenate([[True], np.diff(bins[order]) > 0])]
    if len(first) >= 4:
        drift, offset = np.polyfit(firmware[first], delay[first], 1)
    else:
        drift, offset = 0.0, float(delay.min())
    late = delay - offset - drift * firmware
    return (
        1.0 + float(drift),
        float(offset),
        {
            "of": "firmware",
            "drift_ppm": round(float(drift) * 1e6, 3),
            "median_lateness_ms": round(float(np.median(late)) * 1e3, 3),
            "scatter_ms": round(float(np.abs(late[first]).max()) * 1e3, 3),
        },
    )
