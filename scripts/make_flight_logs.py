"""Make the flight logs in ``data/flight_logs`` with a simulator and a controller that are independent of the library.

The plant is an independent implementation of the paper's equations (1-10) in NumPy, integrated by SciPy between control
ticks. An evaluation of the library on these logs therefore compares two programs. Only writing the files uses cfb_mjx.

    python scripts/make_flight_logs.py [FOLDER]
"""

from __future__ import annotations

import sys
import time as clock
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.integrate import solve_ivp

from cfb_mjx.logs import FlightLog, write_mcap

FOLDER = Path(__file__).resolve().parents[1] / "data" / "flight_logs"

# The drone: the paper's values with propeller guards.
MASS, GRAVITY = 0.044, 9.81
INERTIA = np.array([3.3e-5, 3.6e-5, 5.9e-5])
MOTOR_LAG, MOTOR_GAIN, ROTOR_INERTIA, SPACING = 0.05, 2900.0, 0.5e-7, 0.0707
THRUST = np.array([-0.23, 0.562, -0.043])
TORQUE = 1e-4 * np.array([-3.4, 8.7, 2.9])
# Roll, pitch, yaw torque per unit thrust or torque of M1 front-right, M2 back-right, M3 back-left, M4 front-left.
LEVER = SPACING / 2 * np.array([[-1, -1, 1, 1], [-1, 1, 1, -1]])
YAW = np.array([-1.0, 1.0, -1.0, 1.0])

TICK = 0.002
"""The controller runs and changes the commands every 2 ms."""
ROW = 2
"""Ticks per row of the log: 250 Hz."""
DELAY = 4
"""Delay of pose and velocity in ticks: 8 ms."""
SETTLE = 100
"""Ticks simulated before the first row, so that the delayed signals have a history."""


@dataclass(frozen=True)
class Noise:
    """Standard deviations of the white noise of sensors and estimator."""

    position: float = 0.5e-3  # m
    velocity: float = 5e-3  # m/s
    attitude: float = 1.5e-3  # rad, about each body axis
    gyro: float = 0.01  # rad/s
    accelerometer: float = 0.1  # m/s^2
    rotor_speed: float = 2.0  # rad/s
    voltage: float = 5e-3  # V

    def scaled(self, factor: float) -> Noise:
        """Return the noise with every standard deviation multiplied by ``factor``."""
        return replace(self, **{name: factor * value for name, value in vars(self).items()})


@dataclass(frozen=True)
class Flight:
    """A flight to simulate.

    Attributes:
        drag: linear air drag of the body, N s/m, which the library's declared model does not have.
        direction: sign of the figure eight along y.
        size: size of the figure eight; 0 hovers.
        kicks: disturbances of the commands about yaw, (time [s], size) each.
    """

    name: str
    description: str
    seed: int
    drag: float = 0.0
    direction: float = 1.0
    seconds: float = 12.0
    size: float = 1.0
    kicks: tuple[tuple[float, float], ...] = ()


FLIGHTS = (
    Flight("figure8", "figure eight; the plant has exactly the parameters of cfb-guards", seed=8),
    Flight("drag", "figure eight; the plant has linear air drag of 0.05 N s/m", seed=9, drag=0.05, direction=-1.0),
    Flight(
        "yaw",
        "hover, disturbed about yaw three times; the plant has exactly the parameters of cfb-guards",
        seed=10,
        seconds=5.0,
        size=0.0,
        kicks=((1.0, 0.3), (2.4, -0.3), (3.8, 0.3)),
    ),
)
KICK_S = 0.16
"""Duration of a kick, s."""


# ---------------------------------------------------------------------------------------------------- the plant


