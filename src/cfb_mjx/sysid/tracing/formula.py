"""When the catalogue fails: a sparse formula for what is left, which must pass the same tests as any effect."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from cfb_mjx.model.effects.formula import AXES, PLACES, TERMS, ResidualFormula
from cfb_mjx.sysid.tracing.acceptance import enough
from cfb_mjx.sysid.tracing.columns import FORMULA, Column, term_columns
from cfb_mjx.sysid.tracing.evidence import covariance, evidence, solve
from cfb_mjx.sysid.tracing.fits import prediction_errors
from cfb_mjx.sysid.tracing.search import LEAD_SPREAD, Hypothesis, Search
from cfb_mjx.sysid.tracing.trace import Trace

STRUCTURE = 0.06
"""A formula counts when it lowers at least one prediction error by this share."""
OF_FIRST = 0.05
"""And by this share of what the declared model scores: an effect of slightly another shape leaves crumbs."""
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
_WIDTH = 64


@dataclass(frozen=True)
class Term:
    """One term of a formula."""

    axis: str
    signal: str
    unit: str
    value: float
    std: float
    gain: float
    """Nats on blocks left out, when it was added."""

    def __str__(self) -> str:
        return f"{self.axis} = ({self.value:.3g} +- {self.std:.1g} {self.unit}) {self.signal}"


def describe(column: Column) -> tuple[str, str, str]:
    """Axis, signal and unit of the coefficient of a term."""
    i, j = column.index
    if column.field == "place":
        signal, unit = list(PLACES.items())[j]
        return f"world force_{'xyz'[i]}", signal, _per("N", unit)
    signal, unit = list(TERMS.items())[j]
    return AXES[i], signal, _per("N m" if i < 3 else "N", unit)


def _per(unit: str, signal: str) -> str:
    return unit if signal == "1" else f"{unit} / ({signal})"


def with_library(search: Search, hypothesis: Hypothesis) -> tuple[Search, Hypothesis]:
    """The same search and hypothesis with the (empty) formula among the effects."""
    empty = ResidualFormula.neutral()
    widened = replace(search, names=(*search.names, FORMULA), _flights=search._flights)
    return widened, replace(hypothesis, effects=(*hypothesis.effects, empty), origin=(*hypothesis.origin, empty))


def propose(
    search: Search, hypothesis: Hypothesis, progress: Callable[[str], None] = lambda _: None
) -> tuple[list[Column], dict[Column, float]]:
    """Terms that improve blocks left out beyond chance beside everything found, by forward selection per axis."""
    own = search.own_columns(hypothesis)
    tried = sum(len(term_columns(axis)) for axis in range(6))
    chosen, gains = [], {}
    progress("looking for structure in what is left")
    for linear in search.linearise_terms(hypothesis, own):
        library = [c for c in linear.columns if c.effect == FORMULA and c not in own]
        base, picked = linear.index(own), []
        families = [[c] for c in library] + _families(library)

        def gaining(columns, beside, linear=linear, base=base):
            return evidence(linear.blocks, base + linear.index(beside), linear.index(columns), linear.scale)

        for _ in range(PER_AXIS):
            rest = [[c for c in family if c not in picked] for family in families]
            found = [(gaining(columns, picked), columns) for columns in rest if columns]
            passing = [pair for pair in found if pair[0].p_value * tried < ALPHA and pair[0].gain > LEAST_GAIN]
            if not passing:
                break
            most = max(e.gain for e, _ in passing)
            best, columns = min(
                (pair for pair in passing if pair[0].gain >= OF_FAMILY * most),
                key=lambda pair: (len(pair[1]), -pair[0].gain),
            )
            picked += columns
            gains |= dict.fromkeys(columns, best.gain)
        for column in list(picked):
            others = [c for c in picked if c != column]
            if others and gaining([column], others).gain < NEEDLESS:
                picked = others
        chosen += picked
    return chosen, gains


def _families(library: list[Column]) -> list[list[Column]]:
    """`FAMILIES` among the terms of one axis."""
    found = []
    for field, groups in FAMILIES.items():
        signals = list(TERMS if field == "body_terms" else PLACES)
        named = {signals[c.index[1]]: c for c in library if c.field == field}
        found += [[named[s] for s in group] for group in groups if set(group) <= set(named)]
    return found


def fit_formula(search: Search, hypothesis: Hypothesis, terms: list[Column]) -> tuple[Hypothesis, np.ndarray]:
    """Fit the terms together with everything found; the hypothesis and the terms' standard deviations."""
    richer = replace(hypothesis, terms=tuple(terms))
    for _ in range(2):
        own = search.own_columns(richer)
        linear = search.linearise(richer, own, _WIDTH)
        index = linear.index(own)
        values = solve(linear.blocks.sum(0), index, linear.scale)
        richer = search.moved(richer, own, np.concatenate([[0.0], values * linear.scale[index]]))
    spread = covariance(linear.blocks, [1, *index], linear.scale, np.concatenate([[0.0], values]), 1 / LEAD_SPREAD**2)
    deviation = np.sqrt(np.diag(spread))[1:] * linear.scale[index]
    return richer, deviation[len(own) - len(terms) :]


