"""Reader of tables with firmware variable names as headers, written by cfclient or by scripts that use cflib.

cfclient (``logdatawriter.py`` of bitcraze/crazyflie-clients-python) writes one file per log block: ``Timestamp`` in ms
and the block's variables. Tables of several blocks have empty cells where a block sent no packet. Scripts use other
separators in names (``stateEstimate_x``), or write one value per line under ``timestamp, name, value``.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from cfb_mjx.errors import CfbError
from cfb_mjx.logs.assembly import Import, assemble
from cfb_mjx.logs.flight_log import FlightLog
from cfb_mjx.logs.streams import RADIO_WRAP_MS, Stream, ordered, unwrap
from cfb_mjx.logs.tabular import Table, Text, read_table, require_numbers
from cfb_mjx.logs.variables import VariableMap, load_mapping

_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
_SHORTEST, _LONGEST = 2e-4, 0.45  # s: limits of the interval of a log block; beyond them the time unit is wrong
_CLOCK = re.compile(
    r"(?P<name>timestamp|time[_ .]?stamp|time[_ .]?tick|tick|time|t|stamp|clock|elapsed)"
    r"[_ .]*[\[(]?(?P<unit>s|sec|seconds|ms|us|ns)?[\])]?",
    re.IGNORECASE,
)
_CLOCKS = ("timestamp", "timetick", "tick", "time", "t", "stamp", "clock", "elapsed")
_HOST = re.compile(r"(host|pc|ros|unix|wall|system|log)[_ .]?(time|stamp|timestamp)?.*", re.IGNORECASE)
_LONG = ({"name", "variable", "var", "key", "topic"}, {"value", "val", "data"})
_PREFIX = re.compile(r"(?P<head>[A-Za-z0-9]+)[._/ :](?P<rest>.+[._/ :].+)")
_NOT_MEASURED = frozenset(["sp", "ref", "des", "cmd", "target", "goal", "setpoint", "desired", "reference"])
_FEWEST = 3  # columns with firmware names from which a table is read as this format


class Clock(NamedTuple):
    """The time column of a table."""

    column: str
    unit: str | None
    """Unit in the column's name; None if the name has none."""


def recognises(columns: Iterable[str], mapping: VariableMap) -> bool:
    """Whether columns have names of logged variables, or the table has a name column and a value column."""
    columns = list(columns)
    return len(_variables(columns, mapping)) >= _FEWEST or _long_form(columns) is not None


def clock_of(columns: Iterable[str]) -> Clock | None:
    """The time column. The firmware's clock is preferred to the computer's, and a full name to ``t``."""
    found = []
    for column in columns:
        match = _CLOCK.fullmatch(column.strip())
        if match:
            unit = (match["unit"] or "").lower() or None
            unit = "s" if unit in ("sec", "seconds") else unit
            found.append((_CLOCKS.index(re.sub("[_ .]", "", match["name"].lower())), Clock(column, unit)))
        elif _HOST.fullmatch(column.strip()):
            found.append((len(_CLOCKS), Clock(column, None)))
    return min(found, key=lambda pair: pair[0])[1] if found else None


def read_radio_csv(
    path: str | os.PathLike | Sequence[str | os.PathLike],
    mapping: str | os.PathLike | VariableMap | None = None,
    time_unit: str | None = None,
    robot: str | None = None,
) -> FlightLog:
    """Read tables of named variables. `read_log` also validates the content.

    Columns that are filled in the same rows form a stream. The streams of all files are merged onto the rows of the
    gyro, and each value is held until the next one. Overflows of the 24-bit time stamp (in ms) are undone.

    Args:
        path: csv (or parquet) with a time column (``Timestamp``) and columns like ``gyro.x``; or several files of one
            flight (cfclient writes one per log block).
        mapping: assigns variables to columns of the log; a mapping file, or None for ``configs/logs/crazyflie.yaml``.
        time_unit: unit of the time column: ``s``, ``ms``, ``us`` or ``ns``. None takes the unit from the column's name;
            without one, ms for a ``Timestamp``, and for other columns the unit that gives plausible intervals.
        robot: the drone to read, if variable names have the names of several drones as prefixes (``cf3/gyro.x``).

    Returns:
        The log, not yet validated.

    Raises:
        CfbError: unreadable file, no time column, cells that are not numbers, time in another unit or running
            backwards, required variables that were not logged, fewer than two rows.
    """
    paths = [Path(path)] if isinstance(path, str | os.PathLike) else [Path(p) for p in path]
    return from_columns([(read_table(p), p) for p in paths], mapping, time_unit, robot)


