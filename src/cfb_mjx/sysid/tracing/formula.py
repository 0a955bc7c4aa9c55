"""When the catalogue fails: a sparse formula for what is left, which must pass the same tests as any effect."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from cfb_mjx.model.effects.formula import AXES, PLACES, TERMS
from cfb_mjx.sysid.tracing.acceptance import STRUCTURE, enough, lowered
from cfb_mjx.sysid.tracing.columns import FORMULA, Column, term_columns
from cfb_mjx.sysid.tracing.confirmation import confirm
from cfb_mjx.sysid.tracing.evidence import Prior, covariance, solve
from cfb_mjx.sysid.tracing.fits import prediction_errors
from cfb_mjx.sysid.tracing.hypothesis import LEAD_SPREAD, Hypothesis
from cfb_mjx.sysid.tracing.search import Search
from cfb_mjx.sysid.tracing.terms import Selection, select, with_library
from cfb_mjx.sysid.tracing.trace import Trace

SURE = 3.0
"""A formula counts when its statistic on flights nothing was fitted to is above this."""
THERE_ALONE = 0.2
"""Terms that only those flights show must lower an error by this share, and by as much of the declared model's."""
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


def fit_formula(search: Search, hypothesis: Hypothesis, terms: list[Column]) -> tuple[Hypothesis, np.ndarray]:
    """Fit the terms together with everything found; the hypothesis and the terms' standard deviations."""
    richer = replace(hypothesis, terms=tuple(terms))
    for _ in range(2):
        own = search.own_columns(richer)
        linear = search.linearise(richer, own, _WIDTH)
        index = linear.index(own)
        values = solve(linear.blocks.sum(0), index, linear.scale)
        richer = search.moved(richer, own, np.concatenate([[0.0], values * linear.scale[index]]))
    prior = Prior.weak(1 + len(index)).pulled(0, 0.0, 1 / LEAD_SPREAD**2)
    spread = covariance(linear.blocks, [1, *index], linear.scale, np.concatenate([[0.0], values]), prior)
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
    chosen = select(widened, base, progress)
    terms = _material(widened, base, chosen.sure, found, held_out)
    if held_out is not None:
        terms = _with_rare(widened, base, terms, chosen, held_out)
    if not terms:
        return search, None
    richer, deviation = fit_formula(widened, base, terms)
    new = prediction_errors(widened, richer)
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
    return widened, Proposal(terms_of(richer, deviation, chosen.gains), buys, richer, plain)


def only_there(held_out: Search, hypothesis: Hypothesis) -> list[Term]:
    """Structure in flights nothing was fitted to that the fitted ones do not show: terms fitted to those flights.

    They tell what is missing and what to fly; no model learns from them, for nothing is left to judge it by.

    Args:
        held_out: over those flights.
        hypothesis: what was found on the others. Its numbers are fitted anew, so that what they are wrong by there is
            not taken for structure.
    """
    widened, base = with_library(held_out, hypothesis)
    chosen = select(widened, base)
    if not chosen.sure:
        return []
    plain, _ = fit_formula(widened, base, [])
    richer, deviation = fit_formula(widened, base, chosen.sure)
    three = [prediction_errors(widened, each) for each in (plain, richer, widened.nothing())]
    return terms_of(richer, deviation, chosen.gains) if enough(*three, THERE_ALONE, THERE_ALONE) else []


def _material(
    search: Search, base: Hypothesis, terms: list[Column], found: Trace, held_out: Search | None
) -> list[Column]:
    """The terms, if they lower errors of the fit flights or else of the held-out ones; nothing if not."""
    if not terms:
        return []
    richer, _ = fit_formula(search, base, terms)
    if lowered(found.errors, prediction_errors(search, richer), found.declared_errors):
        return terms
    if held_out is None:
        return []
    three = found.hypothesis, richer, held_out.nothing()
    return terms if lowered(*(prediction_errors(held_out, each) for each in three)) else []


def _with_rare(
    search: Search, base: Hypothesis, terms: list[Column], chosen: Selection, held_out: Search
) -> list[Column]:
    """The terms, and those that few blocks of the fit flights excite, if flights nothing was fitted to bear them out.

    What a drone rarely does in some flights may be what others consist of.
    """
    judge, _ = with_library(held_out, held_out.nothing())
    poorer = fit_formula(search, base, terms)[0] if terms else base
    known = [c for c in chosen.sure if c not in terms]
    more = []
    for group in chosen.rare + [known] * bool(known):
        richer, _ = fit_formula(search, base, terms + group)
        if confirm(judge, poorer, richer).t >= SURE:
            more += group
    if not more:
        return terms
    richer, _ = fit_formula(search, base, terms + more)
    three = [prediction_errors(judge, each) for each in (poorer, richer, judge.nothing())]
    return terms + more if lowered(*three) else terms


def _constant_forces(terms: list[Column]) -> list[Column]:
    """Constant forces along the world's axes that are not among the terms."""
    places = [c for axis in (3, 4, 5) for c in term_columns(axis) if c.field == "place"]
    return [c for c in places if c.index[1] == 0 and c not in terms]
