"""Importer for the IDSIA nano-drone benchmark (raw 100 Hz merges, parquet).

Source: Busetto et al., "Nonlinear system identification for a nano-drone benchmark", Control Engineering Practice 172,
2026, repository idsia-robotics/nanodrone-sysid-benchmark. A Crazyflie 2.1 Brushless with AI-deck and flow deck, 45 g.
The data have no licence. This module reads files that the user has obtained; no data of them are part of the library.
docs/logs.md describes the content of each column and explains every conversion below.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from cfb_mjx.errors import CfbError
from cfb_mjx.logs import alignment, rotation
from cfb_mjx.logs.flight_log import FlightLog, quantise_time, runs
from cfb_mjx.logs.tabular import Table, read_table, require_numbers

POSITION, VELOCITY = ("x", "y", "z"), ("vx", "vy", "vz")
QUATERNION = ("qw", "qx", "qy", "qz")  # stored scalar last; reading by name reorders
GYRO, ACCELERATION = ("wx", "wy", "wz"), ("ax", "ay", "az")
COMMAND = tuple(f"m{i}_thrust" for i in range(1, 5))
# Names in the benchmark's csv files to the names in its parquet files (STAMPS).
_STAMPS_OF_CSV = {
    "ros_timestamp": "ros_timestamp_x",
    "ros_timestamp_motors": "ros_timestamp_y",
    "ros_timestamp_image_accel": "ros_timestamp",
}
ERPM = tuple(f"m{i}_erpm" for i in range(1, 5))
STAMPS = ("ros_timestamp_x", "ros_timestamp_y", "ros_timestamp")  # state, motor and accelerometer packets
COLUMNS = ("t", *POSITION, *VELOCITY, *QUATERNION, *GYRO, *ACCELERATION, *COMMAND, *ERPM, *STAMPS, "Vbat")

PROCESSED = ("m1_rads", "rx")
"""Columns that exist only in the benchmark's processed files: rotor speeds and a rotation vector."""

VEHICLE_MASS = 0.045  # kg, with both decks (the benchmark's description)
RAD_PER_S_PER_ERPM = 2.0 * np.pi / 60.0 / 6.0  # 12 poles: 6 electrical turns per mechanical one
ERPM_LIMIT, ERPM_INVALID = 1.75e5, 65535.0
TAKE_OFF_HEIGHT, AFTER_TAKE_OFF, BEFORE_LANDING = 0.35, 1.0, 0.5  # m, s, s
ACCELERATION_LIMIT, RATE_LIMIT = 60.0, 12.0  # m/s^2, rad/s; larger values are estimator glitches
# Pose and velocity lag the gyro of the same row. The rate of the quaternion, correlated with the gyro, lags by 6 to
# 10 ms (mean 7.7) on all eleven flights examined; the vertical velocity lags the accelerometer by 9 to 15 ms where
# their packets have the same stamp. 8 ms, the default of the evaluation protocol, agrees with both.
OBSERVATION_DELAY = 0.008  # s
# Lag of the gyro behind the rotor speeds on the five flights whose state and motor packets have identical stamps: 3.1
# to 3.8 ms, the delay of the measuring chain itself. The rest of a lag is the packet shift, a whole number of samples.
CHAIN_LAG = 0.0035  # s
HELD_RUN = 3  # shortest run of held copies that is dropped: 3 rows at 100 Hz leave 40 ms, just above the gap threshold


def recognises(table: Table) -> bool:
    """Whether the columns are those of the benchmark."""
    return "m1_thrust" in table and ("ros_timestamp_x" in table or "ros_timestamp_motors" in table)


def read_idsia(path: str | os.PathLike, motor_shift: float | None = None) -> FlightLog:
    """Read one flight of the benchmark, cut to the airborne part, with time starting at 0.

    Args:
        path: a parquet (or csv) file of the benchmark's raw merges.
        motor_shift: delay of the motor columns, s, rounded to whole samples; 0 leaves them as recorded. None estimates
            it (`estimate_command_shift`), and leaves them as recorded if the estimate is not reliable.

    Returns:
        The log. Metadata adds ``vehicle_mass``, ``alignment`` (estimate, what was applied) and ``cleaning`` (counts).

    Raises:
        CfbError: unreadable file, missing columns, no airborne part.
    """
    path = Path(path)
    return from_columns(read_table(path), path, motor_shift)


