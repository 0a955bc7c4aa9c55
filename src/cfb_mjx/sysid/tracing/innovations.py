"""Turning what a model misses into white noise: the filters that say how surprising a residual is, and to which levels.

Three domains, each a scalar filter per axis or motor with two states: the accumulated error of a quantity (body rate,
velocity, rotor speed) and a wandering disturbance behind it (Ornstein-Uhlenbeck). Innovations of these filters are
white where the model is right, whatever the controller does (see `cfb_mjx.sysid.identification.innovation`). The
filters are linear, so the derivative of a residual by a parameter is whitened by the same filter as the residual.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from cfb_mjx.logs import FlightLog
from cfb_mjx.model.effects import Condition, Wrench
from cfb_mjx.model.effects.formula import body_signals, place_signals
from cfb_mjx.model.quadrotor import Quadrotor, at_rotor_center, in_still_air, prepare
from cfb_mjx.model.state import State, unstack
from cfb_mjx.model.vector import Vec, rotate, rotate_inverse
from cfb_mjx.parameters import Parameters
from cfb_mjx.sysid.flight import Flight, in_groups
from cfb_mjx.sysid.identification.flight_data import white_noise
from cfb_mjx.sysid.replay import between, remembered_along, replay, smoothed_rotor_speed

BLOCK = 512
"""Rows that stay together: about two seconds at 250 Hz. A filter starts anew in every block."""
CHANNELS = 10
MOTOR_LAG = 0.05


class Levels(eqx.Module):
    """Noise levels of the filters, one per channel (body rate 3, velocity 3, rotor speed 4) unless said otherwise."""

    reading: Float[Array, "10"]
    """White noise of a row: rad/s, m/s, rad/s."""
    accelerometer: Float[Array, ""]
    """White noise of a row, m/s^2."""
    walk: Float[Array, "10"]
    """White noise driving the quantity, its unit per square root of a second."""
    disturbance: Float[Array, "10"]
    """Of the wandering disturbance: rad/s^2, m/s^2, rad/s."""
    correlation_time: Float[Array, "10"]
    """Of the disturbance, s."""


class Signals(eqx.Module):
    """What the filters read, row by row; the last axis may hold a residual and its derivatives side by side."""

    quantity: Float[Array, "n 10 *c"]
    """Body rate, velocity and rotor speed minus what the model accumulates from its accelerations."""
    acceleration: Float[Array, "n 3 *c"]
    """Accelerometer minus model, world axes."""


def predicted(model: Quadrotor, flight: Flight, driven: Array, lead: Array) -> Signals:
    """What the model says the sensors read, accumulated from its accelerations (so only changes mean something)."""
    found = replay(model, flight, driven, lead)
    gravity = model.parameters.gravity
    return accumulated(flight, found.angular_acceleration, found.specific_force, found.rotor_speed, gravity)


def accumulated(
    flight: Flight,
    angular_acceleration: Float[Array, "n 3"],
    specific_force: Float[Array, "n 3"],
    rotor_speed: Float[Array, "n 4"],
    gravity: Float[Array, ""],
) -> Signals:
    """Signals of accelerations in body axes; ``gravity`` is zero for what comes on top of others."""
    dt = flight.interval[:, None]
    force = Vec.unstack(specific_force)
    middle = between(flight.quaternion)
    middle = middle / jnp.linalg.norm(middle, axis=1, keepdims=True)
    world = rotate(Vec.unstack(middle), force).stack()
    up = jnp.array([0.0, 0.0, 1.0]) * gravity

    def summed(rate):
        return jnp.concatenate([jnp.zeros((1, 3)), jnp.cumsum(rate * dt, axis=0)[:-1]])

    before = jnp.concatenate([world[:1], world[:-1]])
    quantity = jnp.concatenate([summed(angular_acceleration), summed(world - up), rotor_speed], axis=1)
    return Signals(quantity, 0.5 * (before + world))


def measured(flight: Flight) -> Signals:
    """What the sensors read."""
    world = rotate(Vec.unstack(flight.quaternion), Vec.unstack(flight.specific_force)).stack()
    return Signals(jnp.concatenate([flight.body_rate, flight.velocity, flight.rotor_speed], axis=1), world)


class Blocks(eqx.Module):
    """Signals cut into B blocks of `BLOCK` rows, with what the filters need to know of each row."""

    signals: Signals
    interval: Float[Array, "b r"]
    """From the row before, s."""
    valid: Float[Array, "b r 10"]


def cut(flight: Flight, signals: Signals) -> Blocks:
    """Blocks of a padded flight."""
    count = flight.time.shape[0] // BLOCK
    interval = jnp.concatenate([jnp.zeros(1), flight.interval[:-1]])
    rotor = flight.valid * flight.measured
    valid = jnp.concatenate([jnp.repeat(flight.valid[:, None], 6, 1), jnp.repeat(rotor[:, None], 4, 1)], axis=1)

    def chop(x):
        return x[: count * BLOCK].reshape(count, BLOCK, *x.shape[1:])

    return Blocks(jax.tree.map(chop, signals), chop(interval), chop(valid))


def joined(pieces: Iterable[Blocks]) -> Blocks:
    """The blocks of several flights, one after the other."""
    return jax.tree.map(lambda *x: np.concatenate([np.asarray(y) for y in x]), *pieces)


def innovations(blocks: Blocks, levels: Levels) -> tuple[Array, Array, Array]:
    """Whitened innovations (b, r, 13, c) of quantities and accelerometer, their log-variances, and where they count.

    Signals need their last axis (c).
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
        # The first row that counts only says where the quantity starts.
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
    """Levels from the numbers a likelihood is maximised in (23: walk, disturbance and time per domain and axis)."""
    spread = jnp.array([0, 1, 2, 3, 4, 5, 6, 6, 6, 6])
    x = jnp.exp(vector)
    times = jnp.array([0, 0, 0, 1, 1, 1, 2, 2, 2, 2])
    reading = jnp.concatenate([noise["gyro"], jnp.full(3, noise["velocity"]), jnp.full(4, noise["rotor"])])
    return Levels(
        reading=reading,
        accelerometer=jnp.asarray(noise["accelerometer"]),
        walk=_LOWEST + x[:7][spread],
        disturbance=10 * _LOWEST + x[7:14][spread],
        correlation_time=jnp.clip(x[14:17][times], 0.05, 3.0),
    )


