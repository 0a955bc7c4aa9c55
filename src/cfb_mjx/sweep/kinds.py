"""The commands that a sweep can run, and the properties of each that it needs."""

from __future__ import annotations

from dataclasses import dataclass

RESULT = "result.json"


@dataclass(frozen=True)
class Kind:
    """A command as a task of a sweep.

    Attributes:
        positional: parameter that is given without its name.
        output: argument of ``-o`` inside the task's folder (``.`` for the folder itself); None for commands without it.
        result: JSON file with the numbers of the task, requested with ``--json`` unless the command always writes it.
        writes_result: whether the command always writes it.
        goes_on: file in the folder of an interrupted task that the command resumes from.
        more: arguments that make the command resume.
        calls: tasks per worker process; they share compiled programs, which must not accumulate.
    """

    positional: str | None = None
    output: str | None = None
    result: str = RESULT
    writes_result: bool = False
    goes_on: str | None = None
    more: tuple[str, ...] = ()
    calls: int = 20

    def outputs(self) -> tuple[tuple[str, str], ...]:
        """Options that name a file in the task's folder, with the file."""
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
    # A training configures XLA before jax loads (virtual devices, derivatives of the MJX body), so one per process.
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
"""Parameters that name another output file, which is put into the task's folder."""
REPEATED = frozenset({"plugin"})
"""Parameters whose option is repeated for each value."""
CHOSEN_HERE = frozenset({"output", "json", "resume"})
"""Parameters that the sweep sets itself."""
