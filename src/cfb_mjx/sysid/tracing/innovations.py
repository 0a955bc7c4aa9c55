"""Kalman filters that whiten a model's residual, and the maximum-likelihood fit of their noise levels.

Each axis or motor of three domains has a scalar filter with two states: the accumulated error of a quantity (body rate,
velocity, rotor speed) and a slowly varying disturbance that drives it (an Ornstein-Uhlenbeck process). If the model is
right, the innovations of these filters are white for any controller (see `cfb_mjx.sysid.identification.innovation`).
The filters are linear, so the derivative of a residual with respect to a parameter is whitened by the same filter.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from itertools import groupby, islice
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from cfb_mjx.devices import last_repeated, over_cores
from cfb_mjx.logs import FlightLog
from cfb_mjx.logs.rotation import to_world
from cfb_mjx.model.effects import Condition, Effect, Wrench
from cfb_mjx.model.effects.formula import body_signals, place_signals
from cfb_mjx.model.quadrotor import Quadrotor, at_rotor_center, in_still_air, prepare
from cfb_mjx.model.state import AnyArray, State, unstack
from cfb_mjx.model.vector import Vec, rotate_inverse
from cfb_mjx.optional import not_none
from cfb_mjx.parameters import Parameters
from cfb_mjx.sysid.flight import ROWS, Flight, lengthened
from cfb_mjx.sysid.identification.flight_data import white_noise
from cfb_mjx.sysid.replay import (
    MOST,
    Lane,
    Replay,
    between,
    replays,
    replays_in_pieces,
    smoothed_rotor_speed,
    speeds_along,
)

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


class Signals(NamedTuple):
    """Input of the filters, row by row. An optional last axis holds a residual and its derivatives side by side."""

    quantity: Float[np.ndarray, "n 10 *c"]
    """Body rate, velocity and rotor speed, minus the model's integrated accelerations and rotor speed."""
    acceleration: Float[np.ndarray, "n 3 *c"]
    """Accelerometer minus model, world axes."""


def predicted(flight: Flight, said: Replay, gravity: float) -> Signals:
    """Sensor readings that a model predicts, integrated from its accelerations; constant offsets have no meaning.

    Args:
        flight: n rows, or one more.
        said: replay (n rows) of the model; or of several models, along leading axes.
        gravity: m/s^2; zero for an increment to other accelerations.
    """
    count = said.rotor_speed.shape[-2]
    dt = flight.interval[:count, None]
    middle = between(flight.quaternion)[:count]
    middle = middle / np.linalg.norm(middle, axis=1, keepdims=True)
    world = to_world(np.asarray(middle), np.asarray(said.specific_force))
    up = np.array([0.0, 0.0, gravity])

    def summed(rate):
        whole = np.zeros_like(rate)
        np.cumsum((rate * dt)[..., :-1, :], axis=-2, out=whole[..., 1:, :])
        return whole

    before = np.concatenate([world[..., :1, :], world[..., :-1, :]], axis=-2)
    quantity = np.concatenate([summed(said.angular_acceleration), summed(world - up), said.rotor_speed], axis=-1)
    return Signals(quantity, 0.5 * (before + world))


def measured(flight: Flight) -> Signals:
    """Measured sensor readings of a flight."""
    world = to_world(np.asarray(flight.quaternion), np.asarray(flight.specific_force))
    return Signals(np.concatenate([flight.body_rate, flight.velocity, flight.rotor_speed], axis=1), world)


class Blocks(eqx.Module):
    """Signals cut into b blocks of `ROWS` rows, with the interval and validity of each row."""

    signals: Signals
    interval: Float[AnyArray, "b r"]
    """Time since the previous row, s."""
    valid: Float[AnyArray, "b r 10"]
    """1 where a channel's reading can be compared with the model."""


def cut(flight: Flight, signals: Signals) -> Blocks:
    """Cut the signals of a flight into blocks; a filter starts anew in every block."""
    interval = np.concatenate([np.zeros(1), flight.interval[:-1]])
    rotor = flight.valid * flight.measured
    valid = np.concatenate([np.repeat(flight.valid[:, None], 6, 1), np.repeat(rotor[:, None], 4, 1)], axis=1)
    chopped = [x.reshape(-1, ROWS, *x.shape[1:]) for x in (*signals, interval, valid)]
    return Blocks(Signals(*chopped[:2]), *chopped[2:])


