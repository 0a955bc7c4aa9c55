"""Summary of a study by effect: medians over the seeds, whether the flight improved, and reasons if it did not."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from statistics import median
from typing import Any

POLICIES = ("without_effect", "nominal", "longer", "randomised", "corrected", "both")
MEASURES = ("hover_mm", "track_m")
HARDLY = 0.1
"""Relative increase of an error below which an effect counts as harmless."""
NOTES = {
    "battery_sag": "A policy cannot see the voltage: it is trained with a cell that starts half full, and the flights "
    "begin with packs of 3.4 to 3.95 V. The right model is of no use to a controller that is not told what changes."
}
"""Effect to a known reason why a policy that only receives the estimated state does not improve."""


@dataclass(frozen=True)
class Spread:
    """Distribution of the values of the seeds.

    Attributes:
        median: median over the seeds; infinite if half of the seeds or more had a crash.
        least: smallest value.
        greatest: largest value; infinite if a flight crashed.
        crashed: number of flights that crashed.
    """

    median: float
    least: float
    greatest: float
    crashed: int


@dataclass(frozen=True)
class Row:
    """Results of one effect.

    Attributes:
        effect: name of the effect.
        named: effects reported by close-loop, for each seed.
        spreads: measure and policy to the distribution over the seeds.
        change: measure to the relative change of the error from the nominal to the corrected policy, median over seeds.
        alone: the same for the policy trained further by as many updates on the declared model.
        held_out: prediction error to its median over the seeds before and after the correction.
    """

    effect: str
    named: tuple[tuple[str, ...], ...]
    spreads: dict[str, dict[str, Spread]]
    change: dict[str, float]
    alone: dict[str, float]
    held_out: dict[str, tuple[float, float]]

    @property
    def right(self) -> int:
        """Number of seeds for which the effect was reported, with or without others."""
        return sum(self.effect in names for names in self.named)

    def improved(self, measure: str) -> bool:
        """Whether the error decreased, in the median over the seeds."""
        return self.change[measure] < 0

    @property
    def why_not(self) -> list[str]:
        """Sentences with reasons if a measure did not improve."""
        worse = [measure for measure in MEASURES if not self.improved(measure)]
        if not worse:
            return []
        words = []
        for measure in worse:
            clean, before = (self.spreads[measure][p].median for p in ("without_effect", "nominal"))
            if before < (1 + HARDLY) * clean:
                words.append(
                    f"There was little to gain in {_WORDS[measure]}: {_text(measure, before)} with the effect, "
                    f"{_text(measure, clean)} without it, by the same policy."
                )
        if self.right < len(self.named):
            words.append(f"close-loop named it for {self.right} of {len(self.named)} drones.")
        return words + ([NOTES[self.effect]] if self.effect in NOTES else [])


_WORDS = {"hover_mm": "hover", "track_m": "tracking"}


def _text(measure: str, value: float) -> str:
    return f"{value:.0f} mm" if measure == "hover_mm" else f"{value:.3f} m"


def value_of(trial: dict[str, Any], measure: str) -> float:
    """Mean of a measure over the flights of a trial; infinite if one of them crashed."""
    values = trial[measure]
    return math.inf if any(v is None for v in values) else sum(values) / len(values)


def summarise(cells: Iterable[dict[str, Any]]) -> list[Row]:
    """One row per effect, in the order in which they first appear.

    Args:
        cells: results of cells, from `cfb_mjx.loop.study.study`.
    """
    groups: dict[str, list[dict[str, Any]]] = {}
    for cell in cells:
        groups.setdefault(cell["effect"], []).append(cell)
    return [_row(effect, sorted(group, key=lambda cell: cell["seed"])) for effect, group in groups.items()]


def _row(effect: str, group: list[dict[str, Any]]) -> Row:
    named = tuple(tuple(item["name"] for item in cell["report"]["effects"]) for cell in group)
    spreads = {m: {p: _spread([cell["trials"][p] for cell in group], m) for p in POLICIES} for m in MEASURES}
    change, alone = (
        {m: median(_change(cell["trials"], m, policy) for cell in group) for m in MEASURES}
        for policy in ("corrected", "longer")
    )
    errors = group[0]["report"]["held_out"]["before"]
    held_out = {
        key: tuple(median(cell["report"]["held_out"][when][key] for cell in group) for when in ("before", "after"))
        for key in errors
    }
    return Row(effect, named, spreads, change, alone, held_out)


def _spread(trials: list[dict[str, Any]], measure: str) -> Spread:
    values = [value_of(trial, measure) for trial in trials]
    lost = sum(v is None for trial in trials for v in trial[measure])
    return Spread(median(values), min(values), max(values), lost)


def _change(trials: dict[str, Any], measure: str, policy: str) -> float:
    before, after = (value_of(trials[name], measure) for name in ("nominal", policy))
    if math.isinf(after):
        return 0.0 if math.isinf(before) else math.inf
    return -1.0 if math.isinf(before) else after / before - 1
