"""Read a log of any supported format."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cfb_mjx.errors import CfbError
from cfb_mjx.files import read_bytes
from cfb_mjx.logs import (
    arrays,
    containers,
    crazyswarm,
    foxglove,
    idsia,
    mcap_reader,
    radio_csv,
    ros_bag,
    tabular,
    ulog,
    usd_card,
)
from cfb_mjx.logs.fixes import Fix, fix_of
from cfb_mjx.logs.flight_log import FlightLog
from cfb_mjx.logs.flown import flown_part, without_spans
from cfb_mjx.logs.gate import Verdict
from cfb_mjx.logs.mcap_stream import MAGIC
from cfb_mjx.logs.proposal import UnknownNames, lacking, propose
from cfb_mjx.logs.validation import examine
from cfb_mjx.logs.variables import MissingNames, VariableMap, load_mapping, mapping_of

FORMATS = ("mcap", "tabular", "idsia", "usd_card", "crazyswarm", "radio_csv", "ulog", "foxglove")
_OPTIONS = {
    "idsia": ("motor_shift",),
    "usd_card": ("mapping", "motion_capture"),
    "crazyswarm": ("mapping", "topics_yaml", "robot", "motion_capture"),
    "radio_csv": ("mapping", "time_unit", "robot", "motion_capture"),
    "ulog": ("mapping",),
    "foxglove": ("mapping", "motion_capture"),
}
_FLAGS = {name: "--" + name.replace("_", "-") for names in _OPTIONS.values() for name in names}


def read_log(
    path: str | os.PathLike | Sequence[str | os.PathLike],
    format: str | None = None,
    *,
    keep_ground: bool = False,
    cut: Sequence[str] = (),
    fix: Sequence[str] = (),
    **options: Any,
) -> FlightLog:
    """Read and validate a flight log.

    Args:
        path: the file; the folder of a ROS 2 bag; or several tables of one flight (cfclient writes one per log block).
        format: one of `FORMATS`; None detects it from the content. ``mcap`` is this library's own format, ``tabular``
            and ``idsia`` are parquet or csv, ``usd_card`` is the Crazyflie's micro SD card binary, ``crazyswarm`` a
            ROS bag (MCAP, sqlite3 or ROS 1), ``radio_csv`` a table with firmware variable names as headers, ``ulog`` a
            log of PX4, ``foxglove`` an MCAP of JSON or protobuf messages. Named arrays (.npz, .mat) are read as tables.
        keep_ground: keep rows that are not flight: standing, take-off, landing, being carried. Rows of this library's
            own files are never cut.
        cut: spans to leave out, in s of the log's own time: ``12.5:15``, ``:3`` (all up to 3 s), ``40:``.
        fix: changes of convention to apply, in this order, as named in the error message of a refused log:
            ``velocity-frame=body`` (`cfb_mjx.logs.fixes`). Conventions are never changed automatically.
        **options: ``motor_shift`` for ``idsia`` (`cfb_mjx.logs.read_idsia`); ``mapping`` for ``usd_card``,
            ``crazyswarm``, ``radio_csv``, ``ulog`` and ``foxglove``; ``topics_yaml`` for ``crazyswarm``
            (`cfb_mjx.logs.read_crazyswarm`); ``time_unit`` for ``radio_csv`` (`cfb_mjx.logs.read_radio_csv`); ``robot``
            for both; ``motion_capture=True`` takes pose and velocity from motion capture that was logged together with
            the estimate (`cfb_mjx.logs.motion_capture`). An option that is None or False counts as not given.

    Returns:
        The validated log.

    Raises:
        UnknownNames: the table has unknown column names, for which a mapping can be proposed.
        CfbError: the log cannot be read or is refused. One sentence names the file, the error and the remedy.
    """
    return read_judged(path, format, keep_ground=keep_ground, cut=cut, fix=fix, **options)[0]


def read_judged(
    path: str | os.PathLike | Sequence[str | os.PathLike],
    format: str | None = None,
    *,
    keep_ground: bool = False,
    cut: Sequence[str] = (),
    fix: Sequence[str] = (),
    **options: Any,
) -> tuple[FlightLog, Verdict]:
    """As `read_log`; also returns the result of comparing the log's signals with each other."""
    several = not isinstance(path, str | os.PathLike)
    paths = [Path(p) for p in path] if several else [Path(path)]
    if not paths:
        raise CfbError("no log was given; give one.")
    options = {k: v for k, v in options.items() if v is not None and v is not False}
    first, tables = paths[0], {}
    if format is None:
        format = _detect(paths, options, tables)
    if format not in FORMATS:
        raise CfbError(f"{first}: unknown log format {format!r}; choose one of {', '.join(FORMATS)}.")
    if len(paths) > 1 and format != "radio_csv":
        raise CfbError(
            f"{', '.join(map(str, paths))}: several files can be one flight only if they are tables of log blocks, but "
            f"{first} has the format {format}; import them one by one."
        )
    if unknown := sorted(set(options) - set(_OPTIONS.get(format, ()))):
        flags = ", ".join(_FLAGS.get(name, name) for name in unknown)
        raise CfbError(f"{first}: the {format} format has no option {flags}; leave it out.")
    changes = [fix_of(name) for name in fix]
    # Damaged values, or values in a wrong unit, may overflow; the checks report them.
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        return _checked(paths, format, options, tables, changes, cut, keep_ground)


