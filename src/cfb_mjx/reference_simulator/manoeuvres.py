"""Set-point generators with random parameters.

Each takes a Generator, a duration (s) and ``vigour`` (1, less after a crash) and returns set-points (n, 17) at 100 Hz.
The columns are those of `cfb_mjx.reference_simulator.controller`.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np

from cfb_mjx.reference_simulator.constants import SETPOINT_TICKS, TICK
from cfb_mjx.reference_simulator.controller import (
    ACCELERATION,
    DITHER,
    POSITION,
    RATES,
    SETPOINT_COLUMNS,
    VELOCITY,
    YAW_ANGLE,
    YAW_RATE,
)

STEP = SETPOINT_TICKS * TICK
ROOM = np.array([2.4, 2.4])  # half the room along x and y, m
MANOEUVRES: dict[str, Callable[[np.random.Generator, float, float], np.ndarray]] = {}


def manoeuvre(generate):
    """Register a generator under the name of its function."""
    MANOEUVRES[generate.__name__] = generate
    return generate


def _still(seconds: float, place) -> np.ndarray:
    goal = np.zeros((round(seconds / STEP), SETPOINT_COLUMNS))
    goal[:, POSITION] = place
    return goal


def _route(seconds: float, rng, points, speed: float, pull: float, pause=(0.1, 0.4)) -> np.ndarray:
    """Smooth rest-to-rest moves between draws of ``points()``, up to ``speed`` m/s and ``pull`` m/s^2."""
    place = points()
    goal = _still(seconds, place)
    start = round(rng.uniform(*pause) / STEP)
    while start < len(goal) - 20:
        target = points()
        distance = np.linalg.norm(target - place)
        length = max(1.875 * distance / speed, np.sqrt(5.77 * distance / pull), 0.3)
        count = round(length / STEP)
        s = np.linspace(0, 1, count + 1)[1:, None]
        part = slice(start, min(start + count, len(goal)))
        s = s[: part.stop - start]
        step = target - place
        goal[part, POSITION] = place + step * s**3 * (10 - 15 * s + 6 * s**2)
        goal[part, VELOCITY] = step / length * 30 * s**2 * (1 - s) ** 2
        goal[part, ACCELERATION] = step / length**2 * 60 * s * (1 - s) * (1 - 2 * s)
        goal[part.stop :, POSITION] = target
        place, start = target, part.stop + round(rng.uniform(*pause) / STEP)
    return goal


def _box(rng, low: float, high: float, side: float = 1.0):
    return lambda: np.array([*rng.uniform(-side * ROOM, side * ROOM), rng.uniform(low, high)])


def _envelope(count: int) -> np.ndarray:
    """Envelope that rises from 0 to 1 in the first second and falls in the last."""
    t = np.arange(count) * STEP
    return np.clip(np.minimum(t, t[-1] - t), 0, 1)


def _kicks(goal, rng, size: float, every=(0.5, 1.2)) -> None:
    """Add doublets of roll or pitch rate of up to ``size`` rad/s."""
    start = round(rng.uniform(0.2, 0.6) / STEP)
    while start < len(goal) - 60:
        half = round(rng.uniform(0.06, 0.14) / STEP)
        axis, way = rng.integers(2), rng.choice([-1, 1]) * rng.uniform(0.6, 1.0) * size
        goal[start : start + half, RATES.start + axis] += way
        goal[start + half : start + 3 * half, RATES.start + axis] -= way
        goal[start + 3 * half : start + 4 * half, RATES.start + axis] += way
        start += 4 * half + round(rng.uniform(*every) / STEP)


def _sines(goal, rng, column: int, size: float, low: float, high: float, count: int = 5) -> None:
    """Add a sum of sines of rms ``size`` / sqrt(2) and frequencies ``low`` to ``high`` Hz to a column."""
    t = np.arange(len(goal))[:, None] * STEP
    frequency, phase = rng.uniform(low, high, count), rng.uniform(0, 2 * np.pi, count)
    goal[:, column] += size / np.sqrt(count) * np.sin(2 * np.pi * frequency * t + phase).sum(1) * _envelope(len(goal))


def _dither(goal, rng, size: float) -> None:
    """Add random levels to the command of each motor, held for random times."""
    for motor in range(DITHER.start, DITHER.stop):
        holds = rng.integers(1, 12, len(goal))
        levels = np.repeat(size * rng.uniform(-1, 1, len(goal)), holds)[: len(goal)]
        goal[:, motor] += levels


def _yaw(goal, rng, rate: float, turn: float, pause=(0.5, 2.0)) -> None:
    """Add repeated yaw turns of up to ``turn`` rad at up to ``rate`` rad/s."""
    speed = np.zeros(len(goal))
    start = round(rng.uniform(*pause) / STEP)
    while start < len(goal) - 50:
        count = max(20, round(rng.uniform(0.3, 1.0) * 1.5 * turn / rate / STEP))
        bump = np.sin(np.pi * np.arange(count) / count) ** 2
        speed[start : start + count] += (rng.choice([-1, 1]) * rate * rng.uniform(0.7, 1.0) * bump)[: len(goal) - start]
        start += count + round(rng.uniform(*pause) / STEP)
    goal[:, YAW_RATE] += speed
    goal[:, YAW_ANGLE] += np.cumsum(speed) * STEP


def crossing(rng, below: np.ndarray) -> np.ndarray:
    """Set-points of a second drone that crosses over one with the set-points ``below``, at changing heights."""
    goal = np.zeros_like(below)
    t = np.arange(len(below)) * STEP
    # It follows the other slowly, and sweeps over it.
    width = round(1.5 / STEP)
    padded = np.pad(below[:, POSITION], ((width, width), (0, 0)), mode="edge")
    window = np.hanning(width) / np.hanning(width).sum()
    middle = np.stack([np.convolve(x, window, mode="same")[width:-width] for x in padded.T], axis=1)
    for axis, period in ((0, rng.uniform(2.5, 3.5)), (1, rng.uniform(4.0, 6.0))):
        middle[:, axis] += rng.uniform(0.2, 0.35) * np.sin(2 * np.pi * t / period + rng.uniform(0, 2 * np.pi))
    rise = 0.55 + 0.25 * np.sin(2 * np.pi * t / rng.uniform(9.0, 13.0) + rng.uniform(0, 2 * np.pi))
    # A drone that sinks as fast as its wake flies in it, so this one keeps its height while the other climbs and sinks.
    reach = round(3.0 / STEP)
    highest = np.pad(below[:, POSITION.stop - 1], (2 * reach, 2 * reach), mode="edge")
    highest = np.max(np.lib.stride_tricks.sliding_window_view(highest, 2 * reach + 1), axis=1)
    window = np.hanning(2 * reach + 1) / np.hanning(2 * reach + 1).sum()
    middle[:, 2] = np.convolve(highest, window, mode="valid") + rise
    goal[:, POSITION] = middle
    goal[:, VELOCITY] = np.gradient(middle, STEP, axis=0)
    goal[:, ACCELERATION] = np.gradient(goal[:, VELOCITY], STEP, axis=0)
    return goal


@manoeuvre
def lateral(rng, seconds, vigour):
    goal = _route(
        seconds, rng, _box(rng, 0.8, 1.5), rng.uniform(3.7, 4.1) * vigour, rng.uniform(5.0, 6.5) * vigour, (0.0, 0.3)
    )
    if rng.random() < 0.5:
        _yaw(goal, rng, rng.uniform(0.4, 1.2), 2.0)
    return goal


@manoeuvre
def roll_pitch_excitation(rng, seconds, vigour):
    goal = _still(seconds, [0, 0, rng.uniform(0.9, 1.5)])
    _kicks(goal, rng, rng.uniform(2.2, 3.2) * vigour)
    for axis in (RATES.start, RATES.start + 1):
        _sines(goal, rng, axis, rng.uniform(0.4, 0.8) * vigour, 0.7, 5.0)
    return goal


@manoeuvre
def vertical(rng, seconds, vigour):
    centre = rng.uniform(-0.5, 0.5, 2)
    top = itertools.cycle([False, True])

    def points():
        return np.array([*centre, rng.uniform(2.0, 2.9) if next(top) else rng.uniform(0.4, 0.9)])

    return _route(seconds, rng, points, rng.uniform(2.4, 3.2) * vigour, 5.5 * vigour, (0.05, 0.5))


@manoeuvre
def low_altitude(rng, seconds, vigour):
    def points():
        height = rng.uniform(0.05, 0.2) if rng.random() < 0.7 else rng.uniform(0.2, 1.0)
        return np.array([*rng.uniform(-0.5, 0.5, 2), height])

    return _route(seconds, rng, points, rng.uniform(0.4, 0.7), 1.5 * vigour, (0.2, 1.2))


@manoeuvre
def motor_excitation(rng, seconds, vigour):
    goal = _still(seconds, [0, 0, rng.uniform(0.9, 1.5)])
    _dither(goal, rng, rng.uniform(0.04, 0.08) * vigour)
    for motor in range(DITHER.start, DITHER.stop):
        _sines(goal, rng, motor, rng.uniform(0.008, 0.02) * vigour, 2.0, 15.0)
    return goal


@manoeuvre
def hover(rng, seconds, vigour):
    goal = _still(seconds, [*rng.uniform(-0.3, 0.3, 2), rng.uniform(0.7, 1.4)])
    _yaw(goal, rng, 0.5, 0.8, (3.0, 6.0))
    return goal


MANOEUVRES["long_hover"] = hover


def _orbit(rng, seconds, width, depth, pace, double) -> np.ndarray:
    """Ellipse or figure eight; the phase rate is ramped at the start and the end."""
    goal = _still(seconds, [0, 0, rng.uniform(0.8, 1.5)])
    rate = pace * np.clip(_envelope(len(goal)) / 0.9, 0, 1) * rng.choice([-1, 1])
    phase = np.cumsum(rate) * STEP
    goal[:, 0], goal[:, 1] = width * np.cos(phase), depth * np.sin(double * phase)
    goal[:, 2] += rng.uniform(0, 0.3) * np.sin(0.4 * phase)
    for to, source in ((VELOCITY, POSITION), (ACCELERATION, VELOCITY)):
        goal[:, to] = np.gradient(goal[:, source], STEP, axis=0)
    if rng.random() < 0.6:
        _yaw(goal, rng, rng.uniform(0.5, 1.5), 2.0, (0.3, 1.5))
    return goal


@manoeuvre
def figure8(rng, seconds, vigour):
    width = rng.uniform(1.3, 2.0)
    return _orbit(rng, seconds, width, 0.5 * width, rng.uniform(2.4, 3.0) * vigour / width / 1.2, 2)


@manoeuvre
def circle(rng, seconds, vigour):
    radius = rng.uniform(1.6, 2.2)
    return _orbit(rng, seconds, radius, radius, min(rng.uniform(2.7, 3.5), np.sqrt(6.0 * radius)) * vigour / radius, 1)


@manoeuvre
def waypoints(rng, seconds, vigour):
    goal = _route(seconds, rng, _box(rng, 0.05, 2.0, 0.8), rng.uniform(2.0, 3.5) * vigour, 5.0 * vigour, (0.1, 0.8))
    _yaw(goal, rng, rng.uniform(0.8, 2.0), 2.5)
    return goal


@manoeuvre
def mixed_excitation(rng, seconds, vigour):
    goal = _route(seconds, rng, _box(rng, 0.6, 1.8, 0.5), rng.uniform(1.5, 2.5) * vigour, 3.5 * vigour)
    _kicks(goal, rng, 2.0 * vigour, (0.8, 2.0))
    _dither(goal, rng, 0.04 * vigour)
    _yaw(goal, rng, rng.uniform(1.0, 2.5), 2.5, (0.5, 1.5))
    return goal


@manoeuvre
def yaw_recovery(rng, seconds, vigour):
    goal = _route(seconds, rng, _box(rng, 0.6, 1.6, 0.5), 1.5 * vigour, 2.5 * vigour, (0.3, 1.0))
    _yaw(goal, rng, rng.uniform(3.0, 4.0) * vigour, 4.0, (0.2, 0.8))
    for start in rng.integers(100, len(goal), 4):  # steps
        goal[start:, YAW_ANGLE] += rng.choice([-1, 1]) * rng.uniform(0.8, 2.0)
    _kicks(goal, rng, 1.5 * vigour, (1.0, 2.0))
    return goal


@manoeuvre
def climb_dive(rng, seconds, vigour):
    low = itertools.cycle([False, True])

    def points():
        height = rng.uniform(0.05, 0.12) if next(low) else rng.uniform(1.0, 2.2)
        return np.array([*rng.uniform(-0.8, 0.8, 2), height])

    return _route(seconds, rng, points, rng.uniform(1.8, 2.6) * vigour, 3.5 * vigour, (0.1, 0.7))
