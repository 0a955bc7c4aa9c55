"""Prepare a log for replay: every column at the time of its row, padded to whole blocks of rows."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from cfb_mjx.devices import last_repeated
from cfb_mjx.logs import FlightLog
from cfb_mjx.logs.resample import interpolate
from cfb_mjx.logs.rotation import tidy
from cfb_mjx.model.effects.downwash import KNOWN
from cfb_mjx.model.state import AnyArray
from cfb_mjx.parameters import Parameters

ROWS = 512
"""Rows per block: about two seconds at 250 Hz. Flights are padded to a multiple of it."""
LENGTHS = (2560, 4608, 7680)
"""Numbers of rows to which `lengthened` pads (or a multiple of the last): few shapes, so programs are reused."""
WARM_UP = 0.3
"""Time after the start and after every gap in which rotor speeds are not yet known from commands, s: six motor lags."""
MEASURED_SHARE = 0.98
"""Rotor speeds are used if every motor has at least this share of valid readings."""
_AROUND = np.linspace(-1.0, 0.5, 31)
"""Times around a row to which the other drone's path is fitted, s."""
_VOLTAGE_SMOOTHING = 0.02
"""Time constant of the voltage's low-pass filter, s. It is short, because smoothing the dips under load would make
`battery_sag` look weaker."""


class Flight(eqx.Module):
    """Rows of one log with all columns at the rows' own times; the padding repeats the last row with zero intervals."""

    time: Float[AnyArray, " n"]
    """Log time, s."""
    interval: Float[AnyArray, " n"]
    """Time to the next row, s; 0 at the last row and in the padding."""
    position: Float[AnyArray, "n 3"]
    """At the row's time, with ``pose_delay`` removed, m."""
    velocity: Float[AnyArray, "n 3"]
    """At the row's time, m/s."""
    quaternion: Float[AnyArray, "n 4"]
    """At the row's time."""
    body_rate: Float[AnyArray, "n 3"]
    """At the row's time, with ``gyro_delay`` removed, rad/s."""
    specific_force: Float[AnyArray, "n 3"]
    """m/s^2."""
    command: Float[AnyArray, "n 4"]
    """0 to 1."""
    rotor_speed: Float[AnyArray, "n 4"]
    """Measured, rad/s; 0 if not measured."""
    measured: Float[AnyArray, ""]
    """1 if all motors' rotor speeds were measured throughout."""
    voltage: Float[AnyArray, " n"]
    """Battery voltage, smoothed over past rows, V; NaN if not measured."""
    other: Float[AnyArray, "n 36"]
    """Another drone, as `cfb_mjx.model.effects.downwash.Other`; NaN if unknown."""
    fresh: Float[AnyArray, " n"]
    """1 at the first row and at the first row after a gap."""
    valid: Float[AnyArray, " n"]
    """1 where the model's prediction can be compared with the row."""


def delay_of(log: FlightLog, parameters: Parameters) -> float:
    """Age of pose and velocity in a row, s: the log's value, or the model's if the log does not state it."""
    delay = log.observation_delay
    return float(parameters.pose_delay) if delay is None else float(delay)


def usual_delay(logs: Sequence[FlightLog], parameters: Parameters) -> float:
    """Median of the distinct ages of pose and velocity that the logs state, s; the model's value if none does."""
    delays = {log.observation_delay for log in logs if log.observation_delay is not None}
    return float(np.median(list(delays))) if delays else float(parameters.pose_delay)


def with_gyro_in_time(log: FlightLog, gyro_delay: float) -> FlightLog:
    """Remove the delay of the gyro: shift every body rate to the row at whose time it was measured.

    Rows whose reading lies behind a gap are removed.

    Args:
        log: the flight.
        gyro_delay: age of the gyro reading in a row, s.
    """
    if gyro_delay == 0:
        return log
    ends = np.append(log.time[log.gaps()], log.time[-1])
    there = log.time + gyro_delay <= ends[np.searchsorted(ends, log.time)]
    rate = interpolate(log.time, log.body_rate, log.time + gyro_delay)
    return dataclasses.replace(log, body_rate=rate).rows(there)


