"""Domain randomisation: ranges read from YAML, and parameter draws as a pure function of a PRNG key.

A model of a type of drone contains measured ranges itself: the ``spread`` of its parameters between drones.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from cfb_mjx.documents import load_named, load_yaml, refuse_unknown, told
from cfb_mjx.errors import CfbError
from cfb_mjx.optional import not_none
from cfb_mjx.parameters.model_file import FORMAT as MODEL_FORMAT
from cfb_mjx.parameters.model_file import ModelFile, load_model_file, preset_names
from cfb_mjx.parameters.parameters import SPECIFICATIONS, Parameters, concrete, current_names

FORMAT = "cfb_mjx randomisation 1"
UNIFORM = math.sqrt(3)
"""Ratio of the half-width of a uniform distribution to its standard deviation."""


@dataclass(frozen=True)
class Range:
    """Half-width of a uniform distribution about the nominal value.

    ``relative`` widths are fractions of the nominal value; others are in the parameter's unit. ``shared`` draws one
    number for all motors or axes of the parameter. ``unit`` is the unit that a file gives for a field of an effect; it
    is checked when the drone, and with it the effect, is known.
    """

    half_width: tuple[float, ...]
    relative: bool
    shared: bool
    unit: str = ""

    @property
    def width(self) -> np.ndarray:
        """The half-width: one number, or one per component."""
        widths = self.half_width
        return np.asarray(widths[0] if len(widths) == 1 else widths)

    def reach(self, center: np.ndarray | np.generic) -> np.ndarray:
        """Largest distance from ``center`` of a draw at magnitude 1."""
        return np.broadcast_to(np.abs(center) * self.width if self.relative else self.width, center.shape)


def largest_magnitude(room: np.ndarray | np.floating, reach: np.ndarray | np.floating) -> float:
    """Largest magnitude at which draws with this reach stay within the room."""
    return float(np.min(np.where(reach > 0, room / np.where(reach > 0, reach, 1.0), np.inf)))


@dataclass(frozen=True)
class Randomisation:
    """Ranges at magnitude 1. Hashable, so that functions may close over it under ``jit``.

    Attributes:
        name: name for messages.
        ranges: ranges of parameters: name, range.
        effects: ranges of effects: effect, field, range. Drawn by `cfb_mjx.model.sample_drone`.
    """

    name: str
    ranges: tuple[tuple[str, Range], ...]
    effects: tuple[tuple[str, str, Range], ...] = ()


def load_randomisation(name_or_path: str | Path = "paper") -> Randomisation:
    """Read a shipped randomisation (``paper``, ``identification``), a YAML file, or a model with spreads.

    Args:
        name_or_path: name or file.

    Raises:
        CfbError: there is no such file, keys are unknown, widths are impossible, or a model has no ``spread``.
    """
    if _is_model(name_or_path):
        return _between_drones(load_model_file(name_or_path))
    path, document = load_named(name_or_path, "randomisation", FORMAT, "randomisation")
    refuse_unknown(document, {"format", "name", "description", "ranges", "effects"}, path, "")
    ranges, effects = document.get("ranges") or {}, document.get("effects") or {}
    if not isinstance(ranges, dict):
        raise CfbError(f"{path}: 'ranges' must be a mapping of parameter names.")
    if not (isinstance(effects, dict) and all(isinstance(fields, dict) for fields in effects.values())):
        raise CfbError(f"{path}: 'effects' must be a mapping of effects, each of its fields' ranges.")
    ranges = current_names(ranges, path, "ranges.")
    refuse_unknown(ranges, set(SPECIFICATIONS), path, "ranges.")
    return Randomisation(
        name=str(document.get("name", path.stem)),
        ranges=tuple((key, _range(key, raw, path)) for key, raw in ranges.items()),
        effects=tuple(
            (effect, field, _range_of_effect(f"effects.{effect}.{field}", raw, path))
            for effect, fields in effects.items()
            for field, raw in fields.items()
        ),
    )


def _is_model(name_or_path: str | Path) -> bool:
    if Path(name_or_path).suffix in (".yaml", ".yml"):
        return load_yaml(name_or_path).get("format") == MODEL_FORMAT
    return str(name_or_path) in preset_names()


def _between_drones(model: ModelFile) -> Randomisation:
    """Uniform distributions about a model's values with the measured spread as standard deviation."""
    ranges, effects = [], []
    for key, entry in model.entries.items():
        if entry.spread is not None:
            relative = _only_relative(key)
            if relative and np.any(entry.value == 0):
                raise CfbError(
                    f"model {model.name}: parameters.{key} is 0 and has a spread, which would allow negative values."
                )
            width = UNIFORM * (entry.spread / np.abs(entry.value) if relative else entry.spread)
            ranges.append((key, Range(tuple(width.ravel().tolist()), relative, False)))
    for item in model.effects:
        for key, spread in (item.get("spread") or {}).items():
            width = UNIFORM * np.atleast_1d(np.asarray(spread, dtype=np.float64))
            effects.append((item["name"], key, Range(tuple(width.tolist()), False, False)))
    if not ranges and not effects:
        raise CfbError(
            f"model {model.name}: no number has a spread between drones; take cfb-fleet, paper or a YAML file."
        )
    return Randomisation(model.name, tuple(ranges), tuple(effects))


