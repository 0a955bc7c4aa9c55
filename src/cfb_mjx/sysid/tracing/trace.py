"""Tracing: search the flights of a campaign for the effects that a model lacks.

Effects are added one after another (or several at once if many are missing). Each must be significant in blocked
cross-validation and must lower a prediction error. After each addition the earlier effects are tested again.
"""

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
from cfb_mjx.sysid.tracing.hypothesis import LEAD_SPREAD, SHIFT, Column, Fit, Hypothesis, Linear
from cfb_mjx.sysid.tracing.jointly import (
    ERRORS,
    as_it_is,
    beside_each_other,
    borne_out,
    completed,
    confirm,
    everything,
    fitted,
    one_by_one,
    prediction_errors,
    told_apart,
)
from cfb_mjx.sysid.tracing.rules import RULES, Rules
from cfb_mjx.sysid.tracing.search import Search
from cfb_mjx.sysid.tracing.sensors import SensorCheck, check_sensors


@dataclass
class Found:
    """One effect that the search found.

    Attributes:
        name: of the effect.
        p_value: from cross-validation on the fit flights.
        gain: nats in cross-validation; None if predictions were compared instead.
        buys: largest relative decrease that the effect brings to a prediction error of the fit flights.
        parameters: values by field.
        uncertainty: standard deviations by field.
        confusable: names of effects that explain the flights nearly as well.
        without: best model without this effect, for testing it on other flights.
        lowers: sum over the prediction errors of the fit flights of the decrease in their logarithm. Effects are
            sorted by it, because ``buys`` reflects a single error.
    """

    name: str
    p_value: float
    gain: float | None
    buys: float
    parameters: dict[str, float | list[float]]
    uncertainty: dict[str, float | list[float]]
    confusable: list[str]
    without: Hypothesis
    lowers: float = 0.0


@dataclass
class Trace:
    """Outcome of a search.

    Attributes:
        hypothesis: the corrected model.
        sensors: result of the comparison of the sensors.
        found: effects, the most helpful first.
        tried: candidates of every round, for the report.
        search: the search on the fit flights.
        declared_errors: (8,) `prediction_errors` of the declared model.
        errors: (8,) `prediction_errors` of the hypothesis.
        fit: fit of the hypothesis, with its linearisation by the whole catalogue.
    """

    hypothesis: Hypothesis
    sensors: SensorCheck
    found: list[Found]
    tried: list[dict]
    search: Search
    declared_errors: np.ndarray
    errors: np.ndarray
    fit: Fit

    @property
    def faults(self) -> SensorFaults:
        """All faults of the recording, the time shift of the motor columns included."""
        return replace(self.sensors.faults, motor_shift=self.hypothesis.shift)


@dataclass(frozen=True)
class LeftOut:
    """A hypothesis refitted without one of its effects.

    Attributes:
        fit: the refitted hypothesis.
        ranking: evidence for every absent effect, the one left out included.
        own: evidence for the effect left out; None if its fitted sign is meaningless.
    """

    fit: Fit
    ranking: list[tuple[Evidence, list[Column]]]
    own: Evidence | None


def leave_out(search: Search, hypothesis: Hypothesis, name: str, start: Hypothesis | None = None) -> LeftOut:
    """Refit without an effect and rank all absent effects; ``start`` is an initial guess without the effect."""
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
    """Search the catalogue for the effects that a model lacks.

    Args:
        logs: flights to fit; run with x64 enabled.
        parameters: the declared drone.
        delay: declared age of pose and velocity in a row, s.
        progress: called with a message at each step.
        declared: effects that the declared model already has.
        checkpoint: where the state is saved while the search runs, and from which an interrupted search continues.
        brief: leave a drone that lacks many effects to the caller: while the model predicts worse than `hold`, the
            search ends after the first round without an accepted candidate.
        rules: thresholds.
    """
    checkpoint = checkpoint or Checkpoint()
    progress("comparing the sensors with each other")
    sensors = check_sensors(logs, delay, float(parameters.gyro_delay))
    search = Search.start(logs, parameters, delay, sensors, declared, rules=rules)
    progress("replaying the declared model")
    nothing = fitted(search, search.learned(search.nothing()))
    saved = checkpoint.restore(nothing.hypothesis)
    fit, refused, tried, vain = nothing, set(), [], 0
    # Fits without one effect each, of the model `judged`; None after a restart, they are then computed again.
    left_out: Mapping[str, LeftOut | None] = {}
    judged = nothing.hypothesis
    # If many effects were added together: initial guesses for the fits without one of them.
    starts: dict[str, Hypothesis] = {}
    if saved is not None:
        progress(f"continuing the interrupted search with {', '.join(saved.hypothesis.present) or 'no effect'} found")
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
        # Most promising first. It may be immaterial as long as another contender's larger error is not removed.
        for name, richer in options:
            drop = dict(zip(ERRORS, (1 - richer.errors / fit.errors).tolist(), strict=True))
            tried[-1] |= {"tried": name, "drop": drop}
            fit, seen = taken_in(search, nothing, fit, name, richer, statistic[name] >= rules.clear, progress)
            if seen is not None:
                fit, vain = completed(search, fit), 0
                # Effects that were immaterial compared with a larger error may be material now.
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
    """Fit many missing effects together, if many more are clearly significant given those found.

    The fit starts from the declared model again, because the effects added first have absorbed part of what others
    explain. The result is None if few more are significant, or if the joint fit does not predict better.
    """
    standing = beside_each_other(search, fit.hypothesis, not_none(fit.linear))
    if sum(each.found.t > search.rules.clear for each in standing) < search.rules.many:
        return None
    whole = told_apart(search, everything(search, progress), progress)
    if not (np.log(whole.errors / fit.errors).sum() < 0 and whole.beside_hold < search.rules.far_off):
        return None
    return completed(search, borne_out(search, whole, progress))


