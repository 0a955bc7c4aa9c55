"""A log made ready for replay: every column at the time of its row, padded to one of a few lengths."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float

from cfb_mjx.logs import FlightLog
from cfb_mjx.logs.resample import interpolate
from cfb_mjx.logs.rotation import tidy
from cfb_mjx.parameters import Parameters

LENGTHS = (2560, 4608, 7680)
"""Rows a flight is padded to (beyond, a multiple of the last): few shapes, so that programs come from the cache."""
GROUP = 8
"""Flights walked along side by side, row by row, are nearly as fast as one: so many of `LENGTHS`, fewer of longer ones,
which would fill the memory."""
WARM_UP = 0.3
"""After the start and after every gap rotor speeds are not known from commands for so long, s: six motor lags."""
MEASURED_SHARE = 0.98
"""Rotor speeds are used where every motor has at least this share of valid readings."""
_VOLTAGE_SMOOTHING = 0.02
"""Time constant, s. Short: a longer one, where the rotors feel the dips under load, makes `battery_sag` look weaker."""


class Flight(eqx.Module):
    """N rows of one log; the padding repeats the last row with zero time between."""

    time: Float[Array, " n"]
    """Since the log's time zero, s."""
    interval: Float[Array, " n"]
    """To the next row, s; 0 at the last and in the padding."""
    position: Float[Array, "n 3"]
    velocity: Float[Array, "n 3"]
    quaternion: Float[Array, "n 4"]
    """Pose and velocity when the row's time stamp was written, not ``pose_delay`` before."""
    body_rate: Float[Array, "n 3"]
    specific_force: Float[Array, "n 3"]
    command: Float[Array, "n 4"]
    rotor_speed: Float[Array, "n 4"]
    """Measured, rad/s; 0 where not."""
    measured: Float[Array, ""]
    """1 where the log has rotor speeds throughout."""
    voltage: Float[Array, " n"]
    """Of the battery, V, smoothed over past rows; NaN where not measured."""
    fresh: Float[Array, " n"]
    """1 at the first row and at the first after a gap."""
    valid: Float[Array, " n"]
    """1 where what the model predicts can be compared with the row."""


def delay_of(log: FlightLog, parameters: Parameters) -> float:
    """Age of pose and velocity in a row, s: as the log says, else as the model does."""
    delay = log.observation_delay
    return float(parameters.pose_delay) if delay is None else float(delay)


def usual_delay(logs: Sequence[FlightLog], parameters: Parameters) -> float:
    """One `delay_of` for several logs: the median of what they say."""
    delays = {log.observation_delay for log in logs} - {None}
    return float(np.median(list(delays))) if delays else float(parameters.pose_delay)


def with_gyro_in_time(log: FlightLog, gyro_delay: float) -> FlightLog:
    """The log with every body rate in the row at whose time it was measured.

    Args:
        log: the flight.
        gyro_delay: age of the gyro's reading in a row, s. Rows whose reading lies behind a gap are left out.
    """
    if gyro_delay == 0:
        return log
    ends = np.append(log.time[log.gaps()], log.time[-1])
    there = log.time + gyro_delay <= ends[np.searchsorted(ends, log.time)]
    rate = interpolate(log.time, log.body_rate, log.time + gyro_delay)
    return dataclasses.replace(log, body_rate=rate).rows(there)


def prepare_flight(log: FlightLog, delay: float, gyro_delay: float) -> Flight:
    """Rows of a log at their own time.

    Args:
        log: the flight.
        delay: age of pose and velocity in a row, s.
        gyro_delay: age of the gyro's reading in a row, s.
    """
    n, time = len(log), log.time
    gaps = log.gaps()
    fresh = np.zeros(n)
    fresh[0] = 1.0
    fresh[gaps + 1] = 1.0
    since = time - time[np.maximum.accumulate(np.where(fresh > 0, np.arange(n), 0))]
    ends = np.append(time[gaps], time[-1])
    until = ends[np.searchsorted(ends, time)] - time
    # Pose at a row's own time is read from later rows, which must not lie behind a gap.
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
        "fresh": fresh,
        "valid": valid.astype(float),
    }
    length = next((x for x in LENGTHS if x >= n), -(-n // LENGTHS[-1]) * LENGTHS[-1])
    padded = {key: np.concatenate([v, np.repeat(v[-1:], length - n, axis=0)]) for key, v in flight.items()}
    padded["valid"][n:] = 0.0
    padded["fresh"][n:] = 0.0
    return Flight(**padded, measured=np.array(float(measured)))


def in_groups(function: Callable[..., Any], flights: Sequence[Flight], *beside: Sequence[Any]) -> list[Any]:
    """What a function says of flights, several of one length at a time.

    Args:
        function: of flights side by side (leading axis), and of what stands beside them; a program compiled for it
            serves any number of flights.
        flights: one by one.
        beside: more arguments, one for each flight.

    Returns:
        For each flight its part of what the function returns, as NumPy arrays.
    """
    found: list[Any] = [None] * len(flights)
    lengths = np.array([len(flight.time) for flight in flights])
    for length in np.unique(lengths):
        alike = np.flatnonzero(lengths == length)
        size = max(1, min(GROUP, GROUP * LENGTHS[-1] // length)) if len(alike) > 1 else 1
        for first in range(0, len(alike), size):
            # The last group repeats its last flight.
            chosen = alike[np.minimum(np.arange(first, first + size), len(alike) - 1)]
            rows = [(flights[i], *(each[i] for each in beside)) for i in chosen]
            stacked = jax.tree.map(lambda *x: np.stack([np.asarray(y) for y in x]), *rows)
            result = jax.tree.map(np.asarray, function(*stacked))
            for row, i in enumerate(alike[first : first + size]):
                found[i] = jax.tree.map(lambda x, r=row: x[r], result)
    return found


def _rotor_speed(log: FlightLog) -> tuple[np.ndarray, bool]:
    """Measured rotor speeds with short holes bridged, and whether all motors were measured throughout."""
    if log.rotor_speed is None:
        return np.zeros((len(log), 4)), False
    out = log.rotor_speed.copy()
    for motor in range(4):
        good = np.isfinite(out[:, motor])
        if good.mean() < MEASURED_SHARE:
            return np.zeros((len(log), 4)), False
        out[:, motor] = np.interp(log.time, log.time[good], out[good, motor])
    return out, True


def _smoothed_voltage(log: FlightLog) -> np.ndarray:
    """Voltage over past rows only: it serves at the start of a prediction too."""
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