def read_as_published(path: str | os.PathLike) -> FlightLog:
    """Read a flight as the benchmark's own evaluation does: every row unchanged, nothing cut, shifted or left out.

    Args:
        path: one of the benchmark's processed files (``data/real/processed``), parquet or csv.

    Raises:
        CfbError: unreadable file, missing columns, or an unprocessed raw merge.
    """
    path = Path(path)
    table = read_table(path)
    if not any(name in table for name in PROCESSED):
        raise CfbError(
            f"{path}: is a raw merge of the benchmark, but the benchmark's evaluation uses processed files; give a "
            "file of data/real/processed, or leave out --official."
        )
    log, _ = _as_logged(table, path)
    alignment_of = {"applied": False, "applied_ms": 0.0, "chosen_by": "benchmark"}
    return log.replace(time=quantise_time(log.time - log.time[0]), metadata={"alignment": alignment_of})


def from_columns(table: Table, path: Path, motor_shift: float | None = None) -> FlightLog:
    """`read_idsia` on columns already in memory."""
    log, table = _as_logged(table, path)
    held = np.stack([np.concatenate([[False], np.diff(table[c]) <= 0]) for c in STAMPS], axis=1)
    return _clean(log, held, path, motor_shift)


def _as_logged(table: Table, path: Path) -> tuple[FlightLog, Table]:
    """The log with every row, in this library's conventions, and the table with packet stamps named as in `STAMPS`."""
    if "ros_timestamp_motors" in table and "ros_timestamp_x" not in table:
        table = Table(
            {_STAMPS_OF_CSV.get(name, name): values for name, values in table.items()}, table.notes, table.warnings
        )
    if missing := [c for c in COLUMNS if c not in table]:
        raise CfbError(
            f"{path}: missing column{'s' * (len(missing) > 1)} {', '.join(missing)}; the IDSIA layout is the "
            "raw 100 Hz merge of the benchmark (see docs/logs.md)."
        )
    require_numbers(table, list(COLUMNS), path)
    required = [c for c in COLUMNS if c not in ERPM]
    if bad := [c for c in required if not np.isfinite(table[c]).all()]:
        row = int(np.argmin(np.isfinite(table[bad[0]])))
        raise CfbError(
            f"{path}: column {bad[0]} has no finite value in row {row}; drop such rows or fetch the file again."
        )
    time = table.numbers("t")
    if len(time) < 2 or not (np.diff(time) > 0).all():
        raise CfbError(f"{path}: column t must increase over at least 2 rows; sort the rows by t and drop duplicates.")

    def stack(names):
        return np.stack([table.numbers(c) for c in names], axis=1)

    quaternion = stack(QUATERNION)
    if (np.abs(np.linalg.norm(quaternion, axis=1) - 1.0) > 0.05).any():
        raise CfbError(f"{path}: columns qx qy qz qw are not unit quaternions; fetch the original file again.")
    quaternion = rotation.tidy(quaternion)
    erpm = stack(ERPM)
    erpm[~(erpm <= ERPM_LIMIT) | (erpm == ERPM_INVALID) | (erpm < 0)] = np.nan
    log = FlightLog(
        time=quantise_time(time),
        position=stack(POSITION),
        velocity=stack(VELOCITY),
        quaternion=quaternion,
        body_rate=stack(GYRO),
        specific_force=rotation.to_body(quaternion, stack(ACCELERATION)),
        command=stack(COMMAND),
        rotor_speed=None if np.isnan(erpm).all() else erpm * RAD_PER_S_PER_ERPM,
        battery_voltage=table.numbers("Vbat"),
        metadata={
            "name": path.stem,
            "source": path.name,
            "format": "idsia",
            "observation_delay": OBSERVATION_DELAY,
            "vehicle_mass": VEHICLE_MASS,
        },
    )
    return log, table


