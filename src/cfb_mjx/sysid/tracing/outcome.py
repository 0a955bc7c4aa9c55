"""What closing the loop comes to: effects confirmed on other flights, errors before and after, the new model."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from cfb_mjx.logs import FlightLog
from cfb_mjx.model import Quadrotor
from cfb_mjx.model.effects import SENSOR_FAULTS, effect_to_mapping
from cfb_mjx.parameters import Entry, ModelFile
from cfb_mjx.sysid.evaluation import Evaluation, evaluate
from cfb_mjx.sysid.flight import usual_delay
from cfb_mjx.sysid.refinement.numbers import PLANT
from cfb_mjx.sysid.sensor_faults import HEALTHY, SensorFaults
from cfb_mjx.sysid.tracing.acceptance import FAR_OFF
from cfb_mjx.sysid.tracing.checkpoint import Checkpoint
from cfb_mjx.sysid.tracing.columns import FORMULA
from cfb_mjx.sysid.tracing.confirmation import Verdict, confirm
from cfb_mjx.sysid.tracing.fits import prediction_errors
from cfb_mjx.sysid.tracing.formula import SURE, Proposal, Term, explain, only_there
from cfb_mjx.sysid.tracing.hypothesis import Hypothesis
from cfb_mjx.sysid.tracing.lines import Line, find_lines
from cfb_mjx.sysid.tracing.rare import with_rare
from cfb_mjx.sysid.tracing.residuals import residual_rows
from cfb_mjx.sysid.tracing.search import Search
from cfb_mjx.sysid.tracing.sensors import check_sensors
from cfb_mjx.sysid.tracing.together import RULES, Asked, Part, Together, asked, fit_together, hypothesis_of, paired
from cfb_mjx.sysid.tracing.trace import PATIENCE, Found, Trace, numbers_of, trace

ENOUGH, SAME_LINE = 3, 0.1
"""Held-out flights from which lines are looked for there too, and Hz by which the two may differ."""
DOUBTFUL = 2.3
"""An effect whose statistic on held-out flights is below this is not reported."""


@dataclass
class Reported:
    """One effect or sensor fault as reported."""

    name: str
    p_value: float
    """On held-out flights; for sensor faults, of the comparison of the sensors."""
    parameters: dict
    uncertainty: dict
    found: Found | None = None
    verdict: Verdict | None = None
    at_bound: list[str] = field(default_factory=list)
    """Names of its numbers that stand where they may not go further."""
    asked: list[Asked] = field(default_factory=list)
    """What the innovations make of its numbers, where predictions decided."""

    def to_json(self) -> dict:
        """The layout of ``report.json``."""
        more = {} if self.found is None else {"buys": self.found.buys, "confusable_with": self.found.confusable}
        if self.found is not None:
            more |= {"p_value_cross_validated": self.found.p_value}
            more |= {} if self.found.gain is None else {"gain_nats": self.found.gain}
        if self.verdict is not None:
            more |= {"held_out_t": self.verdict.t}
            more |= {} if self.verdict.gain is None else {"held_out_gain_nats": self.verdict.gain}
        if self.at_bound:
            more |= {"at_bound": self.at_bound}
        if self.asked:
            keys = ("value", "std", "contradicts")
            more |= {"innovations": {each.name: {key: getattr(each, key) for key in keys} for each in self.asked}}
        return {
            "name": self.name,
            "p_value": self.p_value,
            "parameters": self.parameters,
            "uncertainty": self.uncertainty,
        } | more


@dataclass(frozen=True)
class Unexplained:
    """Structure that no effect of the catalogue accounts for."""

    proposal: Proposal | None
    """A formula that describes it, borne out by the held-out flights."""
    lines: list[Line]
    """What swings at its own pace."""
    held_out_only: list[Term] = field(default_factory=list)
    """What only the held-out flights show, fitted to them: no part of the corrected model."""

    @property
    def formulas(self) -> list[str]:
        """One line per term, with units and uncertainty."""
        found = [str(term) for term in self.proposal.terms] if self.proposal else []
        return found + [f"{term} (held-out flights only, not in the model)" for term in self.held_out_only]

    @property
    def where(self) -> str:
        """Axes, signals and frequencies in words."""
        words = _followed(self.proposal.terms if self.proposal else [])
        there = [f"in the held-out flights only, {each}" for each in _followed(self.held_out_only)]
        return "; ".join(words + there + [str(line) for line in self.lines])


def _followed(terms: list[Term]) -> list[str]:
    axes = list(dict.fromkeys(term.axis for term in terms))
    return [f"{a} follows {', '.join(t.signal for t in terms if t.axis == a)}" for a in axes]


@dataclass
class Outcome:
    """Everything a report says."""

    trace: Trace
    base: ModelFile
    reported: list[Reported]
    unconfirmed: list[Reported]
    """Found on the fit flights, not borne out by the held-out ones."""
    hypothesis: Hypothesis
    faults: SensorFaults
    before: Evaluation
    after: Evaluation
    unexplained: Unexplained | None = None
    motors: dict[str, Entry] = field(default_factory=dict)
    """Constants of the motors, fitted anew."""
    together: Together | None = None
    """Where the drone lacks so much that its effects were fitted together and judged by predictions."""

    def to_json(self) -> dict:
        """The part of ``report.json`` that comes from the flights (DESIGN 6)."""
        held_out = {
            "before": self.before.metrics("commands_in"),
            "after": self.after.metrics("commands_in"),
            "hold": self.before.metrics("hold"),
            "before_rotor_speed_in": self.before.metrics("rotor_speed_in"),
            "after_rotor_speed_in": self.after.metrics("rotor_speed_in"),
            "intervals": {"before": self.before.intervals("commands_in"), "after": self.after.intervals("commands_in")},
            "logs": {
                old.log.name: {"before": old_error, "after": new_error}
                for old, old_error, new_error in zip(
                    self.before.logs, _per_log(self.before), _per_log(self.after), strict=True
                )
            },
        }
        return {
            "effects": [item.to_json() for item in self.reported],
            "unexplained": self.unexplained is not None,
            "unexplained_because": self.unexplained and self.unexplained.where,
            "formula": self.unexplained and self.unexplained.formulas,
            "held_out": held_out,
            "unconfirmed": [item.to_json() for item in self.unconfirmed],
            "sensors": {name: {"value": v, "std": s} for name, (v, s) in self.trace.sensors.measured.items()},
            "search": self.trace.tried,
        } | ({"motors": {name: _written(entry) for name, entry in self.motors.items()}} if self.motors else {})

    def model_file(self, name: str, provenance: dict) -> ModelFile:
        """The corrected model."""
        effects = []
        for item in self.reported:
            if item.name in self.hypothesis.present and item.name in {type(e).name for e in self.hypothesis.effects}:
                mapping = effect_to_mapping(self.hypothesis.effect(item.name))
                effects.append(mapping | {"uncertainty": item.uncertainty, "p_value": item.p_value})
        if self.unexplained is not None and self.unexplained.proposal is not None:
            effects.append(effect_to_mapping(self.hypothesis.effect(FORMULA)))
        replaced = {item["name"] for item in effects} | {item.name for item in self.unconfirmed} | set(SENSOR_FAULTS)
        kept = [item for item in self.base.effects if item["name"] not in replaced]
        if self.together is not None:
            kept = [self._moved(item) for item in kept if item["name"] in self.hypothesis.present]
        named = ", ".join(item.name for item in self.reported) or "nothing"
        return replace(
            self.base,
            entries={**self.base.entries, **self.motors},
            name=name,
            description=f"{self.base.name} with what its flights lacked: {named}",
            effects=(*kept, *effects, *self.faults.to_mappings()),
            provenance=provenance,
        )

    def _moved(self, item: Mapping[str, Any]) -> Mapping[str, Any]:
        """A declared effect as the drone has it: where the type's spread let it move, with its own numbers."""
        if item["name"] not in self.together.typical:
            return item
        own = effect_to_mapping(self.hypothesis.effect(item["name"]))
        return {**item, "parameters": own["parameters"], "uncertainty": self.together.fit.uncertainty(item["name"])}


