"""Mapping files: they assign logged variables, with their units, to the columns of a `FlightLog`.

The shipped mapping is ``configs/logs/crazyflie.yaml``, which also explains the keys. Names, units and signs follow the
log groups of bitcraze/crazyflie-firmware.
"""

from __future__ import annotations

import dataclasses
import math
import os
from collections.abc import Collection
from pathlib import Path
from typing import Any

from cfb_mjx.documents import load_yaml, told
from cfb_mjx.errors import CfbError
from cfb_mjx.files import shipped
from cfb_mjx.logs.flight_log import OPTIONAL, REQUIRED

FORMAT = "cfb_mjx.variables/1"
DEFAULT = "crazyflie"
_DATA_SETS = ("nanobench",)
_RPM = 2.0 * math.pi / 60.0
# Factors to SI. The firmware scales its accelerometer so that rest reads 1 g; hence 1 g is the model's gravity.
UNITS: dict[str, dict[str, float]] = {
    "position": {"m": 1.0, "cm": 1e-2, "mm": 1e-3},
    "velocity": {"m/s": 1.0, "cm/s": 1e-2, "mm/s": 1e-3},
    "quaternion": {"1": 1.0, "deg": math.pi / 180.0, "rad": 1.0},
    "body_rate": {"rad/s": 1.0, "deg/s": math.pi / 180.0, "mrad/s": 1e-3},
    "specific_force": {"m/s^2": 1.0, "mm/s^2": 1e-3, "g": 9.81},
    "command": {"1": 1.0, "percent": 1e-2, "pwm16": 1.0 / 65535.0},
    "rotor_speed": {"rad/s": 1.0, "rpm": _RPM, "erpm": _RPM / 6.0},  # 12 poles: 6 electrical turns per turn
    "battery_voltage": {"V": 1.0, "mV": 1e-3},
}
FIELDS = tuple(f for f in (*REQUIRED, *OPTIONAL) if f != "time")
_WIDTH = {"quaternion": 4, "command": 4, "rotor_speed": 4, "battery_voltage": 1}
_FORM_WIDTH = {"components": 4, "compressed": 1, "euler": 3}
_FRAMES = {"velocity": "world", "specific_force": "body"}  # the fields whose frame can be chosen, and the default
DERIVED_FROM = {
    "velocity": "position",
    "body_rate": "quaternion",
    "specific_force": "velocity",
    "command": "rotor_speed",
}
"""Field to the field it can be computed from if it was not logged."""
_CHOICE_KEYS = {"variables", "unit", "sign", "frame", "form", "invalid"}
_CAPTURED = ("position", "quaternion")
_FIRMWARE_KEYS = ("version", "battery_compensation", "thrust_limit")


class MissingNames(CfbError):
    """Required columns or variables are missing from a log, or have other names in it."""


@dataclasses.dataclass(frozen=True)
class Choice:
    """One way to fill a field.

    Attributes:
        variables: logged names in the order of the field's columns; empty if the field is derived.
        unit: unit of the logged numbers, a key of `UNITS` of the field.
        factors: factors to SI including the sign, one per variable.
        frame: ``world`` or ``body``, for velocity and specific force.
        form: ``components``, ``compressed`` or ``euler``, for a quaternion.
        invalid: logged numbers that mean "no measurement".
        derived: the field it is computed from, a value of `DERIVED_FROM`; empty if it was logged.
    """

    variables: tuple[str, ...]
    unit: str = ""
    factors: tuple[float, ...] = ()
    frame: str = ""
    form: str = ""
    invalid: tuple[float, ...] = ()
    derived: str = ""

    def report(self) -> dict:
        """The choice as JSON-compatible values."""
        if self.derived:
            return {"derived": self.derived}
        extra = {k: getattr(self, k) for k in ("frame", "form") if getattr(self, k)}
        signs = [1 if f > 0 else -1 for f in self.factors]
        return {"variables": list(self.variables), "unit": self.unit, **extra} | (
            {"sign": signs} if -1 in signs else {}
        )


