"""``cfb train``."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from math import isfinite
from pathlib import Path

from cfb_mjx.cli.hosts import Hosts, joined
from cfb_mjx.errors import CfbError
from cfb_mjx.files import require_no_file, together, write_json
from cfb_mjx.interrupts import ended_by_sigterm
from cfb_mjx.runtime import Progress, configure_jax, differentiate_mjx, environment, say

NEWEST, EVENTS = "training.json", "events"
_JUDGED = (
    ("hover_mm", "hover", " mm"),
    ("random_mm", "on randomised drones", " mm"),
    ("command_std", "command std", ""),
    ("rate_error_radps", "rate error", " rad/s"),
    ("axis_error", "axis error", ""),
)


def run_train(
    task: str,
    config: str | None,
    output: Path,
    changes: tuple[str, ...],
    choices: dict,
    start: Path | None,
    resume: bool,
    force: bool,
    devices: int,
    hosts: Hosts | None = None,
    tensorboard: bool = False,
) -> None:
    """Train, and write policy, learning curve, configuration and checkpoint into ``output``.

    Raises:
        CfbError: a bad configuration, model or policy; an earlier training in the folder; another one to resume.
    """
    require_no_file(output)
    goes_on = f"what was saved in {output} is intact: start every process again with --resume to go on from there."
    with joined(hosts, goes_on):
        configure_jax(x64=False, devices=devices)
        from cfb_mjx.hosts import first
        from cfb_mjx.train.config import load_config, with_changes
        from cfb_mjx.train.run import POLICY, Training, train
        from cfb_mjx.view.learning import learning_figure

        settings = with_changes(load_config(config or task, changes), **choices)
        if settings.task != task:
            raise CfbError(f"--config {config}: trains {settings.task}, not {task}.")
        if settings.body == "mjx" and settings.algorithm == "analytic":
            differentiate_mjx()
        facts = environment()
        versions = {name: facts[name] for name in ("cfb_mjx", "jax", "jaxlib", "python")}
        training = Training.prepare(settings, versions, start, force)
        if first():
            where = f"{training.described.name}, randomisation x {settings.randomisation.magnitude:g}"
            say(f"{settings.algorithm} on {where}")
        bar = Progress("training")

        def advanced(done: int, total: int, rate: float, left: float) -> None:
            if first():
                bar(done, total, f"{rate / 1e3:.0f} k commands/s, {_clock(left)} left")

        def reported(log, row: dict) -> None:
            log(row["commands"], {name: row[name] for name in row if name not in ("update", "commands", "seconds")})
            judged = "".join(
                f", {label} {row[key]:.3g}{unit}" if isfinite(row[key]) else f", {label} most lost"
                for key, label, unit in _JUDGED
                if key in row
            )
            say(f"{_clock(row['seconds'])}: {row['commands'] / 1e6:.3g} M commands, loss {row['loss']:.3g}{judged}")

        with ended_by_sigterm(), _events(output / EVENTS if tensorboard and first() else None) as log:
            rows = train(training, output, resume, advanced, partial(reported, log), devices=devices, log=log)
        if not first():
            return
        with together():
            learning_figure(rows, output / "curve.png", f"{settings.algorithm}, {training.described.name}")
            write_json(output / NEWEST, {"environment": facts, "last": rows[-1]})
        print(f"policy: {output / POLICY}\nlearning curve: {output / 'curve.csv'}, {output / 'curve.png'}")


@contextmanager
def _events(folder: Path | None) -> Iterator[Callable[[int, dict], None]]:
    """What writes numbers over commands flown for TensorBoard; without a folder nothing is written."""
    if folder is None:
        yield lambda commands, numbers: None
        return
    from tensorboardX import SummaryWriter

    with SummaryWriter(str(folder)) as writer:

        def log(commands: int, numbers: dict) -> None:
            for name, number in numbers.items():
                # Where most drones are lost their median error is infinite: nothing to draw.
                if isfinite(number):
                    writer.add_scalar(name, number, commands)

        yield log


def _clock(seconds: float) -> str:
    return f"{int(seconds // 3600)}:{int(seconds // 60 % 60):02d}:{int(seconds % 60):02d}"
