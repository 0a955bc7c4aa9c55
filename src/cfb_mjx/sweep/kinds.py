"""Which commands a sweep can run, and what it must know of each."""

from __future__ import annotations

from dataclasses import dataclass

RESULT = "result.json"


@dataclass(frozen=True)
class Kind:
    """A command, as a task of a sweep.

    Attributes:
        positional: the parameter that is given without its name.
        output: what ``-o`` names inside the task's folder (``.`` for the folder itself), None for commands without it.
        result: JSON with the numbers of the task; asked for with ``--json`` unless the command always writes it.
        writes_result: whether it does.
        goes_on: file in the folder of an interrupted task by which the command goes on where it was.
        more: arguments that make it go on.
        calls: tasks of one worker process, so that compiled programs are shared but do not pile up.
    """

    positional: str | None = None
    output: str | None = None
    result: str = RESULT
    writes_result: bool = False
    goes_on: str | None = None
    more: tuple[str, ...] = ()
    calls: int = 20

    def outputs(self) -> tuple[tuple[str, str], ...]:
        """Options that take a file of the task's folder, with the file."""
        folder = () if self.output is None else (("--output", self.output),)
        return folder if self.writes_result else (*folder, ("--json", self.result))


KINDS = {
    "benchmark-nanodrone": Kind("folder"),
    "close-loop": Kind(output=".", result="report.json", writes_result=True, goes_on="search.json"),
    "demo-loop": Kind(output=".", result="loop.json", writes_result=True, goes_on="settings.json"),
    "evaluate": Kind("logs"),
    "excite": Kind("manoeuvre", output="."),
    "fit": Kind("logs", output="model.yaml"),
    "fit-rotors": Kind("files", output="model.yaml"),
    "fly": Kind("controller"),
    "refine": Kind("logs", output="model.yaml"),
    # A training sets XLA up for itself before jax loads (virtual devices, derivatives of the MJX body).
    "train": Kind(
        "task",
        output=".",
        result="training.json",
        writes_result=True,
        goes_on="checkpoint.npz",
        more=("--resume",),
        calls=1,
    ),
}

EXTRA_FILES = frozenset({"figure", "recording", "video", "log", "keep"})
"""Parameters that name one more file to write: it goes into the task's folder."""
REPEATED = frozenset({"plugin"})
"""Parameters that are named again for each of several values."""
CHOSEN_HERE = frozenset({"output", "json", "resume"})
"""Parameters that the sweep gives."""
