"""Everything a search needs of a flight: inner products of whitened residuals and their derivatives, block by block."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from cfb_mjx.model.effects import Condition, Wrench
from cfb_mjx.model.effects.formula import body_signals, place_signals
from cfb_mjx.model.quadrotor import Quadrotor, at_rotor_center, in_still_air, prepare
from cfb_mjx.model.state import State, unstack
from cfb_mjx.model.vector import Vec, rotate_inverse
from cfb_mjx.parameters import Parameters
from cfb_mjx.sysid.flight import Flight
from cfb_mjx.sysid.replay import between, remembered, smoothed_rotor_speed
from cfb_mjx.sysid.tracing.whitening import (
    Blocks,
    Levels,
    Signals,
    accumulated,
    cut,
    innovations,
    measured,
    predicted,
)


@eqx.filter_jit
def _remembered(model: Quadrotor, flight: Flight, lead):
    return remembered(model, flight, lead)[0]


def driven_by(model: Quadrotor, flight: Flight, lead: float) -> Array:
    """Rotor speeds that drive the body where they were measured (n, 4)."""
    modelled = _remembered(model, flight, jnp.asarray(lead))
    return jnp.asarray(smoothed_rotor_speed(flight, modelled)) if flight.measured else modelled


@eqx.filter_jit
def residual_blocks(model: Quadrotor, flight: Flight, driven: Array, lead: Array) -> Blocks:
    """What the model misses along a flight."""
    said = predicted(model, flight, driven, lead)
    return cut(flight, jax.tree.map(lambda a, b: a - b, measured(flight), said))


@eqx.filter_jit
def with_slopes(models: Quadrotor, flight: Flight, driven: Array, leads: Array, shifts: Array, steps: Array) -> Signals:
    """The residual of a flight and, side by side along the last axis (c), its derivatives.

    Args:
        models: leaves of the effects with a leading axis (c): the model as it is, then moved by each step.
        flight: one flight.
        driven: `driven_by`.
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
