"""Cells of a study: one drone for each effect and seed."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from cfb_mjx.errors import CfbError
from cfb_mjx.reference_simulator import EFFECTS, Case

FIRST_SEED, BETWEEN_SEEDS = 61_000, 100


@dataclass(frozen=True)
class Cell:
    """One drone.

    Attributes:
        effect: the effect that the declared model lacks.
        seed: seed of the policies; together with the position of the effect in the list, of all other random draws.
    """

    effect: str
    seed: int

    @property
    def name(self) -> str:
        """Name of the cell and of its folder."""
        return f"{self.effect}-{self.seed}"

    @property
    def case(self) -> Case:
        """The drone in the reference simulator."""
        return Case(self.name, self.seed + 1 + list(EFFECTS).index(self.effect), ((self.effect, 1.0),))


def cells_of(effects: Iterable[str], seeds: int, first: int = FIRST_SEED) -> list[Cell]:
    """Cells of all effects and seeds, ordered by seed, so that an unfinished study contains every effect.

    Args:
        effects: names of the effects; duplicates are dropped.
        seeds: number of seeds.
        first: the first seed.

    Raises:
        CfbError: an unknown effect, or no effect.
    """
    effects = list(dict.fromkeys(effects))
    known = [name for name in EFFECTS if not name.startswith(("outside", "sensor"))]
    if unknown := [name for name in effects if name not in known]:
        raise CfbError(f"--effects {unknown[0]}: there is no such effect; choose from {', '.join(known)}.")
    if not effects:
        raise CfbError(f"--effects: name at least one of {', '.join(known)}.")
    return [Cell(effect, first + BETWEEN_SEEDS * k) for k in range(seeds) for effect in effects]
