"""The pipeline of a training: segments between checkpoints, learning curve, policy files, and resuming."""

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
from cfb_mjx.envs.target import TargetTask
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
from cfb_mjx.train.card import training_card
from cfb_mjx.train.checkpoint import load_state, read_about, save_checkpoint
from cfb_mjx.train.config import TrainingConfig
from cfb_mjx.train.flips import turning
from cfb_mjx.train.flying import hover, nominal_task
from cfb_mjx.train.tracking import track

CHECKPOINT, POLICY, CURVE, CONFIG = "checkpoint.npz", "policy.npz", "curve.csv", "config.yaml"
BEST, UPDATES = "best.npz", "updates.csv"
_JUDGED_ON, _JUDGED_ON_RANDOM = 64, 256
"""Hover flights per point of the learning curve, with the task's noise: on the nominal drone, and on random drones."""
_BEST_BY = ("random_mm", "hover_mm", "track_mm", "rate_error_radps")
"""Columns of the curve that select the best policy (lowest value): the first of these that the curve has."""

Row = dict[str, float]


class Stream(IntEnum):
    """Independent random streams of a training, each with its own key."""

    NETWORK, LEARNING, JUDGING, JUDGING_RANDOM = range(4)

    def key(self, seed: int) -> PRNGKeyArray:
        """Return the key of this stream for a seed."""
        return jax.random.fold_in(jax.random.PRNGKey(seed), int(self))


@dataclass(frozen=True)
class Training:
    """Inputs of a training.

    Attributes:
        config: configuration.
        described: model file that the configuration names.
        start: policy to start from; None: a random one.
        versions: versions of the software, for the policy file.
    """

    config: TrainingConfig
    described: ModelFile
    start: PolicyFile | None
    versions: dict[str, str]

    @classmethod
    def prepare(
        cls, config: TrainingConfig, versions: dict[str, str], start: str | Path | None = None, force: bool = False
    ) -> Training:
        """Read the model and the policy that a training needs.

        Args:
            config: configuration.
            versions: versions of the software, for the policy file.
            start: policy to start from.
            force: accept a predictor as model.

        Raises:
            CfbError: the model or policy is invalid, the model is a predictor without ``force``, the ranges allow
                impossible drones, or the policy's observation or network differs from the configuration's.
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
            if controller.recurrent:
                raise CfbError(f"{start}: this policy has a GRU; trainings go on from fully connected policies.")
            hidden = tuple(len(b) for b in controller.network.biases[:-1])
            if controller.layout != config.observation or hidden != wanted.hidden:
                raise CfbError(f"{start}: the policy's observation or network differs from the configuration's.")
            if controller.network.activation != wanted.activation:
                raise CfbError(f"{start}: this policy's activation is {controller.network.activation}.")
            if controller.network.limit != "tanh":
                raise CfbError(f"{start}: this policy clips its outputs; trainings go on from policies with a tanh.")
        return cls(config, described, policy, versions)

    def identity(self) -> dict[str, Any]:
        """Everything that a checkpoint must agree with to be resumed."""
        names = [item["name"] for item in self.described.effects]
        own = {name: written(name) for name in names if name in KNOWN and outside(name)}
        return {
            "config": self.config.to_mapping(),
            "model": _described(self.described),
            "start": None if self.start is None else self.start.weights_sha256,
        } | ({"effects": own} if own else {})

    def nominal(self) -> Quadrotor:
        """Return the nominal drone."""
        if self.config.body == "mjx":
            from cfb_mjx.model import MjxBody

            return Quadrotor.from_file(self.described, body=MjxBody(floor=False))
        return Quadrotor.from_file(self.described)

    def first_controller(self, nominal: Quadrotor) -> NeuralController:
        """Return the initial controller."""
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

    def policy(self, controller: NeuralController, commands: int, scores: Row) -> PolicyFile:
        """Return the policy as a file, with the inputs of its training and a card.

        Args:
            controller: the policy.
            commands: number of commands flown so far.
            scores: its scores; empty: it was not evaluated.
        """
        start = None if self.start is None else self.start.weights_sha256
        card = training_card(self.config.to_mapping(), self.described.name, start, commands, scores)
        return PolicyFile(controller, self.config.task, {**self.identity(), "versions": self.versions}, card)


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
    """Train, and write the results into a folder.

    The files are ``policy.npz``, ``best.npz``, ``curve.csv``, ``updates.csv``, ``config.yaml`` and ``checkpoint.npz``.
    An interrupted training (KeyboardInterrupt) stores the state of the last update and can be resumed from it.

    Args:
        training: inputs.
        output: folder; created if it does not exist.
        resume: resume from the checkpoint in ``output``, if there is one.
        progress: called after every update with updates done, total updates, commands per second, seconds left.
        report: called with every new row of the learning curve.
        evaluate: fly the hover test at every checkpoint.
        devices: number of devices of this process over which the drones are spread; if several processes run as one
            (`cfb_mjx.hosts`), of each process. In that case only the first process reads and writes files, and reports.
        log: called after every update with the commands flown so far and the metrics.

    Returns:
        The learning curve, one row per checkpoint.

    Raises:
        CfbError: the folder holds another training, the checkpoint belongs to another training, there are too few
            devices, or the weights are no longer finite (files written before are kept).
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
            # With several processes, others may be in the middle of an update; then the last checkpoint is used.
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
        scores = _judged(controller, training, task, nominal) if evaluate and first() else {}
        rows = [*rows, row | scores]
        if first():
            policy = training.policy(controller, row["commands"], scores)
            with together():
                # The checkpoint is written first, so that an interrupted training can always be resumed.
                save_checkpoint(checkpoint, whole, kept())
                save_policy(policy, output / POLICY)
                if _is_best(rows):
                    save_policy(policy, output / BEST)
                write_text(output / UPDATES, _csv(updates))
                write_text(output / CURVE, _csv(rows))
            report(rows[-1])
    return rows


