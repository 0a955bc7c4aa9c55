"""Everything a drone lacks, from one look at its flights after another: all effects that stand beside each other.

The inner products of `Search.whole` hold what every effect of the catalogue would explain, and what it has in common
with every other. So a set of effects is put together without a fit: the one that gains most beside those chosen is
added, and what is no longer needed beside it taken out, until none gains beyond chance. Then all are fitted, what the
fit shows to be needless goes, and the flights are looked at again from there.
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
    """One effect of a set.

    Attributes:
        variant: its columns.
        found: for it beside those chosen before.
    """

    variant: list[Column]
    found: Evidence

    @property
    def name(self) -> str:
        """Of the effect."""
        return self.variant[0].effect


def beside_each_other(
    search: Search, hypothesis: Hypothesis, linear: Linear, refused: Collection[str] = ()
) -> list[Chosen]:
    """Absent effects that stand beside what is there and beside each other, the largest gain first."""
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

    # So many times: what pushed out others may in turn be pushed out by those that came after.
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
    """All effects of the catalogue that the innovations ask for, fitted together, beginning with the declared model.

    Args:
        search: over the flights.
        say: told what happens.
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
    """A hypothesis with all effects that the innovations ask for, and its derivatives by the whole catalogue.

    Args:
        search: over the flights.
        hypothesis: to begin with, with the noise levels of what it leaves.
        never: effects to pass over.
        better: whether what a look came to is to stay.
        say: told what happens.
    """
    # Late motor columns look like every lag at once: only beside the motors' own lags can they be told.
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
                # Too far for slopes, if not beyond all numbers: those that matter most first.
                richer, chosen = None, chosen[: len(chosen) // 2]
        if richer is None or frozenset(richer.present) in seen or not better(richer):
            break
        hypothesis, linear = richer, search.whole(richer)
        seen.add(frozenset(hypothesis.present))
    return hypothesis, linear


def told_apart(search: Search, fit: Fit, say: Callable[[str], None] = lambda _: None) -> Fit:
    """The fit with another effect in place of a field that says nearly the same, where that is better.

    Beside a free field the other effect explains nothing, so no look takes it in (`Effect.said_by`). The innovations
    must not refute it, and predictions be better by `Rules.same_errors`.
    """
    for name in fit.hypothesis.present:
        said_by = {} if name == SHIFT else CATALOGUE[name].said_by
        for other in (set(said_by.values()) & set(search.names)) - set(fit.hypothesis.present):
            say(f"telling {name} from {other}")
            rival = fit.hypothesis.having(fit.hypothesis.effect(other))
            rival = search.settled(rival, search.rules.look_steps, shrunk=True)
            if confirm(search, fit.hypothesis, rival).t > -search.rules.doubtful:
                apart = as_it_is(search, rival, whole=False)
                fit = apart if _total(apart) < _total(fit) - len(ERRORS) * search.rules.same_errors else fit
    return fit


def borne_out(search: Search, fit: Fit, say: Callable[[str], None] = lambda _: None) -> Fit:
    """What of many effects predictions miss: the others go one by one.

    What goes is taken out to first order to see what the predictions say; of the two without which they are best each
    is, with the rest fitted anew, for one of two that say nearly the same may stand in for the other.
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
    """For each effect that is there, and the hypothesis without it, the others moved to make up: to first order."""
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
    """Sum of the logarithms of the prediction errors; infinite where predictions diverge."""
    found = float(np.log(fit.errors).sum())
    return found if np.isfinite(found) else np.inf


def needless(search: Search, hypothesis: Hypothesis) -> dict[str, Evidence]:
    """What is there and does not stand beside the rest, by the slopes where it is; the least first."""
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
    """The hypothesis with more effects, all fitted, less what the fit shows to be needless."""
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
    """For an effect as it is: the residual is what it would be, to first order, if the effect vanished."""
    added = [c for c in own if c.effect == name and (name == SHIFT or c.field in CATALOGUE[name].strengths)]
    others = [c for c in own if c.effect != name and c.effect not in gone]
    blocks = _put_back(search, hypothesis, linear, [c for c in own if c in added or c.effect in gone])
    prior = search.prior(hypothesis, others) + _near_zero(len(added))
    return evidence(blocks, linear.index(others), linear.index(added), linear.scale, prior, linear.fold)


def _taken_out(search: Search, hypothesis: Hypothesis, linear: Linear, own: list[Column], name: str) -> Hypothesis:
    """The hypothesis without an effect, the others moved to make up for it to first order."""
    away, others = [c for c in own if c.effect == name], [c for c in own if c.effect != name]
    total = _put_back(search, hypothesis, linear, away).sum(0)
    index = linear.index(others)
    steps = solve(total, index, linear.scale, search.prior(hypothesis, others)) * linear.scale[index]
    return search.moved(hypothesis.without(name), others, np.append(0.0, steps))


def _put_back(search: Search, hypothesis: Hypothesis, linear: Linear, away: list[Column]) -> np.ndarray:
    """(b, c, c) inner products with the residual that is left, to first order, where some numbers are as declared."""
    back, index = np.eye(linear.blocks.shape[1]), linear.index(away)
    back[index, 0] = -search.prior(hypothesis, away).center * linear.scale[index]
    return np.einsum("ki,bkl,lj->bij", back, linear.blocks, back, optimize=True)


def _near_zero(count: int) -> Prior:
    return Prior(np.zeros(count), np.ones(count))
