"""What was reproduced, as a page for a browser and as Markdown."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from cfb_mjx.reproduce.item import Result
from cfb_mjx.view.page import Section, html_page

HEADER = ("quantity", "paper", "ours", "how it differs and why")
TITLE = "How to Model Your Crazyflie Brushless, reproduced"


def page(results: Mapping[str, Result], facts: Mapping[str, object]) -> str:
    """Everything on one self-contained HTML page."""
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
        "beside ours."
    )
    return html_page(TITLE, lead, sections, facts)


def markdown(results: Mapping[str, Result], facts: Mapping[str, object], command: str, figures: str = "") -> str:
    """The same as Markdown.

    Args:
        results: by name of the item.
        facts: date, machine and versions.
        command: that wrote it.
        figures: folder of the figures, relative to the file, with a slash at its end; none where they lie beside it.
    """
    stated = sum(bool(row.paper) for result in results.values() for row in result.rows)
    lines = [
        f"# {TITLE}",
        "",
        f"Written by `{command}`; do not edit. " + ", ".join(f"{key} {value}" for key, value in facts.items()) + ".",
        "",
        f"{stated} comparisons with numbers of the paper, in its order, and the command that makes each; rows without "
        "a paper's number are ours alone. Where the paper is silent or cannot be right: "
        "[deviations.md](deviations.md).",
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
    return [row.what, row.paper, row.ours, row.why]


def names_of(results: Mapping[str, Result]) -> list[Path]:
    """All figures."""
    return [path for result in results.values() for path, _ in result.figures]
