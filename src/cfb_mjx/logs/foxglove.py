"""Reader of MCAP files with JSON or protobuf messages, written by Foxglove's tools or by other recorders.

The numbers of all messages are named by topic and field: ``/cf1/imu`` with ``{"angular_velocity": {"x": ..}}`` gives
``cf1.imu.angular_velocity.x``. Poses, transforms, velocities and IMU readings are recognised by the usual field names,
firmware variables by their names anywhere in a message. For unknown names a mapping is proposed, as for tables.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from cfb_mjx.errors import CfbError
from cfb_mjx.files import read_bytes
from cfb_mjx.logs import mcap_schema, mcap_stream
from cfb_mjx.logs.assembly import Import, assemble
from cfb_mjx.logs.flight_log import FlightLog
from cfb_mjx.logs.proposal import UnknownNames, propose
from cfb_mjx.logs.radio_csv import logged_names
from cfb_mjx.logs.streams import Stream, ordered
from cfb_mjx.logs.tabular import Table
from cfb_mjx.logs.variables import MissingNames, VariableMap, load_mapping

_STAMP = re.compile(r"(?:.*\.)?(?:timestamp|stamp|time)\.(?P<part>n(?:ano)?(?:sec|s)\w*|sec\w*|secs)")
# Endings of the fields of common messages, and their names in `configs/logs/crazyflie.yaml`.
_KNOWN = (
    (re.compile(r"(?:.*\.)?(?:position|translation)\.([xyz])"), "pose.{}"),
    (re.compile(r"(?:.*\.)?(?:orientation|rotation)\.([wxyz])"), "pose.q{}"),
    (re.compile(r"(?:.*\.)?(?:linear_velocity|velocity|twist\.linear)\.([xyz])"), "twist.v{}"),
    (re.compile(r"(?:.*\.)?(?:angular_velocity|body_rate)\.([xyz])"), "imu.w{}"),
    (re.compile(r"(?:.*\.)?(?:linear_acceleration|specific_force)\.([xyz])"), "imu.a{}"),
)
_LONGEST = 64  # longest array that is read; longer ones are images and point clouds
_OVERTAKING = 0.1  # s by which messages may arrive out of order in the file


def recognises(path: str | os.PathLike) -> bool:
    """Whether an MCAP holds JSON or protobuf messages and was not written by this library."""
    data = read_bytes(path)
    known = data[-(1 << 16) :] if data.endswith(mcap_stream.MAGIC) else data[: 1 << 16]
    return b"cfb_mjx." not in known and (b"json" in known or b"protobuf" in known)


def read_foxglove(path: str | os.PathLike, mapping: str | os.PathLike | VariableMap | None = None) -> FlightLog:
    """Read a flight from JSON or protobuf messages. `read_log` also validates the content.

    Messages of one topic with the same fields form a stream; streams are merged onto the rows of the gyro. The time of
    a message is its ``timestamp`` or ``header.stamp``, or else the time of recording.

    Args:
        path: the MCAP file.
        mapping: assigns numbers to columns of the log; a mapping file, or None for ``configs/logs/crazyflie.yaml``.

    Returns:
        The log, not yet validated.

    Raises:
        UnknownNames: the messages have unknown names, for which a mapping can be proposed.
        CfbError: damaged file, messages that do not fit their description, several topics with a pose, time that goes
            back, required signals that were not recorded.
    """
    path = Path(path)
    asked = mapping
    mapping = mapping if isinstance(mapping, VariableMap) else load_mapping(mapping)
    notes: list[str] = []
    warnings: list[str] = []
    data = read_bytes(path)
    if mcap_stream.lacks_checksums(data):
        notes.append("the MCAP file has no checksums, so damage to values in it would go unnoticed.")
    streams = [ordered(s, path, notes, _OVERTAKING) for s in _streams(data, path, notes, warnings)]
    streams = _with_known_names(streams, mapping, path, guess=asked is None)
    try:
        return assemble(Import("foxglove", streams, None, notes, warnings), mapping, path)
    except MissingNames as error:
        table = _table(streams)
        proposal = propose(table) if asked is None and table else None
        if proposal is None:
            raise
        raise UnknownNames(
            f"{path}: its messages have unknown names, which look like {', '.join(proposal.fields)}; cfb import writes "
            "a proposed mapping: check it, then give it with --mapping FILE.",
            proposal.text,
        ) from error


def _streams(data: bytes, path: Path, notes: list[str], warnings: list[str]) -> list[Stream]:
    """One stream per topic and set of fields, with the time since the first message, s."""
    groups: dict[tuple[str, tuple[str, ...]], list[tuple[int, list[float]]]] = {}
    unstamped: set[str] = set()
    for message in mcap_stream.messages(data, path, warnings, _decoder):
        topic, logged, numbers = message.channel.topic, message.logged_ns, message.content
        stamp = _stamp(numbers)
        if stamp is None:
            unstamped.add(topic)
        values = {name: x for name, x in numbers.items() if _STAMP.fullmatch(name) is None}
        if values:
            group = groups.setdefault((topic, tuple(values)), [])
            group.append((logged if stamp is None else stamp, list(values.values())))
    if unstamped:
        listed = ", ".join(sorted(unstamped))
        notes.append(f"{listed}: messages without a time of their own; the time of recording was used.")
    if not groups:
        raise CfbError(
            f"{path}: the MCAP file holds no JSON or protobuf messages with numbers; record the flight again."
        )
    origin = min(rows[0][0] for rows in groups.values())
    streams = []
    topics = [topic for topic, _ in groups]
    for (topic, names), rows in groups.items():
        prefix = topic.strip("/").replace("/", ".")
        values = np.array([row for _, row in rows], dtype=np.float64).T
        time = np.array([stamp - origin for stamp, _ in rows], dtype=np.int64) / 1e9
        full = {f"{prefix}.{name}".strip("."): v for name, v in zip(names, values, strict=True)}
        streams.append(Stream(f"{topic} ({names[0]})" if topics.count(topic) > 1 else topic, time, full))
    return streams


def _decoder(channel: Any, schema: Any) -> Callable[[bytes], dict[str, float]] | None:
    """Decoder of a channel's messages to numbers by name; None for an encoding that is not read."""
    if channel.message_encoding == "json":
        parse = json.loads
    elif channel.message_encoding == "protobuf" and schema is not None:
        parse = mcap_schema.message_class(schema.name, schema.data).FromString
    else:
        return None

    def decode(data: bytes) -> dict[str, float]:
        numbers: dict[str, float] = {}
        _collect(parse(data), "", numbers)
        return numbers

    return decode


