"""Read a flight log from MCAP, using the message descriptions embedded in the file."""

from __future__ import annotations

import io
import json
import os
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from cfb_mjx.errors import CfbError
from cfb_mjx.files import read_bytes
from cfb_mjx.logs import mcap_schema
from cfb_mjx.logs.flight_log import FlightLog, from_nanoseconds
from cfb_mjx.logs.mcap_stream import MAGIC, refuse_bombs

if TYPE_CHECKING:
    from mcap.records import Channel

BATCH = 4096
"""Number of messages of a topic that are decoded at once, because as objects they take ten times the memory of their
numbers."""
_STAMP = ("timestamp.seconds", "timestamp.nanos")
_POSE_COLUMNS = tuple(f"pose.position.{c}" for c in "xyz") + tuple(f"pose.orientation.{c}" for c in "wxyz")
_COLUMNS = {t.topic: t.columns for t in mcap_schema.TOPICS} | {mcap_schema.POSE: _POSE_COLUMNS}


def read_mcap(path: str | os.PathLike) -> FlightLog:
    """Read a log that `write_mcap` wrote. `read_log` also validates the content.

    Raises:
        CfbError: the file is missing, not an MCAP, cut short, damaged (checksums), or holds other topics; or its
            topics have different time stamps.
    """
    path = Path(path)
    data = read_bytes(path)
    if not data:
        raise CfbError(f"{path}: the file is empty; export the log again.")
    if not data.startswith(MAGIC):
        raise CfbError(f"{path}: this is not an MCAP file; give a log written by cfb_mjx or a table (parquet, csv).")
    refuse_bombs(data, path)
    try:
        schemas, channels, batches, record = _records(data)
    except Exception as error:  # on damaged bytes, the MCAP library raises struct, codec and lookup errors
        raise CfbError(f"{path}: the MCAP file is {_diagnosis(data, error)}; copy or export it again.") from None
    _check_origin(path, schemas, channels, record)
    try:
        columns = _by_topic(channels, batches)
        metadata = json.loads(record["metadata"])
        if not isinstance(metadata, dict):
            raise ValueError("metadata is not an object")
    except Exception as error:  # protobuf and JSON decoding of foreign or damaged content
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise CfbError(
            f"{path}: the messages do not match their description in the file ({reason}); export the log again."
        ) from None
    return _assemble(path, columns, metadata)


def _records(data: bytes):
    """Schemas, channels, decoded batches per channel in file order, and the log's metadata record. Checks all CRCs."""
    from mcap.records import Channel, Message, Metadata, Schema
    from mcap.stream_reader import StreamReader

    schemas, channels, waiting, batches, record = {}, {}, {}, {}, {}

    def decode(identifier: int) -> None:
        batches.setdefault(identifier, []).append(_decoded(schemas, channels[identifier], waiting.pop(identifier)))

    for item in StreamReader(io.BytesIO(data), validate_crcs=True, record_size_limit=len(data)).records:
        if isinstance(item, Message):
            waiting.setdefault(item.channel_id, []).append(item.data)
            if len(waiting[item.channel_id]) == BATCH and item.channel_id in channels:
                decode(item.channel_id)
        elif isinstance(item, Schema):
            schemas[item.id] = item
        elif isinstance(item, Channel):
            channels[item.id] = item
        elif isinstance(item, Metadata) and item.name == mcap_schema.METADATA_RECORD:
            record = item.metadata
    for identifier in [*waiting]:
        if identifier in channels:
            decode(identifier)
    return schemas, channels, batches, record


def _diagnosis(data: bytes, error: Exception) -> str:
    if not data.endswith(MAGIC):
        return "cut short (its closing bytes are missing)"
    if "crc" in str(error):
        return "damaged (a checksum does not match)"
    return f"damaged ({str(error).splitlines()[0] if str(error) else type(error).__name__})"


