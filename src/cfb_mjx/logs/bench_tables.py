"""Read bench measurements from tables (csv or parquet): command steps, and force and torque against rotor speed.

Steady points come from held commands: rotor speed, thrust, or both joined.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cfb_mjx.errors import CfbError
from cfb_mjx.logs.flight_log import FlightLog, longest_step, stretches
from cfb_mjx.logs.tabular import Table, read_table, require_numbers

STEP_LAYOUT = "t (s), u or u1..u4 (0 to 1), omega or omega1..omega4 (rad/s)"
MAP_LAYOUT = "omega (rad/s), force (N) and/or torque (N m), optionally motor (1 to 4)"
# No Crazyflie rotor reaches 4000 rad/s, 2 N or 0.02 N m; larger values are in another unit.
SPEED_LIMIT, FORCE_LIMIT, TORQUE_LIMIT = 4000.0, 2.0, 0.02
_FLIGHT = ("px", "qw", "wx", "ax", "ros_timestamp_x")


@dataclass(frozen=True)
class MotorRecord:
    """Time series of k motors, from a flight or from a bench.

    Attributes:
        name: name of the recording, for messages.
        time: (n,) s, increasing.
        command: (n, k) in [0, 1]; a row holds until the next.
        rotor_speed: (n, k) rad/s, NaN where a reading is missing.
        motors: (k,) motor numbers 1..4; 0 if the recording does not say which.
        battery_voltage: (n,) V, voltage of the supply or the battery; None if it was not measured.
    """

    name: str
    time: np.ndarray
    command: np.ndarray
    rotor_speed: np.ndarray
    motors: tuple[int, ...]
    battery_voltage: np.ndarray | None = None

    def segments(self) -> list[slice]:
        """Stretches of rows between gaps. A gap is longer than three nominal intervals + 0.5 ms."""
        return stretches(self.time, longest_step(np.median(np.diff(self.time))))


@dataclass(frozen=True)
class MapTable:
    """Steady force and torque against rotor speed.

    Attributes:
        name: file name without its ending.
        rotor_speed: (n,) rad/s.
        force: (n,) N, or None.
        torque: (n,) N m, magnitude, or None.
        motor: (n,) motor numbers 1..4; 0 if the table does not say which.
    """

    name: str
    rotor_speed: np.ndarray
    force: np.ndarray | None
    torque: np.ndarray | None
    motor: np.ndarray


def record_of(log: FlightLog) -> MotorRecord | None:
    """Commands and rotor speeds of a flight; None if its rotor speeds were not measured."""
    if log.rotor_speed is None:
        return None
    return MotorRecord(log.name, log.time, np.clip(log.command, 0, 1), log.rotor_speed, (1, 2, 3, 4))


def recognises(table: Table) -> bool:
    """Whether the columns are those of a bench table, not of a flight."""
    if any(c in table for c in _FLIGHT):
        return False
    return "force" in table or "torque" in table or any(c == "u" or c.startswith("omega") for c in table)


def read_bench(path: str | os.PathLike) -> MotorRecord | MapTable:
    """Read and check a bench table. Its kind follows from its columns.

    Returns:
        A `MapTable` if there is a column ``force`` or ``torque``, else a `MotorRecord`.

    Raises:
        CfbError: unreadable or empty file, missing columns, missing or infinite values, time that does not increase, or
            another unit (rpm, percent, PWM, grams, millinewtons).
    """
    path = Path(path)
    return from_columns(read_table(path), path)


def from_columns(table: Table, path: Path) -> MotorRecord | MapTable:
    """`read_bench` on columns already in memory."""
    if "force" in table or "torque" in table:
        return _map(table, path)
    if "t" in table:
        return _steps(table, path)
    raise CfbError(
        f"{path}: is neither a step table with {STEP_LAYOUT} nor a map table with {MAP_LAYOUT}; "
        f"its columns are {', '.join(table)}; rename them."
    )


def _steps(table: Table, path: Path) -> MotorRecord:
    speeds = [c for c in ("omega", *(f"omega{i}" for i in range(1, 5))) if c in table]
    if not speeds or ("omega" in speeds and len(speeds) > 1):
        raise CfbError(f"{path}: needs one column omega or columns omega1..omega4; a step table holds {STEP_LAYOUT}.")
    motors = tuple(int(c[5:] or 0) for c in speeds)
    commands = [f"u{m}" if m and f"u{m}" in table else "u" for m in motors]
    if motors == (0,) and "u" not in table:
        raise CfbError(f"{path}: missing column u, the command that goes with omega; a step table holds {STEP_LAYOUT}.")
    if missing := sorted({f"u{m}" for m, c in zip(motors, commands, strict=True) if c not in table}):
        raise CfbError(f"{path}: missing column {', '.join(missing)} (or u); a step table holds {STEP_LAYOUT}.")
    require_numbers(table, ["t", *dict.fromkeys(commands), *speeds], path)
    time = table.numbers("t")
    if len(time) < 2:
        raise CfbError(f"{path}: the table has {len(time)} rows; record at least a second of steps.")
    _finite(table, ["t", *dict.fromkeys(commands)], path)
    step = np.diff(time)
    if (step <= 0).any():
        row = int(np.argmax(step <= 0)) + 1
        raise CfbError(f"{path}: t does not increase in row {row} (counted from 0); sort by t and drop duplicates.")
    if np.median(step) >= 0.5:
        raise CfbError(f"{path}: rows are {np.median(step):g} s apart, so t is probably in ms or us; convert it to s.")
    command = np.stack([table.numbers(c) for c in commands], axis=1)
    check_command(command, commands, path)
    speed = np.stack([table.numbers(c) for c in speeds], axis=1)
    _speed(speed, path)
    return MotorRecord(path.stem, time, np.clip(command, 0, 1), speed, motors)


def _map(table: Table, path: Path) -> MapTable:
    if "omega" not in table:
        raise CfbError(f"{path}: missing column omega; a map table holds {MAP_LAYOUT}.")
    used = [c for c in ("omega", "force", "torque", "motor") if c in table]
    require_numbers(table, used, path)
    if not len(table["omega"]):
        raise CfbError(f"{path}: the table has no rows; export the measurement again.")
    _finite(table, used, path)
    speed = table.numbers("omega")
    _speed(speed[:, None], path)
    force, torque, motor = (table.numbers(c) if c in table else None for c in ("force", "torque", "motor"))
    if force is not None:
        top = float(np.abs(force).max())
        if top > FORCE_LIMIT:
            unit, factor = ("millinewtons", "0.001") if top > 100 else ("grams", "0.00981")
            raise CfbError(f"{path}: force reaches {top:.3g} N, which looks like {unit}; multiply it by {factor}.")
        if np.median(force) < 0:
            raise CfbError(f"{path}: force is mostly negative; give thrust along the rotor axis as positive, in N.")
    if torque is not None:
        top = float(np.abs(torque).max())
        if top > TORQUE_LIMIT:
            raise CfbError(
                f"{path}: torque reaches {top:.3g} N m, which looks like millinewton metres; multiply it by 0.001."
            )
        if np.median(torque) < 0:
            raise CfbError(f"{path}: torque is mostly negative; give the magnitude of the drag torque, in N m.")
    if motor is None:
        motor = np.zeros(len(speed))
    elif not np.isin(motor, (1, 2, 3, 4)).all():
        raise CfbError(f"{path}: motor must be 1, 2, 3 or 4 (M1 front-right ... M4 front-left) in every row.")
    return MapTable(path.stem, speed, force, torque, motor.astype(int))


def _finite(table: Table, columns: list[str], path: Path) -> None:
    for column in columns:
        bad = ~np.isfinite(table.numbers(column))
        if bad.any():
            raise CfbError(
                f"{path}: column {column} has no finite value in row {int(np.argmax(bad))} (counted from 0; "
                f"{int(bad.sum())} rows in all); drop those rows."
            )


def check_command(command: np.ndarray, names: list[str], path: Path) -> None:
    """Check that commands lie in [0, 1]; else raise `CfbError` with the likely unit."""
    low, high = float(command.min()), float(command.max())
    if low < -1e-3:
        raise CfbError(f"{path}: {names[0]} is negative ({low:.3g}); commands lie in [0, 1].")
    if high > 1.001:
        unit, factor = ("percent", 100) if high <= 100.5 else ("raw PWM in 0..65535", 65535)
        raise CfbError(f"{path}: {names[0]} reaches {high:.4g}, which looks like {unit}; divide it by {factor}.")


def _speed(speed: np.ndarray, path: Path) -> None:
    known = speed[np.isfinite(speed)]
    if np.isinf(speed).any() or not len(known):
        raise CfbError(f"{path}: omega holds infinite values or none at all; leave missing readings empty.")
    if known.min() < 0:
        raise CfbError(f"{path}: omega is negative in places; rotor speeds are magnitudes in rad/s, drop the sign.")
    beyond = known > SPEED_LIMIT
    if beyond.mean() > 0.01:
        raise CfbError(
            f"{path}: omega reaches {known.max():.0f}, which looks like rpm; multiply it by 2 pi / 60 (0.10472)."
        )
    if beyond.any():
        raise CfbError(
            f"{path}: omega holds single readings up to {known.max():.0f} rad/s, faster than any rotor turns; "
            "drop those readings (in a step table: leave them empty)."
        )


LEAST_COMMAND = 0.05
_SAME = 0.003  # largest difference between equal commands of two tables
_REPEATED = 20  # fewest rows at one command for detecting outliers
_APART_AT_LEVEL = 0.15  # relative deviation from the typical speed that makes a reading an outlier
_AGREE = 0.4  # least share of the readings that must agree on a speed


@dataclass(frozen=True)
class SteadyPoints:
    """Commands and steady rotor speeds, without time.

    Attributes:
        name: file name without its ending.
        command: (n,) in [0, 1].
        rotor_speed: (n,) rad/s.
        battery_voltage: (n,) V, or None.
        readings: (n, k) rad/s of each of k rotors, NaN where there is no reading; None for a single rotor.
    """

    name: str
    command: np.ndarray
    rotor_speed: np.ndarray
    battery_voltage: np.ndarray | None
    readings: np.ndarray | None = None

    @property
    def rotors(self) -> int:
        """Number of rotors with a speed in each row."""
        return 1 if self.readings is None else self.readings.shape[1]


@dataclass(frozen=True)
class ThrustPoints:
    """Commands and thrust, without rotor speeds. `joined` takes the speeds from another table of the same bench.

    Attributes:
        path: the file, for messages.
        command: (n,) in [0, 1].
        force: (n,) N, of all rotors on the scale.
    """

    path: Path
    command: np.ndarray
    force: np.ndarray


def mean_of(columns: dict[str, np.ndarray]) -> np.ndarray:
    """Mean (n,) of the readings of each row; NaN if a row has none."""
    values = np.stack(list(columns.values()), axis=1)
    count = np.isfinite(values).sum(axis=1)
    return np.where(count > 0, np.nansum(values, axis=1) / np.maximum(count, 1), np.nan)


def _agreeing(readings: np.ndarray, u: np.ndarray, path: Path, notes: list[str]) -> np.ndarray:
    """Replace readings that differ from most others at the same command by NaN.

    The median of a row is not enough: if half of the sensors count blades twice for a while, it is no rotor's speed.
    """
    kept = readings.copy()
    for level in np.unique(u[np.isfinite(u)].round(4)):
        rows = np.abs(u - level) < 1e-4
        known = kept[rows]
        if rows.sum() < _REPEATED or np.isnan(known).all():
            continue
        typical = _typical(known[np.isfinite(known)])
        # Within a level, voltage sag changes the speed by some per cent.
        kept[rows] = np.where(np.abs(known - typical) < _APART_AT_LEVEL * typical, known, np.nan)
    lost = int(np.isfinite(readings).sum() - np.isfinite(kept).sum())
    if lost:
        notes.append(
            f"{path.name}: {lost} of {int(np.isfinite(readings).sum())} readings of speed differ strongly from most "
            "others at the same command, and were left out."
        )
    return kept


def steady_points(speeds, command, voltage, path: Path, notes: list[str]) -> SteadyPoints:
    """One point per row: the median speed of its rotors."""
    readings = _agreeing(np.stack(list(speeds.values()), axis=1), mean_of(command), path, notes)
    omega = np.full(len(readings), np.nan)
    read = np.isfinite(readings).any(axis=1)
    omega[read] = np.nanmedian(readings[read], axis=1)
    u = mean_of(command)
    good = np.isfinite(omega) & np.isfinite(u) & (u > LEAST_COMMAND)
    if voltage is not None:
        good &= np.isfinite(voltage) & (voltage > 0)
    u, omega, readings = u[good], omega[good], readings[good]
    if len(u):
        check_command(u, list(command), path)
    return SteadyPoints(path.stem, u, omega, None if voltage is None else voltage[good], readings)


def thrust_points(command, force: np.ndarray, path: Path) -> ThrustPoints:
    """One point per row: the mean command and the thrust. Rows with a command up to `LEAST_COMMAND` are left out."""
    u = mean_of(command)
    good = np.isfinite(u) & np.isfinite(force) & (u > LEAST_COMMAND)
    if good.any():
        check_command(u[good], list(command), path)
    return ThrustPoints(path, u[good], force[good])


def joined(thrust: ThrustPoints, steady: list[SteadyPoints], rotors: int | None, notes: list[str]) -> MapTable:
    """Thrust against rotor speed, with the speeds taken from other tables of the same bench at the same commands.

    Args:
        thrust: commands and forces.
        steady: commands and speeds.
        rotors: number of rotors on the scale; None: as many as the other tables have speeds in a row.
        notes: receives what was joined.

    Raises:
        CfbError: no other table has a speed at these commands.
    """
    each = [(s.command, s.rotor_speed[:, None] if s.readings is None else s.readings) for s in steady]
    speed = np.array(
        [
            _typical(np.concatenate([np.zeros(0), *(x[np.abs(u - command) < _SAME].ravel() for u, x in each)]))
            for command in thrust.command
        ]
    )
    good = np.isfinite(speed)
    if not good.any():
        raise CfbError(
            f"{thrust.path}: has no rotor speed (a column rpm1..rpm4 or omega), and thrust against command alone is "
            "not sufficient to fit motors or rotors; measure the speed too, or give a table that has it at the same "
            "commands."
        )
    count = rotors or max(s.rotors for s in steady)
    notes.append(
        f"{thrust.path.name}: thrust of {count} rotor{'s' * (count > 1)} at {int(good.sum())} of {len(good)} commands "
        f"at which {', '.join(s.name for s in steady)} has a speed that most readings agree on; both must have been "
        "measured with the same supply."
    )
    table = Table({"omega": speed[good], "force": thrust.force[good] / count})
    found = from_columns(table, thrust.path)
    assert isinstance(found, MapTable)  # there is a force
    return found


def _typical(readings: np.ndarray) -> float:
    """The speed on which most readings agree within 5 %; NaN if fewer than two in five do (blades counted twice)."""
    x = np.sort(readings[readings > 0])
    if not len(x):
        return float("nan")
    first, last = np.searchsorted(x, 0.95 * x), np.searchsorted(x, 1.05 * x, side="right")
    best = int(np.argmax(last - first))
    alike = x[first[best] : last[best]]
    return float(np.median(alike)) if len(alike) >= _AGREE * len(x) else float("nan")
