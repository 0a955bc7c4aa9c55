"""Everything a search needs of a flight: inner products of whitened residuals and their derivatives, block by block."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from cfb_mjx.model.quadrotor import Quadrotor
from cfb_mjx.sysid.flight import Flight
from cfb_mjx.sysid.replay import remembered, smoothed_rotor_speed
from cfb_mjx.sysid.tracing.whitening import (
    DOMAINS,
    Blocks,
    Levels,
    Signals,
    cut,
    domain_of_channel,
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
def gram(
    models: Quadrotor, flight: Flight, driven: Array, leads: Array, shifts: Array, steps: Array, levels: Levels
) -> tuple[Float[Array, "b d c c"], Float[Array, "b d"]]:
    """Inner products of the whitened residual and its derivatives, per block and domain; and how many rows count.

    Args:
        models: leaves of the effects with a leading axis (c): the model as it is, then moved by each step.
        flight: one flight.
        driven: `driven_by`.
        leads: (c,) command lead of each.
        shifts: (c,) s by which the motor columns of each are taken to be late.
        steps: (c - 1,) size of the moves, in the units of the columns.
        levels: noise levels.

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

    signals = Signals(*(side_by_side(getattr(seen, k), getattr(said, k)) for k in ("quantity", "acceleration")))
    e, _, use = innovations(cut(flight, signals), levels)
    kind = domain_of_channel()
    products, counts = [], []
    for index in range(len(DOMAINS)):
        part = e[:, :, np.flatnonzero(kind == index)]
        products.append(jnp.einsum("brkc,brkd->bcd", part, part))
        counts.append(jnp.sum(use[:, :, np.flatnonzero(kind == index)], axis=(1, 2)))
    return jnp.stack(products, axis=1), jnp.stack(counts, axis=1)
