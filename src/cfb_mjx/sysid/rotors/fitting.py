"""Fit motors and rotor maps of a drone to flights and bench tables."""

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
from cfb_mjx.sysid.fitted import Estimate, numbers_of
from cfb_mjx.sysid.rotors.flown_motors import ThrustInFlight, thrust_in_flight
from cfb_mjx.sysid.rotors.motors import ENTRIES, MotorFit
from cfb_mjx.sysid.rotors.rotor_maps import MapFit
from cfb_mjx.sysid.rotors.supply import Extras, fit_under_supply
from cfb_mjx.sysid.rotors.tables import SteadyFit, fit_maps, fit_steady, require_one_rotor


@dataclass(frozen=True)
class RotorFit:
    """Result of `fit_rotors`.

    Attributes:
        base: the model that the fit started from.
        motors: fit to recordings of commands and rotor speeds over time; None if there were none.
        steady: fit to steady points; None if there were none, or if recordings over time were used instead.
        maps: fitted curves under ``thrust`` and ``torque``, if there were points.
        flown: thrust in flight relative to the base model's curve; None if no stretch was long enough.
        notes: remarks on the files and the fit.
    """

    base: ModelFile
    motors: MotorFit | None
    steady: SteadyFit | None
    maps: dict[str, MapFit]
    flown: ThrustInFlight | None
    notes: tuple[str, ...]

    @cached_property
    def entries(self) -> dict[str, tuple[np.ndarray, np.ndarray | None]]:
        """Values for the model file, with standard deviations where known."""
        found: dict[str, tuple[np.ndarray, np.ndarray | None]] = {}
        if self.motors is not None:
            found |= {name: told for name in ENTRIES if (told := self.motors.values(name)) is not None}
        if self.steady is not None:
            found["motor_gain"] = np.asarray(self.steady.gain), np.asarray(self.steady.gain_std)
            found["motor_speed_offset"] = np.asarray(self.steady.offset), np.asarray(self.steady.offset_std)
        for name, fitted in self.maps.items():
            found[f"{name}_polynomial"] = fitted.coefficients, fitted.std
            # The factors belong to the fitted curve, so the old ones must be replaced.
            scale, std = np.ones(4), np.zeros(4)
            for motor, value, deviation in zip(fitted.motors, fitted.scale, fitted.scale_std, strict=True):
                scale[motor - 1], std[motor - 1] = value, deviation
            if len(fitted.motors) or np.any(self.base.entries[f"{name}_scale"].value != 1):
                found[f"{name}_scale"] = scale, std if len(fitted.motors) else None
        return found

    @property
    def estimates(self) -> dict[str, Estimate]:
        """All constants by name, with those of the base model for comparison; the motors are treated as one."""
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

    def model_file(self, base: ModelFile, source: str) -> ModelFile:
        """``base`` with the fitted constants, their uncertainty and ``source``."""
        new = {key: Entry(np.asarray(value, float), source, std) for key, (value, std) in self.entries.items()}
        return replace(base, entries={**base.entries, **new})

    def to_json(self) -> dict:
        """All results as a JSON-compatible dictionary."""
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
    """Fit motors and rotor maps to the data in some files.

    Args:
        files: content of the files, from `cfb_mjx.logs.rotor_files.read_rotor_files`; run with x64 enabled.
        base: model to start from.
        offset: as for `fit_motors`.
        asymmetric: as for `fit_motors`.
        dead_time: as for `fit_motors`.
        per_motor: as for `fit_motors` and `fit_map`.
        robust: as for `fit_map`.
        tared: as for `fit_map`.
        progress: called with (done, total) while motors are fitted.

    Raises:
        CfbError: a thrust is not that of one rotor of this drone, or there is too little data.
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
        notes.append("steady points were not used: the command steps determine gain and offset too, and the lag.")
    sigma = float(base.entries["reference_rotor_speed"].value)
    maps = fit_maps(files.tables, sigma, per_motor, robust, tared)
    flown = thrust_in_flight(_flown(files.flights), nominal)
    return RotorFit(base, motors, steady, maps, flown, tuple(notes))


def _flown(logs: Sequence[FlightLog]) -> list[FlightLog]:
    """The parts of recordings in which the drone flies."""
    found = []
    for log in logs:
        with suppress(CfbError):  # a recording on the ground is still useful for the motors
            found.append(flown_part(log, Path(log.name)))
    return found
