"""Read the messages of an MCAP file in file order, check its checksums, and report damage."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

from cfb_mjx.errors import CfbError

MAGIC = b"\x89MCAP0\r\n"
_LARGEST_CHUNK = 1 << 29  # bytes; writers usually make chunks of about a megabyte


def refuse_bombs(data: bytes, path: Path) -> None:
    """Refuse a file with a chunk (record type 6) that would unpack to more than any recording of a flight."""
    position = len(MAGIC)
    while position + 9 <= len(data):
        kind, length = data[position], int.from_bytes(data[position + 1 : position + 9], "little")
        size = int.from_bytes(data[position + 25 : position + 33], "little")  # after two times
        if kind == 6 and position + 33 <= len(data) and size > _LARGEST_CHUNK:
            raise CfbError(
                f"{path}: a chunk would unpack to {size >> 20} MiB, so the MCAP file is damaged; copy it again."
            )
        position += 9 + length


def lacks_checksums(data: bytes) -> bool:
    """Whether a chunk (record type 6) has no CRC of its content, or messages (type 5) were written outside chunks."""
    position = len(MAGIC)
    while position + 9 <= len(data):
        kind, length = data[position], int.from_bytes(data[position + 1 : position + 9], "little")
        crc = position + 9 + 24  # after two times and the uncompressed size
        if kind == 5 or (kind == 6 and not any(data[crc : crc + 4])):
            return True
        position += 9 + length
    return False


class Decoded(NamedTuple):
    """One message: channel, schema (None for some JSON), time of recording (ns) and decoded content."""

    channel: Any
    schema: Any
    logged_ns: int
    content: Any


def messages(
    data: bytes, path: Path, warnings: list[str], decoder_of: Callable[[Any, Any], Callable[[bytes], Any] | None]
) -> Iterator[Decoded]:
    """Iterate over the messages that can be decoded.

    Args:
        data: content of the file.
        path: the file, for messages.
        warnings: receives what could not be read after the first message.
        decoder_of: returns the decoder of a channel's messages, given channel and schema; None to skip the channel.

    Raises:
        CfbError: nothing could be read.
    """
    from mcap.records import Channel, Message, Schema, Statistics
    from mcap.stream_reader import StreamReader

    refuse_bombs(data, path)
    schemas: dict[int, Any] = {}
    channels: dict[int, tuple[Any, Any, Callable[[bytes], Any] | None]] = {}
    seen = read = 0
    try:
        for item in StreamReader(io.BytesIO(data), validate_crcs=True, record_size_limit=len(data)).records:
            if isinstance(item, Schema):
                schemas[item.id] = item
            elif isinstance(item, Channel):
                schema = schemas.get(item.schema_id)
                channels[item.id] = item, schema, decoder_of(item, schema)
            elif isinstance(item, Statistics) and item.message_count > seen:
                warnings.append(
                    f"{item.message_count - seen} of the {item.message_count} messages that the file's own statistics "
                    "count are missing: a part of it was lost."
                )
            elif isinstance(item, Message):
                seen += 1
                channel, schema, decode = channels[item.channel_id]
                if decode is not None:
                    content = decode(item.data)
                    read += 1
                    yield Decoded(channel, schema, item.log_time, content)
    except Exception as error:  # on damaged bytes, the MCAP library raises struct, codec and lookup errors
        reason = str(error).splitlines()[0][:160] if str(error) else type(error).__name__
        kind = "cut short" if not data.endswith(MAGIC) else "damaged"
        if not read:
            raise CfbError(f"{path}: the MCAP file is {kind} ({reason}); copy or record it again.") from None
        warnings.append(f"the MCAP file is {kind} ({reason}); what follows in it was left out.")
