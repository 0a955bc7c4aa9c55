"""Refining the effects of a model file: what comes out is a model file again, and what to report."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from cfb_mjx.logs import FlightLog
from cfb_mjx.model import Quadrotor
from cfb_mjx.model.effects import SENSOR_FAULTS, Effect, effect_to_mapping
from cfb_mjx.parameters import ModelFile
from cfb_mjx.sysid.evaluation import evaluate
from cfb_mjx.sysid.flight import usual_delay
from cfb_mjx.sysid.refinement.fitting import refine
from cfb_mjx.sysid.refinement.numbers import free_numbers, plausible_numbers
from cfb_mjx.sysid.sensor_faults import SensorFaults
from cfb_mjx.sysid.tracing.given import fit_given
from cfb_mjx.sysid.tracing.hypothesis import bounds


def by_innovations(
    base: ModelFile,
    logs: Sequence[FlightLog],
    names: Sequence[str],
    as_logged: bool = False,
    progress: Callable[[str], None] = lambda _: None,
) -> tuple[ModelFile, dict[str, Any]]:
    """The model with some effects fitted to innovations, and what to report.

    Args:
        base: where to start.
        logs: flights; run with x64 enabled.
        names: of the effects.
        as_logged: as for `fit_given`.
        progress: told what happens.

    Raises:
        CfbError: as `fit_given`.
    """
    parameters = base.parameters()
    delay = usual_delay(logs, parameters)
    declared = Quadrotor.from_file(base).effects
    found = fit_given(logs, parameters, names, declared, delay, progress, as_logged)
    rows, mappings = {}, _mappings(found.effects, _kept(base, names) | found.uncertainty)
    for mapping in mappings:
        std = mapping.get("uncertainty")
        if not std or mapping["name"] not in names:
            continue
        for field, value in mapping["parameters"].items():
            low, high = bounds(mapping["name"], field)
            for name, (v, s) in _pairs(f"{mapping['name']}.{field}", value, std.get(field)).items():
                rows[name] = {"value": v, "std": s, "at_bound": not low < v < high}
    effects = (*mappings, *found.faults.to_mappings())
    return replace(base, effects=effects, description=_description(base, names)), {"numbers": rows}


def by_predictions(
    base: ModelFile,
    logs: Sequence[FlightLog],
    names: Sequence[str],
    predictor: bool = False,
    weights: Mapping[str, float] | None = None,
    progress: Callable[[str], None] = lambda _: None,
) -> tuple[ModelFile, dict[str, Any]]:
    """The model with some effects fitted to its predictions, and what to report.

    Args:
        base: where to start.
        logs: flights; run with x64 enabled.
        names: of the effects.
        predictor: leave free what a plant may not change; the model is then marked as one.
        weights: as for `refine`.
        progress: told what happens.

    Raises:
        CfbError: as `refine`.
    """
    start = Quadrotor.from_file(base)
    numbers = free_numbers(names) if predictor else plausible_numbers(start.parameters, names)
    faults = SensorFaults.from_mappings(base.effects, f"model {base.name}")
    # What a predictor is for is the next flight, and nobody knows that one's trim.
    found = refine(start, logs, numbers, faults, weights=weights, trimmed=not predictor, progress=progress)
    rows = {}
    for number, value, std in zip(found.numbers, found.values, found.deviations, strict=True):
        known = float(std) if np.isfinite(std) else None
        rows[number.name] = {"value": float(value), "std": known, "at_bound": found.at_bound(number)}
    uncertainty = {number.effect: found.uncertainty(number.effect) for number in numbers}
    kind = "predictor" if predictor else base.kind
    effects = (*_mappings(found.model.effects, _kept(base, names) | uncertainty), *faults.to_mappings())
    report = {
        "numbers": rows,
        "loss": {"before": found.cost[0], "after": found.cost[1]},
        "trim_torque_nm": {name: trim.tolist() for name, trim in found.trims.items()},
    }
    return replace(base, effects=effects, kind=kind, description=_description(base, names)), report


def as_logged(model: ModelFile) -> ModelFile:
    """The model of a recording out of which no sensor fault is taken, see `SensorFaults.as_logged`."""
    known = SensorFaults.from_mappings(model.effects, f"model {model.name}").as_logged.to_mappings()
    physics = (e for e in model.effects if e["name"] not in SENSOR_FAULTS)
    return replace(model, effects=(*physics, *known))


def judge(model: ModelFile, logs: Sequence[FlightLog]) -> dict[str, Any]:
    """The evaluation of a model file, as in ``cfb evaluate --json``."""
    faults = SensorFaults.from_mappings(model.effects, f"model {model.name}")
    return evaluate(Quadrotor.from_file(model), logs, faults=faults).to_json() | {"model": model.name}


def _mappings(effects: Sequence[Effect], uncertainty: Mapping[str, dict]) -> list[dict]:
    """Effects as a model file lists them, with what is known of their numbers' standard deviations."""
    found = [effect_to_mapping(effect) for effect in effects]
    return [m | ({"uncertainty": uncertainty[m["name"]]} if uncertainty.get(m["name"]) else {}) for m in found]


def _kept(base: ModelFile, names: Sequence[str]) -> dict[str, dict]:
    """What the model says of the uncertainty of effects that are not fitted anew."""
    return {e["name"]: e["uncertainty"] for e in base.effects if "uncertainty" in e and e["name"] not in names}


def _description(base: ModelFile, names: Sequence[str]) -> str:
    return f"{base.name} with {', '.join(names)} refined"


def _pairs(name: str, value, std) -> dict[str, tuple[float, float | None]]:
    if not isinstance(value, list):
        return {name: (value, std)}
    stds = std if isinstance(std, list) else [None] * len(value)
    return {f"{name}[{i}]": pair for i, pair in enumerate(zip(value, stds, strict=True))}
