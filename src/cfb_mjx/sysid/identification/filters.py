"""Kalman filters with a slowly varying disturbance, one per scalar channel, and a smoother of the rotor speeds.

Each filter runs over the rows of one segment and returns one-step innovations and their variances. The states are the
quantity and its disturbance, and for the body also an error of the rotor speeds. The states are so few that all updates
are written out by component.

A test for feedback asks whether the commands respond to the unpredictable part of the gyro's readings.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from cfb_mjx.model.rotors import TORQUE_SIGNS
from cfb_mjx.parameters import Parameters
from cfb_mjx.sysid.identification.flight_data import Segments
from cfb_mjx.sysid.identification.noise import Noise
from cfb_mjx.sysid.identification.solver import limited

CORRELATION_TIME = 0.5
"""Correlation time of the disturbances of specific force and steady rotor speed (battery, inflow), s: about 0.3 Hz."""


class Unlogged(NamedTuple):
    """Effect of commands that were not logged: an error of the rotor speeds that decays with the motors' lag.

    For each axis of the body, and along z, the error is a scalar: the sum over the rotors with their signs, rad/s.
    """

    variance: Float[Array, " n"]
    """Variance that each interval adds to the error, (rad/s)^2."""
    decay: Float[Array, " n"]
    """Factor by which the error decays over each interval."""
    jump: Float[Array, "n 3"]
    """Change of body rate per unit error in the interval in which the error arises."""
    later: Float[Array, "n 3"]
    """Change of body rate per unit error in an interval at whose start the error already exists."""
    force: Float[Array, ""]
    """Specific force along z per unit error, m/s^2 per rad/s."""
    start: Float[Array, ""]
    """Variance of the error at the first row, where the rotor speeds are not known from earlier commands."""


def rate_innovations(
    parameters: Parameters, noise: Noise, piece: Segments, torque: Float[Array, "n 3"], unlogged: Unlogged, robust: bool
) -> tuple[Float[Array, "n 3"], Float[Array, "n 3"]]:
    """Innovations of the gyro: one filter per axis with state (body rate, disturbance, rotor error).

    The three filters are coupled by the gyroscopic term.

    Args:
        parameters: the drone.
        noise: noise levels.
        piece: one segment.
        torque: mean torque over each interval, N m.
        unlogged: effect of commands that were not logged.
        robust: limit the influence of outliers.
    """
    inertia = parameters.inertia
    r, q, d = noise.gyro**2, noise.rate_walk**2, noise.disturbance**2

    def turning(w):
        return -jnp.cross(w, inertia * w) / inertia

    def row(carry, inputs):
        w, a, o, pww, pwa, pwo, paa, pao, poo = carry
        dt, tau, measured, more, decay, jump, later = inputs
        keep = jnp.exp(-dt / noise.correlation_time)
        # Heun's method: at 100 Hz the gyroscopic torque at the previous row is on average 5 ms old, and only this
        # torque determines the scale of J_zz.
        ahead = w + dt * (tau / inertia + a + turning(w))
        w = w + dt * (tau / inertia + a + 0.5 * (turning(w) + turning(ahead))) + later * o
        a, o = keep * a, decay * o
        # F P, with F = [[1, dt, later], [0, keep, 0], [0, 0, decay]]; its first row, then F P F^T + Q.
        fww, fwa, fwo = pww + dt * pwa + later * pwo, pwa + dt * paa + later * pao, pwo + dt * pao + later * poo
        pww = fww + dt * fwa + later * fwo + q * dt + jump**2 * more
        pwa, pwo = keep * fwa, decay * fwo + jump * more
        paa, pao, poo = keep**2 * paa + d * (1 - keep**2), keep * decay * pao, decay**2 * poo + more
        s, e = pww + r, measured - w
        kw, ka, ko = pww / s, pwa / s, pwo / s
        step = limited(e, s, robust)
        w, a, o = w + kw * step, a + ka * step, o + ko * step
        paa, pao, poo = paa - ka * pwa, pao - ka * pwo, poo - ko * pwo
        pww, pwa, pwo = (1 - kw) * pww, (1 - kw) * pwa, (1 - kw) * pwo
        return (w, a, o, pww, pwa, pwo, paa, pao, poo), (e, s)

    zero = jnp.zeros(3)
    start = (piece.body_rate[0], zero, zero, r, zero, zero, d, zero, zero + unlogged.start)
    rows = (piece.interval[1:], torque, piece.body_rate[1:], *unlogged[:4])
    _, (error, variance) = jax.lax.scan(row, start, rows)
    return error, variance


def force_innovations(
    noise: Noise, piece: Segments, force: Float[Array, " n"], unlogged: Unlogged, robust: bool
) -> tuple[Float[Array, "n 1"], Float[Array, "n 1"]]:
    """Innovations of the specific force along z, relative to the model's force behind the accelerometer's low-pass.

    The state holds a slowly varying offset and the rotor error. Without the low-pass (30 Hz on the Crazyflie) the slope
    of thrust over rotor speed would be underestimated.

    Args:
        noise: noise levels.
        piece: one segment.
        force: the model's specific force along z, m/s^2.
        unlogged: effect of commands that were not logged.
        robust: limit the influence of outliers.
    """
    slope = unlogged.force
    r, d, lag = noise.accelerometer**2, noise.force_disturbance**2, noise.accelerometer_lag

    def row(carry, inputs):
        shown, a, o, paa, pao, poo = carry
        dt, before, now, measured, more, decay = inputs
        keep, fade = jnp.exp(-dt / CORRELATION_TIME), jnp.exp(-dt / lag)
        # Exact for a force that changes linearly between rows.
        trail = lag * (now - before) / jnp.where(dt > 0, dt, 1.0)
        shown = jnp.where(dt > 0, now - trail + fade * (shown - before + trail), shown)
        a, o = keep * a, decay * o
        paa, pao, poo = keep**2 * paa + d * (1 - keep**2), keep * decay * pao, decay**2 * poo + more
        pa, po = paa + slope * pao, pao + slope * poo
        s, e = pa + slope * po + r, measured - shown - a - slope * o
        ka, ko = pa / s, po / s
        step = limited(e, s, robust)
        return (shown, a + ka * step, o + ko * step, paa - ka * pa, pao - ka * po, poo - ko * po), (e, s)

    before = jnp.concatenate([force[:1], force[:-1]])
    inputs = (piece.interval[1:], before, force, piece.specific_force[1:, 2], unlogged.variance, unlogged.decay)
    zero = jnp.zeros(())
    _, (error, variance) = jax.lax.scan(row, (force[0], zero, zero, d, zero, unlogged.start), inputs)
    return error[:, None], variance[:, None]


class _Belief(NamedTuple):
    """Rotor speed x and slowly varying error b of its steady value, with their covariance, each (..., 4)."""

    x: Array
    b: Array
    pxx: Array
    pxb: Array
    pbb: Array


def rotor_innovations(
    parameters: Parameters, noise: Noise, piece: Segments, robust: bool
) -> tuple[Float[Array, "n 4"], Float[Array, "n 4"]]:
    """Innovations of the rotor speeds predicted from commands, with a slowly varying error of the steady speed."""
    _, (_, _, error, variance) = _rotor_filter(parameters, noise, piece, robust)
    return error, variance


def smoothed_rotor_speed(parameters: Parameters, noise: Noise, piece: Segments, robust: bool) -> Float[Array, "rows 4"]:
    """Rotor speeds, rad/s, smoothed from measurements and commands together (Rauch, Tung and Striebel 1965).

    Differences of raw readings are noisier than a rotor's acceleration is large, and errors in a regressor bias J_m
    towards zero.
    """
    start, (prior, post, _, _) = _rotor_filter(parameters, noise, piece, robust)
    post = jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), start, post)

    def row(later, inputs):
        at, ahead, dt = inputs
        keep, decay = jnp.exp(-dt / CORRELATION_TIME), jnp.exp(-dt / parameters.motor_time_constant)
        # P F^T with F = [[decay, (1 - decay) keep], [0, keep]]: the state-noise model of `_rotor_filter`.
        mix = 1 - decay
        xx, xb = decay * at.pxx + mix * at.pxb, keep * at.pxb
        bx, bb = decay * at.pxb + mix * at.pbb, keep * at.pbb
        determinant = ahead.pxx * ahead.pbb - ahead.pxb**2
        gxx = (xx * ahead.pbb - xb * ahead.pxb) / determinant
        gxb = (xb * ahead.pxx - xx * ahead.pxb) / determinant
        gbx = (bx * ahead.pbb - bb * ahead.pxb) / determinant
        gbb = (bb * ahead.pxx - bx * ahead.pxb) / determinant
        dx, db = later[0] - ahead.x, later[1] - ahead.b
        x, b = at.x + gxx * dx + gxb * db, at.b + gbx * dx + gbb * db
        return (x, b), x

    earlier = jax.tree.map(lambda x: x[:-1], post)
    last = (post.x[-1], post.b[-1])
    _, speed = jax.lax.scan(row, last, (earlier, prior, piece.interval[1:]), reverse=True)
    return jnp.concatenate([speed, post.x[-1:]])


def _rotor_filter(parameters: Parameters, noise: Noise, piece: Segments, robust: bool):
    r, q, d = noise.rotor**2, noise.rotor_walk**2, noise.rotor_disturbance**2
    target = parameters.motor_gain * piece.command + parameters.motor_speed_offset

    missed = jax.lax.stop_gradient(parameters.motor_gain) * noise.command * piece.doubt

    def row(at, inputs):
        dt, goal, measured, valid, miss = inputs
        keep, decay = jnp.exp(-dt / CORRELATION_TIME), jnp.exp(-dt / parameters.motor_time_constant)
        mix = 1 - decay
        x, b = decay * at.x + mix * (goal + at.b), keep * at.b
        prior = _Belief(
            x,
            b,
            # The small constant keeps the covariance in the padding invertible for the smoother.
            decay**2 * at.pxx + 2 * decay * mix * at.pxb + mix**2 * (at.pbb + miss**2) + q * dt + 1e-6,
            keep * (decay * at.pxb + mix * at.pbb),
            keep**2 * at.pbb + d * (1 - keep**2) + 1e-6,
        )
        s, e = prior.pxx + r, measured - x
        # The padding repeats the last reading, which must count only once.
        kx, kb = valid * prior.pxx / s, valid * prior.pxb / s
        step = limited(e, s, robust)
        post = _Belief(
            x + kx * step,
            b + kb * step,
            (1 - kx) * prior.pxx,
            (1 - kx) * prior.pxb,
            prior.pbb - kb * prior.pxb,
        )
        return post, (prior, post, e, s)

    zero = jnp.zeros(4)
    start = _Belief(piece.rotor_speed[0], zero, zero + r, zero, zero + d)
    rows = (piece.interval[1:], target[:-1], piece.rotor_speed[1:], piece.valid[1:], missed[:-1])
    _, found = jax.lax.scan(row, start, rows)
    return start, found


LAGS = 5
"""Number of rows within which a controller responds."""
SIGNIFICANT = 1e-6
"""Largest p-value at which feedback is considered present."""


@dataclass(frozen=True)
class Feedback:
    """Largest correlation between an innovation of a body rate and a later change of command, and its p-value."""

    correlation: float
    p_value: float

    @property
    def present(self) -> bool:
        """Whether the flight was flown under feedback."""
        return self.p_value < SIGNIFICANT


def detect(segments: Segments, residual: np.ndarray) -> Feedback:
    """Correlate innovations with the command changes that follow.

    An innovation cannot be predicted from past rows and commands. A predetermined command sequence cannot correlate
    with it, whereas a controller's commands must.

    Args:
        segments: flight data.
        residual: (s, n - 1, 8) whitened innovations, zero where a row does not count.
    """
    mix = np.asarray(TORQUE_SIGNS)
    counts = np.asarray(segments.valid * (1 - segments.warm_up))[:, 1:]
    change = np.diff(np.asarray(segments.command) @ mix.T, axis=1)  # into each row, from the one before
    length, best = change.shape[1], 0.0
    for lag in range(LAGS):
        use = (counts[:, : length - lag] * counts[:, lag:])[..., None]
        error, answer = residual[:, : length - lag, :3] * use, change[:, lag:] * use
        size = np.sqrt(np.sum(error**2, axis=(0, 1)) * np.sum(answer**2, axis=(0, 1)))
        found = np.abs(np.sum(error * answer, axis=(0, 1))) / np.maximum(size, 1e-300)
        best = max(best, float(found.max()))
    # Fisher's z is normal with variance 1 / (n - 3); Bonferroni over axes and lags.
    z = np.arctanh(min(best, 1 - 1e-12)) * np.sqrt(max(counts.sum() - 3, 1))
    return Feedback(float(best), min(1.0, 3 * LAGS * math.erfc(z / math.sqrt(2))))
