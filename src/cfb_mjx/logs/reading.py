"""Opening a log of any supported format."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from cfb_mjx.errors import CfbError
from cfb_mjx.files import read_bytes
from cfb_mjx.logs import crazyswarm, idsia, mcap_reader, radio_csv, ros_bag, tabular, usd_card
from cfb_mjx.logs.flight_log import FlightLog
from cfb_mjx.logs.validation import validate

FORMATS = ("mcap", "tabular", "idsia", "usd_card", "crazyswarm", "radio_csv")
_OPTIONS = {
    "idsia": ("motor_shift",),
    "usd_card": ("mapping",),
    "crazyswarm": ("mapping", "topics_yaml", "robot"),
    "radio_csv": ("mapping", "time_unit"),
}
_MCAP_MAGIC = b"\x89MCAP"


def read_log(path: str | os.PathLike, format: str | None = None, **options: Any) -> FlightLog:
    """Read and validate a flight log.

    Args:
        path: the file.
        format: one of `FORMATS`; None detects it from the file's content. ``mcap`` is this library's own, ``tabular``
            and ``idsia`` are parquet or csv, ``usd_card`` is the Crazyflie's micro SD card binary, ``crazyswarm`` a
            ROS 2 bag (MCAP), ``radio_csv`` a table with firmware variable names as headers.
        **options: ``motor_shift`` for ``idsia`` (`cfb_mjx.logs.read_idsia`); ``mapping`` for ``usd_card``,
            ``crazyswarm`` and ``radio_csv``; ``topics_yaml`` and ``robot`` for ``crazyswarm``
            (`cfb_mjx.logs.read_crazyswarm`); ``time_unit`` for ``radio_csv`` (`cfb_mjx.logs.read_radio_csv`). An
            option that is None counts as not given.

    Raises:
        CfbError: one sentence naming the file, what is wrong with it and what to do.
    """
    path = Path(path)
    table = None
    if format is None:
        format, table = _detect(path)
    if format not in FORMATS:
        raise CfbError(f"{path}: unknown log format {format!r}; choose one of {', '.join(FORMATS)}.")
    options = {k: v for k, v in options.items() if v is not None}
    if unknown := sorted(set(options) - set(_OPTIONS.get(format, ()))):
        raise CfbError(f"{path}: the {format} format has no option {', '.join(unknown)}; leave it out.")
    if format == "mcap":
        return validate(mcap_reader.read_mcap(path), path)
    if format == "usd_card":
        return validate(usd_card.read_usd_card(path, **options), path)
    if format == "crazyswarm":
        return validate(crazyswarm.read_crazyswarm(path, **options), path)
    table = tabular.read_table(path) if table is None else table
    if format == "idsia":
        return validate(idsia.from_columns(table, path, **options), path)
    if format == "radio_csv":
        return validate(radio_csv.from_columns(table, path, **options), path)
    return validate(tabular.from_columns(table, path), path)


def _detect(path: Path):
    head = read_bytes(path, len(_MCAP_MAGIC))
    if head.startswith(usd_card.MAGIC):
        return "usd_card", None
    if head == _MCAP_MAGIC:
        return ("crazyswarm" if ros_bag.recognises(path) else "mcap"), None
    if path.suffix == ".mcap":
        return "mcap", None
    table = tabular.read_table(path)
    if idsia.recognises(table):
        return "idsia", table
    return ("radio_csv" if radio_csv.recognises(table) else "tabular"), table
