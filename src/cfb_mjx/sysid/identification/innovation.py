"""One-step innovations of filters with a slowly varying disturbance: the estimator that feedback does not bias.

Flights are flown under feedback, so the commands respond to disturbances that the model does not know. In multi-step
predictions from such data the input is correlated with the error, and least squares then biases the inertia. Here every
row is predicted from earlier rows only, by one Kalman filter per channel. Its state holds the quantity itself and an
unknown, slowly varying acceleration (an Ornstein-Uhlenbeck process). If this noise model is right, the innovations at
the true parameters are white for any controller, and maximising their likelihood gives unbiased estimates (Ljung,
System Identification, 2nd ed., section 13.4).

Measured rotor speeds are an input of the body, not an output. Therefore they are smoothed over the whole segment, and
only gyro and accelerometer are predicted from the past alone.
"""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from cfb_mjx.devices import mapped
from cfb_mjx.model import rotors
from cfb_mjx.model.quadrotor import at_rotor_center, wrench_of
from cfb_mjx.model.state import AnyArray
from cfb_mjx.model.vector import Vec
from cfb_mjx.parameters import Parameters
from cfb_mjx.sysid.identification.filters import (
    Unlogged,
    force_innovations,
    rate_innovations,
    rotor_innovations,
    smoothed_rotor_speed,
)
from cfb_mjx.sysid.identification.flight_data import Segments
from cfb_mjx.sysid.identification.noise import Noise

CHANNELS = ("rate_x", "rate_y", "rate_z", "specific_force_z", "rotor_1", "rotor_2", "rotor_3", "rotor_4")
"""Channels of the innovations."""

START = 0.1
"""Standard deviation of a rotor speed about its steady value at the first row of a segment, over the motor gain."""


class Drive(eqx.Module):
    """Loads of the rotors on the body at each row."""

    torque: Float[Array, "s n 3"]
    """Mean torque over the interval before a row, about the centre of gravity, N m."""
    force: Float[Array, "s n"]
    """Specific force along z at a row, at the rotors' centre, where the accelerometer is, m/s^2."""


def drive(
    parameters: Parameters, noise: Noise, segments: Segments, use_measured: bool = True, robust: bool = False
) -> Drive:
    """Compute the rotors' loads from measured rotor speeds, or from commands where there are none.

    Args:
        parameters: the drone.
        noise: noise levels; only those of the rotors are used.
        segments: flight data.
        use_measured: use measured rotor speeds in segments that have them.
        robust: limit the influence of outliers on the smoothed rotor speeds.
    """

    def one(piece: Segments) -> Drive:
        share = piece.measured * use_measured
        speed = _modelled_speed(parameters, piece)
        if use_measured:
            speed = jnp.where(share > 0, smoothed_rotor_speed(parameters, noise, piece, robust), speed)
        excess = parameters.motor_gain * piece.excess[:-1]
        rows = (piece.interval[1:], speed[:-1], speed[1:], excess, piece.body_rate[1:])
        torque, force = jax.vmap(lambda *x: _loads(parameters, *x))(*rows)
        return Drive(torque, force)

    return mapped(one, segments.over)(segments)


def innovations(
    parameters: Parameters,
    noise: Noise,
    segments: Segments,
    driven: Drive,
    use_measured: bool = True,
    robust: bool = False,
    weighed: Parameters | None = None,
) -> tuple[Float[Array, "s n 8"], Float[Array, "s n 8"]]:
    """Innovations of `CHANNELS` and their variances; zero and one where a row does not count.

    The rotor channels are predicted from commands, and count where rotor speed was measured.

    Args:
        parameters: the drone.
        noise: noise levels.
        segments: flight data.
        driven: `drive` of the same parameters and segments.
        use_measured: as for `drive`.
        robust: limit the correction of a filter by any reading to three standard deviations.
        weighed: parameters for the effect of commands that were not logged; by default ``parameters``.
    """
    # These serve as weights, so no derivative is taken through them.
    weighed = jax.lax.stop_gradient(parameters if weighed is None else weighed)

    def one(piece: Segments, loads: Drive):
        unlogged = _unlogged(weighed, noise, piece, use_measured)
        filters = [
            rate_innovations(parameters, noise, piece, loads.torque, unlogged, robust),
            force_innovations(noise, piece, loads.force, unlogged, robust),
            rotor_innovations(parameters, noise, piece, robust),
        ]
        error, variance = (jnp.concatenate([f[i] for f in filters], axis=1) for i in range(2))
        counts = piece.valid[1:] * (1 - piece.warm_up[1:])
        use = counts[:, None] * jnp.concatenate([jnp.ones(4), jnp.full(4, 1.0) * piece.measured])
        return error * use, jnp.where(use > 0, variance, 1.0)

    return mapped(one, segments.over)(segments, driven)


