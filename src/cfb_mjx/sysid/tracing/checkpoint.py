"""Checkpoint of a search on disk; an interrupted search that continues from it gives the same result."""

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
    """State of a search between two rounds: all that the next round needs and that cannot be recomputed.

    Attributes:
        hypothesis: the model so far.
        refused: names of effects that are not tried again before another effect is added.
        tried: candidates of every round, for the report.
        vain: number of rounds since an effect was last added.
        left_out: names of effects that were left out of ``judged``, one at a time, to test whether they are needed.
        judged: model that was refitted without each of these effects.
    """

    hypothesis: Hypothesis
    refused: frozenset[str] = frozenset()
    tried: tuple[dict, ...] = ()
    vain: int = 0
    left_out: tuple[str, ...] = ()
    judged: Hypothesis | None = None


@dataclass
class Checkpoint:
    """A checkpoint file.

    Attributes:
        path: of the file; None: nothing is saved.
        of: hashes and versions of the inputs of the search (`identity`).
        state: content of the file; None if there is none.
    """

    path: Path | None = None
    of: dict[str, str] = field(default_factory=dict)
    state: dict[str, Any] | None = None

    @classmethod
    def open(cls, path: Path, logs: list[Path], base: ModelFile, say: Callable[[str], None]) -> Checkpoint:
        """Open the checkpoint of a search.

        A file written with other inputs, and an unreadable file, are renamed with the suffix ``.old``.

        Args:
            path: of the checkpoint, which need not exist.
            logs: flight files of the search.
            base: the declared model.
            say: called with a message if the file is renamed.
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
        why = f"was interrupted with different {', '.join(others)}" if before else "cannot be read"
        say(f"the search in {path} {why}: starting again; the old file is kept as {aside.name}")
        return new

    def save(self, progress: Progress) -> None:
        """Write the state of the search to the file."""
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
        """The saved state; None if nothing was saved.

        Args:
            nothing: hypothesis of the declared model.

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
            raise CfbError(f"{self.path}: is damaged ({error}); delete it to start the search again.") from None

    def discard(self) -> None:
        """Delete the file, after the search has finished."""
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
    """Hashes and versions of everything that a search depends on."""
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
