"""The model beside a flight: what it says the sensors should read, given where the drone really was.

The body's state is taken from the log row by row, so nothing diverges and no feedback is broken; only what the log
cannot show (rotor speeds from commands, memories of effects) is carried along. Every effect takes part with the very
functions it has in simulation.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from cfb_mjx.model import rotors
from cfb_mjx.model.effects import Reading
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
from cfb_mjx.model.state import State, unstack
from cfb_mjx.model.vector import Vec, rotate
from cfb_mjx.sysid.flight import Flight, in_groups


def next_row(x: Array) -> Array:
    """(n, ...) what the following row holds; the last row stays."""
    return jnp.concatenate([x[1:], x[-1:]])


def between(x: Array) -> Array:
    """(n, ...) in the middle of the interval after each row."""
    return 0.5 * (x + next_row(x))


class Replay(eqx.Module):
    """What a model predicts along a flight."""

    rotor_speed: Float[Array, "n 4"]
    """From the commands alone, at each row, rad/s."""
    angular_acceleration: Float[Array, "n 3"]
    """Mean over the interval after a row, body axes, rad/s^2."""
    specific_force: Float[Array, "n 3"]
    """At the rotors' centre in the middle of that interval, body axes, m/s^2."""


def replay(model: Quadrotor, flight: Flight, driven: Float[Array, "n 4"], lead: Float[Array, ""]) -> Replay:
    """Replay a flight; differentiable, and batched by ``vmap``.

    Args:
        model: the drone with its effects.
        flight: the flight.
        driven: rotor speeds that drive the body where the flight's were measured (`smoothed_rotor_speed`), rad/s.
        lead: share of the next row's command in the mean over an interval: commands sent between two rows are not
            in the log (0: none are missing; about 1/4: every second one is).
    """
    return _scan(model, flight, driven, lead)[0]


def remembered(model: Quadrotor, flight: Flight, lead: Float[Array, ""]) -> tuple[Array, tuple]:
    """Rotor speeds (n, 4) from commands, and the memories of all effects (arrays with leading axis n), at each row."""
    out, memory = _scan(model, flight, flight.rotor_speed, lead)
    return out.rotor_speed, memory


def remembered_along(model: Quadrotor, flights: Sequence[Flight], lead: float = 0.0) -> list[tuple[np.ndarray, tuple]]:
    """`remembered` of several flights, walked along side by side."""
    return in_groups(partial(_remembered, rotors_alone(model), jnp.asarray(lead)), flights)


def rotors_alone(model: Quadrotor) -> Quadrotor:
    """The model however its body is integrated, for which one program serves all: rotors do not depend on that."""
    return Quadrotor(model.parameters, model.effects, model.body, dt=model.dt, substeps=model.substeps)


@eqx.filter_jit
def _remembered(model: Quadrotor, lead: Array, flights: Flight):
    return jax.vmap(lambda flight: remembered(model, flight, lead))(flights)


def _scan(model: Quadrotor, flight: Flight, driven, lead):
    center = Vec.unstack(model.changed_parameters().center_of_gravity)
    command = flight.command + lead * (next_row(flight.command) - flight.command)
    middle = State(
        between(flight.position),
        between(flight.velocity),
        between(flight.quaternion),
        between(flight.body_rate),
        driven,
    )
    first = jax.tree.map(lambda x: x[0], middle)
    steady = prepare(model)
    speed = rotors.steady_speed(steady.rotors, Vec.unstack(flight.command[0]))
    start = begin(model, State(first.position, first.velocity, first.quaternion, first.body_rate, speed.stack()))
    carry = speed, unstack(start, center).memory
    inputs = (
        middle,
        Vec.unstack(command),
        flight.interval,
        Vec.unstack(driven),
        Vec.unstack(next_row(driven)),
        flight.voltage,
        flight.time,
        Vec.unstack(between(flight.specific_force)),
    )

    def row(carry, inputs):
        speed, memory = carry
        at, command, dt, here, there, voltage, time, felt = inputs
        reading = Reading(voltage, time)
        memory = tuple(effect.sense(m, reading) for effect, m in zip(model.effects, memory, strict=True))
        prepared = prepare(model, dt)
        path, moved = commanded_path(prepared, speed, memory, command)
        straight = rotors.path_between(prepared.rotors, here, there)
        # Where rotor speed was measured it drives the body; the commands still tell the rotors' own model.
        share = flight.measured
        body_speed = share * straight.middle + (1 - share) * path.middle
        rate = share * straight.rate_middle + (1 - share) * ((path.end - path.start) * prepared.rotors.inverse_dt)
        where = remembering(unstack(at, center), moved)
        seen = conditions(prepared, where, body_speed)
        wrench = loaded(model, prepared.parameters, rotors.loads_at(prepared.rotors, body_speed, rate), seen)
        angular, force = at_rotor_center(prepared.parameters, wrench, where.body_rate)
        up = Vec(0.0, 0.0, prepared.parameters.gravity)
        # What remembers accelerations (a slung load) followed the drone, not the model of it.
        missed = rotate(where.quaternion, felt - force)
        moved = followed(prepared, seen, rotate(where.quaternion, felt) - up, missed)
        return (path.end, moved), (
            Replay(speed.stack(), angular.stack(), force.stack()),
            jax.tree.map(lambda v: v.stack(), memory, is_leaf=lambda x: isinstance(x, Vec)),
        )

    return jax.lax.scan(row, carry, inputs)[1]


def smoothed_rotor_speed(flight: Flight, modelled: Array, width: float = 0.012) -> Array:
    """Measured rotor speeds with the reading noise taken out: the model's, plus its error smoothed over ``width`` s.

    Errors in a regressor pull what multiplies it towards zero, most of all the rotors' acceleration.
    """
    error = np.asarray(flight.rotor_speed) - np.asarray(modelled)
    step = float(np.median(np.asarray(flight.interval)[np.asarray(flight.interval) > 0]))
    reach = max(1, int(np.ceil(3 * width / step)))
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) * step / width) ** 2)
    weight = np.ones(len(error))
    norm = np.convolve(weight, kernel, mode="same")
    smooth = np.stack([np.convolve(error[:, i], kernel, mode="same") / norm for i in range(4)], axis=1)
    return np.asarray(modelled) + smooth
