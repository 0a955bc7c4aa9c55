"""Named sets of drones to judge controllers on."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from cfb_mjx.errors import CfbError
from cfb_mjx.files import shipped
from cfb_mjx.model.quadrotor import Quadrotor
from cfb_mjx.parameters import ModelFile
from cfb_mjx.parameters.model_file import load_yaml

FORMAT = "cfb_mjx plants 1"


def load_plants(base: ModelFile, name_or_path: str | Path = "off-nominal") -> dict[str, Quadrotor]:
    """Drones of a shipped set, or of a YAML file: ``base`` with the effects that each adds.

    Raises:
        CfbError: no such set, or an entry without a name, or unknown effects.
    """
    path = Path(name_or_path)
    if path.suffix not in (".yaml", ".yml"):
        names = sorted(file.stem for file in shipped("configs", "plants").glob("*.yaml"))
        if str(name_or_path) not in names:
            raise CfbError(f"{name_or_path}: no such set of plants; give a YAML file or one of {', '.join(names)}.")
        path = shipped("configs", "plants", f"{name_or_path}.yaml")
    document = load_yaml(path)
    if document.get("format") != FORMAT:
        raise CfbError(f"{path}: 'format' must be '{FORMAT}', found {document.get('format')!r}.")
    plants = {}
    for item in document.get("plants") or []:
        if not isinstance(item, dict) or not isinstance(item.get("effects"), list) or "name" not in item:
            raise CfbError(f"{path}: every plant needs a name and a list of effects, found {item!r}.")
        described = replace(base, name=str(item["name"]), effects=(*base.effects, *item["effects"]))
        plants[described.name] = Quadrotor.from_file(described)
    if not plants:
        raise CfbError(f"{path}: names no plants.")
    return plants
