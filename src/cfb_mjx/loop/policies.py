"""The policies of a demonstration, of one budget each: on the declared model, on randomised drones, gone on with."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import jax

from cfb_mjx.files import write_json
from cfb_mjx.runtime import Progress, environment, say
from cfb_mjx.train.config import load_config, with_changes
from cfb_mjx.train.run import POLICY, Training, train

CONFIG = "loop"
"""Shipped: ``configs/loop.yaml``."""
FURTHER = ("analytic.updates=200", "analytic.learning_rate=1.0e-3")
"""Of a policy gone on with, on the corrected model or, to be fair, on the declared one."""
RANDOMISED = ("randomisation.magnitude=1.0", "analytic.updates=700")
"""The paper's whole spread, and as many updates as `CONFIG` and `FURTHER` have together."""
BOTH = (*FURTHER, RANDOMISED[0])
"""Of the randomised policy gone on with on the corrected model."""
DONE = "training.json"


def train_policy(
    what: str,
    folder: Path,
    seed: int,
    changes: tuple[str, ...] = (),
    model: Path | None = None,
    start: Path | None = None,
) -> dict[str, Any]:
    """Train into ``folder``, or go on where an interruption left it; what is done is left alone.

    Args:
        what: is trained, in words.
        folder: of this policy.
        seed: of everything random.
        changes: to the configuration `CONFIG`.
        model: YAML in place of the declared model.
        start: policy file to begin from.

    Returns:
        The last row of the learning curve.
    """
    if (folder / DONE).exists():
        return json.loads((folder / DONE).read_text(encoding="utf-8"))
    say(f"training {what}")
    bar, facts = Progress(what), environment()
    versions = {name: facts[name] for name in ("cfb_mjx", "jax", "jaxlib", "python")}
    choices = {"seed": seed, "model": None if model is None else str(model)}
    training = Training.prepare(with_changes(load_config(CONFIG, changes), **choices), versions, start)
    with jax.enable_x64(False):
        rows = train(
            training,
            folder,
            resume=True,
            progress=lambda done, total, rate, left: bar(done, total, f"{left:.0f} s left"),
        )
    write_json(folder / DONE, rows[-1])
    return rows[-1]


def policy_file(folder: Path) -> Path:
    """Where `train_policy` leaves the policy."""
    return folder / POLICY