def terms_of(hypothesis: Hypothesis, deviation: np.ndarray, gains: dict[Column, float]) -> list[Term]:
    """The formula in words."""
    effect = hypothesis.effect(FORMULA)
    found = []
    for column, std in zip(hypothesis.terms, deviation, strict=True):
        axis, signal, unit = describe(column)
        value = float(np.asarray(getattr(effect, column.field))[column.index])
        found.append(Term(axis, signal, unit, value, float(std), gains.get(column, 0.0)))
    return sorted(found, key=lambda term: -term.gain)


@dataclass(frozen=True)
class Proposal:
    """A formula beside the effects found.

    Attributes:
        terms: the formula, the largest gain first.
        buys: largest share by which it lowers a prediction error of the fit flights.
        hypothesis: with the formula, and without effects that only stood in for it.
        without: the same without the formula.
    """

    terms: list[Term]
    buys: float
    hypothesis: Hypothesis
    without: Hypothesis


def mimicked(search: Search, hypothesis: Hypothesis, name: str, terms: list[Column]) -> bool:
    """Whether the terms can say most of what an effect says: then the effect, which has a meaning, stays.

    An effect that the terms cannot say, but that nothing misses beside them, had only stood in for them.
    """
    own = search.own_columns(hypothesis)
    linear = search.linearise(hypothesis, own, _WIDTH)
    total = linear.blocks.sum(0) * np.outer(linear.scale, linear.scale)
    effect = linear.index([c for c in own if c.effect == name and c not in terms])
    term = linear.index(terms)
    inside = total[np.ix_(term, term)]
    across = total[np.ix_(term, effect)]
    said = np.trace(across.T @ np.linalg.solve(inside + 1e-9 * np.trace(inside) * np.eye(len(term)), across))
    return bool(said > 0.5 * np.trace(total[np.ix_(effect, effect)]))


def _lowered(old: np.ndarray, new: np.ndarray, first: np.ndarray) -> bool:
    return enough(old, new, first, STRUCTURE, OF_FIRST) and np.log(new / old).sum() <= 0


def explain(
    found: Trace, progress: Callable[[str], None] = lambda _: None, held_out: Search | None = None
) -> tuple[Search, Proposal | None]:
    """Look for a formula beside what was found, keep it if it is material, and drop effects it makes needless.

    Args:
        found: what the search came to.
        progress: told what happens.
        held_out: over other flights. What the fit flights excite too little to matter may matter there.

    Returns:
        The search over the fit flights, widened by the formula if there is one, and the formula.
    """
    search, hypothesis = found.search, found.hypothesis
    widened, base = with_library(search, hypothesis)
    terms, gains = propose(widened, base, progress)
    if not terms:
        return search, None
    richer, deviation = fit_formula(widened, base, terms)
    new = prediction_errors(widened, richer)
    if not _lowered(found.errors, new, found.declared_errors):
        if held_out is None:
            return search, None
        three = hypothesis, richer, held_out.nothing()
        if not _lowered(*(prediction_errors(held_out, each) for each in three)):
            return search, None
    # A force that hangs on the place has a constant part, which looked like wind.
    windy = "wind" in hypothesis.present and any(c.field == "place" for c in terms)
    for name in sorted(hypothesis.present, key=lambda name: not (windy and name == "wind")):
        instead = windy and name == "wind"
        if not instead and mimicked(widened, richer, name, terms):
            continue
        progress(f"looking at {name} again, beside the formula")
        wider = terms + _constant_forces(terms) if instead else terms
        less, spread = fit_formula(widened, richer.without(name), wider)
        without = prediction_errors(widened, less)
        if np.max(1 - new / without) < STRUCTURE:
            richer, deviation, new, terms = less, spread, without, wider
    plain = base
    for name in set(hypothesis.present) - set(richer.present):
        plain = plain.without(name)
    plain = widened.settled(plain)
    buys = float(np.max(1 - new / prediction_errors(widened, plain)))
    return widened, Proposal(terms_of(richer, deviation, gains), buys, richer, plain)


def _constant_forces(terms: list[Column]) -> list[Column]:
    """Constant forces along the world's axes that are not among the terms."""
    places = [c for axis in (3, 4, 5) for c in term_columns(axis) if c.field == "place"]
    return [c for c in places if c.index[1] == 0 and c not in terms]
