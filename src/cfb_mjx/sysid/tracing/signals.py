"""Residuals of a model along flights and their derivatives, as the filters of `tracing.innovations` read them.

Sensor readings are predicted from the model's accelerations, which are replayed along the measured motion
(`cfb_mjx.sysid.replay`). Derivatives with respect to parameters are finite differences of such predictions.
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

from cfb_mjx.logs.rotation import to_world
from cfb_mjx.model.effects import Condition, Effect, Wrench
from cfb_mjx.model.effects.formula import body_signals, place_signals
from cfb_mjx.model.quadrotor import Quadrotor, at_rotor_center, in_still_air, prepare
from cfb_mjx.model.state import AnyArray, State, unstack
from cfb_mjx.model.vector import Vec, rotate_inverse
from cfb_mjx.parameters import Parameters
from cfb_mjx.sysid.flight import ROWS, Flight, lengthened
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
