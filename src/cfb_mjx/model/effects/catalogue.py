"""Every effect by name. Adding one is one module and one line here."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

from cfb_mjx.errors import CfbError
from cfb_mjx.model.effects.base import Effect
from cfb_mjx.model.effects.parasitic_drag import ParasiticDrag

CATALOGUE: dict[str, type[Effect]] = {effect.name: effect for effect in (ParasiticDrag,)}


def effect_from_mapping(item: Mapping[str, Any], where: str) -> Effect:
    """Build an effect from ``{name, parameters}`` as written in a model YAML; what is left out is neutral.

    Raises:
        CfbError: unknown effect, unknown parameter or a value that is not a number, named; ``where`` is the file.
    """
    name = item.get("name")
    if not isinstance(name, str) or name not in CATALOGUE:
        raise CfbError(f"{where}: unknown effect {name!r}; known are {', '.join(sorted(CATALOGUE))}.")
    kind = CATALOGUE[name]
    fields = {field.name for field in dataclasses.fields(kind)}
    values = item.get("parameters") or {}
    if not isinstance(values, Mapping):
        raise CfbError(f"{where}: effects.{name}.parameters must be a mapping, found {values!r}.")
    for key in item:
        if key not in ("name", "parameters", "source", "uncertainty", "p_value"):
            raise CfbError(f"{where}: unknown key 'effects.{name}.{key}'.")
    neutral = kind.neutral()
    arguments = {field: getattr(neutral, field) for field in fields}
    for key, raw in values.items():
        if key not in fields:
            raise CfbError(
                f"{where}: unknown key 'effects.{name}.parameters.{key}'; known are {', '.join(sorted(fields))}."
            )
        try:
            value = np.asarray(raw, dtype=np.float64)
        except (TypeError, ValueError):
            value = np.asarray(np.nan)
        shape = np.shape(arguments[key])
        if not np.all(np.isfinite(value)) or value.shape not in ((), shape):
            count = shape[0] if shape else 1
            raise CfbError(f"{where}: effects.{name}.parameters.{key} = {raw!r} must be {count} finite number(s).")
        arguments[key] = value
    return kind(**arguments)


def effect_to_mapping(effect: Effect) -> dict[str, Any]:
    """The inverse of `effect_from_mapping`."""
    values = {field.name: np.asarray(getattr(effect, field.name)).tolist() for field in dataclasses.fields(effect)}
    return {"name": effect.name, "parameters": values, "source": effect.source}
