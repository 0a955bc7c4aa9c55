"""Result of a model correction: confirmed effects, rejected candidates, unexplained structure, the corrected model.

For example:

    diagnosis = close_loop(fit, held_out, load_model_file("cfb"))
    for effect in diagnosis.reported:
        print(effect.name, effect.parameters)
    before, after = diagnosis.held_out.rows  # residuals of every held-out flight
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import jax.numpy as jnp
import numpy as np

from cfb_mjx.logs import FlightLog
from cfb_mjx.model import Quadrotor
from cfb_mjx.model.effects import SENSOR_FAULTS, effect_to_mapping
from cfb_mjx.optional import not_none
from cfb_mjx.parameters import Entry, ModelFile
from cfb_mjx.sysid.evaluation import Evaluation, before_and_after
from cfb_mjx.sysid.sensor_faults import HEALTHY, SensorFaults
from cfb_mjx.sysid.tracing.formula import Proposal, Term
from cfb_mjx.sysid.tracing.hypothesis import FORMULA, Hypothesis
from cfb_mjx.sysid.tracing.innovations import FIRST, levels_from
from cfb_mjx.sysid.tracing.jointly import Verdict
from cfb_mjx.sysid.tracing.residuals import Residuals, SpectralLine, aligned, residual_rows
from cfb_mjx.sysid.tracing.rules import Rules
from cfb_mjx.sysid.tracing.search import Search
from cfb_mjx.sysid.tracing.sensors import check_sensors
from cfb_mjx.sysid.tracing.structure import (
    PREDICTION_BINS,
    Pooled,
    Structure,
    noise_floor,
    pool,
    pool_predictions,
    structure,
)
from cfb_mjx.sysid.tracing.together import Asked, Together
from cfb_mjx.sysid.tracing.trace import Found, Trace


@dataclass
class Reported:
    """One reported effect or sensor fault.

    Attributes:
        name: of the effect or fault.
        p_value: on the held-out flights; for a sensor fault, from the comparison of the sensors.
        parameters: values by field.
        uncertainty: standard deviations by field.
        found: result on the fit flights; None for a sensor fault.
        verdict: result on the held-out flights; None for a sensor fault.
        at_bound: names of its parameters that are at a bound.
        asked: values of its parameters according to the innovations, if it was fitted to predictions.
    """

    name: str
    p_value: float
    parameters: dict
    uncertainty: dict
    found: Found | None = None
    verdict: Verdict | None = None
    at_bound: list[str] = field(default_factory=list)
    asked: list[Asked] = field(default_factory=list)

    def to_json(self) -> dict:
        """The entry of an effect in ``report.json``."""
        more = {} if self.found is None else {"buys": self.found.buys, "confusable_with": self.found.confusable}
        if self.found is not None:
            more |= {"p_value_cross_validated": self.found.p_value}
            more |= {} if self.found.gain is None else {"gain_nats": self.found.gain}
        if self.verdict is not None:
            more |= {"held_out_t": self.verdict.t}
            more |= {} if self.verdict.gain is None else {"held_out_gain_nats": self.verdict.gain}
            more |= {} if self.verdict.domains is None else {"held_out_gain_nats_by_domain": self.verdict.domains}
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
    """Structure that no effect of the catalogue explains.

    Attributes:
        proposal: a formula that describes it and is confirmed by the held-out flights.
        spectral_lines: spectral lines of the residual.
        held_out_only: terms that only the held-out flights show, fitted to these; not part of the corrected model.
    """

    proposal: Proposal | None
    spectral_lines: list[SpectralLine]
    held_out_only: list[Term] = field(default_factory=list)

    @property
    def formulas(self) -> list[str]:
        """One line of text per term, with unit and uncertainty."""
        found = [str(term) for term in self.proposal.terms] if self.proposal else []
        return found + [f"{term} (held-out flights only, not in the model)" for term in self.held_out_only]

    @property
    def where(self) -> str:
        """Description of the axes, signals and frequencies involved."""
        words = _followed(self.proposal.terms if self.proposal else [])
        there = [f"in the held-out flights only, {each}" for each in _followed(self.held_out_only)]
        return "; ".join(words + there + [str(line) for line in self.spectral_lines])


def _followed(terms: list[Term]) -> list[str]:
    axes = list(dict.fromkeys(term.axis for term in terms))
    return [f"{a} follows {', '.join(t.signal for t in terms if t.axis == a)}" for a in axes]


@dataclass(frozen=True)
class Candidate:
    """An effect that was considered but is not reported.

    Attributes:
        name: of the effect.
        gain: in cross-validation, when it was last considered, nats.
        p_value: in cross-validation, when it was last considered.
        why: reason why it is not reported.
    """

    name: str
    gain: float
    p_value: float
    why: str


@dataclass(frozen=True)
class HeldOut:
    """Residuals and prediction errors of the held-out flights; pairs are (before, after) the correction.

    Attributes:
        search: search on these flights, with the faults of the recording removed.
        rows: residuals of each flight.
        pooled: residuals of all flights, concatenated.
        predictions: prediction errors of all flights, concatenated.
        structure: which of these residuals and errors depend on which signal.
        noise_floor: noise floor due to the sensors.
        random: noise floor due to the sensors and to random forces and torques of the size these flights show.
    """

    search: Search
    rows: tuple[list[Residuals], list[Residuals]]
    pooled: tuple[Pooled, Pooled]
    predictions: tuple[Pooled, Pooled]
    structure: tuple[Structure, Structure]
    noise_floor: dict[str, float]
    random: dict[str, float]

    def pair(self, axis: str) -> tuple[Pooled, Pooled]:
        """The pair of `predictions` or of `pooled` that contains this axis."""
        return self.predictions if axis in self.predictions[0].axes else self.pooled


@dataclass
class Diagnosis:
    """Result of `close_loop`: the effects that the declared model lacks, and the evidence for them.

    Attributes:
        trace: outcome of the search on the fit flights.
        base: the declared model.
        reported: sensor faults, then confirmed effects, the most helpful first.
        unconfirmed: effects found on the fit flights that the held-out flights do not confirm.
        hypothesis: the corrected model as a hypothesis of the search.
        faults: of the recording.
        before: predictions of the held-out flights by the declared model.
        after: predictions of the held-out flights by the corrected model.
        unexplained: structure that no effect of the catalogue explains; None if there is none.
        motors: refitted constants of the motors, as entries of a model file.
        together: outcome of the joint fit, if so many effects are missing that they were fitted together and judged by
            predictions; otherwise None.
    """

    trace: Trace
    base: ModelFile
    reported: list[Reported]
    unconfirmed: list[Reported]
    hypothesis: Hypothesis
    faults: SensorFaults
    before: Evaluation
    after: Evaluation
    unexplained: Unexplained | None = None
    motors: dict[str, Entry] = field(default_factory=dict)
    together: Together | None = None

    @property
    def rules(self) -> Rules:
        """Thresholds of the search."""
        return self.trace.search.rules

    @property
    def models(self) -> tuple[Quadrotor, Quadrotor]:
        """The drone before and after the correction."""
        return Quadrotor.from_file(self.base), Quadrotor.from_file(self.model_file(self.base.name, {}))

    @property
    def dropped(self) -> list[str]:
        """Names of effects that the base model declares and the joint fit removed, other than `unconfirmed`."""
        if self.together is None:
            return []
        judged = (item.name for item in (*self.reported, *self.unconfirmed))
        stay = {*self.hypothesis.present, *judged, *SENSOR_FAULTS}
        return [item["name"] for item in self.base.effects if item["name"] not in stay]

    @property
    def candidates(self) -> list[Candidate]:
        """Effects that were considered but are not reported, the largest gain first."""
        reported = {item.name for item in self.reported}
        unconfirmed = {item.name: item for item in self.unconfirmed}
        last: dict[str, dict] = {}
        drops: dict[str, float] = {}
        for entry in self.trace.tried:
            last |= {line["name"]: line for line in entry.get("ranking", [])}
            if "tried" in entry:
                drops[entry["tried"]] = max(entry.get("drop", {"": 0.0}).values())
        tried, rules = len(self.trace.search.names), self.rules

        def why(name: str, line: dict) -> str:
            if name in unconfirmed:
                verdict = unconfirmed[name].verdict
                there = "" if verdict is None else f" (p = {verdict.p_value:.1g} there)"
                return f"found on the fit flights, not confirmed by the held-out ones{there}"
            if name in drops and drops[name] < rules.material:
                most = f"at most {100 * max(0.0, drops[name]):.1f} %"
                return f"lowers no prediction error by {100 * rules.material:.0f} % ({most})"
            if name in drops:
                return "other effects explain the same as well or better"
            if line["p_value"] * tried >= rules.alpha or line["gain"] <= rules.least_gain:
                return "not significant"
            return "explains less than another effect"

        rows = [Candidate(name, line["gain"], line["p_value"], why(name, line)) for name, line in last.items()]
        return sorted((row for row in rows if row.name not in reported), key=lambda row: -row.gain)

    @cached_property
    def held_out(self) -> HeldOut:
        """Residuals and prediction errors of the held-out flights, before and after the correction."""
        logs = [one.log for one in self.before.logs]
        judge = self._beside(logs, self.trace.sensors.faults)
        # The declared model keeps its own motor constants.
        raw = replace(self._beside(logs, HEALTHY), parameters=self.base.parameters())
        # Commands missing between rows are no effect, so both models use the same command lead.
        declared = replace(judge.nothing(), lead=self.hypothesis.lead)
        rows = aligned(residual_rows(raw, declared), residual_rows(judge, self.hypothesis))
        pooled = pool(rows[0]), pool(rows[1])
        predictions = pool_predictions(self.before, rows[0]), pool_predictions(self.after, rows[1])
        found = [structure(p) + structure(q, PREDICTION_BINS) for p, q in zip(pooled, predictions, strict=True)]
        # The predictions use commands, so estimate the noise without measured rotor speeds, which add their own.
        blind = replace(judge, logs=[log.replace(rotor_speed=None) for log in judge.logs], _flights={})
        levels = blind.learned(replace(self.hypothesis, levels=FIRST)).levels
        random = noise_floor(self.after, levels_from(jnp.asarray(levels), blind.noise))
        return HeldOut(judge, rows, pooled, predictions, (found[0], found[1]), noise_floor(self.after), random)

    def without(self, item: Reported) -> Hypothesis | None:
        """The best model without a reported effect; None for a fault of pose, velocity or gyro."""
        if item.found is None:
            return None
        if self.unexplained is not None and self.unexplained.proposal is not None:
            # `found.without` was fitted before the formula; here only this effect is removed.
            return self.hypothesis.without(item.name)
        return item.found.without

    def residuals(self, poorer: Hypothesis) -> tuple[Pooled, Pooled]:
        """Residuals of another hypothesis and of the corrected model, over the fit and the held-out flights."""
        searches = self.trace.search, self.held_out.search
        both = ([row for s in searches for row in residual_rows(s, each)] for each in (poorer, self.hypothesis))
        less, more = aligned(*both)
        return pool(less), pool(more)

    def _beside(self, logs: list[FlightLog], faults: SensorFaults) -> Search:
        """The search on other flights, with the given faults of the recording removed."""
        search = self.trace.search
        return search.beside(logs, replace(check_sensors(logs, *search.delays), faults=faults))

    def to_json(self) -> dict:
        """The part of ``report.json`` that comes from the flights."""
        held_out = before_and_after(self.before, self.after) | {
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
            **({"motors": {name: _written(entry) for name, entry in self.motors.items()}} if self.motors else {}),
            **({"dropped": self.dropped} if self.dropped else {}),
        }

    def model_file(self, name: str, provenance: dict) -> ModelFile:
        """The corrected model as a model file.

        Args:
            name: of the new model.
            provenance: origin of the model, for the file.
        """
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
        """A declared effect with its values for this drone, if the joint fit moved it within the type's spread."""
        together = not_none(self.together)
        if item["name"] not in together.typical:
            return item
        own = effect_to_mapping(self.hypothesis.effect(item["name"]))
        return {**item, "parameters": own["parameters"], "uncertainty": together.fit.uncertainty(item["name"])}


def _per_log(evaluation: Evaluation) -> list[dict[str, float] | None]:
    return [one.metrics("commands_in") for one in evaluation.each]


def _written(entry: Entry) -> dict:
    std = None if entry.std is None else np.asarray(entry.std).tolist()
    return {"value": np.asarray(entry.value).tolist(), "std": std}
