"""Replay: predict accelerations and rotor speeds of a model along a flight, with the body's state taken from the log.

The state is read from the log at every row, so the prediction cannot diverge. Only what the log does not contain (rotor
speeds from commands, memories of effects) is integrated. The effects use the same functions as in simulation. Many
flights, or many models on one flight, are processed in parallel, `ROWS` rows at a time, so that one compiled program
serves any number and length of flights.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import islice
from typing import Literal, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float

from cfb_mjx.devices import over_cores
from cfb_mjx.model import rotors
from cfb_mjx.model.effects import Effect, Reading, overrides
from cfb_mjx.model.quadrotor import (
    Quadrotor,
    at_rotor_center,
    begin,
    commanded_path,
    conditions,
    followed,
    loaded,
    prepare,
    remembering,
)
from cfb_mjx.model.state import AnyArray, State, unstack
from cfb_mjx.model.vector import Vec, rotate
from cfb_mjx.sysid.flight import ROWS, Flight

LANES = 8, 64
"""Number of lanes processed in parallel; the smaller one if it suffices. One row of 64 lanes takes three times as long
as one row of a single lane."""
MOST = 500_000
"""Maximum number of rows processed in parallel, which limits the memory."""


def between(x):
    """Values (n, ...) in the middle of the interval after each row; the last row is unchanged."""
    return 0.5 * (x + x[np.minimum(np.arange(1, len(x) + 1), len(x) - 1)])


class Lane(NamedTuple):
    """One flight to be replayed by one model."""

    flight: Flight
    driven: AnyArray
    """(n, 4) rotor speeds that drive the body where the flight's were measured (`smoothed_rotor_speed`), rad/s."""
    lead: float = 0.0
    """Share of the next row's command in the mean command over an interval, for commands that were sent between two
    rows and are not in the log (0: none are missing; about 1/4: every second one is)."""
    effects: tuple[Effect, ...] | None = None
    """Effects with other values, in place of the model's."""
    rows: AnyArray | None = None
    """(m,) rows, ascending, whose output is wanted; all by default."""


class Replay(NamedTuple):
    """Predictions of a model along a flight."""

    rotor_speed: Float[AnyArray, "n 4"]
    """Rotor speed at each row from the commands alone, rad/s."""
    angular_acceleration: Float[AnyArray, "n 3"]
    """Mean over the interval after each row, body axes, rad/s^2."""
    specific_force: Float[AnyArray, "n 3"]
    """At the rotors' centre, in the middle of the interval after each row, body axes, m/s^2."""


def replays(model: Quadrotor, lanes: Iterable[Lane]) -> Iterator[Replay]:
    """Replay flights lazily, in the order of ``lanes``.

    Args:
        model: the drone with its effects.
        lanes: flights, each with the effects' values to use.
    """
    return _walked(model, lanes, "sensors")


def speeds_along(model: Quadrotor, flights: Sequence[Flight], lead: float = 0.0) -> list[np.ndarray]:
    """Rotor speeds (n, 4) from commands at each row of the flights, rad/s, as from `remembered_along`.

    Only the part of the model that acts on the rotors is evaluated.
    """
    alone = rotors_alone(model)
    # An effect on the rotors whose memory depends on the model's residual needs the whole model.
    if any(_drives(effect) and overrides(effect, "follow") for effect in model.effects):
        return [speed for speed, _ in remembered_along(model, flights, lead)]
    return list(_walked(alone, [Lane(flight, flight.rotor_speed, lead) for flight in flights], "speed"))


def _drives(effect: Effect) -> bool:
    return overrides(effect, "motors") or overrides(effect, "command")


def remembered_along(
    model: Quadrotor, flights: Sequence[Flight], lead: float = 0.0, rows: Sequence[AnyArray] | None = None
) -> list[tuple[np.ndarray, tuple]]:
    """Rotor speeds (m, 4) from commands, rad/s, and memories of all effects (leading axis m), at rows of the flights.

    Args:
        model: the drone with its effects.
        flights: prepared logs.
        lead: as in `Lane`.
        rows: (m,) rows of each flight, ascending; all by default.
    """
    wanted = [None] * len(flights) if rows is None else rows
    pairs = zip(flights, wanted, strict=True)
    lanes = [Lane(flight, flight.rotor_speed, lead, rows=own) for flight, own in pairs]
    return list(_walked(rotors_alone(model), lanes, "memory"))


def rotors_alone(model: Quadrotor) -> Quadrotor:
    """The model with default integration options, on which the rotors do not depend; one program then serves all."""
    return Quadrotor(model.parameters, model.effects, model.body, dt=model.dt, substeps=model.substeps)


Wanted = Literal["sensors", "memory", "speed"]
"""Output at every row: a `Replay`, rotor speeds and memories, or rotor speeds alone."""


