"""The pipeline of a training: segments between checkpoints, learning curve, policy; what is interrupted goes on."""

from __future__ import annotations

import csv
import io
import json
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import IntEnum
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import yaml
from jaxtyping import PRNGKeyArray

from cfb_mjx.control.neural import NeuralController
from cfb_mjx.control.policy_file import PolicyFile, load_policy, save_policy
from cfb_mjx.devices import Devices
from cfb_mjx.errors import CfbError
from cfb_mjx.files import output_folder, together, write_text
from cfb_mjx.hosts import as_first, first, from_first
from cfb_mjx.model.effects import KNOWN
from cfb_mjx.model.effects.catalogue import outside, written
from cfb_mjx.model.quadrotor import Quadrotor
from cfb_mjx.model.randomised import require_possible
from cfb_mjx.model.rotors import hover_command
from cfb_mjx.parameters import ModelFile, load_model_file, load_randomisation
from cfb_mjx.train.algorithm import Algorithm
from cfb_mjx.train.checkpoint import load_state, read_about, save_checkpoint
from cfb_mjx.train.config import TrainingConfig
from cfb_mjx.train.flips import turning
from cfb_mjx.train.flying import hover, nominal_task

CHECKPOINT, POLICY, CURVE, CONFIG = "checkpoint.npz", "policy.npz", "curve.csv", "config.yaml"
BEST, UPDATES = "best.npz", "updates.csv"
_JUDGED_ON, _JUDGED_ON_RANDOM = 64, 256
"""Hover flights at each point of the curve, with the noise of the task: on the nominal drone, on drones of its own."""
_BEST_BY = ("random_mm", "hover_mm", "rate_error_radps")
"""What the best policy has least of: the first of these that the curve has."""

Row = dict[str, float]


class Stream(IntEnum):
    """What a training draws with its seed; each has a key of its own."""

    NETWORK, LEARNING, JUDGING, JUDGING_RANDOM = range(4)

    def key(self, seed: int) -> PRNGKeyArray:
        """Of a training with this seed."""
        return jax.random.fold_in(jax.random.PRNGKey(seed), int(self))


@dataclass(frozen=True)
class Training:
    """What a training starts from.

    Attributes:
        config: the configuration.
        described: the model file it names.
        start: a policy to start from, instead of a random one.
        versions: of the software, for the policy file.
    """

    config: TrainingConfig
    described: ModelFile
    start: PolicyFile | None
    versions: dict[str, str]

    @classmethod
    def prepare(
        cls, config: TrainingConfig, versions: dict[str, str], start: str | Path | None = None, force: bool = False
    ) -> Training:
        """Read what the configuration names.

        Raises:
            CfbError: a bad model or policy, a predictor that is not insisted on, ranges that allow impossible drones,
                or a policy of another shape.
        """
        described = load_model_file(config.model)
        ranges = load_randomisation(config.randomisation.ranges)
        require_possible(
            Quadrotor.from_file(described), ranges, config.randomisation.magnitude, "randomisation.magnitude"
        )
        if not force:
            described.require_plant("training", "--force")
        policy = None if start is None else load_policy(start)
        if policy is not None:
            controller, wanted = policy.controller, config.network
            hidden = tuple(len(b) for b in controller.network.biases[:-1])
            if controller.layout != config.observation or hidden != wanted.hidden:
                raise CfbError(f"{start}: this policy has another observation or network than the configuration.")
            if controller.network.activation != wanted.activation:
                raise CfbError(f"{start}: this policy's activation is {controller.network.activation}.")
        return cls(config, described, policy, versions)

    def identity(self) -> dict[str, Any]:
        """What a checkpoint must agree with to be gone on from."""
        names = [item["name"] for item in self.described.effects]
        own = {name: written(name) for name in names if name in KNOWN and outside(name)}
        return {
            "config": self.config.to_mapping(),
            "model": _described(self.described),
            "start": None if self.start is None else self.start.weights_sha256,
        } | ({"effects": own} if own else {})

    def nominal(self) -> Quadrotor:
        """The drone about which the others are drawn."""
        if self.config.body == "mjx":
            from cfb_mjx.model import MjxBody

            return Quadrotor.from_file(self.described, body=MjxBody(floor=False))
        return Quadrotor.from_file(self.described)

    def first_controller(self, nominal: Quadrotor) -> NeuralController:
        """The policy it starts with."""
        if self.start is not None:
            return self.start.controller
        network = self.config.network
        return NeuralController.random(
            Stream.NETWORK.key(self.config.seed),
            self.config.observation,
            network.hidden,
            network.activation,
            float(jnp.clip(jnp.mean(hover_command(nominal.changed_parameters())), 0.05, 0.95)),
        )

    def policy(self, controller: NeuralController) -> PolicyFile:
        """The policy as a file, with what made it."""
        return PolicyFile(controller, self.config.task, {**self.identity(), "versions": self.versions})


