"""Reader and writer of the tabular flight log (parquet or csv): one row per sample, one column per number."""

from __future__ import annotations

import os
from pathlib import Path
from typing import NamedTuple

import numpy as np

from cfb_mjx.errors import CfbError
from cfb_mjx.files import read_bytes, replacing
from cfb_mjx.logs.flight_log import FlightLog, quantise_time
from cfb_mjx.logs.text_table import read_text_table
from cfb_mjx.logs.variables import MissingNames

COLUMNS = {
    "time": ("t",),
    "position": ("px", "py", "pz"),
    "velocity": ("vx", "vy", "vz"),
    "quaternion": ("qw", "qx", "qy", "qz"),
    "body_rate": ("wx", "wy", "wz"),
    "specific_force": ("ax", "ay", "az"),
    "command": ("u1", "u2", "u3", "u4"),
}
OPTIONAL_COLUMNS = {"rotor_speed": ("omega1", "omega2", "omega3", "omega4"), "battery_voltage": ("vbat",)}
LAYOUT = (
    "t, px py pz, vx vy vz, qw qx qy qz, wx wy wz, ax ay az, u1..u4 and optionally omega1..omega4, vbat "
    "(see docs/logs.md)"
)


_MOST_CELLS = 1 << 28  # a flight of one hour at 1 kHz in 40 columns has half as many


class Text(NamedTuple):
    """A column that does not hold numbers: its first such cell (row counted from 0, content), and all cells as text."""

    row: int
    cell: str
    cells: list[str]


class Table(dict[str, np.ndarray | Text]):
    """Columns by name.

    Attributes:
        notes: what the reader did.
        warnings: what the reader left out.
    """

    def __init__(self, columns=(), notes: list[str] | None = None, warnings: list[str] | None = None):
        super().__init__(columns)
        self.notes = [] if notes is None else notes
        self.warnings = [] if warnings is None else warnings

    def numbers(self, column: str) -> np.ndarray:
        """A column that holds numbers; check it with `require_numbers` first."""
        values = self[column]
        assert not isinstance(values, Text), f"column {column} holds text"
        return values


def read_table(path: str | os.PathLike) -> Table:
    """Read a parquet or text file, every numeric column as float64.

    Args:
        path: a parquet file (recognised by its first bytes) or a text with a header line (`read_text_table`).

    Returns:
        Column name to (n,) array with NaN for missing cells, or to `Text` for columns that do not hold numbers.

    Raises:
        CfbError: the file is missing, empty, damaged, or not a table.
    """
    import pyarrow as pa

    path = Path(path)
    head = read_bytes(path, 4)
    if not head:
        raise CfbError(f"{path}: the file is empty; export the log again.")
    is_parquet = head == b"PAR1"
    said: tuple[list[str], list[str]] = [], []
    try:
        table = _to_arrays(_parquet(path, said[0]) if is_parquet else read_text_table(path, read_bytes(path), *said))
    except (pa.ArrowException, OSError, ValueError, KeyError, OverflowError, MemoryError, RuntimeError) as error:
        kind = "parquet" if is_parquet else "csv"
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise CfbError(
            f"{path}: not a readable {kind} table, the file is damaged or cut short ({reason}); export it again."
        ) from None
    if not table:
        raise CfbError(f"{path}: the table has no columns; the layout is {LAYOUT}.")
    return Table(table, *said)


def require_numbers(table: Table, columns: list[str], path: Path) -> None:
    """Check that ``columns`` hold numbers; raise `CfbError` for the first one that does not."""
    for column in columns:
        if isinstance(table[column], Text):
            row, cell, _ = table[column]
            raise CfbError(
                f"{path}: column {column} holds {cell!r} in row {row} (counted from 0) instead of a number; "
                "export it as plain decimal numbers and leave missing cells empty."
            )


def _parquet(path: Path, notes: list[str]):
    import pyarrow.parquet as pq

    # Not read_table, because it guesses partitions from folder names.
    with pq.ParquetFile(path, memory_map=False, page_checksum_verification=True) as file:
        footer = file.metadata
        if footer.num_rows * max(footer.num_columns, 1) > _MOST_CELLS:
            raise CfbError(
                f"{path}: the table has {footer.num_rows} rows and {footer.num_columns} columns, more than a flight "
                "has; export only the flight."
            )
        table = file.read()
        if not _has_checksums(path, footer):
            _compare_with_footer(path, footer, table)
            notes.append("the parquet file has no checksums, so damage to values in it would go unnoticed.")
    return table


def _has_checksums(path: Path, footer) -> bool:
    """Whether the first page of every column has a CRC, which is the fourth field of its header (Thrift, compact)."""
    with open(path, "rb") as file:
        for group in range(footer.num_row_groups):
            for index in range(footer.num_columns):
                column = footer.row_group(group).column(index)
                file.seek(column.dictionary_page_offset or column.data_page_offset)
                head, at = file.read(40), 0
                for _ in range(3):  # type of page, its size, its compressed size
                    if at >= len(head) or head[at] & 0x0F != 5:
                        return False
                    at += 1
                    while at < len(head) and head[at] & 0x80:
                        at += 1
                    at += 1
                if at >= len(head) or head[at] != 0x15:
                    return False
    return True


