"""``cfb fit``."""

from __future__ import annotations

import math
from dataclasses import replace
from datetime import date
from pathlib import Path

from cfb_mjx.cli.fitted_model import provenance, require_model_path
from cfb_mjx.errors import CfbError
from cfb_mjx.files import require_folder, together, write_json
from cfb_mjx.logs import FlightLog, read_log
from cfb_mjx.parameters import load_model_file
from cfb_mjx.runtime import Progress, configure_jax, environment
from cfb_mjx.terminal import print_paths

HELD_OUT_SHARE = 0.25
"""Without --held-out, this last share of every log is kept from the fit and judged on."""


def run_fit(
    paths: list[Path],
    held_out: list[Path],
    output: Path,
    parameters: str | None,
    model: str,
    changes: list[str],
    json: Path | None,
    commands_only: bool,
    compare: bool,
    estimator: str = "auto",
    robust: bool = False,
    figure: Path | None = None,
    devices: int = 1,
    mass_std: float | None = None,
) -> None:
    """Fit, print a table, write the model and what else was asked for.

    Raises:
        CfbError: bad logs, parameters or outputs.
    """
    if mass_std is not None and not 0 <= mass_std < math.inf:
        raise CfbError(f"--mass-std {mass_std:g}: give the standard deviation of the mass in kg, 0 or more.")
    require_folder(output, json, figure)
    require_model_path(output)
    logs = [read_log(path) for path in paths]
    judged = [read_log(path) for path in held_out] or [_last(log) for log in logs]
    fitted = logs if held_out else [_first(log) for log in logs]
    configure_jax(x64=True, devices=devices)
    from cfb_mjx.devices import Devices
    from cfb_mjx.model import Quadrotor
    from cfb_mjx.parameters import save_model_file
    from cfb_mjx.sysid import evaluate
    from cfb_mjx.sysid.identification.fitting import fit

    base, over = load_model_file(model, changes), Devices.take(devices)
    kept = [path.name for path in held_out] or f"last {HELD_OUT_SHARE:.0%} of each log"
    if mass_std is None and base.entries["mass"].std is not None:
        mass_std = float(base.entries["mass"].std)
    bar = Progress("fitting")
    result = fit(fitted, base.parameters(), parameters, not commands_only, robust, estimator, bar, over, mass_std)
    corrected = replace(
        result.model_file(base, f"cfb fit on {len(paths)} log(s), {date.today().isoformat()}"),
        name=output.stem,
        description=f"{base.name} refitted to {', '.join(log.name for log in logs)}",
        provenance=provenance("fit", base.name, "fit_logs_sha256", paths, held_out=kept),
    )
    other = _other(result, fitted, base, not commands_only, robust, over) if compare else None
    before = evaluate(Quadrotor.from_file(base), judged, over=over)
    after = evaluate(Quadrotor.from_file(corrected), judged, over=over)
    with together():
        save_model_file(corrected, output)
        if json is not None:
            write_json(json, _json(result, other, before, after))
        if figure is not None:
            from cfb_mjx.view.fit import fit_figure

            fit_figure(result, other, before, after, figure)
    _print(result, other, before, after)
    print_paths(model=output, results=json, figure=figure)


def _first(log: FlightLog) -> FlightLog:
    return log.slice(log.time[0], log.time[0] + (1 - HELD_OUT_SHARE) * log.duration)


def _last(log: FlightLog) -> FlightLog:
    return log.slice(log.time[0] + (1 - HELD_OUT_SHARE) * log.duration, log.time[-1])


def _other(result, logs, base, use_measured, robust, over):
    """The estimator that was not chosen, for comparison; None where it cannot run."""
    from cfb_mjx.sysid.identification.fitting import fit

    other = "shooting" if result.estimator == "innovation" else "innovation"
    try:
        bar = Progress(f"fitting ({other})")
        return fit(logs, base.parameters(), result.names, use_measured, robust, other, bar, over)
    except CfbError:
        return None


_NAMES = {"innovation": "innovations", "shooting": "multiple shooting"}


def _numbers(estimates) -> dict:
    return {name: {"value": e.value, "std": e.std, "unit": e.unit, "preset": e.preset} for name, e in estimates.items()}


def _json(result, other, before, after) -> dict:
    held_out = {"hold": before.metrics("hold")}
    for stage, evaluation in (("before", before), ("after", after)):
        held_out[stage] = evaluation.metrics("commands_in")
        held_out[f"{stage}_rotor_speed_in"] = evaluation.metrics("rotor_speed_in")
    return {
        "parameters": _numbers(result.estimates),
        "unidentifiable": list(result.unidentifiable),
        "unidentifiable_because": result.unidentifiable,
        "combinations": _numbers(result.combinations),
        "held_fixed_contradicted": list(result.contradicted),
        "command_hold_s": result.hold,
        "correlation": {"names": result.uncertainty.order, "matrix": result.uncertainty.correlation},
        "estimator": result.estimator,
        "other_estimator": None
        if other is None
        else {"estimator": other.estimator, "parameters": _numbers(other.estimates)}
        | {"values": other.values, "unidentifiable": other.unidentifiable},
        "feedback": result.feedback
        and {"correlation": result.feedback.correlation, "p_value": result.feedback.p_value},
        "innovation_lag_one_correlation": result.whiteness,
        "noise": None if result.noise is None else vars(result.noise),
        "rows": result.rows,
        "held_out": held_out,
        "environment": environment(),
    }


def _print(result, other, before, after) -> None:
    print(f"{'parameter':<22}{'value':>12}{'std':>11}  {'unit':<8}{'preset':>11}{'change':>9}", end="")
    print(f"{_NAMES[other.estimator]:>20}" if other else "")
    for name, e in result.estimates.items():
        change = f"{e.value / e.preset - 1:+.1%}" if e.preset else ""
        print(f"{name:<22}{e.value:>12.4g}{e.std:>11.2g}  {e.unit:<8}{e.preset:>11.4g}{change:>9}", end="")
        doubt = "" if other and name in other.estimates else "?"
        print(f"{f'{other.values[name]:.4g}{doubt}':>20}" if other else "")
    for reason in dict.fromkeys(result.unidentifiable.values()):
        print(f"not identifiable: {reason}")
    for name, e in result.combinations.items():
        print(f"known better together: {name} = {e.value:.6g} +- {e.std:.2g}")
    for name in result.contradicted:
        print(f"{name} was to be held, but the flights contradict its value: it was fitted too.")
    feedback = result.feedback or (other and other.feedback)
    if feedback and feedback.present:
        print(f"flown under feedback: the commands answer the gyro (correlation {feedback.correlation:.2f});", end=" ")
        print("multiple shooting is biased on such flights.")
    windows = sum(len(log.windows) for log in before.logs)
    print(f"\nheld-out RMS error, {windows} windows    before       after        hold")
    hold = before.metrics("hold")
    for variant, label in (("commands_in", "commands in"), ("rotor_speed_in", "rotor speed in")):
        old, new = before.metrics(variant), after.metrics(variant)
        if old is None:
            continue
        for key in ("velocity_rmse_mps", "attitude_rmse_deg", "rate_rmse_radps"):
            for horizon in ("0.2", "0.5"):
                name = f"{key}@{horizon}s"
                quantity, _, unit = key.split("_")
                text = f"{label}, {quantity} {unit}, {horizon} s"
                print(f"{text:<40}{old[name]:>10.4g}{new[name]:>12.4g}{hold[name]:>12.4g}")
