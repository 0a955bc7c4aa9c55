"""``cfb sweep``."""

from __future__ import annotations

import io
import re
import shlex
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from functools import wraps
from pathlib import Path

import tyro

from cfb_mjx import plugins
from cfb_mjx.errors import CfbError
from cfb_mjx.files import output_folder, require_no_file
from cfb_mjx.interrupts import ended_by_sigterm
from cfb_mjx.runtime import Progress, say
from cfb_mjx.sweep import Folder, Summary, Sweep, Task, drive, load_sweep, open_folder, tasks_of
from cfb_mjx.sweep.drive import Ended
from cfb_mjx.sweep.folder import require_own, require_same
from cfb_mjx.sweep.summary import CSV, JSON


def run_sweep(
    config: str, output: Path, address: str | None, workers: int | None, retries: int, part: str | None, dry_run: bool
) -> None:
    """Run what is not done yet of a sweep, and write the table of its results.

    Raises:
        CfbError: a bad file, arguments that a command refuses, a folder with other results or with a sweep at work, no
            Ray or no cluster; at the end, tasks that failed.
    """
    from cfb_mjx.cli.commands import COMMANDS

    chosen = _part(part)
    if workers is not None and workers < 1:
        raise CfbError(f"--workers {workers}: at least one task must run at a time.")
    if retries < 0:
        raise CfbError(f"--retries {retries}: must be zero or positive.")
    sweep = load_sweep(config, COMMANDS, plugins.files())
    tasks = tasks_of(sweep)
    for task in tasks:
        if (complaint := complaint_of(task.words(Path(".")), COMMANDS[task.command])) is not None:
            raise CfbError(f"{sweep.path}: task {task.name}: {complaint}")
    require_no_file(output)
    if dry_run:
        _list(_share(tasks, chosen), Folder(output))
        return
    output_folder(output)
    require_own(output)
    with ended_by_sigterm(), Folder(output).driven(chosen):
        folder = open_folder(output, sweep.path.read_text(encoding="utf-8"))
        require_same(folder, tasks)
        _say_what_is_left_over(folder, tasks)
        summary = Summary(folder, tasks)
        try:
            failed = _carry_out(sweep, _share(tasks, chosen), folder, summary, address, workers, retries)
        finally:
            summary.refresh(now=True)
    print(f"results: {output / CSV}, {output / JSON}")
    if failed:
        name, why = next(iter(failed.items()))
        raise CfbError(
            f"{len(failed)} of {len(_share(tasks, chosen))} tasks failed; {name}: {why.rstrip('.')}; "
            f"{output / 'failed'} says why for each, and the same command tries them again."
        )


def _carry_out(
    sweep: Sweep,
    tasks: tuple[Task, ...],
    folder: Folder,
    summary: Summary,
    address: str | None,
    workers: int | None,
    retries: int,
) -> dict[str, str]:
    """Why tasks failed, by name."""
    from cfb_mjx.cli import main
    from cfb_mjx.sweep.cluster import Needs, opened

    left = [task for task in tasks if folder.state(task.name) != "done"]
    done = len(tasks) - len(left)
    if not left:
        say(f"all {len(tasks)} tasks are done already")
        return {}
    say(f"{len(tasks)} tasks of cfb {sweep.parameters.command}" + (f", {done} done already" if done else ""))
    bar, failed = Progress("sweep"), 0

    def ended(end: Ended) -> None:
        nonlocal done, failed
        done, failed = done + (end.outcome.failed is None), failed + (end.outcome.failed is not None)
        if end.outcome.failed is not None:
            _over(bar, f"{end.task.name} failed: {end.outcome.failed}")
        elif not bar.live:
            say(f"{end.task.name} done; {end.left} left")
        bar(done + failed, len(tasks), f"{failed} failed, {end.left} left")

    needs = Needs(sweep.cpus, sweep.gpus, retries, sweep.parameters.kind.calls)
    try:
        with opened(address, needs, folder.path) as pool, ended_by_sigterm():
            bar(done, len(tasks), f"0 failed, {len(left)} left")
            return drive(left, folder, summary, pool, main, workers, ended)
    except KeyboardInterrupt:
        _over(bar, f"stopped with {done} of {len(tasks)} tasks done; the same command goes on from here")
        raise


def complaint_of(words: list[str], function: Callable) -> str | None:
    """Why a command would refuse to parse its arguments, None if it would not."""

    @wraps(function)
    def idle(**arguments) -> None:
        return None

    said = io.StringIO()
    try:
        with redirect_stderr(said), redirect_stdout(said):
            tyro.cli(idle, prog=f"cfb {words[0]}", args=words[1:])
    except SystemExit:
        lines = [re.sub(r"[─│╭╮╰╯]|-{4,}", " ", line).strip() for line in said.getvalue().splitlines()]
        # A title, what is wrong, and after that the help.
        body = [line for line in lines if line][1:]
        helps = [n for n, line in enumerate(body) if "helptext" in line] or [len(body)]
        return " ".join(body[: helps[0]]).rstrip(".") + f"; see 'cfb {words[0]} --help'."
    return None


def _part(part: str | None) -> tuple[int, int] | None:
    if part is None:
        return None
    found = re.fullmatch(r"(\d+)/(\d+)", part)
    if not found or not 1 <= int(found[1]) <= int(found[2]):
        raise CfbError(f"--part {part}: write I/N with I from 1 to N, for instance 2/8.")
    return int(found[1]), int(found[2])


def _share(tasks: tuple[Task, ...], part: tuple[int, int] | None) -> tuple[Task, ...]:
    return tasks if part is None else tasks[part[0] - 1 :: part[1]]


def _list(tasks: tuple[Task, ...], folder: Folder) -> None:
    states = [folder.state(task.name) for task in tasks]
    for task, state in zip(tasks, states, strict=True):
        note = "" if state == "open" else f"  # {state}"
        print(f"{task.name}{note}\n  {shlex.join(['cfb', *task.words(folder.done(task.name))])}")
    print(f"{len(tasks)} tasks, {states.count('done')} done")


def _say_what_is_left_over(folder: Folder, tasks: tuple[Task, ...]) -> None:
    names = {task.name for task in tasks}
    if others := sorted(p.name for p in (folder.path / "done").iterdir() if p.name not in names):
        where = folder.path / "done"
        say(f"{len(others)} results in {where} are of no task any more ({others[0]} ...); they stay there")


def _over(bar: Progress, text: str) -> None:
    """A line of its own, not at the end of the bar."""
    bar.clear()
    say(text)
