"""Files of flips: the number of rotations, and the knobs that produce it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from cfb_mjx.control.manoeuvre import Knobs
from cfb_mjx.documents import load_named, parse_yaml, refuse_unknown, shipped_names, told
from cfb_mjx.errors import CfbError
from cfb_mjx.files import write_text

FORMAT = "cfb_mjx manoeuvre 1"
_FOLDER = "manoeuvres"
_OPTIONAL = tuple(Knobs._field_defaults)
_NOT_NEGATIVE = ("climb_s", "turn_s")


@dataclass(frozen=True)
class ManoeuvreFile:
    """Contents of a manoeuvre YAML. Optional knobs that are missing have no effect."""

    rotations: int
    knobs: Knobs
    description: str = ""
    holder: str = "target"
    """Name or file of the target policy that climbs and catches, with which the knobs were found."""


def shipped_manoeuvres() -> list[str]:
    """Names of the manoeuvres shipped with the library."""
    return shipped_names(_FOLDER)


def load_manoeuvre(name_or_path: str | Path, changes: tuple[str, ...] = ()) -> ManoeuvreFile:
    """Read a shipped manoeuvre (``double-flip``) or a YAML file.

    Args:
        name_or_path: name or file.
        changes: changes of knobs, each ``KNOB=VALUE``.

    Raises:
        CfbError: there is no such file, a knob is unknown or missing, or a value is invalid; the message names it.
    """
    path, document = load_named(name_or_path, "manoeuvre", FORMAT, _FOLDER)
    refuse_unknown(document, {"format", "description", "rotations", "holder", "knobs"}, path, "")
    rotations, raw = document.get("rotations"), document.get("knobs")
    if not isinstance(rotations, int) or isinstance(rotations, bool) or rotations < 1:
        raise CfbError(f"{path}: rotations must be a whole number from 1, found {told(rotations)}.")
    if not isinstance(raw, dict):
        raise CfbError(f"{path}: knobs must be a mapping, found {told(raw)}.")
    refuse_unknown(raw, set(Knobs._fields), path, "knobs.")
    holder = document.get("holder", ManoeuvreFile.holder)
    if not isinstance(holder, str):
        raise CfbError(f"{path}: holder must be a policy's name or file, found {told(holder)}.")
    knobs = dict(raw)
    for change in changes:
        name, equals, text = change.partition("=")
        if not equals or name not in Knobs._fields:
            raise CfbError(f"--set {change}: write KNOB=VALUE, with one of {', '.join(Knobs._fields)}.")
        knobs[name] = parse_yaml(text, f"--set {change}")
    missing = [name for name in Knobs._fields if name not in knobs and name not in _OPTIONAL]
    if missing:
        raise CfbError(f"{path}: knobs.{missing[0]} is missing.")
    return ManoeuvreFile(
        rotations,
        Knobs(**{name: _number(value, name, path) for name, value in knobs.items()}),
        str(document.get("description", "")).strip(),
        holder,
    )


def save_manoeuvre(manoeuvre: ManoeuvreFile, path: str | Path) -> None:
    """Write a manoeuvre YAML, atomically.

    Raises:
        CfbError: the file cannot be written.
    """
    # Four digits: a tenth of a millimetre, a tenth of a millisecond.
    knobs = {name: round(float(x), 4) for name, x in manoeuvre.knobs._asdict().items() if math.isfinite(x)}
    document: dict[str, Any] = {"format": FORMAT, "description": manoeuvre.description}
    document |= {"rotations": manoeuvre.rotations, "holder": manoeuvre.holder, "knobs": knobs}
    write_text(path, yaml.safe_dump(document, sort_keys=False, width=120))


def _number(value: Any, name: str, path: Path) -> float:
    if not isinstance(value, int | float) or isinstance(value, bool) or math.isnan(value):
        raise CfbError(f"{path}: knobs.{name} must be a number, found {told(value)}.")
    if math.isinf(value) and name not in _OPTIONAL:
        raise CfbError(f"{path}: knobs.{name} must be finite.")
    if name in _NOT_NEGATIVE and value < 0:
        raise CfbError(f"{path}: knobs.{name} = {value} must not be negative.")
    return float(value)
