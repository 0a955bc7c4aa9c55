"""Reader of text tables: detects delimiter, decimal comma, comments, encoding and a truncated last line."""

from __future__ import annotations

import io
import re
from collections import Counter
from pathlib import Path

from cfb_mjx.errors import CfbError

NO_VALUE = (
    "",
    "nan",
    "NaN",
    "NAN",
    "-nan",
    "None",
    "none",
    "null",
    "NULL",
    "Null",
    "NA",
    "N/A",
    "n/a",
    "<NA>",
    "-",
    "--",
)
_BOMS = ((b"\xef\xbb\xbf", "utf-8-sig"), (b"\xff\xfe", "utf-16"), (b"\xfe\xff", "utf-16"))
_DELIMITERS = (",", ";", "\t", "|")
_LOOKED_AT = 50  # lines used to detect the delimiter
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")
_DECIMAL_COMMA = re.compile(r"[+-]?\d+,\d+([eE][+-]?\d+)?")
_VARIABLE = re.compile(r"[A-Za-z]\w*[./]\w+")
_INDEX = re.compile(r"(Unnamed: ?0|index)?", re.IGNORECASE)


def read_text_table(path: Path, data: bytes, notes: list[str], warnings: list[str]):
    """Read a table from text.

    Args:
        path: the file, for messages.
        data: content of the file.
        notes: receives the properties of the file that differ from plain csv.
        warnings: receives what was left out.

    Returns:
        A ``pyarrow.Table``. Cells that are empty or hold one of the words in `NO_VALUE` are null.

    Raises:
        CfbError: the file is not text, has no header line, or a line before the last has a wrong number of cells.
        pyarrow.ArrowException: cells that cannot be read.
    """
    import pyarrow.csv as pc

    lines, ended = _lines(path, data, notes)
    if not lines:
        raise CfbError(f"{path}: the table has no lines; export the log again.")
    delimiter = _delimiter(lines)
    if delimiter is None:
        lines, delimiter = [" ".join(line.split()) for line in lines], " "
    header = _cells(lines[0], delimiter)
    if _is_long_row(header):
        notes.append("the table has no header; its columns were read as time, name and value.")
        header = ["timestamp", "name", "value"]
        lines.insert(0, delimiter.join(header))
    if len(header) > 1 and all(_is_number(cell) for cell in header):
        raise CfbError(
            f"{path}: the first line holds numbers, so the table has no header; write the columns' names in its "
            "first line."
        )
    rows = _whole_rows(path, lines, delimiter, len(header), ended, warnings)
    comma = delimiter != "," and any(_DECIMAL_COMMA.fullmatch(c) for row in rows[:5] for c in _cells(row, delimiter))
    if comma:
        notes.append("numbers are written with a decimal comma.")
    body = "\n".join([lines[0], *rows, ""]).encode()
    table = pc.read_csv(
        io.BytesIO(body),
        read_options=pc.ReadOptions(use_threads=False),
        parse_options=pc.ParseOptions(delimiter=delimiter),
        convert_options=pc.ConvertOptions(
            null_values=list(NO_VALUE), strings_can_be_null=True, decimal_point="," if comma else "."
        ),
    )
    first = table.column_names[0].strip() if table.num_columns else ""
    if table.num_columns > 1 and _INDEX.fullmatch(first):
        # The index column that pandas writes by default.
        table = table.remove_column(0)
    return table


def _lines(path: Path, data: bytes, notes: list[str]) -> tuple[list[str], bool]:
    """Lines that are neither empty nor comments, and whether the last one ends with a line break."""
    text = _decoded(path, data, notes)
    ended = text.endswith(("\n", "\r"))
    lines, comments = [], []
    for line in text.splitlines():
        stripped = line.strip()
        if stripped.startswith(("#", "%", "//")):
            if not lines:
                comments.append(stripped.lstrip("#%/ \t"))
        elif stripped.strip(";,\t |"):
            lines.append(line.strip("\r\n") if "\t" in line else stripped)
    if comments and lines and _headerless(lines[0]):
        # numpy.savetxt writes the column names as a comment.
        delimiter = _delimiter(lines)
        width = len(_cells(lines[0], delimiter or " "))
        for comment in reversed(comments):
            names = _cells(comment, delimiter or " ") if delimiter is None or delimiter in comment else comment.split()
            if len(names) == width:
                lines.insert(0, (delimiter or " ").join(names))
                break
    return lines, ended


