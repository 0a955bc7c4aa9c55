"""One-step innovations of a filter with a slowly varying disturbance: the estimator that feedback does not bias.

Flights are flown under feedback: the commands answer disturbances the model does not know. Predicting many steps ahead
from such data correlates input and error, and least squares then bends the inertia to fit. Here every row is predicted
from the rows before it only, by a Kalman filter per channel whose state holds the quantity itself and an unknown
acceleration that wanders (Ornstein-Uhlenbeck). With that noise described, the prediction errors of the true parameters
are white, and their likelihood is maximised without bias whatever the controller does (Ljung, System Identification,
2nd ed., section 13.4).

Measured rotor speeds are an input of the body, not an output: they are smoothed over the whole segment, and only what
the gyro and the accelerometer say is predicted from the past alone.
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

START = 0.1
"""Std of a rotor's speed at the first row of a segment about its steady speed then, as a share of the motor gain."""


class Drive(eqx.Module):
    """What the rotors do to the body, row by row."""

    torque: Float[Array, "s n 3"]
    """Mean over the interval before a row, about the centre of gravity, N m."""
    force: Float[Array, "s n"]
    """Specific force along z at the row and at the rotors' centre, where the accelerometer is, m/s^2."""


def drive(
    parameters: Parameters, noise: Noise, segments: Segments, use_measured: bool = True, robust: bool = False
) -> Drive:
    """Rotor loads from measured rotor speeds where a segment has them (if ``use_measured``), else from commands.

    Of ``noise`` only the rotors' levels matter.
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
    """Innovations and their variances (`CHANNELS`), zero and one where a row does not count.

    The rotor channels count where rotor speed was measured; they are predicted from the commands.

    Args:
        parameters: the drone.
        noise: noise levels.
        segments: flight data.
        driven: `drive` of the same parameters and segments.
        use_measured: as it was driven.
        robust: let no reading move a filter by more than three standard deviations.
        weighed: parameters that say what errors of the commands do to the body; ``parameters`` by default.
    """
    # As weights these are not differentiated by the parameters.
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
    """Mean torque about the centre of gravity over an interval (N m), and specific force along z at its end (m/s^2).

    ``excess`` is by how much the mean of the steady speeds commanded is above the one that leads from start to end:
    the mean of the rotor speed is above the path's by as much, as T (end - start) is the integral of either's distance.
    """
    constants = rotors.prepare(parameters, dt)
    risen = -jnp.expm1(-dt / parameters.motor_time_constant)
    # Towards the steady speed whose exponential passes through both ends: a straight line would be off by its sag.
    goal = start + (end - start) / jnp.where(risen > 0, risen, 1.0)
    mean = wrench_of(
        parameters, rotors.path_to(constants, Vec.unstack(start + excess), Vec.unstack(goal + excess)).mean
    )
    torque = mean.torque - Vec.unstack(parameters.center_of_gravity).cross(mean.force)
    # At the rotors' centre: 3 mm off it, turning at 100 rad/s^2 reads 0.3 m/s^2, twice the accelerometer's noise.
    last = wrench_of(parameters, rotors.loads_at(constants, Vec.unstack(end), 0.0 * Vec.unstack(end)))
    apart = jax.tree.map(lambda x: Vec.unstack(x) if x.ndim else x, parameters)
    return torque.stack(), at_rotor_center(apart, last, Vec.unstack(body_rate))[1].components[2]


def _unlogged(parameters: Parameters, noise: Noise, piece: Segments, use_measured: bool) -> Unlogged:
    """Rotor errors that the filters must allow for: of the first row, and of commands that were not logged."""
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
    """Commands replaced by constants over the interval after each row that move the rotors as far as the true ones did.

    A controller faster than the log sends commands between rows. Each logged one acts for ``hold`` seconds (the
    controller's period); the others are taken to lie on the parabola through the two logged about them and the one
    before (a line would make fast commands too small: 4 % at 11 Hz of rows 10 ms apart).

    Args:
        parameters: the drone; only the motors' lag matters, by which later commands count for more.
        hold: s; None, or infinite, takes every command to act until the next row.
        segments: flight data.
    """
    if hold is None:
        return eqx.tree_at(lambda s: s.doubt, segments, jnp.zeros_like(segments.doubt))
    interval = segments.interval[:, 1:, None]
    safe = jnp.where(interval > 0, interval, 1.0)
    timed = jnp.isinf(hold)
    held = jnp.where(timed, 1.0, jnp.clip(jnp.where(timed, 0.0, hold) / safe, -0.5, 1.5))
    later = (1 - held**2) * interval / (12 * parameters.motor_time_constant)
    share = 0.5 * (1 - held) + later
    step = jnp.diff(segments.command, axis=1)
    ratio = jnp.concatenate([jnp.ones_like(safe[:, :1]), safe[:, :-1] / safe[:, 1:]], axis=1)
    bend = (step - jnp.concatenate([step[:, :1], step[:, :-1]], axis=1) / ratio) / (1 + ratio)
    between = share * step - (1 - held**2) / 6 * bend
    command = jnp.asarray(segments.command).at[:, :-1].add(jnp.where(interval > 0, between, 0.0))
    # Later ones count for more in the rotors' speed at the next row, and for no more in their mean on the way there.
    excess = jnp.asarray(segments.excess).at[:, :-1].set(jnp.where(interval > 0, -later * step, 0.0))
    unsure = jnp.sqrt(jnp.clip(1 - held**2, 0.0, 1.0)) * segments.doubt[:, :-1]
    doubt = jnp.asarray(segments.doubt).at[:, :-1].set(jax.lax.stop_gradient(unsure))
    return eqx.tree_at(lambda s: (s.command, s.excess, s.doubt), segments, (command, excess, doubt))


class Weights(NamedTuple):
    """What innovations are weighed by; while a least-squares fit runs, by what it began with.

    If the weights followed the parameters, the sum of squares would fall where variances grow, and no step along its
    slope (which is that of the innovations alone) would lower it.
    """

    parameters: Parameters
    doubt: Float[AnyArray, "s n 4"]
    """Of the commands (`Segments.doubt`)."""
    variance: Float[Array, "s n 8"]


def weights(
    parameters: Parameters, noise: Noise, segments: Segments, use_measured: bool = True, robust: bool = False
) -> Weights:
    """Of the innovations of these parameters."""
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
    """Innovations over their standard deviations, which are not differentiated: as ``weighed``, or their own."""
    if weighed is not None:
        segments = eqx.tree_at(lambda s: s.doubt, segments, weighed.doubt)
    driven = drive(parameters, noise, segments, use_measured, robust)
    known = None if weighed is None else weighed.parameters
    error, variance = innovations(parameters, noise, segments, driven, use_measured, robust, known)
    return error / jnp.sqrt(jax.lax.stop_gradient(variance) if weighed is None else weighed.variance)
