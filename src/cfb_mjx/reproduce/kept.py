"""Store results in a folder: the pages, and the data with which an interrupted run continues."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from cfb_mjx.files import write_json, write_text
from cfb_mjx.reproduce.document import markdown, page
from cfb_mjx.reproduce.item import Result, Row

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
