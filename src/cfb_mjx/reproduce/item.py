"""What a figure or table of the paper is here: a function that draws it and says the paper's numbers beside ours."""

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
    """One number of the paper beside ours, as text.

    Attributes:
        what: quantity and unit.
        paper: what the paper states; empty where it does not state it.
        ours: what came out.
        why: how the two differ, and why.
        kind: what ours is: a ``result``; an ``input``, a constant of the paper that files here repeat or that was put
            into the data; or the model's prediction of its ``own`` flights, which says nothing of a drone.
    """

    what: str
    paper: str
    ours: str
    why: str = ""
    kind: Literal["result", "input", "own"] = "result"


@dataclass(frozen=True)
class Result:
    """One figure or table, made.

    Attributes:
        title: heading.
        text: paragraphs: what was done, and with which data.
        rows: the paper's numbers and ours.
        figures: file and alternative text of each.
        tables: (caption, header, rows) of more.
    """

    title: str
    text: Sequence[str]
    rows: Sequence[Row]
    figures: Sequence[tuple[Path, str]] = ()
    tables: Sequence[tuple[str, Sequence[str], Sequence[Sequence[str]]]] = ()


@dataclass(frozen=True)
class Item:
    """A figure or table that can be asked for.

    Attributes:
        about: one line for the help.
        make: draws into a folder; takes that folder and the folder of real flights (None: there is none).
        given: whether it can be made with flights that the user gives; ``make`` then takes them as ``given``.
        x64: whether it is computed in double precision: identification is, flights of policies are not, for those were
            trained in single.
    """

    about: str
    make: Callable[..., Result]
    x64: bool
    given: bool = False


def write_csv(path: Path, header: Sequence[str], rows: Sequence[Sequence[object]]) -> None:
    """Write the numbers behind a figure atomically; floats with seven digits."""
    with replacing(path) as temporary, open(temporary, "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(header)
        writer.writerows([f"{x:.7g}" if isinstance(x, float) else x for x in row] for row in rows)


def with_std(value: float, std: float) -> str:
    """A fitted number and its standard deviation, that with two digits and the number to the same place."""
    place = max(0, 1 - math.floor(math.log10(std))) if std > 0 else 6
    return f"{value:.{place}f} +- {std:.{place}f}"
