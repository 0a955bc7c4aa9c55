"""A disturbance observer: what a flight's own past says about the next half second.

Real drones fly under torques and forces no model knows, and these change slowly. Along the log Kalman filters carry,
per body axis, the body rate with a wandering angular acceleration, and a wandering specific force; per motor, where
rotor speed was measured, the error of the modelled rotor speed with a wandering error of its steady value. What they
know at a window's start is added to the prediction, fading with its own time constant (``docs/nanodrone.md``).

Causal: the estimate at a row rests on gyro, accelerometer, commands and rotor speeds up to that row. Attitude and
velocity enter the model's effects only, read ``observation_delay`` late as a window's initial state is.
"""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from cfb_mjx.logs import FlightLog
from cfb_mjx.model.effects.base import Condition, Effect, Memory, Motors, Wrench
from cfb_mjx.model.quadrotor import Quadrotor
from cfb_mjx.model.vector import Vec
from cfb_mjx.parameters.parameters import Parameters
from cfb_mjx.sysid.flight import Flight, prepare_flight
from cfb_mjx.sysid.replay import replay
from cfb_mjx.sysid.windows import Windows


@dataclasses.dataclass(frozen=True)
class Observer:
    """Noise levels of the filters: standard deviations and correlation times."""

    gyro: float = 0.02
    """White noise of a gyro row, rad/s."""
    rate_walk: float = 0.3
    """White angular acceleration, rad/s per square root of a second."""
    torque: float = 6.0
    """Quickly wandering angular acceleration, rad/s^2."""
    torque_time: float = 0.3
    """Its correlation time, s."""
    trim: float = 10.0
    """Slowly wandering angular acceleration, rad/s^2."""
    trim_time: float = 10.0
    """Its correlation time, s."""
    accelerometer: float = 1.0
    """White noise of an accelerometer row, m/s^2."""
    force: float = 0.7
    """Wandering specific force, m/s^2."""
    force_time: float = 0.7
    """Its correlation time, s."""
    rotor: float = 10.0
    """White noise of a rotor speed row, rad/s."""
    rotor_walk: float = 30.0
    """White rotor acceleration, rad/s per square root of a second."""
    rotor_offset: float = 30.0
    """Wandering error of the steady rotor speed, rad/s."""
    rotor_offset_time: float = 1.0
    """Its correlation time, s."""
    filtered_rate: bool = True
    rotor_feedback: bool = True


class Observed(eqx.Module):
    """What the observer knows at each row of a log (or at each window's start), from that row and earlier ones."""

    body_rate: Float[Array, "n 3"]
    """Filtered, rad/s."""
    torque: Float[Array, "n 3"]
    """Angular acceleration that fades with ``torque_time``, rad/s^2."""
    trim: Float[Array, "n 3"]
    """Angular acceleration that fades with ``trim_time``, rad/s^2."""
    force: Float[Array, "n 3"]
    """Specific force, body axes, m/s^2."""
    rotor_speed: Float[Array, "n 4"]
    """Of the model driven by the commands, corrected by what was measured, rad/s."""
    rotor_offset: Float[Array, "n 4"]
    """Error of the steady rotor speed, rad/s."""
    angular_acceleration: Float[Array, "n 3"]
    innovation: Any = None


def _causal_rotor_speed(log: FlightLog, length: int) -> np.ndarray | None:
    """Measured rotor speeds with holes filled from the past."""
    if log.rotor_speed is None or (np.isfinite(log.rotor_speed).mean(axis=0) < 0.98).any():
        return None
    out = log.rotor_speed.copy()
    for motor in range(4):
        good = np.isfinite(out[:, motor])
        last = np.maximum.accumulate(np.where(good, np.arange(len(out)), -1))
        out[:, motor] = np.where(last >= 0, out[np.maximum(last, 0), motor], out[np.argmax(good), motor])
    return np.concatenate([out, np.repeat(out[-1:], length - len(out), axis=0)])


