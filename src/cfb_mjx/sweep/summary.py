"""The table of a sweep: one row per task, with the varied arguments and the numbers of its results."""

from __future__ import annotations

import csv
import io
import json
import math
import time
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from cfb_mjx.commands.command import text
from cfb_mjx.files import together, write_json, write_text
from cfb_mjx.sweep.config import KINDS
from cfb_mjx.sweep.folder import Folder, read_record
from cfb_mjx.sweep.tasks import Task

CSV, JSON = "results.csv", "results.json"
LEAST_INTERVAL_S = 2.0
DEEPEST = 4
_LEFT_OUT = ("environment", "logs", "intervals", "correlation")
"""Keys of a result that are left out: the machine, single logs, intervals and correlations."""
_OF_TASK = ("name", "state", "attempts", "seconds")


def numbers_of(result: Any) -> dict[str, float | bool]:
    """Return the numbers and booleans of a JSON result under dotted keys.

    The items of lists of named things (``effects``) are found by their names. Other lists, texts, and values deeper
    than `DEEPEST` are left out.
    """
    found: dict[str, float | bool] = {}
    _collect(result, "", 0, found)
    return found


def _collect(value: Any, path: str, depth: int, found: dict[str, float | bool]) -> None:
    if isinstance(value, list) and value and all(isinstance(v, dict) and isinstance(v.get("name"), str) for v in value):
        value = {v["name"]: v for v in value}
    if isinstance(value, bool) or (isinstance(value, int | float) and math.isfinite(value)):
        found[path] = value
    elif isinstance(value, Mapping) and depth < DEEPEST:
        for key, inner in value.items():
            if depth or key not in _LEFT_OUT:
                _collect(inner, f"{path}.{key}" if path else str(key), depth + 1, found)


class Summary:
    """Table of a sweep; it is rewritten as tasks end, and every result is read once."""

    def __init__(self, folder: Folder, tasks: Iterable[Task]):
        self.folder = folder
        self.tasks = tuple(tasks)
        self._rows: dict[str, dict[str, Any]] = {}
        self._written = -math.inf

    def refresh(self, now: bool = False) -> None:
        """Write the table, at most every `LEAST_INTERVAL_S` unless ``now``.

        Raises:
            CfbError: the table cannot be written.
        """
        if not now and time.monotonic() - self._written < LEAST_INTERVAL_S:
            return
        # Results are read and the table is written under one lock, so that the last of several drivers writes all.
        with self.folder.summing():
            rows = [self._row(task) for task in self.tasks]
            with together():
                write_json(self.folder.path / JSON, {"tasks": rows})
                write_text(self.folder.path / CSV, _csv(rows))
        self._written = time.monotonic()

    def _row(self, task: Task) -> dict[str, Any]:
        if task.name not in self._rows:
            row = _row(self.folder, task)
            if row["state"] != "done":
                return row
            self._rows[task.name] = row
        return self._rows[task.name]


def _row(folder: Folder, task: Task) -> dict[str, Any]:
    state = folder.state(task.name)
    row = {"name": task.name, "state": state, "attempts": None, "seconds": None, "varied": task.varied, "results": {}}
    if state == "done":
        record = read_record(folder.done(task.name))
        row |= {key: record.get(key) for key in ("attempts", "seconds")}
        row["results"] = numbers_of(_result(folder.done(task.name) / KINDS[task.command].result))
    return row


def _result(path: Path) -> Any:
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}


def _csv(rows: list[dict[str, Any]]) -> str:
    varied = list(dict.fromkeys(key for row in rows for key in row["varied"]))
    # Results may repeat arguments.
    said = (*_OF_TASK, *varied)
    results = list(dict.fromkeys(key for row in rows for key in row["results"] if key not in said))
    lines = io.StringIO()
    writer = csv.writer(lines, lineterminator="\n")
    writer.writerow([*said, *results])
    for row in rows:
        cells = [row[key] for key in _OF_TASK] + [row["varied"].get(key) for key in varied]
        cells += [row["results"].get(key) for key in results]
        writer.writerow(["" if cell is None else text(cell) for cell in cells])
    return lines.getvalue()
