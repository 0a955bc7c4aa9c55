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

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from cfb_mjx.devices import mapped
from cfb_mjx.model import rotors
from cfb_mjx.model.quadrotor import wrench_of
from cfb_mjx.model.vector import Vec
from cfb_mjx.parameters import Parameters
from cfb_mjx.sysid.identification.filters import (
    force_innovations,
    rate_innovations,
    rotor_innovations,
    smoothed_rotor_speed,
)
from cfb_mjx.sysid.identification.flight_data import Segments
from cfb_mjx.sysid.identification.noise import Noise
from cfb_mjx.sysid.identification.robust import surprise

CHANNELS = ("rate_x", "rate_y", "rate_z", "specific_force_z", "rotor_1", "rotor_2", "rotor_3", "rotor_4")


class Drive(eqx.Module):
    """What the rotors do to the body, row by row."""

    torque: Float[Array, "s n 3"]
    """Mean over the interval before a row, about the centre of gravity, N m."""
    thrust: Float[Array, "s n"]
    """At the row, N."""


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
        torque, thrust = jax.vmap(lambda *x: _loads(parameters, *x, share))(
            piece.interval[1:], speed[:-1], speed[1:], piece.command[:-1]
        )
        return Drive(torque, thrust)

    return mapped(one, segments.over)(segments)


def innovations(
    parameters: Parameters, noise: Noise, segments: Segments, driven: Drive, robust: bool = False
) -> tuple[Float[Array, "s n 8"], Float[Array, "s n 8"]]:
    """Innovations and their variances (`CHANNELS`), zero and one where a row does not count.

    The rotor channels count where rotor speed was measured; they are predicted from the commands.

    Args:
        parameters: the drone.
        noise: noise levels.
        segments: flight data.
        driven: `drive` of the same parameters and segments.
        robust: let no reading move a filter by more than three standard deviations.
    """

    def one(piece: Segments, loads: Drive):
        filters = [
            rate_innovations(parameters, noise, piece, loads.torque, robust),
            force_innovations(parameters, noise, piece, loads.thrust, robust),
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


def _loads(parameters, dt, start, end, command, measured):
    """Mean torque about the centre of gravity over an interval (N m), and thrust at its end (N)."""
    constants = rotors.prepare(parameters, dt)
    risen = -jnp.expm1(-dt / parameters.motor_time_constant)
    # Towards the steady speed whose exponential passes through both ends: a straight line would be off by its sag.
    through = start + (end - start) / jnp.where(risen > 0, risen, 1.0)
    goal = jnp.where(measured > 0, through, parameters.motor_gain * command + parameters.motor_speed_offset)
    wrench = wrench_of(parameters, rotors.path_to(constants, Vec.unstack(start), Vec.unstack(goal)).mean)
    torque = wrench.torque - Vec.unstack(parameters.center_of_gravity).cross(wrench.force)
    return torque.stack(), jnp.sum(rotors.thrust(parameters, end))


def whitened(
    parameters: Parameters, noise: Noise, segments: Segments, use_measured: bool = True, robust: bool = False
) -> Float[Array, "s n 8"]:
    """Innovations over their standard deviations, which as weights are not differentiated."""
    driven = drive(parameters, noise, segments, use_measured, robust)
    error, variance = innovations(parameters, noise, segments, driven, robust)
    # The variance follows the parameters a little (the motors' lag); as a weight it must not be fitted.
    return error / jnp.sqrt(jax.lax.stop_gradient(variance))


def negative_log_likelihood(parameters, noise, segments, driven: Drive, robust: bool = False) -> Float[Array, ""]:
    """Of all innovations, per row, without the constant; over devices differentiable by the noise alone."""
    rows = jnp.maximum(jnp.sum(segments.valid), 1.0)
    if segments.over is None:
        return _surprisal(parameters, noise, segments, driven, robust) / rows

    def share(noise, parameters, segments, driven):
        return _surprisal(parameters, noise, segments, driven, robust)

    batch = replace(segments, over=None), driven
    return segments.over.summed(share, (parameters,), batch)(noise) / rows


def _surprisal(parameters, noise, segments, driven: Drive, robust: bool) -> Float[Array, ""]:
    error, variance = innovations(parameters, noise, segments, driven, robust)
    return 0.5 * jnp.sum(jnp.log(variance) + surprise(error / jnp.sqrt(variance), robust))
