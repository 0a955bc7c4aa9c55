"""``cfb check``: what a log holds, what its signals say about each other, what it is good for."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cfb_mjx.errors import CfbError
from cfb_mjx.files import output_folder, scratch, together, write_json, write_text
from cfb_mjx.logs import FlightLog
from cfb_mjx.logs.alignment import nominal_thrust
from cfb_mjx.logs.gate import Verdict
from cfb_mjx.logs.reading import read_judged
from cfb_mjx.runtime import environment
from cfb_mjx.terminal import print_paths

_LIFTS, _ENOUGH = 4.0, 50  # m/s^2, rows
_FAST, _SLOW = 240.0, 95.0  # rows per s: of 250 Hz and 100 Hz, with jitter


@dataclass(frozen=True)
class Checked:
    """One recording: the flight and what was found, or why it was refused."""

    path: Path
    log: FlightLog | None
    verdict: Verdict | None
    refusal: str | None


def run_check(paths: list[Path], output: Path | None, json: Path | None, options: dict[str, Any]) -> int:
    """Check every recording by itself, print what was found, write the page.

    Returns:
        How many were refused.
    """
    if output is not None:
        output_folder(output)
    found = [_checked(path, options) for path in paths]
    for one in found:
        print("\n".join(_lines(one)))
    with together():
        if json is not None:
            write_json(json, {"logs": {str(c.path): _json(c) for c in found}, "environment": environment()})
        page = None if output is None else _write_page(output, found)
    print_paths(page=page, results=json)
    return sum(c.refusal is not None for c in found)


def _checked(path: Path, options: dict[str, Any]) -> Checked:
    try:
        return Checked(path, *read_judged(path, **options), None)
    except CfbError as error:
        return Checked(path, None, None, str(error))


def _lines(one: Checked) -> list[str]:
    if one.log is None or one.verdict is None:
        return [f"{one.path}: REFUSED", f"  {str(one.refusal).removeprefix(f'{one.path}: ')}"]
    log, verdict = one.log, one.verdict
    said = [*(log.metadata.get("warnings") or ()), *(log.metadata.get("notes") or ())]
    return [
        f"{one.path}: {log.metadata['format']}, {len(log)} rows, {log.duration:.1f} s at "
        f"{1 / log.nominal_interval:.0f} Hz, "
        f"{len(log.gaps())} gap{'s' * (len(log.gaps()) != 1)}",
        f"  measured: {', '.join(_measured(log))}",
        f"  {verdict.summary()}",
        *(f"  {line}" for line in _carries(log)),
        *(f"  {line}" for line in said),
        f"  good for: {', '.join(good_for(log, verdict)) or 'a look'}",
        *(f"  next time: {line}" for line in next_time(log, verdict)),
    ]


def _measured(log: FlightLog) -> list[str]:
    derived = log.metadata.get("variables") or {}
    names = [f for f in ("position", "velocity", "quaternion", "body_rate", "specific_force", "command")]
    said = [f"{n.replace('_', ' ')}{' (derived)' if 'derived' in (derived.get(n) or {}) else ''}" for n in names]
    if log.rotor_speed is not None:
        share = float(np.isfinite(log.rotor_speed).mean())
        said.append("rotor speed" + ("" if share > 0.999 else f" ({share:.0%} of the readings)"))
    if log.battery_voltage is not None:
        said.append(f"battery {log.battery_voltage.min():.2f} to {log.battery_voltage.max():.2f} V")
    return said


def carried(log: FlightLog) -> float | None:
    """kg that the measured rotor speeds carry in the median row, by the paper's thrust curve; None without speeds."""
    if log.rotor_speed is None:
        return None
    known = np.isfinite(log.rotor_speed).all(axis=1) & (log.specific_force[:, 2] > _LIFTS)
    if known.sum() < _ENOUGH:
        return None
    thrust = nominal_thrust(log.rotor_speed[known]).sum(axis=1)
    return float(np.median(thrust / log.specific_force[known, 2]))


def _carries(log: FlightLog) -> list[str]:
    mass = carried(log)
    if mass is None:
        return []
    return [
        f"rotors of a Crazyflie Brushless carry {1e3 * mass:.1f} g at these speeds (the paper's curve): what the drone "
        "weighs over that is its thrust scale"
    ]


