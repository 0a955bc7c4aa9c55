"""``cfb excite``: what to fly so that a fit knows the drone."""

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
from cfb_mjx.files import output_folder, require_folder, require_no_file, together, write_json, write_text

if TYPE_CHECKING:
    from cfb_mjx.logs import FlightLog
    from cfb_mjx.sysid.excitation.conditions import Conditions

_NOT_OF_PATHS = ("duration", "rate_limit", "altitude_loss", "parameters", "repetitions")
"""What separate has no use for."""


@dataclass(frozen=True)
class Excited(Result):
    """A manoeuvre, and what a fit will know of its flight.

    Attributes:
        numbers: as excitation.json has them: ``numbers["parameters"]["inertia_xx"]["std"]`` and the like.
        parameters: names of what will be fitted, whether it can be told or not.
        files: commands.csv, flight.mcap and excitation.png.
        results: JSON files.
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
        """A row for every parameter, with the other manoeuvres beside it."""
        numbers, others = self.numbers, self.numbers["compared_with"]
        heads = "".join(f"{name:>15}" for name in others)
        lines = [f"{'expected of cfb fit':<22}{'value':>12}{'std':>11}  {'unit':<8}{'std, %':>8}{heads}"]
        for name in self.parameters:
            cells = "".join(f"{_share(other['parameters'].get(name)):>15}" for other in others.values())
            e = numbers["parameters"].get(name)
            number = f"{e['value']:>12.4g}{e['std']:>11.2g}  {e['unit']:<8}" if e else f"{'':>12}{'':>11}  {'':<8}"
            lines.append(f"{name:<22}{number}{_share(e):>8}{cells}")
        if numbers["unidentifiable"]:
            together = ", ".join(numbers["identifiable_together"])
            known = f"; known together: {together}" if together else ""
            lines.append(f"cannot be told: {', '.join(numbers['unidentifiable'])}{known}")
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
            lines.append("warning: the undisturbed manoeuvre with its catch exceeds the limits.")
        if rough["caught"] < rough["repetitions"] or not calm["caught"]:
            lines.append("warning: the stabiliser does not always catch the drone; ask for less.")
        return lines


@dataclass(frozen=True)
class Separated(Result):
    """What every path tells about effects that are hard to tell apart.

    Attributes:
        numbers: as separation.json has them; ``numbers["fly"]`` is the path to fly, ``numbers["flights"]`` how often
            (None: no path tells the effects apart, and nothing was written).
        files: setpoints.csv, flight.mcap and separation.json.
        json: where the numbers were written too.
    """

    numbers: Mapping[str, Any]
    files: tuple[Path, ...]
    json: Path | None

    def __str__(self) -> str:
        from cfb_mjx.sysid.excitation.paths import PATHS

        between = " against ".join(self.numbers["between"])
        lines = [f"what one flight of each path tells about {between}, in nats (10 settle it):\n"]
        for path, told in self.numbers["paths"].items():
            count = told["flights"]
            flights = f"{count} flight{'s' * (count != 1)}" if count else "does not tell them"
            worst = min(told["nats"].values()) if told["followed"] else 0.0
            lines.append(f"{path:<16}{max(worst, 0.0):>9.1f}   {flights:<20} {PATHS[path][0]}")
        if self.complaint is None:
            count = self.numbers["flights"]
            lines += [
                f"\nfly: {self.numbers['fly']}, {count} time{'s' * (count != 1)}, then cfb close-loop again",
                f"files: {', '.join(map(str, self.files))}",
                *lines_of({"results": self.json}),
            ]
        return "\n".join(lines)

    @property
    def complaint(self) -> str | None:
        """That no path tells the effects apart."""
        if self.numbers["flights"] is not None:
            return None
        names = " from ".join(self.numbers["between"])
        return f"no path tells {names} at the strengths assumed; weigh, remove a part or measure it apart."


@command
class Excite(Command):
    """Design a manoeuvre that identifies the drone, fly it in simulation, and predict what a fit will know.

    A stabiliser like the firmware's hovers, hands over to open-loop commands and catches the drone. Writes the commands
    (commands.csv), the simulated flight (flight.mcap), a figure and the expected uncertainty (excitation.json).

    separate looks for the path a position controller should fly to tell apart effects that cfb close-loop calls
    confusable, and writes its set-points (setpoints.csv), a simulated flight and what every path tells
    (separation.json).

    Attributes:
        manoeuvre: roll-pitch (doublets, for the inertia about x and y), single-motor (for J_z and J_m), optimised
            for the chosen parameters and compared with the other two, or separate.
        output: folder to write to.
        parameters: what will be fitted, as for cfb fit; by default what cfb fit would choose.
        model: preset or model YAML: the best guess of the drone before the flight.
        set: parameters to change, for instance mass=0.045.
        repetitions: of the manoeuvre in one flight.
        duration: of the open-loop part, s.
        rate_limit: body rate not to exceed, rad/s.
        altitude_loss: height that may be lost until the drone is caught, m.
        measured_rotors: rotor speed will be logged.
        disturbance: rms of the unmodelled torque over inertia to expect, rad/s^2.
        between: effects to tell apart (separate); those the model has are taken at its strengths.
        json: write the results here too.
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

    def run(self) -> Excited | Separated:
        """Find what to fly, and write it with what it will tell.

        Raises:
            CfbError: options that would be ignored, impossible limits, parameters, effects or outputs.
        """
        names = self._effects()
        require_no_file(self.output)
        require_folder(self.json)
        from cfb_mjx.runtime import Progress, configure_jax

        configure_jax(x64=True)
        from cfb_mjx.sysid.excitation.conditions import Conditions

        conditions = Conditions(measured_rotors=self.measured_rotors, disturbance=self.disturbance)
        if names:
            return self._separate(names, conditions, Progress("flying"))
        return self._excite(conditions, Progress("simulating"), Progress("optimising"))

    def _effects(self) -> list[str]:
        """Those to tell apart, none but for separate.

        Raises:
            CfbError: an option the manoeuvre has no use for, or too few effects.
        """
        if self.manoeuvre != "separate":
            if self.between is not None:
                raise CfbError(
                    f"cfb excite {self.manoeuvre} tells no effects apart: leave out --between, or say separate."
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
                "cfb excite separate needs --between A,B: the effects to tell apart, as cfb close-loop names them."
            )
        return names

    def _excite(self, conditions: Conditions, progress, designing) -> Excited:
        from cfb_mjx.parameters import load_model_file
        from cfb_mjx.runtime import environment
        from cfb_mjx.sysid.excitation.manoeuvres import Limits
        from cfb_mjx.sysid.excitation.trials import excite
        from cfb_mjx.view.excitation import excitation_figure

        described = load_model_file(self.model, self.set)
        limits = Limits(rate=self.rate_limit, altitude_loss=self.altitude_loss)
        about = (self.parameters, self.repetitions, self.duration, limits, conditions)
        assert self.manoeuvre != "separate"  # that names effects to tell apart, and `_separate` does it
        excitation = excite(self.manoeuvre, described, *about, progress, designing)
        numbers = excitation.to_json() | {"model": described.name, "environment": environment()}
        chosen = excitation.chosen
        figure = self.output / "excitation.png"
        bounds = {"tilt": limits.tilt_deg, "rate": limits.rate, "height": limits.altitude_loss}
        with together():
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
        from cfb_mjx.sysid.excitation.paths import setpoints_csv
        from cfb_mjx.sysid.excitation.separation import separate

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
        """The table to fly, the simulated flight and the numbers; their paths in that order."""
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
        return "cannot tell"
    return f"{100 * expected['std'] / expected['value']:.2g}" if expected["value"] else ""