def close_loop(
    fit: list[FlightLog],
    held_out: list[FlightLog],
    base: ModelFile,
    progress: Callable[[str], None] = lambda _: None,
    checkpoint: Checkpoint | None = None,
) -> Outcome:
    """Trace what a model lacks on some flights, and judge it on others.

    Args:
        fit: flights to learn from.
        held_out: flights of the same drone nothing is learned from.
        base: the declared model.
        progress: told what happens.
        checkpoint: where the search is kept while it runs.
    """
    declared = Quadrotor.from_file(base).effects
    parameters = base.parameters()
    delay = usual_delay(fit, parameters)
    speeds = all(log.rotor_speed is not None for log in fit)
    found = trace(fit, parameters, delay, progress, declared, checkpoint, 1 if speeds else PATIENCE)
    if found.fit.beside_hold > FAR_OFF:
        whole = _whole(found, fit, held_out, base, progress)
        if whole is not None:
            return whole
        if found.fit.beside_hold > 1:
            # That may have been cut short.
            found = trace(fit, parameters, delay, progress, declared)
    # Biases of the held-out sensors come from their own kinematics; no model is fitted.
    check = replace(check_sensors(held_out, delay, float(parameters.gyro_delay)), faults=found.sensors.faults)
    judge = found.search.beside(held_out, check)
    found = with_rare(found, judge, progress)
    search, proposal = explain(found, progress, judge)
    progress("judging on held-out flights")
    before = evaluate(found.search.nothing().model(parameters), held_out)
    wide = search.beside(held_out, check)
    if proposal is not None and not _borne_out(wide, proposal):
        proposal, search, wide = None, found.search, judge
    hypothesis, reported, unconfirmed = _judged(search, judge, found, proposal)
    left = proposal.hypothesis if proposal else found.hypothesis
    unexplained = _unexplained(search, wide, proposal, left, judge)
    faults = replace(found.sensors.faults, motor_shift=hypothesis.shift)
    after = evaluate(hypothesis.model(parameters), held_out, faults=faults)
    return Outcome(found, base, reported, unconfirmed, hypothesis, faults, before, after, unexplained)


