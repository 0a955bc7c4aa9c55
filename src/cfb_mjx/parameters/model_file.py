"""Model files: YAML with the unit, the source and, where known, the uncertainty of every constant."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from cfb_mjx.documents import is_named, load_named, refuse_unknown, shipped_names
from cfb_mjx.errors import CfbError
from cfb_mjx.files import write_text
from cfb_mjx.parameters.parameters import DEFAULTS, SPECIFICATIONS, Parameters, current_names

FORMAT = "cfb_mjx model 1"
_TOP_LEVEL = {"format", "kind", "name", "description", "parameters", "effects", "provenance"}
_KINDS = ("plant", "predictor")
_ENTRY_KEYS = {"value", "unit", "std", "spread", "source"}
_SPREADS = ("std", "spread")


@dataclass(frozen=True)
class Entry:
    """One constant.

    Attributes:
        value: value in SI units.
        source: where the value comes from.
        std: standard deviation of the value; None if unknown.
        spread: standard deviation between the drones of a type; None if unknown.
    """

    value: np.ndarray
    source: str
    std: np.ndarray | None = None
    spread: np.ndarray | None = None


@dataclass(frozen=True)
class ModelFile:
    """Contents of a model YAML. ``effects`` are stored as read; `cfb_mjx.model.Quadrotor.from_file` builds them.

    ``kind`` is "plant", or "predictor" for a model that was fitted without physical limits on its numbers: it predicts
    flights similar to those it was fitted to, but does not respond to commands as the drone does.
    """

    name: str
    entries: Mapping[str, Entry]
    description: str = ""
    effects: tuple[Mapping[str, Any], ...] = ()
    provenance: Mapping[str, Any] = field(default_factory=dict)
    kind: str = "plant"
    path: str = field(default="", compare=False)
    """File or preset that it was read from, for messages."""

    def require_plant(self, purpose: str, how: str) -> None:
        """Refuse a predictor.

        Args:
            purpose: what the model is needed for, as the subject of a sentence ("training").
            how: option that overrides the refusal.

        Raises:
            CfbError: the model is a predictor.
        """
        if self.kind != "plant":
            raise CfbError(
                f"model {self.name} is a predictor, not a plant: its inertia was left free, so {purpose} with it would "
                f"learn a drone that does not exist; use a plant, or insist with {how}."
            )

    def parameters(self) -> Parameters:
        """Return the parameter pytree, in the current default float precision."""
        return Parameters(**{key: self.entries[key].value for key in SPECIFICATIONS})

    def with_values(self, source: str, **values: float | list | np.ndarray) -> ModelFile:
        """Return a copy with some constants replaced.

        Args:
            source: source of the new values.
            values: new values by name.

        Raises:
            CfbError: a name is unknown, or a value is impossible.

        Warns:
            CfbWarning: a value is unusual.
        """
        where = f"model {self.name}"
        if not source:
            raise CfbError(f"{where}: new values need a source; say where the numbers come from.")
        values = current_names(values, where)
        changed = {k: Entry(_value(k, v, where), source) for k, v in values.items() if _known(k, where)}
        return replace(self, entries={**self.entries, **changed})


def preset_names() -> list[str]:
    """Names of the parameter sets shipped with the library."""
    return shipped_names("parameters")


def load_model_file(name_or_path: str | Path, changes: Iterable[str] = ()) -> ModelFile:
    """Read a shipped preset (by name) or a model YAML (by path).

    Args:
        name_or_path: preset or file.
        changes: changes of parameters, each ``NAME=VALUE``; lists are written with commas.

    Raises:
        CfbError: a change is not NAME=VALUE, there is no such preset or file, the YAML is broken, keys are unknown or
            missing, units are missing or wrong, or values are impossible (`SPECIFICATIONS`). The message names the
            file and the key.

    Warns:
        CfbWarning: a value is possible but unusual.
    """
    values = dict(map(_change, changes))
    described = _read(name_or_path)
    return described.with_values("command line", **values) if values else described


def _change(text: str) -> tuple[str, float | list[float]]:
    name, _, value = text.partition("=")
    try:
        numbers = [float(part) for part in value.split(",")]
    except ValueError:
        raise CfbError(f"--set {text}: write NAME=VALUE with a number, or numbers separated by commas.") from None
    return name, numbers if len(numbers) > 1 else numbers[0]


def _read(name_or_path: str | Path) -> ModelFile:
    path, document = load_named(name_or_path, "model", FORMAT, "parameters")
    refuse_unknown(document, _TOP_LEVEL, path, "")
    kind = document.get("kind", "plant")
    if kind not in _KINDS:
        raise CfbError(f"{path}: 'kind' must be one of {', '.join(_KINDS)}, found {kind!r}.")
    raw = document.get("parameters")
    if not isinstance(raw, dict):
        raise CfbError(f"{path}: 'parameters' must be a mapping of names to {{value, unit, source}}.")
    raw = current_names(raw, path, "parameters.")
    refuse_unknown(raw, set(SPECIFICATIONS), path, "parameters.")
    entries = {key: _entry(key, raw[key], path) for key in raw}
    missing = [key for key in SPECIFICATIONS if key not in raw and key not in DEFAULTS]
    if missing:
        raise CfbError(f"{path}: missing parameters {', '.join(missing)}; add them with value, unit and source.")
    for key in SPECIFICATIONS:
        if key not in entries:
            entries[key] = Entry(_value(key, DEFAULTS[key], path), "neutral value (not given in the file)")
    effects = document.get("effects") or []
    if not isinstance(effects, list) or not all(map(is_named, effects)):
        raise CfbError(f"{path}: 'effects' must be a list of mappings, each with a 'name'.")
    provenance = document.get("provenance") or {}
    if not isinstance(provenance, dict) or not all(isinstance(key, str) for key in provenance):
        raise CfbError(f"{path}: 'provenance' must be a mapping.")
    return ModelFile(
        name=str(document.get("name", path.stem)),
        description=str(document.get("description", "")),
        entries=entries,
        effects=tuple(effects),
        provenance=provenance,
        kind=kind,
        path=str(name_or_path),
    )


def save_model_file(model: ModelFile, path: str | Path) -> None:
    """Write a model YAML, atomically; `load_model_file` reads it back without loss.

    Raises:
        CfbError: the file cannot be written.
    """
    parameters = {}
    for key, entry in model.entries.items():
        item = {"value": _plain(entry.value), "unit": SPECIFICATIONS[key].unit, "source": entry.source}
        item |= {key: _plain(found) for key in _SPREADS if (found := getattr(entry, key)) is not None}
        parameters[key] = item
    document: dict[str, Any] = {"format": FORMAT} | ({} if model.kind == "plant" else {"kind": model.kind})
    document |= {"name": model.name, "description": model.description, "parameters": parameters}
    if model.effects:
        document["effects"] = [dict(e) for e in model.effects]
    if model.provenance:
        document["provenance"] = dict(model.provenance)
    write_text(path, yaml.safe_dump(document, sort_keys=False, allow_unicode=True, width=110))


def _entry(key: str, raw: Any, path: Path) -> Entry:
    if not isinstance(raw, dict):
        raise CfbError(f"{path}: parameters.{key} must be a mapping with value, unit and source.")
    refuse_unknown(raw, _ENTRY_KEYS, path, f"parameters.{key}.")
    unit = SPECIFICATIONS[key].unit
    if "unit" not in raw:
        raise CfbError(f"{path}: parameters.{key} has no unit; write 'unit: {unit}'.")
    if _same_unit(raw["unit"]) != _same_unit(unit):
        raise CfbError(f"{path}: parameters.{key} is in '{raw['unit']}'; convert it to '{unit}'.")
    if "value" not in raw:
        raise CfbError(f"{path}: parameters.{key} has no value.")
    if not raw.get("source"):
        raise CfbError(f"{path}: parameters.{key} has no source; say where the number comes from.")
    spreads = {}
    for what in _SPREADS:
        if raw.get(what) is not None:
            spreads[what] = _numbers(key, raw[what], path, what)
            if np.any(spreads[what] < 0):
                raise CfbError(f"{path}: parameters.{key}.{what} must be zero or positive.")
    return Entry(_value(key, raw["value"], path), str(raw["source"]), **spreads)


def _value(key: str, raw: Any, path) -> np.ndarray:
    value = _numbers(key, raw, path, "value")
    SPECIFICATIONS[key].check(value, f"{path}: parameters.{key}", warn=True)
    return value


def _numbers(key: str, raw: Any, path, what: str) -> np.ndarray:
    shape = SPECIFICATIONS[key].shape
    flat = raw.tolist() if isinstance(raw, np.ndarray | np.generic) else raw
    numbers = flat if isinstance(flat, list | tuple) else [flat]
    if not all(_finite(x) for x in numbers):
        raise CfbError(f"{path}: parameters.{key}.{what} = {flat!r} must be a finite number or a list of them.")
    value = np.asarray(flat, dtype=np.float64)
    if value.shape not in ((), shape):
        raise CfbError(
            f"{path}: parameters.{key}.{what} must have {shape[0] if shape else 1} number(s), found {flat!r}."
        )
    return np.broadcast_to(value, shape).copy()


def _finite(x: Any) -> bool:
    # Compared, because math.isfinite overflows on a huge int.
    return isinstance(x, int | float) and not isinstance(x, bool) and abs(x) <= sys.float_info.max


def _known(key: str, where: str) -> bool:
    refuse_unknown({key: None}, set(SPECIFICATIONS), where, "")
    return True


def _same_unit(unit: Any) -> str:
    text = str(unit).replace("²", "^2").replace("·", " ").replace("**", "^").replace("*", " ")
    return " ".join(text.split())


def _plain(value: np.ndarray):
    # Four equal motors are easier to read as one number.
    if value.ndim == 1 and value.size == 4 and np.all(value == value[0]):
        return float(value[0])
    return value.tolist()