def from_columns(
    tables: Sequence[tuple[Table, Path]],
    mapping: str | os.PathLike | VariableMap | None = None,
    time_unit: str | None = None,
    robot: str | None = None,
) -> FlightLog:
    """`read_radio_csv` on columns already in memory."""
    first = tables[0][1]
    if time_unit is not None and time_unit not in _UNITS:
        raise CfbError(f"{first}: --time-unit must be one of {', '.join(_UNITS)}, not {time_unit!r}.")
    mapping = mapping if isinstance(mapping, VariableMap) else load_mapping(mapping)
    notes: list[str] = []
    warnings: list[str] = []
    streams: list[Stream] = []
    for table, path in tables:
        whose = f"{path.name}: " if len(tables) > 1 else ""
        notes += [f"{whose}{note}" for note in table.notes]
        warnings += [f"{whose}{warning}" for warning in table.warnings]
        streams += _of_table(table, path, mapping, time_unit, robot, notes)
    _require_one_flight(tables, streams)
    return assemble(Import("radio_csv", streams, None, notes, warnings), mapping, first)


def _of_table(
    table: Table, path: Path, mapping: VariableMap, time_unit: str | None, robot: str | None, notes: list[str]
) -> list[Stream]:
    long = _long_form(table)
    if long is not None:
        return _of_long_form(table, *long, path, mapping, time_unit, robot, notes)
    clock = clock_of(table)
    if clock is None:
        raise CfbError(f"{path}: there is no time column; name it Timestamp (ms) or t (s).")
    named = _of_one_drone(table, mapping, path, robot)
    require_numbers(table, [clock.column, *named.values()], path)
    ticks = table.numbers(clock.column)
    if not np.isfinite(ticks).all():
        raise CfbError(
            f"{path}: column {clock.column} has no value in row {int(np.argmin(np.isfinite(ticks)))} (counted from 0); "
            "every row needs a time."
        )
    time, unit = _seconds(ticks, clock, time_unit, path, notes)
    streams = [ordered(s, path, notes) for s in _streams({n: table.numbers(c) for n, c in named.items()}, time)]
    _check_unit(streams, path, unit)
    known = {*named.values(), clock.column}
    ignored = [c for c, v in table.items() if c not in known and not isinstance(v, Text)]
    if ignored:
        notes.append(f"columns not in the mapping were left out: {', '.join(sorted(ignored))}.")
    return streams


def _variables(columns: Iterable[str], mapping: VariableMap) -> dict[str, str]:
    """Logged name to column. Separators and a prefix in the column's name are ignored."""
    return {name: same[0] for name, same in _candidates(columns, mapping).items()}


def _candidates(columns: Iterable[str], mapping: VariableMap) -> dict[str, list[str]]:
    """Logged name to the columns that may hold it; more than one if a table holds several drones."""
    columns = list(columns)
    wanted = _bare_names(mapping)
    found: dict[str, str] = {}
    for column in columns:
        name = wanted.get(_bare(column))
        if name is not None and (name not in found or column == name):
            found[name] = column
    candidates = {name: [column] for name, column in found.items()}
    for column in columns:
        # "cf3/stateEstimate.x", "est_stateEstimate_x"
        match = _PREFIX.fullmatch(column.strip())
        if match is None:
            continue
        name = wanted.get(_bare(match["rest"]))
        if name is not None and name not in found and match["head"].lower() not in _NOT_MEASURED:
            candidates.setdefault(name, []).append(column)
    return candidates


def logged_names(names: Iterable[str], mapping: VariableMap) -> dict[str, str]:
    """Name to the logged variable that it ends with: ``cf1.log.gyro.x`` to ``gyro.x``."""
    wanted = _bare_names(mapping)
    found = {}
    for name in names:
        parts = re.split(r"[._/ :]", name)
        ends = ("".join(parts[k:]).lower() for k in range(len(parts) - 1))
        told = next((wanted[end] for end in ends if end in wanted), None)
        if told is not None:
            found[name] = told
    return found


def _of_one_drone(columns: Iterable[str], mapping: VariableMap, path: Path, robot: str | None) -> dict[str, str]:
    """Logged name to column, for the requested drone if there are several."""
    candidates = _candidates(columns, mapping)
    heads = {c: _PREFIX.fullmatch(c.strip()) for same in candidates.values() for c in same}
    drones = {m["head"] for same in candidates.values() if len(same) > 1 for c in same if (m := heads[c])}
    if robot is not None:
        mine = {n: [c for c in same if (m := heads[c]) and m["head"] == robot] for n, same in candidates.items()}
        if not any(mine.values()):
            there = f"those of {', '.join(sorted(drones))}" if drones else "those of one drone, without its name"
            raise CfbError(f"{path}: has no columns of {robot}, only {there}.")
        return {name: same[0] for name, same in mine.items() if same}
    if drones:
        raise CfbError(
            f"{path}: holds the flights of several drones ({', '.join(sorted(drones))}); choose one with --robot "
            f"{min(drones)}."
        )
    return {name: same[0] for name, same in candidates.items()}


