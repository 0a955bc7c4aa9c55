"""Reader of the binary log that a Crazyflie writes to its micro SD card.

Layout (little endian), as written by ``usddeck.c`` and read by ``tools/usdlog/cfusdlog.py`` of
bitcraze/crazyflie-firmware: byte 0xBC; u16 version; u16 number of event types; per type u16 id, NUL-terminated name,
u16 number of variables and as many NUL-terminated ``group.name(T)``, T a character of Python's struct module; records
of u16 id, time stamp (version 2: u64 microseconds, version 1: u32 milliseconds) and packed values; CRC-32 of all bytes
before it. The firmware writes the CRC when logging is switched off, so a log that ended with an empty battery has none.
"""

from __future__ import annotations

import dataclasses
import os
import re
import struct
import zlib
from pathlib import Path
from typing import NoReturn

import numpy as np

from cfb_mjx.errors import CfbError
from cfb_mjx.files import read_bytes
from cfb_mjx.logs.assembly import Import, assemble
from cfb_mjx.logs.flight_log import FlightLog
from cfb_mjx.logs.streams import Stream, ordered, unwrap
from cfb_mjx.logs.variables import VariableMap, load_mapping

MAGIC = b"\xbc"
FIXED_FREQUENCY_ID, FIXED_FREQUENCY = 0xFFFF, "fixedFrequency"
_RECORD = {1: struct.Struct("<HI"), 2: struct.Struct("<HQ")}
_SECONDS_PER_TICK = {1: 1e-3, 2: 1e-6}
# The firmware uses bBhHiIfe. The other types are accepted because numpy and struct define them identically.
_TYPES = {c: np.dtype(f"<{c}") for c in "bBhHiIqQefd"}
_VARIABLE = re.compile(r"([A-Za-z_][\w.]*)\((.)\)")
# In a damaged file, larger values (SI) count as damage: twice the range of the sensors, an arena of 1 km.
_IMPOSSIBLE = {"position": 1e3, "velocity": 1e2, "body_rate": 70.0, "specific_force": 500.0, "rotor_speed": 6000.0}
_MAX_JUMP = 10.0  # s; in a damaged file, a longer step of the clock counts as damage


@dataclasses.dataclass
class _Event:
    identifier: int
    name: str
    dtype: np.dtype
    offsets: list[int] = dataclasses.field(default_factory=list)
    ticks: list[int] = dataclasses.field(default_factory=list)


def read_usd_card(path: str | os.PathLike, mapping: str | os.PathLike | VariableMap | None = None) -> FlightLog:
    """Read a micro SD card log. `read_log` also validates the content.

    A file without a valid checksum is read up to the first impossible record. A warning in ``metadata["warnings"]``
    says so, and says that values before it may be damaged too. Time starts at 0 at the first row.

    Args:
        path: the file.
        mapping: assigns variables to columns of the log; a mapping file, or None for ``configs/logs/crazyflie.yaml``.

    Returns:
        The log, not yet validated.

    Raises:
        CfbError: unreadable file, damaged header, unknown version, time that goes back in an intact file, required
            variables that were not logged, fewer than two rows.
    """
    path = Path(path)
    data = read_bytes(path)
    if not data.startswith(MAGIC):
        raise CfbError(f"{path}: does not begin with 0xBC, so it is not a micro SD card log of a Crazyflie.")
    intact = len(data) > 9 and zlib.crc32(data[:-4]) == int.from_bytes(data[-4:], "little")
    version, events, start = _header(data, path)
    notes: list[str] = []
    problem, position = _scan(data, start, len(data) - 4 if intact else len(data), version, events, intact)
    warnings = _warnings(intact, problem, position, len(data))
    streams = _streams(data, version, events, path, notes)
    preferred = next((e.name for e in events if e.identifier == FIXED_FREQUENCY_ID), FIXED_FREQUENCY)
    read = Import("usd_card", streams, preferred, notes, warnings)
    read.metadata["usd_card"] = {
        "version": version,
        "checksum": "ok" if intact else "mismatch",
        "records": {e.name: len(e.offsets) for e in events},
    }
    log = assemble(read, mapping if isinstance(mapping, VariableMap) else load_mapping(mapping), path)
    return log if intact else _cut_at_impossible(log)


def _cut_at_impossible(log: FlightLog) -> FlightLog:
    """The rows of a damaged file before the first one with impossible values."""
    bad = (np.abs(np.linalg.norm(log.quaternion, axis=1) - 1.0) > 0.05) | (np.abs(log.command - 0.5) > 0.501).any(
        axis=1
    )
    for field, limit in _IMPOSSIBLE.items():
        if (values := getattr(log, field)) is not None:
            bad |= (np.abs(values) > limit).any(axis=1)
    first = int(np.argmax(bad))
    # If nearly all rows are impossible, the unit is wrong; validation reports that.
    if first < 2 or not bad.any():
        return log
    warning = (
        f"row {first} ({log.time[first]:.3f} s) holds values that no flight has; it and what follows were left out."
    )
    return log.rows(slice(0, first)).replace(metadata={"warnings": [*log.metadata["warnings"], warning]})


