"""One-step innovations of a motor: first-order lag with its own time constant for spin-up and spin-down, dead time.

``Omega' = (K u(t - d) + offset + b - Omega) / T``, with ``T`` that of spin-up where the steady speed lies above the
rotor speed and that of spin-down where it lies below (paper eq. 5 with one T and d = 0). ``b`` wanders
(Ornstein-Uhlenbeck): battery and load move the steady speed, and a controller answers what they do to the flight, so
that its commands are correlated with them. Why the likelihood of one-step innovations is not bent by that:
`cfb_mjx.sysid.identification.innovation`, whose rotor filter this one generalises.

Between two events, a row or a command taking effect, everything is constant and the speed never crosses its target,
so the exponential is exact for any sampling and the dead time is continuous: events are sorted by time, not counted
in rows.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from cfb_mjx.sysid.rotors.motor_tracks import Tracks

NAMES = ("motor_gain", "motor_speed_offset", "spin_up_time_constant", "spin_down_time_constant", "dead_time")
OFFSET_UNIT, DEAD_TIME_UNIT = 1000.0, 0.01
"""rad/s and s that the unknowns of order one stand for."""
CORRELATION_TIME = 0.5
"""Of the wandering steady speed, s: below about 1/(2 pi 0.5 s) = 0.3 Hz it is constant, above it wanders."""


class Motor(eqx.Module):
    """Constants of a motor and the levels of its noise. All scalars."""

    gain: Float[Array, ""]
    """K, rad/s."""
    offset: Float[Array, ""]
    """rad/s."""
    spin_up: Float[Array, ""]
    """Time constant while the steady speed is above the rotor speed, s."""
    spin_down: Float[Array, ""]
    """Time constant while it is below, s."""
    dead_time: Float[Array, ""]
    """From a command to its first effect, s. Negative where rotor speeds are stamped earlier than commands."""
    reading: Float[Array, ""]
    """White noise of a rotor speed row, rad/s."""
    walk: Float[Array, ""]
    """White angular acceleration of the rotor, rad/s per square root of a second."""
    wander: Float[Array, ""]
    """Wandering error of the steady speed, rad/s."""

    @staticmethod
    def from_vector(x: Float[Array, "8"]) -> Motor:
        """From logarithms and unit offsets; a floor keeps a vanishing noise level from flattening the likelihood."""
        up, down = jnp.exp(jnp.clip(x[2:4], jnp.log(1e-4), jnp.log(10.0)))
        return Motor(
            jnp.exp(x[0]),
            OFFSET_UNIT * x[1],
            up,
            down,
            DEAD_TIME_UNIT * x[4],
            jnp.exp(x[5]) + 1e-2,
            jnp.exp(x[6]) + 1e-1,
            jnp.exp(x[7]) + 1e-1,
        )


class Events(eqx.Module):
    """Rows and commands taking effect, in order of time: (2N, S) each, time first for the scan."""

    time: Array
    """Since the piece's first row, s."""
    command: Array
    """That takes effect, where ``switches``."""
    switches: Array
    rotor_speed: Array
    measured: Array
    judged: Array

    @property
    def interval(self) -> Array:
        """Since the event before, s."""
        return jnp.diff(self.time, axis=0, prepend=self.time[:1])


def events(motor: Motor, tracks: Tracks) -> Events:
    """Merge rows with the commands, which act ``dead_time`` later; differentiable in the dead time."""
    zero = jnp.zeros(tracks.time.shape)
    # What was commanded before the first row is not known: its command is taken to have held.
    effect = jnp.maximum(tracks.time + motor.dead_time, 0.0)
    commands = (effect, tracks.command, zero + 1, zero, zero, zero)
    rows = (tracks.time, zero, zero, tracks.rotor_speed, tracks.measured, tracks.judged)
    columns = [jnp.concatenate(pair, axis=1) for pair in zip(commands, rows, strict=True)]
    return Events(*(c.T for c in jax.lax.sort(columns, dimension=1, is_stable=True, num_keys=1)))


def innovations(motor: Motor, tracks: Tracks) -> tuple[Float[Array, "e s"], Float[Array, "e s"], Float[Array, "e s"]]:
    """Errors of predicting every rotor speed from the rows before it, rad/s, their variances, and which are judged.

    In order of events; zero and one where there is nothing to judge.
    """
    happening = events(motor, tracks)
    r, q, d = motor.reading**2, motor.walk**2, motor.wander**2

    def step(carry, inputs):
        x, b, pxx, pxb, pbb, command = carry
        interval, event = inputs
        goal = motor.gain * command + motor.offset + b
        lag = jnp.where(goal > x, motor.spin_up, motor.spin_down)
        keep, decay = jnp.exp(-interval / CORRELATION_TIME), jnp.exp(-interval / lag)
        gain = 1 - decay
        x, b = goal + decay * (x - goal), keep * b
        pxx, pxb, pbb = (
            decay**2 * pxx + 2 * decay * gain * pxb + gain**2 * pbb + q * lag / 2 * (1 - decay**2),
            keep * (decay * pxb + gain * pbb),
            keep**2 * pbb + d * (1 - keep**2),
        )
        s, e = pxx + r, event.rotor_speed - x
        kx, kb = event.measured * pxx / s, event.measured * pxb / s
        x, b = x + kx * e, b + kb * e
        pxx, pxb, pbb = (1 - kx) * pxx, (1 - kx) * pxb, pbb - kb * pxb
        command = jnp.where(event.switches > 0, event.command, command)
        return (x, b, pxx, pxb, pbb, command), (e, s)

    zero = jnp.zeros(tracks.time.shape[0])
    start = (tracks.rotor_speed[:, 0], zero, zero + r, zero, zero + d, tracks.command[:, 0])
    _, (error, variance) = jax.lax.scan(step, start, (happening.interval, happening))
    judged = happening.judged
    return jnp.where(judged > 0, error, 0.0), jnp.where(judged > 0, variance, 1.0), judged


def negative_log_likelihood(motor: Motor, tracks: Tracks) -> Float[Array, ""]:
    """Of all innovations, nats, without the constant."""
    error, variance, _ = innovations(motor, tracks)
    return 0.5 * jnp.sum(jnp.log(variance) + error**2 / variance)


def simulate(motor: Motor, tracks: Tracks) -> Float[Array, "s n"]:
    """Rotor speeds that follow from the commands alone, from the measured first row of every piece, rad/s."""
    happening = events(motor, tracks)

    def step(carry, event):
        x, command = carry
        interval, new, switches = event
        goal = motor.gain * command + motor.offset
        lag = jnp.where(goal > x, motor.spin_up, motor.spin_down)
        x = goal + jnp.exp(-interval / lag) * (x - goal)
        return (x, jnp.where(switches > 0, new, command)), x

    start = (tracks.rotor_speed[:, 0], tracks.command[:, 0])
    _, speed = jax.lax.scan(step, start, (happening.interval, happening.command, happening.switches))
    # The events that are rows, in their order.
    rows = jnp.argsort(happening.switches.T, axis=1, stable=True)[:, : tracks.time.shape[1]]
    return jnp.take_along_axis(speed.T, rows, axis=1)
