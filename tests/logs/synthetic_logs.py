"""Synthetic flights with consistent physics: the signals agree as they must, so each trap can be set alone."""

import functools

import numpy as np

from cfb_mjx.logs import rotation
from cfb_mjx.logs.flight_log import OPTIONAL, REQUIRED, FlightLog, quantise_time

MASS, INERTIA = 0.044, np.array([3.3e-5, 3.6e-5, 5.9e-5])
THRUST, GAIN, TIME_CONSTANT, ARM = (-0.23, 0.562, -0.043, 0.0), 2900.0, 0.050, 0.0707 / 2
MIXER = np.array([[1, 1, 1, 1], [-ARM, -ARM, ARM, ARM], [-ARM, ARM, ARM, -ARM], [-1, 1, -1, 1]])


@functools.cache
def _truth(duration: float, seed: int, excitation: float, rate: float = 1000.0):
    """Attitude from prescribed smooth body rates; rotor speeds that produce exactly the torque this takes."""
    rng = np.random.default_rng(seed)
    t = np.arange(round(duration * rate) + 1) / rate
    frequency = np.array([0.4, 0.9, 2.1, 5.5, 7.7, 10.3, 13.1, 15.9])
    size = excitation * np.array([0.5, 0.7, 0.8, 0.5, 0.4, 0.3, 0.2, 0.15])
    phase = rng.uniform(0, 2 * np.pi, (len(frequency), 3))
    angle = 2 * np.pi * frequency[:, None] * t[:, None, None] + phase
    omega = np.sum(size[:, None] * np.sin(angle), axis=1) * [1.0, 1.0, 0.3]
    alpha = np.sum(size[:, None] * 2 * np.pi * frequency[:, None] * np.cos(angle), axis=1) * [1.0, 1.0, 0.3]
    steps = rotation.exponential((omega[1:] + omega[:-1]) / 2 / rate)
    q = np.empty((len(t), 4))
    q[0] = 1.0, 0.0, 0.0, 0.0
    for k, step in enumerate(steps):
        q[k + 1] = rotation.multiply(q[k], step)
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    thrust = MASS * 9.81 * (1.0 + 0.1 * excitation * np.sin(2 * np.pi * 0.5 * t))
    force = np.zeros((len(t), 3))
    force[:, 2] = thrust / MASS
    acceleration = rotation.to_world(q, force) - [0.0, 0.0, 9.81]
    velocity = np.cumsum(acceleration, axis=0) / rate
    position = np.cumsum(velocity, axis=0) / rate + [0.0, 0.0, 1.0]
    torque = INERTIA * alpha + np.cross(omega, INERTIA * omega)
    wrench = np.column_stack([thrust, torque[:, :2], np.zeros(len(t))])
    per_rotor = wrench @ np.linalg.inv(MIXER).T
    table = np.linspace(230.0, 2900.0, 4000)
    speed = np.interp(per_rotor, np.polyval(THRUST, table / GAIN), table)
    command = np.clip((speed + TIME_CONSTANT * np.gradient(speed, 1 / rate, axis=0)) / GAIN, 0.0, 1.0)
    return t, position, velocity, q, omega, force, command, speed


def make_flight(
    duration=8.0, rate=250.0, seed=0, excitation=1.0, rotor_speed=True, jitter=0.0, drop=(), motor_lead=0.0, noise=0.0
) -> FlightLog:
    """A synthetic flight.

    Args:
        jitter: uniform time stamp jitter as a fraction of the interval.
        drop: (start, stop) s intervals without rows.
        motor_lead: s by which the motor columns are ahead of the rest, so they must be delayed by it.
        noise: standard deviation of the gyro, rad/s; other sensors in proportion.
    """
    t, *signals = _truth(duration + 1.0, seed, excitation)
    rng = np.random.default_rng(seed + 1)
    rows = 0.5 + np.arange(round(duration * rate)) / rate
    rows = rows + rng.uniform(-0.5, 0.5, len(rows)) * jitter / rate
    for start, stop in drop:
        rows = rows[(rows - 0.5 < start) | (rows - 0.5 > stop)]

    def at(values, when):
        return np.column_stack([np.interp(when, t, column) for column in values.T])

    position, velocity, q, omega, force = (at(s, rows) for s in signals[:5])
    # A row's command holds until the next row: the one value that stands for a changing command is that of the middle.
    command, speed = at(signals[5], rows + motor_lead + 0.5 / rate), at(signals[6], rows + motor_lead)
    q /= np.linalg.norm(q, axis=1, keepdims=True)

    def noisy(x, size):
        return x + size * rng.standard_normal(x.shape)

    return FlightLog(
        time=quantise_time(rows - rows[0]),
        position=noisy(position, 0.02 * noise),
        velocity=noisy(velocity, 0.1 * noise),
        quaternion=rotation.tidy(q),
        body_rate=noisy(omega, noise),
        specific_force=noisy(force, noise),
        command=command,
        rotor_speed=noisy(speed, 50 * noise) if rotor_speed else None,
        battery_voltage=4.0 - 0.02 * rows,
        metadata={"name": "synthetic", "source": "synthetic", "format": "memory", "observation_delay": 0.0},
    )


def same_data(a: FlightLog, b: FlightLog) -> bool:
    """Bit for bit, NaN included."""
    for field in (*REQUIRED, *OPTIONAL):
        x, y = getattr(a, field), getattr(b, field)
        if (x is None) != (y is None) or (x is not None and x.tobytes() != y.tobytes()):
            return False
    return True