FIRST = np.log(np.array([0.1] * 3 + [0.02] * 3 + [10.0] + [0.5] * 3 + [0.1] * 3 + [10.0] + [0.4, 0.4, 0.5]))


@eqx.filter_jit
def _loss(vector, noise, blocks: Blocks):
    wide = jax.tree.map(lambda x: x[..., None], blocks.signals)
    e, logs, use = innovations(Blocks(wide, blocks.interval, blocks.valid), levels_from(vector, noise))
    # Very long tails (a gust, a glitch) must not set the level of everything.
    size = jnp.abs(e[..., 0])
    surprise = jnp.where(size < 4, size**2, 8 * size - 16)
    prior = 0.05 * jnp.sum((vector - FIRST) ** 2)
    return (0.5 * jnp.sum(logs + surprise * use) + prior) / jnp.maximum(jnp.sum(use), 1.0)


_slope = eqx.filter_jit(jax.value_and_grad(_loss))


def fit_levels(blocks: Blocks, noise: dict[str, np.ndarray], start: np.ndarray = FIRST) -> np.ndarray:
    """Noise levels of largest likelihood for a residual: the vector of `levels_from`."""
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
        # From levels found before, a few steps are enough.
        options={"maxiter": 40 if start is FIRST else 15, "ftol": 1e-6},
    )
    return found.x


@eqx.filter_jit
def _residuals(model: Quadrotor, lead: Array, flights: Flight, driven: Array) -> Blocks:
    def one(flight, driven):
        said = predicted(model, flight, driven, lead)
        return cut(flight, jax.tree.map(lambda a, b: a - b, measured(flight), said))

    return jax.vmap(one)(flights, driven)


def driven_by(model: Quadrotor, flights: Sequence[Flight], lead: float) -> list[np.ndarray]:
    """Rotor speeds (n, 4) that drive the body along each flight: measured, or from commands."""
    pairs = zip(flights, (speed for speed, _ in remembered_along(model, flights, lead)), strict=True)
    return [smoothed_rotor_speed(flight, speed) if flight.measured else speed for flight, speed in pairs]


def residual_blocks(
    model: Quadrotor, flights: Sequence[Flight], driven: Sequence[np.ndarray], lead: float
) -> list[Blocks]:
    """What the model misses along each flight."""
    return in_groups(partial(_residuals, model, jnp.asarray(lead)), flights, driven)


