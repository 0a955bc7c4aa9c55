"""Sparse formula for a residual that the catalogue does not explain.

Terms are selected from a library by cross-validation, and the formula must pass the same tests as any effect.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from cfb_mjx.model.effects.formula import AXES, PLACES, TERMS, ResidualFormula
from cfb_mjx.sysid.tracing.evidence import Evidence, Prior, covariance, evidence, solve
from cfb_mjx.sysid.tracing.hypothesis import FORMULA, LEAD_SPREAD, Column, Hypothesis, Linear, term_columns
from cfb_mjx.sysid.tracing.jointly import confirm, prediction_errors
from cfb_mjx.sysid.tracing.rules import Rules, enough
from cfb_mjx.sysid.tracing.search import Search
from cfb_mjx.sysid.tracing.trace import Trace

_QUADRATIC = ("n_roll^2", "n_pitch^2", "n_roll n_pitch")
FAMILIES = {"body_terms": [_QUADRATIC], "place": [(p, f"{p}^2") for p in ("x", "y", "z")]}
"""Groups of terms that describe something only together. A force that grows towards a wall, for instance, is badly
described by its slope alone, and a single term that describes it badly is not significant."""


@dataclass(frozen=True)
class Selection:
    """Terms of the library that explain the residual in cross-validation.

    Attributes:
        sure: significant terms.
        weakly_excited: groups of terms that gain as much, but in so few blocks that they are not significant.
        gains: gain of every term when it was chosen, nats.
    """

    sure: list[Column] = field(default_factory=list)
    weakly_excited: list[list[Column]] = field(default_factory=list)
    gains: dict[Column, float] = field(default_factory=dict)


def with_library(search: Search, hypothesis: Hypothesis) -> tuple[Search, Hypothesis]:
    """Add an empty formula to the effects of a search and of a hypothesis."""
    empty = ResidualFormula.neutral()
    widened = replace(search, names=(*search.names, FORMULA), _flights=search._flights)
    return widened, replace(hypothesis, effects=(*hypothesis.effects, empty), origin=(*hypothesis.origin, empty))


def select(search: Search, hypothesis: Hypothesis, progress: Callable[[str], None] = lambda _: None) -> Selection:
    """Select terms alongside the effects that are present, separately for each axis.

    Args:
        search: search with the library (`with_library`).
        hypothesis: hypothesis with the library.
        progress: called with a message at each step.
    """
    own = search.own_columns(hypothesis)
    tried = sum(len(term_columns(axis)) for axis in range(6))
    chosen, rules = Selection(), search.rules
    progress("looking for structure in the residual")
    for linear in search.linearise_terms(hypothesis, own):
        library = [c for c in linear.columns if c.effect == FORMULA and c not in own]
        axis = _Axis(linear, linear.index(own), [[c] for c in library if not _square(c)] + _families(library), rules)
        sure, gains = axis.forward([], lambda e: e.p_value * tried < rules.term_alpha)
        sure = axis.pruned([c for group in sure for c in group])
        weakly_excited, more = axis.forward(sure, lambda e: e.t > rules.term_weakly_excited)
        chosen.sure.extend(sure)
        chosen.weakly_excited.extend(weakly_excited)
        chosen.gains.update(gains | more)
    return chosen


@dataclass(frozen=True)
class _Axis:
    """Forward selection along one axis: the columns ``base`` are always free, ``groups`` of terms may be added."""

    linear: Linear
    base: list[int]
    groups: list[list[Column]]
    rules: Rules

    def gaining(self, columns: list[Column], beside: list[Column]) -> Evidence:
        index = self.linear.index
        linear = self.linear
        return evidence(linear.blocks, self.base + index(beside), index(columns), linear.scale, fold=linear.fold)

    def forward(self, picked: list[Column], stands: Callable[[Evidence], bool]):
        """Add groups one after another while one passes ``stands``; return them and the gain of each of their terms."""
        picked, added, gains = list(picked), [], {}
        for _ in range(self.rules.per_axis):
            rest = [[c for c in group if c not in picked] for group in self.groups]
            found = [(self.gaining(columns, picked), columns) for columns in rest if columns]
            passing = [pair for pair in found if pair[0].gain > self.rules.term_gain and stands(pair[0])]
            if not passing:
                break
            most = max(e.gain for e, _ in passing)
            best, columns = min(
                (pair for pair in passing if pair[0].gain >= self.rules.of_family * most),
                key=lambda pair: (len(pair[1]), -pair[0].gain),
            )
            picked += columns
            added.append(columns)
            gains |= dict.fromkeys(columns, best.gain)
        return added, gains

    def pruned(self, picked: list[Column]) -> list[Column]:
        """Remove terms that gain next to nothing in addition to the others."""
        for column in list(picked):
            others = [c for c in picked if c != column]
            squared = any(_square(c) and _coordinate(c) == _coordinate(column) for c in others)
            if others and not squared and self.gaining([column], others).gain < self.rules.term_needless:
                picked = others
        return picked


def _place(column: Column) -> tuple[int, int]:
    """Indices of axis and signal of a term."""
    assert isinstance(column.index, tuple), "every term of the library has an axis and a signal"
    return column.index


def _square(column: Column) -> bool:
    """Whether a term is the square of a coordinate; used alone, it would give the room's origin a meaning."""
    return column.field == "place" and list(PLACES)[_place(column)[1]].endswith("^2")


