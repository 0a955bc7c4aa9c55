"""Reader of PX4's ULog, using the library `pyulog <https://github.com/PX4/pyulog>`_."""

from __future__ import annotations

import contextlib
import io
import os
from pathlib import Path

import numpy as np

from cfb_mjx.errors import CfbError
from cfb_mjx.files import read_bytes, shipped
from cfb_mjx.logs.assembly import Import, assemble
from cfb_mjx.logs.flight_log import FlightLog
from cfb_mjx.logs.streams import Stream, ordered
from cfb_mjx.logs.variables import VariableMap, load_mapping

MAGIC = b"ULog\x01\x12\x35"


def read_ulog(path: str | os.PathLike, mapping: str | os.PathLike | VariableMap | None = None) -> FlightLog:
    """Read a PX4 log. `read_log` also validates the content.

    Args:
        path: the ``.ulg`` file.
        mapping: assigns topics to columns of the log; a mapping file, or None for ``configs/logs/px4.yaml``.

    Returns:
        The log, not yet validated.

    Raises:
        CfbError: unreadable or damaged file, required topics that were not logged, fewer than two rows.
    """
    from pyulog import ULog

    path = Path(path)
    if not isinstance(mapping, VariableMap):
        mapping = load_mapping(shipped("configs", "logs", "px4.yaml") if mapping is None else mapping)
    wanted = {v for choices in mapping.choices.values() for c in choices for v in c.variables}
    said = io.StringIO()
    data = read_bytes(path)
    whole = _framed(data)
    if whole[0] == len(data) and not any(data[at + 2] == ord("D") for at in whole[1]):
        raise CfbError(f"{path}: the PX4 ULog holds no data, only definitions; give the log of a flight.")
    try:
        if not any(data[at + 2] in b"AL" for at in whole[1]):
            raise ValueError("it ends before its data")
        # pyulog reports damage by printing.
        with contextlib.redirect_stdout(said):
            log = ULog(io.BytesIO(data[: whole[0]]), sorted({name.split(".")[0] for name in wanted}))
    except Exception as error:  # damaged bytes raise errors of struct, lookups and text
        reason = str(error).splitlines()[0][:120] if str(error) else type(error).__name__
        raise CfbError(f"{path}: the PX4 ULog is damaged or cut short ({reason}); copy it again.") from None
    notes: list[str] = ["a PX4 ULog has no checksums, so damage to values in it would go unnoticed."]
    warnings: list[str] = []
    if log.file_corruption or said.getvalue() or whole[0] < len(data):
        warnings.append("the PX4 ULog is damaged in places; the damaged parts were left out.")
    streams = []
    for data in log.data_list:
        names = {f"{data.name}.{field}": field for field in data.data if f"{data.name}.{field}" in wanted}
        if data.multi_id == 0 and names and "timestamp" in data.data:
            time = data.data["timestamp"].astype(np.float64) * 1e-6
            values = {name: np.asarray(data.data[field], np.float64) for name, field in names.items()}
            streams.append(ordered(Stream(data.name, time, values), path, notes, overtaking=0.1))
    try:
        return assemble(Import("ulog", streams, None, notes, warnings), mapping, path)
    except CfbError as error:
        raise CfbError(f"{path}: the PX4 ULog: {str(error).removeprefix(f'{path}: ')}") from None


_HEADER = 16
_DEFINITIONS, _DATA = frozenset(b"BFIMPQ"), frozenset(b"ARDLCSO")


def _framed(data: bytes) -> tuple[int, list[int]]:
    """Length of the valid part of the file, and the position of each message in it.

    Only that part is given to pyulog, because on damaged data pyulog may search for the next message forever.
    """
    at, starts = _HEADER, []
    while at + 3 <= len(data):
        size = int.from_bytes(data[at : at + 2], "little")
        if data[at + 2] not in _DEFINITIONS | _DATA or at + 3 + size > len(data):
            break
        starts.append(at)
        at += 3 + size
    return at, starts
