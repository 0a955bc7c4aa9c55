"""``cfb fit-rotors``: fit motors and thrust and torque curves to flights with rotor speed and to bench tables."""

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
    from cfb_mjx.sysid.rotors.tables import SteadyFit

_LIMIT = "the model file has one time constant per motor and no dead time"
_UNITS = {"thrust": "N", "torque": "N m"}


@dataclass(frozen=True)
class FittedRotors(Result):
    """Motors, thrust curves and torque curves that were fitted to files.

    Attributes:
        fit: the estimates, for instance ``fit.estimates["motor_gain"].value`` and ``.std``; ``fit.motors`` and
            ``fit.maps`` have the details.
        model: the model with the fitted motors and curves, as written.
        asked: which of offset, asymmetric and dead_time the motors were fitted with on request.
        files: paths of the files written, by kind; None for a file that was not asked for.
    """

    fit: RotorFit
    model: ModelFile
    asked: frozenset[str]
    files: Mapping[str, Path | None]

    @property
    def numbers(self) -> dict[str, Any]:
        """The results as ``--json`` writes them."""
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
                f"{fit.base.name} at the same rotor speed, by the specific force at {1e3 * fit.flown.mass:.1f} g (not "
                "written to the model: cfb refine fits thrust_scale to predictions)"
            )
        lines += [*fit.notes, f"model: {self.files['model']} ({', '.join(fit.entries)})"]
        if fit.motors and fit.motors.common.extras - {"offset"}:
            lines.append(f"spin-up and spin-down constants and dead time are reported only: {_LIMIT}.")
        return "\n".join([*lines, *lines_of({what: path for what, path in self.files.items() if what != "model"})])

    @property
    def _groups(self) -> dict[str, GroupFit]:
        """The fits of the motors, by the suffix of the names of their constants."""
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
            hint = "; the fit includes it" if test.supported and test.name not in self.asked else ""
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
    out = f", with {steady.outliers:.0%} of the points left out as outliers" if steady.outliers else ""
    yield f"steady speed: {steady.points} points, spread about a line {steady.spread:.1f} rad/s{out}"
    if steady.per_volt is not None:
        yield (
            f"steady speed follows command times voltage, omega = {steady.offset:.0f} + {steady.per_volt:.0f} u V; "
            f"a line in u alone leaves a spread of {steady.spread_without_voltage:.1f} rad/s. The gain holds at 3.7 V; "
            f"with the effect battery_sag of slope {steady.sag_slope:.2f} a model follows the voltage."
        )


def _of_map(name: str, fitted: MapFit) -> Iterator[str]:
    unit = _UNITS[name]
    yield f"{name}: {len(fitted.value)} points, noise {fitted.noise[0]:.2g} {unit}, {len(fitted.outliers)} outliers"
    if fitted.offset_std:
        yield (
            f"{name}: every reading has an offset of {fitted.offset:+.3g} {unit} "
            f"({abs(fitted.offset) / fitted.offset_std:.0f} std), as if the scale was not tared; the curve is fitted "
            "without this offset."
        )
    for note in fitted.shape.notes():
        yield f"{name}: {note}"
    if math.isfinite(fitted.scale_p_value):
        word = "differ" if fitted.scale_p_value < 0.01 else "do not differ significantly"
        yield f"{name}: the motors {word} (p = {fitted.scale_p_value:.2g})"


@command
class FitRotors(Command):
    """Fit motors, thrust curves and torque curves to flights with measured rotor speed and to bench tables.

    The kind of each file is found from its columns: a flight log, command steps (t, u or u1..u4, omega or
    omega1..omega4), steady points (u, omega, vbat), or steady force and torque (omega, force, torque, optionally
    motor). Bench tables may also have the column names of the tools of Bitcraze, RCbenchmark and Tyto.

    Prints the estimates, and which constants the data do not identify. Writes the model with the fitted motors and
    curves.

    Attributes:
        files: flight logs, and bench tables (csv, parquet).
        output: model YAML to write.
        model: preset or model YAML to start from.
        set: changes to the model's parameters before the fit, for instance mass=0.045 (kg).
        offset: also fit the steady rotor speed at zero command, rad/s; needs commands over a wide range.
        asymmetric: fit separate time constants for spin-up and spin-down (reported, not written to the model).
        dead_time: fit the time from a command to its first effect (reported, not written to the model).
        per_motor: also fit every motor on its own, with a factor on thrust and on torque for each.
        robust: reduce the weight of outliers among the bench points of force and torque.
        json: JSON file for the results.
        figure: file for a figure of the fits and residuals (.png, .svg, .pdf).
        tared: the scale read zero at rest. No offset of its readings is then fitted, or counted in the uncertainty.
        rotors: number of rotors whose force and torque were measured together.
            Default: 4 if the file has the speeds of several rotors beside one force, else 1.
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
        """Fit the contents of the files, and write the model and the other files that were asked for.

        Raises:
            CfbError: bad files, files to which nothing can be fitted, or files that cannot be written.
        """
        from cfb_mjx.logs.rotor_files import read_rotor_files
        from cfb_mjx.runtime import Progress, configure_jax

        if not self.files:
            raise CfbError("fit-rotors needs at least one file; see 'cfb fit-rotors --help'.")
        require_folder(self.output, self.json, self.figure)
        read = read_rotor_files(self.files, self.rotors)  # before jax loads, so that a bad file is refused at once
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
                from cfb_mjx.sysid.rotors.motors import replay
                from cfb_mjx.view.rotors import rotor_figure

                replays = replay(found.motors) if found.motors else []
                rotor_figure(replays, found.maps, self.figure, self.output.stem)
        return result

    def _model(self, found: RotorFit) -> ModelFile:
        names = ", ".join(path.name for path in self.files)
        if not found.entries:
            reasons = "; ".join(found.motors.common.unidentifiable.values()) if found.motors else ""
            raise CfbError(f"{names}: no constant of the model can be identified from these files ({reasons}).")
        return replace(
            found.model_file(found.base, f"cfb fit-rotors on {len(self.files)} file(s), {date.today().isoformat()}"),
            name=self.output.stem,
            description=f"{found.base.name} with rotors fitted to {names}",
            provenance=provenance(["fit-rotors", *self.words()], found.base.name, "files_sha256", self.files),
        )
