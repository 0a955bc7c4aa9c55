"""Resample a log to a uniform time grid without samples in its gaps, and bring two drones' logs onto one clock."""

from __future__ import annotations

import warnings

import numpy as np

from cfb_mjx.errors import CfbError, CfbWarning
from cfb_mjx.logs import rotation
from cfb_mjx.logs.flight_log import FlightLog, quantise_time

_LINEAR = ("position", "velocity", "body_rate", "specific_force", "battery_voltage", "other")
_SMOOTHING = 0.05
"""Time over which the other drone's specific force is averaged, s: its wake does not follow vibrations."""
_COVERED = 0.99
"""Share of a flight that the other log covers without a word: a row before each gap is not."""
_STANDS = 0.02
"""Mean command below which the other drone's rotors do not turn."""


def interpolate(time: np.ndarray, values: np.ndarray, instants: np.ndarray) -> np.ndarray:
    """Linear interpolation of (n, k) values at instants of any shape; the first and last row hold beyond the ends.

    It interpolates across gaps too; the caller must avoid that.
    """
    return np.stack([np.interp(instants, time, column) for column in values.T], axis=-1)


def resample(log: FlightLog, rate: float) -> FlightLog:
    """Resample to instants ``time[0] + k / rate``.

    Position, velocity, gyro, specific force, rotor speed and voltage are interpolated linearly, quaternions along the
    shorter great circle (slerp); commands are held. Instants inside a gap get no sample, so a gap stays a gap.
    There is no low-pass filter: frequencies above half of a lower rate are aliased.

    Args:
        log: the flight, with at least two rows.
        rate: sampling rate, Hz.

    Returns:
        The resampled log; its metadata gains ``resampled_hz``.

    Raises:
        ValueError: ``rate`` is not positive and finite.
    """
    if not rate > 0.0 or not np.isfinite(rate):
        raise ValueError(f"rate must be positive, got {rate}")
    t = log.time
    grid = quantise_time(t[0] + np.arange(int(np.floor(log.duration * rate + 1e-6)) + 1) / rate)
    # Tolerance of a nanosecond, so that rounding does not move an instant past the row that it coincides with.
    before = np.clip(np.searchsorted(t, grid + 1e-9, side="right") - 1, 0, len(t) - 1)
    after = np.minimum(before + 1, len(t) - 1)
    on_row = np.abs(grid - t[before]) <= 1.5e-9
    keep = on_row | (t[after] - t[before] <= log.gap_threshold) & (grid <= t[-1] + 1e-9)
    grid, before, after, on_row = grid[keep], before[keep], after[keep], on_row[keep]
    span = np.where(after > before, t[after] - t[before], 1.0)
    weight = np.where(on_row, 0.0, np.clip((grid - t[before]) / span, 0.0, 1.0))

    def linear(values):
        w = weight.reshape(-1, *[1] * (values.ndim - 1))
        # With weight 0, return the row itself even if the next rotor speed is invalid (NaN).
        return np.where(w == 0.0, values[before], (1.0 - w) * values[before] + w * values[after])

    fields = {f: linear(getattr(log, f)) for f in _LINEAR if getattr(log, f) is not None}
    if log.rotor_speed is not None:
        fields["rotor_speed"] = linear(log.rotor_speed)
    step = rotation.rotation_vector(
        rotation.multiply(rotation.conjugate(log.quaternion[before]), log.quaternion[after])
    )
    turned = rotation.multiply(log.quaternion[before], rotation.exponential(step * weight[:, None]))
    quaternion = np.where(weight[:, None] == 0.0, log.quaternion[before], turned)
    return log.replace(
        time=grid,
        quaternion=rotation.tidy(quaternion),
        command=log.command[before],
        metadata={"resampled_hz": float(rate)},
        **fields,
    )


def with_other(log: FlightLog, other: FlightLog) -> FlightLog:
    """Add the motion of another drone that flew at the same time.

    Args:
        log: the flight.
        other: flight of the other drone. Both logs have one clock and one world frame. If its log does not state the
            age of its poses, they are taken to be of their rows' time.

    Returns:
        The log with `FlightLog.other`; NaN where the other log has no rows.

    Raises:
        CfbError: the other log covers less than half of the flight.

    Warns:
        CfbWarning: it does not cover all of the flight.
    """
    time, delay = other.time, other.observation_delay or 0.0
    before = np.clip(np.searchsorted(time, log.time, side="right") - 1, 0, len(time) - 1)
    after = np.minimum(before + 1, len(time) - 1)
    there = (log.time >= time[0]) & (log.time <= time[-1]) & (time[after] - time[before] <= other.gap_threshold)
    if there.mean() < 0.5:
        raise CfbError(
            f"{other.name}: covers {there.mean():.0%} of {log.name} ({log.time[0]:.1f} to {log.time[-1]:.1f} s; the "
            f"other drone {time[0]:.1f} to {time[-1]:.1f} s); give the log of a drone that flew at the same time, with "
            "times of one clock."
        )
    if there.mean() < _COVERED:
        said = f"{other.name}: covers {there.mean():.0%} of {log.name}; elsewhere no other drone is assumed."
        warnings.warn(said, CfbWarning, stacklevel=2)
    rows = max(1, round(_SMOOTHING / other.nominal_interval))
    mean = np.convolve(np.pad(other.specific_force[:, 2], rows // 2, mode="edge"), np.ones(rows) / rows, mode="valid")
    lift = np.where(other.command.mean(axis=1) > _STANDS, np.maximum(mean[: len(time)], 0.0), 0.0)
    # The pose of a row is older than the row.
    w, x, y, z = interpolate(time - delay, rotation.tidy(other.quaternion), log.time).T
    up = np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), w * w - x * x - y * y + z * z], axis=1)
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    seen = [interpolate(time - delay, values, log.time) for values in (other.position, other.velocity)]
    thrust = np.interp(log.time, time, lift)[:, None] * up
    found = np.concatenate([*seen, thrust], axis=1)
    return log.replace(other=np.where(there[:, None], found, np.nan), metadata={"other": other.name})
