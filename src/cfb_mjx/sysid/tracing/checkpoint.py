"""The state of a search on disk, so that an interrupted one goes on to the result it would have had."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from hashlib import sha256
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from cfb_mjx.errors import CfbError
from cfb_mjx.files import code_identity, remove, write_json
from cfb_mjx.model.effects import effect_from_mapping, effect_to_mapping
from cfb_mjx.model.effects.catalogue import CATALOGUE, outside, written
from cfb_mjx.parameters import ModelFile
from cfb_mjx.sysid.tracing.hypothesis import Hypothesis

FORMAT = "cfb_mjx search 2"


@dataclass(frozen=True)
class Progress:
    """Where a search is between two rounds: all that the next depends on, and that cannot be computed again.

    Attributes:
        hypothesis: the model so far.
        refused: effects that are not tried again before another is taken in.
        tried: what was looked at in every round, for the report.
        vain: rounds since the last effect was taken in.
        left_out: effects without which a model was fitted to see whether they are missed.
        judged: that model.
    """

    hypothesis: Hypothesis
    refused: frozenset[str] = frozenset()
    tried: tuple[dict, ...] = ()
    vain: int = 0
    left_out: tuple[str, ...] = ()
    judged: Hypothesis | None = None


@dataclass
class Checkpoint:
    """One file, and what its state belongs to: flights, model, code, libraries."""

    path: Path | None = None
    of: dict[str, str] = field(default_factory=dict)
    state: dict[str, Any] | None = None

    @classmethod
    def open(cls, path: Path, logs: list[Path], base: ModelFile, say: Callable[[str], None]) -> Checkpoint:
        """The checkpoint of a search over these files.

        A file that is of something else is moved aside, and ``say`` is told of what.
        """
        new = cls(path, identity(logs, base))
        if not path.exists():
            return new
        try:
            found = json.loads(path.read_text(encoding="utf-8"))
            before = found["of"] if found["format"] == FORMAT else {}
        except (OSError, ValueError, KeyError, TypeError):
            found, before = None, {}
        if before == new.of:
            return replace(new, state=found)
        aside = path.with_name(f"{path.name}.old")
        path.replace(aside)
        others = [what for what in new.of if before.get(what) != new.of[what]]
        why = f"was interrupted with other {', '.join(others)}" if before else "cannot be read"
        say(f"the search in {path} {why}: beginning anew; it is kept as {aside.name}")
        return new

    def save(self, progress: Progress) -> None:
        """Remember where the search is."""
        if self.path is None:
            return
        self.state = {
            "format": FORMAT,
            "of": self.of,
            "hypothesis": _written(progress.hypothesis),
            "refused": sorted(progress.refused),
            "tried": list(progress.tried),
            "vain": progress.vain,
            "left_out": list(progress.left_out),
            "judged": None if progress.judged is None else _written(progress.judged),
        }
        write_json(self.path, self.state)

    def restore(self, nothing: Hypothesis) -> Progress | None:
        """What was saved, given the declared model; None if nothing was.

        Raises:
            CfbError: the file is damaged.
        """
        if self.state is None:
            return None
        try:
            state, judged = self.state, self.state["judged"]
            return Progress(
                self._read(state["hypothesis"], nothing),
                frozenset(state["refused"]),
                tuple(state["tried"]),
                int(state["vain"]),
                tuple(state["left_out"]),
                None if judged is None else self._read(judged, nothing),
            )
        except (CfbError, KeyError, TypeError, ValueError) as error:
            raise CfbError(f"{self.path}: is damaged ({error}); delete it, and the search begins anew.") from None

    def discard(self) -> None:
        """The search is done."""
        if self.path is not None:
            remove(self.path)

    def _read(self, written: dict[str, Any], nothing: Hypothesis) -> Hypothesis:
        values = {item["name"]: effect_from_mapping(item, str(self.path)) for item in written["effects"]}
        return replace(
            nothing,
            effects=tuple(values.get(type(e).name, e) for e in nothing.effects),
            present=tuple(written["present"]),
            lead=float(written["lead"]),
            shift=float(written["shift"]),
            levels=np.array(written["levels"], dtype=float),
        )


def identity(logs: list[Path], base: ModelFile) -> dict[str, str]:
    """What a search depends on, each as a hash or a version."""
    model = {name: entry.value.tolist() for name, entry in base.entries.items()}
    return {
        "flights": _hash(log.name.encode() + log.read_bytes() for log in logs),
        "model": _hash([json.dumps([model, [dict(e) for e in base.effects]], default=str).encode()]),
        "code": code_identity(),
        "effects of your own": _hash(written(name).encode() for name in CATALOGUE if outside(name)),
        "libraries": ", ".join(f"{name} {metadata.version(name)}" for name in ("jax", "jaxlib", "numpy", "scipy")),
    }


def _written(hypothesis: Hypothesis) -> dict[str, Any]:
    effects = [effect_to_mapping(e) for e in hypothesis.effects if type(e).name in hypothesis.present]
    return {
        "present": list(hypothesis.present),
        "effects": [{"name": e["name"], "parameters": e["parameters"]} for e in effects],
        "lead": float(hypothesis.lead),
        "shift": float(hypothesis.shift),
        "levels": hypothesis.levels.tolist(),
    }


def _hash(parts) -> str:
    digest = sha256()
    for part in parts:
        digest.update(sha256(part).digest())
    return digest.hexdigest()[:16]
