"""Effects by seeds: every cell is one drone, flown, diagnosed, learnt and flown again. What is done is kept."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cfb_mjx.errors import CfbError
from cfb_mjx.files import output_folder, write_json
from cfb_mjx.labelled_plants import EFFECTS, Case

FIRST_SEED, BETWEEN_SEEDS = 61_000, 100
RESULT = "result.json"


@dataclass(frozen=True)
class Cell:
    """One drone: its effect, and the seed of its policies and, with the effect's place in the list, of all draws."""

    effect: str
    seed: int

    @property
    def name(self) -> str:
        """Of its folder."""
        return f"{self.effect}-{self.seed}"

    @property
    def case(self) -> Case:
        """The drone."""
        return Case(self.name, self.seed + 1 + list(EFFECTS).index(self.effect), ((self.effect, 1.0),))


@dataclass(frozen=True)
class Steps:
    """What a cell is made of, each going on where it was interrupted and quick where it is done.

    Attributes:
        common: seed and folder to the seed's own policies: what is to be known of their training.
        fly: cell, policies' folder, cell's folder: fly and log; what was flown.
        close: cell's folder: diagnose; what ``report.json`` says.
        learn: cell, policies' folder, cell's folder: go on with the policy on the corrected model.
        judge: cell, policies' folder, cell's folder: fly again; `Trial.to_json` by policy.
    """

    common: Callable[[int, Path], dict[str, Any]]
    fly: Callable[[Cell, Path, Path], dict[str, Any]]
    close: Callable[[Path], dict[str, Any]]
    learn: Callable[[Cell, Path, Path], dict[str, Any]]
    judge: Callable[[Cell, Path, Path], dict[str, Any]]


def cells_of(effects: Iterable[str], seeds: int, first: int = FIRST_SEED) -> list[Cell]:
    """Cells seed by seed, so that an unfinished study has every effect.

    Raises:
        CfbError: an unknown effect, or fewer than one seed.
    """
    effects = list(dict.fromkeys(effects))
    known = [name for name in EFFECTS if not name.startswith(("outside", "sensor"))]
    if unknown := [name for name in effects if name not in known]:
        raise CfbError(f"--effects {unknown[0]}: there is no such effect; choose from {', '.join(known)}.")
    if not effects:
        raise CfbError(f"--effects: name at least one of {', '.join(known)}.")
    if seeds < 1:
        raise CfbError(f"--seeds {seeds}: at least one drone must fly.")
    if first < 0:
        raise CfbError(f"--seed {first}: must be zero or positive.")
    return [Cell(effect, first + BETWEEN_SEEDS * k) for k in range(seeds) for effect in effects]


def run(
    cells: list[Cell],
    folder: Path,
    steps: Steps,
    settings: dict[str, Any],
    say: Callable[[str], None] = lambda _: None,
    finished: Callable[[dict[str, Any]], None] = lambda results: None,
) -> dict[str, Any]:
    """Go through the cells; those whose result lies in ``folder`` already are taken from there.

    Args:
        cells: in this order.
        folder: for everything; made if need be.
        steps: the work.
        settings: what results depend on; a folder is for one of them.
        say: told which cell is at work.
        finished: called with all results after every cell.

    Returns:
        ``settings``, ``policies`` by seed and ``cells`` by name, those of earlier runs among them.

    Raises:
        CfbError: the folder holds results of other settings.
    """
    output_folder(folder)
    _require_same(folder / "settings.json", settings)
    results: dict[str, Any] = {"settings": settings, "policies": {}, "cells": _earlier(folder)}
    for number, cell in enumerate(cells, 1):
        own, shared = folder / "cells" / cell.name, folder / "policies" / str(cell.seed)
        say(f"{cell.effect}, seed {cell.seed} ({number} of {len(cells)})")
        results["policies"][str(cell.seed)] = steps.common(cell.seed, shared)
        if cell.name not in results["cells"]:
            results["cells"][cell.name] = _one(cell, shared, own, steps)
            write_json(own / RESULT, results["cells"][cell.name])
        finished(results)
    return results


def _one(cell: Cell, shared: Path, own: Path, steps: Steps) -> dict[str, Any]:
    own.mkdir(parents=True, exist_ok=True)
    flown = steps.fly(cell, shared, own)
    report = steps.close(own)
    learnt = steps.learn(cell, shared, own)
    trials = steps.judge(cell, shared, own)
    return {
        "effect": cell.effect,
        "seed": cell.seed,
        "flown": flown,
        "report": report,
        "learnt": learnt,
        "trials": trials,
    }


def _earlier(folder: Path) -> dict[str, Any]:
    paths = sorted((folder / "cells").glob(f"*/{RESULT}"), key=lambda path: path.stat().st_mtime)
    return {path.parent.name: json.loads(path.read_text(encoding="utf-8")) for path in paths}


def _require_same(path: Path, settings: dict[str, Any]) -> None:
    now = json.loads(json.dumps(settings))
    if path.exists() and json.loads(path.read_text(encoding="utf-8")) != now:
        raise CfbError(f"{path.parent}: holds a loop with other settings; give another folder with -o.")
    write_json(path, settings)
