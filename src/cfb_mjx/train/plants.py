"""Named sets of drones for the evaluation of controllers."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from cfb_mjx.documents import is_named, load_named, refuse_unknown, told
from cfb_mjx.errors import CfbError
from cfb_mjx.model.quadrotor import Quadrotor
from cfb_mjx.parameters import ModelFile

FORMAT = "cfb_mjx plants 1"


def load_plants(base: ModelFile, name_or_path: str | Path = "off-nominal") -> dict[str, Quadrotor]:
    """Read the drones of a shipped set or a YAML file: ``base`` with the effects that each entry adds.

    Args:
        base: model without these effects.
        name_or_path: name of a set, or file.

    Raises:
        CfbError: there is no such set, an entry has no name, an effect is unknown, or a value is impossible.
    """
    path, document = load_named(name_or_path, "set of plants", FORMAT, "plants")
    plants = {}
    refuse_unknown(document, {"format", "name", "description", "plants"}, path, "")
    listed = document.get("plants") or []
    if not isinstance(listed, list):
        raise CfbError(f"{path}: 'plants' must be a list, found {told(listed)}.")
    for item in listed:
        effects = item.get("effects") if isinstance(item, dict) else None
        if not isinstance(effects, list) or not all(map(is_named, effects)) or "name" not in item:
            raise CfbError(f"{path}: every plant needs a name and a list of effects, found {told(item)}.")
        refuse_unknown(item, {"name", "why", "effects"}, path, "plants.")
        if str(item["name"]) in plants:
            raise CfbError(f"{path}: two plants have the name {item['name']}; give each its own name.")
        where = f"{path}: plant {item['name']}"
        described = replace(base, name=str(item["name"]), effects=(*base.effects, *effects), path=where)
        plants[described.name] = Quadrotor.from_file(described)
    if not plants:
        raise CfbError(f"{path}: contains no plants.")
    return plants
