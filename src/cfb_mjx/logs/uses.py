"""Summary of a recording: the measured signals, its possible uses, and what to log next time."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cfb_mjx.errors import CfbError
from cfb_mjx.logs.alignment import nominal_thrust
from cfb_mjx.logs.flight_log import FlightLog
from cfb_mjx.logs.gate import Verdict
from cfb_mjx.logs.reading import read_judged

_LIFTS, _ENOUGH = 4.0, 50  # least specific force along z of a row with thrust, m/s^2; fewest such rows
_FAST, _SLOW = 240.0, 95.0  # Hz: limits for logs of 250 Hz and 100 Hz, with a margin for jitter


@dataclass(frozen=True)
class Recording:
    """A recording and the verdict on it, or the reason why it was refused.

    Attributes:
        path: its file or folder.
        log: the flight; None if the recording was refused.
        verdict: result of comparing its signals with each other; None if it was refused.
        refusal: why it was refused, in one sentence; None if it was not.
    """

    path: Path
    log: FlightLog | None
    verdict: Verdict | None
    refusal: str | None

    @classmethod
    def read(cls, path: Path, **options: Any) -> Recording:
        """Read a recording; an invalid one is returned with its ``refusal`` instead of raising an error.

        Args:
            path: its file or folder.
            **options: those of `cfb_mjx.logs.read_log`.
        """
        try:
            return cls(path, *read_judged(path, **options), None)
        except CfbError as error:
            return cls(path, None, None, str(error))

    def lines(self) -> list[str]:
        """Summary as lines of text."""
        if self.log is None or self.verdict is None:
            return [f"{self.path}: REFUSED", f"  {str(self.refusal).removeprefix(f'{self.path}: ')}"]
        log, verdict = self.log, self.verdict
        return [
            f"{self.path}: {log.metadata['format']}, {extent(log)}",
            f"  measured: {', '.join(measured(log))}",
            f"  {verdict.summary()}",
            *(f"  {line}" for line in _carries(log)),
            *(f"  {line}" for line in remarks(log)),
            f"  good for: {', '.join(good_for(log, verdict)) or 'viewing only'}",
            *(f"  next time: {line}" for line in next_time(log, verdict)),
        ]

    def report(self) -> dict[str, Any]:
        """Summary as JSON-compatible values."""
        if self.log is None or self.verdict is None:
            return {"refused": self.refusal}
        log, verdict = self.log, self.verdict
        return {
            "format": log.metadata["format"],
            "rows": len(log),
            "duration_s": log.duration,
            "rate_hz": 1 / log.nominal_interval,
            "gaps": len(log.gaps()),
            "measured": measured(log),
            "warnings": list(log.metadata.get("warnings") or ()),
            "notes": list(log.metadata.get("notes") or ()),
            "carried_mass_kg": carried_mass(log),
            "checks": verdict.report(),
            "problem": verdict.problem,
            "good_for": good_for(log, verdict),
            "next_time": next_time(log, verdict),
        }


def extent(log: FlightLog) -> str:
    """One phrase with rows, duration, rate and gaps."""
    gaps = len(log.gaps())
    return f"{len(log)} rows, {log.duration:.1f} s at {1 / log.nominal_interval:.0f} Hz, {gaps} gap{'s' * (gaps != 1)}"


def remarks(log: FlightLog) -> list[str]:
    """Warnings, then notes, of the importer."""
    return [*(log.metadata.get("warnings") or ()), *(log.metadata.get("notes") or ())]


def measured(log: FlightLog) -> list[str]:
    """Names of the signals in the log; those derived from other columns are marked."""
    derived = log.metadata.get("variables") or {}
    names = ("position", "velocity", "quaternion", "body_rate", "specific_force", "command")
    said = [f"{n.replace('_', ' ')}{' (derived)' if 'derived' in (derived.get(n) or {}) else ''}" for n in names]
    if log.rotor_speed is not None:
        share = float(np.isfinite(log.rotor_speed).mean())
        said.append("rotor speed" + ("" if share > 0.999 else f" ({share:.0%} of the readings)"))
    if log.battery_voltage is not None:
        said.append(f"battery {log.battery_voltage.min():.2f} to {log.battery_voltage.max():.2f} V")
    return said


def carried_mass(log: FlightLog) -> float | None:
    """Mass, kg, that the measured rotor speeds carry by the paper's thrust curve (median of the rows in flight).

    None if no rotor speeds were measured, or too few rows have thrust.
    """
    if log.rotor_speed is None:
        return None
    known = np.isfinite(log.rotor_speed).all(axis=1) & (log.specific_force[:, 2] > _LIFTS)
    if known.sum() < _ENOUGH:
        return None
    thrust = nominal_thrust(log.rotor_speed[known]).sum(axis=1)
    return float(np.median(thrust / log.specific_force[known, 2]))


def _carries(log: FlightLog) -> list[str]:
    mass = carried_mass(log)
    if mass is None:
        return []
    return [
        f"rotors of a Crazyflie Brushless carry {1e3 * mass:.1f} g at these speeds (the paper's curve); the mass of "
        "the drone divided by this is its thrust scale"
    ]


def _moving(verdict: Verdict, name: str) -> set[str]:
    return {r.axis for r in verdict.relations if r.name == name and r.moves and not r.contradicts}


def good_for(log: FlightLog, verdict: Verdict) -> list[str]:
    """Uses of a flight, the most important first."""
    rate, turning = 1 / log.nominal_interval, _moving(verdict, "attitude")
    found = []
    if {"x", "y"} <= turning and rate > _SLOW and log.duration > 3:
        found.append("fit of J_x, J_y and motors" if rate > _FAST else "fit of J_x, J_y (motors better at 250 Hz)")
    if "z" in turning and rate > _SLOW:
        found.append("fit of J_z and J_m")
    if log.rotor_speed is not None and np.nanstd(log.rotor_speed, axis=0).min() > 20.0:
        found.append("fit-rotors")
    if np.quantile(np.linalg.norm(log.velocity, axis=1), 0.9) > 0.7 and len(_moving(verdict, "displacement")) > 1:
        found.append("drag and other effects (close-loop)")
    if log.battery_voltage is not None and np.ptp(log.battery_voltage) > 0.15:
        found.append("battery sag")
    return found


def next_time(log: FlightLog, verdict: Verdict) -> list[str]:
    """Advice for the next recording: signals to log, rates, and manoeuvres to fly."""
    rate, turning = 1 / log.nominal_interval, _moving(verdict, "attitude")
    derived = log.metadata.get("variables") or {}
    found = []
    if log.rotor_speed is None:
        found.append("log rotor speeds (motor.m1_rpm .. or rpm.m1 ..): they separate motors from aerodynamics")
    if log.battery_voltage is None:
        found.append("log pm.vbat: battery_sag needs it")
    for field, names in (
        ("body_rate", "gyro.x y z"),
        ("specific_force", "acc.x y z"),
        ("velocity", "stateEstimate.vx vy vz"),
    ):
        if "derived" in (derived.get(field) or {}):
            found.append(f"log {names}: a derived {field.replace('_', ' ')} is delayed and smoothed")
    if rate < _FAST:
        found.append(f"log at 250 Hz or more (now {rate:.0f}), with a micro SD card: see cfb import --print-config sd")
    if not {"x", "y"} <= turning:
        found.append("change the attitude quickly (steps, doublets): a gentle flight does not show inertia and motors")
    elif "z" not in {r.axis for r in verdict.relations if r.name == "attitude" and r.moves}:
        found.append("yaw quickly in one flight: otherwise J_z and J_m cannot be identified")
    return found
