"""Refine the effects of a model file; the result is again a model file, with a report."""

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
from cfb_mjx.sysid.tracing.hypothesis import bounds
from cfb_mjx.sysid.tracing.named_effects import fit_named_effects


def by_innovations(
    base: ModelFile,
    logs: Sequence[FlightLog],
    names: Sequence[str],
    as_logged: bool = False,
    progress: Callable[[str], None] = lambda _: None,
) -> tuple[ModelFile, dict[str, Any]]:
    """Fit some effects of a model file to one-step innovations.

    Args:
        base: the model to start from.
        logs: flights; run with x64 enabled.
        names: effects to fit.
        as_logged: as for `fit_named_effects`.
        progress: called with a message at each step.

    Returns:
        The fitted model, and a report with value, standard deviation and bound of each parameter under ``numbers``.

    Raises:
        CfbError: as `fit_named_effects`.
    """
    parameters = base.parameters()
    delay = usual_delay(logs, parameters)
    declared = Quadrotor.from_file(base).effects
    found = fit_named_effects(logs, parameters, names, declared, delay, progress, as_logged)
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
    """Fit some effects of a model file to multi-step predictions.

    Args:
        base: the model to start from.
        logs: flights; run with x64 enabled.
        names: effects to fit.
        predictor: use the wider bounds of `free_numbers` and mark the model as a predictor.
        weights: as for `refine`.
        progress: called with a message at each step.

    Returns:
        The fitted model, and a report with the parameters (``numbers``), the mean loss before and after (``loss``) and
        the trim torque of each flight, N m (``trim_torque_nm``).

    Raises:
        CfbError: as `refine`.
    """
    start = Quadrotor.from_file(base)
    numbers = free_numbers(names) if predictor else plausible_numbers(start.parameters, names)
    faults = SensorFaults.from_mappings(base.effects, f"model {base.name}")
    # A predictor is used on new flights, whose trim is unknown.
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


def _description(base: ModelFile, names: Sequence[str]) -> str:
    return f"{base.name} with {', '.join(names)} refined"


def _pairs(name: str, value, std) -> dict[str, tuple[float, float | None]]:
    if not isinstance(value, list):
        return {name: (value, std)}
    stds = std if isinstance(std, list) else [None] * len(value)
    return {f"{name}[{i}]": pair for i, pair in enumerate(zip(value, stds, strict=True))}