def train(
    training: Training,
    output: Path,
    resume: bool = False,
    progress: Callable[[int, int, float, float], None] = lambda done, total, rate, left: None,
    report: Callable[[Row], None] = lambda row: None,
    evaluate: bool = True,
    devices: int = 1,
    log: Callable[[int, Row], None] = lambda commands, metrics: None,
) -> list[Row]:
    """Train, writing ``policy.npz``, ``best.npz``, ``curve.csv``, ``updates.csv``, ``config.yaml`` and
    ``checkpoint.npz`` into ``output``.

    What is interrupted (KeyboardInterrupt) keeps the state of the last update, and goes on from there.

    Args:
        training: what to do.
        output: folder; made if need be.
        resume: go on from the checkpoint there, if there is one.
        progress: called after every update with updates done, all updates, commands flown per second, seconds left.
        report: called with every new row of the learning curve.
        evaluate: fly the hover test at every checkpoint.
        devices: of this process over which the drones are spread; where several processes run as one
            (`cfb_mjx.hosts`), of each of them. Then the first alone reads and writes files, and reports.
        log: called after every update with the commands flown so far and its metrics.

    Returns:
        The learning curve, one row per checkpoint.

    Raises:
        CfbError: an earlier training is in the way, the checkpoint is of another training, there are fewer devices, or
            the weights are no numbers any more (what was written before stays).
    """
    output = Path(output)
    checkpoint = output / CHECKPOINT
    about = from_first(lambda: _found(checkpoint, output_folder(output), training, resume))
    over, nominal = Devices.take(devices), training.nominal()
    task = training.config.build_task()
    task.hold(nominal)
    algorithm = build(training.config, task, nominal, over, training.start is not None)
    state = algorithm.begin(Stream.LEARNING.key(training.config.seed), training.first_controller(nominal))
    done, seconds, rows, metrics = 0, 0.0, [], {}
    if about is not None:
        state = _loaded(checkpoint, state)
        done, seconds, rows, metrics = about["updates"], about["seconds"], about["rows"], about.get("metrics", {})
    state = spread(as_first(state), over)
    updates = _logged(output / UPDATES, done) if first() else []
    if first():
        write_text(output / CONFIG, yaml.safe_dump(training.config.to_mapping(), sort_keys=False))

    def kept() -> dict[str, Any]:
        return training.identity() | {"updates": done, "seconds": seconds, "rows": rows, "metrics": metrics}

    for end in segments(algorithm.updates, training.config.checkpoints):
        if rows and end <= rows[-1]["update"]:
            continue
        begun, spent = done, 0.0
        try:
            for update in range(done, end):
                started = time.perf_counter()
                after, found = algorithm.update(state)
                found = {name: float(value) for name, value in jax.block_until_ready(found).items()}
                spent += time.perf_counter() - started
                state, metrics, done = after, found, update + 1
                flown = done * algorithm.steps_per_update
                if first():
                    updates.append({"update": done, "commands": flown} | metrics)
                    log(flown, metrics)
                pace = spent / (done - begun)
                progress(done, algorithm.updates, algorithm.steps_per_update / pace, pace * (algorithm.updates - done))
        except KeyboardInterrupt:
            # Of several processes others may be in the middle of an update: there the last checkpoint counts.
            if jax.process_count() == 1 and done > begun:
                seconds += spent
                with together():
                    save_checkpoint(checkpoint, over.here(state), kept())
                    write_text(output / UPDATES, _csv(updates))
            raise
        seconds += spent
        row = {"update": done, "commands": done * algorithm.steps_per_update, "seconds": round(seconds, 2), **metrics}
        whole = over.here(state)
        controller = jax.tree.map(lambda x: jnp.asarray(x) if eqx.is_array_like(x) else x, algorithm.controller(whole))
        if not all(bool(jnp.isfinite(x).all()) for x in jax.tree.leaves(eqx.filter(controller, eqx.is_inexact_array))):
            raise CfbError(_diverged(output, done, rows))
        if first():
            row |= _judged(controller, training, task, nominal) if evaluate else {}
        rows = [*rows, row]
        if first():
            policy = training.policy(controller)
            with together():
                # The first is never missing: from it an interrupted training goes on.
                save_checkpoint(checkpoint, whole, kept())
                save_policy(policy, output / POLICY)
                if _is_best(rows):
                    save_policy(policy, output / BEST)
                write_text(output / UPDATES, _csv(updates))
                write_text(output / CURVE, _csv(rows))
            report(row)
    return rows


def _is_best(rows: list[Row]) -> bool:
    """Whether no earlier policy was judged as good as the last one."""
    by = next((name for name in _BEST_BY if name in rows[-1]), None)
    return by is None or all(not rows[-1][by] >= row[by] for row in rows[:-1])


def _logged(path: Path, done: int) -> list[dict]:
    """What the file holds of the first ``done`` updates."""
    rows = list(csv.DictReader(path.read_text().splitlines())) if done and path.is_file() else []
    return [row for row in rows if int(row["update"]) <= done]


