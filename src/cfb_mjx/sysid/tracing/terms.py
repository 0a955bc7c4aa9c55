"""Which terms of a library describe what is left of a residual: forward selection on blocks left out, axis by axis."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

from cfb_mjx.model.effects.formula import PLACES, TERMS, ResidualFormula
from cfb_mjx.sysid.tracing.columns import FORMULA, Column, term_columns
from cfb_mjx.sysid.tracing.evidence import Evidence, evidence
from cfb_mjx.sysid.tracing.hypothesis import Hypothesis, Linear
from cfb_mjx.sysid.tracing.search import Search

PER_AXIS = 3
"""Terms or families along one axis at most."""
_QUADRATIC = ("n_roll^2", "n_pitch^2", "n_roll n_pitch")
FAMILIES = {"body_terms": [_QUADRATIC], "place": [(p, f"{p}^2") for p in ("x", "y", "z")]}
"""Terms that describe one thing only together: a force that grows towards a wall is badly told by its slope alone, and
what one term describes badly does not stand against chance."""
OF_FAMILY = 0.9
"""A single term is preferred if it gains this share of what a family gains."""
NEEDLESS = 2.0
"""A term that gains fewer nats beside the others is left out again."""
ALPHA, LEAST_GAIN = 1e-3, 8.0
RARE = 2.0
"""Least statistic of a term that few blocks excite."""


@dataclass(frozen=True)
class Selection:
    """Terms of the library that improve blocks left out.

    Attributes:
        sure: beyond chance.
        rare: groups of terms that gain as much, but in so few blocks that these alone are no proof.
        gains: of every term, nats on blocks left out, when it was chosen.
    """

    sure: list[Column] = field(default_factory=list)
    rare: list[list[Column]] = field(default_factory=list)
    gains: dict[Column, float] = field(default_factory=dict)


def with_library(search: Search, hypothesis: Hypothesis) -> tuple[Search, Hypothesis]:
    """The same search and hypothesis with the (empty) formula among the effects."""
    empty = ResidualFormula.neutral()
    widened = replace(search, names=(*search.names, FORMULA), _flights=search._flights)
    return widened, replace(hypothesis, effects=(*hypothesis.effects, empty), origin=(*hypothesis.origin, empty))


def select(search: Search, hypothesis: Hypothesis, progress: Callable[[str], None] = lambda _: None) -> Selection:
    """Choose terms beside everything found.

    Args:
        search: with the library (`with_library`).
        hypothesis: likewise.
        progress: told what happens.
    """
    own = search.own_columns(hypothesis)
    tried = sum(len(term_columns(axis)) for axis in range(6))
    chosen = Selection()
    progress("looking for structure in what is left")
    for linear in search.linearise_terms(hypothesis, own):
        library = [c for c in linear.columns if c.effect == FORMULA and c not in own]
        axis = _Axis(linear, linear.index(own), [[c] for c in library if not _square(c)] + _families(library))
        sure, gains = axis.forward([], lambda e: e.p_value * tried < ALPHA)
        sure = axis.pruned([c for group in sure for c in group])
        rare, more = axis.forward(sure, lambda e: e.t > RARE)
        chosen.sure.extend(sure)
        chosen.rare.extend(rare)
        chosen.gains.update(gains | more)
    return chosen


@dataclass(frozen=True)
class _Axis:
    """Inner products along one axis: the ``base`` is free anyway, ``groups`` may be added."""

    linear: Linear
    base: list[int]
    groups: list[list[Column]]

    def gaining(self, columns: list[Column], beside: list[Column]) -> Evidence:
        index = self.linear.index
        return evidence(self.linear.blocks, self.base + index(beside), index(columns), self.linear.scale)

    def forward(self, picked: list[Column], stands: Callable[[Evidence], bool]):
        """Groups added one after the other while one stands, and the gain of each of their terms."""
        picked, added, gains = list(picked), [], {}
        for _ in range(PER_AXIS):
            rest = [[c for c in group if c not in picked] for group in self.groups]
            found = [(self.gaining(columns, picked), columns) for columns in rest if columns]
            passing = [pair for pair in found if pair[0].gain > LEAST_GAIN and stands(pair[0])]
            if not passing:
                break
            most = max(e.gain for e, _ in passing)
            best, columns = min(
                (pair for pair in passing if pair[0].gain >= OF_FAMILY * most),
                key=lambda pair: (len(pair[1]), -pair[0].gain),
            )
            picked += columns
            added.append(columns)
            gains |= dict.fromkeys(columns, best.gain)
        return added, gains

    def pruned(self, picked: list[Column]) -> list[Column]:
        """Without terms that gain next to nothing beside the others."""
        for column in list(picked):
            others = [c for c in picked if c != column]
            squared = any(_square(c) and _coordinate(c) == _coordinate(column) for c in others)
            if others and not squared and self.gaining([column], others).gain < NEEDLESS:
                picked = others
        return picked


def _square(column: Column) -> bool:
    """Whether it is the square of a coordinate: alone it would say that the origin of the room means something."""
    return column.field == "place" and list(PLACES)[column.index[1]].endswith("^2")


def _coordinate(column: Column) -> str | None:
    return list(PLACES)[column.index[1]].removesuffix("^2") if column.field == "place" else None


def _families(library: list[Column]) -> list[list[Column]]:
    """`FAMILIES` among the terms of one axis."""
    found = []
    for name, groups in FAMILIES.items():
        signals = list(TERMS if name == "body_terms" else PLACES)
        named = {signals[c.index[1]]: c for c in library if c.field == name}
        found += [[named[s] for s in group] for group in groups if set(group) <= set(named)]
    return found
