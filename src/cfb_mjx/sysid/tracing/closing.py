"""Model correction: find the effects a model lacks on some flights, and confirm them on others."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from cfb_mjx.logs import FlightLog
from cfb_mjx.model import Quadrotor
from cfb_mjx.optional import not_none
from cfb_mjx.parameters import ModelFile
from cfb_mjx.sysid.evaluation import Evaluation, evaluate
from cfb_mjx.sysid.flight import usual_delay
from cfb_mjx.sysid.refinement.numbers import PLANT
from cfb_mjx.sysid.sensor_faults import HEALTHY
from cfb_mjx.sysid.tracing.checkpoint import Checkpoint
from cfb_mjx.sysid.tracing.diagnosis import Diagnosis, Reported, Unexplained
from cfb_mjx.sysid.tracing.formula import Proposal, explain, only_there
from cfb_mjx.sysid.tracing.hypothesis import Hypothesis
from cfb_mjx.sysid.tracing.jointly import Verdict, confirm, prediction_errors
from cfb_mjx.sysid.tracing.residuals import SpectralLine, find_spectral_lines, residual_rows
from cfb_mjx.sysid.tracing.rules import RULES, Rules
from cfb_mjx.sysid.tracing.search import Search
from cfb_mjx.sysid.tracing.sensors import check_sensors
from cfb_mjx.sysid.tracing.together import Part, asked, fit_together, hypothesis_of, paired
from cfb_mjx.sysid.tracing.trace import Found, Trace, deviations, numbers_of, trace, with_weakly_excited


def close_loop(
    fit: list[FlightLog],
    held_out: list[FlightLog],
    base: ModelFile,
    progress: Callable[[str], None] = lambda _: None,
    checkpoint: Checkpoint | None = None,
    rules: Rules = RULES,
) -> Diagnosis:
    """Find the effects that a model lacks and correct it.

    The search uses the fit flights only. Each effect is then tested on the held-out flights, and the corrected model
    contains the confirmed effects.

    Args:
        fit: flights to fit; run with x64 enabled.
        held_out: other flights of the same drone; no parameter is fitted to them.
        base: the declared model.
        progress: called with a message at each step.
        checkpoint: where the state is saved while the search runs, and from which an interrupted search continues.
        rules: thresholds.
    """
    declared = Quadrotor.from_file(base).effects
    parameters = base.parameters()
    delay = usual_delay(fit, parameters)
    speeds = all(log.rotor_speed is not None for log in fit)
    found = trace(fit, parameters, delay, progress, declared, checkpoint, speeds, rules)
    if found.fit.beside_hold > rules.far_off:
        whole = _whole(found, fit, held_out, base, progress)
        if whole is not None:
            return whole
        if found.fit.beside_hold > 1:
            # The search was `brief` and may have ended early.
            found = trace(fit, parameters, delay, progress, declared, rules=rules)
    # Biases of the held-out sensors come from their own kinematics; no model is fitted.
    check = replace(check_sensors(held_out, delay, float(parameters.gyro_delay)), faults=found.sensors.faults)
    judge = found.search.beside(held_out, check)
    found = with_weakly_excited(found, judge, progress)
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
    return Diagnosis(found, base, reported, unconfirmed, hypothesis, faults, before, after, unexplained)


def _whole(
    found: Trace, fit: list[FlightLog], held_out: list[FlightLog], base: ModelFile, progress: Callable[[str], None]
) -> Diagnosis | None:
    """Fit all effects together; None if that predicts the fit flights hardly better than the search's result."""
    check = replace(found.sensors, faults=HEALTHY, findings=[])
    rules = found.search.rules
    search = Search.start(fit, base.parameters(), found.search.delay, check, found.search.declared, PLANT, rules)
    whole = fit_together(fit, base, search, progress)
    if not whole.beside_hold < (1 - rules.better) * found.fit.beside_hold:
        return None
    progress("judging on held-out flights")
    model = whole.model
    search = replace(search, parameters=model.parameters, _flights={})
    before, after = evaluate(Quadrotor.from_file(base), held_out), evaluate(model, held_out)
    reported, unconfirmed = [], []
    for part in whole.parts:
        entry = _reported(search, part, after, held_out)
        (reported if _stands(entry, part, rules) else unconfirmed).append(entry)
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
    for item in reported:
        poorer = replace(item.found.without, levels=hypothesis.levels)
        item.verdict = replace(item.verdict, domains=confirm(beside, poorer, hypothesis).domains)
    lines = _lines(search, beside, hypothesis)
    left = Unexplained(None, lines) if lines else None
    traced = replace(found, hypothesis=hypothesis, sensors=check, tried=[*found.tried, *whole.tried], search=search)
    return Diagnosis(traced, base, reported, unconfirmed, hypothesis, HEALTHY, before, after, left, whole.motors, whole)


