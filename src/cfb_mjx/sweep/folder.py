"""The folder of a sweep: what lies where, and what it says of every task."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from cfb_mjx.errors import CfbError
from cfb_mjx.files import output_folder, write_text
from cfb_mjx.sweep.kinds import KINDS
from cfb_mjx.sweep.locks import held
from cfb_mjx.sweep.tasks import Task

RECORD, OUTPUT, CONFIG = "task.json", "output.txt", "sweep.yaml"
State = Literal["done", "failed", "open"]


@dataclass(frozen=True)
class Folder:
    """Of a sweep.

    ``done/NAME`` holds a task's results and appears at once and whole; ``running/NAME`` is where it is worked on;
    ``failed/NAME.txt`` says why it did not work.
    """

    path: Path

    def done(self, name: str) -> Path:
        """Results of a task."""
        return self.path / "done" / name

    def running(self, name: str) -> Path:
        """Where a task is worked on."""
        return self.path / "running" / name

    def failed(self, name: str) -> Path:
        """Why a task failed."""
        return self.path / "failed" / f"{name}.txt"

    def state(self, name: str) -> State:
        """Of a task."""
        if self.done(name).is_dir():
            return "done"
        return "failed" if self.failed(name).exists() else "open"

    def alone(self, name: str):
        """A block in which no other process works on the task; waits for one that does."""
        return held(self.path / ".locks" / "tasks" / name)

    def summing(self):
        """A block in which no other process writes the table of results."""
        return held(self.path / ".locks" / "results")

    @contextmanager
    def driven(self, part: tuple[int, int] | None = None) -> Iterator[None]:
        """A block in which no other process drives this sweep, or this part of it.

        Raises:
            CfbError: one does.
        """
        busy = f"{self.path}: another cfb sweep is at work there; wait for it or stop it"
        with ExitStack() as stack:
            stack.enter_context(held(self.path / ".locks" / "sweep", part is not None, busy))
            if part is not None:
                stack.enter_context(held(self.path / ".locks" / f"part-{part[0]}-of-{part[1]}", busy=busy))
            yield

    def fail(self, task: Task, why: str) -> None:
        """Note why a task failed, with the end of what it printed."""
        printed = self.running(task.name) / OUTPUT
        said = printed.read_text(encoding="utf-8", errors="replace") if printed.exists() else ""
        tail = "\n".join(said.splitlines()[-50:])
        write_text(self.failed(task.name), f"{why}\n\n{task.line}\n\n{tail}\n")

    def forgive(self, name: str) -> None:
        """Forget an earlier failure of a task that is done now."""
        self.failed(name).unlink(missing_ok=True)


def open_folder(path: Path, config: str) -> Folder:
    """Make the folder of a sweep, or take up an earlier one, and keep the sweep's file in it.

    Raises:
        CfbError: something else lies there, or it cannot be written.
    """
    path = Path(os.path.abspath(path))
    require_own(path)
    output_folder(path)
    # First, since it says to other parts of the sweep, which may start at the same moment, whose folder this is.
    write_text(path / CONFIG, config)
    for name in ("done", "running", "failed"):
        output_folder(path / name)
    return Folder(path)


def require_own(path: Path) -> None:
    """Refuse a folder with anything but a sweep in it.

    Raises:
        CfbError: names it.
    """
    if path.is_dir() and any(not p.name.startswith(".") for p in path.iterdir()) and not (path / CONFIG).exists():
        raise CfbError(f"{path}: holds other files; give a folder of the sweep's own with -o.")


def require_same(folder: Folder, tasks: tuple[Task, ...]) -> None:
    """Refuse to mix results of two command lines under one name.

    Raises:
        CfbError: names the first task that was another one when it was done, or when it got as far as it is.
    """
    for task in tasks:
        goes_on = KINDS[task.command].goes_on
        begun = goes_on is not None and (folder.running(task.name) / goes_on).exists()
        for place in (folder.done(task.name), folder.running(task.name)):
            if not place.is_dir() or (place == folder.running(task.name) and not begun):
                continue
            line = read_record(place).get("line")
            if line != task.line:
                was = f"'{line}'" if line else "something else"
                raise CfbError(
                    f"{place}: was made by {was}, this sweep would run '{task.line}'; give another folder with -o, or "
                    "move that one away."
                )


def read_record(place: Path) -> dict[str, Any]:
    """What a task's folder says of the task; nothing if it cannot be read."""
    try:
        record = json.loads((place / RECORD).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return record if isinstance(record, dict) else {}
