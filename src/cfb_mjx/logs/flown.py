"""Selection of the rows of a recording that are measured flight.

Rows on the ground or in the hand, glitches and frozen estimates are left out. The log's notes and warnings report them.
Within the flight they leave a gap. Times keep their values, so times in messages are those of the recording.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from cfb_mjx.errors import CfbError
from cfb_mjx.logs import rotation
from cfb_mjx.logs.flight_log import FlightLog, changes, runs

_CARRIES = 0.5  # share of the hover command below which, for longer than a flip, the drone is not flying
_FLIP = 0.7  # s, longest time with low motors in flight
_CLEAR = 0.1  # m above the floor from which the drone is off the ground
_SETTLED = 0.3  # s left out after take-off and before landing, because of ground effect and contact
_SHORTEST = 0.2  # s, shortest stretch of flight that is kept
_LEAP = 0.3  # m, deviation of a step of the position from the velocity's prediction that counts as a jump
_BACK = 1.0  # s within which a jump of the motion capture may jump back
_FROZEN = 0.15  # s that an estimate may stay exactly the same
_FAR = 60.0  # a spike exceeds the typical second difference of the signal by this factor, and these absolute limits:
_STICKS_OUT = {"position": 0.05, "velocity": 0.3, "quaternion": 0.05, "body_rate": 2.0, "specific_force": 15.0}
_RARELY = 0.2  # what occurs in a larger share of the rows is a property of the file, not a fault
_UNDER_COMMAND = 0.15  # command from which a rotor must turn; a brushless one reaches a third of its speed
_SPIN_UP = 0.1  # s after which a motor under command turns


def flown_part(log: FlightLog, path: Path, keep_ground: bool = False) -> FlightLog:
    """The log without rows that are not measured flight. Its notes and warnings report what was left out.

    Args:
        log: as read, not yet validated.
        path: the file, for messages.
        keep_ground: keep rows recorded on the ground and in the hand.

    Raises:
        CfbError: the log contains no flight.
    """
    if len(log) < 2 or not (np.diff(log.time) > 0).all():
        return log  # `validate` refuses it
    notes: list[str] = []
    warnings: list[str] = []
    log = _without_lost_readings(log, warnings)
    if not keep_ground and np.isfinite(log.command).all():
        log = _airborne(log, path, notes)
    if not all(np.isfinite(getattr(log, f)).all() for f in ("position", "velocity", "quaternion")):
        return log
    log = _without(log, _leaps(log), "the position jumps by more than the velocity allows", warnings)
    log = _without(log, _spikes(log), "single rows differ strongly from both their neighbours", warnings)
    log = _without(log, _frozen(log), "position, velocity and attitude stay exactly the same", warnings)
    if not notes and not warnings:
        return log
    said = {"notes": notes, "warnings": warnings}
    return log.replace(metadata={key: [*(log.metadata.get(key) or ()), *new] for key, new in said.items()})


def without_spans(log: FlightLog, spans: Sequence[str], path: Path) -> FlightLog:
    """The log without the spans that a user wants left out.

    Args:
        log: as read.
        spans: ``A:B`` leaves out the rows from A to B (s, in the log's own time, both included); ``:B`` all up to B,
            ``A:`` all from A on.
        path: the file, for messages.

    Raises:
        CfbError: a span is invalid or contains no rows, or fewer than two rows remain.
    """
    gone = np.zeros(len(log), dtype=bool)
    for span in spans:
        first, colon, last = span.partition(":")
        try:
            begin, end = float(first or "-inf"), float(last or "inf")
        except ValueError:
            begin, end = np.inf, -np.inf
        if not (colon and (first or last) and begin <= end):
            raise CfbError(f"--cut {span}: give seconds as A:B, :B or A:, for instance --cut 12.5:15.")
        inside = (log.time >= begin) & (log.time <= end)
        if not inside.any():
            raise CfbError(
                f"{path}: --cut {span}: the log has no rows there; its times are {log.time.min():.6g} to "
                f"{log.time.max():.6g} s."
            )
        gone |= inside
    if not gone.any():
        return log
    if (~gone).sum() < 2:
        raise CfbError(f"{path}: --cut {' '.join(spans)} leaves {int((~gone).sum())} rows of {len(log)}; cut less.")
    told = f"--cut {' '.join(spans)}: {int(gone.sum())} rows were left out, as asked."
    return log.rows(~gone).replace(metadata={"notes": [*(log.metadata.get("notes") or ()), told]})


def _without_lost_readings(log: FlightLog, warnings: list[str]) -> FlightLog:
    """Replace rotor speeds of 0 under command by NaN: the rotor must be turning, so they are lost readings."""
    if log.rotor_speed is None:
        return log
    on = log.command > _UNDER_COMMAND
    row = np.arange(len(log))[:, None]
    # Time since each motor's last row without command; infinite if it has had a command since the first row.
    off = np.maximum.accumulate(np.where(on, -1, row), axis=0)
    since = np.where(off >= 0, log.time[:, None] - log.time[np.maximum(off, 0)], np.inf)
    lost = (log.rotor_speed == 0) & on & (since > _SPIN_UP)
    if not lost.any():
        return log
    told = ", ".join(f"motor {m + 1} {lost[:, m].mean():.1%}" for m in range(4) if lost[:, m].any())
    warnings.append(f"rotor speeds of 0 under command are dead readings and became NaN: {told} of the rows.")
    return log.replace(rotor_speed=np.where(lost, np.nan, log.rotor_speed))


def _airborne(log: FlightLog, path: Path, notes: list[str]) -> FlightLog:
    command, z = log.command.mean(axis=1), log.position[:, 2]
    top = float(np.percentile(command, 95))
    if top <= 0:
        raise CfbError(f"{path}: the motors are off throughout, so there is no flight in it; --keep-ground reads it.")
    carries = command >= _CARRIES * float(np.median(command[command > 0.3 * top]))
    flies, stood = carries.copy(), []
    for start, stop in runs(~carries):
        long = log.time[stop - 1] - log.time[start] > _FLIP
        flies[start:stop] = not (long or start == 0 or stop == len(log))
        if long:
            stood.append((start, stop, float(np.median(z[start:stop]))))
    keep = np.zeros(len(log), dtype=bool)
    for start, stop in runs(flies):
        before = next((floor for _, b, floor in stood if b == start), -np.inf)
        after = next((floor for a, _, floor in stood if a == stop), -np.inf)
        left = start + np.flatnonzero(z[start:stop] > before + _CLEAR)
        back = start + np.flatnonzero(z[start:stop] > after + _CLEAR)
        if not (len(left) and len(back)):
            continue  # it never left the ground
        begin = log.time[left[0]] + _SETTLED * np.isfinite(before)
        end = log.time[back[-1]] - _SETTLED * np.isfinite(after)
        inside = (log.time >= begin) & (log.time <= end)
        inside[:start] = inside[stop:] = False
        if end - begin >= _SHORTEST:
            keep |= inside
    if keep.all() or (not keep.any() and flies.all()):
        return log
    if not keep.any():
        raise CfbError(
            f"{path}: there is no flight in it: the motors are low, or the drone does not leave the ground; "
            "--keep-ground reads it anyway."
        )
    gone = log.duration - float(sum(log.time[b - 1] - log.time[a] for a, b in runs(keep)))
    notes.append(
        f"{gone:.1f} s on the ground or in the hand (motors off, standing, take-off, landing) were cut, so the log "
        f"begins at {log.time[np.argmax(keep)]:.2f} s; --keep-ground keeps them."
    )
    return log.rows(keep)


def _leaps(log: FlightLog) -> np.ndarray:
    """Rows between a jump of the position and the jump back, or next to a jump that stays."""
    bad = np.zeros(len(log), dtype=bool)
    new = np.flatnonzero(changes(log.position))
    if len(new) < 3:
        return bad
    step, moved = np.diff(log.time[new]), np.diff(log.position[new], axis=0)
    expected = (log.velocity[new[1:]] + log.velocity[new[:-1]]) / 2 * step[:, None]
    leap = np.flatnonzero((np.linalg.norm(moved - expected, axis=1) > _LEAP) & (step < log.gap_threshold * 3))
    if not len(leap) or len(leap) > 0.05 * len(new):
        return bad
    at = 0
    while at < len(leap):
        first, last = new[leap[at]] + 1, new[leap[at] + 1]
        back = at + 1 < len(leap) and log.time[new[leap[at + 1]]] - log.time[first] < _BACK
        if back:
            last = new[leap[at + 1] + 1] - 1
            at += 1
        bad[max(first - 1, 0) : last + 2] = True
        at += 1
    return bad


def _spikes(log: FlightLog) -> np.ndarray:
    """Rows in which a value differs strongly from its two neighbours, which agree: a bad packet, a changed digit."""
    bad = np.zeros(len(log), dtype=bool)
    if len(log) < 20:
        return bad
    for field, least in _STICKS_OUT.items():
        values = getattr(log, field)
        if not np.isfinite(values).all():
            continue
        if field == "quaternion":  # its sign may change from row to row
            if np.linalg.norm(values, axis=1).min() < 0.5:
                continue
            values = rotation.tidy(values)
        bend = values[1:-1] - (values[:-2] + values[2:]) / 2
        across = np.abs(values[2:] - values[:-2])
        usual = 1.4826 * np.median(np.abs(bend), axis=0)
        out = np.abs(bend) > np.maximum(_FAR * usual, least)
        bad[1:-1] |= (out & (across < 0.2 * np.abs(bend))).any(axis=1)
    return bad if bad.mean() < 0.02 else np.zeros(len(log), dtype=bool)


def _frozen(log: FlightLog) -> np.ndarray:
    """Rows in which the whole estimate stays constant for much longer than usual."""
    estimate = np.concatenate([log.position, log.velocity, log.quaternion], axis=1)
    same = ~changes(estimate)
    bad = np.zeros(len(log), dtype=bool)
    held = [(a, b, log.time[b - 1] - log.time[a - 1]) for a, b in runs(same) if a > 0]
    # If the estimate has packets of its own at a lower rate, many rows repeat it.
    usual = float(np.median([length for *_, length in held])) if same.mean() > _RARELY else 0.0
    for start, stop, length in held:
        bad[start:stop] = length > max(_FROZEN, 5 * usual)
    return bad if bad.mean() < _RARELY else np.zeros(len(log), dtype=bool)


def _without(log: FlightLog, bad: np.ndarray, what: str, warnings: list[str]) -> FlightLog:
    if not bad.any() or (~bad).sum() < 2:
        return log
    found = runs(bad)
    times, count = ", ".join(f"{log.time[a]:.2f}" for a, _ in found[:5]), len(found)
    more = f" and {count - 5} more" if count > 5 else ""
    warnings.append(f"{what}: {int(bad.sum())} rows at {times}{more} s were left out.")
    return log.rows(~bad)
