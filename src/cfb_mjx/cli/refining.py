"""``cfb refine``."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from cfb_mjx.cli.fitted_model import provenance, require_apart, require_model_path
from cfb_mjx.errors import CfbError
from cfb_mjx.files import require_folder, together, write_json
from cfb_mjx.logs import FlightLog, read_log, require_own_names
from cfb_mjx.parameters import load_model_file
from cfb_mjx.runtime import configure_jax, environment, say
from cfb_mjx.terminal import print_paths

if TYPE_CHECKING:
    from cfb_mjx.model.effects import Effect
    from cfb_mjx.parameters import ModelFile


def run_refine(
    paths: list[Path],
    held_out: list[Path],
    output: Path,
    model: str,
    changes: list[str],
    effects: str | None,
    estimator: str,
    predictor: bool,
    weights: list[str],
    as_logged: bool,
    json: Path | None,
) -> None:
    """Fit, print, write the model.

    Raises:
        CfbError: bad logs, model, effects, weights or outputs.
    """
    require_folder(output, json)
    require_model_path(output)
    require_apart(paths, held_out)
    if estimator == "innovations" and (predictor or weights):
        raise CfbError("--predictor and --weight are for --estimator predictions; leave them out, or the estimator.")
    logs, judged = [read_log(path) for path in paths], [read_log(path) for path in held_out]
    for group in (logs, judged):
        require_own_names(group)
    shares = _weights(weights, logs)
    configure_jax(x64=True)
    from cfb_mjx.model.effects import CATALOGUE, SENSOR_FAULTS
    from cfb_mjx.parameters import save_model_file
    from cfb_mjx.sysid.refinement.numbers import PLANT
    from cfb_mjx.sysid.sensor_faults import SensorFaults

    base = load_model_file(model, changes)
    if as_logged:
        known = SensorFaults.from_mappings(base.effects, f"model {base.name}").as_logged.to_mappings()
        physics = (e for e in base.effects if e["name"] not in SENSOR_FAULTS)
        base = replace(base, effects=(*physics, *known))
    if effects == "plant":
        names = list(PLANT)
    else:
        names = effects.split(",") if effects else [e["name"] for e in base.effects if e["name"] in CATALOGUE]
    if not names:
        raise CfbError(
            f"model {base.name} has no effects; name some to fit, for instance --effects rotor_drag, or all a drone "
            "usually lacks with --effects plant."
        )
    innovations = estimator == "innovations"
    fit = by_innovations if innovations else by_predictions
    extra = {"as_logged": as_logged} if innovations else {"predictor": predictor, "weights": shares}
    refined, report = fit(base, logs, names, progress=say, **extra)
    origin = provenance("refine", base.name, "fit_logs_sha256", paths, held_out=[path.name for path in held_out])
    refined = replace(refined, name=output.stem, provenance=origin)
    if judged:
        report |= {"held_out": {"before": judge(base, judged), "after": judge(refined, judged)}}
    with together():
        save_model_file(refined, output)
        if json is not None:
            write_json(json, report | {"model": refined.name, "estimator": estimator, "environment": environment()})
    _print(report)
    print(f"model: {output}" + (" (a predictor, not a plant)" if predictor else ""))
    for result in report.get("held_out", {}).values():
        print("\n" + errors_table(result))
    print_paths(results=json)


def by_innovations(
    base: ModelFile, logs: list[FlightLog], names: list[str], as_logged: bool = False, progress=lambda _: None
) -> tuple[ModelFile, dict]:
    """The model with some effects fitted to innovations, and what to report."""
    from cfb_mjx.model import Quadrotor
    from cfb_mjx.sysid.flight import usual_delay
    from cfb_mjx.sysid.tracing.given import fit_given
    from cfb_mjx.sysid.tracing.hypothesis import bounds

    parameters = base.parameters()
    delay = usual_delay(logs, parameters)
    declared = Quadrotor.from_file(base).effects
    found = fit_given(logs, parameters, names, declared, delay, progress, as_logged)
    rows, mappings = {}, _mappings(found.effects, _kept(base, names) | found.uncertainty)
    for mapping in mappings:
        std = mapping.get("uncertainty")
        for field, value in mapping["parameters"].items() if std and mapping["name"] in names else ():
            low, high = bounds(mapping["name"], field)
            for name, (v, s) in _pairs(f"{mapping['name']}.{field}", value, std.get(field)).items():
                rows[name] = {"value": v, "std": s, "at_bound": not low < v < high}
    effects = (*mappings, *found.faults.to_mappings())
    return replace(base, effects=effects, description=_description(base, names)), {"numbers": rows}


def by_predictions(
    base: ModelFile,
    logs: list[FlightLog],
    names: list[str],
    predictor: bool = False,
    weights: dict[str, float] | None = None,
    progress=lambda _: None,
) -> tuple[ModelFile, dict]:
    """The model with some effects fitted to its predictions, and what to report."""
    from cfb_mjx.model import Quadrotor
    from cfb_mjx.sysid.refinement import free_numbers, plausible_numbers, refine
    from cfb_mjx.sysid.sensor_faults import SensorFaults

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


def judge(model: ModelFile, logs: list[FlightLog]) -> dict:
    """The evaluation of a model file, as in ``cfb evaluate --json``."""
    from cfb_mjx.model import Quadrotor
    from cfb_mjx.sysid import evaluate
    from cfb_mjx.sysid.sensor_faults import SensorFaults

    faults = SensorFaults.from_mappings(model.effects, f"model {model.name}")
    return evaluate(Quadrotor.from_file(model), logs, faults=faults).to_json() | {"model": model.name}


def _mappings(effects: tuple[Effect, ...], uncertainty: dict[str, dict]) -> list[dict]:
    """Effects as a model file lists them, with what is known of their numbers' standard deviations."""
    from cfb_mjx.model.effects import effect_to_mapping

    found = [effect_to_mapping(effect) for effect in effects]
    return [m | ({"uncertainty": uncertainty[m["name"]]} if uncertainty.get(m["name"]) else {}) for m in found]


