"""Build dataclasses from mappings with strict keys and types; errors name the key."""

from __future__ import annotations

import dataclasses
import sys
import types
import typing
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, TypeVar

from cfb_mjx.documents import LARGEST_INT, told
from cfb_mjx.errors import CfbError

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

T = TypeVar("T", bound="DataclassInstance")


def build(kind: type[T], raw: Mapping[str, Any], where: str, prefix: str = "") -> T:
    """Build a dataclass, with nested ones, from a mapping; missing keys have their defaults.

    Args:
        kind: class to build.
        raw: the mapping.
        where: name of the file, for messages.
        prefix: dotted path of ``raw`` within the file, for messages.

    Raises:
        CfbError: a key is unknown, or a value has the wrong type; the message gives ``where`` and the dotted path.
    """
    if not isinstance(raw, Mapping):
        raise CfbError(f"{where}: {prefix.rstrip('.') or 'the file'} must be a mapping, found {told(raw)}.")
    fields = {field.name: field for field in dataclasses.fields(kind)}
    unknown = [f"'{prefix}{key}'" for key in raw if key not in fields]
    if unknown:
        raise CfbError(f"{where}: unknown key {', '.join(unknown)}; known here are {', '.join(fields)}.")
    hints = typing.get_type_hints(kind)
    return kind(**{key: _value(hints[key], value, where, f"{prefix}{key}") for key, value in raw.items()})


def plain(value: Any) -> Any:
    """Return the mapping that `build` would read back."""
    if dataclasses.is_dataclass(value):
        return {field.name: plain(getattr(value, field.name)) for field in dataclasses.fields(value)}
    return [plain(x) for x in value] if isinstance(value, tuple) else value


def _value(kind: Any, raw: Any, where: str, key: str) -> Any:
    if isinstance(kind, type) and dataclasses.is_dataclass(kind):
        return build(kind, raw, where, f"{key}.")
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin is typing.Literal:
        return _checked(raw in arguments, raw, f"one of {', '.join(map(str, arguments))}", where, key)
    if origin in (types.UnionType, typing.Union):
        if raw is None and type(None) in arguments:
            return None
        return _value(next(a for a in arguments if a is not type(None)), raw, where, key)
    if origin is tuple:
        _checked(isinstance(raw, list | tuple), raw, "a list", where, key)
        return tuple(_value(arguments[0], x, where, key) for x in raw)
    number = isinstance(raw, int | float) and not isinstance(raw, bool)
    if kind is float:
        # Compared, because math.isfinite overflows on a huge int.
        finite = number and abs(raw) <= sys.float_info.max
        return float(_checked(finite, raw, "a finite number", where, key))
    if kind is int:
        # 2e7 is a float in Python, but a count to the user.
        whole = number and (isinstance(raw, int) or raw.is_integer()) and abs(raw) <= LARGEST_INT
        return int(_checked(whole, raw, "a whole number of at most 64 bits", where, key))
    return _checked(isinstance(raw, kind), raw, {bool: "true or false", str: "text"}[kind], where, key)


def _checked(holds: bool, raw: Any, wanted: str, where: str, key: str) -> Any:
    if not holds:
        raise CfbError(f"{where}: {key} must be {wanted}, found {told(raw)}.")
    return raw
