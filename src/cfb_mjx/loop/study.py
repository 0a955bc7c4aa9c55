"""Run the cells of a study one after another and store their results: fly, correct the model, train, fly again."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from cfb_mjx.errors import CfbError
from cfb_mjx.files import output_folder, write_json
from cfb_mjx.loop import steps
from cfb_mjx.loop.steps import Cell
from cfb_mjx.runtime import say

RESULT = "result.json"


def study(cells: Sequence[Cell], folder: Path) -> Iterator[dict[str, Any]]:
    """Run the cells. A cell whose result already exists in ``folder`` is read from there.

    Args:
        cells: the cells, in the order in which they are run.
        folder: folder of all files; created if it does not exist.

    Yields:
        After every cell ``settings``, ``policies`` by seed and ``cells`` by name, including those of earlier runs.

    Raises:
        CfbError: the folder holds results with other settings.
    """
    output_folder(folder)
    settings = steps.settings()
    _require_same(folder / "settings.json", settings)
    results: dict[str, Any] = {"settings": settings, "policies": {}, "cells": _earlier(folder)}
    for number, cell in enumerate(cells, 1):
        own, policies = folder / "cells" / cell.name, folder / "policies" / str(cell.seed)
        say(f"{cell.effect}, seed {cell.seed} ({number} of {len(cells)})")
        results["policies"][str(cell.seed)] = steps.train_common(cell.seed, policies)
        if cell.name not in results["cells"]:
            results["cells"][cell.name] = _one(cell, policies, own)
            write_json(own / RESULT, results["cells"][cell.name])
        yield results


def _one(cell: Cell, policies: Path, own: Path) -> dict[str, Any]:
    own.mkdir(parents=True, exist_ok=True)
    return {
        "effect": cell.effect,
        "seed": cell.seed,
        "flown": steps.fly(cell, policies, own),
        "report": steps.close(own),
        "learnt": steps.learn(cell, policies, own),
        "trials": steps.judge(cell, policies, own),
    }


def _earlier(folder: Path) -> dict[str, Any]:
    paths = sorted((folder / "cells").glob(f"*/{RESULT}"), key=lambda path: path.stat().st_mtime)
    return {path.parent.name: json.loads(path.read_text(encoding="utf-8")) for path in paths}


def _require_same(path: Path, settings: dict[str, Any]) -> None:
    now = json.loads(json.dumps(settings))
    if path.exists() and json.loads(path.read_text(encoding="utf-8")) != now:
        raise CfbError(f"{path.parent}: holds a loop with other settings; give another folder with -o.")
    write_json(path, settings)
