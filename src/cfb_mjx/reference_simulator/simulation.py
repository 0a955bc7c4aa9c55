"""The time loop: many flights at once, each with its own drone, sensors and set-points. SI units."""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np

from cfb_mjx.reference_simulator import constants as c
from cfb_mjx.reference_simulator import physics
from cfb_mjx.reference_simulator.airframe import (
    BOB,
    BOB_V,
    ESC,
    LAGGED,
    LONGEST_WAKE,
    PLAIN_ROWS,
    ROWS,
    SPEED,
    P,
    Q,
    V,
    W,
    advance,
    rotation_of,
)
from cfb_mjx.reference_simulator.controller import DITHER, POSITION, YAW_ANGLE, Controller, OtherController, relative
from cfb_mjx.reference_simulator.sensors import Instruments, LowPass, Recorder

CHUNK = 250  # ticks of noise drawn at a time
# Columns of the noise: position, velocity, quaternion, gyro, and the inputs of push, twist and gust.
NOISES = 21
PUSH_KEEP = np.exp(-c.TICK / 0.3)
GUST_KEEP = np.exp(-c.TICK / 1.5)
HOVER_CURRENT, IDLE_CURRENT, RESISTANCE, DISCHARGE = 4.5, 0.3, 0.045, 6e-4  # A, A, ohm, V/C
CURRENT_KEEP = np.exp(-c.TICK / 0.03)
# Limits beyond which a flight counts as crashed: body rate, rad/s, and cosine of the tilt.
RATE_LIMIT, TILT_LIMIT = 15.0, np.cos(np.radians(80.0))
PLAYS = np.array([0.4, 1.0, 1.6])
"""Widths of the play elements of a speed controller, relative to their mean."""
EXTRA = frozenset({"esc_rate", "second_lag", "bob_mass", "flex"})
DELAY_RING = 16
WAKE_RING = round(LONGEST_WAKE / c.TICK) + 2
"""Ticks for which the positions of other drones are kept."""


@dataclass(frozen=True)
class Lane:
    """One flight to simulate.

    Attributes:
        drone: parameters, as `physics.nominal` gives them.
        instruments: sensors.
        setpoints: set-points at 100 Hz, (n, 17), flown after a warm-up at the first one.
        rows: ticks of the rows, from the start of the log.
        voltage: voltage of the unloaded battery at the start, V.
        gyro_bias: bias of the gyro, (3,), rad/s.
        rng: generator of the noise in the control loop.
        other: index of the lane of another drone that flies at the same time; this drone feels its wake.
    """

    drone: dict[str, np.ndarray]
    instruments: Instruments
    setpoints: np.ndarray
    rows: np.ndarray
    voltage: float
    gyro_bias: np.ndarray
    rng: np.random.Generator
    other: int | None = None


@dataclass(frozen=True)
class Flight:
    """Recorded signals of a flight.

    Attributes:
        crashed: whether the flight crashed.
        pose: delayed position, velocity and quaternion, (n, 10).
        inertial: gyro, accelerometer and voltage, (n, 7).
        motors: commands and rotor speeds, (n, 8).
    """

    crashed: bool
    pose: np.ndarray
    inertial: np.ndarray
    motors: np.ndarray


def simulate(lanes: list[Lane], other: OtherController | None = None) -> list[Flight]:
    """Simulate all flights at once. A flight depends on that of its ``other`` drone, and on no further one.

    Args:
        lanes: flights to simulate.
        other: controller of all flights instead of the built-in one. All its estimates are delayed, the gyro too.
    """
    loop = _Loop(lanes, other)
    for tick in range(loop.ticks):
        loop.step(tick)
    return [
        Flight(bool(loop.crashed[i]), loop.pose.lane(i), loop.inertial.lane(i), loop.motors.lane(i))
        for i in range(len(lanes))
    ]


