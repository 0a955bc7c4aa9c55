"""Putting a log on a uniform time grid without inventing samples in its gaps."""

from __future__ import annotations

import numpy as np

from cfb_mjx.logs import rotation
from cfb_mjx.logs.flight_log import FlightLog, quantise_time

_LINEAR = ("position", "velocity", "body_rate", "specific_force", "battery_voltage")


def interpolate(time: np.ndarray, values: np.ndarray, instants: np.ndarray) -> np.ndarray:
    """Linear interpolation of (n, k) values at instants of any shape; the first and last row hold beyond the ends.

    It knows nothing of gaps: whoever asks across one has to.
    """
    return np.stack([np.interp(instants, time, column) for column in values.T], axis=-1)


def resample(log: FlightLog, rate: float) -> FlightLog:
    """Resample to instants ``time[0] + k / rate``.

    Position, velocity, gyro, specific force, rotor speed and voltage are interpolated linearly, quaternions along the
    shorter great circle (slerp), commands held. No instant inside a gap gets a sample, so a gap stays a gap.
    Nothing is low-pass filtered: resampling to a lower rate aliases what lies above its half.

    Args:
        log: at least two rows.
        rate: Hz.

    Returns:
        The resampled log; its metadata gains ``resampled_hz``.

    Raises:
        ValueError: ``rate`` is not positive, or no instant of the grid falls into the log.
    """
    if not rate > 0.0 or not np.isfinite(rate):
        raise ValueError(f"rate must be positive, got {rate}")
    t = log.time
    grid = quantise_time(t[0] + np.arange(int(np.floor(log.duration * rate + 1e-6)) + 1) / rate)
    # A nanosecond of rounding must not push an instant over a row it coincides with.
    before = np.clip(np.searchsorted(t, grid + 1e-9, side="right") - 1, 0, len(t) - 1)
    after = np.minimum(before + 1, len(t) - 1)
    on_row = np.abs(grid - t[before]) <= 1.5e-9
    keep = on_row | (t[after] - t[before] <= log.gap_threshold) & (grid <= t[-1] + 1e-9)
    grid, before, after, on_row = grid[keep], before[keep], after[keep], on_row[keep]
    span = np.where(after > before, t[after] - t[before], 1.0)
    weight = np.where(on_row, 0.0, np.clip((grid - t[before]) / span, 0.0, 1.0))

    def linear(values):
        w = weight.reshape(-1, *[1] * (values.ndim - 1))
        # Written so that weight 0 returns the row itself, also beside an invalid (NaN) rotor speed.
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