def _check_origin(path: Path, schemas: dict, channels: dict, record: dict) -> None:
    topics = sorted({c.topic for c in channels.values()})
    ours = {
        c.topic
        for c in channels.values()
        if c.schema_id in schemas
        and schemas[c.schema_id].encoding == c.message_encoding == "protobuf"
        and schemas[c.schema_id].name == mcap_schema.MESSAGES.get(c.topic)
    }
    if not ours or not record:
        listed = ", ".join(topics[:8]) + (", ..." if len(topics) > 8 else "") if topics else "none"
        raise CfbError(
            f"{path}: this MCAP has topics {listed}; it was not written by cfb_mjx. Export it to the tabular layout "
            "instead (see docs/logs.md)."
        )
    if record.get("format_version") != mcap_schema.FORMAT_VERSION:
        raise CfbError(
            f"{path}: the log has format version {record.get('format_version')!r}, this library reads "
            f"{mcap_schema.FORMAT_VERSION!r}; update cfb_mjx or export the log again."
        )
    required = [
        mcap_schema.POSE,
        *(t.topic for t in mcap_schema.TOPICS if t.field not in ("rotor_speed", "battery_voltage")),
    ]
    if missing := [t for t in required if t not in ours]:
        raise CfbError(
            f"{path}: the MCAP lacks the topic{'s' * (len(missing) > 1)} {', '.join(missing)}; export all of them."
        )


def _decoded(schemas: dict, channel: Channel, payloads: list[bytes]) -> np.ndarray | Exception:
    """The (n, 2 + columns) table of messages of a topic: seconds, nanoseconds, values; or why there is none."""
    columns = _COLUMNS.get(channel.topic, ())
    try:
        schema = schemas[channel.schema_id]
        parse = mcap_schema.message_class(schema.name, schema.data).FromString
        row = attrgetter(*_STAMP, *columns)
        # Of another topic nothing is wanted, so that nothing can be wrong with it.
        rows = [row(parse(data)) for data in payloads] if columns else []
        return np.array(rows, dtype=np.float64).reshape(len(rows), 2 + len(columns))
    except Exception as error:  # protobuf decoding of foreign or damaged content; the file's origin is checked first
        return error


def _by_topic(channels: dict, batches: dict[int, list]) -> dict[str, np.ndarray]:
    """Topic to its table of rows, as of `_decoded`."""
    tables: dict[str, list] = {}
    for identifier, channel in channels.items():
        if channel.topic in _COLUMNS:
            empty = np.zeros((0, 2 + len(_COLUMNS[channel.topic])))
            tables.setdefault(channel.topic, [empty]).extend(batches.get(identifier, ()))
    for found in tables.values():
        if failed := next((each for each in found if isinstance(each, Exception)), None):
            raise failed
    return {topic: np.concatenate(found) for topic, found in tables.items()}


def _assemble(path: Path, tables: dict[str, np.ndarray], metadata: dict) -> FlightLog:
    reference = tables.pop(mcap_schema.POSE)
    for topic, table in tables.items():
        if len(table) != len(reference):
            raise CfbError(
                f"{path}: {topic} has {len(table)} messages, {mcap_schema.POSE} {len(reference)}, but a log needs "
                "every topic at every time stamp; resample with cfb_mjx.logs.resample before writing "
                "or export all at one rate."
            )
        if (table[:, :2] != reference[:, :2]).any():
            row = int(np.argmax((table[:, :2] != reference[:, :2]).any(axis=1)))
            stamps = from_nanoseconds(*np.stack([table[row, :2], reference[row, :2]], axis=1))
            raise CfbError(
                f"{path}: message {row} of {topic} is at {stamps[0]:.9g} s, that of {mcap_schema.POSE} at "
                f"{stamps[1]:.9g} s; resample with cfb_mjx.logs.resample before writing or export all at one rate."
            )
    fields = {t.field: tables[t.topic][:, 2:] for t in mcap_schema.TOPICS if t.topic in tables}
    if "battery_voltage" in fields:
        fields["battery_voltage"] = fields["battery_voltage"][:, 0]
    # The log is named after this file; ``origin`` keeps the file from which the data first came.
    origin = {k: metadata.get(k) for k in ("name", "source", "format")}
    metadata = {"origin": origin} | metadata | {"name": path.stem, "source": path.name, "format": "mcap"}
    return FlightLog(
        time=from_nanoseconds(reference[:, 0], reference[:, 1]),
        position=reference[:, 2:5],
        quaternion=reference[:, 5:9],
        metadata=metadata,
        **fields,
    )
