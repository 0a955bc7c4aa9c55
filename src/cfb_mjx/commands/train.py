"""``cfb train``: a controller, trained in simulation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import isfinite
from pathlib import Path
from typing import Annotated, Literal

import tyro

from cfb_mjx.commands.command import Command, Devices, File, OutputFolder, Pairs, Result, command
from cfb_mjx.errors import CfbError
from cfb_mjx.files import require_no_file, together, write_json

NEWEST, EVENTS, FIGURE = "training.json", "events", "curve.png"
_JUDGED = (
    ("hover_mm", "hover", " mm"),
    ("random_mm", "on randomised drones", " mm"),
    ("command_std", "command std", ""),
    ("rate_error_radps", "rate error", " rad/s"),
    ("axis_error", "axis error", ""),
)


@dataclass(frozen=True)
class Trained(Result):
    """What a training came to.

    Attributes:
        curve: the learning curve, a row of numbers by name for every checkpoint.
        files: what was written, by what it is: policy, learning curve, figure. Of several processes that train one
            policy the first alone writes.
    """

    curve: Sequence[Mapping[str, float]]
    files: Mapping[str, Path]

    def __str__(self) -> str:
        if not self.files:
            return ""
        return f"policy: {self.files['policy']}\nlearning curve: {self.files['learning curve']}, {self.files['figure']}"


@command
class Train(Command):
    """Train a controller. Interrupt it whenever you like: --resume goes on to the same result.

    Writes policy.npz (what `cfb fly` flies), best.npz (what was judged best on the way), curve.csv and curve.png
    (learning curve), updates.csv (what every update measured), config.yaml and checkpoint.npz.

    Attributes:
        task: what to learn: fly to a target and hold it, or turn about the x axis at a rate that is asked for.
        output: folder for the results.
        config: training YAML, or the name of a shipped one; the task's own by default.
        model: preset or model YAML of the drone, with its effects; in place of the configuration's.
        randomise: ranges from which drones are drawn: a shipped name, a YAML file, or a model whose numbers have a
            spread (cfb-fleet); in place of the configuration's. How much of them: --set randomisation.magnitude.
        algorithm: ppo (the paper's) or analytic (back-propagation through the model); in place of the configuration's.
        seed: of everything random; in place of the configuration's.
        set: changes to the configuration, for instance randomisation.magnitude=0.5 ppo.steps=2e7.
        start: policy to start from, in place of random weights: a file, or the name of a shipped one.
        resume: go on from the checkpoint in the folder.
        force: train on a model that is a predictor, not a plant.
        devices: of this machine, or of each of several processes, over which the drones are spread.
        coordinator: where several processes meet that train one policy together: the address of process 0, or auto
            within srun or mpirun.
        processes: how many they are; not with auto.
        process: which of them this is, from 0; not with auto.
        tensorboard: write the numbers of every update and checkpoint for TensorBoard too, into the folder's events.
    """

    lists_in_yaml = True

    task: Annotated[Literal["target", "flip"], tyro.conf.Positional]
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

    def run(self) -> Trained:
        """Train, and write policy, learning curve, configuration and checkpoint.

        With ``coordinator`` a child process does it, which is forked before jax is loaded; this one waits for it and
        leaves by SystemExit.

        Raises:
            CfbError: a bad configuration, model or policy; an earlier training in the folder; another one to resume.
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

        ranges = () if self.randomise is None else (f"randomisation.ranges={self.randomise}",)
        settings = load_config(self.config or self.task, (*ranges, *self.set))
        settings = with_changes(settings, model=self.model, algorithm=self.algorithm, seed=self.seed)
        if settings.task != self.task:
            raise CfbError(f"--config {self.config}: trains {settings.task}, not {self.task}.")
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
        with together():
            learning_figure(rows, files["figure"], f"{settings.algorithm}, {drone}")
            write_json(self.output / NEWEST, {"environment": facts, "last": rows[-1]})
        return Trained(rows, files)


def _said(row: Mapping[str, float]) -> str:
    """A row of the learning curve in words."""
    judged = "".join(
        f", {label} {row[key]:.3g}{unit}" if isfinite(row[key]) else f", {label} most lost"
        for key, label, unit in _JUDGED
        if key in row
    )
    return f"{_clock(row['seconds'])}: {row['commands'] / 1e6:.3g} M commands, loss {row['loss']:.3g}{judged}"


def _clock(seconds: float) -> str:
    return f"{int(seconds // 3600)}:{int(seconds // 60 % 60):02d}:{int(seconds % 60):02d}"