def _header(data: bytes, path: Path) -> tuple[int, list[_Event], int]:
    """Version, event types, and the position of the first record."""

    def fail(problem: str) -> NoReturn:
        raise CfbError(f"{path}: the header is damaged or cut short ({problem}); copy the log from the card again.")

    position = 1

    def number() -> int:
        nonlocal position
        if position + 2 > len(data):
            fail(f"it ends at byte {len(data)}")
        position += 2
        return int.from_bytes(data[position - 2 : position], "little")

    def text() -> str:
        nonlocal position
        end = data.find(b"\0", position)
        if end < 0:
            fail(f"the name at byte {position} has no end")
        raw, position = data[position:end], end + 1
        if not raw or not all(33 <= byte < 127 for byte in raw):
            fail(f"the name at byte {end - len(raw)} is not text")
        return raw.decode("ascii")

    version = number()
    if version not in _RECORD:
        raise CfbError(
            f"{path}: micro SD card log of version {version}, this library reads {', '.join(map(str, _RECORD))}; "
            "update cfb_mjx, or copy the log again if the file is damaged."
        )
    events: list[_Event] = []
    for _ in range(number()):
        identifier, name, fields = number(), text(), []
        for _ in range(number()):
            entry = text()
            match = _VARIABLE.fullmatch(entry)
            if match is None or match[2] not in _TYPES:
                fail(f"{entry!r} is not a variable and its type")
            fields.append((match[1], _TYPES[match[2]]))
        if len({f for f, _ in fields}) < len(fields):
            fail(f"event {name} lists a variable twice")
        if any(e.identifier == identifier or e.name == name for e in events):
            fail(f"event {name} appears twice")
        events.append(_Event(identifier, name, np.dtype(fields)))
    if not events:
        fail("it lists no event types")
    return version, events, position


def _scan(data, start, end, version, events, intact) -> tuple[str | None, int]:
    """Find the records. Returns the fault of the first invalid one (None if all are valid) and its position."""
    head, by_id = _RECORD[version], {e.identifier: e for e in events}
    jump = int(_MAX_JUMP / _SECONDS_PER_TICK[version])
    latest, position = None, start
    while position + head.size <= end:
        identifier, tick = head.unpack_from(data, position)
        event = by_id.get(identifier)
        if event is None:
            return f"there is no event type {identifier}", position
        if position + head.size + event.dtype.itemsize > end:
            break
        if not intact:
            # Tasks of different priority write different events, so order is required only within one event.
            if event.ticks and tick < event.ticks[-1]:
                return "its time goes back", position
            if latest is not None and abs(tick - latest) > jump:
                return f"its time jumps by more than {_MAX_JUMP:g} s", position
            size = event.dtype.itemsize
            if size and not np.isfinite(np.frombuffer(data, event.dtype, 1, position + head.size)[0].item()).all():
                return "it holds a value that is not finite", position
        event.offsets.append(position + head.size)
        event.ticks.append(tick)
        latest = tick if latest is None else max(latest, tick)
        position += head.size + event.dtype.itemsize
    return ("bytes are left over" if intact and position < end else None), position


def _warnings(intact: bool, problem: str | None, position: int, size: int) -> list[str]:
    if intact:
        where = f"the record at byte {position} of {size} is not valid ({problem})"
        return [f"the checksum is right but {where}; what follows was left out."] if problem else []
    if problem is not None:
        what = f"the record at byte {position} cannot be right ({problem})"
        return [
            f"the checksum does not match and {what}: the file is damaged; {size - position} of {size} bytes were left "
            "out, and values before that may be damaged too."
        ]
    return [
        "the checksum does not match: the log was cut short (the firmware writes the checksum when logging is switched "
        "off) or values in it are damaged, which cannot be distinguished; check it before use."
    ]


def _streams(data: bytes, version: int, events: list[_Event], path: Path, notes: list[str]) -> list[Stream]:
    """The events as streams, with the time since the vehicle started, in s."""
    whole = np.frombuffer(data, dtype=np.uint8)
    streams = []
    for event in events:
        if not event.offsets:
            notes.append(f"event {event.name} has no records.")
            continue
        ticks = np.array(event.ticks, dtype=np.uint64)
        if version == 1:
            ticks, wraps = unwrap(ticks.astype(np.int64), 1 << 32)
            if wraps:
                notes.append(f"{event.name}: the 32-bit time stamp overflowed {wraps} times; this was undone.")
        bytes_of = np.array(event.offsets)[:, None] + np.arange(event.dtype.itemsize)
        values = {}
        if names := event.dtype.names:
            table = np.ascontiguousarray(whole[bytes_of]).view(event.dtype).reshape(-1)
            values = {n: table[n].astype(np.float64) for n in names}
        stream = Stream(event.name, ticks.astype(np.float64) * _SECONDS_PER_TICK[version], values)
        streams.append(ordered(stream, path, notes))
    return streams