def _is_best(rows: list[Row]) -> bool:
    """Whether the last policy is better than all earlier ones."""
    by = next((name for name in _BEST_BY if name in rows[-1]), None)
    return by is None or all(not rows[-1][by] >= row[by] for row in rows[:-1])


def _logged(path: Path, done: int) -> list[dict]:
    """Rows of the file for the first ``done`` updates."""
    rows = list(csv.DictReader(path.read_text().splitlines())) if done and path.is_file() else []
    return [row for row in rows if int(row["update"]) <= done]


def _diverged(output: Path, done: int, rows: list[dict]) -> str:
    kept = f"the policy of update {rows[-1]['update']} is kept" if rows else "no policy was written"
    return (
        f"{output}: by update {done} the policy's weights are not finite any more; {kept}. Train again with a lower "
        "learning rate, and use cfb fly to look for drones that the ranges make too extreme."
    )


def build(
    config: TrainingConfig, task, nominal: Quadrotor, over: Devices | None = None, trained: bool = False
) -> Algorithm:
    """Build the algorithm of a configuration.

    Args:
        config: configuration.
        nominal: nominal drone.
        over: devices; one by default.
        trained: whether the initial policy can already fly.
    """
    if config.algorithm == "ppo":
        from cfb_mjx.train.ppo import Ppo

        return Ppo(config.ppo, task, nominal, over, trained)
    from cfb_mjx.train.analytic import Analytic

    return Analytic(config.analytic, task, nominal, over)


def segments(updates: int, count: int) -> list[int]:
    """Updates after which checkpoints are written; the last one is ``updates``."""
    count = min(count, updates)
    return sorted({round(updates * (i + 1) / count) for i in range(count)})


def spread(state: Any, over: Devices) -> Any:
    """Spread the drones over the devices, and copy everything else to each."""
    return replace(over.whole(state), episodes=over.along(state.episodes))


def _loaded(checkpoint: Path, like: Any) -> Any:
    """State of the checkpoint in the first process, ``like`` elsewhere; all processes fail if the file is damaged."""
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
            raise CfbError(f"{checkpoint}: that training had another {what}; give the same, or another folder.")
    return about


def _comparable(part: Any) -> Any:
    """Remove what a training does not depend on: the description, and the name of the model's file, because the
    contents of the file are compared and folders may move."""
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
    if training.config.task == "track":
        measured, _ = track(controller, TargetTask(noise=task.noise, lumped_delay=task.lumped_delay), nominal, keys)
        return {
            "track_mm": 1e3 * float(jnp.mean(measured.mean_distance_m)),
            "track_failed": float(jnp.mean(measured.failed)),
        }
    measured, _ = hover(controller, nominal_task(task), nominal, keys)
    row = {
        "hover_mm": 1e3 * float(jnp.mean(measured.mean_distance_m)),
        "command_std": float(jnp.mean(measured.command_std)),
        "hover_failed": float(jnp.mean(measured.failed)),
    }
    if task.randomisation is None:
        return row
    # All of the ranges, also if the training uses milder drones in part.
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