def _collect(value: Any, name: str, out: dict[str, float]) -> None:
    """Collect the numbers of a message in ``out``, keyed by the path of field names."""
    if isinstance(value, bool | int | float):
        out[name] = float(value)
    elif isinstance(value, dict):
        for key, inner in value.items():
            _collect(inner, f"{name}.{key}" if name else str(key), out)
    elif isinstance(value, list | tuple):
        for index, inner in enumerate(value if len(value) <= _LONGEST else ()):
            _collect(inner, f"{name}.{index}", out)
    elif hasattr(value, "DESCRIPTOR"):
        for field in value.DESCRIPTOR.fields:
            inner = getattr(value, field.name)
            repeated = hasattr(inner, "__len__") and not isinstance(inner, str | bytes)
            _collect(list(inner) if repeated else inner, f"{name}.{field.name}" if name else field.name, out)


def _stamp(numbers: dict[str, float]) -> int | None:
    """The message's own time stamp, ns; None if it has none."""
    parts: dict[str, int] = {}
    for name, value in numbers.items():
        match = _STAMP.fullmatch(name)
        if match is not None:
            parts.setdefault("nanos" if match["part"].startswith("n") else "seconds", int(value))
    if not parts.get("seconds"):
        return None
    return parts["seconds"] * 1_000_000_000 + parts.get("nanos", 0)


def _with_known_names(streams: list[Stream], mapping: VariableMap, path: Path, guess: bool) -> list[Stream]:
    """The streams, with recognised numbers also under the mapping's names.

    Raises:
        CfbError: two topics hold the same quantity, and there is no user's mapping (``guess``) that chooses one.
    """
    out: list[Stream] = []
    homes: dict[str, str] = {}
    for stream in streams:
        firmware = logged_names(stream.values, mapping)
        known: dict[str, list[str]] = {}
        for name in stream.values:
            told = next((word.format(m[1]) for p, word in _KNOWN if (m := p.fullmatch(name))), None)
            if (told := firmware.get(name, told)) is not None:
                known.setdefault(told, []).append(name)
        # A quantity that occurs twice in one message is ambiguous, for example a pose and its set-point.
        clear = {told: names[0] for told, names in known.items() if len(names) == 1}
        for told, name in clear.items():
            if homes.setdefault(told, stream.name) != stream.name and guess:
                raise CfbError(
                    f"{path}: {homes[told]} and {stream.name} both hold {told}; say which is the drone's with "
                    f"--mapping FILE, in which {name} is the name of the latter."
                )
        values = stream.values | {told: stream.values[name] for told, name in clear.items()}
        out.append(Stream(stream.name, stream.time, values))
    return out


def _table(streams: list[Stream]) -> Table:
    """All numbers, held, on the rows of the longest stream, as input for a proposed mapping."""
    longest = max(streams, key=lambda s: len(s.time))
    table = Table({"t": longest.time})
    for stream in streams:
        row = np.clip(np.searchsorted(stream.time, longest.time, side="right") - 1, 0, len(stream.time) - 1)
        table |= {name: values[row] for name, values in stream.values.items()}
    return table