def joined(pieces: Iterable[Blocks]) -> Blocks:
    """Concatenate the blocks of several flights."""
    return jax.tree.map(lambda *x: np.concatenate([np.asarray(y) for y in x]), *pieces)


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


def driven_by(model: Quadrotor, flights: Sequence[Flight], lead: float) -> list[np.ndarray]:
    """Rotor speeds (n, 4), rad/s, that drive the body along each flight: measured (smoothed), or from commands."""
    pairs = zip(flights, speeds_along(model, flights, lead), strict=True)
    return [smoothed_rotor_speed(flight, speed) if flight.measured else speed for flight, speed in pairs]


def residual_blocks(
    model: Quadrotor, flights: Sequence[Flight], driven: Sequence[np.ndarray], lead: float
) -> list[Blocks]:
    """Residuals of a model along each flight: measured minus predicted sensor readings.

    Args:
        model: the drone.
        flights: prepared flights.
        driven: rotor speeds of each flight, from `driven_by`.
        lead: command lead.
    """
    gravity = float(model.parameters.gravity)
    lanes = (Lane(*pair, lead) for pair in zip(flights, driven, strict=True))
    found = []
    for flight, said in zip(flights, replays(model, lanes), strict=True):
        pairs = zip(measured(flight), predicted(flight, said, gravity), strict=True)
        found.append(cut(flight, Signals(*(a - b for a, b in pairs))))
    return found


class Moved(NamedTuple):
    """A model with one parameter moved, for a finite difference."""

    effects: tuple[Effect, ...]
    lead: float
    """Command lead."""
    shift: float
    """Assumed delay of the motor columns, s."""
    step: float
    """Size of the step, in the parameter's unit."""


class Piece(NamedTuple):
    """Some blocks of a flight."""

    flight: Flight
    """Their rows."""
    ahead: Flight
    """The same rows and the one after them, which counts for nothing; at the flight's end, the same rows."""
    driven: np.ndarray
    """Rotor speeds that drive the body in the rows of ``ahead``, rad/s."""
    signals: Signals | None = None
    """The residual and its derivatives, side by side along the last axis (c)."""


PIECE = 14
"""Number of blocks of a piece. With one row more it is a length of `lengthened`."""


def pieces(flight: Flight, driven: np.ndarray) -> Iterator[Piece]:
    """Cut a flight into pieces of `PIECE` blocks."""
    count = len(flight.time)
    for first in range(0, count, PIECE * ROWS):
        last = min(first + PIECE * ROWS, count)
        own, ahead = (_rows_of(flight, first, end) for end in (last, last + 1))
        counts = np.arange(len(ahead.time)) < last - first
        ahead = eqx.tree_at(lambda f: f.valid, ahead, ahead.valid * counts)
        yield Piece(own, ahead, driven[first : last + 1])


def _rows_of(flight: Flight, first: int, last: int) -> Flight:
    return jax.tree.map(lambda x: x[first:last] if np.ndim(x) else x, flight)


