"""An independent drone under feedback, in plain NumPy: many flights at once, each with its own physics.

None of the library's model code is used. The equations are the paper's; classical RK4 at 1 ms with commands held for
2 ms (checked against SciPy's DOP853 in test_fitting.py). A crude attitude and height controller keeps the drone in the
air while doublets excite it; an unmodelled wandering torque can be switched on.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from cfb_mjx.logs import FlightLog

THRUST, TORQUE, SIGMA, GRAVITY = (-0.23, 0.562, -0.043), (-3.4e-4, 8.7e-4, 2.9e-4), 2900.0, 9.81
ROLL, PITCH, YAW = np.array([-1, -1, 1, 1.0]), np.array([-1, 1, 1, -1.0]), np.array([-1, 1, -1, 1.0])
HALF = 0.03535
TICK, SUBSTEPS, ROW, DELAY_TICKS = 0.002, 2, 2, 4


@dataclass
class Plant:
    """Physics of F drones; every field broadcasts to (F,) or (F, 3)."""

    mass: np.ndarray = field(default_factory=lambda: np.array([0.044]))
    inertia: np.ndarray = field(default_factory=lambda: np.array([[3.3e-5, 3.6e-5, 5.9e-5]]))
    rotor_inertia: np.ndarray = field(default_factory=lambda: np.array([5e-8]))
    lag: np.ndarray = field(default_factory=lambda: np.array([0.05]))
    gain: np.ndarray = field(default_factory=lambda: np.array([2900.0]))
    thrust_scale: np.ndarray = field(default_factory=lambda: np.array([1.0]))
    torque_scale: np.ndarray = field(default_factory=lambda: np.array([1.0]))


def cross(a, b):
    """What NumPy's function says, in a quarter of its time."""
    (ax, ay, az), (bx, by, bz) = a.T, b.T
    return np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], axis=1)


def cubic(c, s):
    return s * (c[2] + s * (c[1] + s * c[0]))


def derivative(plant: Plant, x, u, push):
    """(F, 17) rate of change; ``push`` (F, 3) is the unmodelled angular acceleration."""
    q, w, speed = x[:, 6:10], x[:, 10:13], x[:, 13:17]
    s = speed / SIGMA
    thrust = plant.thrust_scale[:, None] * np.maximum(cubic(THRUST, s), 0)
    drag = plant.torque_scale[:, None] * cubic(TORQUE, s)
    speed_rate = (plant.gain[:, None] * u - speed) / plant.lag[:, None]
    torque = np.stack(
        [HALF * thrust @ ROLL, HALF * thrust @ PITCH, (plant.rotor_inertia[:, None] * speed_rate + drag) @ YAW], axis=1
    )
    rate = (torque - cross(w, plant.inertia * w)) / plant.inertia + push
    qw, qv = q[:, :1], q[:, 1:]
    q_rate = 0.5 * np.concatenate([-np.sum(qv * w, 1, keepdims=True), qw * w + cross(qv, w)], axis=1)
    up = np.stack(
        [
            2 * (q[:, 1] * q[:, 3] + q[:, 0] * q[:, 2]),
            2 * (q[:, 2] * q[:, 3] - q[:, 0] * q[:, 1]),
            1 - 2 * (q[:, 1] ** 2 + q[:, 2] ** 2),
        ],
        axis=1,
    )
    acceleration = up * (thrust.sum(1) / plant.mass)[:, None] - [0, 0, GRAVITY]
    return np.concatenate([x[:, 3:6], acceleration, q_rate, rate, speed_rate], axis=1)