def _only_relative(key: str) -> bool:
    """Whether a width in the parameter's unit would allow values of the wrong sign."""
    return SPECIFICATIONS[key].limits.hard_low >= 0 or bool(SPECIFICATIONS[key].together)


def _range(key: str, raw, path: Path) -> Range:
    specification, where = SPECIFICATIONS[key], f"ranges.{key}"
    widths = _widths(where, raw, path, "shared")
    if raw.get("unit") not in ("relative", specification.unit):
        raise CfbError(
            f"{path}: {where}.unit must be 'relative' or '{specification.unit}', found {told(raw.get('unit'))}."
        )
    size = specification.shape
    if len(widths) not in (1, *size):
        raise CfbError(f"{path}: {where}.half_width must have 1 or {size[0] if size else 1} numbers.")
    relative = raw["unit"] == "relative"
    if not relative and _only_relative(key):
        raise CfbError(
            f"{path}: {where}.unit must be 'relative': a width in {specification.unit} would allow the wrong sign."
        )
    if relative and max(widths) >= 1:
        raise CfbError(
            f"{path}: {where}.half_width = {told(raw['half_width'])} relative would allow values of the wrong sign."
        )
    shared = raw.get("shared", False)
    if not isinstance(shared, bool):
        raise CfbError(f"{path}: {where}.shared must be true or false, found {told(shared)}.")
    return Range(widths, relative, shared)


def _range_of_effect(where: str, raw, path: Path) -> Range:
    widths = _widths(where, raw, path)
    unit = raw.get("unit")
    if not isinstance(unit, str):
        raise CfbError(f"{path}: {where}.unit must be 'relative' or the field's unit, found {told(unit)}.")
    return Range(widths, unit == "relative", False, unit)


def _widths(where: str, raw, path: Path, *more: str) -> tuple[float, ...]:
    """Half-widths of a range; its keys are the usual ones and ``more``."""
    if not isinstance(raw, dict):
        raise CfbError(f"{path}: {where} must be a mapping with half_width and unit.")
    refuse_unknown(raw, {"half_width", "unit", "source", *more}, path, f"{where}.")
    width = raw.get("half_width")
    widths: list[Any] = width if isinstance(width, list) else [width]
    if not widths or not all(
        isinstance(w, int | float) and not isinstance(w, bool) and 0 <= w < float("inf") for w in widths
    ):
        raise CfbError(f"{path}: {where}.half_width = {told(width)} must be zero or positive.")
    return tuple(float(w) for w in widths)


