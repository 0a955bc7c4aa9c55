"""Domain randomisation: ranges read from YAML, and parameter draws as a pure function of a PRNG key.

A model of a type of drone carries measured ranges itself: the ``spread`` of its numbers between drones.
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
from cfb_mjx.parameters.limits import concrete
from cfb_mjx.parameters.model_file import FORMAT as MODEL_FORMAT
from cfb_mjx.parameters.model_file import ModelFile, load_model_file, preset_names
from cfb_mjx.parameters.parameters import SPECIFICATIONS, Parameters, current_names

FORMAT = "cfb_mjx randomisation 1"
UNIFORM = math.sqrt(3)
"""Half-width of a uniform draw over its standard deviation."""


@dataclass(frozen=True)
class Range:
    """Half-width of a uniform draw about the nominal value.

    ``relative`` widths are fractions of the nominal value; others carry the parameter's unit. ``shared`` draws one
    number for all motors or axes of the parameter. ``unit`` is what a file says of an effect's field, whose effect is
    only known where there is a drone.
    """

    half_width: tuple[float, ...]
    relative: bool
    shared: bool
    unit: str = ""

    @property
    def width(self) -> np.ndarray:
        """The half-width: a number, or one of each component."""
        widths = self.half_width
        return np.asarray(widths[0] if len(widths) == 1 else widths)

    def reach(self, center: np.ndarray | np.generic) -> np.ndarray:
        """How far from ``center`` a draw at magnitude 1 can lie."""
        return np.broadcast_to(np.abs(center) * self.width if self.relative else self.width, center.shape)


def largest_magnitude(room: np.ndarray | np.floating, reach: np.ndarray | np.floating) -> float:
    """Up to which no draw that reaches so far leaves the room there is."""
    return float(np.min(np.where(reach > 0, room / np.where(reach > 0, reach, 1.0), np.inf)))


@dataclass(frozen=True)
class Randomisation:
    """What varies, and how far at magnitude 1. Hashable, so it can be closed over under ``jit``.

    Attributes:
        name: for messages.
        ranges: of parameters, by name.
        effects: of effects: effect, field, range. Drawn by `cfb_mjx.model.sample_drone`.
    """

    name: str
    ranges: tuple[tuple[str, Range], ...]
    effects: tuple[tuple[str, str, Range], ...] = ()


def load_randomisation(name_or_path: str | Path = "paper") -> Randomisation:
    """Read a shipped randomisation (``paper``, ``identification``), a YAML file, or a model with spreads.

    Raises:
        CfbError: no such file, unknown keys or impossible widths, named; a model whose numbers have no ``spread``.
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
    """Uniform draws as far from the type's value as has the measured spread for standard deviation."""
    ranges, effects = [], []
    for key, entry in model.entries.items():
        if entry.spread is not None:
            relative = _only_relative(key)
            if relative and np.any(entry.value == 0):
                raise CfbError(f"model {model.name}: parameters.{key} is 0 and has a spread, which would allow less.")
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
    """Whether a width in the parameter's unit would allow the wrong sign."""
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
    """The half-widths of a range, whose keys are the usual ones and ``more``."""
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
    """Draw one drone. ``vmap`` over ``key`` for many; the same key gives the same drone.

    Args:
        key: PRNG key.
        nominal: parameters about which to draw (without batch axes).
        randomisation: ranges; the paper's (section V) by default.
        magnitude: factor on every range; 0 returns the nominal drone. May be traced.

    Raises:
        CfbError: ranges whose draws could lie beyond what can be (`require_possible`), or that vary effects.

    Where ``nominal`` or ``magnitude`` is traced, nothing can be refused: there a number drawn beyond what can be is
    NaN, and so is every state of that drone. A drawn inertia that no rigid body can have (the paper's independent
    +-20 % allows some) has its largest moment reduced to the sum of the other two.
    """
    randomisation = load_randomisation() if randomisation is None else randomisation
    if randomisation.effects:
        raise CfbError(
            f"randomisation '{randomisation.name}' varies effects, which are no parameters; draw with sample_drone."
        )
    require_possible(nominal, randomisation, magnitude)
    drawn = {}
    for name, spread in randomisation.ranges:
        value = getattr(nominal, name)
        shape = () if spread.shared else value.shape
        # fold_in by position in the specification table: adding a range never changes the draws of the others.
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
    """Refuse ranges whose draws could lie beyond what can be (`SPECIFICATIONS`). Nothing is said of what is traced.

    Args:
        nominal: parameters about which to draw; batch axes may come first.
        randomisation: ranges.
        magnitude: factor on every range.
        what: the magnitude is called, for messages.

    Raises:
        CfbError: one parameter that could be drawn beyond its limits, and the largest magnitude that fits all.
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
    """Up to which no draw leaves what can be; below zero where the nominal value does."""
    limits = SPECIFICATIONS[name].limits
    reach = spread.reach(center)
    room = np.minimum(limits.hard_high - center, center - limits.hard_low)
    rooms, reaches = [room], [reach]
    if name in _SUMS:
        rooms, reaches = [room, center.sum(-1)], [reach, reach.sum(-1)]
    return min(map(largest_magnitude, rooms, reaches))


_SUMS = ("thrust_polynomial", "torque_polynomial")
"""Their coefficients must have a positive sum."""


def _possible(name: str, value: Array) -> Array:
    """The value, and NaN where it cannot be."""
    specification = SPECIFICATIONS[name]
    holds = specification.limits.holds(value)
    if name in _SUMS:
        holds = holds & not_none(specification.together)(value)[..., None]
    return jnp.where(holds, value, jnp.nan)


def _physical(inertia: Float[Array, "3"]) -> Float[Array, "3"]:
    others = jnp.sum(inertia) - inertia
    return jnp.minimum(inertia, others)