@dataclasses.dataclass(frozen=True)
class VariableMap:
    """Content of a mapping file.

    Attributes:
        name: of the mapping.
        choices: field to its choices, in order of preference.
        firmware: what the user states about the firmware; None for an unknown entry.
        observation_delay: lag of pose and velocity behind their row's time, s; None if unknown.
        recognised_by: columns that identify a table of this data set; empty for a user's mapping.
        motion_capture: position and attitude by motion capture, in order of preference.
        by_motion_capture: whether pose and velocity are taken from motion capture.
    """

    name: str
    choices: dict[str, tuple[Choice, ...]]
    firmware: dict[str, Any]
    observation_delay: float | None
    recognised_by: tuple[str, ...] = ()
    motion_capture: tuple[tuple[Choice, Choice], ...] = ()
    by_motion_capture: bool = False

    def choose(self, available: Collection[str], path: Path) -> dict[str, Choice]:
        """For each field the first choice whose variables are all available; optional fields may be absent.

        Raises:
            CfbError: a required field has no such choice. The message lists the missing and the found variables.
        """
        found = {}
        # Last, because it can be derived from rotor speeds, which come after it in FIELDS.
        for field in sorted(FIELDS, key=lambda f: (f == "command", FIELDS.index(f))):
            for choice in self.choices.get(field, ()):
                usable = choice.derived in found if choice.derived else all(v in available for v in choice.variables)
                if usable:
                    found[field] = choice
                    break
        missing = [f for f in FIELDS if f in REQUIRED and f not in found]
        if missing:
            wanted = "; ".join(f"{f} ({self._wanted(f, available)})" for f in missing)
            listed = ", ".join(sorted(available)) or "none"
            raise MissingNames(
                f"{path}: no logged variables for {wanted}. Found: {listed}. Log the missing ones too, or give their "
                "names and units with --mapping FILE, a changed copy of configs/logs/crazyflie.yaml (see "
                "docs/logs.md)."
            )
        return found

    def logged_parts(self, field: str, available: Collection[str]) -> list[str]:
        """Variables of a field that were logged, although no choice is complete."""
        return sorted({v for c in self.choices.get(field, ()) for v in c.variables if v in available})

    def _wanted(self, field: str, available: Collection[str]) -> str:
        options = [c for c in self.choices.get(field, ()) if not c.derived]
        if not options:
            return "the mapping names none"
        # The user most likely meant the choice that lacks the fewest variables.
        best = min(options, key=lambda c: sum(v not in available for v in c.variables) / len(c.variables))
        return "missing " + " ".join(v for v in best.variables if v not in available)


def load_mapping(source: str | os.PathLike | None = None) -> VariableMap:
    """Read a mapping file.

    Args:
        source: path of the file; None reads the shipped mapping for a Crazyflie.

    Raises:
        CfbError: missing file, invalid YAML, unknown keys, fields or units, wrong number of variables.
    """
    path = shipped("configs", "logs", f"{DEFAULT}.yaml") if source is None else Path(source)
    document = load_yaml(path)
    known = {"format", "name", "fields", "firmware", "observation_delay", "recognised_by", "motion_capture"}
    _only(document, known, path, "the file")
    if document.get("format") != FORMAT:
        raise CfbError(f"{path}: 'format' must be '{FORMAT}', found {document.get('format')!r}.")
    fields = document.get("fields")
    if not isinstance(fields, dict):
        raise CfbError(f"{path}: 'fields' must map field names to lists of choices.")
    _only(fields, set(FIELDS), path, "fields")
    choices = {}
    for field, listed in fields.items():
        if not isinstance(listed, list) or not all(isinstance(c, dict) for c in listed):
            raise CfbError(f"{path}: fields.{field} must be a list of choices, each a mapping with 'variables'.")
        choices[field] = tuple(_choice(field, c, path) for c in listed)
    firmware = document.get("firmware") or {}
    if not isinstance(firmware, dict):
        raise CfbError(f"{path}: 'firmware' must be a mapping of {', '.join(_FIRMWARE_KEYS)}.")
    _only(firmware, set(_FIRMWARE_KEYS), path, "firmware")
    delay = document.get("observation_delay")
    if delay is not None and not (_is_number(delay) and 0.0 <= delay < 1.0):
        raise CfbError(f"{path}: 'observation_delay' must be in seconds, from 0 to 1, or null; found {told(delay)}.")
    marks = document.get("recognised_by", [])
    if not isinstance(marks, list) or not all(isinstance(m, str) for m in marks):
        raise CfbError(f"{path}: 'recognised_by' must be a list of columns; found {told(marks)}.")
    captures = document.get("motion_capture", [])
    if not isinstance(captures, list) or not all(isinstance(c, dict) and set(c) == set(_CAPTURED) for c in captures):
        raise CfbError(f"{path}: 'motion_capture' must be a list of choices, each with position and quaternion.")
    return VariableMap(
        name=str(document.get("name", path.stem)),
        choices=choices,
        firmware={k: firmware.get(k) for k in _FIRMWARE_KEYS},
        observation_delay=None if delay is None else float(delay),
        recognised_by=tuple(marks),
        motion_capture=tuple(_captured(c, path) for c in captures),
    )