def _clean(log: FlightLog, held: np.ndarray, path: Path, motor_shift: float | None) -> FlightLog:
    """Align the motor packets, drop held copies and glitches (they become gaps), and keep the airborne part."""
    airborne = _airborne(log, path)
    glitch = _glitches(log, held[:, 0])
    keep = airborne & ~_runs(held[:, 0], HELD_RUN) & ~_runs(held[:, 1], HELD_RUN) & ~glitch
    if keep.sum() < 2:
        raise CfbError(
            f"{path}: nothing is left after dropping held copies and glitches; fetch the original file again."
        )
    estimate = alignment.estimate_command_shift(log.rows(keep))
    if motor_shift is None:
        shift = estimate.shift_s - CHAIN_LAG if estimate.reliable else 0.0
    else:
        shift = float(motor_shift)
    samples = round(shift / log.nominal_interval)
    log = alignment.delay_by_samples(log, samples)
    state_held, motors_held, sensor_held = (_runs(held[:, i], HELD_RUN) for i in range(3))
    # Held copies of motor packets are shifted with the motor columns.
    motors_held = motors_held[np.clip(np.arange(len(held)) - samples, 0, len(held) - 1)]
    keep = airborne & ~(state_held | motors_held | sensor_held | glitch)
    first = log.time[np.argmax(airborne)]
    start = log.time[np.argmax(keep)]
    log = log.rows(keep)
    return log.replace(
        time=quantise_time(log.time - start),
        metadata={
            "alignment": estimate.report()
            | {
                "chosen_by": "estimate" if motor_shift is None else "user",
                "applied": samples != 0,
                "applied_samples": samples,
                "applied_ms": round(samples * log.nominal_interval * 1e3, 6),
            },
            "cleaning": {
                "recorded_rows": len(held),
                "airborne_rows": int(airborne.sum()),
                "first_airborne_time": float(first),
                "time_of_first_row": float(start),
                "dropped_state_held": int((airborne & state_held).sum()),
                "dropped_motor_held": int((airborne & motors_held).sum()),
                "dropped_accelerometer_held": int((airborne & sensor_held).sum()),
                "dropped_glitch": int((airborne & glitch).sum()),
                "held_rows_kept": int((keep & held.any(axis=1)).sum()),
                "invalid_rotor_speeds": 0 if log.rotor_speed is None else int(np.isnan(log.rotor_speed).sum()),
            },
        },
    )


def _airborne(log: FlightLog, path: Path) -> np.ndarray:
    above = np.flatnonzero(log.position[:, 2] > TAKE_OFF_HEIGHT)
    if len(above):
        start, stop = log.time[above[0]] + AFTER_TAKE_OFF, log.time[above[-1]] - BEFORE_LANDING
        mask = (log.time >= start - 1e-9) & (log.time <= stop + 1e-9)
        if mask.sum() >= 2:
            return mask
    raise CfbError(
        f"{path}: column z shows no flight longer than {AFTER_TAKE_OFF + BEFORE_LANDING} s above {TAKE_OFF_HEIGHT} m; "
        "choose a file with a whole flight."
    )


def _glitches(log: FlightLog, state_held: np.ndarray) -> np.ndarray:
    """Rows to drop because of implausible jumps, with one more row on each side so that a gap remains."""
    fresh = np.flatnonzero(~state_held)  # a held copy hides a step and doubles the next one
    jump = np.linalg.norm(np.diff(log.velocity[fresh], axis=0), axis=1) / np.diff(log.time[fresh]) > ACCELERATION_LIMIT
    bad = np.linalg.norm(log.body_rate, axis=1) > RATE_LIMIT
    bad[fresh[:-1][jump]] = True
    bad[fresh[1:][jump]] = True
    wide = bad.copy()
    wide[:-1] |= bad[1:]
    wide[1:] |= bad[:-1]
    return wide


def _runs(mask: np.ndarray, length: int) -> np.ndarray:
    """The true values of ``mask`` that are in runs of at least ``length``."""
    out = np.zeros_like(mask)
    for start, stop in runs(mask):
        out[start:stop] = stop - start >= length
    return out
