"""Opening a log of any supported format."""

from __future__ import annotations

import os
from pathlib import Path

from cfb_mjx.errors import CfbError
from cfb_mjx.logs import idsia, mcap_reader, tabular
from cfb_mjx.logs.flight_log import FlightLog
from cfb_mjx.logs.validation import validate

FORMATS = ("mcap", "tabular", "idsia")
_MCAP_MAGIC = b"\x89MCAP"


def read_log(path: str | os.PathLike, format: str | None = None, **options) -> FlightLog:
    """Read and validate a flight log.

    Args:
        path: the file.
        format: ``mcap``, ``tabular`` (parquet or csv) or ``idsia``; None detects it from the file's content.
        **options: for ``idsia`` only, see `cfb_mjx.logs.read_idsia`.

    Raises:
        CfbError: one sentence naming the file, what is wrong with it and what to do.
    """
    path = Path(path)
    table = None
    if format is None:
        format, table = _detect(path)
    if format not in FORMATS:
        raise CfbError(f"{path}: unknown log format {format!r}; choose one of {', '.join(FORMATS)}.")
    if options and format != "idsia":
        raise CfbError(f"{path}: the {format} format has no option {', '.join(sorted(options))}; leave it out.")
    if format == "mcap":
        return validate(mcap_reader.read_mcap(path), path)
    table = tabular.read_table(path) if table is None else table
    if format == "idsia":
        return validate(idsia.from_columns(table, path, **options), path)
    return validate(tabular.from_columns(table, path), path)


def _detect(path: Path):
    try:
        with open(path, "rb") as file:
            head = file.read(len(_MCAP_MAGIC))
    except FileNotFoundError:
        raise CfbError(f"{path}: there is no such file; check the path.") from None
    except OSError as error:
        raise CfbError(
            f"{path}: cannot be read ({error.strerror or error}); check the path and its permissions."
        ) from None
    if head == _MCAP_MAGIC or path.suffix == ".mcap":
        return "mcap", None
    table = tabular.read_table(path)
    return ("idsia" if idsia.recognises(table) else "tabular"), table
