"""``cfb evaluate``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from cfb_mjx.cli.importing import describe_alignment
from cfb_mjx.errors import CfbError
from cfb_mjx.files import require_folder, write_json
from cfb_mjx.logs import FlightLog, estimate_command_shift, read_log
from cfb_mjx.runtime import Progress, configure_jax, environment

if TYPE_CHECKING:
    from cfb_mjx.parameters import ModelFile

_LABELS = {
    "commands_in": "commands in",
    "commands_in_observer": "  with observer",
    "rotor_speed_in": "rotor speed in",
    "rotor_speed_in_observer": "  with observer",
    "hold": "hold",
}
_ROWS = (("position", "m"), ("velocity", "mps"), ("attitude", "deg"), ("rate", "radps"))
_UNITS = {"m": "m", "mps": "m/s", "deg": "deg", "radps": "rad/s"}


def run_evaluate(
    paths: list[Path],
    model: str,
    changes: list[str],
    json: Path | None,
    figure: Path | None,
    observer: bool = False,
    devices: int = 1,
) -> None:
    """Evaluate, print a table, write what was asked for.

    Raises:
        CfbError: bad logs, bad model, or outputs that cannot be written.
    """
    require_folder(json, figure)
    logs = [read_log(path) for path in paths]  # before jax loads: a bad log is refused at once
    configure_jax(x64=True, devices=devices)
    described = changed_model(model, changes)
    from cfb_mjx.devices import Devices
    from cfb_mjx.model import Quadrotor
    from cfb_mjx.sysid import evaluate
    from cfb_mjx.sysid.observer import usual_observer
    from cfb_mjx.sysid.sensor_faults import SensorFaults

    settings = usual_observer(described.kind) if observer else None
    faults = SensorFaults.from_mappings(described.effects, model)
    evaluation = evaluate(
        Quadrotor.from_file(described),
        logs,
        progress=Progress("evaluating"),
        observer=settings,
        faults=faults,
        over=Devices.take(devices),
    )
    alignment = {log.name: _alignment(log) for log in logs}
    result = evaluation.to_json()
    result |= {"model": described.name, "changes": changes, "alignment": alignment, "environment": environment()}
    if settings is not None:
        result["observer"] = vars(settings)
    for log in evaluation.logs:
        print(f"{log.log.name}: {len(log.windows)} windows; {describe_alignment(alignment[log.log.name])}")
    print_table(result)
    if json is not None:
        write_json(json, result)
        print(f"results: {json}")
    if figure is not None:
        from cfb_mjx.view import prediction_figure

        prediction_figure(evaluation, figure)
        print(f"figure: {figure}")


def changed_model(model: str, changes: list[str]) -> ModelFile:
    """A model with ``NAME=VALUE`` changes; lists are written with commas.

    Raises:
        CfbError: a change that is not NAME=VALUE, an unknown name or an impossible value.
    """
    values = {}
    for change in changes:
        name, _, text = change.partition("=")
        try:
            numbers = [float(part) for part in text.split(",")]
        except ValueError:
            raise CfbError(f"--set {change}: write NAME=VALUE with a number, or numbers separated by commas.") from None
        values[name] = numbers if len(numbers) > 1 else numbers[0]
    from cfb_mjx.parameters import load_model_file

    described = load_model_file(model)
    return described.with_values("command line", **values) if values else described


def _alignment(log: FlightLog) -> dict:
    return log.metadata.get("alignment") or {**estimate_command_shift(log).report(), "applied": False}


def print_table(result: dict) -> None:
    """RMSE of every quantity and variant at every horizon, with 95 % intervals."""
    horizons = [key.partition("@")[2] for key in result["hold"] if key.startswith("position_rmse")]
    print(f"\nRMS error of {result['windows']} open-loop predictions by {result['model']} [95 % interval]")
    print(f"{'':31}" + "".join(f"{float(h[:-1]) * 1e3:.0f} ms".ljust(26) for h in horizons).rstrip())
    for quantity, unit in _ROWS:
        for variant, label in _LABELS.items():
            if result.get(variant) is None:
                continue
            cells = []
            for horizon in horizons:
                key = f"{quantity}_rmse_{unit}@{horizon}"
                low, high = result["intervals"][variant][key]
                cells.append(f"{result[variant][key]:.3g} [{low:.3g}, {high:.3g}]".ljust(26))
            head = f"{quantity}, {_UNITS[unit]}" if variant == "commands_in" else ""
            print(f"{head:<15}{label:<16}" + "".join(cells).rstrip())
    skipped = result["windows"] - result["rotor_speed_in_windows"]
    if result["rotor_speed_in"] is not None and skipped:
        print(f"rotor speed was measured in {result['rotor_speed_in_windows']} of the windows.")
