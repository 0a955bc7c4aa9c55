"""An independent bench in plain NumPy: motors with two lags and a dead time, stepped at 0.5 ms.

None of the library's model code is used. Exact, as commands change and take effect at ticks only.
"""

from __future__ import annotations

import numpy as np

from cfb_mjx.logs.bench_tables import MotorRecord

TICK = 5e-4


def steps(rng: np.random.Generator, seconds: float, hold: float = 0.25, interval: float = 0.004) -> np.ndarray:
    """(n,) a command that jumps to a new level every ``hold`` seconds, with rows every ``interval``."""
    count = round(seconds / interval)
    levels = rng.uniform(0.25, 0.9, count)
    return levels[(np.arange(count) * interval / hold).astype(int)]


def record(
    command: np.ndarray,
    rng: np.random.Generator,
    up: float = 0.05,
    down: float = 0.05,
    dead: float = 0.0,
    gain: float = 2900.0,
    offset: float = 0.0,
    noise: float = 5.0,
    wander: float = 0.0,
    interval: float = 0.004,
    motors: tuple[int, ...] = (0,),
) -> MotorRecord:
    """A recording of motors that all follow ``command`` (n,), each with its own noise and wandering steady speed."""
    count = len(motors)
    speed = np.full(count, gain * command[0] + offset)
    shift = wander * rng.normal(size=count)
    per_row = round(interval / TICK)
    keep = np.exp(-TICK / 0.5)
    measured = []
    for row in range(len(command)):
        measured.append(speed)
        shift = keep**per_row * shift + wander * np.sqrt(1 - keep ** (2 * per_row)) * rng.normal(size=count)
        for tick in range(per_row):
            # What was commanded a dead time ago, to the tick.
            late = row * per_row + tick - round(dead / TICK)
            goal = gain * command[max(late, 0) // per_row] + offset + shift
            speed = goal + (speed - goal) * np.exp(-TICK / np.where(goal > speed, up, down))
    speeds = np.array(measured) + noise * rng.normal(size=(len(command), count))
    return MotorRecord("bench", np.arange(len(command)) * interval, np.tile(command[:, None], count), speeds, motors)