def rank(search: Search, fit: Fit, refused: set[str]) -> list[tuple[Evidence, list[Column]]]:
    """Evidence for every absent effect that is not ``refused``, at its best probe, the largest gain first."""
    best = search.probes(fit.hypothesis, not_none(fit.linear))
    return sorted((pair for name, pair in best.items() if name not in refused), key=lambda pair: -pair[0].gain)


def needed(search: Search, less: LeftOut, fit: Fit, nothing: Fit) -> bool:
    """Whether an effect is needed: it is significant given the others and lowers an error materially."""
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
    """Add an effect if it passes the rules, and test the earlier effects again.

    Args:
        search: over the fit flights.
        nothing: fit of the declared model.
        fit: fit without the effect.
        name: of the effect.
        richer: fit with the effect.
        clear: whether the effect's t is above `Rules.clear`.
        progress: called with a message at each step.

    Returns:
        The resulting fit, and the refits without one effect each that were made of it by name; None in place of these
        if the effect is not kept.
    """
    if not search.rules.worth_it(name, fit, richer, nothing, clear):
        return fit, None
    # Remove it again and refit: refitting the other effects has improved the fit too, which is not the effect's merit.
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
    """Remove effects that are no longer needed, and replace effects that another effect explains better.

    Args:
        search: over the fit flights.
        nothing: fit of the declared model.
        poorer: fit without the newest effect.
        richer: fit with the newest effect.
        progress: called with a message at each step.

    Returns:
        The resulting fit, and the refits without one effect each since its last change, by name. The fit is ``poorer``
        itself if the newest effect and an older one explain the same and the older one predicts better.
    """
    fit = richer
    seen: dict[str, LeftOut] = {}
    for name in fit.hypothesis.present[:-1]:
        progress(f"testing {name} again")
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
    """Find one effect that replaces all effects found, in case the search has split a single cause into several.

    Args:
        search: over the fit flights.
        nothing: fit of the declared model.
        fit: result of the search.
        ranking: candidates of the first round.
        progress: called with a message at each step.

    Returns:
        Fit of the single effect if no error grows by more than `Rules.as_good`; None if there is no such effect.
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
    """Standard deviation of every parameter of the present effects, which are fitted together with the lead."""
    columns, spread = spread_of(search, hypothesis, linear)
    return dict(zip(columns, np.sqrt(np.diag(spread)).tolist(), strict=True))


def spread_of(search: Search, hypothesis: Hypothesis, linear: Linear) -> tuple[list[Column], np.ndarray]:
    """Columns of the present effects and the covariance (n, n) of their values, fitted together with the lead."""
    columns = search.own_columns(hypothesis)
    index = [1, *linear.index(columns)]
    values = solve(linear.blocks.sum(0), index, linear.scale)
    prior = Prior.weak(len(index)).pulled(0, 0.0, (linear.scale[1] / LEAD_SPREAD) ** 2)
    spread = covariance(linear.blocks, index, linear.scale, values, prior)
    scale = linear.scale[index][1:]
    return columns, spread[1:, 1:] * np.outer(scale, scale)


def numbers_of(hypothesis: Hypothesis, stds: Mapping[Column, float], name: str) -> tuple[dict, dict]:
    """Values and standard deviations of one effect, by field; ``stds`` are those of all parameters (`deviations`)."""
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
    """What is reported of an effect, from a fit and the refit without the effect."""
    stds = deviations(search, fit.hypothesis, not_none(fit.linear))
    parameters, uncertainty = numbers_of(fit.hypothesis, stds, name)
    gain, p_value = (less.own.gain, less.own.p_value) if less.own else (0.0, 1.0)
    close = 1 - search.rules.close
    rivals = {v[0].effect: e.gain for e, v in less.ranking if v[0].effect != name and e.gain > close * gain}
    if rivals:
        # The linearisation at neutral understates an effect whose shape was fitted, so use the gain of the fit itself.
        explained = max(gain, not_none(confirm(search, less.fit.hypothesis, fit.hypothesis).gain))
        rivals = {rival: its for rival, its in rivals.items() if its > close * explained}
    buys = float(np.max(1 - fit.errors / less.fit.errors))
    lowers = float(np.log(less.fit.errors / fit.errors).sum())
    return Found(name, p_value, gain, buys, parameters, uncertainty, list(rivals), less.fit.hypothesis, lowers)


def line_of(variant: list[Column], found: Evidence) -> dict:
    """A candidate as listed in reports."""
    return {"name": variant[0].effect, "gain": found.gain, "t": found.t, "p_value": found.p_value}


def contenders(
    search: Search, fit: Fit, ranking: list[tuple[Evidence, list[Column]]], progress: Callable[[str], None]
) -> tuple[list[tuple[str, Fit]], set[str]]:
    """Fit the best candidates alongside the present effects, and order them.

    The ranking uses linearisations at neutral values, which say little about effects whose shape is still to be
    fitted. Therefore several of the best candidates are fitted. Among those with nearly the same gain, the ones that
    predict best come first, and among these the one with the fewest parameters.

    Returns:
        Names and fits of the plausible candidates in the order to try them, and the names of the implausible ones.
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
        # With the age of commands unknown, innovations hardly separate a lag from a delay; half-second predictions do.
        errors = {name: _without_lead(search, fits[name].hypothesis) for name in rivals}
        rivals = [name for name in rivals if errors[name] <= min(errors.values()) + rules.same_errors]
    most = max(gains[name] for name in rivals)
    close = [name for name in rivals if _near(gains[name], most, rules.parsimony)]
    first = min(close, key=numbers.__getitem__)
    delayed = "command_delay"
    if first == SHIFT and fits[first].hypothesis.shift < 0 and delayed in plausible:
        # Without logged rotor speeds, commands logged early and commands that act late are indistinguishable. Try the
        # physical cause first; the report names both.
        first = delayed if gains[delayed] > (1 - rules.close) * gains[first] else first
    order = sorted(plausible, key=lambda name: (name != first, -gains[name]))
    return [(name, fits[name]) for name in order], stretched


