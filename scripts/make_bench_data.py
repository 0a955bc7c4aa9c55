"""Make the bench measurements in ``data/bench``: step responses of a motor, and force and torque of rotors.

The paper's own bench data are not public. Motor and rotor are simulated with equations 5, 8 and 9 of the paper in NumPy
and SciPy; no code of cfb_mjx is used.

    python scripts/make_bench_data.py [FOLDER]
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from scipy.integrate import solve_ivp

FOLDER = Path(__file__).resolve().parents[1] / "data" / "bench"
MOTOR_LAG, MOTOR_GAIN = 0.05, 2900.0
THRUST = np.array([-0.23, 0.562, -0.043])
TORQUE = 1e-4 * np.array([-3.4, 8.7, 2.9])

STEPS = (0.3, 0.7, 0.4, 0.9, 0.5, 0.6, 0.2, 0.8, 0.3)
HELD_S, ROW_S = 0.4, 0.004
SPEED_NOISE = 5.0  # rad/s
POINTS = np.linspace(400.0, 2800.0, 13)
FORCE_NOISE, TORQUE_NOISE = 1e-3, 1e-5  # N, N m


def motor_steps(random: np.random.Generator) -> np.ndarray:
    """Simulate the step responses; return a table with the columns t, u, omega."""
    speed, rows = MOTOR_GAIN * STEPS[0], []
    for number, command in enumerate(STEPS):
        at = np.arange(0.0, HELD_S - 1e-9, ROW_S)
        solved = solve_ivp(
            lambda _, y, u=command: (MOTOR_GAIN * u - y) / MOTOR_LAG,
            (0.0, HELD_S),
            [speed],
            t_eval=[*at, HELD_S],
            rtol=1e-9,
            atol=1e-6,
        ).y[0]
        rows.append(np.stack([number * HELD_S + at, np.full_like(at, command), solved[:-1]], axis=1))
        speed = solved[-1]
    table = np.concatenate(rows)
    table[:, 2] += SPEED_NOISE * random.standard_normal(len(table))
    return table


def rotor_points(random: np.random.Generator) -> np.ndarray:
    """Simulate rotors at constant speeds; return a table with the columns omega, force, torque, motor."""
    speed = np.tile(POINTS, 4) + random.uniform(-40.0, 40.0, 4 * len(POINTS))
    s = speed / MOTOR_GAIN
    powers = np.stack([s**3, s**2, s])
    force = THRUST @ powers + FORCE_NOISE * random.standard_normal(len(s))
    torque = TORQUE @ powers + TORQUE_NOISE * random.standard_normal(len(s))
    return np.stack([speed, force, torque, np.repeat(np.arange(1, 5), len(POINTS))], axis=1)


def main(folder: Path = FOLDER) -> None:
    """Write both tables into ``folder``."""
    folder.mkdir(parents=True, exist_ok=True)
    random = np.random.default_rng(5)
    np.savetxt(
        folder / "motor_steps.csv",
        motor_steps(random),
        fmt=("%.3f", "%.3f", "%.2f"),
        delimiter=",",
        header="t,u,omega",
        comments="",
    )
    np.savetxt(
        folder / "rotor_points.csv",
        rotor_points(random),
        fmt=("%.2f", "%.6f", "%.4e", "%d"),
        delimiter=",",
        header="omega,force,torque,motor",
        comments="",
    )


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:2]))
