"""From tasks to results: what is done is skipped, the rest handed to workers, every ending noted at once."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from cfb_mjx.sweep.attempt import Outcome, attempt
from cfb_mjx.sweep.folder import Folder
from cfb_mjx.sweep.summary import Summary
from cfb_mjx.sweep.tasks import Task


class Workers(Protocol):
    """Where attempts are made; see `cfb_mjx.sweep.cluster.Pool`."""

    def submit(self, function: Callable[..., Outcome], *arguments: object) -> object:
        """Hand in a call."""
        ...

    def finished(self, handles: list) -> list[tuple[object, Outcome]]:
        """Calls that ended."""
        ...


@dataclass(frozen=True)
class Ended:
    """A task that has ended: it, how, and how many did not yet."""

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
        tasks: to run.
        folder: of the sweep.
        summary: refreshed as tasks end.
        workers: who run them.
        run: runs ``cfb`` with arguments in a worker; exit status.
        at_once: most tasks at a time; None leaves it to the workers.
        ended: told of every task.

    Returns:
        Why tasks failed, by name.
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
