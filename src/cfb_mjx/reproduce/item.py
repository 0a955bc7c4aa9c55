"""Items of the reproduction: functions that draw a figure or table of the paper and compare its numbers with ours."""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from cfb_mjx.files import replacing


@dataclass(frozen=True)
class Row:
    """One number of the paper and ours, as text.

    Attributes:
        what: quantity and unit.
        paper: the paper's value; empty if the paper does not state it.
        ours: our value.
        why: how the two differ, and why.
        kind: kind of our value: a ``result``; an ``input``, which is a constant of the paper that is in the shipped
            files or was used to generate the data; or the model's prediction of its ``own`` simulated flights, which is
            no evidence about a drone.
    """

    what: str
    paper: str
    ours: str
    why: str = ""
    kind: Literal["result", "input", "own"] = "result"


@dataclass(frozen=True)
class Result:
    """Result of one figure or table.

    Attributes:
        title: heading.
        text: paragraphs on the method and the data.
        rows: the paper's numbers and ours.
        figures: file and alternative text of each figure.
        tables: (caption, header, rows) of further tables.
    """

    title: str
    text: Sequence[str]
    rows: Sequence[Row]
    figures: Sequence[tuple[Path, str]] = ()
    tables: Sequence[tuple[str, Sequence[str], Sequence[Sequence[str]]]] = ()


@dataclass(frozen=True)
class Item:
    """A figure or table that can be reproduced.

    Attributes:
        about: one line for the help.
        make: function that draws into a folder; its arguments are that folder and the folder of real flights (or None).
        x64: whether it is computed in double precision. Identification is; flights of policies are not, because
            policies were trained in single precision.
        given: whether it can use flights given by the user; ``make`` then takes them as ``given``.
    """

    about: str
    make: Callable[..., Result]
    x64: bool
    given: bool = False


def write_csv(path: Path, header: Sequence[str], rows: Sequence[Sequence[object]]) -> None:
    """Write the numbers of a figure as csv, atomically, with seven digits for floats."""
    with replacing(path) as temporary, open(temporary, "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(header)
        writer.writerows([f"{x:.7g}" if isinstance(x, float) else x for x in row] for row in rows)


def with_std(value: float, std: float) -> str:
    """Format a fitted number and its standard deviation: two digits of the deviation, the number to the same place."""
    place = max(0, 1 - math.floor(math.log10(std))) if std > 0 else 6
    return f"{value:.{place}f} +- {std:.{place}f}"
