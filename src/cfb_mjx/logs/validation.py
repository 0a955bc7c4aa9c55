"""Validation of a log: order of time, missing values, units and axis conventions."""

from __future__ import annotations

import os

import numpy as np

from cfb_mjx.errors import CfbError
from cfb_mjx.logs import gate, motor_checks, rotation
from cfb_mjx.logs.flight_log import FlightLog
from cfb_mjx.logs.tabular import COLUMNS, OPTIONAL_COLUMNS

_NORM_TOLERANCE = 0.05
_COMMAND_TOLERANCE = 1e-3
# rad/s. No Crazyflie rotor turns faster than about 2900 rad/s, so twice that is another unit or a damaged packet.
_ROTOR_SPEED_LIMIT = 6000.0
_BEHIND = 20  # most rows per step back in time that can be rows out of order; more are another recording
_FASTEST = 2.2e-4  # s between rows; no sensor of a Crazyflie is read at more than 4000 Hz
# Impossible beyond these limits: an arena of 10 km, twice the range of gyro and accelerometer.
_LIMITS = {"position": 1e4, "velocity": 60.0, "body_rate": 70.0, "specific_force": 320.0}
_UNITS = {"position": "m", "velocity": "m/s", "body_rate": "rad/s", "specific_force": "m/s^2"}


def validate(log: FlightLog, path: str | os.PathLike) -> FlightLog:
    """Check a log and normalise it, as `examine` does; returns the log only.

    Args:
        log: the log as read.
        path: the file, for messages.

    Raises:
        CfbError: the log is refused; `examine` lists the reasons.
    """
    return examine(log, path)[0]


def examine(log: FlightLog, path: str | os.PathLike) -> tuple[FlightLog, gate.Verdict]:
    """Check a log, normalise its quaternions (unit norm, continuous sign) and clip its commands to [0, 1].

    Args:
        log: the log as read.
        path: the file, for messages.

    Returns:
        The log, and the result of comparing its signals with each other. If they contradict each other and no change
        of convention makes them agree, a warning in the log's metadata says so.

    Raises:
        CfbError: fewer than two rows; time that does not increase; NaN or infinity in a required column; quaternions
            more than 5 % from unit norm; values out of range; signals that contradict each other, if a change of unit,
            axes or order makes them agree (see `cfb_mjx.logs.gate`).
    """

    def fail(problem: str):
        raise CfbError(f"{path}: {problem}.")

    if len(log) < 2:
        fail(f"the log has {len(log)} row{'s' * (len(log) != 1)}, at least 2 are needed; export more of the flight")
    _finite(log, fail)
    _time(log, fail)
    _quaternion_norm(log, fail)
    _command(log, fail)
    _rotor_speed(log, fail)
    if log.battery_voltage is not None and np.median(log.battery_voltage) > 100.0:
        fail(
            f"vbat has a median of {np.median(log.battery_voltage):.0f}, which looks like millivolts; divide it by 1000"
        )
    log = log.replace(quaternion=rotation.tidy(log.quaternion), command=np.clip(log.command, 0.0, 1.0))
    with np.errstate(over="ignore", invalid="ignore"):
        verdict = gate.judge(log)
    if verdict.remedy or (verdict.problem and verdict.certain):
        fail(verdict.sentence())
    _magnitudes(log, fail)
    if verdict.problem:
        said = f"signals contradict each other: {verdict.problem}; no change of unit, axes or order makes them agree."
        if said not in (log.metadata.get("warnings") or ()):
            log = log.replace(metadata={"warnings": [*(log.metadata.get("warnings") or ()), said]})
    return log, verdict


def _at(log: FlightLog, row: int) -> str:
    return f"row {row} (counted from 0; t = {log.time[row]:.6g} s)"


def _finite(log: FlightLog, fail) -> None:
    for field, names in (COLUMNS | OPTIONAL_COLUMNS).items():
        values = getattr(log, field)
        if values is None:
            continue
        # Only a rotor speed may be NaN (invalid sample).
        bad = np.isinf(values) if field == "rotor_speed" else ~np.isfinite(values)
        bad = bad.reshape(len(log), -1)
        if bad.any():
            row = int(np.argmax(bad.any(axis=1)))
            column = int(np.argmax(bad[row]))
            what = "an infinite value" if np.isinf(values.reshape(len(log), -1)[row, column]) else "no value (NaN)"
            fail(
                f"column {names[column]} has {what} in {_at(log, row)} ({int(bad.any(axis=1).sum())} rows in all); "
                "drop those rows (a gap is handled) or repair them"
            )