@eqx.filter_jit
def _observe(model: Quadrotor, flight: Flight, driven, levels, use_measured: bool) -> Observed:
    flight = eqx.tree_at(lambda f: f.measured, flight, jnp.asarray(1.0 if use_measured else 0.0))
    said = replay(model, flight, driven, jnp.zeros(()))
    lag = jnp.mean(model.changed_parameters().motor_time_constant)
    o = levels

    def body(carry, row):
        w, a, b, f, p = carry
        dt, alpha, force, gyro, acceleration, fresh = row
        # state (w, a, b), covariance (3, 3), the same for the three axes
        ka, kb = jnp.exp(-dt / o.torque_time), jnp.exp(-dt / o.trim_time)
        step = jnp.array([[1.0, 0, 0], [0, 1, 0], [0, 0, 1]]).at[0, 1].set(o.torque_time * (1 - ka)).at[0, 2].set(dt)
        step = step.at[1, 1].set(ka).at[2, 2].set(kb)
        grown = step @ p @ step.T + jnp.diag(
            jnp.stack([o.rate_walk**2 * dt, o.torque**2 * (1 - ka**2), o.trim**2 * (1 - kb**2)])
        )
        w, a, b = w + dt * (alpha + b) + o.torque_time * (1 - ka) * a, ka * a, kb * b
        s = grown[0, 0] + o.gyro**2
        gain = grown[:, 0] / s
        e = gyro - w
        w, a, b = w + gain[0] * e, a + gain[1] * e, b + gain[2] * e
        p = grown - jnp.outer(gain, grown[0])
        # after a gap
        restart = jnp.diag(jnp.stack([o.gyro**2, o.torque**2, grown[2, 2]]))
        w = jnp.where(fresh > 0, gyro, w)
        a = jnp.where(fresh > 0, 0.0, a)
        p = jnp.where(fresh > 0, restart, p)
        kf = jnp.exp(-dt / o.force_time)
        d, q = f
        d, q = kf * d, kf**2 * q + o.force**2 * (1 - kf**2)
        g = q / (q + o.accelerometer**2)
        ef = acceleration - force - d
        d, q = d + jnp.where(fresh > 0, 0.0, g) * ef, jnp.where(fresh > 0, q, (1 - g) * q)
        return (w, a, b, (d, q), p), (w, a, b, d, e, s)

    def rotor(carry, row):
        x, b, pxx, pxb, pbb = carry
        dt, error, fresh = row
        keep, decay = jnp.exp(-dt / o.rotor_offset_time), jnp.exp(-dt / lag)
        mix = 1 - decay
        x, b = decay * x + mix * b, keep * b
        pxx, pxb, pbb = (
            decay**2 * pxx + 2 * decay * mix * pxb + mix**2 * pbb + o.rotor_walk**2 * dt,
            keep * (decay * pxb + mix * pbb),
            keep**2 * pbb + o.rotor_offset**2 * (1 - keep**2),
        )
        s, e = pxx + o.rotor**2, error - x
        kx, kb = pxx / s, pxb / s
        x, b = x + kx * e, b + kb * e
        pxx, pxb, pbb = (1 - kx) * pxx, (1 - kx) * pxb, pbb - kb * pxb
        return (x, b, pxx, pxb, pbb), (x, b)

    zero = jnp.zeros(3)
    first = (
        flight.body_rate[0],
        zero,
        zero,
        (zero, jnp.asarray(o.force**2)),
        jnp.diag(jnp.stack([o.gyro**2, o.torque**2, o.trim**2])),
    )
    before = lambda x: jnp.concatenate([x[:1], x[:-1]])  # noqa: E731
    interval = jnp.concatenate([jnp.zeros(1), flight.interval[:-1]])
    rows = (
        interval,
        before(said.angular_acceleration),
        before(said.specific_force),
        flight.body_rate,
        flight.specific_force,
        flight.fresh,
    )
    _, (w, a, b, d, e, s) = jax.lax.scan(body, first, rows)
    speed, offset = said.rotor_speed, jnp.zeros_like(said.rotor_speed)
    if use_measured:
        error = driven - said.rotor_speed
        z = jnp.zeros(4)
        start = (error[0], z, z + o.rotor**2, z, z + o.rotor_offset**2)
        _, (x, offset) = jax.lax.scan(rotor, start, (interval, error, flight.fresh))
        speed = said.rotor_speed + x
    return Observed(w, a, b, d, speed, offset, before(said.angular_acceleration), (e, s))


class Disturbance(Effect):
    """Adds a fading angular acceleration, specific force and error of the steady rotor speed."""

    name: ClassVar[str] = "observed_disturbance"
    units: ClassVar[dict[str, str]] = {
        "torque_time": "s",
        "trim_time": "s",
        "force_time": "s",
        "rotor_offset_time": "s",
    }
    source: ClassVar[str] = ""
    prior: ClassVar[dict[str, tuple[float, float]]] = {}
    strengths: ClassVar[tuple[str, ...]] = ()

    torque_time: Array
    trim_time: Array
    force_time: Array
    rotor_offset_time: Array

    def start(self, rotor_speed: Vec, parameters: Parameters) -> Memory:
        zero = jnp.zeros_like(rotor_speed[0])
        three = Vec(zero, zero, zero)
        return three, three, three, Vec(zero, zero, zero, zero)

    def motors(
        self, motors: Motors, rotor_speed: Vec, memory: Memory, dt: Any, parameters: Parameters
    ) -> tuple[Motors, Memory]:
        return Motors(motors.target + memory[3], motors.time_constant), memory

    def body(self, wrench: Wrench, condition: Condition) -> Wrench:
        torque, trim, force, _ = condition.memory
        parameters = condition.parameters
        pushed = force * parameters.mass
        turning = parameters.inertia.map(lambda j, a: j * a, torque + trim)
        return Wrench(
            wrench.force + pushed, wrench.torque + turning + parameters.center_of_gravity.cross(pushed)
        )

    def advance(self, condition: Condition, acceleration: Vec, dt: Any) -> Memory:
        times = (self.torque_time, self.trim_time, self.force_time, self.rotor_offset_time)
        return tuple(m * jnp.exp(-dt / t) for m, t in zip(condition.memory, times, strict=True))
