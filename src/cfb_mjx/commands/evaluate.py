"""``cfb evaluate``: measure how well a model predicts flights."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cfb_mjx.commands.command import (
    Command,
    Devices,
    Figure,
    File,
    FlownWith,
    Logs,
    Model,
    Pairs,
    Result,
    command,
    lines_of,
)
from cfb_mjx.errors import CfbError
from cfb_mjx.files import require_folder, write_json
from cfb_mjx.terminal import aligned

_LABELS = {
    "commands_in": "commands in",
    "commands_in_observer": "  with observer",
    "rotor_speed_in": "rotor speed in",
    "rotor_speed_in_observer": "  with observer",
    "hold": "hold",
}
_ROWS = (("position", "m"), ("velocity", "mps"), ("attitude", "deg"), ("rate", "radps"))
_UNITS = {"m": "m", "mps": "m/s", "deg": "deg", "radps": "rad/s"}


@dataclass(frozen=True)
class Evaluated(Result):
    """Prediction errors of a model.

    Attributes:
        numbers: the results as ``--json`` writes them, for instance
            ``numbers["commands_in"]["position_rmse_m@0.5s"]``.
        files: paths of the files written, by kind; None for a file that was not asked for.
    """

    numbers: Mapping[str, Any]
    files: Mapping[str, Path | None]

    def __str__(self) -> str:
        from cfb_mjx.logs.alignment import describe_alignment

        logs, alignment = self.numbers["logs"], self.numbers["alignment"]
        each = [f"{name}: {logs[name]['windows']} windows; {describe_alignment(alignment[name])}" for name in logs]
        return "\n".join([*each, "", errors_table(self.numbers), *lines_of(self.files)])


@command
class Evaluate(Command):
    """Measure the open-loop prediction error of a model on flights, at 50, 100, 200 and 500 ms.

    Every 0.2 s a prediction starts from the measured state and takes the logged commands as input. Where rotor speeds
    were measured, a second prediction takes those instead. The errors are printed beside those of "hold", which assumes
    constant velocity and constant body rate.

    Attributes:
        logs: flight logs (MCAP, parquet, csv).
        flown_with: logs of another drone that flew at the same time, one for each log, in the same order.
        model: preset (cfb-guards, cfb, cfb-fleet, cfb-idsia, cf21b-500, cf2x) or model YAML.
        set: changes to the model's parameters, for instance mass=0.045 (kg).
        json: JSON file for the results.
        figure: file for a figure of predictions and measurements (.png, .svg, .pdf).
        observer: add predictions with disturbances estimated from the data before each prediction starts.
        devices: number of devices of this machine over which the predictions are divided.
    """

    logs: Logs
    flown_with: FlownWith = ()
    model: Model = "cfb-guards"
    set: Pairs = ()
    json: File = None
    figure: Figure = None
    observer: bool = False
    devices: Devices = 1

    def run(self) -> Evaluated:
        """Evaluate the model, and write the files that were asked for.

        Raises:
            CfbError: bad logs, an invalid model, or files that cannot be written.
        """
        from cfb_mjx.commands.fitted import read_together
        from cfb_mjx.logs import estimate_command_shift
        from cfb_mjx.runtime import Progress, configure_jax, environment

        if not self.logs:
            raise CfbError("evaluate needs at least one log; see 'cfb evaluate --help'.")
        require_folder(self.json, self.figure)
        logs = read_together(self.logs, self.flown_with)  # before jax loads, so that a bad log is refused at once
        configure_jax(x64=True, devices=self.devices)
        from cfb_mjx.devices import Devices
        from cfb_mjx.model import Quadrotor
        from cfb_mjx.parameters import load_model_file
        from cfb_mjx.sysid import evaluate
        from cfb_mjx.sysid.observer import usual_observer
        from cfb_mjx.sysid.sensor_faults import SensorFaults

        described = load_model_file(self.model, self.set)
        settings = usual_observer(described.kind) if self.observer else None
        evaluation = evaluate(
            Quadrotor.from_file(described),
            logs,
            progress=Progress("evaluating"),
            observer=settings,
            faults=SensorFaults.from_mappings(described.effects, self.model),
            over=Devices.take(self.devices),
        )
        alignment = {
            log.name: log.metadata.get("alignment") or {**estimate_command_shift(log).report(), "applied": False}
            for log in logs
        }
        numbers = evaluation.to_json()
        numbers |= {"model": described.name, "changes": list(self.set), "alignment": alignment}
        numbers |= {"environment": environment()}
        if settings is not None:
            numbers["observer"] = vars(settings)
        if self.json is not None:
            write_json(self.json, numbers)
        if self.figure is not None:
            from cfb_mjx.view import prediction_figure

            prediction_figure(evaluation, self.figure)
        return Evaluated(numbers, {"results": self.json, "figure": self.figure})


def errors_table(numbers: Mapping[str, Any]) -> str:
    """A table of the RMS error of every quantity and kind of prediction at every horizon, with 95 % intervals."""
    horizons = [key.partition("@")[2] for key in numbers["hold"] if key.startswith("position_rmse")]
    rows = [["", "", *(f"{float(h[:-1]) * 1e3:.0f} ms" for h in horizons)]]
    for quantity, unit in _ROWS:
        for variant, label in _LABELS.items():
            if numbers.get(variant) is None:
                continue
            cells = []
            for horizon in horizons:
                key = f"{quantity}_rmse_{unit}@{horizon}"
                low, high = numbers["intervals"][variant][key]
                cells.append(f"{numbers[variant][key]:.3g} [{low:.3g}, {high:.3g}]")
            rows.append([f"{quantity}, {_UNITS[unit]}" if variant == "commands_in" else "", label, *cells])
    head = f"RMS error of {numbers['windows']} open-loop predictions by {numbers['model']} [95 % interval]"
    lines = [head, aligned(rows)]
    if numbers["rotor_speed_in"] is not None and numbers["windows"] > numbers["rotor_speed_in_windows"]:
        lines.append(f"rotor speed was measured in {numbers['rotor_speed_in_windows']} of these windows.")
    return "\n".join(lines)
