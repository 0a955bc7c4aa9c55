"""Fit effects of a model file to flights."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from cfb_mjx.logs import FlightLog
from cfb_mjx.model import Quadrotor
from cfb_mjx.model.effects import KNOWN, SENSOR_FAULTS, Effect, effect_to_mapping
from cfb_mjx.parameters import ModelFile
from cfb_mjx.sysid.evaluation import evaluate
from cfb_mjx.sysid.fitted import Estimate
from cfb_mjx.sysid.flight import usual_delay
from cfb_mjx.sysid.refinement.fitting import refine
from cfb_mjx.sysid.refinement.numbers import free_numbers, plausible_numbers
from cfb_mjx.sysid.sensor_faults import SensorFaults
from cfb_mjx.sysid.tracing.hypothesis import bounds
from cfb_mjx.sysid.tracing.named_effects import fit_named_effects


@dataclass(frozen=True)
class EffectFit:
    """Some effects of a model file, fitted to flights.

    Attributes:
        names: effects that were fitted.
        estimates: their parameters, named as ``rotor_drag.coefficient`` or ``inertia.relative[0]``.
        at_bound: names of the estimates at a bound.
        effects: all effects, as a model file lists them.
        kind: ``plant`` or ``predictor``.
        loss: mean loss before and after; None for a fit to innovations.
        trims: trim torque of each flight, N m; None for a fit to innovations.
    """

    names: tuple[str, ...]
    estimates: dict[str, Estimate]
    at_bound: frozenset[str]
    effects: tuple[dict[str, Any], ...]
    kind: str
    loss: tuple[float, float] | None = None
    trims: dict[str, np.ndarray] | None = None

    def model_file(self, base: ModelFile, source: str = "") -> ModelFile:
        """``base`` with these effects; ``source`` becomes the description, by default which effects were refined."""
        described = source or f"{base.name} with {', '.join(self.names)} refined"
        return replace(base, effects=self.effects, kind=self.kind, description=described)

    def to_json(self) -> dict[str, Any]:
        """The parameters under ``numbers``, and for a fit to predictions ``loss`` and ``trim_torque_nm``."""
        rows = {
            name: {
                "value": one.value,
                "std": one.std if math.isfinite(one.std) else None,
                "at_bound": name in self.at_bound,
            }
            for name, one in self.estimates.items()
        }
        found: dict[str, Any] = {"numbers": rows}
        if self.loss is not None:
            found["loss"] = {"before": self.loss[0], "after": self.loss[1]}
        if self.trims is not None:
            found["trim_torque_nm"] = {name: trim.tolist() for name, trim in self.trims.items()}
        return found


def by_innovations(
    base: ModelFile,
    logs: Sequence[FlightLog],
    names: Sequence[str],
    as_logged: bool = False,
    progress: Callable[[str], None] = lambda _: None,
) -> EffectFit:
    """Fit some effects of a model file to one-step innovations.

    Args:
        base: the model to start from.
        logs: flights; run with x64 enabled.
        names: effects to fit.
        as_logged: as for `fit_named_effects`.
        progress: called with a message at each step.

    Raises:
        CfbError: as `fit_named_effects`.
    """
    parameters = base.parameters()
    delay = usual_delay(logs, parameters)
    declared = Quadrotor.from_file(base).effects
    found = fit_named_effects(logs, parameters, names, declared, delay, progress, as_logged)
    estimates, at_bound = {}, set()
    before, mappings = _values(declared), _mappings(found.effects, _kept(base, names) | found.uncertainty)
    for mapping in mappings:
        std = mapping.get("uncertainty")
        if not std or mapping["name"] not in names:
            continue
        for field, value in mapping["parameters"].items():
            low, high = bounds(mapping["name"], field)
            unit = KNOWN[mapping["name"]].units[field]
            for name, (v, s) in _pairs(f"{mapping['name']}.{field}", value, std.get(field)).items():
                estimates[name] = Estimate(v, math.nan if s is None else s, unit, before.get(name, math.nan))
                at_bound |= set() if low < v < high else {name}
    effects = (*mappings, *found.faults.to_mappings())
    return EffectFit(tuple(names), estimates, frozenset(at_bound), effects, base.kind)


def by_predictions(
    base: ModelFile,
    logs: Sequence[FlightLog],
    names: Sequence[str],
    predictor: bool = False,
    weights: Mapping[str, float] | None = None,
    progress: Callable[[str], None] = lambda _: None,
) -> EffectFit:
    """Fit some effects of a model file to multi-step predictions.

    Args:
        base: the model to start from.
        logs: flights; run with x64 enabled.
        names: effects to fit.
        predictor: use the wider bounds of `free_numbers` and mark the model as a predictor.
        weights: as for `refine`.
        progress: called with a message at each step.

    Raises:
        CfbError: as `refine`.
    """
    start = Quadrotor.from_file(base)
    numbers = free_numbers(names) if predictor else plausible_numbers(start.parameters, names)
    faults = SensorFaults.from_mappings(base.effects, f"model {base.name}")
    # A predictor is used on new flights, whose trim is unknown.
    found = refine(start, logs, numbers, faults, weights=weights, trimmed=not predictor, progress=progress)
    estimates, before = {}, _values(start.effects)
    for number, value, std in zip(found.numbers, found.values, found.deviations, strict=True):
        unit = KNOWN[number.effect].units[number.field]
        estimates[number.name] = Estimate(float(value), float(std), unit, before.get(number.name, math.nan))
    uncertainty = {number.effect: found.uncertainty(number.effect) for number in numbers}
    return EffectFit(
        tuple(names),
        estimates,
        frozenset(number.name for number in found.numbers if found.at_bound(number)),
        (*_mappings(found.model.effects, _kept(base, names) | uncertainty), *faults.to_mappings()),
        "predictor" if predictor else base.kind,
        found.cost,
        found.trims,
    )


def as_logged(model: ModelFile) -> ModelFile:
    """The model for flights from which no sensor fault is removed (`SensorFaults.as_logged`)."""
    known = SensorFaults.from_mappings(model.effects, f"model {model.name}").as_logged.to_mappings()
    physics = (e for e in model.effects if e["name"] not in SENSOR_FAULTS)
    return replace(model, effects=(*physics, *known))


def judge(model: ModelFile, logs: Sequence[FlightLog]) -> dict[str, Any]:
    """Evaluate a model file on flights; the result is that of ``cfb evaluate --json``."""
    faults = SensorFaults.from_mappings(model.effects, f"model {model.name}")
    return evaluate(Quadrotor.from_file(model), logs, faults=faults).to_json() | {"model": model.name}


def _mappings(effects: Sequence[Effect], uncertainty: Mapping[str, dict]) -> list[dict]:
    """Effects as listed in a model file, with the standard deviations that are known."""
    found = [effect_to_mapping(effect) for effect in effects]
    return [m | ({"uncertainty": uncertainty[m["name"]]} if uncertainty.get(m["name"]) else {}) for m in found]


def _kept(base: ModelFile, names: Sequence[str]) -> dict[str, dict]:
    """Uncertainties in the model file of the effects that are not refitted."""
    return {e["name"]: e["uncertainty"] for e in base.effects if "uncertainty" in e and e["name"] not in names}


def _values(effects: Sequence[Effect]) -> dict[str, float]:
    """Parameters of effects by the names of estimates."""
    found = {}
    for mapping in map(effect_to_mapping, effects):
        for field, value in mapping["parameters"].items():
            found |= {name: v for name, (v, _) in _pairs(f"{mapping['name']}.{field}", value, None).items()}
    return found


def _pairs(name: str, value, std) -> dict[str, tuple[float, float | None]]:
    if not isinstance(value, list):
        return {name: (value, std)}
    stds = std if isinstance(std, list) else [None] * len(value)
    return {f"{name}[{i}]": pair for i, pair in enumerate(zip(value, stds, strict=True))}