def _decoded(path: Path, data: bytes, notes: list[str]) -> str:
    encoding = next((name for mark, name in _BOMS if data.startswith(mark)), None)
    if encoding is None and b"\0" in data[:1000]:
        # Every second byte of Latin text in UTF-16 is zero.
        zeros = [sum(byte == 0 for byte in data[i:1000:2]) / len(data[i:1000:2] or b"1") for i in (0, 1)]
        if max(zeros) > 0.8 and min(zeros) < 0.2:
            encoding = "utf-16-le" if zeros[1] > zeros[0] else "utf-16-be"
        else:
            raise CfbError(f"{path}: this is neither a text table nor another format this library reads.")
    if encoding is not None:
        if encoding != "utf-8-sig":
            notes.append("the file is written in UTF-16.")
        try:
            return data[: len(data) - len(data) % 2 if "16" in encoding else None].decode(encoding)
        except UnicodeDecodeError:
            raise CfbError(f"{path}: the text is damaged or cut short ({encoding}); export it again.") from None
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError:
        if sum(byte < 9 or 13 < byte < 32 for byte in data[:1000]) > 5:
            raise CfbError(f"{path}: this is neither a text table nor another format this library reads.") from None
        return data.decode("latin-1")


def _delimiter(lines: list[str]) -> str | None:
    """The delimiter that divides most of the first lines into the same number of cells; None for white space."""
    some = lines[:_LOOKED_AT]
    best, most = None, 0
    for delimiter in _DELIMITERS:
        counts = Counter(len(_cells(line, delimiter)) for line in some)
        width = len(_cells(lines[0], delimiter))
        # The header decides the number of cells, because a decimal comma splits numbers but not names.
        alike = counts[width] if width > 1 else 0
        if width > 1 and alike >= max(1, len(some) // 2) and width > most:
            best, most = delimiter, width
    return best


def _cells(line: str, delimiter: str) -> list[str]:
    return [cell.strip().strip('"') for cell in (line.split() if delimiter == " " else line.split(delimiter))]


def _headerless(line: str) -> bool:
    cells = re.split(r"[,;\t| ]+", line.strip())
    return all(_is_number(cell) for cell in cells)


def _is_long_row(cells: list[str]) -> bool:
    """Whether a line is time, variable name and value, as in a table with one value per line, and not a header."""
    return (
        len(cells) == 3 and _is_number(cells[0]) and _is_number(cells[2]) and _VARIABLE.fullmatch(cells[1]) is not None
    )


def _is_number(cell: str) -> bool:
    return _NUMBER.fullmatch(cell) is not None or _DECIMAL_COMMA.fullmatch(cell) is not None


def _whole_rows(
    path: Path, lines: list[str], delimiter: str, width: int, ended: bool, warnings: list[str]
) -> list[str]:
    """The rows of the table, without the last one if it was cut short."""
    rows = lines[1:]
    if rows and '"' not in rows[-1] and rows[-1].count(delimiter) < width - 1:
        warnings.append("the last line was cut short and was left out.")
        rows = rows[:-1]
    elif rows and not ended:
        warnings.append("the file does not end with a line break, so its last row may be cut short and was left out.")
        rows = rows[:-1]
    for number, row in enumerate(rows):
        if '"' not in row and row.count(delimiter) != width - 1:
            raise CfbError(
                f"{path}: row {number} (counted from 0) has {row.count(delimiter) + 1} cells, the header has {width}, "
                "so the file is damaged there; export it again, or delete that row."
            )
    return rows