def _diverged(output: Path, done: int, rows: list[dict]) -> str:
    kept = f"the policy of update {rows[-1]['update']} is kept" if rows else "no policy was written"
    return (
        f"{output}: by update {done} the policy's weights are no numbers; {kept}. Train anew with a lower learning "
        "rate, and look for a drone that the ranges make too wild with cfb fly."
    )


def build(
    config: TrainingConfig, task, nominal: Quadrotor, over: Devices | None = None, trained: bool = False
) -> Algorithm:
    """The algorithm of a configuration, over these devices (one by default); ``trained``: it begins with a policy that
    can fly."""
    if config.algorithm == "ppo":
        from cfb_mjx.train.ppo import Ppo

        return Ppo(config.ppo, task, nominal, over, trained)
    from cfb_mjx.train.analytic import Analytic

    return Analytic(config.analytic, task, nominal, over)


def segments(updates: int, count: int) -> list[int]:
    """After which updates checkpoints are written; the last is ``updates``."""
    count = min(count, updates)
    return sorted({round(updates * (i + 1) / count) for i in range(count)})


def spread(state: Any, over: Devices) -> Any:
    """Drones over the devices, everything else on each."""
    episodes = over.along(state.episodes)
    return eqx.tree_at(lambda s: s.episodes, over.whole(state), episodes)


def _loaded(checkpoint: Path, like: Any) -> Any:
    """In the first process the state of the checkpoint, elsewhere ``like`` it; all fail where it is damaged."""
    found = [like]

    def load() -> None:
        found[0] = load_state(checkpoint, like)

    from_first(load)
    return found[0]


def _found(checkpoint: Path, output: Path, training: Training, resume: bool) -> dict[str, Any] | None:
    if not resume:
        if checkpoint.exists():
            raise CfbError(f"{output}: holds a training already; go on with --resume, or give another folder with -o.")
        return None
    if not checkpoint.exists():
        return None
    about = read_about(checkpoint)
    for part, now in training.identity().items():
        before, now = _comparable(about.get(part)), _comparable(_json(now))
        if before != now:
            what = ", ".join(_differences(before, now, part)) or part
            raise CfbError(f"{checkpoint}: the training there had another {what}; give what it had, or another folder.")
    return about


def _comparable(part: Any) -> Any:
    """Without what a training does not depend on: its description, and the name of the model's file, since what that
    holds is compared and folders move."""
    if not isinstance(part, dict):
        return part
    named = str(part.get("model", "")).endswith((".yaml", ".yml"))
    left_out = {"description", "model"} if named else {"description"}
    return {key: value for key, value in part.items() if key not in left_out}


def _json(value: Any) -> Any:
    return json.loads(json.dumps(value))


def _differences(before: Any, now: Any, path: str) -> list[str]:
    if isinstance(before, dict) and isinstance(now, dict):
        keys = [*before, *(k for k in now if k not in before)]
        return [d for k in keys for d in _differences(before.get(k), now.get(k), f"{path}.{k}")]
    return [] if before == now else [path]


def _judged(controller: NeuralController, training: Training, task, nominal: Quadrotor) -> Row:
    keys = jax.random.split(Stream.JUDGING.key(training.config.seed), _JUDGED_ON)
    if training.config.task == "flip":
        measured = turning(controller, nominal_task(task), nominal, keys)
        return {name: float(jnp.mean(value)) for name, value in measured._asdict().items()}
    measured, _ = hover(controller, nominal_task(task), nominal, keys)
    row = {
        "hover_mm": 1e3 * float(jnp.mean(measured.mean_distance_m)),
        "command_std": float(jnp.mean(measured.command_std)),
        "hover_failed": float(jnp.mean(measured.failed)),
    }
    if task.randomisation is None:
        return row
    # All of the ranges, however mild some of the drones are that it learns on.
    keys = jax.random.split(Stream.JUDGING_RANDOM.key(training.config.seed), _JUDGED_ON_RANDOM)
    measured, _ = hover(controller, replace(task, graded=0.0), nominal, keys)
    distance = jnp.where(measured.failed, jnp.inf, measured.mean_distance_m)
    return row | {"random_mm": 1e3 * float(jnp.median(distance)), "random_failed": float(jnp.mean(measured.failed))}


def _csv(rows: list[Row]) -> str:
    text = io.StringIO()
    writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    for row in rows:
        writer.writerow({k: f"{v:.6g}" if isinstance(v, float) else v for k, v in row.items()})
    return text.getvalue()


def _described(model: ModelFile) -> dict[str, Any]:
    return {
        "name": model.name,
        "kind": model.kind,
        "parameters": {key: entry.value.tolist() for key, entry in model.entries.items()},
        "effects": [{k: v for k, v in effect.items() if k in ("name", "parameters")} for effect in model.effects],
    }
