"""Named sets of drones to judge controllers on."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from cfb_mjx.documents import load_named
from cfb_mjx.errors import CfbError
from cfb_mjx.model.quadrotor import Quadrotor
from cfb_mjx.parameters import ModelFile

FORMAT = "cfb_mjx plants 1"


def load_plants(base: ModelFile, name_or_path: str | Path = "off-nominal") -> dict[str, Quadrotor]:
    """Drones of a shipped set, or of a YAML file: ``base`` with the effects that each adds.

    Raises:
        CfbError: no such set, an entry without a name, unknown effects, or numbers of them that cannot be.
    """
    path, document = load_named(name_or_path, "set of plants", FORMAT, "plants")
    plants = {}
    for item in document.get("plants") or []:
        if not isinstance(item, dict) or not isinstance(item.get("effects"), list) or "name" not in item:
            raise CfbError(f"{path}: every plant needs a name and a list of effects, found {item!r}.")
        where, effects = f"{path}: plant {item['name']}", (*base.effects, *item["effects"])
        described = replace(base, name=str(item["name"]), effects=effects, path=where)
        plants[described.name] = Quadrotor.from_file(described)
    if not plants:
        raise CfbError(f"{path}: names no plants.")
    return plants
