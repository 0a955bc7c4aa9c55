"""A log made ready for replay: every column at the time of its row, padded to whole blocks of rows."""

from __future__ import annotations

import dataclasses
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
from cfb_mjx.model.state import AnyArray
from cfb_mjx.parameters import Parameters

ROWS = 512
"""Rows that are looked at together: about two seconds at 250 Hz. Flights are padded to a multiple of it."""
LENGTHS = (2560, 4608, 7680)
"""Rows to which `lengthened` pads (beyond, a multiple of the last): few shapes, for which programs are cached."""
WARM_UP = 0.3
"""After the start and after every gap rotor speeds are not known from commands for so long, s: six motor lags."""
MEASURED_SHARE = 0.98
"""Rotor speeds are used where every motor has at least this share of valid readings."""
_VOLTAGE_SMOOTHING = 0.02
"""Time constant, s. Short: a longer one, where the rotors feel the dips under load, makes `battery_sag` look weaker."""


class Flight(eqx.Module):
    """N rows of one log; the padding repeats the last row with zero time between."""

    time: Float[AnyArray, " n"]
    """Since the log's time zero, s."""
    interval: Float[AnyArray, " n"]
    """To the next row, s; 0 at the last and in the padding."""
    position: Float[AnyArray, "n 3"]
    velocity: Float[AnyArray, "n 3"]
    quaternion: Float[AnyArray, "n 4"]
    """Pose and velocity when the row's time stamp was written, not ``pose_delay`` before."""
    body_rate: Float[AnyArray, "n 3"]
    specific_force: Float[AnyArray, "n 3"]
    command: Float[AnyArray, "n 4"]
    rotor_speed: Float[AnyArray, "n 4"]
    """Measured, rad/s; 0 where not."""
    measured: Float[AnyArray, ""]
    """1 where the log has rotor speeds throughout."""
    voltage: Float[AnyArray, " n"]
    """Of the battery, V, smoothed over past rows; NaN where not measured."""
    fresh: Float[AnyArray, " n"]
    """1 at the first row and at the first after a gap."""
    valid: Float[AnyArray, " n"]
    """1 where what the model predicts can be compared with the row."""


def delay_of(log: FlightLog, parameters: Parameters) -> float:
    """Age of pose and velocity in a row, s: as the log says, else as the model does."""
    delay = log.observation_delay
    return float(parameters.pose_delay) if delay is None else float(delay)


def usual_delay(logs: Sequence[FlightLog], parameters: Parameters) -> float:
    """One `delay_of` for several logs: the median of what they say."""
    delays = {log.observation_delay for log in logs if log.observation_delay is not None}
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
    return _padded(Flight(**flight, measured=np.array(float(measured))), -(-n // ROWS) * ROWS)


def lengthened(flight: Flight, beside: Any) -> tuple[Flight, Any]:
    """A flight, and arrays with a row for each of its rows, padded to one of `LENGTHS`."""
    n = len(flight.time)
    length = next((x for x in LENGTHS if x >= n), -(-n // LENGTHS[-1]) * LENGTHS[-1])
    return _padded(flight, length), jax.tree.map(lambda x: last_repeated(x, length), beside)


def _padded(flight: Flight, length: int) -> Flight:
    n = len(flight.time)
    padded = jax.tree.map(lambda x: last_repeated(x, length) if np.ndim(x) else x, flight)
    own = np.arange(length) < n
    return dataclasses.replace(padded, valid=padded.valid * own, fresh=padded.fresh * own)


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