def _whole(
    found: Trace, fit: list[FlightLog], held_out: list[FlightLog], base: ModelFile, progress: Callable[[str], None]
) -> Outcome | None:
    """All effects at once; None where that predicts the fit flights hardly better than what the search found."""
    check = replace(found.sensors, faults=HEALTHY, findings=[])
    search = Search.start(fit, base.parameters(), found.search.delay, check, found.search.declared, PLANT)
    whole = fit_together(fit, base, search, progress)
    if not whole.beside_hold < (1 - RULES.better) * found.fit.beside_hold:
        return None
    progress("judging on held-out flights")
    model = whole.model
    search = replace(search, parameters=model.parameters, _flights={})
    before, after = evaluate(Quadrotor.from_file(base), held_out), evaluate(model, held_out)
    reported, unconfirmed = [], []
    for part in whole.parts:
        entry = _reported(search, part, after, held_out)
        (reported if _stands(entry, part) else unconfirmed).append(entry)
    if unconfirmed:
        model = whole.without([item.name for item in unconfirmed])
        after = evaluate(model, held_out)
        for item in reported:
            effect = next(e for e in model.effects if type(e).name == item.name)
            item.parameters = {key: np.asarray(getattr(effect, key)).tolist() for key in item.parameters}
    told = {part.name for part in whole.parts if part.told}
    beside_rotors = [item for item in reported if item.name not in told]
    others = asked(search, model, [item.name for item in beside_rotors]) if beside_rotors else {}
    for item in beside_rotors:
        item.asked = others[item.name]
    gone = {item.name for item in unconfirmed}
    hypothesis = search.learned(hypothesis_of(search, model, gone))
    beside = search.beside(held_out, replace(check_sensors(held_out, *search.delays), faults=HEALTHY))
    lines = find_lines(residual_rows(search, hypothesis))
    if len(held_out) >= ENOUGH:
        again = find_lines(residual_rows(beside, hypothesis))
        lines = [a for a in lines if any(_same(a, b) for b in again)]
    left = Unexplained(None, lines) if lines else None
    traced = replace(found, hypothesis=hypothesis, sensors=check, tried=[*found.tried, *whole.tried], search=search)
    return Outcome(traced, base, reported, unconfirmed, hypothesis, HEALTHY, before, after, left, whole.motors, whole)


