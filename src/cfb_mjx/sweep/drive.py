"""Run the tasks of a sweep on workers and record each outcome immediately."""

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