def sample_parameters(
    key: PRNGKeyArray,
    nominal: Parameters,
    randomisation: Randomisation | None = None,
    magnitude: float | Float[Array, ""] = 1.0,
) -> Parameters:
    """Draw the parameters of a random drone. Use ``vmap`` over ``key`` for many; the same key gives the same drone.

    If ``nominal`` or ``magnitude`` is traced, nothing can be refused. Impossible draws are then NaN, and so are all
    states of that drone. A drawn inertia that is impossible for a rigid body (the paper's independent +-20 % allow
    some) has its largest moment reduced to the sum of the other two.

    Args:
        key: PRNG key.
        nominal: parameters about which to draw (without batch axes).
        randomisation: ranges; default: the paper's (section V).
        magnitude: factor on every range; 0 returns the nominal drone. May be traced.

    Returns:
        The drawn parameters.

    Raises:
        CfbError: the ranges allow impossible values (`require_possible`), or vary effects.
    """
    randomisation = load_randomisation() if randomisation is None else randomisation
    if randomisation.effects:
        raise CfbError(
            f"randomisation '{randomisation.name}' varies effects, which are not parameters; draw with sample_drone."
        )
    require_possible(nominal, randomisation, magnitude)
    drawn = {}
    for name, spread in randomisation.ranges:
        value = getattr(nominal, name)
        shape = () if spread.shared else value.shape
        # Keyed by position in the table of specifications: adding a range never changes the draws of the others.
        order = list(SPECIFICATIONS).index(name)
        unit = jax.random.uniform(jax.random.fold_in(key, order), shape, value.dtype, -1.0, 1.0)
        change = magnitude * spread.width.astype(value.dtype) * unit
        drawn[name] = value * (1 + change) if spread.relative else value + change
    if "inertia" in drawn:
        drawn["inertia"] = _physical(drawn["inertia"])
    drawn = {name: _possible(name, value) for name, value in drawn.items()}
    return eqx.tree_at(
        lambda p: [getattr(p, name) for name in drawn], nominal, [jnp.asarray(v) for v in drawn.values()]
    )


def require_possible(
    nominal: Parameters,
    randomisation: Randomisation,
    magnitude: float | Float[Array, ""] = 1.0,
    what: str = "magnitude",
) -> None:
    """Refuse ranges that allow impossible values (`SPECIFICATIONS`). Traced values are not checked.

    Args:
        nominal: parameters about which to draw; batch axes may come first.
        randomisation: ranges.
        magnitude: factor on every range.
        what: name of the magnitude in messages.

    Raises:
        CfbError: a parameter could be drawn outside its limits; the message gives the largest magnitude that fits.
    """
    asked = concrete(magnitude)
    if asked is None or not asked.any():
        return
    fitting = {}
    for name, spread in randomisation.ranges:
        center = concrete(getattr(nominal, name))
        if center is not None:
            fitting[name] = _largest_magnitude(name, center, spread)
    if not fitting or np.max(np.abs(asked)) <= min(fitting.values()):
        return
    name = min(fitting, key=fitting.__getitem__)
    specification, most = SPECIFICATIONS[name], max(math.floor(1e3 * fitting[name]) / 1e3, 0.0)
    limits = specification.limits
    span = specification.condition or f"lie between {limits.hard_low:g} and {limits.hard_high:g} {specification.unit}"
    raise CfbError(
        f"{what} = {np.max(np.abs(asked)):g}: randomisation '{randomisation.name}' could then draw a {name} that does"
        f" not {span}; at most {most:g} fits this drone."
    )


def _largest_magnitude(name: str, center: np.ndarray, spread: Range) -> float:
    """Largest magnitude at which all draws are possible; negative if the nominal value is not."""
    limits = SPECIFICATIONS[name].limits
    reach = spread.reach(center)
    room = np.minimum(limits.hard_high - center, center - limits.hard_low)
    rooms, reaches = [room], [reach]
    if name in _SUMS:
        rooms, reaches = [room, center.sum(-1)], [reach, reach.sum(-1)]
    return min(map(largest_magnitude, rooms, reaches))


_SUMS = ("thrust_polynomial", "torque_polynomial")
"""Polynomials whose coefficients must have a positive sum."""


def _possible(name: str, value: Array) -> Array:
    """The value, with NaN where it is impossible."""
    specification = SPECIFICATIONS[name]
    holds = specification.limits.holds(value)
    if name in _SUMS:
        holds = holds & not_none(specification.together)(value)[..., None]
    return jnp.where(holds, value, jnp.nan)


def _physical(inertia: Float[Array, "3"]) -> Float[Array, "3"]:
    others = jnp.sum(inertia) - inertia
    return jnp.minimum(inertia, others)
