"""Repeatability of a model's residual torque over two flights of the same reference.

The part common to both flights is not noise, so a better model could predict it.
"""

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
"""Cut-off frequency, Hz; above it the derivative of the gyro is mostly noise."""
RATE = 100.0
"""Rate to which the flights are resampled, Hz."""
LONGEST_SHIFT = 6.0
"""Maximum time shift between the two flights, s; at most a third of the shorter flight."""
SHORTEST = 6.0
"""Minimum duration of a flight, s."""
EDGE = 1.0
"""Time at both ends where the filter is not valid, s."""


@dataclass(frozen=True)
class Repeated:
    """Comparison of a model's residual angular accelerations (roll, pitch, yaw) in two flights of one reference.

    Attributes:
        correlation: (3,) of the two residuals.
        rms: (3,) root mean square of the residuals, rad/s^2, without their means (due to the battery's position).
        shared: (3,) covariance of the two residuals, (rad/s^2)^2: the part common to both flights.
        distance: rms distance of the two paths, m, which shows whether the reference was the same.
    """

    correlation: np.ndarray
    rms: np.ndarray
    shared: np.ndarray
    distance: float


def residual_angular_acceleration(model: Quadrotor, log: FlightLog) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Measured minus modelled angular acceleration along a flight, below `CORNER`.

    The state is read from the log at every row, and so are rotor speeds if they were measured.

    Args:
        model: the drone.
        log: the flight.

    Returns:
        Evenly spaced time (n,), s; residual (n, 3), rad/s^2; position (n, 3), m.
    """
    log = with_gyro_in_time(log, float(model.parameters.gyro_delay))
    (said,) = replays(model, [Lane(*replay_inputs(log, delay_of(log, model.parameters), 0.0))])
    said = np.asarray(said.angular_acceleration)[: len(log)]
    time = np.arange(log.time[0], log.time[-1], 1 / RATE)
    rate, said, position = (_sampled(time, log.time, x) for x in (log.body_rate, said, log.position))
    low = butter(4, CORNER, fs=RATE, output="sos")
    return time, sosfiltfilt(low, np.gradient(rate, 1 / RATE, axis=0) - said, axis=0), position


def repeated(model: Quadrotor, one: FlightLog, other: FlightLog) -> Repeated:
    """Compare a model's residual angular accelerations in two flights of one reference, after aligning their paths.

    Args:
        model: the drone.
        one: first flight.
        other: second flight.

    Raises:
        CfbError: a flight is too short.
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
    """Overlapping rows of both flights if the second one is moved ``shift`` rows earlier."""
    first, second = max(0, -shift), max(0, shift)
    length = min(count - first, other - second)
    return slice(first, first + length), slice(second, second + length)