def _modelled_speed(parameters: Parameters, piece: Segments) -> Float[Array, "n 4"]:
    target = parameters.motor_gain * piece.command + parameters.motor_speed_offset

    def advance(speed, row):
        dt, goal = row
        speed = goal + (speed - goal) * jnp.exp(-dt / parameters.motor_time_constant)
        return speed, speed

    _, later = jax.lax.scan(advance, target[0], (piece.interval[1:], target[:-1]))
    return jnp.concatenate([target[:1], later])


def _loads(parameters, dt, start, end, excess, body_rate):
    """Mean torque about the centre of gravity over an interval, N m, and specific force along z at its end, m/s^2.

    ``excess`` is the difference between the mean of the commanded steady speeds and the constant steady speed that
    leads from ``start`` to ``end``. The mean rotor speed differs from that of the exponential path by the same amount,
    because in both cases T (end - start) is the integral of steady speed minus rotor speed.
    """
    constants = rotors.prepare(parameters, dt)
    risen = -jnp.expm1(-dt / parameters.motor_time_constant)
    # Steady speed of the exponential through both ends; a straight line would ignore the curvature.
    goal = start + (end - start) / jnp.where(risen > 0, risen, 1.0)
    mean = wrench_of(
        parameters, rotors.path_to(constants, Vec.unstack(start + excess), Vec.unstack(goal + excess)).mean
    )
    torque = mean.torque - Vec.unstack(parameters.center_of_gravity).cross(mean.force)
    # Specific force at the rotors' centre: 3 mm away from it, an angular acceleration of 100 rad/s^2 adds 0.3 m/s^2,
    # twice the accelerometer's noise.
    last = wrench_of(parameters, rotors.loads_at(constants, Vec.unstack(end), 0.0 * Vec.unstack(end)))
    apart = jax.tree.map(lambda x: Vec.unstack(x) if x.ndim else x, parameters)
    return torque.stack(), at_rotor_center(apart, last, Vec.unstack(body_rate))[1].components[2]


def _unlogged(parameters: Parameters, noise: Noise, piece: Segments, use_measured: bool) -> Unlogged:
    """Rotor-speed errors to be modelled by the filters: at the first row, and from commands that were not logged."""
    interval, lag = piece.interval[1:], jnp.mean(parameters.motor_time_constant)
    decay = jnp.exp(-interval / lag)
    counts = 1.0 - jnp.asarray(piece.measured) * use_measured
    missed = noise.command * (parameters.motor_gain * piece.doubt[:-1]) * (1 - decay)[:, None]
    speed = jnp.mean(parameters.motor_gain * piece.command + parameters.motor_speed_offset, axis=0)
    lift, drag = (
        jnp.mean(jax.jvp(lambda x, load=load: load(parameters, x), (speed,), (jnp.ones(4),))[1])
        for load in (rotors.thrust, rotors.torque)
    )
    half = 0.5 * parameters.rotor_spacing * lift
    kick = jnp.array([0.0, 0.0, 1.0]) * parameters.rotor_inertia / parameters.inertia
    pull = jnp.stack([half, half, drag]) / parameters.inertia - kick / lag
    return Unlogged(
        variance=counts * jnp.sum(missed**2, axis=1),
        decay=decay,
        jump=kick + 0.5 * pull * interval[:, None],
        later=pull * lag * (1 - decay)[:, None],
        force=lift / parameters.mass,
        start=counts * 4 * (START * jnp.mean(parameters.motor_gain)) ** 2,
    )