def with_slopes(
    model: Quadrotor, lead: float, moves: Sequence[Moved], flights: Sequence[Flight], driven: Sequence[np.ndarray]
) -> Iterator[Piece]:
    """Residual of each flight and its finite-difference derivatives, side by side along the last axis (c).

    Args:
        model: the unperturbed model.
        lead: its command lead.
        moves: the c - 1 perturbed models.
        flights: prepared flights.
        driven: rotor speeds of each flight, from `driven_by`.

    Returns:
        Iterator over flights; those that would need much memory come in pieces. Column 0 is the residual; the others
        are the change of the model's prediction per unit of each parameter.
    """

    def lanes(flight: Flight, speed: np.ndarray) -> Iterator[Lane]:
        yield Lane(flight, speed, lead, model.effects)
        slope = np.gradient(speed, axis=0) / np.maximum(np.gradient(flight.time), 1e-4)[:, None]
        # Late commands and late rotor speeds agree with each other; only the body's motion is then early.
        row = np.sum(flight.interval) / max(np.count_nonzero(flight.interval > 0), 1)
        for move in moves:
            late, early = flight.measured * move.shift, (1 - flight.measured) * move.shift / row
            yield Lane(flight, speed + late * slope if late else speed, move.lead + early, move.effects)

    def sloped(piece: Piece, said: Replay) -> Piece:
        steps = np.array([move.step for move in moves])
        told = predicted(piece.ahead, said, float(model.parameters.gravity))
        # In place, because they are the largest arrays of a search.
        for seen, x in zip(measured(piece.flight), told, strict=True):
            x[1:] -= x[0]
            x[1:] /= steps[:, None, None]
            x[0] = seen - x[0]
        return piece._replace(signals=Signals(*(np.moveaxis(x, 0, -1) for x in told)))

    count = 1 + len(moves)
    for long, some in groupby(zip(flights, driven, strict=True), lambda pair: count * len(pair[0].time) > MOST):
        if long:
            for pair in some:
                yield from map(sloped, pieces(*pair), replays_in_pieces(model, list(lanes(*pair)), PIECE))
            continue
        pairs = list(some)
        every = replays(model, (lane for pair in pairs for lane in lanes(*pair)))
        for flight, speed in pairs:
            said = Replay(*(np.stack(x) for x in zip(*islice(every, count), strict=True)))
            yield sloped(Piece(flight, flight, speed), said)


def _seen(model: Quadrotor, flight: Flight, driven: Array) -> tuple[Parameters, Condition]:
    """Parameters of the model and flight condition in the middle of every interval."""
    prepared = prepare(model)
    read = (flight.position, flight.velocity, flight.quaternion, flight.body_rate, driven)
    at = unstack(State(*map(between, read)), Vec.unstack(prepared.parameters.center_of_gravity))
    return prepared.parameters, in_still_air(prepared, at, at.rotor_speed)


def term_squares(model: Quadrotor, flight: Flight, driven: np.ndarray) -> Float[np.ndarray, " c"]:
    """Mean squares of the signals of the formula library over a flight: body terms, then places."""
    each = [_term_squares(model, *lengthened(piece.ahead, piece.driven)) for piece in pieces(flight, driven)]
    return np.sum(each, axis=0) / max(np.sum(flight.valid), 1.0)


@eqx.filter_jit
def _term_squares(model: Quadrotor, flight: Flight, driven: Array) -> Array:
    _, seen = _seen(model, flight, driven)
    signals = jnp.stack([*body_signals(seen), *place_signals(seen)], axis=-1)
    return jnp.asarray(flight.valid) @ signals**2


def term_slopes(model: Quadrotor, piece: Piece, axis: int) -> Signals:
    """Predicted signals of each term of the formula library (c: body terms, then places) along one axis (0 to 5).

    They equal the derivatives with respect to the coefficients of a `ResidualFormula`, but need no replay of the model
    for every term, because a wrench on the body does not affect the rotors.
    """
    found = _term_accelerations(model, *lengthened(piece.ahead, piece.driven), jnp.asarray(axis))
    spin, push = (np.asarray(x)[:, : len(piece.flight.time)] for x in found)
    told = predicted(piece.ahead, Replay(np.zeros((*spin.shape[:2], 4)), spin, push), 0.0)
    return Signals(*(np.moveaxis(x, 0, -1) for x in told))


@eqx.filter_jit
def _term_accelerations(model: Quadrotor, flight: Flight, driven: Array, axis: Array) -> tuple[Array, Array]:
    """Angular accelerations and specific forces (c, n, 3) of each term."""
    parameters, seen = _seen(model, flight, driven)
    along = jnp.arange(6) == axis

    def accelerations(force: Vec, torque: Vec) -> tuple[Array, Array]:
        spin, push = at_rotor_center(parameters, Wrench(force, torque), Vec(0.0, 0.0, 0.0))
        return spin.stack(), push.stack()

    found = [
        accelerations(Vec(*(a * s for a in along[3:])), Vec(*(a * s for a in along[:3]))) for s in body_signals(seen)
    ]
    for s in place_signals(seen):
        pull = rotate_inverse(seen.quaternion, Vec(*(a * s for a in along[3:])))
        found.append(accelerations(pull, Vec(0.0, 0.0, 0.0)))
    return jax.tree.map(lambda *x: jnp.stack(x), *found)


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
