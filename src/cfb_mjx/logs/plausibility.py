"""Units and axis conventions judged by physics: signals of one log must agree with each other.

Each check speaks only when the signals are large enough to decide; a hovering drone passes them all.
The thresholds sit far from both sides: the mistakes looked for are factors of 57, 10 and 1000, while sensor faults and
unmodelled physics change the same ratios by tens of per cent.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from cfb_mjx.logs import rotation
from cfb_mjx.logs.flight_log import FlightLog

GRAVITY = 9.81
_WINDOW = 0.1  # s: long against noise and observation delay, short against a turn of half a revolution


def first_problem(log: FlightLog) -> str | None:
    """The first implausibility found, as half a sentence with its remedy; None for a plausible log."""
    return next((p for check in _CHECKS if (p := check(log)) is not None), None)


def _gyro(log: FlightLog) -> str | None:
    """Gyro against the rate at which the attitude turns: degrees per second, or a quaternion in another convention."""
    a, b = _pairs(log)
    gyro = _mean_between(log, log.body_rate, a, b)
    dt = (log.time[b] - log.time[a])[:, None]

    def attitude_rate(q):
        return rotation.rotation_vector(rotation.multiply(rotation.conjugate(q[a]), q[b])) / dt

    rate = attitude_rate(log.quaternion)
    if len(a) < 5 or _rms(rate) < 0.02:
        return None
    slope, correlation = _regress(rate, gyro)
    if correlation > 0.7 and slope > 20.0:
        return (
            f"the gyro wx wy wz is {slope:.1f} times the rate at which the attitude turns, so it looks like degrees "
            "per second; multiply it by pi/180"
        )
    if _rms(gyro) < 0.1 or _mismatch(rate, gyro) < 0.7:
        return None
    for reorder, remedy in _QUATERNION_REMEDIES:
        candidate = attitude_rate(reorder(log.quaternion))
        if _mismatch(candidate, gyro) < 0.4:
            return f"the attitude turns in a way the gyro contradicts (by {_mismatch(rate, gyro):.0%}), and {remedy}"
    return None


_QUATERNION_REMEDIES: tuple[tuple[Callable, str], ...] = (
    (
        lambda q: q[:, [3, 0, 1, 2]],
        "reading the quaternion as scalar-last [x, y, z, w] makes them agree; reorder the columns to [w, x, y, z]",
    ),
    (
        rotation.conjugate,
        "inverting the quaternion makes them agree, it is world to body; negate qx qy qz to get body to world",
    ),
    (
        lambda q: rotation.conjugate(q[:, [3, 0, 1, 2]]),
        "reading the quaternion as scalar-last and world to body makes them agree; "
        "reorder the columns to [w, x, y, z] and negate qx qy qz",
    ),
)


def _specific_force(log: FlightLog) -> str | None:
    """In flight as at rest the specific force is about 9.81 m/s^2 upwards; only a second of free fall is otherwise."""
    if log.duration < 1.0:
        return None
    size = float(np.median(np.linalg.norm(log.specific_force, axis=1)))
    up = float(np.median(log.specific_force[:, 2]))
    if 0.5 < size < 2.0:
        return f"the specific force ax ay az has a median of {size:.2f}, which looks like g; multiply it by {GRAVITY}"
    if not GRAVITY / 2 < size < GRAVITY * 2:
        return (
            f"the specific force ax ay az has a median of {size:.3g} instead of about {GRAVITY} m/s^2; give what the "
            "accelerometer reads, gravity included, in m/s^2"
        )
    if up < -GRAVITY / 2:
        return (
            f"the specific force along z has a median of {up:.2f} instead of +{GRAVITY} m/s^2; "
            "body axes must be forward, left, up"
        )
    return None


def _position(log: FlightLog) -> str | None:
    """Displacement against the integral of the velocity: millimetres or centimetres on either side."""
    a, b = _pairs(log)
    moved = log.position[b] - log.position[a]
    integral = _mean_between(log, log.velocity, a, b) * (log.time[b] - log.time[a])[:, None]
    if len(a) < 5:
        return None
    slope, correlation = _regress(integral, moved)
    if correlation > 0.7 and slope > 30.0:
        unit, factor = ("millimetres", 1000) if slope > 300.0 else ("centimetres", 100)
        return (
            f"the position px py pz changes {slope:.0f} times faster than the velocity says, so it looks like {unit}; "
            f"divide it by {factor}"
        )
    slope, correlation = _regress(moved, integral)
    if correlation > 0.7 and slope > 30.0:
        unit, factor = ("mm/s", 1000) if slope > 300.0 else ("cm/s", 100)
        return (
            f"the velocity vx vy vz is {slope:.0f} times the rate at which the position changes, "
            f"so it looks like {unit}; divide it by {factor}"
        )
    return None


_CHECKS = (_gyro, _specific_force, _position)


def _pairs(log: FlightLog) -> tuple[np.ndarray, np.ndarray]:
    """Row pairs (a, b) about `_WINDOW` apart, end to end, with no gap between them."""
    stride = max(1, round(_WINDOW / log.nominal_interval))
    a = np.arange(0, len(log) - stride, stride)
    b = a + stride
    gap_count = np.concatenate([[0], np.cumsum(np.diff(log.time) > log.gap_threshold)])
    clean = gap_count[a] == gap_count[b]
    return a[clean], b[clean]


def _mean_between(log: FlightLog, values: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Time average of ``values`` from row a to row b (trapezoids)."""
    dt = np.diff(log.time)[:, None]
    integral = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum((values[1:] + values[:-1]) / 2 * dt, axis=0)])
    return (integral[b] - integral[a]) / (log.time[b] - log.time[a])[:, None]


def _rms(x: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.sum(x**2, axis=-1)))) if len(x) else 0.0


def _mismatch(x: np.ndarray, reference: np.ndarray) -> float:
    return _rms(x - reference) / max(_rms(reference), 1e-12)


def _regress(x: np.ndarray, y: np.ndarray) -> tuple[float, float]:
    """Slope of y on x through the origin, and their uncentred correlation."""
    xx, yy, xy = float(np.sum(x * x)), float(np.sum(y * y)), float(np.sum(x * y))
    if xx <= 0.0 or yy <= 0.0:
        return 0.0, 0.0
    return xy / xx, xy / np.sqrt(xx * yy)
