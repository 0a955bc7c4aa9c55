"""``cfb close-loop``: find the physical effects that a model lacks, and correct the model."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cfb_mjx.commands.command import Command, FlownWith, Model, OtherLogs, OutputFolder, Pairs, Result, command
from cfb_mjx.errors import CfbError
from cfb_mjx.files import VectorFormat, output_folder, require_no_file, together, write_json

if TYPE_CHECKING:
    from cfb_mjx.logs import FlightLog

LEAST_SECONDS = 10.0
"""Shortest total duration of the flights to fit, s: with less, no effect can be distinguished from chance."""


@dataclass(frozen=True)
class Closed(Result):
    """The effects that a model lacks.

    Attributes:
        numbers: the results as in report.json: ``numbers["effects"]`` are the effects found,
            ``numbers["held_out"]["after"]`` the held-out errors of the corrected model.
        report: path of the report, an HTML page.
        model: path of the corrected model.
        to_fly: for each effect that these flights can hardly distinguish from others, the command that finds a flight
            which can.
    """

    numbers: Mapping[str, Any]
    report: Path
    model: Path
    to_fly: Mapping[str, str]

    def __str__(self) -> str:
        numbers, lines = self.numbers, []
        if not numbers["effects"]:
            lack = (
                "no effect of the catalogue passes the test"
                if numbers["unexplained"]
                else "nothing is missing beyond chance"
            )
            lines.append(lack)
        for effect in numbers["effects"]:
            lines.append(f"{effect['name']}: {_values(effect)} (p = {effect['p_value']:.1g})")
            if effect.get("confusable_with"):
                lines.append(f"  these flights can hardly distinguish it from {', '.join(effect['confusable_with'])}")
            if effect["name"] in self.to_fly:
                lines.append(f"  to find a flight that can: {self.to_fly[effect['name']]}")
        if numbers["unexplained"]:
            lines.append(f"unexplained: {numbers['unexplained_because']}")
        held = numbers["held_out"]
        lines.append(f"\n{'held-out RMS error':<28}{'before':>10}{'after':>10}{'hold':>10}")
        for key, before in held["before"].items():
            if "_rmse_" in key and key.endswith(("@0.2s", "@0.5s")):
                lines.append(f"{key:<28}{before:>10.4g}{held['after'][key]:>10.4g}{held['hold'][key]:>10.4g}")
        return "\n".join([*lines, f"report: {self.report}", f"model: {self.model}"])


@command
class CloseLoop(Command):
    """Find the physical effects that a model lacks, correct the model, and report its held-out error before and after.

    First the sensors are compared with each other. Then effects of the catalogue are proposed and fitted together. An
    effect is accepted only if it improves predictions of data it was not fitted to by more than chance.

    Needs flights of one drone: with --fit at least 10 s with different manoeuvres, with --held-out others for the
    evaluation. Writes report.html, report.json, residual.rrd and model.yaml (the corrected model). If the run was
    interrupted, the same command continues it.

    Attributes:
        output: folder to write to.
        fit: flights of one drone to fit, with different manoeuvres; at least 10 s in total. Required.
        held_out: other flights of the same drone, for the evaluation; nothing is fitted to them. Required.
        flown_with: logs of another drone that flew at the same time, one for each log of --fit and then of --held-out,
            in the same order; its wake is then an effect that can be found. Times of one clock, positions of one frame.
        model: preset or model YAML that is compared with the flights and corrected.
        set: changes to the model's parameters, for instance mass=0.045 (kg).
        format: also write the report's figures as vector graphics, pdf or svg, into the folder figures.
            Default: none; the report holds its figures itself.
    """

    output: OutputFolder
    fit: OtherLogs = ()
    held_out: OtherLogs = ()
    flown_with: FlownWith = ()
    model: Model = "cfb-guards"
    set: Pairs = ()
    format: VectorFormat | None = None

    def run(self) -> Closed:
        """Search for effects, evaluate the corrected model, and write it and the report.

        Raises:
            CfbError: bad logs, a log given both to fit and as held-out, an invalid model, or a folder that cannot be
                written.
        """
        logs, judged = self._read()
        require_no_file(self.output)
        from cfb_mjx.runtime import configure_jax, environment, say

        configure_jax(x64=True)
        from cfb_mjx.commands.fitted import provenance
        from cfb_mjx.parameters import load_model_file, save_model_file
        from cfb_mjx.sysid.tracing.checkpoint import Checkpoint
        from cfb_mjx.sysid.tracing.closing import close_loop
        from cfb_mjx.view.closing import separating, verdict, write_report
        from cfb_mjx.view.style import with_vector_copies

        base = load_model_file(self.model, self.set)
        folder = output_folder(self.output)
        checkpoint = Checkpoint.open(folder / "search.json", [*self.fit, *self.flown_with], base, say)
        outcome = close_loop(logs, judged, base, say, checkpoint)
        words, judged_on = ["close-loop", *self.words()], [path.name for path in self.held_out]
        beside = {"flown_with": [path.name for path in self.flown_with]} if self.flown_with else {}
        story = provenance(words, base.name, "fit_logs_sha256", self.fit, held_out=judged_on, **beside)
        corrected = outcome.model_file(f"{base.name}-closed", story)
        facts = environment()
        numbers: dict[str, Any] = {"case": folder.resolve().name, "summary": verdict(outcome)}
        numbers |= outcome.to_json()
        numbers |= {"model": base.name, "environment": facts}
        say("writing the report")
        model = folder / "model.yaml"
        if self.format is not None:
            output_folder(folder / "figures")
        with together(), with_vector_copies(self.format, folder / "figures"):
            save_model_file(corrected, model)
            write_report(outcome, folder, facts, logs, judged)
            write_json(folder / "report.json", numbers)
            checkpoint.discard()
        unsure = {e["name"]: e["confusable_with"] for e in numbers["effects"] if e.get("confusable_with")}
        to_fly = {name: separating([name, *others], str(model)) for name, others in unsure.items()}
        known = {name: line for name, line in to_fly.items() if line is not None}
        return Closed(numbers, folder / "report.html", model, known)

    def _read(self) -> tuple[list[FlightLog], list[FlightLog]]:
        from cfb_mjx.commands.fitted import read_together, require_apart
        from cfb_mjx.logs import require_own_names

        if not self.fit or not self.held_out:
            raise CfbError(
                "close-loop needs flights to fit (--fit LOG...) and other flights to evaluate on (--held-out LOG...)."
            )
        require_apart(self.fit, self.held_out)
        flights = read_together([*self.fit, *self.held_out], self.flown_with)
        logs, judged = flights[: len(self.fit)], flights[len(self.fit) :]
        for group in (logs, judged):
            require_own_names(group)
        if sum(log.duration for log in logs) < LEAST_SECONDS:
            raise CfbError(f"--fit: the logs hold less than {LEAST_SECONDS:g} s of flight; give longer or more logs.")
        return logs, judged


def _values(effect: Mapping[str, Any]) -> str:
    """The parameters of an effect as text, with their standard deviations."""
    values = []
    for key, value in effect["parameters"].items():
        std = effect["uncertainty"].get(key)
        pairs = zip(value, std, strict=True) if isinstance(value, list) else [(value, std)]
        values.append(f"{key} " + ", ".join(_with_error(v, s) for v, s in pairs))
    return "; ".join(values)


def _with_error(value: float, std: float | None) -> str:
    return f"{value:.4g} (at its bound)" if std is None else f"{value:.4g} +- {std:.2g}"
