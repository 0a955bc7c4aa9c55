"""Motors and rotor maps of a drone from all that flights and bench tables tell of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from cfb_mjx.errors import CfbError
from cfb_mjx.logs import FlightLog
from cfb_mjx.logs.flown import flown_part
from cfb_mjx.logs.rotor_files import RotorFiles
from cfb_mjx.parameters import Entry, ModelFile
from cfb_mjx.sysid.identification.result import Estimate, numbers_of
from cfb_mjx.sysid.rotors.motors import ENTRIES, MotorFit
from cfb_mjx.sysid.rotors.rotor_maps import MapFit
from cfb_mjx.sysid.rotors.steady import SteadyFit, fit_steady
from cfb_mjx.sysid.rotors.supply import Extras, fit_under_supply
from cfb_mjx.sysid.rotors.tables import fit_maps, require_one_rotor
from cfb_mjx.sysid.rotors.thrust_in_flight import ThrustInFlight, thrust_in_flight


@dataclass(frozen=True)
class RotorFit:
    """Result of `fit_rotors`.

    Attributes:
        base: the model that was started from.
        motors: from commands and rotor speeds in time; None: there were none.
        steady: from steady points; None: there were none, or records in time tell the same and more.
        maps: ``thrust`` and ``torque``, as far as there were points.
        flown: thrust in flight beside the base model's curve; None: no stretch was long enough.
        notes: what to know about the files and the fit, in words.
    """

    base: ModelFile
    motors: MotorFit | None
    steady: SteadyFit | None
    maps: dict[str, MapFit]
    flown: ThrustInFlight | None
    notes: tuple[str, ...]

    @cached_property
    def entries(self) -> dict[str, tuple[np.ndarray, np.ndarray | None]]:
        """What a model file takes over, with standard deviations where known."""
        found: dict[str, tuple[np.ndarray, np.ndarray | None]] = {}
        if self.motors is not None:
            found |= {name: told for name in ENTRIES if (told := self.motors.values(name)) is not None}
        if self.steady is not None:
            found["motor_gain"] = np.asarray(self.steady.gain), np.asarray(self.steady.gain_std)
            found["motor_speed_offset"] = np.asarray(self.steady.offset), np.asarray(self.steady.offset_std)
        for name, fitted in self.maps.items():
            found[f"{name}_polynomial"] = fitted.coefficients, fitted.std
            # The factors belong to the curve: old ones would count twice.
            scale, std = np.ones(4), np.zeros(4)
            for motor, value, deviation in zip(fitted.motors, fitted.scale, fitted.scale_std, strict=True):
                scale[motor - 1], std[motor - 1] = value, deviation
            if len(fitted.motors) or np.any(self.base.entries[f"{name}_scale"].value != 1):
                found[f"{name}_scale"] = scale, std if len(fitted.motors) else None
        return found

    @property
    def estimates(self) -> dict[str, Estimate]:
        """All constants, those of the motors as if they were one; the curves' beside the base model's own."""
        found = dict(self.motors.common.estimates) if self.motors else {}
        if self.steady is not None:
            for name, value, std in (
                ("motor_gain", self.steady.gain, self.steady.gain_std),
                ("motor_speed_offset", self.steady.offset, self.steady.offset_std),
            ):
                found[name] = Estimate(value, std, "rad/s", float(np.mean(self.base.entries[name].value)))
        for name, fitted in self.maps.items():
            unit = "N" if name == "thrust" else "N m"
            scales = self.base.entries[f"{name}_scale"].value
            old = self.base.entries[f"{name}_polynomial"].value * np.mean(scales)
            for power, value, std, preset in zip("321", fitted.coefficients, fitted.std, old, strict=True):
                found[f"{name}_s{power}"] = Estimate(value, std, unit, preset)
            if fitted.offset_std:
                found[f"{name}_offset"] = Estimate(fitted.offset, fitted.offset_std, unit, 0.0)
            for motor, value, std in zip(fitted.motors, fitted.scale, fitted.scale_std, strict=True):
                found[f"{name}_scale_M{motor}"] = Estimate(value, std, "1", scales[motor - 1])
        return found

    def model_file(self, source: str) -> ModelFile:
        """The base model with what was found, its uncertainty and ``source``."""
        new = {key: Entry(np.asarray(value, float), source, std) for key, (value, std) in self.entries.items()}
        return replace(self.base, entries={**self.base.entries, **new})

    def to_json(self) -> dict:
        """All numbers, in JSON terms."""
        found: dict[str, Any] = {"parameters": numbers_of(self.estimates)}
        if self.steady is not None:
            found["steady"] = self.steady.to_json()
        found["unidentifiable"] = list(self.motors.common.unidentifiable) if self.motors else []
        if self.motors:
            groups = {"all": self.motors.common} | {f"M{n}": group for n, group in self.motors.motors.items()}
            found["motors"] = {name: group.to_json() for name, group in groups.items()}
            found["motors_differ_p_value"] = self.motors.differences
        found["maps"] = {name: fitted.to_json() for name, fitted in self.maps.items()}
        if self.flown is not None:
            found["thrust_in_flight"] = asdict(self.flown)
        return found | {"written_to_model": list(self.entries)}


def fit_rotors(
    files: RotorFiles,
    base: ModelFile,
    offset: bool = False,
    asymmetric: bool = False,
    dead_time: bool = False,
    per_motor: bool = False,
    robust: bool = False,
    tared: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> RotorFit:
    """Fit what the files tell of motors and rotors.

    Args:
        files: `cfb_mjx.logs.rotor_files.read_rotor_files`; run with x64 enabled.
        base: model to start from.
        offset: as for `fit_motors`.
        asymmetric: likewise.
        dead_time: likewise.
        per_motor: likewise, and as for `fit_map`.
        robust: as for `fit_map`.
        tared: likewise.
        progress: called with (done, total) while motors are fitted.

    Raises:
        CfbError: thrust that is not one rotor's of this drone, or too little data.
    """
    require_one_rotor(files.tables, base)
    nominal, notes = base.parameters(), list(files.notes)
    motors = steady = None
    if files.records:
        extras = Extras(offset=offset, asymmetric=asymmetric, dead_time=dead_time)
        motors, said = fit_under_supply(files.records, nominal, per_motor=per_motor, progress=progress, **extras)
        notes += said
    if files.points and not files.records:
        steady = fit_steady(files.points)
    elif files.points:
        notes.append("steady points were not used: command steps tell gain and offset too, and the lag.")
    sigma = float(base.entries["reference_rotor_speed"].value)
    maps = fit_maps(files.tables, sigma, per_motor, robust, tared)
    flown = thrust_in_flight(_flown(files.flights), nominal)
    return RotorFit(base, motors, steady, maps, flown, tuple(notes))


def _flown(logs: Sequence[FlightLog]) -> list[FlightLog]:
    """What of some recordings is flight."""
    found = []
    for log in logs:
        with suppress(CfbError):  # motors on the ground are a recording of motors all the same
            found.append(flown_part(log, Path(log.name)))
    return found
