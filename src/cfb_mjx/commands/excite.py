"""``cfb excite``: design flights that identify the drone."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from cfb_mjx.commands.command import (
    Command,
    File,
    Model,
    OutputFolder,
    Pairs,
    Result,
    Within,
    command,
    default_of,
    lines_of,
)
from cfb_mjx.errors import CfbError
from cfb_mjx.files import VectorFormat, output_folder, require_folder, require_no_file, together, write_json, write_text

if TYPE_CHECKING:
    from cfb_mjx.logs import FlightLog
    from cfb_mjx.sysid.excitation.experiment import Conditions

_NOT_OF_PATHS = ("duration", "rate_limit", "altitude_loss", "parameters", "repetitions", "format")
"""Options that ``separate`` does not use."""


@dataclass(frozen=True)
class Excited(Result):
    """A manoeuvre, and the uncertainty that a fit to its flight will have.

    Attributes:
        numbers: the results as in excitation.json, for instance ``numbers["parameters"]["inertia_xx"]["std"]``.
        parameters: names of the parameters that will be fitted, identifiable or not.
        files: paths of commands.csv, flight.mcap and excitation.png.
        results: paths of the JSON files.
    """

    numbers: Mapping[str, Any]
    parameters: tuple[str, ...]
    files: tuple[Path, ...]
    results: tuple[Path, ...]

    def __str__(self) -> str:
        numbers = self.numbers
        count, rotors = numbers["repetitions"], numbers["conditions"]["measured_rotors"]
        return "\n".join(
            [
                f"{numbers['manoeuvre']}: {numbers['duration_s']:g} s, {count} repetition{'s' * (count != 1)} in one "
                f"flight, {'rotor speed measured' if rotors else 'commands only'}, "
                f"disturbance {numbers['conditions']['disturbance']:g} rad/s^2\n",
                *self._expected(),
                "",
                *self._attained(),
                f"files: {', '.join(map(str, self.files))}",
                *(f"results: {path}" for path in self.results),
            ]
        )

    def _expected(self) -> list[str]:
        """A table with a row for every parameter, and a column for each of the other manoeuvres."""
        numbers, others = self.numbers, self.numbers["compared_with"]
        heads = "".join(f"{name:>15}" for name in others)
        lines = [f"{'expected from cfb fit':<22}{'value':>12}{'std':>11}  {'unit':<8}{'std, %':>8}{heads}"]
        for name in self.parameters:
            cells = "".join(f"{_share(other['parameters'].get(name)):>15}" for other in others.values())
            e = numbers["parameters"].get(name)
            number = f"{e['value']:>12.4g}{e['std']:>11.2g}  {e['unit']:<8}" if e else f"{'':>12}{'':>11}  {'':<8}"
            lines.append(f"{name:<22}{number}{_share(e):>8}{cells}")
        if numbers["unidentifiable"]:
            together = ", ".join(numbers["identifiable_together"])
            known = f"; identifiable in combination: {together}" if together else ""
            lines.append(f"not identifiable: {', '.join(numbers['unidentifiable'])}{known}")
        return lines

    def _attained(self) -> list[str]:
        calm, rough = self.numbers["undisturbed"], self.numbers["with_disturbances"]
        lines = [
            f"undisturbed: tilt {calm['tilt_deg']:.0f} deg, body rate {calm['rate']:.1f} rad/s, "
            f"altitude loss {calm['altitude_loss']:.2f} m, drift {calm['drift']:.1f} m, "
            + (f"settled {calm['settled']:.1f} s after the handover" if calm["caught"] else "not caught"),
            f"worst with disturbances: tilt {rough['max_tilt_deg']:.0f} deg, "
            f"body rate {rough['max_rate_radps']:.1f} rad/s, altitude loss {rough['altitude_loss_m']:.2f} m, "
            f"drift {rough['drift_m']:.1f} m; "
            f"within limits {rough['within_limits']}, caught {rough['caught']} of {rough['repetitions']}",
        ]
        if not calm["within_limits"]:
            lines.append("warning: the undisturbed manoeuvre, including the catch, exceeds the limits.")
        if rough["caught"] < rough["repetitions"] or not calm["caught"]:
            lines.append("warning: the stabiliser does not always catch the drone; choose lower limits.")
        return lines


@dataclass(frozen=True)
class Separated(Result):
    """How well each path distinguishes effects that are easily confused.

    Attributes:
        numbers: the results as in separation.json. ``numbers["fly"]`` is the path to fly, ``numbers["flights"]`` the
            number of flights needed (None: no path distinguishes the effects, and nothing was written).
        files: paths of setpoints.csv, flight.mcap and separation.json.
        json: path of the copy of the results, if one was asked for.
    """

    numbers: Mapping[str, Any]
    files: tuple[Path, ...]
    json: Path | None

    def __str__(self) -> str:
        from cfb_mjx.sysid.excitation.manoeuvres import PATHS

        between = " against ".join(self.numbers["between"])
        lines = [f"evidence from one flight of each path for {between}, in nats (10 are enough):\n"]
        for path, told in self.numbers["paths"].items():
            count = told["flights"]
            flights = f"{count} flight{'s' * (count != 1)}" if count else "cannot distinguish"
            worst = min(told["nats"].values()) if told["followed"] else 0.0
            lines.append(f"{path:<16}{max(worst, 0.0):>9.1f}   {flights:<20} {PATHS[path][0]}")
        if self.complaint is None:
            count = self.numbers["flights"]
            lines += [
                f"\nfly: {self.numbers['fly']}, {count} time{'s' * (count != 1)}, then run cfb close-loop again",
                f"files: {', '.join(map(str, self.files))}",
                *lines_of({"results": self.json}),
            ]
        return "\n".join(lines)

    @property
    def complaint(self) -> str | None:
        """That no path distinguishes the effects; None if one does."""
        if self.numbers["flights"] is not None:
            return None
        names = " from ".join(self.numbers["between"])
        return f"no path distinguishes {names} at the assumed strengths; weigh, remove a part or measure it separately."


@command
class Excite(Command):
    """Design a manoeuvre that identifies the drone, fly it in simulation, and predict the uncertainty of a fit.

    roll-pitch, single-motor and optimised are open-loop manoeuvres. A stabiliser like the firmware's hovers, hands over
    to the open-loop commands, and catches the drone afterwards. Writes commands.csv (the commands), flight.mcap (a
    simulated flight), excitation.png (a figure) and excitation.json (the expected uncertainty).

    separate is for effects that `cfb close-loop` reports as confusable. It finds the path that distinguishes them best
    when a position controller flies it. Writes setpoints.csv (the set-points), flight.mcap (a simulated flight) and
    separation.json (the evidence that each path gives). If no path distinguishes the effects, it writes nothing, and
    the exit status is 2.

    Attributes:
        manoeuvre: kind of flight to design.
            roll-pitch: doublets, for the inertia about x and y. single-motor: for J_z and J_m.
            optimised: for the parameters of --parameters; compared with the other two.
            separate: a path that distinguishes effects.
        output: folder to write to.
        parameters: parameters that will be fitted, as for `cfb fit`. Default: those that `cfb fit` fits by default.
        model: preset or model YAML, the best guess of the drone before the flight.
        set: changes to the model's parameters, for instance mass=0.045 (kg).
        repetitions: repetitions of the manoeuvre in one flight.
        duration: duration of the open-loop part, s, from 0.1 to 2.
        rate_limit: largest body rate that is allowed, rad/s, above 0.
        altitude_loss: largest loss of height that is allowed until the drone is caught, m, above 0.
        measured_rotors: assume that rotor speed will be logged.
        disturbance: expected RMS of the unmodelled torque divided by the inertia, rad/s^2.
        between: effects that separate shall distinguish, two or more, with commas between them.
            Effects of the model have their strength in the model, others a typical strength.
        json: JSON file for a copy of the results.
        format: also write every figure as a vector graphic, pdf or svg. Default: PNG only.
    """

    manoeuvre: Annotated[Literal["roll-pitch", "single-motor", "optimised", "separate"], tyro.conf.Positional]
    output: OutputFolder
    parameters: str | None = None
    model: Model = "cfb-guards"
    set: Pairs = ()
    repetitions: Annotated[int, Within(1, 50)] = 5
    duration: float = 0.5
    rate_limit: float = 12.0
    altitude_loss: float = 0.5
    measured_rotors: bool = False
    disturbance: Annotated[float, Within(0, 1000)] = 4.0
    between: Annotated[str | None, tyro.conf.arg(metavar="EFFECT,EFFECT")] = None
    json: File = None
    format: VectorFormat | None = None

    def run(self) -> Excited | Separated:
        """Design the manoeuvre or find the path, and write it with its expected results.

        Raises:
            CfbError: options that would have no effect, invalid limits, parameters or effects, or files that cannot be
                written.
        """
        names = self._effects()
        require_no_file(self.output)
        require_folder(self.json)
        from cfb_mjx.runtime import Progress, configure_jax

        configure_jax(x64=True)
        from cfb_mjx.sysid.excitation.experiment import Conditions

        conditions = Conditions(measured_rotors=self.measured_rotors, disturbance=self.disturbance)
        if names:
            return self._separate(names, conditions, Progress("flying"))
        return self._excite(conditions, Progress("simulating"), Progress("optimising"))

    def _effects(self) -> list[str]:
        """The effects to distinguish; an empty list for all manoeuvres but separate.

        Raises:
            CfbError: an option that the manoeuvre does not use, or fewer than two effects.
        """
        if self.manoeuvre != "separate":
            if self.between is not None:
                raise CfbError(
                    f"cfb excite {self.manoeuvre} does not use --between: leave it out, or use cfb excite separate."
                )
            return []
        usual = {one.name: default_of(one) for one in fields(self)}
        unused = [name for name in _NOT_OF_PATHS if getattr(self, name) != usual[name]]
        if unused:
            options = ", ".join(f"--{name.replace('_', '-')}" for name in unused)
            raise CfbError(f"cfb excite separate flies paths of its own: leave out {options}.")
        names = [name.strip() for name in (self.between or "").split(",") if name.strip()]
        if len(names) < 2:
            raise CfbError(
                "cfb excite separate needs --between A,B: two or more effects, by the names that cfb close-loop prints."
            )
        return names

    def _excite(self, conditions: Conditions, progress, designing) -> Excited:
        from cfb_mjx.parameters import load_model_file
        from cfb_mjx.runtime import environment
        from cfb_mjx.sysid.excitation.manoeuvres import Limits
        from cfb_mjx.sysid.excitation.trials import excite
        from cfb_mjx.view.excitation import excitation_figure
        from cfb_mjx.view.style import with_vector_copies

        described = load_model_file(self.model, self.set)
        limits = Limits(rate=self.rate_limit, altitude_loss=self.altitude_loss)
        about = (self.parameters, self.repetitions, self.duration, limits, conditions)
        assert self.manoeuvre != "separate"  # separate names effects, and `run` calls `_separate` for them
        excitation = excite(self.manoeuvre, described, *about, progress, designing)
        numbers = excitation.to_json() | {"model": described.name, "environment": environment()}
        chosen = excitation.chosen
        figure = self.output / "excitation.png"
        bounds = {"tilt": limits.tilt_deg, "rate": limits.rate, "height": limits.altitude_loss}
        with together(), with_vector_copies(self.format):
            table, flight, results = self._write(
                "commands.csv", chosen.commands_csv(), chosen.flown.log, "excitation.json", numbers
            )
            excitation_figure(chosen.calm, chosen.flown, figure, bounds, f"{self.manoeuvre} on {described.name}")
        copy = [self.json] if self.json is not None else []
        return Excited(numbers, chosen.prediction.names, (table, flight, figure), (results, *copy))

    def _separate(self, names: list[str], conditions: Conditions, progress) -> Separated:
        from cfb_mjx.model import Quadrotor
        from cfb_mjx.parameters import load_model_file
        from cfb_mjx.runtime import environment
        from cfb_mjx.sysid.excitation.information import separate
        from cfb_mjx.sysid.excitation.manoeuvres import setpoints_csv

        described = load_model_file(self.model, self.set)
        told = separate(Quadrotor.from_file(described), names, conditions, progress=progress)
        best = told[0]
        numbers = {
            "between": names,
            "model": described.name,
            "fly": best.path,
            "flights": best.flights,
            "paths": {one.path: one.to_json() for one in told},
            "conditions": vars(conditions),
            "environment": environment(),
        }
        if best.flights is None:
            return Separated(numbers, (), None)
        with together():
            files = self._write("setpoints.csv", setpoints_csv(best.path), best.flown.log, "separation.json", numbers)
        return Separated(numbers, files, self.json)

    def _write(self, table: str, text: str, log: FlightLog, results: str, numbers: dict) -> tuple[Path, Path, Path]:
        """Write the table to fly, the simulated flight and the results; return their paths in this order."""
        from cfb_mjx.logs import write_mcap

        folder = output_folder(self.output)
        paths = folder / table, folder / "flight.mcap", folder / results
        write_text(paths[0], text)
        write_mcap(log, paths[1])
        for path in (paths[2], self.json):
            if path is not None:
                write_json(path, numbers)
        return paths


def _share(expected: dict | None) -> str:
    if expected is None:
        return "no estimate"
    return f"{100 * expected['std'] / expected['value']:.2g}" if expected["value"] else ""