def _bare_names(mapping: VariableMap) -> dict[str, str]:
    """The mapping's names, keyed by the same names without separators."""
    return {_bare(v): v for choices in mapping.choices.values() for c in choices for v in c.variables}


def _bare(name: str) -> str:
    return re.sub(r"[\s._/:-]", "", name).lower()


def _long_form(columns: Iterable[str]) -> tuple[str, str] | None:
    """Name column and value column of a table with one value per line; None for any other table."""
    by_name = {c.strip().lower(): c for c in columns}
    name, value = (next((by_name[n] for n in sorted(names) if n in by_name), None) for names in _LONG)
    return None if name is None or value is None or len(by_name) > 5 else (name, value)


def _of_long_form(table, name_column, value_column, path, mapping, time_unit, robot, notes) -> list[Stream]:
    clock = clock_of([c for c in table if c not in (name_column, value_column)])
    if clock is None:
        raise CfbError(f"{path}: there is no time column; name it timestamp (ms) or t (s).")
    require_numbers(table, [clock.column, value_column], path)
    names = table[name_column]
    if not isinstance(names, Text):
        raise CfbError(f"{path}: column {name_column} holds numbers instead of names of variables.")
    labels = np.array(names.cells, dtype=object)
    wanted = _of_one_drone(dict.fromkeys(labels), mapping, path, robot)
    time, unit = _seconds(table[clock.column], clock, time_unit, path, notes)
    values, streams, groups = table[value_column], [], {}
    for variable, label in wanted.items():
        rows = np.flatnonzero((labels == label) & np.isfinite(time))
        groups.setdefault(time[rows].tobytes(), []).append((variable, rows))
    for members in groups.values():
        rows = members[0][1]
        stream = Stream(f"block of {members[0][0]}", time[rows], {v: values[r] for v, r in members})
        streams.append(ordered(stream, path, notes))
    _check_unit(streams, path, unit)
    return streams


def _seconds(
    ticks: np.ndarray, clock: Clock, asked: str | None, path: Path, notes: list[str]
) -> tuple[np.ndarray, str]:
    """Time in s, and the unit in which the column was read."""
    unit = asked or clock.unit or _guessed_unit(ticks, clock)
    if unit == "ms" and len(ticks) and (ticks == np.rint(ticks)).all() and np.abs(ticks).max() < 2.0**62:
        ticks, wraps = unwrap(ticks.astype(np.int64), RADIO_WRAP_MS)
        if wraps:
            notes.append(f"the 24-bit time stamp overflowed {wraps} times; this was undone.")
    if asked is None and clock.unit is None and unit != "ms":
        notes.append(f"column {clock.column} was read in {unit}, because this gives plausible sampling intervals.")
    return np.asarray(ticks, dtype=np.float64) * _UNITS[unit], unit


def _guessed_unit(ticks: np.ndarray, clock: Clock) -> str:
    if _bare(clock.column) in ("timestamp", "timetick"):
        return "ms"
    steps = np.diff(np.unique(ticks))
    step = float(np.median(steps)) if len(steps) else 1.0
    return next((u for u, factor in _UNITS.items() if _SHORTEST <= step * factor <= _LONGEST), "ms")


def _streams(columns: dict[str, np.ndarray], time: np.ndarray) -> list[Stream]:
    """One stream per group of columns with values in the same rows, named after its first column."""
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


def _check_unit(streams: list[Stream], path: Path, unit: str) -> None:
    fastest = min((s.interval for s in streams if s.interval > 0), default=None)
    if fastest is None or _SHORTEST <= fastest <= _LONGEST:
        return
    fitting = [u for u, factor in _UNITS.items() if _SHORTEST <= fastest / _UNITS[unit] * factor <= _LONGEST]
    remedy = f"give --time-unit {fitting[0]}" if fitting else "give the right one with --time-unit"
    raise CfbError(
        f"{path}: read in {unit}, the time advances by {fastest:.3g} s per row, so it is in another unit; {remedy}."
    )


def _require_one_flight(tables: Sequence[tuple[Table, Path]], streams: list[Stream]) -> None:
    """Refuse several files whose recordings do not overlap in time."""
    if len(tables) < 2 or not streams:
        return
    latest_start, earliest_end = max(s.time[0] for s in streams), min(s.time[-1] for s in streams)
    if latest_start > earliest_end:
        late = max(streams, key=lambda s: s.time[0])
        raise CfbError(
            f"{', '.join(str(path) for _, path in tables)}: these are not one flight: {late.name} begins at "
            f"{latest_start:.3f} s, after another has ended ({earliest_end:.3f} s); import each flight separately."
        )