def _compare_with_footer(path: Path, footer, table) -> None:
    """Refuse values outside the minimum and maximum stored in the footer."""
    import pyarrow.compute as pcm

    for index in range(footer.num_columns):
        groups = [footer.row_group(g).column(index) for g in range(footer.num_row_groups)]
        noted = [c.statistics for c in groups if c.statistics is not None and c.statistics.has_min_max]
        name = groups[0].path_in_schema if groups else ""
        if len(noted) < len(groups) or table.column_names.count(name) != 1:
            continue
        found = pcm.call_function("min_max", [table[name]]).as_py()
        low, high = min(s.min for s in noted), max(s.max for s in noted)
        if found["min"] is not None and (found["min"] < low or found["max"] > high):
            raise CfbError(
                f"{path}: column {name} holds values beyond {low} to {high}, the range stored by its writer, so the "
                "file is damaged; copy it again."
            )


def _to_arrays(table) -> dict[str, np.ndarray | Text]:
    import pyarrow as pa
    import pyarrow.compute as pcm

    names = [name.strip() for name in table.column_names]
    if twice := sorted({n for n in names if names.count(n) > 1}):
        raise ValueError(f"column {twice[0]!r} appears twice")
    arrays: dict[str, np.ndarray | Text] = {}
    for name, column in zip(names, table.columns, strict=True):
        kind = column.type
        if pa.types.is_null(kind):
            arrays[name] = np.full(len(column), np.nan)
        elif pa.types.is_integer(kind) or pa.types.is_floating(kind) or pa.types.is_decimal(kind):
            arrays[name] = pcm.cast(column, pa.float64(), safe=False).to_numpy().astype(np.float64)
        else:
            arrays[name] = _first_text(column)
    return arrays


def _first_text(column) -> Text:
    cells = [str(cell) for cell in column.to_pylist()]
    for row, cell in enumerate(cells):
        try:
            float(cell)
        except ValueError:
            return Text(row, cell[:40], cells)
    return Text(0, cells[0][:40] if cells else "", cells)


def read_tabular(path: str | os.PathLike) -> FlightLog:
    """Read the tabular layout (parquet or csv). `read_log` also validates the content.

    Raises:
        CfbError: unreadable file, missing columns (all are listed), cells that are not numbers.
    """
    path = Path(path)
    return from_columns(read_table(path), path)


def from_columns(table: Table, path: Path) -> FlightLog:
    """Build a log from columns in the tabular layout. ``path`` is the file, for messages and metadata."""
    missing = [c for names in COLUMNS.values() for c in names if c not in table]
    partial = [
        c for names in OPTIONAL_COLUMNS.values() if any(c in table for c in names) for c in names if c not in table
    ]
    if missing or partial:
        raise MissingNames(
            f"{path}: missing column{'s' * (len(missing + partial) > 1)} {', '.join(missing + partial)}; "
            f"the tabular layout is {LAYOUT}."
        )
    known = [c for names in (COLUMNS | OPTIONAL_COLUMNS).values() for c in names if c in table]
    require_numbers(table, known, path)

    def stack(names: tuple[str, ...]) -> np.ndarray:
        return table.numbers(names[0]) if len(names) == 1 else np.stack([table.numbers(c) for c in names], axis=1)

    def measured(field: str) -> np.ndarray | None:
        """The columns of an optional field; None if they are missing or have no values."""
        names = OPTIONAL_COLUMNS[field]
        values = stack(names) if names[0] in table else None
        return None if values is None or np.isnan(values).all() else values

    fields = {field: stack(names) for field, names in COLUMNS.items()}
    rotor_speed, battery_voltage = measured("rotor_speed"), measured("battery_voltage")
    notes = list(table.notes)
    if battery_voltage is not None and np.isnan(battery_voltage).any():
        battery_voltage = _held(battery_voltage)
        notes.append("vbat has values in some rows only; each was held until the next.")
    if np.isfinite(fields["time"]).all() and np.abs(fields["time"]).max(initial=0.0) < 1e12:
        fields["time"] = quantise_time(fields["time"])
    metadata = {"name": path.stem, "source": path.name, "format": "tabular", "observation_delay": None}
    if notes or table.warnings:
        metadata |= {"warnings": list(table.warnings), "notes": notes}
    return FlightLog(**fields, rotor_speed=rotor_speed, battery_voltage=battery_voltage, metadata=metadata)


def _held(values: np.ndarray) -> np.ndarray:
    """Forward-fill NaN; rows before the first known value get that value."""
    known = np.flatnonzero(~np.isnan(values))
    return values[known[np.maximum(np.searchsorted(known, np.arange(len(values)), side="right") - 1, 0)]]


def write_tabular(log: FlightLog, path: str | os.PathLike) -> None:
    """Write the tabular layout, float64, as parquet or csv, according to the ending of ``path``. Metadata is not kept.

    Raises:
        CfbError: the path ends in neither ``.parquet`` nor ``.csv``, or cannot be written.
    """
    import pyarrow as pa
    import pyarrow.csv as pc
    import pyarrow.parquet as pq

    path = Path(path)
    if path.suffix not in (".parquet", ".csv"):
        raise CfbError(f"{path}: a tabular log is written as .parquet or .csv; give the file one of these endings.")
    columns = {}
    for field, names in (COLUMNS | OPTIONAL_COLUMNS).items():
        values = getattr(log, field)
        if values is not None:
            columns |= dict(zip(names, np.reshape(values, (len(log), len(names))).T, strict=True))
    # from_pandas=True turns NaN (an invalid rotor speed) into a missing cell, because csv cannot store NaN.
    table = pa.table({c: pa.array(np.ascontiguousarray(v), from_pandas=True) for c, v in columns.items()})
    with replacing(path) as temporary:
        if path.suffix == ".csv":
            pc.write_csv(table, temporary)
        else:
            pq.write_table(table, temporary, write_page_checksum=True)
