"""Training of the policies of a demonstration: on the declared model, on randomised drones, and further training."""

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
"""Name of the shipped configuration ``configs/loop.yaml``."""
FURTHER = ("analytic.updates=200", "analytic.learning_rate=1.0e-3")
"""Changes for further training on the corrected model and, for a fair comparison, on the declared model."""
RANDOMISED = ("randomisation.magnitude=1.0", "analytic.updates=700")
"""Changes for the randomised policy: the paper's spread, and as many updates as `CONFIG` and `FURTHER` together."""
BOTH = (*FURTHER, RANDOMISED[0])
"""Changes for further training of the randomised policy on the corrected model."""
DONE = "training.json"


def train_policy(
    what: str,
    folder: Path,
    seed: int,
    changes: tuple[str, ...] = (),
    model: Path | None = None,
    start: Path | None = None,
) -> dict[str, Any]:
    """Train a policy, or resume an interrupted training. A finished training is not repeated.

    Args:
        what: description of the training, for the terminal.
        folder: folder of this policy.
        seed: seed of all random draws.
        changes: changes to the configuration `CONFIG`.
        model: model file that replaces the declared model.
        start: policy file from which the training starts; None starts from random weights.

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
    """File in which `train_policy` stores the policy."""
    return folder / POLICY