def _walked(model: Quadrotor, lanes: Iterable[Lane], wanted: Wanted) -> Iterator:
    def walked(some: list[Lane]) -> list:
        return _side_by_side(model, some, wanted)

    for found in over_cores(walked, _grouped(lanes)):
        yield from found


def _side_by_side(model: Quadrotor, some: list[Lane], wanted: Wanted) -> list:
    rows = [np.arange(len(lane.flight.time)) if lane.rows is None else np.asarray(lane.rows) for lane in some]
    kept: list[list] = [[] for _ in some]
    for block, found in enumerate(_in_turn(model, some, wanted)):
        for i, own in enumerate(rows):
            # Copied: a view would keep the whole block.
            here = own[slice(*np.searchsorted(own, [block * ROWS, (block + 1) * ROWS]))] - block * ROWS
            kept[i].append(jax.tree.map(lambda x, i=i, here=here: x[i, here], found))
    return [jax.tree.map(lambda *x: np.concatenate(x), *pieces) for pieces in kept]


def _in_turn(model: Quadrotor, some: Sequence[Lane], wanted: Wanted) -> Iterator:
    """Outputs of all lanes, `ROWS` rows at a time."""
    width = next(count for count in LANES if count >= len(some))
    # Fill up with copies of the last lane.
    whole = [*some, *[some[-1]] * (width - len(some))]
    numbers = [model.effects if lane.effects is None else lane.effects for lane in whole]
    effects = jax.tree.map(lambda *x: np.stack([np.asarray(y) for y in x]), *numbers)
    lead = np.array([lane.lead for lane in whole], float)
    measured = np.array([lane.flight.measured for lane in whole], float)
    flights = {id(lane.flight): lane.flight for lane in some}.values()
    read = _READ + (("other",) if any(np.isfinite(flight.other).any() for flight in flights) else ())
    carry = None
    for first in range(0, max(len(lane.flight.time) for lane in some), ROWS):
        # One more row, for the interval after the last one.
        rows = _rows(whole, read, first, first + ROWS + 1)
        if carry is None:
            carry = _begin(model, effects, {key: x[:, :2] for key, x in rows.items()})
        carry, found = _advance(model, effects, lead, measured, rows, carry, wanted)
        yield jax.tree.map(lambda x: np.asarray(x)[: len(some)], found)


def replays_in_pieces(model: Quadrotor, lanes: Sequence[Lane], blocks: int) -> Iterator[Replay]:
    """Replay one long flight by several models, some rows at a time, so that memory does not grow with the flight.

    Args:
        model: as for `replays`.
        lanes: of the same flight.
        blocks: size of a piece, in blocks of `ROWS` rows.

    Returns:
        Iterator over pieces; the arrays of each have the lanes as their leading axis.
    """
    groups = [_in_turn(model, lanes[i : i + LANES[-1]], "sensors") for i in range(0, len(lanes), LANES[-1])]
    for _ in range(0, len(lanes[0].flight.time), blocks * ROWS):
        found = [jax.tree.map(lambda *x: np.concatenate(x, axis=1), *islice(group, blocks)) for group in groups]
        yield jax.tree.map(lambda *x: np.concatenate(x), *found)


def _grouped(lanes: Iterable[Lane]) -> Iterator[list[Lane]]:
    some: list[Lane] = []
    for lane in lanes:
        longest = max(len(each.flight.time) for each in (*some, lane))
        if some and (len(some) == LANES[-1] or longest * (len(some) + 1) > MOST):
            yield some
            some = []
        some.append(lane)
    if some:
        yield some


_READ = ("time", "interval", "position", "velocity", "quaternion", "body_rate", "specific_force", "command", "voltage")


def _rows(lanes: list[Lane], read: Sequence[str], first: int, last: int) -> dict[str, np.ndarray]:
    """Columns of rows [first, last) of every lane's flight; beyond its end, the last row with zero intervals."""
    rows = {id(lane.flight): np.minimum(np.arange(first, last), len(lane.flight.time) - 1) for lane in lanes}
    # Many lanes often share one flight.
    flights = {id(lane.flight): lane.flight for lane in lanes}
    found = {}
    for key in read:
        some = {at: np.asarray(getattr(flight, key))[rows[at]] for at, flight in flights.items()}
        found[key] = np.stack([some[id(lane.flight)] for lane in lanes])
    return found | {"driven": np.stack([np.asarray(lane.driven)[rows[id(lane.flight)]] for lane in lanes])}


def _state(rows: Mapping[str, AnyArray]) -> State:
    """State of the body in the middle of the intervals between rows."""
    names = ("position", "velocity", "quaternion", "body_rate", "driven")
    return State(*(0.5 * (rows[name][:-1] + rows[name][1:]) for name in names))