def _time(log: FlightLog, fail) -> None:
    steps = np.diff(log.time)
    if (steps <= 0).any():
        row = int(np.argmax(steps <= 0)) + 1
        kind = "repeats the time of" if steps[row - 1] == 0 else "is earlier than"
        back = np.flatnonzero(steps < 0)
        behind = int((log.time < np.maximum.accumulate(log.time)).sum())
        if len(back) and behind > _BEHIND * len(back):
            # Sorting by time would interleave two recordings, so do not suggest it.
            ends = f"from {log.time[back[0]]:.6g} to {log.time[back[0] + 1]:.6g} s in row {back[0] + 1}"
            fail(
                f"t goes back {ends} (counted from 0; {len(back)} times in all), so the file holds several recordings "
                "or its clock overflowed; split it there and import the parts one by one"
            )
        fail(f"{_at(log, row)} {kind} the row before it; sort the rows by t and drop duplicates")
    median = float(np.median(steps))
    if median >= 0.5:
        unit, factor = ("milli", "1e3") if median < 500 else ("micro", "1e6") if median < 5e5 else ("nano", "1e9")
        flag = f"{unit[0] if unit != 'micro' else 'u'}s"
        fail(
            f"the median interval of t is {median:g} s, so t looks like {unit}seconds; divide it by {factor} (--fix "
            f"time-unit={flag})"
        )
    if median < _FASTEST:
        fits = [u for u, s in (("min", 60.0), ("h", 3600.0)) if _FASTEST * 5 <= median * s <= 0.2]
        hint = (
            f", so t looks like {dict(min='minutes', h='hours')[fits[0]]} (--fix time-unit={fits[0]})" if fits else ""
        )
        fail(f"the median interval of t is {median:.3g} s, faster than any log{hint}; give t in seconds")


def _quaternion_norm(log: FlightLog, fail) -> None:
    norm = np.linalg.norm(log.quaternion, axis=1)
    bad = np.abs(norm - 1.0) > _NORM_TOLERANCE
    if bad.any():
        row = int(np.argmax(bad))
        fail(
            f"the quaternion in {_at(log, row)} has norm {norm[row]:.3g} ({int(bad.sum())} rows are off); "
            "the quaternion columns qw qx qy qz must be [w, x, y, z], unit"
        )


def _command(log: FlightLog, fail) -> None:
    low, high = float(log.command.min()), float(log.command.max())
    if low >= -_COMMAND_TOLERANCE and high <= 1.0 + _COMMAND_TOLERANCE:
        return
    if low >= -_COMMAND_TOLERANCE and float(np.median(log.command)) > 1.0:
        force = float(np.median(np.linalg.norm(log.specific_force, axis=1)))
        looks = motor_checks.command_unit(log.command, force if force > 1.0 else 9.81)
        if looks is not None:
            fail(f"u1..u4 reach {high:.4g}: they {looks}")
    row, motor = np.unravel_index(int(np.argmax(np.abs(log.command - 0.5))), log.command.shape)
    fail(
        f"u{motor + 1} is {log.command[row, motor]:.4g} in {_at(log, int(row))}, outside [0, 1]; "
        "scale the commands to duty or clip them as the ESC does"
    )


def _rotor_speed(log: FlightLog, fail) -> None:
    if log.rotor_speed is None:
        return
    speed = np.where(np.isnan(log.rotor_speed), 0.0, log.rotor_speed)
    if (speed < 0).any():
        row, motor = np.unravel_index(int(np.argmax(speed < 0)), speed.shape)
        fail(
            f"omega{motor + 1} is negative in {_at(log, int(row))}; rotor speeds are magnitudes in rad/s, drop the sign"
        )
    if speed.max() <= _ROTOR_SPEED_LIMIT:
        return
    # The median distinguishes a wrong unit from a few damaged packets.
    turning = speed[speed > 0]
    if np.median(turning) > _ROTOR_SPEED_LIMIT:
        unit, factor = ("rpm", "2 pi / 60") if np.median(turning) < 4e4 else ("electrical rpm", "2 pi / 360 (12 poles)")
        fail(f"omega1..omega4 have a median of {np.median(turning):.0f}, which looks like {unit}; multiply by {factor}")
    row, motor = np.unravel_index(int(np.argmax(speed)), speed.shape)
    fail(
        f"omega{motor + 1} is {speed[row, motor]:.0f} rad/s in {_at(log, int(row))}, faster than any rotor turns; "
        "leave invalid samples empty (NaN)"
    )


def _magnitudes(log: FlightLog, fail) -> None:
    for field, limit in _LIMITS.items():
        values = np.abs(getattr(log, field))
        if values.max() > limit:
            row = int(np.argmax(values.max(axis=1)))
            rows = int((values > limit).any(axis=1).sum())
            fail(
                f"{field.replace('_', ' ')} reaches {values.max():.4g} {_UNITS[field]} in {_at(log, row)}, which no "
                f"flight has ({rows} rows in all); drop those rows, or give the right unit"
            )