def as_held(parameters: Parameters, hold: Float[Array, ""] | None, segments: Segments) -> Segments:
    """Replace the commands between two rows by the constant command that moves the rotors equally far.

    A controller that is faster than the log sends commands between rows. Each logged command acts for ``hold`` seconds
    (the controller's period). The others are assumed to lie on the parabola through the logged commands before and
    after them and the one before these. (A straight line would underestimate fast commands, by 4 % at 11 Hz with rows
    10 ms apart.)

    Args:
        parameters: the drone; only the motors' lag is used, because later commands have more influence.
        hold: s; if None or infinite, every command acts until the next row.
        segments: flight data.
    """
    if hold is None:
        return eqx.tree_at(lambda s: s.doubt, segments, jnp.zeros_like(segments.doubt))
    interval = segments.interval[:, 1:, None]
    safe = jnp.where(interval > 0, interval, 1.0)
    timed = jnp.isinf(hold)
    held = jnp.where(timed, 1.0, _share(jnp.where(timed, 0.0, hold) / safe))
    later = (1 - held**2) * interval / (12 * parameters.motor_time_constant)
    share = 0.5 * (1 - held) + later
    step = jnp.diff(segments.command, axis=1)
    ratio = jnp.concatenate([jnp.ones_like(safe[:, :1]), safe[:, :-1] / safe[:, 1:]], axis=1)
    bend = (step - jnp.concatenate([step[:, :1], step[:, :-1]], axis=1) / ratio) / (1 + ratio)
    between = share * step - (1 - held**2) / 6 * bend
    command = jnp.asarray(segments.command).at[:, :-1].add(jnp.where(interval > 0, between, 0.0))
    # Later commands have more influence on the rotor speed at the next row, but not on its mean over the interval.
    excess = jnp.asarray(segments.excess).at[:, :-1].set(jnp.where(interval > 0, -later * step, 0.0))
    unsure = jnp.sqrt(jnp.clip(1 - held**2, 0.0, 1.0)) * segments.doubt[:, :-1]
    doubt = jnp.asarray(segments.doubt).at[:, :-1].set(jax.lax.stop_gradient(unsure))
    return eqx.tree_at(lambda s: (s.command, s.excess, s.doubt), segments, (command, excess, doubt))


def _share(ratio: Array) -> Array:
    """The share of an interval for which a command acted, of the ratio of their lengths: equal from 0 to 1.

    Beyond, it tends to -0.5 and 1.5, smoothly: intervals scatter, and a corner at every interval would stop a descent.
    """
    possible = jnp.clip(ratio, 0.0, 1.0)
    return possible + 0.5 * jnp.tanh((ratio - possible) / 0.5)


class Weights(NamedTuple):
    """Weights of the innovations, which stay constant during a least-squares fit.

    If the weights followed the parameters, the sum of squares would decrease where the variances grow. But the gradient
    that the solver uses is that of the innovations alone, so its steps would not lower the sum.
    """

    parameters: Parameters
    doubt: Float[AnyArray, "s n 4"]
    """Uncertainty of the commands (`Segments.doubt`)."""
    variance: Float[Array, "s n 8"]
    """Variance of each innovation."""


def weights(
    parameters: Parameters, noise: Noise, segments: Segments, use_measured: bool = True, robust: bool = False
) -> Weights:
    """Weights from the innovations' variances at the given parameters."""
    driven = drive(parameters, noise, segments, use_measured, robust)
    _, variance = innovations(parameters, noise, segments, driven, use_measured, robust)
    return jax.lax.stop_gradient(Weights(parameters, segments.doubt, variance))


def whitened(
    parameters: Parameters,
    noise: Noise,
    segments: Segments,
    use_measured: bool = True,
    robust: bool = False,
    weighed: Weights | None = None,
) -> Float[Array, "s n 8"]:
    """Innovations divided by their standard deviations, which are constants in derivatives.

    Args:
        parameters: the drone.
        noise: noise levels.
        segments: flight data.
        use_measured: as for `drive`.
        robust: as for `innovations`.
        weighed: fixed weights; by default the innovations' own variances.
    """
    if weighed is not None:
        segments = eqx.tree_at(lambda s: s.doubt, segments, weighed.doubt)
    driven = drive(parameters, noise, segments, use_measured, robust)
    known = None if weighed is None else weighed.parameters
    error, variance = innovations(parameters, noise, segments, driven, use_measured, robust, known)
    return error / jnp.sqrt(jax.lax.stop_gradient(variance) if weighed is None else weighed.variance)
