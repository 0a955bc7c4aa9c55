"""Reader of csv files with firmware variable names as headers: what cfclient and scripts around cflib write.

cfclient (``logdatawriter.py`` of bitcraze/crazyflie-clients-python) writes one file per log block: ``Timestamp`` in ms
and the block's variables. Tables of several blocks leave cells empty where a block has no packet at a time.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from cfb_mjx.errors import CfbError
from cfb_mjx.logs.assembly import Import, assemble
from cfb_mjx.logs.flight_log import FlightLog
from cfb_mjx.logs.streams import RADIO_WRAP_MS, Stream, ordered, unwrap
from cfb_mjx.logs.tabular import Table, Text, read_table, require_numbers
from cfb_mjx.logs.variables import VariableMap, load_mapping

_PREFIXES = ("stateEstimate.", "stateEstimateZ.", "gyro.", "motor.", "acc.", "stabilizer.", "kalman.")
_TIME_NAMES = ("timestamp", "timestamp_ms", "time_ms", "time", "t")  # the first of these that is there
_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6}
_SHORTEST, _LONGEST = 2e-4, 0.45  # s: no log block is faster or slower than this, so the unit must be another


def recognises(columns: Iterable[str]) -> bool:
    """Whether the columns are named after firmware variables."""
    return any(c.startswith(_PREFIXES) for c in columns)


def read_radio_csv(
    path: str | os.PathLike, mapping: str | os.PathLike | VariableMap | None = None, time_unit: str = "ms"
) -> FlightLog:
    """Read a table of firmware variables. `read_log` also validates the content.

    Columns that are filled in the same rows form a stream; streams are merged onto the rows of the gyro, each value
    held until its next one. A time stamp that overflows three bytes of milliseconds is continued.

    Args:
        path: csv (or parquet) with a time column (``Timestamp``) and columns like ``gyro.x``.
        mapping: which variable is which column; a mapping file, or None for ``configs/logs/crazyflie.yaml``.
        time_unit: of the time column: ``ms``, ``us`` or ``s``.

    Raises:
        CfbError: unreadable file, no time column, cells that are not numbers, a time column in another unit or that
            goes back, required variables that were not logged, fewer than two rows.
    """
    path = Path(path)
    return from_columns(read_table(path), path, mapping, time_unit)


def from_columns(
    table: Table, path: Path, mapping: str | os.PathLike | VariableMap | None = None, time_unit: str = "ms"
) -> FlightLog:
    """`read_radio_csv` on columns already in memory."""
    if time_unit not in _UNITS:
        raise CfbError(f"{path}: time_unit must be one of {', '.join(_UNITS)}, not {time_unit!r}.")
    mapping = mapping if isinstance(mapping, VariableMap) else load_mapping(mapping)
    clock = sorted((c for c in table if c.lower() in _TIME_NAMES), key=lambda c: _TIME_NAMES.index(c.lower()))
    if not clock:
        raise CfbError(f"{path}: there is no time column; name it Timestamp (ms).")
    wanted = {v for choices in mapping.choices.values() for c in choices for v in c.variables}
    names = [c for c in table if c in wanted]
    require_numbers(table, [clock[0], *names], path)
    ticks = table[clock[0]]
    if not np.isfinite(ticks).all():
        raise CfbError(
            f"{path}: column {clock[0]} has no value in row {int(np.argmin(np.isfinite(ticks)))} (counted from 0); "
            "every row needs a time."
        )
    notes: list[str] = []
    warnings: list[str] = []
    rows = np.arange(len(ticks))
    if _ends_within_a_line(path):
        rows = rows[:-1]
        warnings.append("the file does not end with a line break, so its last row may be cut short and was left out.")
    ticks = ticks[rows]
    if time_unit == "ms" and len(ticks) and (ticks == np.rint(ticks)).all() and np.abs(ticks).max() < 2.0**62:
        ticks, wraps = unwrap(ticks.astype(np.int64), RADIO_WRAP_MS)
        if wraps:
            notes.append(f"the 24-bit time stamp overflowed {wraps} times; it was continued.")
    time = np.asarray(ticks, dtype=np.float64) * _UNITS[time_unit]
    streams = [ordered(s, path, notes) for s in _streams({n: table[n][rows] for n in names}, time)]
    _check_unit(streams, path, time_unit)
    ignored = [c for c, v in table.items() if c not in wanted and c != clock[0] and not isinstance(v, Text)]
    if ignored:
        notes.append(f"columns not in the mapping were left out: {', '.join(sorted(ignored))}.")
    return assemble(Import("radio_csv", streams, None, notes, warnings), mapping, path)


def _streams(columns: dict[str, np.ndarray], time: np.ndarray) -> list[Stream]:
    """Columns with values in exactly the same rows belong together; each such group is named after its first."""
    groups: dict[bytes, list[str]] = {}
    for name, values in columns.items():
        filled = ~np.isnan(values)
        if filled.any():
            groups.setdefault(np.packbits(filled).tobytes(), []).append(name)
    streams = []
    for names in groups.values():
        rows = ~np.isnan(columns[names[0]])
        streams.append(Stream(f"block of {names[0]}", time[rows], {n: columns[n][rows] for n in names}))
    return streams


def _check_unit(streams: list[Stream], path: Path, time_unit: str) -> None:
    fastest = min((s.interval for s in streams if s.interval > 0), default=None)
    if fastest is not None and not _SHORTEST <= fastest <= _LONGEST:
        others = " or ".join(f"{u!r}" for u in _UNITS if u != time_unit)
        raise CfbError(
            f"{path}: read in {time_unit}, the time advances by {fastest:.3g} s per row, so it is in another unit; "
            f"give time_unit={others}."
        )


def _ends_within_a_line(path: Path) -> bool:
    """Whether a text file lacks its last line break. Parquet, which has its own marks, never does."""
    with open(path, "rb") as file:
        if file.read(4) == b"PAR1":
            return False
        file.seek(-1, os.SEEK_END)
        return file.read(1) not in b"\r\n"