@eqx.filter_jit
def _begin(model: Quadrotor, effects: tuple[Effect, ...], rows: Mapping[str, AnyArray]):
    """Initial rotor speeds and memories of every lane, as after a long steady flight at the first row."""

    def one(effects, rows):
        own = _with(model, effects)
        center = Vec.unstack(own.changed_parameters().center_of_gravity)
        first = jax.tree.map(lambda x: x[0], _state(rows))
        speed = rotors.steady_speed(prepare(own).rotors, Vec.unstack(rows["command"][0]))
        start = begin(own, State(first.position, first.velocity, first.quaternion, first.body_rate, speed.stack()))
        return speed, unstack(start, center).memory

    # Weak types would become strong after some rows, which would require a second compilation.
    return jax.tree.map(lambda x: jax.lax.convert_element_type(x, x.dtype), jax.vmap(one)(effects, rows))


def _with(model: Quadrotor, effects: tuple[Effect, ...]) -> Quadrotor:
    return eqx.tree_at(lambda m: m.effects, model, effects) if effects else model


@eqx.filter_jit
def _advance(model: Quadrotor, effects: tuple[Effect, ...], lead, measured, rows, carry, wanted: Wanted):
    """Advance every lane by some rows; return the new carry and the output at each row."""

    def one(effects, lead, measured, rows, carry):
        return _along(_with(model, effects), lead, measured, rows, carry, wanted)

    return jax.vmap(one)(effects, lead, measured, rows, carry)


def _along(model: Quadrotor, lead: Array, share: Array, rows: dict[str, Array], carry, wanted: Wanted):
    center = Vec.unstack(model.changed_parameters().center_of_gravity)
    here, there = (Vec.unstack(rows["driven"][x]) for x in (slice(-1), slice(1, None)))
    command = rows["command"][:-1] + lead * (rows["command"][1:] - rows["command"][:-1])
    felt = 0.5 * (rows["specific_force"][:-1] + rows["specific_force"][1:])
    inputs = (
        _state(rows),
        Vec.unstack(command),
        rows["interval"][:-1],
        here,
        there,
        rows["voltage"][:-1],
        rows["time"][:-1],
        Vec.unstack(felt),
        (Vec.unstack(rows["other"][:-1]),) if "other" in rows else (),
    )

    def row(carry, inputs):
        speed, memory = carry
        at, command, dt, here, there, voltage, time, felt, other = inputs
        reading = Reading(voltage, time, other)
        memory = tuple(effect.sense(m, reading) for effect, m in zip(model.effects, memory, strict=True))
        prepared = prepare(model, dt)
        path, moved = commanded_path(prepared, speed, memory, command)
        straight = rotors.path_between(prepared.rotors, here, there)
        # Measured rotor speeds drive the body; the rotor model itself is still driven by the commands.
        body_speed = share * straight.middle + (1 - share) * path.middle
        rate = share * straight.rate_middle + (1 - share) * ((path.end - path.start) * prepared.rotors.inverse_dt)
        where = remembering(unstack(at, center), moved)
        seen = conditions(prepared, where, body_speed)
        acceleration = rotate(where.quaternion, felt) - Vec(0.0, 0.0, prepared.parameters.gravity)
        if wanted == "speed":
            advanced = followed(prepared, seen, acceleration, Vec(0.0, 0.0, 0.0))
            pairs = zip(model.effects, advanced, moved, strict=True)
            return (path.end, tuple(new if _drives(effect) else old for effect, new, old in pairs)), speed.stack()
        wrench = loaded(model, prepared.parameters, rotors.loads_at(prepared.rotors, body_speed, rate), seen)
        angular, force = at_rotor_center(prepared.parameters, wrench, where.body_rate)
        # Memories that depend on accelerations (a slung load) follow the measured motion, not the model's.
        missed = rotate(where.quaternion, felt - force)
        moved = followed(prepared, seen, acceleration, missed)
        kept = jax.tree.map(lambda v: v.stack(), memory, is_leaf=lambda x: isinstance(x, Vec))
        known = (speed.stack(), kept) if wanted == "memory" else Replay(speed.stack(), angular.stack(), force.stack())
        return (path.end, moved), known

    return jax.lax.scan(row, carry, inputs)


def smoothed_rotor_speed(flight: Flight, modelled: np.ndarray, width: float = 0.012) -> np.ndarray:
    """Reduce the noise of measured rotor speeds: the model's speeds plus their smoothed error.

    Noise in a regressor biases its coefficient towards zero; the rotors' acceleration is affected most.

    Args:
        flight: with measured rotor speeds.
        modelled: (n, 4) rotor speeds from commands, rad/s.
        width: standard deviation of the Gaussian filter of the error, s.
    """
    error = np.asarray(flight.rotor_speed) - np.asarray(modelled)
    step = float(np.median(np.asarray(flight.interval)[np.asarray(flight.interval) > 0]))
    reach = max(1, int(np.ceil(3 * width / step)))
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) * step / width) ** 2)
    weight = np.ones(len(error))
    norm = np.convolve(weight, kernel, mode="same")
    smooth = np.stack([np.convolve(error[:, i], kernel, mode="same") / norm for i in range(4)], axis=1)
    return np.asarray(modelled) + smooth
