"""Selection of many missing effects at once, by stepwise regression on the linearised residual.

The inner products of `Search.whole` contain what every effect of the catalogue would explain, and what it shares with
every other effect. So a set of effects can be selected without a fit: add the effect with the largest gain given those
already chosen, remove chosen ones that are no longer significant, and stop when no further effect is. Then fit all
effects of the set, remove those that the fit shows to be needless, linearise again and repeat.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass, replace

import numpy as np

from cfb_mjx.model.effects import CATALOGUE
from cfb_mjx.optional import not_none
from cfb_mjx.sysid.tracing.evidence import Evidence, Prior, evidence, solve
from cfb_mjx.sysid.tracing.fits import ERRORS, as_it_is, confirm
from cfb_mjx.sysid.tracing.hypothesis import SHIFT, Column, Fit, Hypothesis, Linear, sensible
from cfb_mjx.sysid.tracing.search import Search


@dataclass(frozen=True)
class Chosen:
    """One effect of a selection.

    Attributes:
        variant: its columns.
        found: evidence for it given the effects chosen before.
    """

    variant: list[Column]
    found: Evidence

    @property
    def name(self) -> str:
        """Name of the effect."""
        return self.variant[0].effect


def beside_each_other(
    search: Search, hypothesis: Hypothesis, linear: Linear, refused: Collection[str] = ()
) -> list[Chosen]:
    """Select the absent effects that are significant given the present effects and given each other.

    Args:
        search: over the flights.
        hypothesis: the present effects.
        linear: linearisation at the hypothesis by the whole catalogue.
        refused: names of effects to pass over.

    Returns:
        The selected effects in the order in which they were chosen.
    """
    own = search.own_columns(hypothesis)
    base, prior = linear.index(own), search.prior(hypothesis, own)
    absent = [v for v in search.candidates(hypothesis) if v[0].effect not in refused]
    chosen: list[Chosen] = []

    def beside(variant: list[Column], others: list[Chosen]) -> Evidence:
        columns = [column for each in others for column in each.variant]
        index = base + linear.index(columns)
        known = prior + _near_zero(len(columns) + len(variant))
        return evidence(linear.blocks, index, linear.index(variant), linear.scale, known, linear.fold)

    def stands(variant: list[Column], found: Evidence) -> bool:
        return search.stands(found) and sensible(variant, found.values)

    # The limit ends cycles: an effect that displaced others may be displaced by later ones.
    for _ in range(search.rules.a_look):
        names = {each.name for each in chosen}
        more = [(variant, beside(variant, chosen)) for variant in absent if variant[0].effect not in names]
        more = [Chosen(variant, found) for variant, found in more if stands(variant, found)]
        if not more:
            break
        newest = max(more, key=lambda each: each.found.gain)
        before, chosen = chosen, [*chosen, newest]
        for each in before:
            others = [other for other in chosen if other is not each]
            if not stands(each.variant, beside(each.variant, others)):
                chosen = others
    return chosen


def everything(search: Search, say: Callable[[str], None] = lambda _: None) -> Fit:
    """Select and fit together all effects that the innovations require, starting from the declared model.

    Args:
        search: over the flights.
        say: called with a message at each step.
    """
    fits = [as_it_is(search, search.learned(search.nothing()), whole=False)]

    def better(richer: Hypothesis) -> bool:
        fits.append(as_it_is(search, richer, whole=False))
        return _total(fits[-1]) < _total(fits[-2])

    hypothesis, linear = look_by_look(search, fits[0].hypothesis, better=better, say=say)
    return replace(next(fit for fit in fits if fit.hypothesis is hypothesis), linear=linear)


def look_by_look(
    search: Search,
    hypothesis: Hypothesis,
    never: Collection[str] = (),
    better: Callable[[Hypothesis], bool] = lambda _: True,
    say: Callable[[str], None] = lambda _: None,
) -> tuple[Hypothesis, Linear]:
    """Alternate selection and fit until the selection changes no more.

    Args:
        search: over the flights.
        hypothesis: where to start, with the noise levels of its residuals.
        never: names of effects to pass over.
        better: predicate that decides whether a fitted hypothesis is kept.
        say: called with a message at each step.

    Returns:
        The last hypothesis kept, and its linearisation by the whole catalogue.
    """
    # Late motor columns resemble every lag, so they are identifiable only once the motors' own lags are included.
    linear, refused, seen = search.whole(hypothesis), {SHIFT, *never}, {frozenset(hypothesis.present)}
    for _ in range(search.rules.looks):
        chosen = beside_each_other(search, hypothesis, linear, refused)
        refused, richer = set(never), None
        while chosen and richer is None:
            more, there = [each.name for each in chosen], hypothesis.present
            say(f"fitting {', '.join(more)} beside {', '.join(there) or 'nothing'}")
            with np.errstate(over="ignore", invalid="ignore"):
                richer = _with(search, hypothesis, linear, chosen)
                gain = not_none(confirm(search, hypothesis, richer).gain)
            if not gain > 0:
                # The linear fit went too far (possibly to infinity): try again with the more important half.
                richer, chosen = None, chosen[: len(chosen) // 2]
        if richer is None or frozenset(richer.present) in seen or not better(richer):
            break
        hypothesis, linear = richer, search.whole(richer)
        seen.add(frozenset(hypothesis.present))
    return hypothesis, linear


def told_apart(search: Search, fit: Fit, say: Callable[[str], None] = lambda _: None) -> Fit:
    """Replace fields by the nearly equivalent effect (`Effect.said_by`) where that predicts better.

    Beside the free field the other effect explains nothing, so the selection never chooses it. It replaces the field
    if the innovations do not refute it and the predictions improve by `Rules.same_errors`.
    """
    for name in fit.hypothesis.present:
        said_by = {} if name == SHIFT else CATALOGUE[name].said_by
        for other in (set(said_by.values()) & set(search.names)) - set(fit.hypothesis.present):
            say(f"comparing {name} with {other}")
            rival = fit.hypothesis.having(fit.hypothesis.effect(other))
            rival = search.settled(rival, search.rules.look_steps, shrunk=True)
            if confirm(search, fit.hypothesis, rival).t > -search.rules.doubtful:
                apart = as_it_is(search, rival, whole=False)
                fit = apart if _total(apart) < _total(fit) - len(ERRORS) * search.rules.same_errors else fit
    return fit


def borne_out(search: Search, fit: Fit, say: Callable[[str], None] = lambda _: None) -> Fit:
    """Remove, one by one, the effects that the predictions do not need.

    The candidates for removal are found to first order: each effect is removed and the others are adjusted. For the two
    without which predictions are best, the rest is refitted and the better fit is kept, because one of two nearly
    equivalent effects may stand in for the other.
    """
    while len(fit.hypothesis.present) > 1:
        worth = {}
        for name, (found, without) in one_by_one(search, fit.hypothesis).items():
            less = as_it_is(search, without, whole=False)
            if not search.rules.missed(less, fit, found.t >= search.rules.clear):
                worth[name] = _total(less)
        if not worth:
            return fit
        least = sorted(worth, key=worth.__getitem__)[:2]
        say(f"leaving out {' or '.join(least)}")
        tried = [search.settled(fit.hypothesis.without(name), search.rules.look_steps, shrunk=True) for name in least]
        fit = min((as_it_is(search, each, whole=False) for each in tried), key=_total)
    return fit


def one_by_one(search: Search, hypothesis: Hypothesis) -> dict[str, tuple[Evidence, Hypothesis]]:
    """Per present effect, to first order: the evidence for it, and the hypothesis without it, the others adjusted."""
    own = search.own_columns(hypothesis)
    linear = search.linearise(hypothesis, own)
    return {
        name: (
            _for_what_is_there(search, hypothesis, linear, own, name, ()),
            _taken_out(search, hypothesis, linear, own, name),
        )
        for name in hypothesis.present
    }


def _total(fit: Fit) -> float:
    """Sum of the logarithms of the prediction errors; infinite if predictions diverge."""
    found = float(np.log(fit.errors).sum())
    return found if np.isfinite(found) else np.inf


def needless(search: Search, hypothesis: Hypothesis) -> dict[str, Evidence]:
    """Present effects that are not significant given the rest, by the linearisation here; the smallest gain first."""
    own = search.own_columns(hypothesis)
    linear, gone = search.linearise(hypothesis, own), {}
    while True:
        left = {
            name: _for_what_is_there(search, hypothesis, linear, own, name, gone)
            for name in hypothesis.present
            if name not in gone
        }
        small = SHIFT in left and abs(hypothesis.shift) < search.rules.smallest_shift
        doubted = {name: found for name, found in left.items() if not search.stands(found) or (name == SHIFT and small)}
        if not doubted:
            return gone
        least = min(doubted, key=lambda name: doubted[name].gain)
        gone[least] = doubted[least]


def _with(search: Search, hypothesis: Hypothesis, linear: Linear, chosen: list[Chosen]) -> Hypothesis:
    """Add the chosen effects to the hypothesis, fit all, and remove those that the fit shows to be needless."""
    own = search.own_columns(hypothesis)
    columns = [column for each in chosen for column in each.variant]
    index = linear.index([*own, *columns])
    prior = search.prior(hypothesis, own) + _near_zero(len(columns))
    values = iter(solve(linear.blocks.sum(0), index, linear.scale, prior)[len(own) :])
    for each in chosen:
        start = replace(each.found, values=np.array([next(values) for _ in each.variant]))
        hypothesis = search.with_candidate(hypothesis, each.variant, start)
    hypothesis = search.settled(hypothesis, search.rules.look_steps, shrunk=True)
    gone = needless(search, hypothesis)
    for name in gone:
        hypothesis = hypothesis.without(name)
    return search.settled(hypothesis, search.rules.look_steps, shrunk=True) if gone else hypothesis


def _for_what_is_there(
    search: Search, hypothesis: Hypothesis, linear: Linear, own: list[Column], name: str, gone: Collection[str]
) -> Evidence:
    """Evidence for a present effect: the residual is extrapolated, to first order, to where the effect vanishes."""
    added = [c for c in own if c.effect == name and (name == SHIFT or c.field in CATALOGUE[name].strengths)]
    others = [c for c in own if c.effect != name and c.effect not in gone]
    blocks = _put_back(search, hypothesis, linear, [c for c in own if c in added or c.effect in gone])
    prior = search.prior(hypothesis, others) + _near_zero(len(added))
    return evidence(blocks, linear.index(others), linear.index(added), linear.scale, prior, linear.fold)


def _taken_out(search: Search, hypothesis: Hypothesis, linear: Linear, own: list[Column], name: str) -> Hypothesis:
    """The hypothesis without an effect, with the others adjusted to compensate to first order."""
    away, others = [c for c in own if c.effect == name], [c for c in own if c.effect != name]
    total = _put_back(search, hypothesis, linear, away).sum(0)
    index = linear.index(others)
    steps = solve(total, index, linear.scale, search.prior(hypothesis, others)) * linear.scale[index]
    return search.moved(hypothesis.without(name), others, np.append(0.0, steps))


def _put_back(search: Search, hypothesis: Hypothesis, linear: Linear, away: list[Column]) -> np.ndarray:
    """Inner products (b, c, c) with the residual extrapolated, to first order, to declared values of ``away``."""
    back, index = np.eye(linear.blocks.shape[1]), linear.index(away)
    back[index, 0] = -search.prior(hypothesis, away).center * linear.scale[index]
    return np.einsum("ki,bkl,lj->bij", back, linear.blocks, back, optimize=True)


def _near_zero(count: int) -> Prior:
    """Prior about zero with half the prior range as standard deviation."""
    return Prior(np.zeros(count), np.ones(count))
