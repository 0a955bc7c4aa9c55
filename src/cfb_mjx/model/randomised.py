"""Random drones: parameters and effects drawn from ranges.

For example ``vmap(lambda key: sample_drone(key, Quadrotor.from_file("cfb-fleet"), load_randomisation("cfb-fleet")))``
draws drones that differ as much as measured ones do.
"""

from __future__ import annotations

from dataclasses import replace
from zlib import crc32

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from cfb_mjx.errors import CfbError
from cfb_mjx.model.effects import Effect
from cfb_mjx.model.quadrotor import Quadrotor
from cfb_mjx.parameters import Randomisation, sample_parameters
from cfb_mjx.parameters import require_possible as require_possible_parameters
from cfb_mjx.parameters.parameters import concrete
from cfb_mjx.parameters.randomisation import Range, largest_magnitude


def sample_drone(
    key: PRNGKeyArray,
    nominal: Quadrotor,
    randomisation: Randomisation,
    magnitude: float | Float[Array, ""] = 1.0,
) -> Quadrotor:
    """Draw a random drone. Use ``vmap`` over ``key`` for many; the same key gives the same drone.

    If ``nominal`` or ``magnitude`` is traced, impossible draws cannot be refused and become NaN, as in
    `sample_parameters`.

    Args:
        key: PRNG key.
        nominal: centre of the ranges (without batch axes).
        randomisation: ranges of parameters and effects.
        magnitude: factor on every range; 0 returns the nominal drone. May be traced.

    Returns:
        The drawn drone.

    Raises:
        CfbError: a range of an effect that the drone does not have, or ranges that allow impossible values
            (`require_possible`).
    """
    require_possible(nominal, randomisation, magnitude)
    parameters = sample_parameters(key, nominal.parameters, replace(randomisation, effects=()), magnitude)
    drone = eqx.tree_at(lambda m: m.parameters, nominal, parameters)
    for effect, field, spread in randomisation.effects:
        at, own = _found(nominal, effect, field, spread, randomisation)
        value = jnp.asarray(getattr(own, field))
        # Keyed by name: adding a range never changes the draws of the others.
        of_field = jax.random.fold_in(key, crc32(f"{effect}.{field}".encode()))
        unit = jax.random.uniform(of_field, value.shape, value.dtype, -1.0, 1.0)
        reach = spread.width.astype(value.dtype) * (value if spread.relative else 1.0)
        drawn = value + magnitude * reach * unit
        if field in own.limits:
            drawn = jnp.where(own.limits[field].holds(drawn), drawn, jnp.nan)
        drone = eqx.tree_at(lambda m, i=at, f=field: getattr(m.effects[i], f), drone, drawn)
    return drone


def require_possible(
    nominal: Quadrotor,
    randomisation: Randomisation,
    magnitude: float | Float[Array, ""] = 1.0,
    what: str = "magnitude",
) -> None:
    """Refuse ranges that allow impossible values. Traced values are not checked.

    Args:
        nominal: centre of the ranges.
        randomisation: ranges.
        magnitude: factor on every range.
        what: name of the magnitude in messages.

    Raises:
        CfbError: an effect that the drone does not have, or a range that exceeds the limits of its field. The message
            gives the largest magnitude that fits.
    """
    require_possible_parameters(nominal.parameters, randomisation, magnitude, what)
    asked = concrete(magnitude)
    for effect, field, spread in randomisation.effects:
        _, own = _found(nominal, effect, field, spread, randomisation)
        center, limits = concrete(getattr(own, field)), own.limits.get(field)
        if asked is None or center is None or limits is None:
            continue
        room = np.minimum(limits.hard_high - center, center - limits.hard_low)
        fitting = largest_magnitude(room, spread.reach(center))
        if np.max(np.abs(asked)) > fitting:
            raise CfbError(
                f"{what} = {np.max(np.abs(asked)):g}: randomisation '{randomisation.name}' could then draw a "
                f"{effect}.{field} outside {limits.hard_low:g} to {limits.hard_high:g} {own.units[field]}; at most "
                f"{max(np.floor(1e3 * fitting) / 1e3, 0.0):g} fits this drone."
            )


def differences(nominal: Quadrotor, drone: Quadrotor, randomisation: Randomisation) -> Float[Array, " n"]:
    """Differences between a drawn drone and the nominal one, divided by the half-widths of the ranges.

    Args:
        nominal: centre of the ranges.
        drone: drone drawn by `sample_drone`.
        randomisation: ranges of the draw.
    """
    found = [jnp.zeros(0)]
    for name, spread in randomisation.ranges:
        mean, drawn = getattr(nominal.parameters, name), getattr(drone.parameters, name)
        change = (drawn - mean) / (spread.width.astype(mean.dtype) * (mean if spread.relative else 1.0))
        found.append(jnp.atleast_1d(change[0] if spread.shared and change.ndim else change))
    for effect, field, spread in randomisation.effects:
        at, _ = _found(nominal, effect, field, spread, randomisation)
        mean, drawn = (getattr(model.effects[at], field) for model in (nominal, drone))
        width = spread.width.astype(mean.dtype) * (mean if spread.relative else 1.0)
        found.append(jnp.atleast_1d((drawn - mean) / jnp.where(width != 0, width, 1.0)))
    return jnp.concatenate(found)


def _found(
    nominal: Quadrotor, effect: str, field: str, spread: Range, randomisation: Randomisation
) -> tuple[int, Effect]:
    """Index and effect of the drone that a range belongs to; refuses a range that does not fit."""
    name = f"randomisation '{randomisation.name}'"
    for i, own in enumerate(nominal.effects):
        if type(own).name != effect:
            continue
        if field not in own.units:
            raise CfbError(f"{name}: {effect} has no field {field}; it has {', '.join(own.units)}.")
        if spread.unit not in ("", "relative", own.units[field]):
            raise CfbError(
                f"{name}: {effect}.{field}.unit must be 'relative' or '{own.units[field]}', found '{spread.unit}'."
            )
        size = getattr(type(own).neutral(), field).shape
        if len(spread.half_width) not in (1, *size):
            raise CfbError(
                f"{name}: {effect}.{field}.half_width must have {' or '.join(map(str, {1, *size}))} numbers."
            )
        return i, own
    raise CfbError(
        f"{name} varies {effect}, which this drone does not have; add it to the model's effects (it may be neutral), "
        "or take a model that has it."
    )