def _near(gain: float, most: float, share: float) -> bool:
    """Whether a gain falls short of the largest by at most a share; gains may be negative if fits do not converge."""
    return gain >= most - share * abs(most)


def _without_lead(search: Search, hypothesis: Hypothesis) -> float:
    """Mean logarithm of the prediction errors after a refit without a command lead; infinite if predictions diverge.

    Predictions hold a command until the next row. A delay fitted with a lead is longer by that lead, so a lag, which
    needs none, would seem to predict better.
    """
    held = search.settled(replace(hypothesis, lead=0.0), lead_free=False)
    found = float(np.log(prediction_errors(search, held)).mean())
    return found if np.isfinite(found) else np.inf


def with_weakly_excited(found: Trace, held_out: Search, progress: Callable[[str], None] = lambda _: None) -> Trace:
    """Add rarely excited effects that the held-out flights confirm.

    Args:
        found: result of the search.
        held_out: search over the held-out flights; nothing is fitted to them.
        progress: called with a message at each step.
    """
    search, fit, rules = found.search, found.fit, found.search.rules
    before, tried, buys = fit.hypothesis, set(), {}
    while len(fit.hypothesis.present) < rules.largest:
        ranking = [
            (evidence, variant)
            for evidence, variant in rank(search, fit, tried)
            if evidence.gain > rules.weakly_excited_gain and evidence.t > rules.weakly_excited_t
        ]
        if not ranking or len(tried) == rules.weakly_excited_tried:
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
    """Largest relative decrease of a held-out error by an effect; None if the held-out flights do not confirm it."""
    if not np.isfinite(richer.errors).all() or held_out.rules.stretched(richer.hypothesis, name):
        return None
    if confirm(held_out, fit.hypothesis, richer.hypothesis).t < held_out.rules.weakly_excited_sure:
        return None
    pair = fit.hypothesis, richer.hypothesis
    old, new, first = (prediction_errors(held_out, each) for each in (*pair, held_out.nothing()))
    return float(np.max(1 - new / old)) if held_out.rules.lowered(old, new, first) else None
