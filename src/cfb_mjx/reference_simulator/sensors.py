"""Sampling times, noise and filters of the sensors. SI units."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cfb_mjx.reference_simulator import constants as c


@dataclass(frozen=True)
class Instruments:
    """Sensors of one campaign: standard deviations of noise, sampling, and the unexplained accelerations."""

    position: float
    velocity: float
    quaternion: float
    gyro: float
    accelerometer: float
    rotor_speed: float
    battery: float
    push: float  # m/s^2 rms
    twist: float  # rad/s^2 rms about x and y; 0.4 of it about z
    irregular: bool
    measures_rotors: bool
    jolt: float = 0.0
    """Random walk of the velocity in addition to ``push``, m/s after one second.

    The steps are too short for the accelerometer.
    """


QUIET = Instruments(*(0.0,) * 9, irregular=False, measures_rotors=True)


def draw_instruments(rng: np.random.Generator) -> Instruments:
    """Draw the sensors of one campaign."""

    def about(value: float) -> float:
        return value * rng.uniform(0.85, 1.15)

    return Instruments(
        position=about(4e-4),
        velocity=about(4e-3),
        quaternion=about(5e-4),
        gyro=rng.uniform(0.015, 0.02),
        accelerometer=rng.uniform(0.2, 0.3),
        rotor_speed=about(7.0),
        battery=about(8e-3),
        push=0.02 * 2 ** rng.uniform(-1, 1),
        twist=0.15 * 2 ** rng.uniform(-1, 1),
        irregular=bool(rng.random() < 0.4),
        measures_rotors=bool(rng.random() < 0.6),
        # A separate generator, so that the other draws do not change.
        jolt=_jolt(*rng.spawn(1)),
    )


def _jolt(rng: np.random.Generator) -> float:
    """Draw the jolt; zero in half of the campaigns."""
    return float(rng.uniform(0.02, 0.06)) if rng.random() < 0.5 else 0.0


def row_ticks(rng: np.random.Generator, ticks: int, irregular: bool, dropouts: bool) -> np.ndarray:
    """Draw the ticks of the rows of a log of ``ticks``, counted from its start."""
    rows = np.arange(0, ticks, c.ROW_TICKS)
    if irregular:
        rows = np.unique(np.clip(rows + np.rint(rng.normal(0, 0.4, len(rows))).astype(int), 0, ticks - 1))
    if dropouts:
        for _ in range(rng.integers(1, 5)):
            begin = rng.integers(0, ticks)
            rows = rows[(rows < begin) | (rows >= begin + rng.uniform(0.02, 0.2) / c.TICK)]
    return rows


class Recorder:
    """Records columns of the running simulation at the ticks of each lane."""

    def __init__(self, ticks: list[np.ndarray], width: int):
        """Take the sorted ticks to record of each lane, and the number of columns."""
        lengths = np.array([len(t) for t in ticks])
        self.ends = np.cumsum(lengths)
        self.slots = self.ends - lengths
        self.starts = self.slots.copy()
        self.ticks = np.concatenate([*ticks, [-1]])
        # -1 marks a lane without rows; it would otherwise use the first tick of the next lane.
        self.next = np.where(lengths > 0, self.ticks[self.slots], -1)
        self.rows = np.zeros((int(lengths.sum()), width))

    def __call__(self, tick: int, *columns: np.ndarray) -> None:
        """Record ``columns``, each (k, F), of the lanes that have a row at ``tick``."""
        lanes = np.flatnonzero(self.next == tick)
        if not lanes.size:
            return
        slots, at = self.slots[lanes], 0
        for values in columns:
            self.rows[slots, at : at + len(values)] = values[:, lanes].T
            at += len(values)
        self.slots[lanes] = slots = slots + 1
        self.next[lanes] = np.where(slots < self.ends[lanes], self.ticks[slots], -1)

    def lane(self, index: int) -> np.ndarray:
        """Return the rows of a lane, (n, width)."""
        return self.rows[self.starts[index] : self.ends[index]]


class LowPass:
    """Second-order Butterworth low-pass of the gyro, with a corner frequency per lane; 0 does not filter."""

    def __init__(self, corner: np.ndarray):
        k = np.tan(np.pi * np.minimum(corner, 0.45 / c.TICK) * c.TICK)
        scale = 1 / (1 + np.sqrt(2) * k + k**2)
        self.passes = corner <= 0
        self.b = k**2 * scale
        self.a1, self.a2 = 2 * (k**2 - 1) * scale, (1 - np.sqrt(2) * k + k**2) * scale
        self.s1, self.s2 = np.zeros((3, len(corner))), np.zeros((3, len(corner)))

    def __call__(self, value: np.ndarray) -> np.ndarray:
        out = self.b * value + self.s1
        self.s1 = 2 * self.b * value - self.a1 * out + self.s2
        self.s2 = self.b * value - self.a2 * out
        return np.where(self.passes, value, out)
