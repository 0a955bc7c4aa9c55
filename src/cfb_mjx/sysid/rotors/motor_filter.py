"""One-step innovations of a motor with first-order lag, separate spin-up and spin-down time constants, and dead time.

``Omega' = (K u(t - d) + offset + b - Omega) / T``, where ``T`` is the spin-up constant if the steady speed is above the
rotor speed and the spin-down constant if it is below (paper eq. 5: one T, d = 0). ``b`` is an Ornstein-Uhlenbeck
process: battery and load change the steady speed, and the controller responds to the consequences, so the commands are
correlated with it. This does not bias the likelihood of one-step innovations; see
`cfb_mjx.sysid.identification.innovation`, whose rotor filter this one generalises.

Between two events (a row, or a command that takes effect) the command is constant and the speed never crosses its
target. So the exponential solution is exact for any sampling. Events are sorted by time rather than counted in rows, so
the dead time is continuous.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from cfb_mjx.sysid.rotors.motor_tracks import Tracks

NAMES = ("motor_gain", "motor_speed_offset", "spin_up_time_constant", "spin_down_time_constant", "dead_time")
OFFSET_UNIT, DEAD_TIME_UNIT = 1000.0, 0.01
"""Units of the unknowns for offset, rad/s, and dead time, s; the unknowns are then of order one."""
CORRELATION_TIME = 0.5
"""Correlation time of the error of the steady speed, s; the corner frequency is 1/(2 pi 0.5 s) = 0.3 Hz."""


class Motor(eqx.Module):
    """Constants and noise levels of a motor, all scalars."""

    gain: Float[Array, ""]
    """K, rad/s."""
    offset: Float[Array, ""]
    """Steady speed at zero command, rad/s."""
    spin_up: Float[Array, ""]
    """Time constant while the steady speed is above the rotor speed, s."""
    spin_down: Float[Array, ""]
    """Time constant while the steady speed is below the rotor speed, s."""
    dead_time: Float[Array, ""]
    """Time from a command to its first effect, s. Negative if rotor speeds are stamped earlier than commands."""
    reading: Float[Array, ""]
    """White measurement noise of the rotor speed per row, rad/s."""
    walk: Float[Array, ""]
    """White angular acceleration of the rotor, rad/s per square root of a second."""
    wander: Float[Array, ""]
    """Standard deviation of the slowly varying error of the steady speed, rad/s."""

    @staticmethod
    def from_vector(x: Float[Array, "8"]) -> Motor:
        """Motor from the vector of unknowns: logarithms, except offset and dead time, which are in their units.

        The noise levels have a floor, because the likelihood is flat where a level vanishes.
        """
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
    """Rows and commands that take effect, sorted by time: arrays (2N, S), with time as the first axis for the scan."""

    time: Array
    """Since the piece's first row, s."""
    command: Array
    """Command that takes effect where ``switches`` is 1."""
    switches: Array
    """1 where a command takes effect, 0 for a row."""
    rotor_speed: Array
    measured: Array
    judged: Array

    @property
    def interval(self) -> Array:
        """Time since the previous event, s."""
        return jnp.diff(self.time, axis=0, prepend=self.time[:1])


def events(motor: Motor, tracks: Tracks) -> Events:
    """Merge the rows with the commands, which take effect ``dead_time`` later; differentiable in the dead time."""
    zero = jnp.zeros(tracks.time.shape)
    # Commands before the first row are unknown; assume that the first command was held.
    effect = jnp.maximum(tracks.time + motor.dead_time, 0.0)
    commands = (effect, tracks.command, zero + 1, zero, zero, zero)
    rows = (tracks.time, zero, zero, tracks.rotor_speed, tracks.measured, tracks.judged)
    columns = [jnp.concatenate(pair, axis=1) for pair in zip(commands, rows, strict=True)]
    return Events(*(c.T for c in jax.lax.sort(columns, dimension=1, is_stable=True, num_keys=1)))


def innovations(motor: Motor, tracks: Tracks) -> tuple[Float[Array, "e s"], Float[Array, "e s"], Float[Array, "e s"]]:
    """One-step prediction errors of the rotor speeds, rad/s, their variances, and the mask of those that count.

    The order is that of the events. Errors that do not count are zero, with variance one.
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
    """Negative log-likelihood of all innovations, nats, up to a constant."""
    error, variance, _ = innovations(motor, tracks)
    return 0.5 * jnp.sum(jnp.log(variance) + error**2 / variance)


def simulate(motor: Motor, tracks: Tracks) -> Float[Array, "s n"]:
    """Simulate rotor speeds from the commands, starting at the measured first row of every piece, rad/s."""
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
    # Select the events that are rows, in their order.
    rows = jnp.argsort(happening.switches.T, axis=1, stable=True)[:, : tracks.time.shape[1]]
    return jnp.take_along_axis(speed.T, rows, axis=1)