def _checked(
    paths: list[Path],
    format: str,
    options: dict[str, Any],
    tables: dict[Path, tabular.Table],
    changes: list[Fix],
    cut: Sequence[str],
    keep_ground: bool,
) -> tuple[FlightLog, Verdict]:
    first = paths[0]
    log = _read(paths, format, options, tables)
    for change in changes:
        log = change.apply(log)
    if changes:
        told = [f"--fix {change.name}: {change.words}, as asked." for change in changes]
        log = log.replace(metadata={"notes": [*(log.metadata.get("notes") or ()), *told]})
    log = without_spans(log, cut, first)
    if format in ("mcap", "idsia"):  # mcap was cut when it was imported; idsia has rules of its own
        return examine(log, first)
    return examine(flown_part(log, first, keep_ground), first)


def _read(paths: list[Path], format: str, options: dict[str, Any], tables: dict[Path, tabular.Table]) -> FlightLog:
    path = paths[0]
    if options.get("motion_capture"):
        mapping = options.get("mapping")
        mapping = mapping if isinstance(mapping, VariableMap) else load_mapping(mapping)
        options = options | {"mapping": dataclasses.replace(mapping, by_motion_capture=True)}
    options = {name: value for name, value in options.items() if name != "motion_capture"}
    if format == "mcap":
        return mcap_reader.read_mcap(path)
    if format == "usd_card":
        return usd_card.read_usd_card(path, **options)
    if format == "ulog":
        return ulog.read_ulog(path, **options)
    if format == "foxglove":
        return foxglove.read_foxglove(path, **options)
    if format == "crazyswarm":
        return crazyswarm.read_crazyswarm(path, **options)
    found = [tables.get(p) or _table(p) for p in paths]
    if format != "idsia" and "mapping" not in options:
        return _or_proposed(found, paths, format, options)
    if format == "idsia":
        return idsia.from_columns(found[0], path, **options)
    return _of_tables(found, paths, format, options)


def _of_tables(tables: list[tabular.Table], paths: list[Path], format: str, options: dict[str, Any]) -> FlightLog:
    if format == "radio_csv":
        return radio_csv.from_columns(list(zip(tables, paths, strict=True)), **options)
    return tabular.from_columns(tables[0], paths[0])


def _or_proposed(tables: list[tabular.Table], paths: list[Path], format: str, options: dict[str, Any]) -> FlightLog:
    """The log. For columns with unknown names, raise `UnknownNames` with a proposed mapping."""
    try:
        return _of_tables(tables, paths, format, options)
    except MissingNames as error:
        if sum(name in tables[0] for names in tabular.COLUMNS.values() for name in names) > _OWN_LAYOUT:
            raise  # this library's own layout, with columns missing
        proposal = propose(tables[0]) if len(tables) == 1 else None
        if proposal is None and format == "tabular":
            raise CfbError(f"{paths[0]}: {_not_told(tables[0], read_bytes(paths[0], 64), paths[0])}.") from None
        if proposal is None:
            raise
        raise UnknownNames(
            f"{paths[0]}: its columns have unknown names, which look like {', '.join(proposal.fields)}; cfb import "
            "writes a proposed mapping: check it, then give it with --mapping FILE.",
            proposal.text,
        ) from error


def _not_told(table: tabular.Table, head: bytes, path: Path) -> str:
    """Why a table with unknown column names cannot be read as a flight, and the remedy."""
    names = list(table)
    listed = ", ".join(names[:_LISTED]) + (f" and {len(names) - _LISTED} more" if len(names) > _LISTED else "")
    what = f"{arrays.kind(head)} has arrays" if arrays.recognises(path, head) else "it has columns"
    missing = ", ".join(lacking(table)) or "more than one row"
    return (
        f"{what} {listed}, and none is known by its name to hold {missing}; record that too, or name the columns with "
        f"--mapping FILE, a changed copy of configs/logs/crazyflie.yaml, or rename them to {tabular.LAYOUT}"
    )


def _table(path: Path) -> tabular.Table:
    head = read_bytes(path, 64)
    return arrays.read_arrays(path) if arrays.recognises(path, head) else tabular.read_table(path)


_OWN_LAYOUT = 17  # a table with more of the tabular layout's columns than this is in that layout
_LISTED = 12  # most column names in a message


def _detect(paths: list[Path], options: dict[str, Any], tables: dict[Path, tabular.Table]) -> str:
    """The format of files, detected from their content.

    Tables read for this are stored in ``tables``, and the mapping of a known data set in ``options``.
    """
    path = paths[0]
    if path.is_dir():
        if (path / "metadata.yaml").exists():
            return "crazyswarm"
        raise CfbError(f"{path}: this is a folder, but not the folder of a ROS 2 bag; give the log itself.")
    head = read_bytes(path, 64)
    if head.startswith(ulog.MAGIC):
        return "ulog"
    if head.startswith((ros_bag.SQLITE, ros_bag.ROS1)):
        return "crazyswarm"
    if head.startswith(usd_card.MAGIC):
        return "usd_card"
    if head.startswith(MAGIC[:5]):
        if ros_bag.recognises(path):
            return "crazyswarm"
        return "foxglove" if foxglove.recognises(path) else "mcap"
    by_name = arrays.recognises(path, head)
    if not by_name and (foreign := containers.name_of(path, head)) is not None:
        raise CfbError(f"{path}: this is {foreign[0]}, which this library does not read; {foreign[1]}.")
    if path.suffix == ".mcap":
        return "mcap"
    for one in paths:
        tables[one] = _table(one)
    table = tables[path]
    if idsia.recognises(table):
        return "idsia"
    if "mapping" not in options and (known := mapping_of(table)) is not None:
        options["mapping"] = known
    if "mapping" in options or radio_csv.recognises(table, load_mapping()):
        return "radio_csv"
    return "tabular"
