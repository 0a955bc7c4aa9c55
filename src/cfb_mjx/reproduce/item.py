"""Items of the reproduction: functions that draw a figure or table of the paper and compare its numbers with ours.

Results are stored as pages (HTML and Markdown) and as the data with which an interrupted run continues.
"""

from __future__ import annotations

import csv
import json
import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from cfb_mjx.files import replacing, write_json, write_text
from cfb_mjx.view.page import Section, html_page


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


HEADER = ("quantity", "paper", "ours", "ours is", "how it differs and why")
KINDS = {"result": "", "input": "an input, not a result", "own": "for the model's own flight, not evidence"}
TITLE = "How to Model Your Crazyflie Brushless, reproduced"


def page(results: Mapping[str, Result], facts: Mapping[str, object], left: str = "") -> str:
    """Build one self-contained HTML page.

    Args:
        results: results by name of the item.
        facts: date, machine and versions.
        left: sentence on the items that are not made yet.
    """
    sections = [
        Section(
            result.title,
            [*result.text, f"Made by cfb reproduce {name}."],
            [("The paper's numbers and ours", HEADER, [_cells(row) for row in result.rows]), *result.tables],
            [(path, alternative) for path, alternative in result.figures],
        )
        for name, result in results.items()
    ]
    lead = (
        "Every figure and table of the paper (ICRA 2026), made with the shipped model, policies and logs. The paper's "
        f"numbers are next to ours. {counted(results)} {left}"
    )
    return html_page(TITLE, lead.strip(), sections, facts)


def counted(results: Mapping[str, Result]) -> str:
    """Sentence with the numbers of comparisons with the paper that are results, inputs, and the model's own flights."""
    kinds = Counter(row.kind for result in results.values() for row in result.rows if row.paper)
    return (
        f"{kinds['result']} comparisons with numbers of the paper. In addition there are {kinds['input']} inputs "
        "(constants of the paper that are in the shipped files or were used to generate data) and "
        f"{kinds['own']} predictions of flights that were simulated with the model's own constants. Neither is "
        "evidence."
    )


def markdown(
    results: Mapping[str, Result], facts: Mapping[str, object], command: str, figures: str = "", left: str = ""
) -> str:
    """Build the page as Markdown.

    Args:
        results: results by name of the item.
        facts: date, machine and versions.
        command: the command that writes the page.
        figures: folder of the figures, relative to the file, with a final slash; empty if it is the file's folder.
        left: sentence on the items that are not made yet.
    """
    lines = [
        f"# {TITLE}",
        "",
        f"Written by `{command}`; do not edit. " + ", ".join(f"{key} {value}" for key, value in facts.items()) + ".",
        "",
        f"{counted(results)} The sections follow the order of the paper, each with the command that makes it. Rows "
        "without a number of the paper have only our result. [deviations.md](deviations.md) lists where the paper "
        "gives no value or cannot be right.",
        *(["", left] if left else []),
    ]
    for name, result in results.items():
        lines += ["", f"## {result.title}", "", f"`cfb reproduce {name}`", ""]
        for text in result.text:
            lines += [text, ""]
        for path, alternative in result.figures:
            lines += [f"![{alternative}]({figures}{path.name})", ""]
        lines += ["| " + " | ".join(HEADER) + " |", "|---" * len(HEADER) + "|"]
        lines += ["| " + " | ".join(cell.replace("|", "/") for cell in _cells(row)) + " |" for row in result.rows]
    return "\n".join(lines) + "\n"


def _cells(row) -> list[str]:
    return [row.what, row.paper, row.ours, KINDS[row.kind], row.why]


def names_of(results: Mapping[str, Result]) -> list[Path]:
    """Files of all figures."""
    return [path for result in results.values() for path, _ in result.figures]


PAGE, TEXT, NUMBERS = "index.html", "paper.md", "paper.json"


def keep(
    folder: Path, results: Mapping[str, Result], of: Mapping[str, Any], facts: Mapping[str, Any], command: str
) -> None:
    """Write the pages, the rows, and the data needed to continue an interrupted run.

    Args:
        folder: folder of all files.
        results: results by name of the item.
        of: settings on which the results depend, including the ``names`` of all requested items.
        facts: date, machine and versions.
        command: the command that makes the results.
    """
    left = [name for name in of["names"] if name not in results]
    said = f"Not made yet: {', '.join(left)}; the same command continues with them." if left else ""
    # The duration is only printed, so that runs of the same day on the same machine give identical files.
    write_text(folder / PAGE, page(results, facts, said))
    write_text(folder / TEXT, markdown(results, facts, command, left=said))
    kept = {
        name: {
            "title": result.title,
            "text": list(result.text),
            "figures": [(path.name, alternative) for path, alternative in result.figures],
            "tables": list(result.tables),
        }
        for name, result in results.items()
    }
    rows = {name: [vars(row) for row in result.rows] for name, result in results.items()}
    write_json(folder / NUMBERS, {"rows": rows, "environment": facts, "of": of, "left": left, "items": kept})


def kept_in(folder: Path, of: Mapping[str, Any]) -> dict[str, Result]:
    """Results of an interrupted run with the same settings; empty if there is none, or if the run was complete."""
    try:
        found = json.loads((folder / NUMBERS).read_text(encoding="utf-8"))
        if found["of"] != of or not found["left"]:
            return {}
        results = {}
        for name, item in found["items"].items():
            figures = [(folder / file, alternative) for file, alternative in item["figures"]]
            rows = [Row(**row) for row in found["rows"][name]]
            if all(path.is_file() for path, _ in figures):
                results[name] = Result(item["title"], item["text"], rows, figures, item["tables"])
        return results
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return {}
