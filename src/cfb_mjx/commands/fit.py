"""``cfb fit``: fit the parameters of a model to flights."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from datetime import date
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from cfb_mjx.commands.command import (
    Command,
    Devices,
    Figure,
    File,
    Logs,
    Model,
    ModelOutput,
    OtherLogs,
    Pairs,
    Result,
    command,
    lines_of,
)
from cfb_mjx.commands.fitted import provenance, require_apart
from cfb_mjx.errors import CfbError
from cfb_mjx.files import require_folder, together, write_json
from cfb_mjx.optional import not_none

if TYPE_CHECKING:
    from cfb_mjx.devices import Devices as Shared
    from cfb_mjx.logs import FlightLog
    from cfb_mjx.parameters import ModelFile
    from cfb_mjx.sysid import Evaluation, identification

FITTED_SHARE = 0.75
"""Without --held-out, this first share of every log is fitted, and the rest is used for the evaluation."""
GROWN = 1.02
"""A held-out error that is larger than before by less than this factor counts as the same."""
_NAMES = {"innovation": "innovations", "shooting": "multiple shooting"}


@dataclass(frozen=True)
class Fitted(Result):
    """A model that was fitted to flights.

    Attributes:
        fit: the estimates, for instance ``fit.estimates["mass"].value`` and ``.std``, and the reasons why other
            parameters have no estimate.
        other: the fit by the other estimator; None if it was not asked for, or cannot run on these flights.
        before: held-out errors of the model that the fit started from.
        after: held-out errors of the fitted model.
        model: the fitted model, as written.
        files: paths of the files written, by kind; None for a file that was not asked for.
    """

    fit: identification.Fit
    other: identification.Fit | None
    before: Evaluation
    after: Evaluation
    model: ModelFile
    files: Mapping[str, Path | None]

    @property
    def numbers(self) -> dict[str, Any]:
        """The results as ``--json`` writes them."""
        from cfb_mjx.runtime import environment
        from cfb_mjx.sysid.evaluation import before_and_after

        numbers = self.fit.to_json() | {"other_estimator": None}
        if self.other is not None:
            theirs = self.other.to_json()
            numbers["other_estimator"] = {
                "estimator": theirs["estimator"],
                "parameters": theirs["parameters"],
                "values": self.other.values,
                "unidentifiable": self.other.unidentifiable,
            }
        return numbers | {"held_out": before_and_after(self.before, self.after), "environment": environment()}

    def __str__(self) -> str:
        return "\n".join([*self._estimates(), *self._remarks(), *self._held_out(), *lines_of(self.files)])

    def _estimates(self) -> Iterator[str]:
        other = self.other
        head = f"{'parameter':<22}{'value':>12}{'std':>11}  {'unit':<8}{'preset':>11}{'change':>9}"
        yield head + (f"{_NAMES[other.estimator]:>20}" if other else "")
        for name, e in self.fit.estimates.items():
            change = f"{e.value / e.preset - 1:+.1%}" if e.preset else ""
            row = f"{name:<22}{e.value:>12.4g}{e.std:>11.2g}  {e.unit:<8}{e.preset:>11.4g}{change:>9}"
            doubt = "" if other and name in other.estimates else "?"
            yield row + (f"{f'{other.values[name]:.4g}{doubt}':>20}" if other else "")

    def _remarks(self) -> Iterator[str]:
        for reason in dict.fromkeys(self.fit.unidentifiable.values()):
            yield f"not identifiable: {reason}"
        for name, e in self.fit.combinations.items():
            yield f"known better in combination: {name} = {e.value:.6g} +- {e.std:.2g}"
        if freed := ", ".join(self.fit.contradicted):
            yield f"fitted too, because the flights contradict what was meant to stay fixed: {freed}"
        if fixed := ", ".join(self.fit.unexplained):
            yield (
                f"fixed, though the flights contradict it, because no possible value fits them: {fixed}. "
                "The model lacks something else; 'cfb close-loop' looks for it."
            )
        feedback = self.fit.feedback or (self.other and self.other.feedback)
        if feedback and feedback.present:
            yield (
                f"flown under feedback: the commands respond to the gyro (correlation {feedback.correlation:.2f}); "
                "multiple shooting is biased on such flights."
            )

    def _held_out(self) -> Iterator[str]:
        windows = sum(len(log.windows) for log in self.before.logs)
        yield f"\nheld-out RMS error, {windows} windows    before       after        hold"
        hold = self.before.metrics("hold")
        grown = []
        for variant, label in (("commands_in", "commands in"), ("rotor_speed_in", "rotor speed in")):
            old, new = self.before.metrics(variant), self.after.metrics(variant)
            if old is None:
                continue
            # Not None: both are evaluated on the same logs.
            new, still = not_none(new), not_none(hold)
            for key in ("velocity_rmse_mps", "attitude_rmse_deg", "rate_rmse_radps"):
                for horizon in ("0.2", "0.5"):
                    name = f"{key}@{horizon}s"
                    quantity, _, unit = key.split("_")
                    text = f"{label}, {quantity} {unit}, {horizon} s"
                    grown.append(new[name] > GROWN * old[name])
                    yield f"{text:<40}{old[name]:>10.4g}{new[name]:>12.4g}{still[name]:>12.4g}"
        if 2 * sum(grown) > len(grown):
            yield (
                f"{sum(grown)} of {len(grown)} held-out errors grew: the fitted model is worse than the one before. It "
                "lacks something that the held-out flights show; 'cfb close-loop' looks for it."
            )


@command
class Fit(Command):
    """Fit the parameters of a model to flights, with uncertainty, and evaluate the result on held-out data.

    The default estimator is not biased by feedback and allows for unmodelled disturbances. A parameter that the flights
    do not identify gets no estimate; it is listed with the reason. Prints the estimates and the held-out errors before
    and after the fit. Writes the fitted model.

    Attributes:
        logs: flight logs to fit (MCAP, parquet, csv).
        output: model YAML to write.
        parameters: names or groups of parameters, with commas between them.
            Groups: inertia (inertia_xx, inertia_yy, inertia_zz), motor (motor_time_constant, motor_gain), cog (x, y).
            Names: rotor_inertia (J_m), motor_speed_offset, thrust_scale, torque_scale, mass, pose_delay.
            Default: inertia, rotor_inertia, motor_time_constant, motor_gain, cog, thrust_scale and torque_scale.
        held_out: logs for the evaluation. Without them, the last quarter of every log is held out from the fit.
        model: preset or model YAML to start from.
        set: changes to the model's parameters before the fit, for instance mass=0.045 (kg).
            Weigh the drone: flights do not identify its mass.
        json: JSON file for the results.
        figure: file for a figure of the estimates and the held-out errors before and after (.png, .svg, .pdf).
        estimator: innovation (not biased by feedback) or shooting (predictions over 200 ms; biased by feedback).
            auto chooses innovation, unless pose_delay is to be fitted.
        robust: let the loss of outliers grow linearly instead of quadratically.
        commands_only: do not use measured rotor speeds as input of the body, even where the logs have them.
        compare: also fit with the other estimator, and print its estimates.
        devices: number of devices of this machine over which the flights are divided.
        mass_std: standard deviation of the mass as weighed, kg, 0 or more.
            It limits the accuracy of inertia, J_m and the scales of thrust and torque.
            Default: the value in the model file, or 5 % of the mass if it has none.
    """

    logs: Logs
    output: ModelOutput
    parameters: str | None = None
    held_out: OtherLogs = ()
    model: Model = "cfb-guards"
    set: Pairs = ()
    json: File = None
    figure: Figure = None
    estimator: Literal["auto", "innovation", "shooting"] = "auto"
    robust: bool = False
    commands_only: bool = False
    compare: bool = False
    devices: Devices = 1
    mass_std: float | None = None

    def run(self) -> Fitted:
        """Fit the model, evaluate it, and write it and the other files that were asked for.

        Raises:
            CfbError: bad logs, invalid parameters, or files that cannot be written.
        """
        from cfb_mjx.runtime import Progress, configure_jax

        fitted, judged = self._flights()
        configure_jax(x64=True, devices=self.devices)
        from cfb_mjx.devices import Devices
        from cfb_mjx.model import Quadrotor
        from cfb_mjx.parameters import load_model_file, save_model_file
        from cfb_mjx.sysid import evaluate
        from cfb_mjx.sysid.identification import fit

        base, over = load_model_file(self.model, self.set), Devices.take(self.devices)
        mass_std = self.mass_std
        if mass_std is None and base.entries["mass"].std is not None:
            mass_std = float(base.entries["mass"].std)
        found = fit(
            fitted,
            base.parameters(),
            self.parameters,
            not self.commands_only,
            self.robust,
            self.estimator,
            Progress("fitting"),
            over,
            mass_std,
        )
        model = self._model(found, base, fitted)
        other = self._other(found, fitted, base, over) if self.compare else None
        before, after = (evaluate(Quadrotor.from_file(one), judged, over=over) for one in (base, model))
        files = {"model": self.output, "results": self.json, "figure": self.figure}
        result = Fitted(found, other, before, after, model, files)
        with together():
            save_model_file(model, self.output)
            if self.json is not None:
                write_json(self.json, result.numbers)
            if self.figure is not None:
                from cfb_mjx.view.fit import fit_figure

                fit_figure(found, other, before, after, self.figure)
        return result

    def _flights(self) -> tuple[list[FlightLog], list[FlightLog]]:
        """Check the arguments, and read the flights to fit and the held-out flights."""
        from cfb_mjx.logs import read_log

        if not self.logs:
            raise CfbError("fit needs at least one log; see 'cfb fit --help'.")
        if self.mass_std is not None and not 0 <= self.mass_std < math.inf:
            raise CfbError(f"--mass-std {self.mass_std:g}: give the standard deviation of the mass in kg, 0 or more.")
        require_apart(self.logs, self.held_out)
        require_folder(self.output, self.json, self.figure)
        logs, judged = ([read_log(path) for path in paths] for paths in (self.logs, self.held_out))
        if judged:
            return logs, judged
        parts = [log.split(FITTED_SHARE) for log in logs]
        return [first for first, _ in parts], [last for _, last in parts]

    def _model(self, found: identification.Fit, base: ModelFile, logs: list[FlightLog]) -> ModelFile:
        kept = [path.name for path in self.held_out] or f"last {1 - FITTED_SHARE:.0%} of each log"
        words = ["fit", *self.words()]
        return replace(
            found.model_file(base, f"cfb fit on {len(logs)} log(s), {date.today().isoformat()}"),
            name=self.output.stem,
            description=f"{base.name} refitted to {', '.join(log.name for log in logs)}",
            provenance=provenance(words, base.name, "fit_logs_sha256", self.logs, held_out=kept),
        )

    def _other(
        self, found: identification.Fit, logs: list[FlightLog], base: ModelFile, over: Shared | None
    ) -> identification.Fit | None:
        """The fit by the other estimator, for comparison; None if it cannot run on these flights."""
        from cfb_mjx.runtime import Progress
        from cfb_mjx.sysid.identification import fit

        other = "shooting" if found.estimator == "innovation" else "innovation"
        bar = Progress(f"fitting ({other})")
        try:
            return fit(logs, base.parameters(), found.names, not self.commands_only, self.robust, other, bar, over)
        except CfbError:
            return None