class _Loop:
    """State of the simulation of all lanes."""

    def __init__(self, lanes: list[Lane], other: OtherController | None):
        count = len(lanes)
        self.lanes, self.other, self.memory = lanes, other, None
        self.p = p = physics.stack([lane.drone for lane in lanes])
        self.goals = _padded([lane.setpoints for lane in lanes])
        self.ends = np.array([c.WARM_UP_TICKS + len(lane.setpoints) * c.SETPOINT_TICKS for lane in lanes])
        shift, extra = p.motor_shift.astype(int), p.extra_delay.astype(int)
        rows = [c.WARM_UP_TICKS + lane.rows for lane in lanes]
        self.pose = Recorder([r - e for r, e in zip(rows, extra, strict=True)], 10)
        self.inertial = Recorder(rows, 7)
        # The motor columns of a row have the values of `motor_shift` ticks earlier.
        self.motors = Recorder([r - s for r, s in zip(rows, shift, strict=True)], 8)
        self.ticks = int(self.ends.max()) + max(0, -int(shift.min())) + 1
        self.x = self.start = _start(p, self.goals[0])
        self.levels = _levels([lane.instruments for lane in lanes])
        self.gyro_bias = np.stack([lane.gyro_bias for lane in lanes], axis=1)
        self.controller, self.low_pass = Controller(count), LowPass(p.gyro_corner)
        self.past = [self.x[: W.start]] * c.POSE_TICKS
        self.past_gyro = [self.x[W]] * c.POSE_TICKS
        self.commands = np.full((DELAY_RING, 4, count), c.HOVER_SPEED / c.MOTOR_GAIN)
        self.driven, self.plays = self.commands, np.tile(self.commands[0], (len(PLAYS), 1, 1))
        if "play" in p.on:
            self.driven = self.commands.copy()
        self.wander = np.zeros((8, count))
        self.jolt = _jolts([lane.instruments for lane in lanes])
        self.phase = np.array([lane.rng.uniform(0, 2 * np.pi) for lane in lanes])
        self.heat = np.zeros((4, count))
        self.charge, self.current = np.zeros(count), np.full(count, HOVER_CURRENT)
        self.resting = np.array([lane.voltage for lane in lanes])
        self.crashed = np.zeros(count, dtype=bool)
        # A drone that flies alone would feel its own wake, whose coefficient is zero.
        self.source = np.array([i if lane.other is None else lane.other for i, lane in enumerate(lanes)])
        self.p.wake = p.wake * np.array([lane.other is not None for lane in lanes])
        self.wakes, self.newest = np.zeros((0, 7, count)), 0

    def step(self, tick: int) -> None:
        """Simulate one tick: measure, control, record, integrate."""
        if tick % CHUNK == 0:
            self.noise = np.stack([lane.rng.standard_normal((CHUNK, NOISES)) for lane in self.lanes], axis=-1)
        noise = self.noise[tick % CHUNK] * self.levels
        self.past.append(self.x[: W.start])
        late = self.past.pop(0) + noise[:10]
        late[Q] /= np.sqrt((late[Q] ** 2).sum(0))
        gyro = self.x[W] + noise[10:13] + self.gyro_bias
        goal = self.goals[min(max(tick - c.WARM_UP_TICKS, 0) // c.SETPOINT_TICKS, len(self.goals) - 1)]
        command = self._decide(tick, goal, late, gyro)
        voltage = self._battery()
        held = self._held(noise, voltage)
        self.commands[tick % DELAY_RING] = command
        if "play" in self.p.on:
            self.driven[tick % DELAY_RING] = self._played(command)
        moved, specific = self._move(tick, held)
        self.pose(tick, late)
        self.inertial(tick, self.low_pass(gyro), specific, voltage[None])
        self.motors(tick, command, self.x[SPEED])
        moved[V] += self.jolt * noise[13:16]
        self.x = moved
        if tick % 5 == 0:
            self._check(tick)

    def _decide(self, tick, goal, late, gyro):
        """Return commands (4, F) of the built-in controller, or of the other one, held between its control steps."""
        if self.other is None:
            return self.controller(goal, SimpleNamespace(position=late[P], velocity=late[V], quaternion=late[Q]), gyro)
        self.past_gyro.append(gyro)
        late_gyro = self.past_gyro.pop(0)
        if tick % self.other.every:
            return self.commands[(tick - 1) % DELAY_RING]
        self.memory, command = self.other.fly(self.memory, relative(goal, late, late_gyro))
        return np.rint(np.clip(command + goal[DITHER], 0.0, 1.0) * 65535) / 65535

    def _played(self, command):
        """Return the output of speed controllers with play: a mean of play elements, mixed with the command itself."""
        width = PLAYS[:, None, None] * self.p.play
        self.plays = np.clip(self.plays, command - width, command + width)
        return command + self.p.play_share * (self.plays.mean(axis=0) - command)

    def _move(self, tick, held):
        step, time = c.TICK / c.SUBSTEPS, tick * c.TICK
        x, first = advance(self.p, self.x, self._arrived(tick, 0), held, time, step)
        for sub in range(1, c.SUBSTEPS):
            x, _ = advance(self.p, x, self._arrived(tick, sub), held, time + sub * step, step)
        return x, first

    def _arrived(self, tick, sub):
        """Return the commands at the motors, after the delay of each lane (whole substeps)."""
        if "delay_ms" not in self.p.on:
            return self.driven[tick % DELAY_RING]
        past = (c.SUBSTEPS * tick + sub - self.p.delay_ms.astype(int)) // c.SUBSTEPS
        return self.driven[past % DELAY_RING, :, np.arange(len(self.lanes))].T

    def _battery(self):
        """Return the battery voltage (F,); it falls with the charge drawn and with the current."""
        load = IDLE_CURRENT + (HOVER_CURRENT - IDLE_CURRENT) / 4 * ((self.x[SPEED] / c.HOVER_SPEED) ** 3).sum(0)
        self.current = CURRENT_KEEP * self.current + (1 - CURRENT_KEEP) * load
        self.charge += c.TICK * self.current
        return self.resting - DISCHARGE * self.charge - RESISTANCE * (self.current - HOVER_CURRENT)

    def _held(self, noise, voltage):
        """Return the inputs that are constant over a tick."""
        p = self.p
        keep = PUSH_KEEP
        self.wander[:6] = keep * self.wander[:6] + np.sqrt(1 - keep**2) * noise[13:19]
        self.wander[6:] = GUST_KEEP * self.wander[6:] + np.sqrt(1 - GUST_KEEP**2) * noise[19:21]
        gain = p.gain
        if "sag" in p.on:
            gain = gain * np.maximum(voltage / p.sag_voltage, 0.1) ** p.sag
        if "thermal_drop" in p.on:
            self.heat += c.TICK / p.thermal_time * ((self.x[SPEED] / c.HOVER_SPEED) ** 3 - self.heat)
            gain = gain * (1 - p.thermal_drop * np.tanh(self.heat) / np.tanh(1.0))
        return SimpleNamespace(
            gain=gain,
            push=self.wander[:3],
            twist=self.wander[3:6],
            gust=p.gust * self.wander[6:],
            phase=self.phase,
            past=self._past() if "wake" in p.on else None,
        )

    def _past(self):
        """Return a function of an age (F,) in s: where the other drones were, and their thrust."""
        x = self.x[:, self.source]
        thrust = c.thrust_curve(x[SPEED]).sum(0)
        now = np.concatenate([x[P], rotation_of(x[Q])[:, 2], thrust[None]])
        if not len(self.wakes):
            self.wakes = np.repeat(now[None], WAKE_RING, axis=0)
        self.newest = newest = (self.newest + 1) % WAKE_RING
        self.wakes[newest] = now
        kept, lanes = self.wakes, np.arange(len(self.lanes))

        def past(age):
            ticks = np.broadcast_to(age, lanes.shape) / c.TICK
            before = np.minimum(ticks.astype(int), WAKE_RING - 2)
            share = ticks - before
            later, earlier = (kept[(newest - before - k) % WAKE_RING, :, lanes].T for k in (0, 1))
            found = later + share * (earlier - later)
            return found[:3], found[3:6], found[6]

        return past

    def _check(self, tick):
        """Mark crashed flights, and reset them to hover so that they do not overflow."""
        x = self.x
        level = 1 - 2 * (x[7] ** 2 + x[8] ** 2)
        wild = (np.abs(x[W]).max(0) > RATE_LIMIT) | (level < TILT_LIMIT) | (x[2] < 0.0)
        wild |= (np.abs(x[P]).max(0) > 30.0) | ~np.isfinite(x).all(0)
        if wild.any():
            self.crashed |= wild & (tick < self.ends)
            self.x = np.where(wild, self.start, x)


def _levels(instruments: list[Instruments]) -> np.ndarray:
    """Standard deviations of the noise columns, (21, F)."""
    return np.array(
        [
            [i.position] * 3 + [i.velocity] * 3 + [i.quaternion] * 4 + [i.gyro] * 3 + [i.push] * 3
            + [i.twist, i.twist, 0.4 * i.twist, 1.0, 1.0]
            for i in instruments
        ]
    ).T  # fmt: skip


def _jolts(instruments: list[Instruments]) -> np.ndarray:
    """Ratio of the velocity step per tick to the input of ``push``, (F,); both use the same draws."""
    return np.array([i.jolt / i.push if i.push else 0.0 for i in instruments]) * np.sqrt(c.TICK)


def _padded(setpoints: list[np.ndarray]) -> np.ndarray:
    """Set-points padded to equal length, (n, 17, F); a flight that has ended holds its last position."""
    length = max(map(len, setpoints))
    goals = np.zeros((length, setpoints[0].shape[1], len(setpoints)))
    for lane, own in enumerate(setpoints):
        goals[: len(own), :, lane] = own
        goals[len(own) :, POSITION, lane] = own[-1, POSITION]
        goals[len(own) :, YAW_ANGLE, lane] = own[-1, YAW_ANGLE]
    goals[0, POSITION.stop : YAW_ANGLE] = 0.0
    goals[0, YAW_ANGLE + 1 : DITHER.stop] = 0.0
    return goals


def _start(p: SimpleNamespace, goal: np.ndarray) -> np.ndarray:
    """Initial state: level and at rest at the first set-point, rotors at hover speed, a bob hanging straight down."""
    x = np.zeros((ROWS if p.on & EXTRA else PLAIN_ROWS, goal.shape[1]))
    x[P], x[6] = goal[POSITION], 1.0
    x[SPEED] = c.HOVER_SPEED
    if len(x) > PLAIN_ROWS:
        x[ESC] = x[LAGGED] = c.HOVER_SPEED / c.MOTOR_GAIN
        x[BOB.stop - 1] = -p.bob_length
        x[BOB_V] = 0.0
    return x
