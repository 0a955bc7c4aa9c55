"""Pages of the reproduced results, as HTML and as Markdown."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from pathlib import Path

from cfb_mjx.reproduce.item import Result
from cfb_mjx.view.page import Section, html_page

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
