"""Run the tasks of a sweep on workers and record each outcome immediately.

A worker sets its environment before jax loads. Each attempt at a task runs in its own folder, which one rename moves to
the results.
"""

from __future__ import annotations

import os
import shutil
import socket
import sys
import time
import traceback
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from cfb_mjx import __version__
from cfb_mjx.files import write_json
from cfb_mjx.sweep.config import KINDS
from cfb_mjx.sweep.folder import OUTPUT, RECORD, Folder, read_record
from cfb_mjx.sweep.summary import Summary
from cfb_mjx.sweep.tasks import Task

BAD_INPUT, INTERRUPTED = 2, 130


class TaskFault(Exception):
    """The command failed although its input is valid; another attempt may succeed."""


@dataclass(frozen=True)
class Outcome:
    """Outcome of a task: the reason of its failure, or None if it is done."""

    failed: str | None = None


def attempt(task: Task, folder: Folder, place: str, run: Callable[[list[str]], int]) -> Outcome:
    """Run a task and move its results into place.

    Args:
        task: the task.
        folder: folder of the sweep.
        place: folder that the relative paths of the command start from.
        run: runs ``cfb`` with the given arguments and returns its exit status.

    Raises:
        TaskFault: the command failed for another reason than bad input.
        KeyboardInterrupt: the command was interrupted.
    """
    os.chdir(place)
    with folder.alone(task.name):
        if folder.done(task.name).is_dir():
            return Outcome()  # Another attempt was faster, or its worker died after the rename.
        here = folder.running(task.name)
        record = _prepare(task, here)
        started = time.monotonic()
        status, said = _run(task, here, run)
        if status == INTERRUPTED:
            raise KeyboardInterrupt
        if status == BAD_INPUT:
            return Outcome(_sentence(said) or "bad input; see the output of the task.")
        if status != 0 or not (here / KINDS[task.command].result).exists():
            lines = said.strip().splitlines()
            raise TaskFault(lines[-1] if lines else f"the command ended with exit status {status}.")
        write_json(here / RECORD, record | {"seconds": round(time.monotonic() - started, 3)})
        here.rename(folder.done(task.name))
    return Outcome()


def _prepare(task: Task, here: Path) -> dict[str, Any]:
    """Delete the files of an earlier attempt, except those that the command resumes from; return the task's record."""
    kind = KINDS[task.command]
    earlier = read_record(here)
    here.mkdir(parents=True, exist_ok=True)
    goes_on = kind.goes_on is not None and (here / kind.goes_on).exists()
    for path in here.iterdir():
        half_written = path.name.startswith(".") and ".tmp" in path.suffixes
        if half_written or not (goes_on or path.name in (OUTPUT, RECORD)):
            shutil.rmtree(path) if path.is_dir() else path.unlink()
    record = {
        "name": task.name,
        "line": task.line,
        "varied": task.varied,
        "attempts": earlier.get("attempts", 0) + 1,
        "host": socket.gethostname(),
        "process": os.getpid(),
        "cfb_mjx": __version__,
    }
    write_json(here / RECORD, record)
    return record


def _run(task: Task, here: Path, run: Callable[[list[str]], int]) -> tuple[int, str]:
    """Run the command; return its exit status and its output."""
    words = [*task.words(here), *KINDS[task.command].more]
    printed = here / OUTPUT
    before = printed.stat().st_size if printed.exists() else 0
    arguments, sys.argv = sys.argv, ["cfb", *words]  # a fitted model stores the command line that made it
    try:
        with _captured(printed):
            now = time.strftime("%Y-%m-%d %H:%M:%S")
            print(f"# {task.line}\n# {now}, {socket.gethostname()}, process {os.getpid()}")
            try:
                status = run(words)
            except Exception:
                traceback.print_exc()
                status = 1
    finally:
        sys.argv = arguments
    with open(printed, "rb") as file:
        file.seek(before)
        return status, file.read().decode(errors="replace")


@contextmanager
def _captured(path: Path) -> Iterator[None]:
    """Append everything that this process prints, also from compiled code, to a file."""
    kept = os.dup(1), os.dup(2)
    with open(path, "a", encoding="utf-8", buffering=1) as file:
        try:
            for number in (1, 2):
                os.dup2(file.fileno(), number)
            with redirect_stdout(file), redirect_stderr(file):
                yield
        finally:
            for number, copy in zip((1, 2), kept, strict=True):
                os.dup2(copy, number)
                with suppress(OSError):
                    os.close(copy)


def _sentence(said: str) -> str | None:
    """Return the last error message of the command, if it printed one."""
    reasons = [line.removeprefix("cfb: ") for line in said.splitlines() if line.startswith("cfb: ")]
    return reasons[-1] if reasons else None


_THREADS: tuple[str, ...] = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NPROC", "PJRT_NPROC")
"""Numbers of threads of BLAS libraries; the last two are XLA's."""


def environment(cpus: float, gpus: float) -> dict[str, str]:
    """Return environment variables that limit a task to its share of a machine.

    Args:
        cpus: processors of the task; it gets as many threads, at least one.
        gpus: GPUs of the task; with 0, jax uses the processors even if a GPU is free.
    """
    threads = max(1, int(cpus))
    found: dict[str, str] = dict.fromkeys(_THREADS, str(threads))
    if not gpus:
        found["JAX_PLATFORMS"] = "cpu"
    elif gpus < 1:
        # By default jax reserves three quarters of a GPU; tasks that share one must leave room for each other.
        found["XLA_PYTHON_CLIENT_MEM_FRACTION"] = f"{0.9 * gpus:.3f}"
    return found


class Workers(Protocol):
    """Workers that run attempts; see `cfb_mjx.sweep.cluster.Pool`."""

    def submit(self, function: Callable[..., Outcome], *arguments: object) -> object:
        """Submit a call; return a handle."""
        ...

    def finished(self, handles: list) -> list[tuple[object, Outcome]]:
        """Return the calls that have ended, with their outcomes."""
        ...


@dataclass(frozen=True)
class Ended:
    """A task that has ended, its outcome, and the number of tasks left."""

    task: Task
    outcome: Outcome
    left: int


def drive(
    tasks: list[Task],
    folder: Folder,
    summary: Summary,
    workers: Workers,
    run: Callable[[list[str]], int],
    at_once: int | None,
    ended: Callable[[Ended], None],
) -> dict[str, str]:
    """Run tasks until all have ended.

    Args:
        tasks: tasks to run.
        folder: folder of the sweep.
        summary: table that is refreshed as tasks end.
        workers: workers that run the tasks.
        run: runs ``cfb`` with the given arguments in a worker and returns its exit status.
        at_once: largest number of simultaneous tasks; None leaves it to the workers.
        ended: called for every task that ends.

    Returns:
        The reasons of failed tasks, by name.
    """
    waiting, flying, failed = deque(tasks), {}, {}
    place = os.getcwd()
    while waiting or flying:
        while waiting and (at_once is None or len(flying) < at_once):
            task = waiting.popleft()
            flying[workers.submit(attempt, task, folder, place, run)] = task
        for handle, outcome in workers.finished(list(flying)):
            task = flying.pop(handle)
            if outcome.failed is None:
                folder.forgive(task.name)
            else:
                failed[task.name] = outcome.failed
                folder.fail(task, outcome.failed)
            ended(Ended(task, outcome, len(waiting) + len(flying)))
            summary.refresh()
    return failed
