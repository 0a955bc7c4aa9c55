"""Tracing: from a campaign of flights to the effects a model lacks, each tested on data it was not fitted on."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from cfb_mjx.logs import FlightLog
from cfb_mjx.model.effects import KNOWN, Effect
from cfb_mjx.parameters import Parameters
from cfb_mjx.sysid.sensor_faults import SensorFaults
from cfb_mjx.sysid.tracing.acceptance import CLEAR, FAR_OFF, LEAST_GAIN, material, significant, worth_it
from cfb_mjx.sysid.tracing.checkpoint import Checkpoint, Progress
from cfb_mjx.sysid.tracing.columns import SHIFT, Column
from cfb_mjx.sysid.tracing.confirmation import confirm
from cfb_mjx.sysid.tracing.contenders import CLOSE, contenders
from cfb_mjx.sysid.tracing.evidence import Evidence, Prior, covariance, solve
from cfb_mjx.sysid.tracing.fits import ERRORS, Fit, as_it_is, completed, fitted
from cfb_mjx.sysid.tracing.hypothesis import LEAD_SPREAD, Hypothesis, Linear
from cfb_mjx.sysid.tracing.jointly import beside_each_other, borne_out, everything, one_by_one
from cfb_mjx.sysid.tracing.search import Search
from cfb_mjx.sysid.tracing.sensors import SensorCheck, check_sensors

RIVALS, AS_GOOD = 3, 0.03
"""So many effects are tried alone in place of several; no error may grow by more than this share."""
LARGEST = 6
"""Effects at most."""
MANY = 3
"""So many that stand clearly beside each other and what was found are taken in together."""
PATIENCE = 3
"""Candidates in a row that stand against chance but lower no error: then the search ends."""


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
    confusable: list[str] = field(default_factory=list)
    without: Hypothesis | None = None
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
    fit: Fit | None = None
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
    patience: int = PATIENCE,
) -> Trace:
    """Search the catalogue for what a model lacks.

    Args:
        logs: flights to fit; run with x64 enabled.
        parameters: the declared drone.
        delay: declared age of pose and velocity in a row, s.
        progress: told what happens.
        declared: effects the declared model has already.
        checkpoint: where the search is kept while it runs, and taken up from.
        patience: so many candidates in a row that lower no error end the search while the model predicts worse than
            `hold` does; it ends after `PATIENCE` in any case. With 1 a drone that lacks much is left to the caller.
    """
    checkpoint = checkpoint or Checkpoint()
    progress("comparing the sensors with each other")
    sensors = check_sensors(logs, delay, float(parameters.gyro_delay))
    search = Search.start(logs, parameters, delay, sensors, declared)
    progress("replaying the declared model")
    nothing = fitted(search, search.learned(search.nothing()))
    saved = checkpoint.restore(nothing.hypothesis)
    fit, refused, tried, vain = nothing, set(), [], 0
    # Without which effects was a model fitted (None: it can be again), and which.
    left_out: dict[str, LeftOut | None] = {}
    judged = nothing.hypothesis
    # Of many taken in together: near to where a fit without one of them ends.
    starts: dict[str, Hypothesis] = {}
    if saved is not None:
        progress(f"going on with {', '.join(saved.hypothesis.present) or 'no effect'} found before the interruption")
        fit, judged = as_it_is(search, saved.hypothesis), saved.judged
        refused, tried, vain, left_out = (
            set(saved.refused),
            list(saved.tried),
            saved.vain,
            dict.fromkeys(saved.left_out),
        )
    while len(fit.hypothesis.present) < LARGEST and vain < (patience if fit.beside_hold > 1 else PATIENCE):
        ranking = rank(search, fit, refused)
        tried.append({"present": list(fit.hypothesis.present), "ranking": [line_of(v, e) for e, v in ranking[:8]]})
        passing = [(e, v) for e, v in ranking if significant(e, len(search.names))]
        if not passing:
            break
        if (fit.hypothesis.present or vain) and patience > 1:
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
            fit, seen = taken_in(search, nothing, fit, name, richer, statistic[name] >= CLEAR, progress)
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
    standing = beside_each_other(search, fit.hypothesis, fit.linear)
    if sum(each.found.t > CLEAR for each in standing) < MANY:
        return None
    whole = everything(search, progress)
    if not (np.log(whole.errors / fit.errors).sum() < 0 and whole.beside_hold < FAR_OFF):
        return None
    return completed(search, borne_out(search, whole, progress))


def rank(search: Search, fit: Fit, refused: set[str]) -> list[tuple[Evidence, list[Column]]]:
    """Every absent effect at its best probe, the largest gain first."""
    best = search.probes(fit.hypothesis, fit.linear)
    return sorted((pair for name, pair in best.items() if name not in refused), key=lambda pair: -pair[0].gain)


def needed(search: Search, less: LeftOut, fit: Fit, nothing: Fit) -> bool:
    """Whether a fit without one of its effects shows that the effect is missed."""
    if less.own is None or not significant(less.own, len(search.names)):
        return False
    return material(less.fit, fit, nothing, less.own.t >= CLEAR)


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
        clear: whether its statistic is above `CLEAR`.
        progress: told what happens.

    Returns:
        The fit, and what is left of it without each effect looked at; None for that where the effect does not stay.
    """
    if not worth_it(name, fit, richer, nothing, clear):
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
        if variant[0].effect != name and rival.gain > less.own.gain + LEAST_GAIN:
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
    candidates = search.probes(nothing.hypothesis, nothing.linear)
    rivals = [item["name"] for item in ranking if item["name"] not in fit.hypothesis.present][:RIVALS]
    for name in rivals:
        if name not in KNOWN or name not in candidates:
            continue
        progress(f"trying {name} in place of {', '.join(fit.hypothesis.present)}")
        found, variant = candidates[name]
        single = fitted(search, search.with_candidate(nothing.hypothesis, variant, found), whole=False)
        if np.isfinite(single.errors).all() and np.max(single.errors / fit.errors - 1) < AS_GOOD:
            return single
    return None


