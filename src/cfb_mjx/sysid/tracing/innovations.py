"""Kalman filters that whiten a model's residual, and the maximum-likelihood fit of their noise levels.

Each axis or motor of three domains has a scalar filter with two states: the accumulated error of a quantity (body rate,
velocity, rotor speed) and a slowly varying disturbance that drives it (an Ornstein-Uhlenbeck process). If the model is
right, the innovations of these filters are white for any controller (see `cfb_mjx.sysid.identification.innovation`).
The filters are linear, so the derivative of a residual with respect to a parameter is whitened by the same filter.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import islice

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from cfb_mjx.devices import last_repeated, over_cores
from cfb_mjx.logs import FlightLog
from cfb_mjx.optional import not_none
from cfb_mjx.sysid.flight import ROWS
from cfb_mjx.sysid.identification.flight_data import white_noise
from cfb_mjx.sysid.tracing.signals import Blocks, Signals

CHANNELS = 10
DOMAINS = {"rotor_speed": range(6, 10), "force": (*range(3, 6), *range(10, 13)), "torque": range(3)}
"""Channels of the innovations by where an effect acts: on rotor speeds, on forces, or on torques."""
SIDE_BY_SIDE = 32, 16
"""Number of groups of columns whitened at once, and of columns in a group. Fixed, so that one compiled program serves
any number."""
MOTOR_LAG = 0.05
"""Lag with which the error of a rotor speed follows its disturbance, s."""


class Levels(eqx.Module):
    """Noise levels of the filters, one per channel (body rate 3, velocity 3, rotor speed 4) unless said otherwise."""

    reading: Float[Array, "10"]
    """White measurement noise per row: rad/s, m/s, rad/s."""
    accelerometer: Float[Array, ""]
    """White measurement noise of the accelerometer per row, m/s^2."""
    walk: Float[Array, "10"]
    """White process noise of the quantity, in its unit per square root of a second."""
    disturbance: Float[Array, "10"]
    """Standard deviation of the disturbance: rad/s^2, m/s^2, rad/s."""
    correlation_time: Float[Array, "10"]
    """Correlation time of the disturbance, s."""


def innovations(blocks: Blocks, levels: Levels) -> tuple[Array, Array, Array]:
    """Run the filters over blocks whose signals have their last axis (c).

    Returns:
        Whitened innovations (b, r, 13, c) of the ten quantities and the accelerometer, their log-variances (b, r, 13),
        and the mask (b, r, 13) of the innovations that count.
    """
    return jax.vmap(lambda block: _walk(block, levels))(blocks)


def _walk(block: Blocks, levels: Levels):
    columns = block.signals.quantity.shape[-1]
    r, ra = levels.reading**2, levels.accelerometer**2
    is_force = (jnp.arange(CHANNELS) >= 3) & (jnp.arange(CHANNELS) < 6)
    is_rotor = jnp.arange(CHANNELS) >= 6

    def row(carry, inputs):
        x, d, pxx, pxd, pdd, known = carry
        y, a, dt, valid = inputs
        keep = jnp.exp(-dt / levels.correlation_time)
        fade = jnp.where(is_rotor, jnp.exp(-dt / MOTOR_LAG), 1.0)
        gain = jnp.where(is_rotor, 1 - fade, dt)
        x = fade[:, None] * x + gain[:, None] * d
        d = keep[:, None] * d
        pxx = fade**2 * pxx + 2 * fade * gain * pxd + gain**2 * pdd + levels.walk**2 * dt
        pxd = keep * (fade * pxd + gain * pdd)
        pdd = keep**2 * pdd + levels.disturbance**2 * (1 - keep**2)
        # The first valid row only initialises the quantity.
        new = valid * (1 - known)
        x = jnp.where(new[:, None] > 0, y, x)
        d = jnp.where(new[:, None] > 0, 0.0, d)
        pxx = jnp.where(new > 0, r, pxx)
        pxd = jnp.where(new > 0, 0.0, pxd)
        pdd = jnp.where(new > 0, levels.disturbance**2, pdd)
        counts = valid * known
        s = pxx + r
        e = y - x
        kx, kd = counts * pxx / s, counts * pxd / s
        x, d = x + kx[:, None] * e, d + kd[:, None] * e
        pxx, pxd, pdd = pxx - kx * pxx, pxd - kx * pxd, pdd - kd * pxd
        # The accelerometer reads the disturbance of the force itself.
        also = (counts * is_force)[3:6]
        s2 = pdd[3:6] + ra
        e2 = a - d[3:6]
        kx2, kd2 = also * pxd[3:6] / s2, also * pdd[3:6] / s2
        x = x.at[3:6].add(kx2[:, None] * e2)
        d = d.at[3:6].add(kd2[:, None] * e2)
        pxx = pxx.at[3:6].add(-kx2 * pxd[3:6])
        pxd_new = pxd.at[3:6].add(-kx2 * pdd[3:6])
        pdd = pdd.at[3:6].add(-kd2 * pdd[3:6])
        error = jnp.concatenate([e, e2])
        variance = jnp.concatenate([s, s2])
        use = jnp.concatenate([counts, also])
        return (x, d, pxx, pxd_new, pdd, valid), (
            error * (use / jnp.sqrt(variance))[:, None],
            use * jnp.log(variance),
            use,
        )

    zero = jnp.zeros(CHANNELS)
    wide = jnp.zeros((CHANNELS, columns))
    inputs = (block.signals.quantity, block.signals.acceleration, block.interval, block.valid)
    return jax.lax.scan(row, (wide, wide, zero, zero, zero, zero), inputs)[1]


_LOWEST = np.array([1e-3] * 3 + [1e-4] * 3 + [1e-1] * 4)


def levels_from(vector: Array, noise: dict[str, np.ndarray]) -> Levels:
    """Noise levels from the vector in which the likelihood is maximised, and the measured sensor noise.

    Args:
        vector: (17,) logarithms: walk (7: three body rates, three velocities, all rotor speeds), disturbance (7,
            likewise) and correlation time (3, one per domain).
        noise: white noise of the sensors, from `sensor_noise`.
    """
    spread = jnp.array([0, 1, 2, 3, 4, 5, 6, 6, 6, 6])
    x = jnp.exp(vector)
    times = jnp.array([0, 0, 0, 1, 1, 1, 2, 2, 2, 2])
    reading = jnp.concatenate([noise["gyro"], jnp.full(3, noise["velocity"]), jnp.full(4, noise["rotor"])])
    return Levels(
        reading=reading,
        accelerometer=jnp.asarray(noise["accelerometer"]),
        walk=jnp.asarray(_LOWEST) + x[:7][spread],
        disturbance=jnp.asarray(10 * _LOWEST) + x[7:14][spread],
        correlation_time=jnp.clip(x[14:17][times], 0.05, 3.0),
    )


FIRST = np.log(np.array([0.1] * 3 + [0.02] * 3 + [10.0] + [0.5] * 3 + [0.1] * 3 + [10.0] + [0.4, 0.4, 0.5]))
"""Initial noise levels, as the vector of `levels_from`; also the mean of their prior."""


@eqx.filter_jit
def surprise(vector, noise, blocks: Blocks) -> tuple[Array, Array]:
    """Negative log-likelihood of a residual, nats, at the noise levels of ``vector``, and the number of readings."""
    wide = jax.tree.map(lambda x: x[..., None], blocks.signals)
    e, logs, use = innovations(Blocks(wide, blocks.interval, blocks.valid), levels_from(vector, noise))
    # Huber loss: outliers (a gust, a glitch) must not determine the noise levels.
    size = jnp.abs(e[..., 0])
    squares = jnp.where(size < 4, size**2, 8 * size - 16)
    return 0.5 * jnp.sum(logs + squares * use), jnp.sum(use)


@eqx.filter_jit
def _loss(vector, noise, blocks: Blocks):
    nats, count = surprise(vector, noise, blocks)
    prior = 0.05 * jnp.sum((vector - FIRST) ** 2)
    return (nats + prior) / jnp.maximum(count, 1.0)


_slope = eqx.filter_jit(jax.value_and_grad(_loss))


def fit_levels(blocks: Blocks, noise: dict[str, np.ndarray], start: np.ndarray = FIRST) -> np.ndarray:
    """Maximum-likelihood noise levels of a residual, as the vector of `levels_from`."""
    from scipy.optimize import minimize

    def both(x):
        value, slope = _slope(jnp.asarray(x), noise, blocks)
        return float(value), np.asarray(slope)

    low, high = FIRST - 7, FIRST + 6
    found = minimize(
        both,
        np.clip(start, low, high),
        jac=True,
        method="L-BFGS-B",
        bounds=list(zip(low, high, strict=True)),
        # A few iterations suffice from levels found earlier.
        options={"maxiter": 40 if start is FIRST else 15, "ftol": 1e-6},
    )
    return found.x


def inner_products(pieces: Iterable[Blocks], levels: Levels) -> Float[np.ndarray, "b c c"]:
    """Inner products of the whitened columns (the residual and its derivatives) in each block.

    Args:
        pieces: blocks with the same number of columns (c), of which few are held in memory at a time.
        levels: noise levels.
    """

    def whitened(batch: tuple[Blocks, int, int]) -> tuple[np.ndarray, int]:
        blocks, count, columns = batch
        return np.asarray(_whitened(blocks, levels))[:count], columns

    found, waiting = [], np.zeros((0, ROWS, CHANNELS + 3, SIDE_BY_SIDE[1]))
    for more, columns in over_cores(whitened, _batches(pieces)):
        groups = _groups(columns)
        waiting = np.concatenate([waiting, more])
        count = len(waiting) // groups
        whole, waiting = np.split(waiting, [count * groups])
        e = np.moveaxis(whole.reshape(count, groups, -1, whole.shape[-1]), 1, -2)
        e = e.reshape(count, -1, groups * whole.shape[-1])[..., :columns]
        found.append(np.swapaxes(e, 1, 2) @ e)
    return np.concatenate(found)


def _groups(columns: int) -> int:
    return -(-columns // SIDE_BY_SIDE[1])


def _batches(pieces: Iterable[Blocks]) -> Iterator[tuple[Blocks, int, int]]:
    """Batches with each group of columns of each block as a row of its own.

    Returns:
        Iterator over a batch of `SIDE_BY_SIDE`, the number of its rows that count, and the number of columns.
    """
    most, wide = SIDE_BY_SIDE
    rows = (
        (piece, block, group)
        for piece in pieces
        for block in range(len(piece.interval))
        for group in range(_groups(piece.signals.quantity.shape[-1]))
    )
    while some := list(islice(rows, most)):
        signals = Signals(*(np.zeros((len(some), ROWS, x.shape[-2], wide)) for x in some[0][0].signals))
        for row, (piece, block, group) in enumerate(some):
            for whole, x in zip(signals, piece.signals, strict=True):
                part = x[block, ..., group * wide : (group + 1) * wide]
                whole[row, ..., : part.shape[-1]] = part
        interval = np.stack([piece.interval[block] for piece, block, _ in some])
        valid = np.stack([piece.valid[block] for piece, block, _ in some])
        filled = jax.tree.map(lambda x: last_repeated(x, most), Blocks(signals, interval, valid))
        yield filled, len(some), some[0][0].signals.quantity.shape[-1]


@eqx.filter_jit
def _whitened(blocks: Blocks, levels: Levels) -> Array:
    return innovations(blocks, levels)[0]


def sensor_noise(logs: list[FlightLog], least_gyro: float = 1e-3) -> dict[str, np.ndarray]:
    """White noise per row of gyro (3,), velocity, accelerometer and rotor speed: medians over the logs.

    Args:
        logs: flights.
        least_gyro: lower limit of the gyro's level, rad/s. A low-pass filter makes a gyro's rows look less noisy than
            they are.
    """

    def level(pick):
        found = [np.atleast_1d(white_noise(pick(log))) for log in logs if pick(log) is not None]
        return np.median(found, axis=0) if found else None

    speed = level(lambda log: log.rotor_speed)
    return {
        "gyro": np.maximum(not_none(level(lambda log: log.body_rate)), least_gyro),
        "velocity": np.maximum(np.mean(not_none(level(lambda log: log.velocity))), 1e-3),
        "accelerometer": np.maximum(np.mean(not_none(level(lambda log: log.specific_force))), 1e-2),
        "rotor": np.array(10.0) if speed is None else np.maximum(np.nanmean(speed), 1.0),
    }
