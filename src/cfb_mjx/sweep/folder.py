"""The folder of a sweep: its layout, and the state of every task.

Locks are file locks: they end with the process that holds them, and also work on shared file systems.
"""

from __future__ import annotations

import fcntl
import json
import os
import socket
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from cfb_mjx.errors import CfbError
from cfb_mjx.files import output_folder, write_text
from cfb_mjx.sweep.config import KINDS
from cfb_mjx.sweep.tasks import Task

POLL_S = 0.3


@contextmanager
def held(path: Path, shared: bool = False, busy: str | None = None) -> Iterator[None]:
    """Hold a lock during the block.

    Args:
        path: file of the lock; it is not deleted.
        shared: allow other shared holders.
        busy: message if another process holds the lock; None waits for it.

    Raises:
        CfbError: another process holds the lock (``busy``, with that process), or the file system has no locks.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    how = fcntl.LOCK_SH if shared else fcntl.LOCK_EX
    with open(path, "a+", encoding="utf-8") as file:
        while True:
            try:
                fcntl.flock(file, how | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                if busy is not None:
                    file.seek(0)
                    raise CfbError(f"{busy} ({file.read().strip() or 'elsewhere'}).") from None
                # Polling lets Ctrl-C through.
                time.sleep(POLL_S)
            except OSError as error:
                raise CfbError(
                    f"{path}: its file system has no locks ({error.strerror or error}), so two processes could write "
                    "at the same time; choose a folder on another file system."
                ) from None
        file.truncate(0)
        file.write(f"{socket.gethostname()}, process {os.getpid()}")
        file.flush()
        yield


RECORD, OUTPUT, CONFIG = "task.json", "output.txt", "sweep.yaml"
State = Literal["done", "failed", "open"]


@dataclass(frozen=True)
class Folder:
    """Folder of a sweep.

    ``done/NAME`` holds the results of a task; it appears in one rename, complete. A task runs in ``running/NAME``.
    ``failed/NAME.txt`` has the reason of a failure.
    """

    path: Path

    def done(self, name: str) -> Path:
        """Folder of the results of a task."""
        return self.path / "done" / name

    def running(self, name: str) -> Path:
        """Folder in which a task runs."""
        return self.path / "running" / name

    def failed(self, name: str) -> Path:
        """File with the reason of a task's failure."""
        return self.path / "failed" / f"{name}.txt"

    def state(self, name: str) -> State:
        """State of a task."""
        if self.done(name).is_dir():
            return "done"
        return "failed" if self.failed(name).exists() else "open"

    def alone(self, name: str):
        """Lock a task during a block; wait if another process runs it."""
        return held(self.path / ".locks" / "tasks" / name)

    def summing(self):
        """Lock the table of results during a block; wait if another process writes it."""
        return held(self.path / ".locks" / "results")

    @contextmanager
    def driven(self, part: tuple[int, int] | None = None) -> Iterator[None]:
        """Lock the sweep, or one part of it, during a block.

        Raises:
            CfbError: another process drives it.
        """
        busy = f"{self.path}: another cfb sweep is at work there; wait for it or stop it"
        with ExitStack() as stack:
            stack.enter_context(held(self.path / ".locks" / "sweep", part is not None, busy))
            if part is not None:
                stack.enter_context(held(self.path / ".locks" / f"part-{part[0]}-of-{part[1]}", busy=busy))
            yield

    def fail(self, task: Task, why: str) -> None:
        """Record the reason of a task's failure, with the end of its output."""
        printed = self.running(task.name) / OUTPUT
        said = printed.read_text(encoding="utf-8", errors="replace") if printed.exists() else ""
        tail = "\n".join(said.splitlines()[-50:])
        write_text(self.failed(task.name), f"{why}\n\n{task.line}\n\n{tail}\n")

    def forgive(self, name: str) -> None:
        """Delete the record of an earlier failure of a task that is done now."""
        self.failed(name).unlink(missing_ok=True)


def open_folder(path: Path, config: str) -> Folder:
    """Create the folder of a sweep, or open an existing one, and store the sweep's file in it.

    Raises:
        CfbError: the folder holds other files, or cannot be written.
    """
    path = Path(os.path.abspath(path))
    require_own(path)
    output_folder(path)
    # Written first: other parts of the sweep may start now, and recognise the folder by it.
    write_text(path / CONFIG, config)
    for name in ("done", "running", "failed"):
        output_folder(path / name)
    return Folder(path)


def require_own(path: Path) -> None:
    """Refuse a folder that holds anything but a sweep.

    Raises:
        CfbError: it does.
    """
    if path.is_dir() and any(not p.name.startswith(".") for p in path.iterdir()) and not (path / CONFIG).exists():
        raise CfbError(f"{path}: holds other files; give another folder, for this sweep alone, with -o.")


def require_same(folder: Folder, tasks: tuple[Task, ...]) -> None:
    """Refuse a folder in which a task of the same name has another command line.

    Raises:
        CfbError: names the first such task that is done, or has begun and would resume.
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
                    f"{place}: was made by {was}, but this sweep would run '{task.line}'; give another folder with -o, "
                    "or move that one away."
                )


def read_record(place: Path) -> dict[str, Any]:
    """Return the record in a task's folder; empty if it cannot be read."""
    try:
        record = json.loads((place / RECORD).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return record if isinstance(record, dict) else {}