def _stands(entry: Reported, part: Part, rules: Rules = RULES) -> bool:
    """Whether the held-out flights confirm an effect, or, if rotor speeds identified it, do not refute it."""
    return not_none(entry.verdict).t >= (-rules.doubtful if part.told else rules.doubtful)


def _reported(search: Search, part: Part, after: Evaluation, held_out: list[FlightLog]) -> Reported:
    """Report entry of a jointly fitted effect: compare predictions of the held-out flights with and without it.

    The p-value of an effect identified from rotor speeds is the one found there, because in predictions other effects
    may hide its benefit.
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


def _borne_out(wide: Search, proposal: Proposal) -> bool:
    """Whether the held-out flights confirm a formula."""
    verdict = confirm(wide, proposal.without, proposal.hypothesis)
    return verdict.t >= wide.rules.formula_sure and _change(wide, proposal.without, proposal.hypothesis) <= 0


def _judged(
    search: Search, judge: Search, found: Trace, proposal: Proposal | None
) -> tuple[Hypothesis, list[Reported], list[Reported]]:
    """Test every effect found on the held-out flights.

    Returns:
        The hypothesis without unconfirmed effects, the report entries of sensor faults and confirmed effects, and those
        of unconfirmed effects.
    """
    hypothesis = proposal.hypothesis if proposal else found.hypothesis
    reported, unconfirmed = [], []
    for fault in found.sensors.findings:
        reported.append(Reported(fault.name, fault.p_value, fault.parameters, fault.uncertainty))
    for item in found.found:
        verdict = confirm(judge, item.without, found.hypothesis)
        entry = Reported(item.name, verdict.p_value, item.parameters, item.uncertainty, item, verdict)
        worse = _change(judge, item.without, found.hypothesis) > 0
        if item.name not in hypothesis.present or verdict.t < judge.rules.doubtful or worse:
            unconfirmed.append(entry)
            hypothesis = hypothesis.without(item.name)
        else:
            reported.append(entry)
    if unconfirmed and reported:
        # Refit: the confirmed effects were fitted together with the removed ones.
        hypothesis, linear = search.refine(hypothesis)
        stds = deviations(search, hypothesis, linear)
        for entry in reported:
            if entry.found is not None:
                entry.parameters, entry.uncertainty = numbers_of(hypothesis, stds, entry.name)
    return hypothesis, reported, unconfirmed


def _unexplained(
    search: Search, wide: Search, proposal: Proposal | None, hypothesis: Hypothesis, judge: Search
) -> Unexplained | None:
    """Unexplained structure: the formula and spectral lines; without either, terms that only held-out flights show."""
    lines = _lines(search, wide, hypothesis)
    there = [] if proposal or lines else only_there(judge, hypothesis)
    return Unexplained(proposal, lines, there) if proposal or lines or there else None


def _lines(search: Search, judge: Search, hypothesis: Hypothesis) -> list[SpectralLine]:
    """Spectral lines common to most fit flights, and to most held-out flights if there are enough of these."""
    rules = search.rules
    lines = find_spectral_lines(residual_rows(search, hypothesis), rules.line_alpha)
    if len(judge.logs) < rules.line_flights:
        return lines
    again = find_spectral_lines(residual_rows(judge, hypothesis), rules.line_alpha)
    return [
        a for a in lines if any(a.axis == b.axis and abs(a.frequency - b.frequency) < rules.same_line for b in again)
    ]


def _change(judge: Search, poorer: Hypothesis, richer: Hypothesis) -> float:
    """Sum of the changes of the logarithms of the prediction errors from the poorer to the richer hypothesis."""
    return float(np.log(prediction_errors(judge, richer) / prediction_errors(judge, poorer)).sum())