def rotation_matrix(q: np.ndarray) -> np.ndarray:
    """Rotation matrix from body to world axes of the quaternion [w, x, y, z]."""
    w, x, y, z = q / np.sqrt(q @ q)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def thrust_and_torque(speed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Thrust [N] and torque [N m] of each rotor at its speed [rad/s]."""
    s = speed / MOTOR_GAIN
    powers = np.array([s**3, s**2, s])
    return np.maximum(THRUST @ powers, 0.0), TORQUE @ powers


def specific_force(y: np.ndarray, drag: float) -> np.ndarray:
    """Reading of an ideal accelerometer: force without gravity per mass, body axes, m/s^2."""
    force = -drag * rotation_matrix(y[6:10]).T @ y[3:6]
    force[2] += thrust_and_torque(y[13:17])[0].sum()
    return force / MASS


def derivative(_, y: np.ndarray, command: np.ndarray, drag: float) -> np.ndarray:
    """Time derivative of the state: position, velocity (world), quaternion, body rate, rotor speeds."""
    q, rate, speed = y[6:10], y[10:13], y[13:17]
    thrust, torque = thrust_and_torque(speed)
    acceleration = rotation_matrix(q)[:, 2] * (thrust.sum() / MASS) - drag / MASS * y[3:6]
    acceleration[2] -= GRAVITY
    spin = (MOTOR_GAIN * command - speed) / MOTOR_LAG
    moment = np.array([*(LEVER @ thrust), YAW @ (ROTOR_INERTIA * spin + torque)])
    a, b, c = rate
    ja, jb, jc = INERTIA * rate
    gyroscopic = np.array([b * jc - c * jb, c * ja - a * jc, a * jb - b * ja])
    w, i, j, k = q
    turn = 0.5 * np.array([-i * a - j * b - k * c, w * a + j * c - k * b, w * b + k * a - i * c, w * c + i * b - j * a])
    return np.concatenate([y[3:6], acceleration, turn, (moment - gyroscopic) / INERTIA, spin])


def fly_tick(y: np.ndarray, command: np.ndarray, drag: float) -> np.ndarray:
    """Return the state one control tick later, with the command held."""
    # A tick is far shorter than any time constant: DOP853 needs one step for 1e-10.
    solution = solve_ivp(
        derivative, (0.0, TICK), y, method="DOP853", rtol=1e-9, atol=1e-10, first_step=TICK, args=(command, drag)
    )
    y = solution.y[:, -1].copy()
    y[6:10] /= np.linalg.norm(y[6:10])
    return y


# ----------------------------------------------------------------------------------------------- the controller


def reference(t: float, flight: Flight) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Reference position, velocity, acceleration and heading at time t [s]: a figure eight that begins in hover."""
    # The phase rate rises smoothly over two seconds, so that the acceleration of the reference is continuous.
    fraction = np.clip(t / 2.0, 0.0, 1.0)
    full = 1.4
    rate = full * (3 * fraction**2 - 2 * fraction**3)
    rate_change = full * (6 * fraction - 6 * fraction**2) / 2.0
    phase = full * (2.0 * (fraction**3 - fraction**4 / 2) + max(t - 2.0, 0.0))
    size = flight.size * np.array([1.1, 0.65 * flight.direction, 0.25])
    often = np.array([1.0, 2.0, 1.0])
    angle = often * phase
    curve, slope, bend = np.sin(angle), often * np.cos(angle), -(often**2) * np.sin(angle)
    position = np.array([0.0, 0.0, 1.2]) + size * curve
    return (
        position,
        size * slope * rate,
        size * (bend * rate**2 + slope * rate_change),
        flight.size * 0.5 * np.sin(0.6 * phase),
    )


def control(t: float, seen: np.ndarray, speed: np.ndarray, flight: Flight) -> np.ndarray:
    """Geometric position controller: commands from the reported state and the rotor speeds that it expects."""
    position, velocity, q, rate = seen[:3], seen[3:6], seen[6:10], seen[10:13]
    p, v, a, heading = reference(t, flight)
    wanted = a + 6.0 * (p - position) + 4.0 * (v - velocity) + np.array([0.0, 0.0, GRAVITY])
    matrix = rotation_matrix(q)
    up = wanted / np.linalg.norm(wanted)
    left = np.cross(up, [np.cos(heading), np.sin(heading), 0.0])
    left /= np.linalg.norm(left)
    target = np.column_stack([np.cross(left, up), left, up])
    error = 0.5 * (matrix.T @ target - target.T @ matrix)
    turn = np.array([error[2, 1], error[0, 2], error[1, 0]])
    moment = INERTIA * (np.array([110.0, 110.0, 25.0]) * turn - np.array([15.0, 15.0, 6.0]) * rate)
    # Thrusts for the wanted force and moment; yaw uses the torque-to-thrust ratio near hover.
    mix = np.vstack([np.ones(4), LEVER, YAW * 6e-3])
    thrust = np.linalg.solve(mix, [MASS * max(wanted @ matrix[:, 2], 2.0), *moment])
    # Invert the thrust curve, then add lead so that the motors respond in 20 ms instead of 50 ms.
    s = np.interp(thrust, *_CURVE)
    return np.clip(speed / MOTOR_GAIN + 2.5 * (s - speed / MOTOR_GAIN), 0.05, 1.0)


def kick(t: float, flight: Flight) -> np.ndarray:
    """Disturbance of the commands at time t [s]."""
    return sum((size for at, size in flight.kicks if at <= t < at + KICK_S), 0.0) * YAW


_GRID = np.linspace(0.15, 1.0, 400)
_CURVE = (thrust_and_torque(_GRID * MOTOR_GAIN)[0], _GRID)


# -------------------------------------------------------------------------------------------------- the sensors


def turned(q: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Return q after a small rotation about body axes [rad]."""
    w, x, y, z = q
    a, b, c = vector / 2
    product = np.array([w - x * a - y * b - z * c, x + w * a + y * c - z * b, y + w * b + z * a - x * c])
    product = np.append(product, z + w * c + x * b - y * a)
    return product / np.linalg.norm(product)


def fly(flight: Flight, noise: Noise) -> FlightLog:
    """Simulate the flight and return its log."""
    random = np.random.default_rng(flight.seed)
    hover = np.interp(MASS * GRAVITY / 4, *_CURVE) * MOTOR_GAIN
    y = np.concatenate([reference(0.0, flight)[0], np.zeros(3), [1, 0, 0, 0], np.zeros(3), np.full(4, hover)])
    past = [y] * (DELAY + 1)
    deviation = np.repeat(
        [noise.position, noise.velocity, noise.attitude, noise.gyro, noise.rotor_speed, noise.accelerometer],
        [3, 3, 3, 3, 4, 3],
    )
    # The controller uses the rotor speeds that its commands should have produced. With measured speeds, the commands
    # would contain their noise, and a log at half the rate would not contain all commands.
    expected = y[13:17]
    charge, rows = 0.0, []
    for tick in range(-SETTLE, round(flight.seconds / TICK) + 1):
        # Draw the same number of samples at every tick, so that changes elsewhere do not change the noise.
        e = deviation * random.standard_normal(19)
        late = past[0]
        seen = np.concatenate([late[:6] + e[:6], turned(late[6:10], e[6:9]), y[10:13] + e[9:12], y[13:17] + e[12:16]])
        t = tick * TICK
        command = control(max(t, 0.0), seen, expected, flight) + kick(t, flight)
        expected = MOTOR_GAIN * command + (expected - MOTOR_GAIN * command) * np.exp(-TICK / MOTOR_LAG)
        # The voltage falls with the charge and with the current, which is taken as proportional to the rotor power. The
        # firmware compensates for it, so it does not affect the motors.
        power = thrust_and_torque(y[13:17])[1] @ y[13:17]
        charge += power * TICK
        voltage = 4.05 - 0.0015 * charge - 0.02 * power + noise.voltage * random.standard_normal()
        if tick >= 0 and tick % ROW == 0:
            force = specific_force(y, flight.drag) + e[16:19]
            rows.append(np.concatenate([seen, force, command, [voltage]]))
        y = fly_tick(y, command, flight.drag)
        past = [*past[1:], y]
    # Single precision, as the firmware logs it; the files shrink by half.
    table = np.array(rows).astype(np.float32).astype(np.float64)
    quaternion = table[:, 6:10] / np.linalg.norm(table[:, 6:10], axis=1, keepdims=True)
    return FlightLog(
        time=np.arange(len(table)) * ROW * TICK,
        position=table[:, 0:3],
        velocity=table[:, 3:6],
        quaternion=quaternion,
        body_rate=table[:, 10:13],
        specific_force=table[:, 17:20],
        command=table[:, 20:24],
        rotor_speed=table[:, 13:17],
        battery_voltage=table[:, 24],
        metadata={
            "name": flight.name,
            "source": "scripts/make_flight_logs.py",
            "description": flight.description,
            "observation_delay": DELAY * TICK,
            "vehicle_mass": MASS,
            "simulated": True,
            "seed": flight.seed,
        },
    )


def main(folder: Path = FOLDER) -> None:
    """Write all logs into ``folder``."""
    folder.mkdir(parents=True, exist_ok=True)
    for flight in FLIGHTS:
        begin = clock.perf_counter()
        log = fly(flight, Noise())
        path = folder / f"{flight.name}.mcap"
        write_mcap(log, path)
        speed = np.linalg.norm(log.velocity, axis=1).max()
        print(
            f"{path}: {len(log)} rows, {path.stat().st_size / 1e6:.2f} MB, up to {speed:.1f} m/s, "
            f"{clock.perf_counter() - begin:.0f} s"
        )


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:2]))