@eqx.filter_jit
def with_slopes(models: Quadrotor, flight: Flight, driven: Array, leads: Array, shifts: Array, steps: Array) -> Signals:
    """The residual of a flight and, side by side along the last axis (c), its derivatives.

    Args:
        models: leaves of the effects with a leading axis (c): the model as it is, then moved by each step.
        flight: one flight.
        driven: of `driven_by`.
        leads: (c,) command lead of each.
        shifts: (c,) s by which the motor columns of each are taken to be late.
        steps: (c - 1,) size of the moves, in the units of the columns.

    Returns:
        Column 0 is the residual, the others are what the model would say more per unit of each number.
    """
    time = flight.time
    slope = jnp.gradient(driven, axis=0) / jnp.maximum(jnp.gradient(time), 1e-4)[:, None]
    # Late commands and late rotor speeds agree with each other; only what the body does comes too early.
    rows = jnp.sum(flight.interval) / jnp.maximum(jnp.sum(flight.interval > 0), 1)

    def one(effects, lead, shift):
        model = eqx.tree_at(lambda m: m.effects, models, effects)
        more = (1 - flight.measured) * shift / rows
        return predicted(model, flight, driven + flight.measured * shift * slope, lead + more)

    said = jax.vmap(one)(models.effects, leads, shifts)
    seen = measured(flight)

    def side_by_side(m, s):
        base = m - s[0]
        slopes = (s[1:] - s[:1]) / steps.reshape(-1, *([1] * base.ndim))
        return jnp.moveaxis(jnp.concatenate([base[None], slopes]), 0, -1)

    return Signals(*(side_by_side(getattr(seen, k), getattr(said, k)) for k in ("quantity", "acceleration")))


def _seen(model: Quadrotor, flight: Flight, driven: Array) -> tuple[Parameters, Condition]:
    """The parameters, and the flight condition in the middle of every interval."""
    prepared = prepare(model)
    middle = (flight.position, flight.velocity, flight.quaternion, flight.body_rate, driven)
    at = unstack(State(*map(between, middle)), prepared.parameters.center_of_gravity)
    return prepared.parameters, in_still_air(prepared, at, at.rotor_speed)


@eqx.filter_jit
def term_squares(model: Quadrotor, flight: Flight, driven: Array) -> Float[Array, " c"]:
    """Mean squares of the signals of the formulas' library over a flight: body terms, then places."""
    _, seen = _seen(model, flight, driven)
    signals = jnp.stack([*body_signals(seen), *place_signals(seen)], axis=-1)
    return flight.valid @ signals**2 / jnp.maximum(jnp.sum(flight.valid), 1.0)


@eqx.filter_jit
def term_slopes(model: Quadrotor, flight: Flight, driven: Array, axis: Array) -> Signals:
    """What each term of the formulas' library (c: body terms, then places) along one axis (0..5) adds.

    The same as the derivatives by a `ResidualFormula`'s numbers, without replaying the model for every one of them:
    a wrench on the body does not change how the rotors run.
    """
    parameters, seen = _seen(model, flight, driven)
    along = jnp.arange(6) == axis

    def signals(force: Vec, torque: Vec) -> Signals:
        spin, push = at_rotor_center(parameters, Wrench(force, torque), Vec(0.0, 0.0, 0.0))
        still = jnp.zeros((flight.time.shape[0], 4))
        return accumulated(flight, spin.stack(), push.stack(), still, jnp.zeros(()))

    found = [signals(Vec(*(a * s for a in along[3:])), Vec(*(a * s for a in along[:3]))) for s in body_signals(seen)]
    for s in place_signals(seen):
        pull = rotate_inverse(seen.quaternion, Vec(*(a * s for a in along[3:])))
        found.append(signals(pull, Vec(0.0, 0.0, 0.0)))
    return jax.tree.map(lambda *x: jnp.stack(x, axis=-1), *found)


@eqx.filter_jit
def inner_products(flight: Flight, signals: Signals, levels: Levels) -> Float[Array, "b c c"]:
    """Inner products of whitened signals side by side, per block."""
    e, _, _ = innovations(cut(flight, signals), levels)
    return jnp.einsum("brkc,brkd->bcd", e, e)


def sensor_noise(logs: list[FlightLog], least_gyro: float = 1e-3) -> dict[str, np.ndarray]:
    """White noise of gyro (3), velocity, accelerometer and rotor speed rows, medians over the logs.

    ``least_gyro`` is the lowest level believed of a gyro, rad/s: behind a low-pass its rows look better than they are.
    """

    def level(pick):
        found = [np.atleast_1d(white_noise(pick(log))) for log in logs if pick(log) is not None]
        return np.median(found, axis=0) if found else None

    speed = level(lambda log: log.rotor_speed)
    return {
        "gyro": np.maximum(level(lambda log: log.body_rate), least_gyro),
        "velocity": np.maximum(np.mean(level(lambda log: log.velocity)), 1e-3),
        "accelerometer": np.maximum(np.mean(level(lambda log: log.specific_force)), 1e-2),
        "rotor": np.array(10.0) if speed is None else np.maximum(np.nanmean(speed), 1.0),
    }
