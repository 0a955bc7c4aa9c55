"""One attempt at a task in a worker: it runs in its own folder, which one rename moves to the results."""

from __future__ import annotations

import os
import shutil
import socket
import sys
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cfb_mjx import __version__
from cfb_mjx.files import write_json
from cfb_mjx.sweep.folder import OUTPUT, RECORD, Folder, read_record
from cfb_mjx.sweep.kinds import KINDS
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
