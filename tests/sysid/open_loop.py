"""Short open-loop manoeuvres of the independent plant (`plant.py`): the experiment of the paper's identification.

The drone hovers motionless, then flies one of seven manoeuvres of half a second without any feedback: a roll, pitch or
yaw doublet, or a step of one motor. Nothing correlates input and error here, so every estimator may be used.
"""

from __future__ import annotations

import numpy as np
from plant import GRAVITY, PITCH, ROLL, SIGMA, THRUST, YAW, Plant, _rk4, cubic

from cfb_mjx.logs import FlightLog

TICK, ROW_TICKS = 0.001, 4
"""The plant's step, s, and steps per row of a log (250 Hz); commands change with the rows."""
ROW = TICK * ROW_TICKS
DELAY_ROWS = 2
"""Pose and velocity of a row are 8 ms old, as in real logs."""
HOVER, MANOEUVRE, LENGTH = 0.6, 0.5, 1.54
"""Of a flight, s. The evaluation protocol's windows start at 0.6, 0.8 and 1.0 s: they cover the manoeuvre."""
NOISE = {"position": 5e-4, "velocity": 0.01, "attitude": 1e-3, "body_rate": 0.02}
"""Standard deviations of white sensor noise: m, m/s, rad, rad/s."""
KINDS = 7


def draw_drone(rng: np.random.Generator) -> Plant:
    """One drone around the paper's: each moment of inertia within 20 %, J_m within 30 %, motor lag within 20 %."""
    while True:
        inertia = np.array([3.3e-5, 3.6e-5, 5.9e-5]) * rng.uniform(0.8, 1.2, 3)
        # Not every combination is a rigid body; keep clear of the flat plate, where MuJoCo refuses to compile.
        if 2 * inertia.max() < 0.98 * inertia.sum():
            break
    return Plant(
        inertia=inertia[None],
        rotor_inertia=5e-8 * rng.uniform(0.7, 1.3, 1),
        lag=0.05 * rng.uniform(0.8, 1.2, 1),
    )


def truth(plant: Plant) -> dict[str, float]:
    """The drawn quantities under the names of a fit, SI."""
    (xx, yy, zz), spin, lag = plant.inertia[0], plant.rotor_inertia[0], plant.lag[0]
    values = (xx, yy, zz, spin, lag)
    names = ("inertia_xx", "inertia_yy", "inertia_zz", "rotor_inertia", "motor_time_constant")
    return dict(zip(names, map(float, values), strict=True))


def commands(plant: Plant, repeats: int, rng: np.random.Generator) -> np.ndarray:
    """(7 * repeats, rows, 4) commands, amplitudes drawn anew for every flight."""
    time = np.arange(round(LENGTH / ROW)) * ROW - HOVER
    flights = []
    for i in range(KINDS * repeats):
        kind, size, sign = i % KINDS, rng.uniform(0.7, 1.3), rng.choice([-1.0, 1.0])
        if kind < 3:
            pattern, level, half = ((ROLL, 0.06, 0.1), (PITCH, 0.06, 0.1), (YAW, 0.2, 0.25))[kind]
            shape = np.where(time < half, 1.0, -1.0) * ((time >= 0) & (time < 2 * half - 1e-9))
        else:
            pattern, level = np.eye(4)[kind - 3], 0.04
            shape = ((time >= 0) & (time < 0.25)).astype(float)
        flights.append(_hover_speed(plant) / plant.gain[0] + sign * size * level * shape[:, None] * pattern)
    return np.round(np.array(flights), 6)


def fly(plant: Plant, repeats: int, rng: np.random.Generator) -> list[FlightLog]:
    """Fly the manoeuvres with one drone; 250 Hz logs with the sensors' noise and delay, without rotor speeds."""
    given = commands(plant, repeats, rng)
    count = len(given)
    many = Plant(*(np.repeat(np.asarray(x), count, axis=0) for x in vars(plant).values()))
    x = np.zeros((count, 17))
    x[:, 2], x[:, 6] = 1.0, 1.0
    x[:, 13:] = _hover_speed(plant)
    rows = []
    for row in range(given.shape[1]):
        rows.append(x.copy())
        for _ in range(ROW_TICKS):
            x = _rk4(many, x, given[:, row], 0.0, TICK)
    states = np.stack(rows, axis=1)
    thrust = np.maximum(cubic(THRUST, states[..., 13:] / SIGMA), 0).sum(-1) / plant.mass[0]

    def noisy(values, level):
        return values + level * rng.normal(size=values.shape)

    late = np.concatenate([np.repeat(states[:, :1], DELAY_ROWS, axis=1), states[:, :-DELAY_ROWS]], axis=1)
    quaternion = noisy(late[..., 6:10], NOISE["attitude"] / 2)
    force = noisy(np.stack([0 * thrust, 0 * thrust, thrust], axis=-1), 0.1)
    position, velocity = noisy(late[..., :3], NOISE["position"]), noisy(late[..., 3:6], NOISE["velocity"])
    body_rate = noisy(states[..., 10:13], NOISE["body_rate"])
    quaternion /= np.linalg.norm(quaternion, axis=-1, keepdims=True)
    return [
        FlightLog(
            time=np.arange(given.shape[1]) * ROW,
            position=position[i],
            velocity=velocity[i],
            quaternion=quaternion[i],
            body_rate=body_rate[i],
            specific_force=force[i],
            command=given[i],
            metadata={
                "name": f"manoeuvre{i}",
                "source": "plant",
                "format": "made",
                "observation_delay": DELAY_ROWS * ROW,
            },
        )
        for i in range(count)
    ]


def _hover_speed(plant: Plant) -> float:
    # The paper's cubic is monotonic from 0.2 up.
    grid = np.linspace(0.2, 1.0, 200001)
    return float(np.interp(plant.mass[0] * GRAVITY / 4, cubic(THRUST, grid), grid)) * SIGMA