def _kept(base: ModelFile, names: list[str]) -> dict[str, dict]:
    """What the model says of the uncertainty of effects that are not fitted anew."""
    return {e["name"]: e["uncertainty"] for e in base.effects if "uncertainty" in e and e["name"] not in names}


def _description(base: ModelFile, names: list[str]) -> str:
    return f"{base.name} with {', '.join(names)} refined"


def _pairs(name: str, value, std) -> dict[str, tuple[float, float | None]]:
    if not isinstance(value, list):
        return {name: (value, std)}
    stds = std if isinstance(std, list) else [None] * len(value)
    return {f"{name}[{i}]": pair for i, pair in enumerate(zip(value, stds, strict=True))}


def _weights(texts: list[str], logs: list[FlightLog]) -> dict[str, float]:
    found = {}
    for text in texts:
        name, _, value = text.partition("=")
        chosen = [log.name for log in logs if log.name.startswith(name)] if name else []
        try:
            number = float(value)
        except ValueError:
            number = float("nan")
        if not number > 0 or not np.isfinite(number):
            raise CfbError(f"--weight {text}: write NAME=VALUE with a positive number.")
        if not chosen:
            raise CfbError(f"--weight {text}: no flight's name begins with '{name}'.")
        found |= dict.fromkeys(chosen, number)
    return found


def _print(report: dict) -> None:
    print(f"{'number':<36}{'value':>12}{'std':>11}")
    for name, row in report["numbers"].items():
        std = "" if row["std"] is None else f"{row['std']:.2g}"
        print(f"{name:<36}{row['value']:>12.4g}{std:>11}" + ("  at its bound" if row["at_bound"] else ""))
    if "loss" in report:
        before, after = report["loss"].values()
        print(f"mean loss {before:.4f} -> {after:.4f}")
