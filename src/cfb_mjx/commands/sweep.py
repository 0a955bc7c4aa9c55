"""``cfb sweep``: run a command with many combinations of arguments."""

from __future__ import annotations

import re
import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from cfb_mjx.commands.command import Command, OutputFolder, Result, Within, command
from cfb_mjx.errors import CfbError
from cfb_mjx.files import output_folder, require_no_file
from cfb_mjx.interrupts import ended_by_sigterm

if TYPE_CHECKING:
    from cfb_mjx.sweep import Folder, Summary, Task
    from cfb_mjx.sweep import Sweep as Plan
    from cfb_mjx.sweep.drive import Ended


@dataclass(frozen=True)
class Swept(Result):
    """The outcome of a sweep.

    Attributes:
        listed: the tasks with their command lines, if they were only listed; else empty.
        results: paths of the tables of results, as CSV and as JSON.
        failed: the reasons why tasks failed, by the name of the task.
        tasks: number of tasks.
        folder: folder of the sweep.
    """

    listed: str
    results: tuple[Path, ...]
    failed: dict[str, str]
    tasks: int
    folder: Path

    def __str__(self) -> str:
        return self.listed or f"results: {', '.join(map(str, self.results))}"

    @property
    def complaint(self) -> str | None:
        """How many tasks failed, and why; None if none did."""
        if not self.failed:
            return None
        name, why = next(iter(self.failed.items()))
        return (
            f"{len(self.failed)} of {self.tasks} tasks failed; {name}: {why.rstrip('.')}; "
            f"all reasons are in {self.folder / 'failed'}; run the same command again to retry."
        )


@command
class Sweep(Command):
    """Run a command with many combinations of arguments (seeds, randomisations, drones), here or on a cluster.

    The results of each task are written to DIR/done/NAME, where DIR is the folder of --output; they appear there only
    when the task is complete. results.csv has a row for each finished task and is updated during the run. A worker
    process that dies is replaced. A task with bad input is recorded in DIR/failed, and the others continue.

    If the sweep was interrupted, the same command continues it: finished tasks are kept, and failed tasks are tried
    again. Needs Ray: pip install 'cfb_mjx[sweep]'.

    Attributes:
        config: sweep YAML, or the name of a shipped sweep (firmware-pid, randomisation, refits).
        output: folder for the results.
        address: address of a Ray cluster to use instead of this machine alone; auto: the cluster of this machine.
            All machines of the cluster must have access to the folder.
        workers: largest number of tasks at a time. Default: as many as the processors and GPUs allow.
        retries: number of further attempts at a task whose worker dies, or which ends with an error of the library.
        part: run only every N-th task from the I-th on.
            With it N jobs share the tasks of one folder without a cluster.
        dry_run: list the tasks with their command lines, and run nothing.
    """

    config: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="CONFIG")]
    output: OutputFolder
    address: Annotated[str | None, tyro.conf.arg(metavar="HOST:PORT")] = None
    workers: Annotated[int | None, Within(1), tyro.conf.arg(metavar="N")] = None
    retries: Annotated[int, Within(0)] = 3
    part: Annotated[str | None, tyro.conf.arg(metavar="I/N")] = None
    dry_run: bool = False

    def run(self) -> Swept:
        """Run the tasks that are not done yet, and write the table of results.

        Raises:
            CfbError: an invalid sweep file, arguments that the command refuses, a folder with other results or with
                another sweep that is running, no Ray, or no cluster.
        """
        from cfb_mjx import plugins
        from cfb_mjx.commands import load
        from cfb_mjx.sweep import Folder, Summary, load_sweep, open_folder, tasks_of
        from cfb_mjx.sweep.folder import require_own, require_same
        from cfb_mjx.sweep.summary import CSV, JSON

        chosen = _part(self.part)
        plan = load_sweep(self.config, load, plugins.files())
        tasks = tasks_of(plan)
        share = tasks if chosen is None else tasks[chosen[0] - 1 :: chosen[1]]
        require_no_file(self.output)
        if self.dry_run:
            return Swept(_listed(share, Folder(self.output)), (), {}, len(share), self.output)
        output_folder(self.output)
        require_own(self.output)
        with ended_by_sigterm(), Folder(self.output).driven(chosen):
            folder = open_folder(self.output, plan.path.read_text(encoding="utf-8"))
            require_same(folder, tasks)
            _say_what_is_left_over(folder, tasks)
            summary = Summary(folder, tasks)
            try:
                failed = self._carry_out(plan, share, folder, summary)
            finally:
                summary.refresh(now=True)
        return Swept("", (self.output / CSV, self.output / JSON), failed, len(share), self.output)

    def _carry_out(self, plan: Plan, tasks: tuple[Task, ...], folder: Folder, summary: Summary) -> dict[str, str]:
        """Run the tasks that are left; return the reasons why tasks failed, by the name of the task."""
        from cfb_mjx.cli import main
        from cfb_mjx.runtime import Progress, say
        from cfb_mjx.sweep import drive
        from cfb_mjx.sweep.cluster import Needs, opened

        left = [task for task in tasks if folder.state(task.name) != "done"]
        done = len(tasks) - len(left)
        if not left:
            say(f"all {len(tasks)} tasks are done already")
            return {}
        say(f"{len(tasks)} tasks of cfb {plan.parameters.command}" + (f", {done} done already" if done else ""))
        bar, failed = Progress("sweep"), 0

        def ended(end: Ended) -> None:
            nonlocal done, failed
            done, failed = done + (end.outcome.failed is None), failed + (end.outcome.failed is not None)
            if end.outcome.failed is not None:
                bar.clear()
                say(f"{end.task.name} failed: {end.outcome.failed}")
            elif not bar.live:
                say(f"{end.task.name} done; {end.left} left")
            bar(done + failed, len(tasks), f"{failed} failed, {end.left} left")

        needs = Needs(plan.cpus, plan.gpus, self.retries, plan.parameters.kind.calls)
        try:
            with opened(self.address, needs, folder.path) as pool, ended_by_sigterm():
                bar(done, len(tasks), f"0 failed, {len(left)} left")
                return drive(left, folder, summary, pool, main, self.workers, ended)
        except KeyboardInterrupt:
            bar.clear()
            say(f"stopped with {done} of {len(tasks)} tasks done; run the same command again to continue")
            raise


def _part(part: str | None) -> tuple[int, int] | None:
    if part is None:
        return None
    found = re.fullmatch(r"(\d+)/(\d+)", part)
    if not found or not 1 <= int(found[1]) <= int(found[2]):
        raise CfbError(f"--part {part}: write I/N with I from 1 to N, for instance 2/8.")
    return int(found[1]), int(found[2])


def _listed(tasks: tuple[Task, ...], folder: Folder) -> str:
    states = [folder.state(task.name) for task in tasks]
    lines = [
        f"{task.name}{'' if state == 'open' else f'  # {state}'}\n"
        f"  {shlex.join(['cfb', *task.words(folder.done(task.name))])}"
        for task, state in zip(tasks, states, strict=True)
    ]
    return "\n".join([*lines, f"{len(tasks)} tasks, {states.count('done')} done"])


def _say_what_is_left_over(folder: Folder, tasks: tuple[Task, ...]) -> None:
    from cfb_mjx.runtime import say

    names = {task.name for task in tasks}
    if others := sorted(p.name for p in (folder.path / "done").iterdir() if p.name not in names):
        where = folder.path / "done"
        say(f"{len(others)} results in {where} belong to no task of this sweep ({others[0]} ...); they are kept")
