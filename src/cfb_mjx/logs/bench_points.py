"""Steady points of bench tables: rotor speed at a held command, thrust at a held command, and both joined."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cfb_mjx.errors import CfbError
from cfb_mjx.logs.bench_tables import MapTable, check_command, from_columns
from cfb_mjx.logs.tabular import Table

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