def _moving(verdict: Verdict, name: str) -> set[str]:
    return {r.axis for r in verdict.relations if r.name == name and r.moves and not r.contradicts}


def good_for(log: FlightLog, verdict: Verdict) -> list[str]:
    """What can be learned from a flight, most wanted first."""
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
    """What a recording lacks."""
    rate, turning = 1 / log.nominal_interval, _moving(verdict, "attitude")
    derived = log.metadata.get("variables") or {}
    found = []
    if log.rotor_speed is None:
        found.append("log rotor speeds (motor.m1_rpm .. or rpm.m1 ..): they tell motors from aerodynamics")
    if log.battery_voltage is None:
        found.append("log pm.vbat: battery_sag follows it")
    for field, names in (
        ("body_rate", "gyro.x y z"),
        ("specific_force", "acc.x y z"),
        ("velocity", "stateEstimate.vx vy vz"),
    ):
        if "derived" in (derived.get(field) or {}):
            found.append(f"log {names}: a derived {field.replace('_', ' ')} is late and smooth")
    if rate < _FAST:
        found.append(f"log at 250 Hz or more (now {rate:.0f}): a micro SD card does; see cfb import --print-config sd")
    if not {"x", "y"} <= turning:
        found.append("change the attitude quickly (steps, doublets): inertia and motors do not show in a gentle flight")
    elif "z" not in {r.axis for r in verdict.relations if r.name == "attitude" and r.moves}:
        found.append("yaw quickly in one flight: J_z and J_m do not show otherwise")
    return found


def _json(one: Checked) -> dict:
    if one.log is None or one.verdict is None:
        return {"refused": one.refusal}
    log, verdict = one.log, one.verdict
    return {
        "format": log.metadata["format"],
        "rows": len(log),
        "duration_s": log.duration,
        "rate_hz": 1 / log.nominal_interval,
        "gaps": len(log.gaps()),
        "measured": _measured(log),
        "warnings": list(log.metadata.get("warnings") or ()),
        "notes": list(log.metadata.get("notes") or ()),
        "carried_mass_kg": carried(log),
        "checks": verdict.report(),
        "problem": verdict.problem,
        "good_for": good_for(log, verdict),
        "next_time": next_time(log, verdict),
    }


def _write_page(output: Path, found: list[Checked]) -> Path:
    from cfb_mjx.logs.consistency import comparisons
    from cfb_mjx.view.checked import checked_figure
    from cfb_mjx.view.page import Section, html_page

    with scratch() as folder:
        sections = []
        for number, one in enumerate(found):
            figures, tables = [], []
            if one.log is not None and one.verdict is not None:
                compared = comparisons(one.log)
                if compared:
                    figure = Path(folder) / f"{number}.png"
                    checked_figure(compared, one.verdict.relations, figure)
                    figures.append((figure, f"measured and integrated signals of {one.path.name}"))
                rows = [
                    [
                        f"{r.name} {r.axis}".strip(),
                        f"{r.slope:.3f}",
                        f"{r.lag * 1e3:.0f}",
                        f"{r.correlation:.3f}",
                        f"{r.unexplained:.3f}",
                        "contradicts" if r.contradicts else "agrees" if r.moves else "too gentle to tell",
                    ]
                    for r in one.verdict.relations
                ]
                rows += [
                    [
                        f"motors by {source.replace('_', ' ')}",
                        "",
                        "",
                        f"{value:.3f}",
                        "",
                        "agrees" if value > 0.6 else "weak",
                    ]
                    for source, value in one.verdict.agreement.items()
                ]
                header = ["comparison", "slope", "lag, ms", "correlation", "unexplained", "verdict"]
                tables = [("What the signals say about each other; unexplained from 0.2 on contradicts.", header, rows)]
            sections.append(Section(one.path.name, [line.strip() for line in _lines(one)], tables, figures))
        lead = (
            f"{len(found)} recordings, {sum(c.refusal is not None for c in found)} refused. Each pair of signals that "
            "should be one another's derivative is compared over short windows."
        )
        page = output / "index.html"
        write_text(page, html_page("Recordings, checked", lead, sections, environment()))
    return page
