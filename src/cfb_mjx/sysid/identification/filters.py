"""Kalman filters with a slowly wandering disturbance, one scalar channel at a time; the rotor's also runs backwards.

Each filter walks along the rows of one segment and returns the one-step innovations and their variances. States are
two numbers (the quantity and its disturbance), so covariances are three numbers and every update is written out.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from cfb_mjx.parameters import Parameters
from cfb_mjx.sysid.identification.flight_data import Segments
from cfb_mjx.sysid.identification.noise import Noise
from cfb_mjx.sysid.identification.robust import limited

CORRELATION_TIME = 0.5
"""Of the wandering offsets of specific force and steady rotor speed, s: battery and inflow, below about 0.3 Hz."""


def rate_innovations(
    parameters: Parameters, noise: Noise, piece: Segments, torque: Float[Array, "n 3"], robust: bool
) -> tuple[Float[Array, "n 3"], Float[Array, "n 3"]]:
    """Three filters with state (body rate, disturbance), one per axis, coupled through the gyroscopic term."""
    inertia = parameters.inertia
    r, q, d = noise.gyro**2, noise.rate_walk**2, noise.disturbance**2

    def row(carry, inputs):
        w, a, pww, pwa, paa = carry
        dt, tau, measured = inputs
        keep = jnp.exp(-dt / noise.correlation_time)
        w = w + dt * ((tau - jnp.cross(w, inertia * w)) / inertia + a)
        a = keep * a
        pww, pwa, paa = (
            pww + 2 * dt * pwa + dt**2 * paa + q * dt,
            keep * (pwa + dt * paa),
            keep**2 * paa + d * (1 - keep**2),
        )
        s, e = pww + r, measured - w
        kw, ka = pww / s, pwa / s
        step = limited(e, s, robust)
        w, a = w + kw * step, a + ka * step
        pww, pwa, paa = (1 - kw) * pww, (1 - kw) * pwa, paa - ka * pwa
        return (w, a, pww, pwa, paa), (e, s)

    zero = jnp.zeros(3)
    start = (piece.body_rate[0], zero, r, zero, d)
    _, (error, variance) = jax.lax.scan(row, start, (piece.interval[1:], torque, piece.body_rate[1:]))
    return error, variance


def force_innovations(
    parameters: Parameters, noise: Noise, piece: Segments, thrust: Float[Array, "n"], robust: bool
) -> tuple[Float[Array, "n 1"], Float[Array, "n 1"]]:
    """Specific force along z against thrust over mass behind the accelerometer's low-pass, with a wandering offset.

    Without the low-pass (30 Hz on the Crazyflie) the slope of thrust over rotor speed comes out too small.
    """
    r, d, lag = noise.accelerometer**2, noise.force_disturbance**2, noise.accelerometer_lag

    def row(carry, inputs):
        shown, a, p = carry
        dt, before, now, measured = inputs
        keep, fade = jnp.exp(-dt / CORRELATION_TIME), jnp.exp(-dt / lag)
        # Exact for a force that changes linearly between rows.
        trail = lag * (now - before) / jnp.where(dt > 0, dt, 1.0)
        shown = jnp.where(dt > 0, now - trail + fade * (shown - before + trail), shown)
        a, p = keep * a, keep**2 * p + d * (1 - keep**2)
        s, e = p + r, measured - shown - a
        k = p / s
        return (shown, a + k * limited(e, s, robust), (1 - k) * p), (e, s)

    force = thrust / parameters.mass
    before = jnp.concatenate([force[:1], force[:-1]])
    inputs = (piece.interval[1:], before, force, piece.specific_force[1:, 2])
    _, (error, variance) = jax.lax.scan(row, (force[0], jnp.zeros(()), d), inputs)
    return error[:, None], variance[:, None]


class _Belief(NamedTuple):
    """Rotor speed x and wandering error of its steady value b, with covariance, each (..., 4)."""

    x: Array
    b: Array
    pxx: Array
    pxb: Array
    pbb: Array


def rotor_innovations(
    parameters: Parameters, noise: Noise, piece: Segments, robust: bool
) -> tuple[Float[Array, "n 4"], Float[Array, "n 4"]]:
    """Rotor speeds from commands, with a wandering error of the steady speed (battery, load)."""
    _, (_, _, error, variance) = _rotor_filter(parameters, noise, piece, robust)
    return error, variance


def smoothed_rotor_speed(parameters: Parameters, noise: Noise, piece: Segments, robust: bool) -> Float[Array, "rows 4"]:
    """Rotor speeds from measurements and commands together (Rauch, Tung and Striebel 1965), rad/s.

    Differences of raw readings carry more noise than a rotor's acceleration does, and errors in a regressor pull J_m
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

    def row(at, inputs):
        dt, goal, measured, valid = inputs
        keep, decay = jnp.exp(-dt / CORRELATION_TIME), jnp.exp(-dt / parameters.motor_time_constant)
        mix = 1 - decay
        x, b = decay * at.x + mix * (goal + at.b), keep * at.b
        prior = _Belief(
            x,
            b,
            # The floor keeps the padding's covariance invertible for the smoother.
            decay**2 * at.pxx + 2 * decay * mix * at.pxb + mix**2 * at.pbb + q * dt + 1e-6,
            keep * (decay * at.pxb + mix * at.pbb),
            keep**2 * at.pbb + d * (1 - keep**2) + 1e-6,
        )
        s, e = prior.pxx + r, measured - x
        # The padding repeats the last reading; it must count once.
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
    rows = (piece.interval[1:], target[:-1], piece.rotor_speed[1:], piece.valid[1:])
    _, found = jax.lax.scan(row, start, rows)
    return start, found
