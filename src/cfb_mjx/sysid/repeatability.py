"""Flights of one reference, flown twice: the torque a model misses both times is no noise, and could be known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.signal import butter, sosfiltfilt

from cfb_mjx.errors import CfbError
from cfb_mjx.logs import FlightLog
from cfb_mjx.model import Quadrotor
from cfb_mjx.sysid.flight import delay_of, with_gyro_in_time
from cfb_mjx.sysid.observer import replay_inputs
from cfb_mjx.sysid.replay import Lane, replays

CORNER = 6.0
"""Hz. Above, the gyro's derivative is noise."""
RATE = 100.0
LONGEST_SHIFT = 6.0
"""Flights of one reference are moved against each other by this at most, s, and by a third of the shorter at most."""
SHORTEST = 6.0
"""Flights shorter than this, s, say nothing."""
EDGE = 1.0
"""s at both ends that filters need."""


@dataclass(frozen=True)
class Repeated:
    """What a model misses in two flights of one reference, roll, pitch, yaw.

    Attributes:
        correlation: (3,) of the two residual angular accelerations.
        rms: (3,) their root mean square, rad/s^2; constants (a battery's place) are not part of it.
        shared: (3,) their covariance, (rad/s^2)^2: what is missed both times.
        distance: rms distance of the two paths, m: says whether it was one reference.
    """

    correlation: np.ndarray
    rms: np.ndarray
    shared: np.ndarray
    distance: float


def residual_angular_acceleration(model: Quadrotor, log: FlightLog) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Measured minus modelled angular acceleration along a flight, below `CORNER`.

    The state comes from the log row by row, rotor speeds from it too where they were measured.

    Returns:
        (n,) time, s, evenly spaced; (n, 3) residual, rad/s^2; (n, 3) position, m.
    """
    log = with_gyro_in_time(log, float(model.parameters.gyro_delay))
    (said,) = replays(model, [Lane(*replay_inputs(log, delay_of(log, model.parameters), 0.0))])
    said = np.asarray(said.angular_acceleration)[: len(log)]
    time = np.arange(log.time[0], log.time[-1], 1 / RATE)
    rate, said, position = (_sampled(time, log.time, x) for x in (log.body_rate, said, log.position))
    low = butter(4, CORNER, fs=RATE, output="sos")
    return time, sosfiltfilt(low, np.gradient(rate, 1 / RATE, axis=0) - said, axis=0), position


def repeated(model: Quadrotor, one: FlightLog, other: FlightLog) -> Repeated:
    """Compare what a model misses in two flights of one reference.

    Raises:
        CfbError: flights too short.
    """
    (_, a, path_a), (_, b, path_b) = (residual_angular_acceleration(model, log) for log in (one, other))
    shorter = min(len(a), len(b))
    if shorter < SHORTEST * RATE:
        raise CfbError(f"{one.name}, {other.name}: too short to compare; {SHORTEST:g} s are needed.")
    reach = int(min(LONGEST_SHIFT * RATE, shorter / 3))
    pairs = {shift: _overlap(len(a), len(b), shift) for shift in range(-reach, reach + 1)}
    apart = {shift: float(np.mean((path_a[i] - path_b[j]) ** 2)) for shift, (i, j) in pairs.items()}
    best = min(apart, key=apart.__getitem__)
    i, j = pairs[best]
    edge = int(EDGE * RATE)
    first, second = (x - x.mean(axis=0) for x in (a[i][edge:-edge], b[j][edge:-edge]))
    shared = np.mean(first * second, axis=0)
    spread = np.sqrt(np.mean(first**2, axis=0)), np.sqrt(np.mean(second**2, axis=0))
    rms = np.sqrt((spread[0] ** 2 + spread[1] ** 2) / 2)
    return Repeated(shared / (spread[0] * spread[1]), rms, shared, float(np.sqrt(3 * apart[best])))


def _sampled(at: np.ndarray, time: np.ndarray, values: np.ndarray) -> np.ndarray:
    return np.stack([np.interp(at, time, column) for column in values.T], axis=1)


def _overlap(count: int, other: int, shift: int) -> tuple[slice, slice]:
    """Rows that lie side by side when the second flight is moved ``shift`` rows earlier."""
    first, second = max(0, -shift), max(0, shift)
    length = min(count - first, other - second)
    return slice(first, first + length), slice(second, second + length)