def mapping_of(columns: Collection[str]) -> VariableMap | None:
    """The shipped mapping of the data set with these columns; None for any other table."""
    for name in _DATA_SETS:
        mapping = load_mapping(shipped("configs", "logs", f"{name}.yaml"))
        if set(mapping.recognised_by) <= set(columns):
            return mapping
    return None


def _choice(field: str, raw: dict, path: Path) -> Choice:
    where = f"fields.{field}"
    if "derived" in raw:
        if raw != {"derived": DERIVED_FROM.get(field)}:
            possible = ", ".join(f"derived: {source} for {what}" for what, source in DERIVED_FROM.items())
            raise CfbError(f"{path}: {where}: 'derived' must be the only key, and must be one of {possible}.")
        return Choice((), derived=raw["derived"])
    _only(raw, _CHOICE_KEYS, path, where)
    form = raw.get("form", "components") if field == "quaternion" else ""
    if (field != "quaternion" and "form" in raw) or form not in ("", *_FORM_WIDTH):
        raise CfbError(f"{path}: {where}: 'form' is for quaternions and one of {', '.join(_FORM_WIDTH)}.")
    frame = raw.get("frame", _FRAMES.get(field, ""))
    if frame not in (("world", "body") if field in _FRAMES else ("",)):
        raise CfbError(
            f"{path}: {where}: 'frame' is for velocity and specific_force, world or body; found {told(frame)}."
        )
    names, width = raw.get("variables"), _FORM_WIDTH.get(form) or _WIDTH.get(field, 3)
    if not isinstance(names, list) or len(names) != width or not all(isinstance(v, str) for v in names):
        raise CfbError(f"{path}: {where}: 'variables' must list {width} name{'s' * (width > 1)}; found {told(names)}.")
    unit = str(raw.get("unit", "1" if "1" in UNITS[field] else ""))
    if unit not in UNITS[field] or (field == "quaternion" and (unit == "1") == (form == "euler")):
        raise CfbError(f"{path}: {where}: unit {unit!r} is not one of {', '.join(UNITS[field])} or does not fit.")
    if form == "compressed" and "sign" in raw:
        raise CfbError(f"{path}: {where}: a compressed quaternion has no 'sign'; leave it out.")
    sign, invalid = raw.get("sign", [1] * width), raw.get("invalid", [])
    if not isinstance(sign, list) or len(sign) != width or any(isinstance(s, bool) or s not in (1, -1) for s in sign):
        raise CfbError(f"{path}: {where}: 'sign' must list {width} times 1 or -1; found {told(sign)}.")
    if not isinstance(invalid, list) or not all(_is_number(v) for v in invalid):
        raise CfbError(f"{path}: {where}: 'invalid' must be a list of numbers; found {told(invalid)}.")
    factors = tuple(s * UNITS[field][unit] for s in sign)
    return Choice(tuple(names), unit, factors, frame, form, tuple(float(v) for v in invalid))


def _captured(raw: dict, path: Path) -> tuple[Choice, Choice]:
    position, quaternion = (_choice(f, _mapping(raw[f], f, path), path) for f in _CAPTURED)
    return position, quaternion


def _mapping(value: Any, field: str, path: Path) -> dict:
    if not isinstance(value, dict) or "derived" in value:
        raise CfbError(f"{path}: motion_capture.{field} must be a mapping with 'variables'; found {told(value)}.")
    return value


def _only(mapping: dict, allowed: set[str], path: Path, where: str) -> None:
    if unknown := [str(k) for k in mapping if k not in allowed]:
        raise CfbError(f"{path}: {where} has unknown key {unknown[0]!r}; allowed are {', '.join(sorted(allowed))}.")


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