def fly(
    plant: Plant,
    seconds: float,
    seed: int,
    disturbance: float = 0.0,
    noise: float = 1.0,
    measure_rotors: bool = True,
    goals: tuple[float, float, float] = (1.0, 1.0, 1.0),
    dither: float = 0.01,
    gyro_feedback: float = 1.0,
    loop: int = ROW,
    row: int = ROW,
) -> list[FlightLog]:
    """Fly F drones and return their logs (250 Hz rows unless told otherwise, pose and velocity 8 ms late).

    Args:
        plant: physics, batched.
        seconds: length.
        seed: of excitation, disturbance and noise.
        disturbance: rms of the wandering angular acceleration about x and y, rad/s^2 (a quarter of it about z).
        noise: factor on the sensors' noise.
        measure_rotors: whether the logs hold rotor speeds.
        goals: factors on the roll, pitch and yaw set-points.
        dither: rms of the noise added to the commands.
        gyro_feedback: factor on the controller's gains; 0 leaves the drone to itself.
        loop: ticks between commands; those between two rows are not logged.
        row: ticks between rows.
    """
    rng = np.random.default_rng(seed)
    count = len(plant.mass)
    ticks = round(seconds / TICK)
    hover_s = _hover(plant)
    x = np.zeros((count, 17))
    x[:, 2], x[:, 6], x[:, 13:17] = 1.0, 1.0, (hover_s * SIGMA)[:, None]
    hover_u = hover_s * SIGMA / plant.gain
    # Attitude doublets and yaw steps, a new one every 0.3 s, as set-points of the controller; and small dither.
    steps = ticks // 150 + 1
    goal = rng.uniform(-0.35, 0.35, (steps, count, 3)) * [1, 1, 2] * np.asarray(goals)
    push = np.zeros((count, 3))
    keep = np.exp(-TICK * 2 * np.pi * 2.0)  # corner at 2 Hz
    history, rows, last = [], [], None
    for tick in range(ticks):
        delayed = history[max(len(history) - DELAY_TICKS, 0)] if history else x
        q, w, height, climb = delayed[:, 6:10], x[:, 10:13], delayed[:, 2], delayed[:, 5]
        q = q * np.sign(q[:, :1])
        wanted = goal[tick // 150]
        command = 60 * (wanted - 2 * q[:, 1:]) - 14 * w * [1, 1, 0.7]
        command = gyro_feedback * command
        collective = 0.15 * (1.0 - height) - 0.12 * climb
        mix = 6e-4 * (command[:, :1] * ROLL + command[:, 1:2] * PITCH) + 1.2e-3 * command[:, 2:] * YAW
        u = np.clip(hover_u[:, None] + collective[:, None] + mix + dither * rng.normal(size=(count, 4)), 0.05, 0.95)
        u = last = u if tick % loop == 0 else last
        if tick % row == 0:
            rows.append((x.copy(), u.copy(), delayed.copy()))
        push = keep * push + disturbance * np.array([1, 1, 0.25]) * np.sqrt(1 - keep**2) * rng.normal(size=push.shape)
        history.append(x.copy())
        for _ in range(SUBSTEPS):
            x = _rk4(plant, x, u, push, TICK / SUBSTEPS)
    return _logs(plant, rows, row * TICK, rng, noise, measure_rotors)


def _rk4(plant, x, u, push, dt):
    k1 = derivative(plant, x, u, push)
    k2 = derivative(plant, x + 0.5 * dt * k1, u, push)
    k3 = derivative(plant, x + 0.5 * dt * k2, u, push)
    k4 = derivative(plant, x + dt * k3, u, push)
    x = x + dt / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    x[:, 6:10] /= np.linalg.norm(x[:, 6:10], axis=1, keepdims=True)
    return x


def _hover(plant: Plant) -> np.ndarray:
    grid = np.linspace(0.2, 1.0, 20001)
    return np.interp(plant.mass * GRAVITY / 4 / plant.thrust_scale, cubic(THRUST, grid), grid)


def _logs(plant, rows, interval, rng, noise, measure_rotors) -> list[FlightLog]:
    now, command, late = (np.stack([row[i] for row in rows]) for i in range(3))  # (n, F, .)
    time = np.arange(len(rows)) * interval
    thrust = np.maximum(cubic(THRUST, now[..., 13:17] / SIGMA), 0).sum(-1) * plant.thrust_scale / plant.mass
    logs = []
    for i in range(now.shape[1]):

        def noisy(values, level):
            return values + noise * level * rng.normal(size=values.shape)

        quaternion = noisy(late[:, i, 6:10], 0.0005)
        zero = np.zeros(len(time))
        logs.append(
            FlightLog(
                time=time,
                position=noisy(late[:, i, 0:3], 0.0005),
                velocity=noisy(late[:, i, 3:6], 0.01),
                quaternion=quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True),
                body_rate=noisy(now[:, i, 10:13], 0.02),
                specific_force=noisy(np.stack([zero, zero, thrust[:, i]], axis=1), 0.1),
                command=command[:, i],
                rotor_speed=noisy(now[:, i, 13:17], 3.0) if measure_rotors else None,
                battery_voltage=None,
                metadata={"name": f"plant{i}", "source": "plant", "format": "made", "observation_delay": 0.008},
            )
        )
    return logs
