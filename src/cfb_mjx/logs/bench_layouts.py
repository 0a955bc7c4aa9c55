"""Read bench tables with the column names of common programs, and convert them to the layouts of `bench_tables`.

The known names are those of Bitcraze's system identification and of labs that use it (``pwm, vbat[V], rpm1..4,
thrust[g]``, the whole vehicle on a scale; with ``weight[g]``, ``i[A]``, ``p[W]``; with ``time[ms]`` and steps of the
command), and those of exports of RCbenchmark and Tyto (``Thrust (N)``, ``Motor Optical Speed (RPM)``,
``ESC signal (µs)``).
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from cfb_mjx.errors import CfbError
from cfb_mjx.logs.bench_tables import (
    FORCE_LIMIT,
    LEAST_COMMAND,
    SPEED_LIMIT,
    MapTable,
    MotorRecord,
    SteadyPoints,
    ThrustPoints,
    from_columns,
    mean_of,
    steady_points,
    thrust_points,
)
from cfb_mjx.logs.bench_tables import recognises as standard
from cfb_mjx.logs.tabular import Table, require_numbers
from cfb_mjx.optional import not_none

GRAVITY = 9.81
RPM = 2 * np.pi / 60
_UNITS: dict[str, dict[str, tuple[float, float]]] = {
    # Unit to (factor, offset): SI = (value - offset) * factor.
    "t": {"s": (1.0, 0.0), "ms": (1e-3, 0.0), "us": (1e-6, 0.0)},
    "u": {"1": (1.0, 0.0), "%": (1e-2, 0.0), "pwm": (1 / 65535, 0.0), "us": (1e-3, 1000.0)},
    "omega": {"rad/s": (1.0, 0.0), "rpm": (RPM, 0.0), "hz": (2 * np.pi, 0.0), "rev/s": (2 * np.pi, 0.0)},
    "force": {
        "n": (1.0, 0.0),
        "mn": (1e-3, 0.0),
        "g": (1e-3 * GRAVITY, 0.0),
        "gf": (1e-3 * GRAVITY, 0.0),
        "kg": (GRAVITY, 0.0),
        "kgf": (GRAVITY, 0.0),
        "lbf": (4.4482216, 0.0),
        "ozf": (0.27801385, 0.0),
    },
    "torque": {
        "nm": (1.0, 0.0),
        "mnm": (1e-3, 0.0),
        "nmm": (1e-3, 0.0),
        "gfcm": (9.80665e-5, 0.0),
        "kgfcm": (9.80665e-2, 0.0),
        "ozfin": (7.0615518e-3, 0.0),
        "lbfin": (0.11298483, 0.0),
    },
    "vbat": {"v": (1.0, 0.0), "mv": (1e-3, 0.0)},
}
# Names without blanks, the preferred one first, each with its unit if the header has none.
_NAMES: dict[str, tuple[tuple[str, str], ...]] = {
    "t": (("t", "s"), ("time", "s"), ("timestamp", "s")),
    "u": (
        ("u", "1"),
        ("command", "1"),
        ("duty", "1"),
        ("pwm", "pwm"),
        ("throttle", "%"),
        ("escsignal", "us"),
        ("escthrottle", "us"),
        ("esc", "us"),
    ),
    "omega": (
        ("omega", "rad/s"),
        ("rpm", "rpm"),
        ("motoropticalspeed", "rpm"),
        ("rotationalspeed", "rpm"),
        ("rotationspeed", "rpm"),
        ("motorspeed", "rpm"),
        ("motorelectricalspeed", "rpm"),
    ),
    "force": (("force", "n"), ("thrust", "n"), ("forcefz", "n"), ("weight", "g"), ("load", "g"), ("lift", "g")),
    "torque": (("torque", "nm"), ("torquemz", "nm")),
    "vbat": (("vbat", "v"), ("voltage", "v"), ("v", "v"), ("battery", "v")),
}
_NUMBERED = re.compile(r"(?P<name>[a-z]+?)_?(?P<motor>[1-4])?")
_UNIT_AT_END = re.compile(r"(?P<name>.*?)\s*[\[(](?P<unit>[^\[\]()]*)[\])]\s*")
_LETTERS = {"µ": "u", "μ": "u"}  # micro sign and Greek letter
_SENSORS_APART = 0.02  # relative difference allowed between two sensors of the same speed


class _Header(NamedTuple):
    name: str
    unit: str | None
    stand: str
    """Powertrain or side of the test stand; empty if the header does not name one."""


class Columns(NamedTuple):
    """Columns in SI.

    Attributes:
        values: columns by ``t``, ``u``, ``omega``, ``force``, ``torque``, ``vbat``; numbered ones by ``u1``, ``omega1``
        names: the same keys to the column's name in the file, for messages.
        unit_said: the keys whose unit is given in the header.
    """

    values: dict[str, np.ndarray]
    names: dict[str, str]
    unit_said: frozenset[str]


def keys_of(table: Table) -> dict[str, list[str]]:
    """Quantities of a table (keys as in `Columns`) to the columns that hold them, the preferred one first."""
    found: dict[str, list[tuple[int, str]]] = {}
    for column in table:
        match = _NUMBERED.fullmatch(_header(column).name)
        if match is None:
            continue
        for key, names in _NAMES.items():
            rank = next((i for i, (name, _) in enumerate(names) if name == match["name"]), None)
            if rank is not None and not (match["motor"] and key not in ("u", "omega")):
                found.setdefault(key + (match["motor"] or ""), []).append((rank, column))
    return {key: [column for _, column in sorted(columns, key=lambda c: c[0])] for key, columns in found.items()}


def in_si(table: Table, path: Path, notes: list[str]) -> Columns:
    """The recognised columns, in SI. Of several columns for one quantity, the preferred one with nonzero readings.

    Args:
        table: the table as read.
        path: the file, for messages.
        notes: receives disagreements between sensors of the same speed.

    Raises:
        CfbError: several powertrains side by side, cells that are not numbers, an unknown unit.
    """
    found = keys_of(table)
    stands = sorted({_header(c).stand for columns in found.values() for c in columns} - {""})
    if len(stands) > 1:
        raise CfbError(
            f"{path}: holds {len(stands)} powertrains side by side ({', '.join(stands)}); keep the columns of one."
        )
    require_numbers(table, [column for columns in found.values() for column in columns], path)
    values, names, said = {}, {}, set()
    for key, columns in found.items():
        readings = {column: _converted(table, key, column, path) for column in columns}
        lively = {column: float(np.mean(np.nan_to_num(v) != 0)) if len(v) else 0.0 for column, v in readings.items()}
        chosen = next(c for c in columns if lively[c] >= max(lively.values()) / 2)
        if key.startswith("omega"):
            _compare(chosen, {c: v for c, v in readings.items() if lively[c] > 0}, path, notes)
        values[key], names[key] = readings[chosen], chosen
        if _header(chosen).unit is not None:
            said.add(key)
    return Columns(values, names, frozenset(said))


def _header(column: str) -> _Header:
    text = column.strip().lower()
    for letter, plain in _LETTERS.items():
        text = text.replace(letter, plain)
    stand, dash, rest = text.partition(" - ")
    stand, text = (stand, rest) if dash else ("", text)
    match = _UNIT_AT_END.fullmatch(text)
    name, unit = (match["name"], match["unit"]) if match else (text, None)
    unit = None if unit is None else re.sub(r"[\s·⋅*.]", "", unit)
    # Brackets before the unit explain the name: "force Fz (thrust) (N)".
    name = re.sub(r"[\[(][^\[\]()]*[\])]", "", name)
    side = re.fullmatch(r"(?P<name>.{3,}?) (?P<side>[ab])", name.strip())
    if side and not stand:
        name, stand = side["name"], side["side"]
    return _Header(re.sub(r"\s", "", name), unit, stand)


def _converted(table: Table, key: str, column: str, path: Path) -> np.ndarray:
    kind, header = key.rstrip("1234"), _header(column)
    default = dict(_NAMES[kind])[not_none(_NUMBERED.fullmatch(header.name))["name"]]
    known, unit = _UNITS[kind], default if header.unit is None else header.unit
    if unit not in known:
        raise CfbError(f"{path}: column {column} is in {unit}, which is not one of {', '.join(known)}; convert it.")
    factor, zero = known[unit]
    values = np.asarray(table[column], float)
    # A column named pwm may hold a duty of 0 to 1.
    if unit == "pwm" and np.nanmax(np.abs(values), initial=0.0) <= 1.001:
        factor = 1.0
    return (values - zero) * factor


def _compare(chosen: str, readings: dict[str, np.ndarray], path: Path, notes: list[str]) -> None:
    """Add a note if two sensors of the same speed disagree, which means a wrong number of poles or marks."""
    for column, values in readings.items():
        both = (values > 0) & (readings[chosen] > 0)
        if column == chosen or both.sum() < 3:
            continue
        ratio = float(np.median(values[both] / readings[chosen][both]))
        if abs(ratio - 1) > _SENSORS_APART:
            notes.append(
                f"{path.name}: {column} reads {ratio:.3f} times {chosen}, which was used; one of them has a wrong "
                "number of poles or marks."
            )


_DEAD = 0.5  # share of zeros in the rows under command above which a sensor is left out
_STEP, _STEPS, _AFTER, _ANSWERED = 0.05, 3, 5, 0.05  # see `_command_before`
_APART = 0.1  # s; rows further apart do not resolve a motor, whose time constant is about 0.05 s
_BACK_ROWS = 5  # rows with time running backwards that are left out without an error
_SETTLED = 0.01  # relative change of the speed in 0.1 s below which it counts as steady


class Bench(NamedTuple):
    """Content of one file, and notes of what was done to read it."""

    parts: Sequence[MotorRecord | MapTable | SteadyPoints | ThrustPoints]
    notes: list[str]


def recognises(table: Table) -> bool:
    """Whether the columns are those of a bench table (under any of the known names), not of a flight."""
    if any(c in table for c in ("px", "qw", "wx", "ax", "ros_timestamp_x")):
        return False
    found = set(keys_of(table))
    return standard(table) or bool({"force", "omega"} <= found or {"force", "u"} <= found or {"omega", "u"} <= found)


def read_bench_table(table: Table, path: Path, rotors: int | None = None) -> Bench:
    """Content of a bench table: command steps, steady points, thrust and torque.

    Args:
        table: the table as read.
        path: the file, for messages.
        rotors: number of rotors that produce the measured force and torque. None: four if the table has speeds of
            several rotors, else one.

    Raises:
        CfbError: as `bench_tables.read_bench`, or the columns are not sufficient.
    """
    known = [column for columns in keys_of(table).values() for column in columns]
    steady = "t" not in table and {"u", "omega"} <= set(table) and not {"force", "torque"} & set(table)
    if standard(table) and not steady and _STANDARD.issuperset(known):
        part, notes = from_columns(table, path), []
        if isinstance(part, MotorRecord):
            part = _command_before(part, notes)
        elif rotors not in (None, 1):
            part = _of_one(part, rotors)
        return Bench([part], notes)
    notes: list[str] = []
    columns = in_si(table, path, notes)
    si, names = columns.values, columns.names
    if not any(re.fullmatch(r"omega[1-4]?", key) for key in si):
        command = {key: v for key, v in si.items() if re.fullmatch(r"u[1-4]?", key)}
        if command and "force" in si:
            return Bench([thrust_points(command, si["force"], path)], notes)
        raise CfbError(
            f"{path}: has no rotor speed (a column rpm1..rpm4 or omega) and no thrust against command, so neither "
            "motors nor rotors can be fitted; measure the speed too."
        )
    si = _in_time(columns, path, notes)
    speeds = {key: si[key] for key in si if re.fullmatch(r"omega[1-4]?", key)}
    command = {key: si[key] for key in si if re.fullmatch(r"u[1-4]?", key)}
    _refuse_commands_as_speed(speeds, names, path)
    speeds = _living(speeds, command, names, path, notes)
    return Bench(_parts(si, speeds, command, path, rotors, columns, notes), notes)


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


def _refuse_commands_as_speed(speeds: dict[str, np.ndarray], names: dict[str, str], path: Path) -> None:
    for key, values in speeds.items():
        known = values[np.isfinite(values)]
        if len(known) and np.median(known) > 0.8 * SPEED_LIMIT and known.max() > SPEED_LIMIT:
            raw = known / RPM
            hint = "multiply it by 2 pi / 60" if not names[key].lower().startswith("rpm") else "give the right unit"
            if names[key].lower().startswith("rpm") and raw.max() <= 65535.5:
                hint = "these look like 16-bit commands; name the column pwm, and give a table with the speeds as well"
            raise CfbError(
                f"{path}: column {names[key]} reaches {known.max():.0f} rad/s ({raw.max():.0f} rpm), faster than any "
                f"rotor of this size; {hint}."
            )


def _in_time(columns: Columns, path: Path, notes: list[str]) -> dict[str, np.ndarray]:
    """Rows in order of time, with gaps of sensors filled; without ``t`` if each row is a separate measurement."""
    si = dict(columns.values)
    if "t" in si:
        latest = np.maximum.accumulate(np.concatenate([[-np.inf], si["t"][:-1]]))
        forward = si["t"] > latest
        late = int(len(forward) - forward.sum())
        if 0 < late <= max(_BACK_ROWS, 0.02 * len(forward)):
            notes.append(f"{path.name}: {late} rows whose time does not increase were left out.")
            si = {key: values[forward] for key, values in si.items()}
        step = float(np.median(np.diff(si["t"]))) if len(si["t"]) > 1 else 0.0
        if step > _APART and "t" in columns.unit_said:
            notes.append(f"{path.name}: rows are {step:.2g} s apart, so each is read as a separate steady point.")
            del si["t"]
    return _filled(si, path, notes)


def _filled(si: dict[str, np.ndarray], path: Path, notes: list[str]) -> dict[str, np.ndarray]:
    """Interpolate linearly between the readings of sensors that are read in turns, which leaves cells empty."""
    known = {key: np.isfinite(values) for key, values in si.items()}
    fewest = min(int(k.sum()) for k in known.values())
    together = int(np.all(list(known.values()), axis=0).sum())
    if fewest < 2 or together > fewest / 2:
        return si
    at = si.get("t", np.arange(len(next(iter(si.values()))), dtype=float))
    notes.append(f"{path.name}: sensors were read in turns; values between two readings were interpolated.")
    return {
        key: np.interp(at, at[known[key]], values[known[key]], left=np.nan, right=np.nan) for key, values in si.items()
    }


def _living(speeds, command, names, path: Path, notes: list[str]) -> dict[str, np.ndarray]:
    """The speeds without dead sensors. Single zeros under command become NaN."""
    on = mean_of(command) > 2 * LEAST_COMMAND if command else mean_of(speeds) > 100.0
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


def _parts(
    si, speeds, command, path: Path, rotors, columns: Columns, notes
) -> list[MotorRecord | MapTable | SteadyPoints]:
    parts: list[MotorRecord | MapTable | SteadyPoints] = []
    names = columns.names
    steady = np.ones(len(next(iter(speeds.values()))), dtype=bool)
    numbers = {key: int(key[5:] or 0) for key in speeds}
    if command and "t" in si:
        table = {"t": si["t"]} | {f"omega{numbers[k] or ''}": v for k, v in speeds.items()}
        table |= {k: np.clip(v, 0, None) for k, v in command.items()}
        record = from_columns(Table(table), path)
        assert isinstance(record, MotorRecord)  # there is a time, and neither force nor torque
        parts.append(_command_before(dataclasses.replace(record, battery_voltage=si.get("vbat")), notes))
        steady = _steady(si["t"], mean_of(speeds))
    elif command:
        parts.append(steady_points(speeds, command, si.get("vbat"), path, notes))
    force, torque = si.get("force"), si.get("torque")
    if force is not None and not (np.abs(force) > 0).any():
        notes.append(f"{path.name}: {names['force']} is 0 in every row, so the scale was not read; it was left out.")
        force = None
    if force is None and torque is None:
        return parts
    count = rotors or (4 if len(si.keys() & {f"omega{i}" for i in range(1, 5)}) > 1 else 1)
    # Thrust grows with the square of the speed, so the rms speed corresponds to the mean thrust.
    speed = np.sqrt(mean_of({key: values**2 for key, values in speeds.items()}))
    good = steady & np.isfinite(speed)
    for values in (force, torque):
        good &= np.isfinite(values) if values is not None else True
    if command:
        good &= mean_of(command) > LEAST_COMMAND
    if not good.any():
        said = f"in no row are both speed and {names.get('force', names.get('torque'))} steady"
        if not parts:
            raise CfbError(f"{path}: {said}, so nothing can be fitted; hold every command for half a second.")
        notes.append(f"{path.name}: {said}, so thrust and torque were left out.")
        return parts
    if force is not None and _pulls_down(force[good], speed[good]):
        notes.append(f"{path.name}: {names['force']} falls with speed; its sign was changed.")
        force = -force
    top = 0.0 if force is None else float(np.nanmax(np.abs(force), initial=0.0)) / count
    if top > FORCE_LIMIT and "force" in columns.unit_said:
        raise CfbError(
            f"{path}: {names['force']} comes to {top:.3g} N per rotor, more than any rotor of a Crazyflie; give a "
            "table of a Crazyflie's rotors, or correct the unit in the header."
        )
    if count > 1:
        notes.append(f"{path.name}: {names.get('force', names.get('torque'))} is the sum of {count} rotors.")
    table = {"omega": speed[good]}
    if force is not None:
        table["force"] = force[good] / count
    if torque is not None:
        table["torque"] = np.abs(torque[good]) / count
    return [*parts, from_columns(Table(table), path)]


def _pulls_down(force: np.ndarray, speed: np.ndarray) -> bool:
    if len(force) < 3 or not np.ptp(speed) > 0 or not np.ptp(force) > 0:
        return False
    fast = speed >= np.quantile(speed, 0.75)
    return bool(np.median(force[fast]) < 0 and np.corrcoef(force, speed**2)[0, 1] < -0.9)


def _command_before(record: MotorRecord, notes: list[str]) -> MotorRecord:
    """The record with every command in the row from which on it acts.

    Some scripts set a command, wait, and then write the row. The speed in that row has already responded to the
    command. If this is the case after most steps, the commands are moved to the row before.
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
        f"{record.name}: the speed responds in the same row as a new command, so each command was set before its row; "
        "it was moved to the row before."
    )
    voltage = None if record.battery_voltage is None else record.battery_voltage[:-1]
    return dataclasses.replace(
        record,
        time=record.time[:-1],
        command=record.command[1:],
        rotor_speed=record.rotor_speed[:-1],
        battery_voltage=voltage,
    )


def _of_one(part: MapTable, rotors: int) -> MapTable:
    force, torque = (None if x is None else x / rotors for x in (part.force, part.torque))
    return MapTable(part.name, part.rotor_speed, force, torque, part.motor)


def _steady(time: np.ndarray, speed: np.ndarray) -> np.ndarray:
    """Mask of the rows whose speed has hardly changed for a tenth of a second."""
    row = np.searchsorted(time, time - 0.1)
    change = np.abs(speed - speed[row])
    return (time - time[0] > 0.1) & (change <= _SETTLED * np.abs(speed)) if len(time) > 1 else np.ones(1, bool)
