"""One-step innovations of a filter with a slowly varying disturbance: the estimator that feedback does not bias.

Flights are flown under feedback: the commands answer disturbances the model does not know. Predicting many steps ahead
from such data correlates input and error, and least squares then bends the inertia to fit. Here every row is predicted
from the rows before it only, by a Kalman filter per channel whose state holds the quantity itself and an unknown
acceleration that wanders (Ornstein-Uhlenbeck). With that noise described, the prediction errors of the true parameters
are white, and their likelihood is maximised without bias whatever the controller does (Ljung, System Identification,
2nd ed., section 13.4).
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from cfb_mjx.model import rotors
from cfb_mjx.model.quadrotor import wrench_of
from cfb_mjx.model.vector import Vec
from cfb_mjx.parameters import Parameters
from cfb_mjx.sysid.flight_data import Segments

CORRELATION_TIME = 0.5
"""Of the disturbance, s: below about 1/(2 pi 0.5 s) = 0.3 Hz it is constant, above it wanders."""


class Noise(eqx.Module):
    """Standard deviations, one per axis."""

    gyro: Float[Array, "3"]
    """White noise of a gyro row, rad/s."""
    rate_walk: Float[Array, "3"]
    """White angular acceleration, rad/s per square root of a second."""
    disturbance: Float[Array, "3"]
    """Wandering angular acceleration, rad/s^2."""
    accelerometer: Float[Array, ""]
    """White noise of the z accelerometer, m/s^2."""
    force_disturbance: Float[Array, ""]
    """Wandering specific force along z, m/s^2."""
    rotor: Float[Array, ""]
    """White noise of a rotor speed row, rad/s."""
    rotor_disturbance: Float[Array, ""]
    """Wandering error of the steady rotor speed, rad/s."""

    def to_vector(self) -> Array:
        """Logarithms, for optimisation."""
        return jnp.log(jnp.concatenate([jnp.atleast_1d(x) for x in jax.tree.leaves(self)]))

    @staticmethod
    def from_vector(vector: Array) -> Noise:
        """Inverse of `to_vector`; a floor keeps a vanishing level from flattening the likelihood."""
        x = jnp.exp(vector)
        return Noise(x[0:3] + 1e-4, x[3:6] + 1e-3, x[6:9] + 1e-2, x[9] + 1e-3, x[10] + 1e-3, x[11] + 1e-2, x[12] + 1e-2)


class Drive(eqx.Module):
    """What the rotors do to the body, row by row: depends on the parameters, not on the noise."""

    torque: Float[Array, "s n 3"]
    """Mean over the interval before a row, about the centre of gravity, N m."""
    thrust: Float[Array, "s n"]
    """At the row, N."""


def drive(parameters: Parameters, segments: Segments, use_measured: bool) -> Drive:
    """Rotor loads from measured rotor speeds where a segment has them (if ``use_measured``), else from commands."""

    def one(piece: Segments) -> Drive:
        share = piece.measured * use_measured
        speed = jnp.where(share > 0, piece.rotor_speed, _modelled_speed(parameters, piece))
        torque, thrust = jax.vmap(lambda *x: _loads(parameters, *x, share))(
            piece.interval[1:], speed[:-1], speed[1:], piece.command[:-1]
        )
        return Drive(torque, thrust)

    return jax.vmap(one)(segments)


def innovations(
    parameters: Parameters, noise: Noise, segments: Segments, driven: Drive
) -> tuple[Float[Array, "s n 8"], Float[Array, "s n 8"]]:
    """Innovations and their variances, zero and one where a row does not count.

    Channels: body rate x, y, z, specific force z, and (where rotor speed was measured) the four rotor speeds predicted
    from the commands.

    Args:
        parameters: the drone.
        noise: noise levels.
        segments: flight data.
        driven: `drive` of the same parameters and segments.
    """

    def one(piece: Segments, loads: Drive):
        filters = [
            _rate_filter(parameters, noise, piece, loads.torque),
            _force_filter(parameters, noise, piece, loads.thrust),
            _rotor_filter(parameters, noise, piece),
        ]
        error, variance = (jnp.concatenate([f[i] for f in filters], axis=1) for i in range(2))
        counts = piece.valid[1:] * (1 - piece.warm_up[1:])
        use = counts[:, None] * jnp.concatenate([jnp.ones(4), jnp.full(4, 1.0) * piece.measured])
        return error * use, jnp.where(use > 0, variance, 1.0)

    return jax.vmap(one)(segments, driven)


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
    straight = rotors.path_between(constants, Vec.unstack(start), Vec.unstack(end)).mean
    exact = rotors.path_to(constants, Vec.unstack(start), rotors.steady_speed(constants, Vec.unstack(command))).mean
    mean = jax.tree.map(lambda a, b: jnp.where(measured > 0, a, b), straight, exact)
    wrench = wrench_of(parameters, mean)
    torque = wrench.torque - Vec.unstack(parameters.center_of_gravity).cross(wrench.force)
    return torque.stack(), jnp.sum(rotors.thrust(parameters, end))


def _rate_filter(parameters: Parameters, noise: Noise, piece: Segments, torque: Float[Array, "n 3"]):
    """Three filters with state (rate, disturbance), one per axis, coupled through the gyroscopic term."""
    inertia = parameters.inertia
    r, q, d = noise.gyro**2, noise.rate_walk**2, noise.disturbance**2

    def row(carry, inputs):
        w, a, pww, pwa, paa = carry
        dt, tau, measured = inputs
        keep = jnp.exp(-dt / CORRELATION_TIME)
        w = w + dt * ((tau - jnp.cross(w, inertia * w)) / inertia + a)
        a = keep * a
        pww, pwa, paa = (
            pww + 2 * dt * pwa + dt**2 * paa + q * dt,
            keep * (pwa + dt * paa),
            keep**2 * paa + d * (1 - keep**2),
        )
        s, e = pww + r, measured - w
        kw, ka = pww / s, pwa / s
        w, a = w + kw * e, a + ka * e
        pww, pwa, paa = (1 - kw) * pww, (1 - kw) * pwa, paa - ka * pwa
        return (w, a, pww, pwa, paa), (e, s)

    zero = jnp.zeros(3)
    start = (piece.body_rate[0], zero, r, zero, d)
    _, (error, variance) = jax.lax.scan(row, start, (piece.interval[1:], torque, piece.body_rate[1:]))
    return error, variance


def _force_filter(parameters: Parameters, noise: Noise, piece: Segments, thrust: Float[Array, "n"]):
    """Specific force along z against thrust over mass, with a wandering offset."""
    r, d = noise.accelerometer**2, noise.force_disturbance**2

    def row(carry, inputs):
        a, p = carry
        dt, predicted, measured = inputs
        keep = jnp.exp(-dt / CORRELATION_TIME)
        a, p = keep * a, keep**2 * p + d * (1 - keep**2)
        s, e = p + r, measured - predicted - a
        k = p / s
        return (a + k * e, (1 - k) * p), (e, s)

    inputs = (piece.interval[1:], thrust / parameters.mass, piece.specific_force[1:, 2])
    _, (error, variance) = jax.lax.scan(row, (jnp.zeros(()), d), inputs)
    return error[:, None], variance[:, None]


def _rotor_filter(parameters: Parameters, noise: Noise, piece: Segments):
    """Rotor speeds from commands, with a wandering error of the steady speed (battery, load)."""
    r, d = noise.rotor**2, noise.rotor_disturbance**2
    target = parameters.motor_gain * piece.command + parameters.motor_speed_offset

    def row(carry, inputs):
        x, b, pxx, pxb, pbb = carry
        dt, goal, measured = inputs
        keep, decay = jnp.exp(-dt / CORRELATION_TIME), jnp.exp(-dt / parameters.motor_time_constant)
        gain = 1 - decay
        x, b = decay * x + gain * (goal + b), keep * b
        pxx, pxb, pbb = (
            decay**2 * pxx + 2 * decay * gain * pxb + gain**2 * pbb + 1e-6,
            keep * (decay * pxb + gain * pbb),
            keep**2 * pbb + d * (1 - keep**2),
        )
        s, e = pxx + r, measured - x
        kx, kb = pxx / s, pxb / s
        x, b = x + kx * e, b + kb * e
        pxx, pxb, pbb = (1 - kx) * pxx, (1 - kx) * pxb, pbb - kb * pxb
        return (x, b, pxx, pxb, pbb), (e, s)

    zero = jnp.zeros(4)
    start = (piece.rotor_speed[0], zero, zero + r, zero, zero + d)
    _, (error, variance) = jax.lax.scan(row, start, (piece.interval[1:], target[:-1], piece.rotor_speed[1:]))
    return error, variance


def negative_log_likelihood(parameters, noise, segments, driven: Drive) -> Float[Array, ""]:
    """Of all innovations, per row, without the constant."""
    error, variance = innovations(parameters, noise, segments, driven)
    rows = jnp.maximum(jnp.sum(segments.valid), 1.0)
    return 0.5 * jnp.sum(jnp.log(variance) + error**2 / variance) / rows