def _coordinate(column: Column) -> str | None:
    return list(PLACES)[_place(column)[1]].removesuffix("^2") if column.field == "place" else None


def _families(library: list[Column]) -> list[list[Column]]:
    """The groups of `FAMILIES` whose terms are all in the library of one axis."""
    found = []
    for name, groups in FAMILIES.items():
        signals = list(TERMS if name == "body_terms" else PLACES)
        named = {signals[_place(c)[1]]: c for c in library if c.field == name}
        found += [[named[s] for s in group] for group in groups if set(group) <= set(named)]
    return found


@dataclass(frozen=True)
class Term:
    """One term of a formula.

    Attributes:
        axis: component of force or torque.
        signal: that the component is proportional to.
        unit: of the coefficient.
        value: of the coefficient.
        std: its standard deviation.
        gain: in cross-validation when the term was added, nats.
    """

    axis: str
    signal: str
    unit: str
    value: float
    std: float
    gain: float

    def __str__(self) -> str:
        return f"{self.axis} = ({self.value:.3g} +- {self.std:.1g} {self.unit}) {self.signal}"


def describe(column: Column) -> tuple[str, str, str]:
    """Axis, signal and unit of the coefficient of a term."""
    i, j = _place(column)
    if column.field == "place":
        signal, unit = list(PLACES.items())[j]
        return f"world force_{'xyz'[i]}", signal, _per("N", unit)
    signal, unit = list(TERMS.items())[j]
    return AXES[i], signal, _per("N m" if i < 3 else "N", unit)


def _per(unit: str, signal: str) -> str:
    return unit if signal == "1" else f"{unit} / ({signal})"


def fit_formula(search: Search, hypothesis: Hypothesis, terms: list[Column]) -> tuple[Hypothesis, np.ndarray]:
    """Fit the terms together with the present effects; return the hypothesis and the terms' standard deviations."""

    def step(at: Hypothesis) -> tuple[Hypothesis, list[Column], Linear, list[int], np.ndarray]:
        own = search.own_columns(at)
        linear = search.linearise(at, own)
        index = linear.index(own)
        values = solve(linear.blocks.sum(0), index, linear.scale)
        return search.moved(at, own, np.concatenate([[0.0], values * linear.scale[index]])), own, linear, index, values

    first, *_ = step(replace(hypothesis, terms=tuple(terms)))
    richer, own, linear, index, values = step(first)
    prior = Prior.weak(1 + len(index)).pulled(0, 0.0, 1 / LEAD_SPREAD**2)
    spread = covariance(linear.blocks, [1, *index], linear.scale, np.concatenate([[0.0], values]), prior)
    deviation = np.sqrt(np.diag(spread))[1:] * linear.scale[index]
    return richer, deviation[len(own) - len(terms) :]


def terms_of(hypothesis: Hypothesis, deviation: np.ndarray, gains: dict[Column, float]) -> list[Term]:
    """The terms of a hypothesis's formula, the largest gain first.

    Args:
        hypothesis: with the fitted formula.
        deviation: (n,) standard deviations of its terms.
        gains: gain of each term, nats.
    """
    effect = hypothesis.effect(FORMULA)
    found = []
    for column, std in zip(hypothesis.terms, deviation, strict=True):
        axis, signal, unit = describe(column)
        value = float(np.asarray(getattr(effect, column.field))[column.index])
        found.append(Term(axis, signal, unit, value, float(std), gains.get(column, 0.0)))
    return sorted(found, key=lambda term: -term.gain)


@dataclass(frozen=True)
class Proposal:
    """A formula alongside the effects that were found.

    Attributes:
        terms: of the formula, the largest gain first.
        buys: largest share by which the formula lowers a prediction error of the fit flights.
        hypothesis: with the formula, and without effects that only stood in for it.
        without: the same hypothesis without the formula.
    """

    terms: list[Term]
    buys: float
    hypothesis: Hypothesis
    without: Hypothesis


def mimicked(search: Search, hypothesis: Hypothesis, name: str, terms: list[Column]) -> bool:
    """Whether the terms can reproduce most of an effect; the effect, which has a physical meaning, is then kept.

    An effect that the terms cannot reproduce, but that is needless alongside them, only stood in for them.

    Args:
        search: with the library.
        hypothesis: with the effect and the terms.
        name: of the effect.
        terms: columns of the formula.
    """
    own = search.own_columns(hypothesis)
    linear = search.linearise(hypothesis, own)
    total = linear.blocks.sum(0) * np.outer(linear.scale, linear.scale)
    effect = linear.index([c for c in own if c.effect == name and c not in terms])
    term = linear.index(terms)
    inside = total[np.ix_(term, term)]
    across = total[np.ix_(term, effect)]
    said = np.trace(across.T @ np.linalg.solve(inside + 1e-9 * np.trace(inside) * np.eye(len(term)), across))
    return bool(said > 0.5 * np.trace(total[np.ix_(effect, effect)]))