def deviations(search: Search, hypothesis: Hypothesis, linear: Linear) -> dict[Column, float]:
    """Standard deviation of every number of the effects that are there, fitted together with the lead."""
    columns = search.own_columns(hypothesis)
    index = [1, *linear.index(columns)]
    values = solve(linear.blocks.sum(0), index, linear.scale)
    prior = Prior.weak(len(index)).pulled(0, 0.0, (linear.scale[1] / LEAD_SPREAD) ** 2)
    spread = covariance(linear.blocks, index, linear.scale, values, prior)
    deviation = np.sqrt(np.diag(spread)) * linear.scale[index]
    return dict(zip(columns, deviation[1:].tolist(), strict=True))


def numbers_of(search: Search, hypothesis: Hypothesis, linear: Linear, name: str) -> tuple[dict, dict]:
    """Values and standard deviations of one effect, by field."""
    parameters: dict[str, float | list[float]] = {}
    uncertainty: dict[str, float | list[float]] = {}
    for column, std in deviations(search, hypothesis, linear).items():
        if column.effect != name:
            continue
        value = np.asarray(hypothesis.shift if name == SHIFT else getattr(hypothesis.effect(name), column.field))
        if column.index is None:
            parameters[column.field], uncertainty[column.field] = float(value), std
        else:
            parameters[column.field] = value.tolist()
            uncertainty.setdefault(column.field, []).append(std)
    return parameters, uncertainty


def summary(search: Search, fit: Fit, name: str, less: LeftOut) -> Found:
    """What is reported of an effect, from a fit and what is left of it without the effect."""
    parameters, uncertainty = numbers_of(search, fit.hypothesis, fit.linear, name)
    gain, p_value = (less.own.gain, less.own.p_value) if less.own else (0.0, 1.0)
    rivals = {v[0].effect: e.gain for e, v in less.ranking if v[0].effect != name and e.gain > (1 - CLOSE) * gain}
    if rivals:
        # Slopes at neutral understate an effect whose shape was fitted; what it explains as it is counts.
        explained = max(gain, confirm(search, less.fit.hypothesis, fit.hypothesis).gain)
        rivals = {rival: its for rival, its in rivals.items() if its > (1 - CLOSE) * explained}
    buys = float(np.max(1 - fit.errors / less.fit.errors))
    lowers = float(np.log(less.fit.errors / fit.errors).sum())
    return Found(name, p_value, gain, buys, parameters, uncertainty, list(rivals), less.fit.hypothesis, lowers)


def line_of(variant: list[Column], found: Evidence) -> dict:
    """A candidate as reports list it."""
    return {"name": variant[0].effect, "gain": found.gain, "t": found.t, "p_value": found.p_value}
