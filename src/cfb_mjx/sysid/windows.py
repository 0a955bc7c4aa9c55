"""Prediction windows of a log: their starts, inputs and true values (protocol in ``docs/evaluation.md``)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cfb_mjx.logs import FlightLog
from cfb_mjx.logs.resample import interpolate

FIRST_START = 0.6
"""Start of the first window, s of log time."""
START_SPACING = 0.2
"""Time between the starts of two windows, s."""
REACH = 0.53
"""A window may start at t0 if t0 + REACH lies inside the log, s."""
ROOM = 0.03
"""Age of readings that `REACH` allows for, s; if readings are older, the last windows start earlier by the excess."""
GAP_BEFORE, GAP_AFTER = 0.3, 0.5
"""A window is skipped if a gap begins within this time before or after its start, s."""
COMMAND_TICK = 0.001
"""A command takes effect at the first tick at or after its row, because the firmware's main loop runs at 1 kHz. This
matters only for jittered time stamps (up to 3 % of an error)."""
LONGEST_STEP = 0.0051
"""Maximum integration step, s; longer intervals between rows are divided into equal substeps."""


@dataclass(frozen=True)
class Windows:
    """Inputs and true values of W predictions of S steps; short windows end in steps of length 0.

    Attributes:
        start: (W,) window starts t0, s of log time.
        position: (W, 3) measured at t0, m.
        velocity: (W, 3) measured at t0, m/s.
        quaternion: (W, 4) measured at t0.
        body_rate: (W, 3) measured at t0, rad/s.
        row: (W,) row at or before t0.
        step: (W, S) integration steps, s; they end at every row and every horizon.
        command: (W, S, 4) command held during each step.
        rotor_speed: (W, S + 1, 4) measured rotor speed at the step boundaries, rad/s; NaN where not measured.
        at: (W, H) index of the state (0 = initial) at each horizon.
        true_position: (W, H, 3) measured at each horizon, m.
        true_velocity: (W, H, 3) measured at each horizon, m/s.
        true_quaternion: (W, H, 4) measured at each horizon.
        true_body_rate: (W, H, 3) measured at each horizon, rad/s.
    """

    start: np.ndarray
    position: np.ndarray
    velocity: np.ndarray
    quaternion: np.ndarray
    body_rate: np.ndarray
    row: np.ndarray
    step: np.ndarray
    command: np.ndarray
    rotor_speed: np.ndarray
    at: np.ndarray
    true_position: np.ndarray
    true_velocity: np.ndarray
    true_quaternion: np.ndarray
    true_body_rate: np.ndarray

    def __len__(self) -> int:
        return len(self.start)


def find_starts(log: FlightLog, horizons: tuple[float, ...], delay: float, gyro_delay: float) -> np.ndarray:
    """Window starts (W,) that the protocol allows, s of log time; possibly none.

    Args:
        log: the flight.
        horizons: prediction horizons, s.
        delay: age of pose and velocity in a row, s.
        gyro_delay: age of the gyro reading in a row, s.
    """
    # Log time counts from zero even if the first sample is a little later; other logs count from their first row.
    origin = 0.0 if 0 <= log.time[0] < START_SPACING else log.time[0]
    ages = (0.0, delay, gyro_delay)
    reach = REACH + max(0.0, max(ages) - ROOM)
    count = int(np.floor((log.time[-1] - origin - reach - FIRST_START) / START_SPACING + 1e-9)) + 1
    starts = origin + FIRST_START + START_SPACING * np.arange(max(count, 0))
    gaps = np.asarray(log.gaps(), dtype=int)
    if not len(gaps):
        return starts
    begin, end = log.time[gaps], log.time[gaps + 1]
    near = np.searchsorted(begin, starts + GAP_AFTER, side="right") > np.searchsorted(begin, starts - GAP_BEFORE)
    instants = starts[:, None] + np.array([start + age for start in (0.0, *horizons) for age in ages])
    # The edges of a gap count as part of it; otherwise a reading there would depend on rounding.
    before = np.searchsorted(begin, instants + 1e-6) - 1
    inside = (before >= 0) & (instants - 1e-6 < end[before])
    return starts[~near & ~inside.any(axis=1)]


def find_windows(
    log: FlightLog,
    horizons: tuple[float, ...],
    delay: float,
    gyro_delay: float,
    starts: np.ndarray | None = None,
) -> Windows:
    """Cut a log into prediction windows.

    Args:
        log: the flight.
        horizons: prediction horizons, s, ascending.
        delay: age of pose and velocity in a row, s; commands are current.
        gyro_delay: age of the gyro reading in a row, s.
        starts: window starts, s; by default those of `find_starts`.
    """
    starts = find_starts(log, horizons, delay, gyro_delay) if starts is None else starts
    ticks = np.ceil(log.time / COMMAND_TICK - 1e-6) * COMMAND_TICK
    plans = [_plan(ticks, t0, horizons) for t0 in starts]
    width = max((len(edges) - 1 for edges, _, _ in plans), default=0)
    count, reach = len(starts), len(horizons)
    step, at = np.zeros((count, width)), np.zeros((count, reach), dtype=int)
    command = np.zeros((count, width, 4))
    boundary = np.zeros((count, width + 1))
    for i, (edges, rows, where) in enumerate(plans):
        n = len(edges) - 1
        step[i, :n] = np.diff(edges)
        command[i, :n], command[i, n:] = log.command[rows], log.command[rows[-1]]
        boundary[i, : n + 1], boundary[i, n + 1 :] = edges, edges[-1]
        at[i] = where
    ends = starts[:, None] + np.asarray(horizons)
    return Windows(
        start=starts,
        position=interpolate(log.time, log.position, starts + delay),
        velocity=interpolate(log.time, log.velocity, starts + delay),
        quaternion=_unit(interpolate(log.time, log.quaternion, starts + delay)),
        body_rate=interpolate(log.time, log.body_rate, starts + gyro_delay),
        row=_row(log.time, starts),
        step=step,
        command=command,
        rotor_speed=_measured_rotor_speed(log, boundary),
        at=at,
        true_position=interpolate(log.time, log.position, ends + delay),
        true_velocity=interpolate(log.time, log.velocity, ends + delay),
        true_quaternion=_unit(interpolate(log.time, log.quaternion, ends + delay)),
        true_body_rate=interpolate(log.time, log.body_rate, ends + gyro_delay),
    )


def _plan(ticks: np.ndarray, t0: float, horizons: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Step boundaries from t0 to the last horizon, the row whose command holds in each step, and horizon indices.

    ``ticks`` are the instants at which the rows' commands take effect.
    """
    ends = t0 + np.asarray(horizons)
    inside = ticks[np.searchsorted(ticks, t0 + 1e-9, side="right") : np.searchsorted(ticks, ends[-1] - 1e-9)]
    marks = np.unique(np.concatenate([[t0], inside, ends]))
    # Merge marks that differ only by rounding.
    marks = marks[np.concatenate([[True], np.diff(marks) > 1e-9])]
    pieces = np.ceil(np.diff(marks) / LONGEST_STEP - 1e-9).astype(int)
    nth = np.arange(pieces.sum()) - np.repeat(np.cumsum(pieces) - pieces, pieces)
    edges = np.append(np.repeat(marks[:-1], pieces) + nth * np.repeat(np.diff(marks) / pieces, pieces), marks[-1])
    return edges, _row(ticks, edges[:-1]), np.searchsorted(edges, ends - 2e-9)


def _row(time: np.ndarray, instants: np.ndarray) -> np.ndarray:
    return np.clip(np.searchsorted(time, instants + 1e-9, side="right") - 1, 0, len(time) - 1)


def _unit(quaternion: np.ndarray) -> np.ndarray:
    return quaternion / np.linalg.norm(quaternion, axis=-1, keepdims=True)


def _measured_rotor_speed(log: FlightLog, instants: np.ndarray) -> np.ndarray:
    """Rotor speeds at instants, linear between valid readings; NaN outside them and in holes longer than a gap."""
    if log.rotor_speed is None:
        return np.full((*instants.shape, 4), np.nan)
    out = np.empty((*instants.shape, 4))
    for motor in range(4):
        valid = np.isfinite(log.rotor_speed[:, motor])
        if not valid.any():
            out[..., motor] = np.nan
            continue
        time, speed = log.time[valid], log.rotor_speed[valid, motor]
        out[..., motor] = np.interp(instants, time, speed)
        after = np.clip(np.searchsorted(time, instants), 1, len(time) - 1)
        outside = (instants < time[0]) | (instants > time[-1])
        far = time[after] - time[after - 1] > log.gap_threshold
        out[..., motor][outside | far] = np.nan
    return out
