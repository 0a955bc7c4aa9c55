"""``cfb refine``: fit the parameters of named effects to flights."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from cfb_mjx.commands.command import (
    Command,
    File,
    FlownWith,
    Logs,
    Model,
    ModelOutput,
    OtherLogs,
    Pairs,
    Result,
    command,
    lines_of,
)
from cfb_mjx.commands.evaluate import errors_table
from cfb_mjx.commands.fitted import provenance, require_apart
from cfb_mjx.errors import CfbError
from cfb_mjx.files import require_folder, together, write_json

if TYPE_CHECKING:
    from cfb_mjx.logs import FlightLog
    from cfb_mjx.parameters import ModelFile


@dataclass(frozen=True)
class Refined(Result):
    """A model with effects that were fitted to flights.

    Attributes:
        numbers: the results as ``--json`` writes them, for instance
            ``numbers["numbers"]["rotor_drag.coefficient"]["value"]``.
        model: the model, as written.
        files: paths of the files written, by kind; None for a file that was not asked for.
    """

    numbers: Mapping[str, Any]
    model: ModelFile
    files: Mapping[str, Path | None]

    def __str__(self) -> str:
        lines = [f"{'number':<36}{'value':>12}{'std':>11}"]
        for name, row in self.numbers["numbers"].items():
            std = "" if row["std"] is None else f"{row['std']:.2g}"
            lines.append(f"{name:<36}{row['value']:>12.4g}{std:>11}" + ("  at its bound" if row["at_bound"] else ""))
        if "loss" in self.numbers:
            loss = self.numbers["loss"]
            lines.append(f"mean loss {loss['before']:.4f} -> {loss['after']:.4f}")
        marked = " (a predictor, not a plant)" if self.model.kind == "predictor" else ""
        lines.append(f"model: {self.files['model']}{marked}")
        lines += [f"\n{errors_table(result)}" for result in self.numbers.get("held_out", {}).values()]
        return "\n".join([*lines, *lines_of({"results": self.files["results"]})])


@command
class Refine(Command):
    """Fit the parameters of effects that you name. (`cfb close-loop` searches for the effects itself.)

    The parameters are fitted either to predictions over half a second, which is what a model is used for, or to
    innovations. Feedback biases a fit to predictions, so every parameter is limited to its plausible range, and inertia
    to 25 % of change. Feedback does not bias a fit to innovations.

    Prints the fitted parameters, and the held-out errors before and after if --held-out is given. Writes the model.

    Attributes:
        logs: flight logs to fit (MCAP, parquet, csv).
        output: model YAML to write.
        effects: names of effects (docs/effects.md) with commas between them. Default: the effects of the model.
            plant stands for all effects that an undamaged drone without load usually needs.
        held_out: other flights, for the evaluation; nothing is fitted to them.
        flown_with: logs of another drone that flew at the same time, one for each log and then for each of --held-out,
            in the same order.
        model: preset or model YAML to start from.
        set: changes to the model's parameters before the fit, for instance mass=0.045 (kg).
        estimator: what the parameters are fitted to.
        predictor: let inertia and inflow leave their plausible range (--estimator predictions only).
            The model then predicts better, but is wrong as a plant, and is marked as a predictor.
        weight: weight of the flights whose names begin with NAME, above 0 (--estimator predictions only).
            Other flights have weight 1.
        as_logged: correct no sensor faults, even if sensors disagree or the model lists a fault.
            If the velocity has a wrong scale, the attitude is assumed to share it; only positions are corrected.
        json: JSON file for the results.
    """

    logs: Logs
    output: ModelOutput
    effects: str | None = None
    held_out: OtherLogs = ()
    flown_with: FlownWith = ()
    model: Model = "cfb-guards"
    set: Pairs = ()
    estimator: Literal["predictions", "innovations"] = "predictions"
    predictor: bool = False
    weight: Pairs = ()
    as_logged: bool = False
    json: File = None

    def run(self) -> Refined:
        """Fit the effects, evaluate the model, and write it and the other files that were asked for.

        Raises:
            CfbError: bad logs, an invalid model, effects or weights, or files that cannot be written.
        """
        from cfb_mjx.runtime import configure_jax, environment, say

        logs, judged = self._flights()
        weights = self._weights(logs)
        configure_jax(x64=True)
        from cfb_mjx.parameters import load_model_file, save_model_file
        from cfb_mjx.sysid.refinement import model_files

        base = load_model_file(self.model, self.set)
        if self.as_logged:
            base = model_files.as_logged(base)
        names = self._names(base)
        if self.estimator == "innovations":
            found = model_files.by_innovations(base, logs, names, as_logged=self.as_logged, progress=say)
        else:
            extra = {"predictor": self.predictor, "weights": weights}
            found = model_files.by_predictions(base, logs, names, progress=say, **extra)
        held_out, words = [path.name for path in self.held_out], ["refine", *self.words()]
        origin = provenance(words, base.name, "fit_logs_sha256", self.logs, held_out=held_out)
        model = replace(found.model_file(base), name=self.output.stem, provenance=origin)
        numbers = found.to_json()
        if judged:
            before, after = (model_files.judge(one, judged) for one in (base, model))
            numbers |= {"held_out": {"before": before, "after": after}}
        numbers |= {"model": model.name, "estimator": self.estimator, "environment": environment()}
        with together():
            save_model_file(model, self.output)
            if self.json is not None:
                write_json(self.json, numbers)
        return Refined(numbers, model, {"model": self.output, "results": self.json})

    def _flights(self) -> tuple[list[FlightLog], list[FlightLog]]:
        """Check the arguments, and read the flights to fit and the held-out flights."""
        from cfb_mjx.commands.fitted import read_together
        from cfb_mjx.logs import require_own_names

        if not self.logs:
            raise CfbError("refine needs at least one log; see 'cfb refine --help'.")
        require_folder(self.output, self.json)
        require_apart(self.logs, self.held_out)
        if self.estimator == "innovations" and (self.predictor or self.weight):
            raise CfbError(
                "--predictor and --weight are for --estimator predictions; leave them out, or use that estimator."
            )
        flights = read_together([*self.logs, *self.held_out], self.flown_with)
        logs, judged = flights[: len(self.logs)], flights[len(self.logs) :]
        for group in (logs, judged):
            require_own_names(group)
        return logs, judged

    def _weights(self, logs: list[FlightLog]) -> dict[str, float]:
        """The weights that were given, by the names of the flights."""
        found = {}
        for text in self.weight:
            name, _, value = text.partition("=")
            chosen = [log.name for log in logs if log.name.startswith(name)] if name else []
            try:
                number = float(value)
            except ValueError:
                number = math.nan
            if not 0 < number < math.inf:
                raise CfbError(f"--weight {text}: write NAME=VALUE with a positive number.")
            if not chosen:
                raise CfbError(f"--weight {text}: no flight's name begins with '{name}'.")
            found |= dict.fromkeys(chosen, number)
        return found

    def _names(self, base: ModelFile) -> list[str]:
        """Names of the effects to fit."""
        from cfb_mjx.model.effects import CATALOGUE
        from cfb_mjx.sysid.refinement.numbers import PLANT

        if self.effects == "plant":
            return list(PLANT)
        names = self.effects.split(",") if self.effects else [e["name"] for e in base.effects if e["name"] in CATALOGUE]
        if not names:
            raise CfbError(
                f"model {base.name} has no effects; name the effects to fit, for instance --effects rotor_drag, or fit "
                "all that a drone usually needs with --effects plant."
            )
        return names
