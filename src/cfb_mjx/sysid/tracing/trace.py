"""Tracing: from a campaign of flights to the effects a model lacks, each tested on data it was not fitted on."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from cfb_mjx.logs import FlightLog
from cfb_mjx.model.effects import KNOWN, Effect
from cfb_mjx.optional import not_none
from cfb_mjx.parameters import Parameters
from cfb_mjx.sysid.sensor_faults import SensorFaults
from cfb_mjx.sysid.tracing.checkpoint import Checkpoint, Progress
from cfb_mjx.sysid.tracing.evidence import Evidence, Prior, covariance, solve
from cfb_mjx.sysid.tracing.fits import ERRORS, as_it_is, completed, confirm, fitted, prediction_errors
from cfb_mjx.sysid.tracing.hypothesis import LEAD_SPREAD, SHIFT, Column, Fit, Hypothesis, Linear
from cfb_mjx.sysid.tracing.jointly import beside_each_other, borne_out, everything, one_by_one, told_apart
from cfb_mjx.sysid.tracing.rules import RULES, Rules
from cfb_mjx.sysid.tracing.search import Search
from cfb_mjx.sysid.tracing.sensors import SensorCheck, check_sensors


@dataclass
class Found:
    """One effect that is there."""

    name: str
    p_value: float
    gain: float | None
    """Nats on blocks left out; None where predictions judged."""
    buys: float
    """Largest share by which a prediction error of the fit flights grows without it."""
    parameters: dict[str, float | list[float]]
    uncertainty: dict[str, float | list[float]]
    confusable: list[str]
    without: Hypothesis
    """The best model without this effect, for judging it on other flights."""
    lowers: float = 0.0
    """Sum of the logarithms by which the prediction errors of the fit flights grow without it: the order goes by that,
    for the largest share is that of one error."""


@dataclass
class Trace:
    """Outcome of a search."""

    hypothesis: Hypothesis
    sensors: SensorCheck
    found: list[Found]
    tried: list[dict]
    """What was looked at in every round, for the report."""
    search: Search
    declared_errors: np.ndarray
    """`prediction_errors` of the declared model."""
    errors: np.ndarray
    """Of the hypothesis."""
    fit: Fit
    """Of the hypothesis, with derivatives by the whole catalogue."""

    @property
    def faults(self) -> SensorFaults:
        """Everything wrong with the recording."""
        return replace(self.sensors.faults, motor_shift=self.hypothesis.shift)


@dataclass(frozen=True)
class LeftOut:
    """A fit without one of its effects, fitted anew."""

    fit: Fit
    ranking: list[tuple[Evidence, list[Column]]]
    """Of everything that could come in its place."""
    own: Evidence | None
    """For the effect itself; None if its best value makes no sense."""


def leave_out(search: Search, hypothesis: Hypothesis, name: str, start: Hypothesis | None = None) -> LeftOut:
    """Fit without an effect and see what would come in its place; the fit may ``start`` nearer to where it ends."""
    less = fitted(search, start or hypothesis.without(name))
    ranking = rank(search, less, set())
    return LeftOut(less, ranking, next((e for e, v in ranking if v[0].effect == name), None))


def trace(
    logs: list[FlightLog],
    parameters: Parameters,
    delay: float = 0.008,
    progress: Callable[[str], None] = lambda _: None,
    declared: tuple[Effect, ...] = (),
    checkpoint: Checkpoint | None = None,
    brief: bool = False,
    rules: Rules = RULES,
) -> Trace:
    """Search the catalogue for what a model lacks.

    Args:
        logs: flights to fit; run with x64 enabled.
        parameters: the declared drone.
        delay: declared age of pose and velocity in a row, s.
        progress: told what happens.
        declared: effects the declared model has already.
        checkpoint: where the search is kept while it runs, and taken up from.
        brief: leave a drone that lacks much to the caller: the first candidate that lowers no error ends the search
            while the model predicts worse than `hold` does.
        rules: what counts.
    """
    checkpoint = checkpoint or Checkpoint()
    progress("comparing the sensors with each other")
    sensors = check_sensors(logs, delay, float(parameters.gyro_delay))
    search = Search.start(logs, parameters, delay, sensors, declared, rules=rules)
    progress("replaying the declared model")
    nothing = fitted(search, search.learned(search.nothing()))
    saved = checkpoint.restore(nothing.hypothesis)
    fit, refused, tried, vain = nothing, set(), [], 0
    # Without which effects was a model fitted (None: it can be again), and which.
    left_out: Mapping[str, LeftOut | None] = {}
    judged = nothing.hypothesis
    # Of many taken in together: near to where a fit without one of them ends.
    starts: dict[str, Hypothesis] = {}
    if saved is not None:
        progress(f"going on with {', '.join(saved.hypothesis.present) or 'no effect'} found before the interruption")
        fit = as_it_is(search, saved.hypothesis)
        judged = fit.hypothesis if saved.judged is None else saved.judged
        refused, tried, vain, left_out = (
            set(saved.refused),
            list(saved.tried),
            saved.vain,
            dict.fromkeys(saved.left_out),
        )
    while len(fit.hypothesis.present) < rules.largest:
        if vain >= (1 if brief and fit.beside_hold > 1 else rules.patience):
            break
        ranking = rank(search, fit, refused)
        tried.append({"present": list(fit.hypothesis.present), "ranking": [line_of(v, e) for e, v in ranking[:8]]})
        passing = [(e, v) for e, v in ranking if search.stands(e)]
        if not passing:
            break
        if (fit.hypothesis.present or vain) and not brief:
            many = lacks_many(search, fit, progress)
            if many is not None:
                fit, left_out = many, {}
                starts = {name: less for name, (_, less) in one_by_one(search, fit.hypothesis).items()}
                break
        options, stretched = contenders(search, fit, passing, progress)
        refused |= stretched
        statistic = {v[0].effect: e.t for e, v in passing}
        # The likeliest first. It may be too slight beside a large error of which another contender is the cause.
        for name, richer in options:
            drop = dict(zip(ERRORS, (1 - richer.errors / fit.errors).tolist(), strict=True))
            tried[-1] |= {"tried": name, "drop": drop}
            fit, seen = taken_in(search, nothing, fit, name, richer, statistic[name] >= rules.clear, progress)
            if seen is not None:
                fit, vain = completed(search, fit), 0
                # What was too slight beside a large error may matter now.
                refused = set()
                left_out, judged = seen, fit.hypothesis
                break
            refused.add(name)
        else:
            vain += 1
        checkpoint.save(Progress(fit.hypothesis, frozenset(refused), tuple(tried), vain, tuple(left_out), judged))
    if len(fit.hypothesis.present) > 1 and not starts:
        single = simplified(search, nothing, fit, tried[0]["ranking"], progress)
        fit, left_out = (completed(search, single), {}) if single is not None else (fit, left_out)
    if not starts:
        apart = told_apart(search, fit, progress)
        fit, left_out = (completed(search, apart), {}) if apart is not fit else (fit, left_out)
    found = []
    for name in fit.hypothesis.present:
        whole = judged if name in left_out else fit.hypothesis
        less = left_out.get(name) or leave_out(search, whole, name, starts.get(name))
        found.append(summary(search, fit, name, less))
    found.sort(key=lambda f: -f.lowers)
    return Trace(fit.hypothesis, sensors, found, tried, search, nothing.errors, fit.errors, fit)


def lacks_many(search: Search, fit: Fit, progress: Callable[[str], None]) -> Fit | None:
    """All that a drone lacks, where that is much beside what was found; None where it is not, or predicts no better.

    It begins with the declared model again, for what was taken in first has taken on what others explain.
    """
    standing = beside_each_other(search, fit.hypothesis, not_none(fit.linear))
    if sum(each.found.t > search.rules.clear for each in standing) < search.rules.many:
        return None
    whole = told_apart(search, everything(search, progress), progress)
    if not (np.log(whole.errors / fit.errors).sum() < 0 and whole.beside_hold < search.rules.far_off):
        return None
    return completed(search, borne_out(search, whole, progress))


def rank(search: Search, fit: Fit, refused: set[str]) -> list[tuple[Evidence, list[Column]]]:
    """Every absent effect at its best probe, the largest gain first."""
    best = search.probes(fit.hypothesis, not_none(fit.linear))
    return sorted((pair for name, pair in best.items() if name not in refused), key=lambda pair: -pair[0].gain)


def needed(search: Search, less: LeftOut, fit: Fit, nothing: Fit) -> bool:
    """Whether a fit without one of its effects shows that the effect is missed."""
    if less.own is None or not search.stands(less.own):
        return False
    return search.rules.lowers(less.fit, fit, nothing, less.own.t >= search.rules.clear)


def taken_in(
    search: Search,
    nothing: Fit,
    fit: Fit,
    name: str,
    richer: Fit,
    clear: bool,
    progress: Callable[[str], None],
) -> tuple[Fit, dict[str, LeftOut] | None]:
    """Take an effect in if it is worth it, and look at the others again.

    Args:
        search: over the fit flights.
        nothing: the declared model.
        fit: without the effect.
        name: the effect.
        richer: with it.
        clear: whether its t is above `Rules.clear`.
        progress: told what happens.

    Returns:
        The fit, and what is left of it without each effect looked at; None for that where the effect does not stay.
    """
    if not search.rules.worth_it(name, fit, richer, nothing, clear):
        return fit, None
    # Taken out again, for the newcomer's turn has also fitted the others anew, and that is not its merit.
    less = leave_out(search, richer.hypothesis, name)
    if not needed(search, less, richer, nothing):
        return less.fit, None
    kept, seen = re_examined(search, nothing, less.fit, richer, progress)
    if kept is less.fit:
        return kept, None
    return kept, seen | {name: less} if kept is richer else seen


def re_examined(
    search: Search, nothing: Fit, poorer: Fit, richer: Fit, progress: Callable[[str], None]
) -> tuple[Fit, dict[str, LeftOut]]:
    """Drop what the others explain as well by now, and swap what another effect explains better.

    Args:
        search: over the fit flights.
        nothing: the declared model.
        poorer: without the newest effect.
        richer: with it.
        progress: told what happens.

    Returns:
        The fit, and what is left of it without each effect looked at since it last changed; ``poorer`` itself if the
        newest effect and an older one explain the same, and the older one predicts better.
    """
    fit = richer
    seen: dict[str, LeftOut] = {}
    for name in fit.hypothesis.present[:-1]:
        progress(f"looking at {name} again")
        less = leave_out(search, fit.hypothesis, name)
        if not needed(search, less, fit, nothing):
            if fit is richer and np.log(poorer.errors / less.fit.errors).sum() < 0:
                return poorer, {}
            fit, seen = less.fit, {}
            continue
        seen[name] = less
        rival, variant = less.ranking[0]
        if variant[0].effect != name and rival.gain > not_none(less.own).gain + search.rules.least_gain:
            other = fitted(search, search.with_candidate(less.fit.hypothesis, variant, rival), whole=False)
            if np.log(other.errors / fit.errors).sum() < 0:
                fit, seen = other, {}
    return fit, seen


def simplified(
    search: Search, nothing: Fit, fit: Fit, ranking: list[dict], progress: Callable[[str], None]
) -> Fit | None:
    """One effect in place of several, where it does as well: the first steps of a search may have split it up.

    Args:
        search: over the fit flights.
        nothing: the declared model.
        fit: what the search came to.
        ranking: of the first round.
        progress: told what happens.
    """
    candidates = search.probes(nothing.hypothesis, not_none(nothing.linear))
    rivals = [item["name"] for item in ranking if item["name"] not in fit.hypothesis.present][: search.rules.rivals]
    for name in rivals:
        if name not in KNOWN or name not in candidates:
            continue
        progress(f"trying {name} in place of {', '.join(fit.hypothesis.present)}")
        found, variant = candidates[name]
        single = fitted(search, search.with_candidate(nothing.hypothesis, variant, found), whole=False)
        if np.isfinite(single.errors).all() and np.max(single.errors / fit.errors - 1) < search.rules.as_good:
            return single
    return None


def deviations(search: Search, hypothesis: Hypothesis, linear: Linear) -> dict[Column, float]:
    """Standard deviation of every number of the effects that are there, fitted together with the lead."""
    columns, spread = spread_of(search, hypothesis, linear)
    return dict(zip(columns, np.sqrt(np.diag(spread)).tolist(), strict=True))


def spread_of(search: Search, hypothesis: Hypothesis, linear: Linear) -> tuple[list[Column], np.ndarray]:
    """The numbers of the effects that are there and their covariance (n, n), fitted together with the lead."""
    columns = search.own_columns(hypothesis)
    index = [1, *linear.index(columns)]
    values = solve(linear.blocks.sum(0), index, linear.scale)
    prior = Prior.weak(len(index)).pulled(0, 0.0, (linear.scale[1] / LEAD_SPREAD) ** 2)
    spread = covariance(linear.blocks, index, linear.scale, values, prior)
    scale = linear.scale[index][1:]
    return columns, spread[1:, 1:] * np.outer(scale, scale)


def numbers_of(hypothesis: Hypothesis, stds: Mapping[Column, float], name: str) -> tuple[dict, dict]:
    """Values and standard deviations of one effect, by field; ``stds`` are of all numbers (`deviations`)."""
    parameters: dict[str, float | list[float]] = {}
    uncertainty: dict[str, float | list[float]] = {}
    several: dict[str, list[float]] = {}
    for column, std in stds.items():
        if column.effect != name:
            continue
        value = np.asarray(hypothesis.shift if name == SHIFT else getattr(hypothesis.effect(name), column.field))
        if column.index is None:
            parameters[column.field], uncertainty[column.field] = float(value), std
        else:
            parameters[column.field] = value.tolist()
            uncertainty[column.field] = several.setdefault(column.field, [])
            several[column.field].append(std)
    return parameters, uncertainty


def summary(search: Search, fit: Fit, name: str, less: LeftOut) -> Found:
    """What is reported of an effect, from a fit and what is left of it without the effect."""
    stds = deviations(search, fit.hypothesis, not_none(fit.linear))
    parameters, uncertainty = numbers_of(fit.hypothesis, stds, name)
    gain, p_value = (less.own.gain, less.own.p_value) if less.own else (0.0, 1.0)
    close = 1 - search.rules.close
    rivals = {v[0].effect: e.gain for e, v in less.ranking if v[0].effect != name and e.gain > close * gain}
    if rivals:
        # Slopes at neutral understate an effect whose shape was fitted; what it explains as it is counts.
        explained = max(gain, not_none(confirm(search, less.fit.hypothesis, fit.hypothesis).gain))
        rivals = {rival: its for rival, its in rivals.items() if its > close * explained}
    buys = float(np.max(1 - fit.errors / less.fit.errors))
    lowers = float(np.log(less.fit.errors / fit.errors).sum())
    return Found(name, p_value, gain, buys, parameters, uncertainty, list(rivals), less.fit.hypothesis, lowers)


def line_of(variant: list[Column], found: Evidence) -> dict:
    """A candidate as reports list it."""
    return {"name": variant[0].effect, "gain": found.gain, "t": found.t, "p_value": found.p_value}


def contenders(
    search: Search, fit: Fit, ranking: list[tuple[Evidence, list[Column]]], progress: Callable[[str], None]
) -> tuple[list[tuple[str, Fit]], set[str]]:
    """The candidates that explain the flights best, fitted beside what is there.

    The ranking rests on slopes at neutral, which say little of effects whose shape is still to be fitted: those that
    come near the best there are fitted too. Of those that gain nearly the same, the ones that predict best come first,
    and of those the one with the fewest numbers.

    Returns:
        Their names and the fits with them, in the order to try them, and the names of those that would have to be
        implausibly strong.
    """
    fits, rules = {}, search.rules
    for found, variant in ranking[: rules.contenders]:
        if found.gain < rules.contender * ranking[0][0].gain:
            break
        name = variant[0].effect
        progress(f"trying {name} beside {', '.join(fit.hypothesis.present) or 'nothing'}")
        fits[name] = fitted(search, search.with_candidate(fit.hypothesis, variant, found), whole=False)
    plausible = [name for name, richer in fits.items() if not rules.stretched(richer.hypothesis, name)]
    gains: dict[str, float] = {}
    if len(plausible) > 1:
        verdicts = {name: confirm(search, fit.hypothesis, fits[name].hypothesis) for name in plausible}
        gains = {name: not_none(verdict.gain) for name, verdict in verdicts.items()}
        plausible = [name for name in plausible if np.isfinite(gains[name])]
    stretched = set(fits) - set(plausible)
    if len(plausible) < 2:
        name = (plausible or list(fits))[-1]
        return [(name, fits[name])], stretched
    numbers = {variant[0].effect: len(variant) for _, variant in ranking}
    most = max(gains[name] for name in plausible)
    rivals = [name for name in plausible if _near(gains[name], most, rules.close)]
    if len(rivals) > 1:
        # Innovations hardly tell a lag from a delay beside the unknown age of commands; half a second of flight does.
        errors = {name: _without_lead(search, fits[name].hypothesis) for name in rivals}
        rivals = [name for name in rivals if errors[name] <= min(errors.values()) + rules.same_errors]
    most = max(gains[name] for name in rivals)
    close = [name for name in rivals if _near(gains[name], most, rules.parsimony)]
    first = min(close, key=numbers.__getitem__)
    delayed = "command_delay"
    if first == SHIFT and fits[first].hypothesis.shift < 0 and delayed in plausible:
        # Commands logged early and commands that act late look the same unless rotor speeds were logged: the
        # physical cause comes first, and the report names both.
        first = delayed if gains[delayed] > (1 - rules.close) * gains[first] else first
    order = sorted(plausible, key=lambda name: (name != first, -gains[name]))
    return [(name, fits[name]) for name in order], stretched


def _near(gain: float, most: float, share: float) -> bool:
    """Whether a gain is the largest but for a share; all may be negative, where fits do not converge."""
    return gain >= most - share * abs(most)


def _without_lead(search: Search, hypothesis: Hypothesis) -> float:
    """Mean logarithm of the prediction errors, commands held until the next row in the fit as in predictions.

    A delay is longer by what a lead takes back, and a lag that wants no lead would seem to predict better.
    Infinite where predictions diverge.
    """
    held = search.settled(replace(hypothesis, lead=0.0), lead_free=False)
    found = float(np.log(prediction_errors(search, held)).mean())
    return found if np.isfinite(found) else np.inf


def with_rare(found: Trace, held_out: Search, progress: Callable[[str], None] = lambda _: None) -> Trace:
    """What was found, and rarely excited effects that held-out flights bear out.

    Args:
        found: what the search came to.
        held_out: over flights nothing is fitted to.
        progress: told what happens.
    """
    search, fit, rules = found.search, found.fit, found.search.rules
    before, tried, buys = fit.hypothesis, set(), {}
    while len(fit.hypothesis.present) < rules.largest:
        ranking = [
            (evidence, variant)
            for evidence, variant in rank(search, fit, tried)
            if evidence.gain > rules.rare_gain and evidence.t > rules.rare_t
        ]
        if not ranking or len(tried) == rules.rare_tried:
            break
        evidence, variant = ranking[0]
        name = variant[0].effect
        tried.add(name)
        progress(f"trying {name} on the held-out flights")
        richer = fitted(search, search.with_candidate(fit.hypothesis, variant, evidence), whole=False)
        share = _share(held_out, fit, richer, name)
        if share is not None:
            fit, buys[name] = completed(search, richer), share
    if fit.hypothesis is before:
        return found
    kept = []
    for name in fit.hypothesis.present:
        item = summary(search, fit, name, leave_out(search, fit.hypothesis, name))
        kept.append(replace(item, buys=max(item.buys, buys.get(name, 0.0))))
    kept.sort(key=lambda item: (-item.lowers, -item.buys))
    return replace(found, hypothesis=fit.hypothesis, found=kept, errors=fit.errors, fit=fit)


def _share(held_out: Search, fit: Fit, richer: Fit, name: str) -> float | None:
    """Largest share by which an effect lowers an error of the held-out flights; None where it does not stand there."""
    if not np.isfinite(richer.errors).all() or held_out.rules.stretched(richer.hypothesis, name):
        return None
    if confirm(held_out, fit.hypothesis, richer.hypothesis).t < held_out.rules.rare_sure:
        return None
    pair = fit.hypothesis, richer.hypothesis
    old, new, first = (prediction_errors(held_out, each) for each in (*pair, held_out.nothing()))
    return float(np.max(1 - new / old)) if held_out.rules.lowered(old, new, first) else None
