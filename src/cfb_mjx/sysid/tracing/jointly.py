"""Selection of many missing effects at once, by stepwise regression on the linearised residual.

The inner products of `Search.whole` contain what every effect of the catalogue would explain, and what it shares with
every other effect. So a set of effects can be selected without a fit: add the effect with the largest gain given those
already chosen, remove chosen ones that are no longer significant, and stop when no further effect is. Then fit all
effects of the set, remove those that the fit shows to be needless, linearise again and repeat.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from scipy.stats import norm

from cfb_mjx.model.effects import CATALOGUE
from cfb_mjx.optional import not_none
from cfb_mjx.sysid.evaluation import Evaluation, evaluate
from cfb_mjx.sysid.flight import Flight, prepare_flight
from cfb_mjx.sysid.tracing.evidence import Evidence, Prior, evidence, solve
from cfb_mjx.sysid.tracing.hypothesis import SHIFT, Column, Fit, Hypothesis, Linear, sensible
from cfb_mjx.sysid.tracing.innovations import CHANNELS, DOMAINS, Levels, innovations, levels_from
from cfb_mjx.sysid.tracing.search import Search
from cfb_mjx.sysid.tracing.signals import Blocks, joined

ERRORS = tuple(
    f"{q}@{h}s"
    for h in ("0.2", "0.5")
    for q in ("position_rmse_m", "velocity_rmse_mps", "attitude_rmse_deg", "rate_rmse_radps")
)
"""Prediction errors by which an effect is judged: four quantities at two horizons."""


def predicted(search: Search, hypothesis: Hypothesis) -> Evaluation:
    """Predictions of the search's flights by a hypothesis."""
    return evaluate(hypothesis.model(search.parameters), search.logs, faults=hypothesis.faults, keep_diverged=True)


def errors_of(evaluation: Evaluation) -> np.ndarray:
    """Prediction errors `ERRORS` (8,) over all flights."""
    metrics = not_none(evaluation.metrics("commands_in"))
    return np.array([metrics[key] for key in ERRORS])


def prediction_errors(search: Search, hypothesis: Hypothesis) -> np.ndarray:
    """Prediction errors `ERRORS` (8,) on the flights of the search."""
    return errors_of(predicted(search, hypothesis))


def beside_hold(evaluation: Evaluation) -> float:
    """Mean attitude or velocity error at the last horizon, each divided by that of `hold`; the larger ratio of the two.

    Infinite if the predictions diverged.
    """
    model, still = (not_none(evaluation.metrics(variant)) for variant in ("commands_in", "hold"))
    keys = [f"{quantity}@{max(evaluation.horizons):g}s" for quantity in ("attitude_mean_deg", "velocity_mean_mps")]
    found = max(model[key] / still[key] for key in keys)
    return float(found) if np.isfinite(found) else np.inf


def fitted(search: Search, hypothesis: Hypothesis, whole: bool = True) -> Fit:
    """Fit the parameters of all present effects; linearise with respect to the whole catalogue only if ``whole``."""
    return as_it_is(search, search.settled(hypothesis), whole)


def as_it_is(search: Search, hypothesis: Hypothesis, whole: bool = True) -> Fit:
    """The `Fit` of a hypothesis that is already fitted: its errors and, if ``whole``, its linearisation."""
    linear = search.whole(hypothesis) if whole else None
    evaluation = predicted(search, hypothesis)
    flights = [errors_of(one) for one in evaluation.each if len(one.logs[0].windows)]
    return Fit(hypothesis, linear, errors_of(evaluation), np.array(flights), beside_hold(evaluation))


def completed(search: Search, fit: Fit) -> Fit:
    """The fit with its linearisation with respect to the whole catalogue, computed if it is missing."""
    return fit if fit.linear is not None else replace(fit, linear=search.whole(fit.hypothesis))


TOGETHER = 64
"""Number of blocks compared at once. It is fixed, so that one compiled program serves any number of blocks."""


@dataclass(frozen=True)
class Verdict:
    """Comparison of a richer hypothesis with a poorer one on held-out flights.

    Attributes:
        gain: decrease of half the sum of squared innovations, nats; None if predictions were compared instead.
        t: statistic that is standard normal if the richer hypothesis explains nothing more.
        p_value: one-sided p-value of ``t``.
        domains: the gain in each of `DOMAINS`.
    """

    gain: float | None
    t: float
    p_value: float
    domains: dict[str, float] | None = None


def confirm(search: Search, poorer: Hypothesis, richer: Hypothesis) -> Verdict:
    """Compare the whitened innovations of two fitted hypotheses on the flights of ``search``.

    Args:
        search: flights on which to compare.
        poorer: hypothesis without the effect to be tested; its noise levels are used for both.
        richer: hypothesis with the effect.
    """
    levels = levels_from(jnp.asarray(poorer.levels), search.noise)
    score, power, noise = np.zeros(CHANNELS + 3), np.zeros(CHANNELS + 3), 0.0
    alike = poorer.shift == richer.shift
    own, other = (None, None) if alike else zip(*_matched(search, poorer, richer), strict=True)
    # Compute the richer one first: its residuals stay cached while several poorer ones are compared with it.
    more = joined(blocks for blocks, _ in search.residuals(richer, other))
    less = joined(blocks for blocks, _ in search.residuals(poorer, own))
    signals = jax.tree.map(lambda a, b: np.stack([a, b], axis=-1), less.signals, more.signals)
    for first in range(0, len(less.interval), TOGETHER):
        # The last group repeats its last block.
        rows = np.arange(first, min(first + TOGETHER, len(less.interval)))
        filled = np.pad(rows, (0, TOGETHER - len(rows)), mode="edge")
        both = jax.tree.map(lambda x, r=filled: x[r], Blocks(signals, less.interval, less.valid))
        rz, zz = (np.asarray(x)[: len(rows)] for x in _products(both, levels))
        score, power = score + rz.sum(axis=0), power + zz.sum(axis=0)
        noise += np.sum(np.sum(rz - zz, axis=1) ** 2)
    t = score.sum() / np.sqrt(max(noise, power.sum(), 1e-30))
    gain = score - 0.5 * power
    domains = {name: float(gain[list(channels)].sum()) for name, channels in DOMAINS.items()}
    return Verdict(float(gain.sum()), float(t), float(norm.sf(t)), domains)


@eqx.filter_jit
def _products(both: Blocks, levels: Levels) -> tuple[Array, Array]:
    """Sums per block and channel (b, 13): poorer residual times its difference to the richer one, and the square."""
    e, _, _ = innovations(both, levels)
    said = e[..., 0] - e[..., 1]
    return jnp.sum(e[..., 0] * said, axis=1), jnp.sum(said**2, axis=1)


def _matched(search: Search, poorer: Hypothesis, richer: Hypothesis) -> Iterator[tuple[Flight, Flight]]:
    """Every flight as prepared for both hypotheses, cut to their common rows.

    A time shift of the motor columns removes rows at the ends and at gaps.
    """
    for log in search.logs:
        logs = [hypothesis.faults.repaired(log) for hypothesis in (poorer, richer)]
        both = np.intersect1d(logs[0].time, logs[1].time)
        one, other = (prepare_flight(log.rows(np.isin(log.time, both)), *search.delays) for log in logs)
        yield one, other


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
