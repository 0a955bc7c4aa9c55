"""``cfb fit-rotors``: motors and rotor maps on their own, from flights with rotor speed and from bench tables."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from datetime import date
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cfb_mjx.commands.command import (
    Command,
    Figure,
    File,
    Files,
    Model,
    ModelOutput,
    Pairs,
    Result,
    Within,
    command,
    lines_of,
)
from cfb_mjx.commands.fitted import provenance
from cfb_mjx.errors import CfbError
from cfb_mjx.files import require_folder, together, write_json

if TYPE_CHECKING:
    from cfb_mjx.parameters import ModelFile
    from cfb_mjx.sysid.rotors.fitting import RotorFit
    from cfb_mjx.sysid.rotors.motors import GroupFit
    from cfb_mjx.sysid.rotors.rotor_maps import MapFit
    from cfb_mjx.sysid.rotors.steady import SteadyFit

_LIMIT = "the model file has one time constant per motor and no dead time"
_UNITS = {"thrust": "N", "torque": "N m"}


@dataclass(frozen=True)
class FittedRotors(Result):
    """Motors and rotor maps fitted to files.

    Attributes:
        fit: ``fit.estimates["motor_gain"].value``, ``.std`` and the like, and all else in ``fit.motors``, ``fit.maps``.
        model: the model with them, as written.
        asked: what the motors were to have beside gain and lag: offset, asymmetric, dead_time.
        files: what was written, by what it is.
    """

    fit: RotorFit
    model: ModelFile
    asked: frozenset[str]
    files: Mapping[str, Path | None]

    @property
    def numbers(self) -> dict[str, Any]:
        """As ``--json`` writes them."""
        from cfb_mjx.runtime import environment

        return self.fit.to_json() | {"environment": environment()}

    def __str__(self) -> str:
        fit = self.fit
        lines = [*self._constants()]
        if fit.steady is not None:
            lines += _of_steady(fit.steady)
        lines += self._of_motors()
        for name, fitted in fit.maps.items():
            lines += _of_map(name, fitted)
        if fit.flown is not None:
            lines.append(
                f"thrust in flight: {fit.flown.ratio:.3f} +- {fit.flown.ratio_std:.3f} times the curve of "
                f"{fit.base.name} at the same rotor speeds, by the specific force of {1e3 * fit.flown.mass:.1f} g (not "
                "written: cfb refine takes thrust_scale from predictions)"
            )
        lines += [*fit.notes, f"model: {self.files['model']} ({', '.join(fit.entries)})"]
        if fit.motors and fit.motors.common.extras - {"offset"}:
            lines.append(f"spin-up and spin-down constants and dead time are reported only: {_LIMIT}.")
        return "\n".join([*lines, *lines_of({what: path for what, path in self.files.items() if what != "model"})])

    @property
    def _groups(self) -> dict[str, GroupFit]:
        """What was fitted of motors, by what stands behind the names of its constants."""
        motors = self.fit.motors
        return {"": motors.common, **{f" M{n}": group for n, group in motors.motors.items()}} if motors else {}

    def _constants(self) -> Iterator[str]:
        yield f"{'constant':<26}{'value':>12}{'std':>11}  {'unit':<8}{'preset':>11}{'change':>9}"
        of_motors = {name + n: e for n, group in self._groups.items() for name, e in group.estimates.items()}
        for name, e in (of_motors | self.fit.estimates).items():
            change = f"{e.value / e.preset - 1:+.1%}" if e.preset else ""
            yield f"{name:<26}{e.value:>12.4g}{e.std:>11.2g}  {e.unit:<8}{e.preset:>11.4g}{change:>9}".rstrip()

    def _of_motors(self) -> Iterator[str]:
        motors = self.fit.motors
        if motors is None:
            return
        for suffix, group in self._groups.items():
            for reason in dict.fromkeys(group.unidentifiable.values()):
                yield f"not identifiable{suffix}: {reason}"
        for test in motors.common.tests:
            verdict = "supported by the data" if test.supported else "not supported by the data"
            hint = "; the fit allows for it" if test.supported and test.name not in self.asked else ""
            yield f"{test.name.replace('_', ' ')}: {verdict} (p = {test.p_value:.2g}, BIC {-test.bic_gain:+.1f}){hint}"
        for name, p in motors.differences.items():
            if p < 0.01:
                yield f"the motors differ in {name} (p = {p:.2g})"
        best = motors.common.optimum
        yield (
            f"rows {best.rows}; innovations: lag-one correlation {best.whiteness:+.3f}, "
            f"{best.outliers:.2%} beyond 5 standard deviations"
        )


def _of_steady(steady: SteadyFit) -> Iterator[str]:
    out = f", {steady.outliers:.0%} of them left out as outliers" if steady.outliers else ""
    yield f"steady speed: {steady.points} points about a line, spread {steady.spread:.1f} rad/s{out}"
    if steady.per_volt is not None:
        yield (
            f"steady speed follows command times voltage, omega = {steady.offset:.0f} + {steady.per_volt:.0f} u "
            f"V; a line in u alone leaves {steady.spread_without_voltage:.1f} rad/s. The gain is that at 3.7 V; "
            f"the effect battery_sag with slope {steady.sag_slope:.2f} makes a model follow the voltage."
        )


def _of_map(name: str, fitted: MapFit) -> Iterator[str]:
    unit = _UNITS[name]
    yield f"{name}: {len(fitted.value)} points, noise {fitted.noise[0]:.2g} {unit}, {len(fitted.outliers)} outliers"
    if fitted.offset_std:
        yield (
            f"{name}: every point reads {fitted.offset:+.3g} {unit} too much "
            f"({abs(fitted.offset) / fitted.offset_std:.0f} std): a scale that was not tared; fitted as an offset and "
            "left out of the curve."
        )
    for note in fitted.shape.notes():
        yield f"{name}: {note}"
    if math.isfinite(fitted.scale_p_value):
        word = "differ" if fitted.scale_p_value < 0.01 else "do not differ significantly"
        yield f"{name}: the motors {word} (p = {fitted.scale_p_value:.2g})"


@command
class FitRotors(Command):
    """Fit motors and rotor maps on their own, from flights with rotor speed and from bench tables.

    What a file holds is seen from its content: a flight log, command steps (t, u or u1..u4, omega or omega1..omega4),
    steady points (u, omega, vbat), steady force and torque (omega, force, torque, optionally motor), or any of these
    under the names of Bitcraze's, RCbenchmark's or Tyto's tools. What the data cannot tell is named.

    Attributes:
        files: flight logs and bench tables (csv, parquet).
        output: model YAML to write.
        model: preset or model YAML to start from.
        set: parameters to set before, for instance mass=0.045.
        offset: fit the steady rotor speed at zero command as well (needs commands over a wide range).
        asymmetric: separate time constants for spin-up and spin-down (reported, not written to the model).
        dead_time: time from a command to its first effect (reported, not written to the model).
        per_motor: every motor on its own as well, and a thrust and torque factor for each.
        robust: weigh outliers among the bench points of force and torque down.
        json: write the results here.
        figure: draw fits and residuals here (.png, .svg, .pdf).
        tared: the scale read zero at rest, so that no offset of its readings is tried and none is in the error bars.
        rotors: of how many rotors force and torque are; without it of four where several rotors' speeds stand beside
            them, else of one.
    """

    files: Files
    output: ModelOutput
    model: Model = "cfb-guards"
    set: Pairs = ()
    offset: bool = False
    asymmetric: bool = False
    dead_time: bool = False
    per_motor: bool = False
    robust: bool = False
    json: File = None
    figure: Figure = None
    tared: bool = False
    rotors: Annotated[int | None, Within(1)] = None

    def run(self) -> FittedRotors:
        """Fit what the files hold, and write the model and what else was asked for.

        Raises:
            CfbError: bad files, nothing that can be fitted, or outputs that cannot be written.
        """
        from cfb_mjx.logs.rotor_files import read_rotor_files
        from cfb_mjx.runtime import Progress, configure_jax

        if not self.files:
            raise CfbError("fit-rotors needs at least one file; see 'cfb fit-rotors --help'.")
        require_folder(self.output, self.json, self.figure)
        read = read_rotor_files(self.files, self.rotors)  # before jax loads: a bad file is refused at once
        configure_jax(x64=True)
        from cfb_mjx.parameters import load_model_file, save_model_file
        from cfb_mjx.sysid.rotors.fitting import fit_rotors

        base = load_model_file(self.model, self.set)
        extras = {"offset": self.offset, "asymmetric": self.asymmetric, "dead_time": self.dead_time}
        shared = {"per_motor": self.per_motor, "robust": self.robust, "tared": self.tared}
        found = fit_rotors(read, base, **extras, **shared, progress=Progress("fitting motors"))
        model = self._model(found)
        asked = frozenset(name for name, on in extras.items() if on)
        files = {"model": self.output, "results": self.json, "figure": self.figure}
        result = FittedRotors(found, model, asked, files)
        with together():
            save_model_file(model, self.output)
            if self.json is not None:
                write_json(self.json, result.numbers)
            if self.figure is not None:
                from cfb_mjx.sysid.rotors.motor_replay import replay
                from cfb_mjx.view.rotors import rotor_figure

                replays = replay(found.motors) if found.motors else []
                rotor_figure(replays, found.maps, self.figure, self.output.stem)
        return result

    def _model(self, found: RotorFit) -> ModelFile:
        names = ", ".join(path.name for path in self.files)
        if not found.entries:
            reasons = "; ".join(found.motors.common.unidentifiable.values()) if found.motors else ""
            raise CfbError(f"{names}: cannot tell any constant of the model ({reasons}).")
        return replace(
            found.model_file(f"cfb fit-rotors on {len(self.files)} file(s), {date.today().isoformat()}"),
            name=self.output.stem,
            description=f"{found.base.name} with rotors fitted to {names}",
            provenance=provenance(["fit-rotors", *self.words()], found.base.name, "files_sha256", self.files),
        )
