"""The state of a search on disk, so that an interrupted one goes on where it was."""

from __future__ import annotations

import contextlib
import json
from dataclasses import dataclass, replace
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np

from cfb_mjx import __version__
from cfb_mjx.errors import CfbError
from cfb_mjx.files import remove, write_json
from cfb_mjx.model.effects import effect_from_mapping, effect_to_mapping
from cfb_mjx.parameters import ModelFile
from cfb_mjx.sysid.tracing.hypothesis import Hypothesis


@dataclass
class Checkpoint:
    """One file; what belongs to other flights, another model or another version is not taken up."""

    path: Path | None = None
    key: str = ""
    state: dict[str, Any] | None = None

    @classmethod
    def open(cls, path: Path, logs: list[Path], base: ModelFile) -> Checkpoint:
        """The checkpoint of a search over these files."""
        digest = sha256(f"{__version__} {base}".encode())
        for log in logs:
            digest.update(log.name.encode() + log.read_bytes())
        key = digest.hexdigest()
        state = None
        with contextlib.suppress(OSError, ValueError):
            found = json.loads(path.read_text(encoding="utf-8"))
            state = found if isinstance(found, dict) and found.get("key") == key else None
        return cls(path, key, state)

    def save(self, hypothesis: Hypothesis, refused: set[str], tried: list[dict]) -> None:
        """Remember where the search is."""
        if self.path is None:
            return
        effects = [effect_to_mapping(e) for e in hypothesis.effects if type(e).name in hypothesis.present]
        self.state = {
            "key": self.key,
            "present": list(hypothesis.present),
            "effects": [{"name": e["name"], "parameters": e["parameters"]} for e in effects],
            "lead": hypothesis.lead,
            "shift": hypothesis.shift,
            "levels": hypothesis.levels.tolist(),
            "refused": sorted(refused),
            "tried": tried,
        }
        write_json(self.path, self.state)

    def restore(self, nothing: Hypothesis) -> tuple[Hypothesis, set[str], list[dict]] | None:
        """The hypothesis, refused effects and history that were saved; None if there are none."""
        if self.state is None:
            return None
        try:
            values = {item["name"]: effect_from_mapping(item, str(self.path)) for item in self.state["effects"]}
        except (CfbError, KeyError, TypeError):
            return None  # damaged: the search begins anew
        effects = tuple(values.get(type(e).name, e) for e in nothing.effects)
        hypothesis = replace(
            nothing,
            effects=effects,
            present=tuple(self.state["present"]),
            lead=self.state["lead"],
            shift=self.state["shift"],
            levels=np.array(self.state["levels"]),
        )
        return hypothesis, set(self.state["refused"]), self.state["tried"]

    def discard(self) -> None:
        """The search is done."""
        if self.path is not None:
            remove(self.path)
