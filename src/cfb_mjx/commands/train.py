"""``cfb train``: train a controller in simulation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import isfinite
from pathlib import Path
from typing import Annotated, Literal

import tyro

from cfb_mjx.commands.command import Command, Devices, File, OutputFolder, Pairs, Result, command
from cfb_mjx.errors import CfbError
from cfb_mjx.files import VectorFormat, require_no_file, together, write_json

NEWEST, EVENTS, FIGURE = "training.json", "events", "curve.png"
_JUDGED = (
    ("hover_mm", "hover", " mm"),
    ("track_mm", "figure eight", " mm"),
    ("random_mm", "on randomised drones", " mm"),
    ("command_std", "command std", ""),
    ("rate_error_radps", "rate error", " rad/s"),
    ("axis_error", "axis error", ""),
)


@dataclass(frozen=True)
class Trained(Result):
    """The outcome of a training.

    Attributes:
        curve: the learning curve, with a row of numbers by name for every checkpoint.
        files: paths of the files written, by kind: policy, learning curve, figure. If several processes train one
            policy, only the first writes files; it is empty for the others.
    """

    curve: Sequence[Mapping[str, float]]
    files: Mapping[str, Path]

    def __str__(self) -> str:
        if not self.files:
            return ""
        return f"policy: {self.files['policy']}\nlearning curve: {self.files['learning curve']}, {self.files['figure']}"


@command
class Train(Command):
    """Train a controller with PPO or by back-propagation through the model.

    A training can be interrupted at any time; with --resume it continues from its last checkpoint to the same result.

    Writes policy.npz (the final policy, for `cfb fly` and `cfb export`), best.npz (the policy with the best evaluation
    during the training), curve.csv and curve.png (the learning curve), updates.csv (the numbers of every update),
    config.yaml and checkpoint.npz.

    Attributes:
        task: task to learn: target (fly to a target and hold it), flip (turn about the x axis at a given rate) or track
            (follow a path).
        output: folder for the results.
        config: training YAML, or the name of a shipped one. Default: the configuration with the name of the task.
        model: preset or model YAML of the drone, with its effects. Default: that of the configuration.
        randomise: ranges from which drones are drawn: a shipped name, a YAML file or a model.
            The parameters of such a model must have a spread between drones (cfb-fleet).
            Default: those of the configuration. --set randomisation.magnitude sets their factor.
        algorithm: ppo (as in the paper) or analytic (back-propagation through the model).
            Default: that of the configuration.
        seed: seed of all random numbers. Default: that of the configuration.
        set: changes to the configuration, for instance randomisation.magnitude=0.5 ppo.steps=2e7.
        start: policy to start from: a policy file, or the name of a shipped policy. Default: random weights.
        resume: continue from the checkpoint in the folder.
        force: train even if the model is a predictor and not a plant.
        devices: number of devices over which the drones are divided; with several processes, of each process.
        coordinator: address of process 0, to train one policy with several processes; auto within srun or mpirun.
        processes: number of processes; not with auto.
        process: index of this process, from 0; not with auto.
        tensorboard: also write the numbers of every update and checkpoint for TensorBoard, into the folder events.
        format: also write every figure as a vector graphic, pdf or svg. Default: PNG only.
    """

    lists_in_yaml = True

    task: Annotated[Literal["target", "flip", "track"], tyro.conf.Positional]
    output: OutputFolder
    config: Annotated[str | None, tyro.conf.arg(metavar="CONFIG")] = None
    model: Annotated[str | None, tyro.conf.arg(metavar="MODEL")] = None
    randomise: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    algorithm: Literal["ppo", "analytic"] | None = None
    seed: int | None = None
    set: Pairs = ()
    start: File = None
    resume: bool = False
    force: bool = False
    devices: Devices = 1
    coordinator: Annotated[str | None, tyro.conf.arg(metavar="HOST:PORT")] = None
    processes: int | None = None
    process: int | None = None
    tensorboard: bool = False
    format: VectorFormat | None = None

    def run(self) -> Trained:
        """Train, and write the policy, the learning curve, the configuration and the checkpoint.

        With ``coordinator`` the training runs in a child process, which is forked before jax is loaded. This process
        waits for it and then raises SystemExit.

        Raises:
            CfbError: an invalid configuration, model or policy; an earlier training in the folder, without ``resume``;
                or a training with other settings to resume.
        """
        from cfb_mjx.joining import Hosts, joined

        hosts = Hosts.asked(self.coordinator, self.processes, self.process)
        require_no_file(self.output)
        goes_on = (
            f"what was saved in {self.output} is intact: start every process again with --resume to go on from there."
        )
        with joined(hosts, goes_on):
            return self._trained()

    def _trained(self) -> Trained:
        from cfb_mjx.interrupts import ended_by_sigterm
        from cfb_mjx.runtime import Progress, configure_jax, differentiate_mjx, environment, say

        configure_jax(x64=False, devices=self.devices)
        from cfb_mjx.hosts import first
        from cfb_mjx.train.config import load_config, with_changes
        from cfb_mjx.train.run import CURVE, POLICY, Training, train
        from cfb_mjx.view.learning import learning_events, learning_figure
        from cfb_mjx.view.style import with_vector_copies

        ranges = () if self.randomise is None else (f"randomisation.ranges={self.randomise}",)
        settings = load_config(self.config or self.task, (*ranges, *self.set))
        settings = with_changes(settings, model=self.model, algorithm=self.algorithm, seed=self.seed)
        if settings.task != self.task:
            raise CfbError(f"--config {self.config}: trains {settings.task}, not {self.task}; give another one.")
        if settings.body == "mjx" and settings.algorithm == "analytic":
            differentiate_mjx()
        facts = environment()
        versions = {name: facts[name] for name in ("cfb_mjx", "jax", "jaxlib", "python")}
        training = Training.prepare(settings, versions, self.start, self.force)
        drone = training.described.name
        if first():
            say(f"{settings.algorithm} on {drone}, randomisation x {settings.randomisation.magnitude:g}")
        bar = Progress("training")

        def advanced(done: int, total: int, rate: float, left: float) -> None:
            if first():
                bar(done, total, f"{rate / 1e3:.0f} k commands/s, {_clock(left)} left")

        with ended_by_sigterm(), learning_events(self.output / EVENTS if self.tensorboard and first() else None) as log:

            def reported(row: dict[str, float]) -> None:
                log(
                    int(row["commands"]),
                    {name: row[name] for name in row if name not in ("update", "commands", "seconds")},
                )
                say(_said(row))

            rows = train(training, self.output, self.resume, advanced, reported, devices=self.devices, log=log)
        if not first():
            return Trained(rows, {})
        files = {"policy": POLICY, "learning curve": CURVE, "figure": FIGURE}
        files = {what: self.output / name for what, name in files.items()}
        with together(), with_vector_copies(self.format):
            learning_figure(rows, files["figure"], f"{settings.algorithm}, {drone}")
            write_json(self.output / NEWEST, {"environment": facts, "last": rows[-1]})
        return Trained(rows, files)


def _said(row: Mapping[str, float]) -> str:
    """A row of the learning curve as text."""
    judged = "".join(
        f", {label} {row[key]:.3g}{unit}" if isfinite(row[key]) else f", {label} most failed"
        for key, label, unit in _JUDGED
        if key in row
    )
    return f"{_clock(row['seconds'])}: {row['commands'] / 1e6:.3g} M commands, loss {row['loss']:.3g}{judged}"


def _clock(seconds: float) -> str:
    return f"{int(seconds // 3600)}:{int(seconds // 60 % 60):02d}:{int(seconds % 60):02d}"