def explain(
    found: Trace, progress: Callable[[str], None] = lambda _: None, held_out: Search | None = None
) -> tuple[Search, Proposal | None]:
    """Look for a formula alongside the effects found, keep it if it is material, and remove effects it makes needless.

    Args:
        found: result of the search.
        progress: called with a message at each step.
        held_out: search over other flights. Terms that are immaterial on the fit flights may be material there.

    Returns:
        The search over the fit flights, with the formula among its effects if there is one, and the formula.
    """
    search, hypothesis = found.search, found.hypothesis
    widened, base = with_library(search, hypothesis)
    chosen = select(widened, base, progress)
    terms = _material(widened, base, chosen.sure, found, held_out)
    if held_out is not None:
        terms = _with_weakly_excited(widened, base, terms, chosen, held_out)
    if not terms:
        return search, None
    richer, deviation = fit_formula(widened, base, terms)
    new = prediction_errors(widened, richer)
    # A force that depends on the position has a constant part, which may have been fitted as wind.
    windy = "wind" in hypothesis.present and any(c.field == "place" for c in terms)
    for name in sorted(hypothesis.present, key=lambda name: not (windy and name == "wind")):
        instead = windy and name == "wind"
        if not instead and mimicked(widened, richer, name, terms):
            continue
        progress(f"testing {name} again beside the formula")
        wider = terms + _constant_forces(terms) if instead else terms
        less, spread = fit_formula(widened, richer.without(name), wider)
        without = prediction_errors(widened, less)
        if np.max(1 - new / without) < search.rules.structure:
            richer, deviation, new, terms = less, spread, without, wider
    plain = base
    for name in set(hypothesis.present) - set(richer.present):
        plain = plain.without(name)
    plain = widened.settled(plain)
    buys = float(np.max(1 - new / prediction_errors(widened, plain)))
    return widened, Proposal(terms_of(richer, deviation, chosen.gains), buys, richer, plain)


def only_there(held_out: Search, hypothesis: Hypothesis) -> list[Term]:
    """Look for terms that only the held-out flights show, and fit them there.

    They indicate what is missing and what to fly. They never enter the model, because no flights would be left to judge
    it on.

    Args:
        held_out: search over the held-out flights.
        hypothesis: result of the fit flights. Its parameters are refitted, so that their errors on the held-out flights
            are not mistaken for structure.
    """
    widened, base = with_library(held_out, hypothesis)
    chosen = select(widened, base)
    if not chosen.sure:
        return []
    plain, _ = fit_formula(widened, base, [])
    richer, deviation = fit_formula(widened, base, chosen.sure)
    before, after, first = (prediction_errors(widened, each) for each in (plain, richer, widened.nothing()))
    alone = held_out.rules.there_alone
    return terms_of(richer, deviation, chosen.gains) if enough(before, after, first, alone, alone) else []


def _material(
    search: Search, base: Hypothesis, terms: list[Column], found: Trace, held_out: Search | None
) -> list[Column]:
    """The terms if they are material on the fit flights or else on the held-out ones; otherwise an empty list."""
    if not terms:
        return []
    richer, _ = fit_formula(search, base, terms)
    if search.rules.lowered(found.errors, prediction_errors(search, richer), found.declared_errors):
        return terms
    if held_out is None:
        return []
    three = found.hypothesis, richer, held_out.nothing()
    return terms if search.rules.lowered(*(prediction_errors(held_out, each) for each in three)) else []


def _with_weakly_excited(
    search: Search, base: Hypothesis, terms: list[Column], chosen: Selection, held_out: Search
) -> list[Column]:
    """Add terms that few blocks of the fit flights excite, if the held-out flights confirm them.

    A motion that is rare in the fit flights may be common in the held-out ones.
    """
    judge, _ = with_library(held_out, held_out.nothing())
    poorer = fit_formula(search, base, terms)[0] if terms else base
    known = [c for c in chosen.sure if c not in terms]
    more = []
    for group in chosen.weakly_excited + [known] * bool(known):
        richer, _ = fit_formula(search, base, terms + group)
        if confirm(judge, poorer, richer).t >= search.rules.formula_sure:
            more += group
    if not more:
        return terms
    richer, _ = fit_formula(search, base, terms + more)
    three = [prediction_errors(judge, each) for each in (poorer, richer, judge.nothing())]
    return terms + more if search.rules.lowered(*three) else terms


def _constant_forces(terms: list[Column]) -> list[Column]:
    """Columns of the constant forces along the world axes that are not among the terms."""
    places = [c for axis in (3, 4, 5) for c in term_columns(axis) if c.field == "place"]
    return [c for c in places if _place(c)[1] == 0 and c not in terms]