def prepare_flight(log: FlightLog, delay: float, gyro_delay: float) -> Flight:
    """Prepare a log for replay.

    Args:
        log: the flight.
        delay: age of pose and velocity in a row, s.
        gyro_delay: age of the gyro reading in a row, s.
    """
    n, time = len(log), log.time
    gaps = log.gaps()
    fresh = np.zeros(n)
    fresh[0] = 1.0
    fresh[gaps + 1] = 1.0
    since = time - time[np.maximum.accumulate(np.where(fresh > 0, np.arange(n), 0))]
    ends = np.append(time[gaps], time[-1])
    until = ends[np.searchsorted(ends, time)] - time
    # The pose at a row's own time is interpolated between later rows, which must not lie behind a gap.
    valid = (since >= WARM_UP) & (until >= max(delay, gyro_delay))

    def late(values, by=delay):
        return interpolate(time, values, time + by)

    speed, measured = _rotor_speed(log)
    flight = {
        "time": time,
        "interval": np.append(np.diff(time), 0.0),
        "position": late(log.position),
        "velocity": late(log.velocity),
        "quaternion": tidy(late(tidy(log.quaternion))),
        "body_rate": late(log.body_rate, gyro_delay),
        "specific_force": log.specific_force,
        "command": np.clip(log.command, 0.0, 1.0),
        "rotor_speed": speed,
        "voltage": _smoothed_voltage(log),
        "other": _other_of(log),
        "fresh": fresh,
        "valid": valid.astype(float),
    }
    return _padded(Flight(**flight, measured=np.array(float(measured))), -(-n // ROWS) * ROWS)


def lengthened(flight: Flight, beside: Any) -> tuple[Flight, Any]:
    """Pad a flight, and the arrays in ``beside`` that have the same number of rows, to one of `LENGTHS`."""
    n = len(flight.time)
    length = next((x for x in LENGTHS if x >= n), -(-n // LENGTHS[-1]) * LENGTHS[-1])
    return _padded(flight, length), jax.tree.map(lambda x: last_repeated(x, length), beside)


def _padded(flight: Flight, length: int) -> Flight:
    n = len(flight.time)
    padded = jax.tree.map(lambda x: _longer(x, length) if np.ndim(x) else x, flight)
    own = np.arange(length) < n
    return dataclasses.replace(padded, valid=padded.valid * own, fresh=padded.fresh * own)


def _longer(x: AnyArray, length: int) -> np.ndarray:
    x = np.asarray(x)
    # A column that is the same in all rows stays one row in memory.
    return np.broadcast_to(x[:1], (length, *x.shape[1:])) if x.strides[0] == 0 else last_repeated(x, length)


def _rotor_speed(log: FlightLog) -> tuple[np.ndarray, bool]:
    """Measured rotor speeds with invalid readings interpolated, and whether all motors were measured throughout."""
    if log.rotor_speed is None:
        return np.zeros((len(log), 4)), False
    out = log.rotor_speed.copy()
    for motor in range(4):
        good = np.isfinite(out[:, motor])
        if good.mean() < MEASURED_SHARE:
            return np.zeros((len(log), 4)), False
        out[:, motor] = np.interp(log.time, log.time[good], out[good, motor])
    return out, True


def _other_of(log: FlightLog) -> np.ndarray:
    """Polynomials of the other drone's path and wake about every row, (n, 36).

    They are of the fifth degree, fitted to the time of a prediction after the row and that of a wake before it: the
    other drone's path is known, like the commands.
    """
    nothing = np.broadcast_to(np.nan, (len(log), 3 * sum(KNOWN)))
    if log.other is None:
        return nothing
    known = np.asarray(np.isfinite(log.other).all(axis=1))
    if not known.any():
        return nothing
    pushed = log.other[:, 6:]
    size = np.sqrt(np.maximum(np.linalg.norm(pushed, axis=1, keepdims=True), 1e-9))
    at = log.time[:, None] + _AROUND
    # Beyond its ends the other log is extended by constant velocity, so that the ends bend no path.
    clipped = np.clip(at, log.time[known][0], log.time[known][-1])
    path = interpolate(log.time[known], log.other[known, :3], clipped)
    path += (at - clipped)[..., None] * interpolate(log.time[known], log.other[known, 3:6], clipped)
    wake = interpolate(log.time[known], (-pushed / size)[known], clipped)
    found = []
    for values, count in zip((path, wake), KNOWN, strict=True):
        powers = [_AROUND**k / math.factorial(k) for k in range(count)]
        found.append(np.einsum("ks,nsi->nki", np.linalg.pinv(np.stack(powers, axis=1)), values))
    return np.where(known[:, None], np.concatenate(found, axis=1).reshape(len(log), -1), np.nan)


def _smoothed_voltage(log: FlightLog) -> np.ndarray:
    """Battery voltage smoothed over past rows only, because it is also used at the start of a prediction."""
    if log.battery_voltage is None:
        return np.full(len(log), np.nan)
    good = np.isfinite(log.battery_voltage)
    if not good.any():
        return np.full(len(log), np.nan)
    raw = np.interp(log.time, log.time[good], log.battery_voltage[good])
    keep = np.exp(-np.diff(log.time) / _VOLTAGE_SMOOTHING)
    out = np.empty_like(raw)
    out[0] = raw[: max(1, round(_VOLTAGE_SMOOTHING / max(log.nominal_interval, 1e-4)))].mean()
    for k in range(1, len(raw)):
        out[k] = keep[k - 1] * out[k - 1] + (1 - keep[k - 1]) * raw[k]
    return out