def _stands(entry: Reported, part: Part) -> bool:
    """Whether held-out flights bear an effect out; one that the rotor speeds tell must only not be refuted by them."""
    return entry.verdict.t >= (-RULES.sure if part.told else RULES.sure)


def _reported(search: Search, part: Part, after: Evaluation, held_out: list[FlightLog]) -> Reported:
    """An effect fitted with others, judged by predictions of held-out flights without it.

    Of one that the rotor speeds tell the p-value is theirs: in predictions other effects may hide what it buys.
    """
    t, p_value = paired(evaluate(part.without, held_out, keep_diverged=True), after)
    without = hypothesis_of(search, part.without, {part.name})
    found = Found(
        part.name,
        part.p_value,
        None,
        part.buys,
        part.parameters,
        part.uncertainty,
        part.confusable,
        without,
    )
    verdict = Verdict(None, t, p_value)
    p_value = part.p_value if part.told else p_value
    return Reported(part.name, p_value, part.parameters, part.uncertainty, found, verdict, part.at_bound)


def _written(entry: Entry) -> dict:
    std = None if entry.std is None else np.asarray(entry.std).tolist()
    return {"value": np.asarray(entry.value).tolist(), "std": std}


def _borne_out(wide: Search, proposal: Proposal) -> bool:
    """Whether held-out flights confirm a formula."""
    verdict = confirm(wide, proposal.without, proposal.hypothesis)
    return verdict.t >= SURE and _change(wide, proposal.without, proposal.hypothesis) <= 0


def _judged(
    search: Search, judge: Search, found: Trace, proposal: Proposal | None
) -> tuple[Hypothesis, list[Reported], list[Reported]]:
    """What held-out flights leave of the hypothesis; what they confirm, sensor faults first; what they do not."""
    hypothesis = proposal.hypothesis if proposal else found.hypothesis
    reported, unconfirmed = [], []
    for fault in found.sensors.findings:
        reported.append(Reported(fault.name, fault.p_value, fault.parameters, fault.uncertainty))
    for item in found.found:
        verdict = confirm(judge, item.without, found.hypothesis)
        entry = Reported(item.name, verdict.p_value, item.parameters, item.uncertainty, item, verdict)
        worse = _change(judge, item.without, found.hypothesis) > 0
        if item.name not in hypothesis.present or verdict.t < DOUBTFUL or worse:
            unconfirmed.append(entry)
            hypothesis = hypothesis.without(item.name)
        else:
            reported.append(entry)
    if unconfirmed and reported:
        # What stays was fitted beside what goes.
        hypothesis, linear = search.refine(hypothesis)
        for entry in reported:
            if entry.found is not None:
                entry.parameters, entry.uncertainty = numbers_of(search, hypothesis, linear, entry.name)
    return hypothesis, reported, unconfirmed


def _unexplained(
    search: Search, wide: Search, proposal: Proposal | None, hypothesis: Hypothesis, judge: Search
) -> Unexplained | None:
    """What is left: a formula, and lines that most flights share, held-out ones too where there are enough of them.

    If neither, what only the held-out flights show.
    """
    lines = find_lines(residual_rows(search, hypothesis))
    if len(wide.logs) >= ENOUGH:
        again = find_lines(residual_rows(wide, hypothesis))
        lines = [a for a in lines if any(_same(a, b) for b in again)]
    there = [] if proposal or lines else only_there(judge, hypothesis)
    return Unexplained(proposal, lines, there) if proposal or lines or there else None


def _same(a: Line, b: Line) -> bool:
    return a.axis == b.axis and abs(a.frequency - b.frequency) < SAME_LINE


def _per_log(evaluation: Evaluation) -> list[dict[str, float] | None]:
    return [one.metrics("commands_in") for one in evaluation.each]


def _change(judge: Search, poorer: Hypothesis, richer: Hypothesis) -> float:
    """Sum of the logarithms by which the richer hypothesis changes the prediction errors."""
    return float(np.log(prediction_errors(judge, richer) / prediction_errors(judge, poorer)).sum())
