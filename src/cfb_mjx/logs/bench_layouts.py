"""Bench tables under the names of the programs that write them, brought into the layouts of `bench_tables`.

Known are those of Bitcraze's system identification and of labs after it (``pwm, vbat[V], rpm1..4, thrust[g]``, the
whole vehicle on a scale; with ``weight[g]``, ``i[A]``, ``p[W]``; with ``time[ms]`` and steps of the command), and
RCbenchmark's and Tyto's exports (``Thrust (N)``, ``Motor Optical Speed (RPM)``, ``ESC signal (µs)``).
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from cfb_mjx.errors import CfbError
from cfb_mjx.logs.bench_tables import SPEED_LIMIT, MapTable, MotorRecord, check_command, from_columns
from cfb_mjx.logs.bench_tables import recognises as standard
from cfb_mjx.logs.tabular import Table, require_numbers

_GRAVITY = 9.81
_RPM = 2 * np.pi / 60
_UNITS: dict[str, dict[str, tuple[float, float]]] = {
    # To SI: factor, and what is taken off before.
    "t": {"s": (1.0, 0.0), "ms": (1e-3, 0.0), "us": (1e-6, 0.0)},
    "u": {"1": (1.0, 0.0), "%": (1e-2, 0.0), "pwm": (1 / 65535, 0.0), "us": (1e-3, 1000.0)},
    "omega": {"rad/s": (1.0, 0.0), "rpm": (_RPM, 0.0)},
    "force": {
        "n": (1.0, 0.0),
        "mn": (1e-3, 0.0),
        "g": (1e-3 * _GRAVITY, 0.0),
        "gf": (1e-3 * _GRAVITY, 0.0),
        "kg": (_GRAVITY, 0.0),
        "kgf": (_GRAVITY, 0.0),
    },
    "torque": {"nm": (1.0, 0.0), "mnm": (1e-3, 0.0), "nmm": (1e-3, 0.0)},
    "vbat": {"v": (1.0, 0.0), "mv": (1e-3, 0.0)},
}
# Names without blanks, in the order in which they are preferred, and the unit where the header gives none.
_NAMES: dict[str, tuple[tuple[str, str], ...]] = {
    "t": (("t", "s"), ("time", "s"), ("timestamp", "s")),
    "u": (("u", "1"), ("command", "1"), ("duty", "1"), ("pwm", "pwm"), ("throttle", "%"), ("escsignal", "us")),
    "omega": (
        ("omega", "rad/s"),
        ("rpm", "rpm"),
        ("motoropticalspeed", "rpm"),
        ("rotationalspeed", "rpm"),
        ("rotationspeed", "rpm"),
        ("motorspeed", "rpm"),
        ("motorelectricalspeed", "rpm"),
    ),
    "force": (("force", "n"), ("thrust", "n"), ("weight", "g"), ("load", "g"), ("lift", "g")),
    "torque": (("torque", "nm"),),
    "vbat": (("vbat", "v"), ("voltage", "v"), ("v", "v"), ("battery", "v")),
}
_MOTOR = re.compile(r"(?P<name>[a-z]+?)_?(?P<motor>[1-4])?")
_LEAST_COMMAND = 0.05
_DEAD = 0.5  # of the rows under command: with more zeros than that a sensor tells nothing
_STEP, _STEPS, _AFTER, _ANSWERED = 0.05, 3, 5, 0.05
_SETTLED = 0.01  # of the speed over 0.1 s: faster changes are not steady


@dataclass(frozen=True)
class SteadyPoints:
    """Commands and the speeds the rotors settle at, without time.

    Attributes:
        name: file name without its ending.
        command: (n,) in [0, 1].
        rotor_speed: (n,) rad/s.
        battery_voltage: (n,) V, or None.
    """

    name: str
    command: np.ndarray
    rotor_speed: np.ndarray
    battery_voltage: np.ndarray | None


class Bench(NamedTuple):
    """What one file holds, and what was done to read it."""

    parts: list[MotorRecord | MapTable | SteadyPoints]
    notes: list[str]


def recognises(table: Table) -> bool:
    """Whether the columns are a bench table's rather than a flight's, under any of the known names."""
    if any(c in table for c in ("px", "qw", "wx", "ax", "ros_timestamp_x")):
        return False
    found = {key for key, _ in _columns(table)}
    return standard(table) or bool({"force", "omega"} <= found or {"force", "u"} <= found or {"omega", "u"} <= found)


def read_bench_table(table: Table, path: Path, rotors: int | None = None) -> Bench:
    """What a bench table holds: command steps, steady points, thrust and torque.

    Args:
        table: as read.
        path: named in messages.
        rotors: of how many rotors the force and torque are. None: of four where several rotors' speeds stand beside one
            force, else of one.

    Raises:
        CfbError: as `bench_tables.read_bench`; or nothing can be told from the columns.
    """
    found = _columns(table)
    steady = "t" not in table and {"u", "omega"} <= set(table) and not {"force", "torque"} & set(table)
    if standard(table) and not steady and not any(name not in _STANDARD for _, name in found if name in table):
        part, notes = from_columns(table, path), []
        if isinstance(part, MotorRecord):
            part = _command_before(part, notes)
        elif rotors not in (None, 1):
            part = _of_one(part, rotors)
        return Bench([part], notes)
    notes: list[str] = []
    si, names = _in_si(table, found, path)
    speeds = {key: si[key] for key in si if re.fullmatch(r"omega[1-4]?", key)}
    if not speeds:
        raise CfbError(
            f"{path}: has no rotor speed (a column rpm1..rpm4 or omega), and thrust against command alone tells "
            "neither the motors nor the rotors; measure the speed too."
        )
    command = {key: si[key] for key in si if re.fullmatch(r"u[1-4]?", key)}
    _refuse_commands_as_speed(speeds, names, path)
    speeds = _living(speeds, command, names, path, notes)
    return Bench(_parts(si, speeds, command, path, rotors, names, notes), notes)


_STANDARD = frozenset(
    [
        "t",
        "u",
        "omega",
        "force",
        "torque",
        "motor",
        *(f"u{i}" for i in range(1, 5)),
        *(f"omega{i}" for i in range(1, 5)),
    ]
)


def _columns(table: Table) -> list[tuple[str, str]]:
    """What each column is, and its name; of two columns for one thing the preferred one."""
    best: dict[str, tuple[int, str]] = {}
    for column in table:
        bare, _ = _bare(column)
        match = _MOTOR.fullmatch(bare)
        if match is None:
            continue
        for key, names in _NAMES.items():
            rank = next((i for i, (name, _) in enumerate(names) if name == match["name"]), None)
            if rank is None or (match["motor"] and key not in ("u", "omega")):
                continue
            full = key + (match["motor"] or "")
            if full not in best or rank < best[full][0]:
                best[full] = rank, column
    return [(key, column) for key, (_, column) in best.items()]


def _bare(column: str) -> tuple[str, str | None]:
    """A header without its unit, and the unit."""
    text = re.sub(r"^powertrain ?\d+ ?[-:] ?", "", column.strip().lower().replace("µ", "u").replace("μ", "u"))
    match = re.fullmatch(r"(?P<name>.*?)\s*[\[(](?P<unit>[^\])]*)[\])]\s*", text)
    name, unit = (match["name"], match["unit"]) if match else (text, None)
    unit = None if unit is None else re.sub(r"[\s·⋅*.]", "", unit)
    return re.sub(r"\s", "", name), unit


def _in_si(table: Table, found: list[tuple[str, str]], path: Path) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    require_numbers(table, [column for _, column in found], path)
    si, names = {}, {}
    for key, column in found:
        kind = key.rstrip("1234")
        bare, unit = _bare(column)
        default = dict(_NAMES[kind])[_MOTOR.fullmatch(bare)["name"]]
        known = _UNITS[kind]
        unit = default if unit is None else unit
        if unit not in known:
            raise CfbError(f"{path}: column {column} is in {unit}, which is none of {', '.join(known)}; convert it.")
        factor, zero = known[unit]
        values = np.asarray(table[column], float)
        # Duty of 0 to 1 under the name pwm.
        if unit == "pwm" and np.nanmax(np.abs(values), initial=0.0) <= 1.001:
            factor = 1.0
        si[key], names[key] = (values - zero) * factor, column
    return si, names


def _refuse_commands_as_speed(speeds: dict[str, np.ndarray], names: dict[str, str], path: Path) -> None:
    for key, values in speeds.items():
        known = values[np.isfinite(values)]
        if len(known) and np.median(known) > 0.8 * SPEED_LIMIT and known.max() > SPEED_LIMIT:
            raw = known / _RPM
            hint = "multiply it by 2 pi / 60" if not names[key].lower().startswith("rpm") else "it is in another unit"
            if names[key].lower().startswith("rpm") and raw.max() <= 65535.5:
                hint = "these look like 16-bit commands; name the column pwm, and measure the speed too"
            raise CfbError(
                f"{path}: column {names[key]} reaches {known.max():.0f} rad/s ({raw.max():.0f} rpm), which no rotor of "
                f"this size turns; {hint}."
            )


def _living(speeds, command, names, path: Path, notes: list[str]) -> dict[str, np.ndarray]:
    """The speeds of sensors that read something; single zeros under command become NaN."""
    on = _mean(command) > 2 * _LEAST_COMMAND if command else _mean(speeds) > 100.0
    living = {}
    for key, values in speeds.items():
        lost = (values == 0) & on
        share = float(lost[on].mean()) if on.any() else 0.0
        if share > _DEAD:
            notes.append(
                f"{path.name}: {names[key]} reads 0 in {share:.0%} of the rows under command and was left out."
            )
            continue
        if lost.any():
            notes.append(f"{path.name}: {int(lost.sum())} readings of 0 under command in {names[key]} were left out.")
        living[key] = np.where(lost, np.nan, values)
    if not living:
        raise CfbError(f"{path}: no rotor speed sensor reads anything under command; repair it and measure again.")
    return living


def _mean(columns: dict[str, np.ndarray]) -> np.ndarray:
    return np.nanmean(np.stack(list(columns.values()), axis=1), axis=1)


def _parts(si, speeds, command, path: Path, rotors, names, notes) -> list[MotorRecord | MapTable | SteadyPoints]:
    parts: list[MotorRecord | MapTable | SteadyPoints] = []
    steady = np.ones(len(next(iter(speeds.values()))), dtype=bool)
    numbers = {key: int(key[5:] or 0) for key in speeds}
    if command and "t" in si:
        table = {"t": si["t"]} | {f"omega{numbers[k] or ''}": v for k, v in speeds.items()}
        table |= {k: np.clip(v, 0, None) for k, v in command.items()}
        parts.append(_command_before(from_columns(Table(table), path), notes))
        steady = _steady(si["t"], _mean(speeds))
    elif command:
        parts.append(_steady_points(speeds, command, si.get("vbat"), path))
    force, torque = si.get("force"), si.get("torque")
    if force is not None and not (np.abs(force) > 0).any():
        notes.append(f"{path.name}: {names['force']} is 0 in every row, so the scale was not read; it was left out.")
        force = None
    if force is None and torque is None:
        return parts
    count = rotors or (4 if len(si.keys() & {f"omega{i}" for i in range(1, 5)}) > 1 else 1)
    # With thrust as the square of the speed, the root of the mean square is what carries the mean thrust.
    speed = np.sqrt(np.nanmean(np.stack(list(speeds.values()), axis=1) ** 2, axis=1))
    good = steady & np.isfinite(speed)
    for values in (force, torque):
        good &= np.isfinite(values) if values is not None else True
    if command:
        good &= _mean(command) > _LEAST_COMMAND
    if count > 1:
        notes.append(f"{path.name}: {names.get('force', names.get('torque'))} is what {count} rotors give together.")
    table = {"omega": speed[good]}
    if force is not None:
        table["force"] = force[good] / count
    if torque is not None:
        table["torque"] = np.abs(torque[good]) / count
    return [*parts, from_columns(Table(table), path)]


def _command_before(record: MotorRecord, notes: list[str]) -> MotorRecord:
    """The record with every command in the row from which it acts.

    Some scripts write a command, wait, and then write the row: the speed in it has already answered. A command that
    acts from its row on cannot have moved the speed there.
    """
    moved = []
    for u, speed in zip(record.command.T, record.rotor_speed.T, strict=True):
        step = np.flatnonzero(np.abs(np.diff(u)) > _STEP)
        step = step[(step > 0) & (step < len(u) - _AFTER)]
        before, at = np.abs(speed[step] - speed[step - 1]), np.abs(speed[step + 1] - speed[step])
        final = np.abs(speed[np.minimum(step + _AFTER, len(u) - 1)] - speed[step])
        moved.append((at - before) / np.maximum(final, 1.0))
    moved = np.concatenate(moved)
    if len(moved) < _STEPS or not np.nanmedian(moved) > _ANSWERED:
        return record
    notes.append(
        f"{record.name}: the speed answers in the very row of a new command, so each row's command is the one that "
        "led to it; it was moved to the row before."
    )
    return MotorRecord(record.name, record.time[:-1], record.command[1:], record.rotor_speed[:-1], record.motors)


def _of_one(part: MapTable, rotors: int) -> MapTable:
    force, torque = (None if x is None else x / rotors for x in (part.force, part.torque))
    return MapTable(part.name, part.rotor_speed, force, torque, part.motor)


def _steady(time: np.ndarray, speed: np.ndarray) -> np.ndarray:
    """Rows whose speed has hardly changed for a tenth of a second."""
    row = np.searchsorted(time, time - 0.1)
    change = np.abs(speed - speed[row])
    return (time - time[0] > 0.1) & (change <= _SETTLED * np.abs(speed)) if len(time) > 1 else np.ones(1, bool)


def _steady_points(speeds, command, voltage, path: Path) -> SteadyPoints:
    """One point a row: the median of its rotors, which one that is counted double does not move."""
    omega = np.nanmedian(np.stack(list(speeds.values()), axis=1), axis=1)
    u = _mean(command)
    good = np.isfinite(omega) & np.isfinite(u) & (u > _LEAST_COMMAND)
    if voltage is not None:
        good &= np.isfinite(voltage) & (voltage > 0)
    u, omega = u[good], omega[good]
    if len(u):
        check_command(u, list(command), path)
    return SteadyPoints(path.stem, u, omega, None if voltage is None else voltage[good])
