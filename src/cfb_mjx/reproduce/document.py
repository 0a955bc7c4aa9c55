"""What was reproduced, as a page for a browser and as Markdown."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from pathlib import Path

from cfb_mjx.reproduce.item import Result
from cfb_mjx.view.page import Section, html_page

HEADER = ("quantity", "paper", "ours", "ours is", "how it differs and why")
KINDS = {"result": "", "input": "an input, no result", "own": "of its own flight, no evidence"}
TITLE = "How to Model Your Crazyflie Brushless, reproduced"


def page(results: Mapping[str, Result], facts: Mapping[str, object], left: str = "") -> str:
    """Everything on one self-contained HTML page; ``left`` says what is still to be made."""
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
        "Every figure and table of the paper (ICRA 2026), from the shipped model, policies and logs, its numbers "
        f"beside ours. {counted(results)} {left}"
    )
    return html_page(TITLE, lead.strip(), sections, facts)


def counted(results: Mapping[str, Result]) -> str:
    """How many of the rows with a number of the paper say something, and how many do not."""
    kinds = Counter(row.kind for result in results.values() for row in result.rows if row.paper)
    return (
        f"{kinds['result']} comparisons with numbers of the paper; beside them {kinds['input']} inputs (constants of "
        f"the paper that the shipped files repeat, or were put into generated data) and {kinds['own']} predictions "
        "by the model of its own flights, neither of which is evidence."
    )


def markdown(
    results: Mapping[str, Result], facts: Mapping[str, object], command: str, figures: str = "", left: str = ""
) -> str:
    """The same as Markdown.

    Args:
        results: by name of the item.
        facts: date, machine and versions.
        command: that wrote it.
        figures: folder of the figures, relative to the file, with a slash at its end; none where they lie beside it.
        left: what is still to be made.
    """
    lines = [
        f"# {TITLE}",
        "",
        f"Written by `{command}`; do not edit. " + ", ".join(f"{key} {value}" for key, value in facts.items()) + ".",
        "",
        f"{counted(results)} They stand in the paper's order, with the command that makes each; rows without a paper's "
        "number are ours alone. Where the paper is silent or cannot be right: [deviations.md](deviations.md).",
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
    """All figures."""
    return [path for result in results.values() for path, _ in result.figures]
