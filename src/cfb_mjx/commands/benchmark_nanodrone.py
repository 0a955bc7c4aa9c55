"""``cfb benchmark-nanodrone``: evaluate a model by the rules of the IDSIA nano-drone benchmark."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from cfb_mjx.commands.command import Command, File, Model, Result, Within, command, lines_of
from cfb_mjx.errors import CfbError
from cfb_mjx.files import require_folder, write_json

if TYPE_CHECKING:
    from cfb_mjx.logs import FlightLog

_ENDINGS = (".parquet", ".csv")
_UNITS = {"position": "m", "velocity": "m/s", "attitude": "rad", "rate": "rad/s"}


@dataclass(frozen=True)
class Judged(Result):
    """Errors of a model beside those of other models and of the published results.

    Attributes:
        numbers: the results as ``--json`` writes them, for instance ``numbers["rows"]["model"]["position_sum_m"]``.
        files: paths of the files written, by kind; None for a file that was not asked for.
    """

    numbers: Mapping[str, Any]
    files: Mapping[str, Path | None]

    def __str__(self) -> str:
        windows = [f"{name}: {flight['windows']} windows" for name, flight in self.numbers["flights"].items()]
        return "\n".join([*windows, "", errors_table(self.numbers), *lines_of(self.files)])


@command
class BenchmarkNanodrone(Command):
    """Evaluate a model by the rules of the IDSIA nano-drone benchmark, beside the published results.

    From every row of a flight, 50 steps at 100 Hz are predicted. The inputs are the measured rotor speeds; each step
    uses only speeds that were measured up to its time. The table also has the preset cfb-idsia, a plant that was fitted
    to flights of the benchmark's drone.

    Attributes:
        folder: folder with the flights of the benchmark: raw 100 Hz merges or processed files (parquet or csv).
        model: preset or model YAML. It is evaluated alone and with a disturbance observer.
            The default was fitted to flights of the benchmark's drone, but not to its test flights.
        json: JSON file for the results.
        stride: number of rows between the starts of two predictions.
        official: the folder holds the benchmark's processed files (data/real/processed).
            Every row is then used as it is, as in the benchmark's own evaluation.
            Only then are the errors comparable with the published ones.
            Without this option, raw merges are cleaned.
    """

    folder: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FOLDER")]
    model: Model = "cfb-idsia-predictor"
    json: File = None
    stride: Annotated[int, Within(1)] = 1
    official: bool = False

    def run(self) -> Judged:
        """Run the benchmark, and write the results if a file was asked for.

        Raises:
            CfbError: a folder without flights of the benchmark, an invalid model, or a file that cannot be written.
        """
        from cfb_mjx.runtime import Progress, configure_jax, environment

        require_folder(self.json)
        logs = _flights(self.folder, self.official)  # before jax loads, so that a bad log is refused at once
        configure_jax(x64=True)
        from cfb_mjx.sysid.nanodrone import STEPS, benchmark, published_rows, usual_contestants

        numbers = benchmark(logs, usual_contestants(self.model), self.stride, Progress("benchmark"))
        numbers |= {
            "published": published_rows(),
            "steps": STEPS,
            "stride": self.stride,
            "official": self.official,
            "model": self.model,
            "environment": environment(),
        }
        if self.json is not None:
            write_json(self.json, numbers)
        return Judged(numbers, {"results": self.json})


def _flights(folder: Path, official: bool) -> list[FlightLog]:
    from cfb_mjx.logs import read_log
    from cfb_mjx.logs.idsia import read_as_published

    if not folder.is_dir():
        raise CfbError(f"{folder}: is not a folder; give one with the flights of the benchmark (parquet or csv).")
    paths = sorted(path for path in folder.iterdir() if path.suffix in _ENDINGS)
    if not paths:
        raise CfbError(f"{folder}: has no .parquet or .csv file; give a folder with the flights of the benchmark.")
    logs = [read_as_published(path) if official else read_log(path, "idsia") for path in paths]
    if len({log.name for log in logs}) < len(logs):
        raise CfbError(f"{folder}: two files hold the same flight; keep each flight as parquet or as csv, not both.")
    return logs


def errors_table(numbers: Mapping[str, Any]) -> str:
    """A table of the mean errors of every model after 1, 10 and 50 steps, their sums, and the published sums."""
    from cfb_mjx.sysid.nanodrone import DECLARED, PLANT, QUANTITIES, SHOWN, STEPS

    labels = {
        "physics": "physics (rate held)",
        "declared": f"{DECLARED}, 45 g",
        "plant": PLANT,
        "plant_observer": f"{PLANT} with observer",
        "model_observer": "model with observer",
    }
    rows: Mapping[str, Mapping[str, float]] = numbers["rows"]
    keys = [[f"{q}_mean_{u}@{h}" for h in SHOWN] + [f"{q}_sum_{u}"] for q, u in QUANTITIES.items()]
    heads = [f"h = {h}" for h in SHOWN] + ["sum"]
    return "\n".join(
        [
            f"mean errors after h steps of 10 ms, and their sum over h = 1 to {STEPS}; {numbers['windows']} windows",
            f"{'':<26}" + "".join(f"{f'{q}, {_UNITS[q]}':<38}" for q in QUANTITIES).rstrip(),
            f"{'':<26}" + "".join("".join(f"{head:<9}" for head in heads) + "  " for _ in QUANTITIES).rstrip(),
            *(_row(labels.get(name, name), row, keys) for name, row in rows.items()),
            "as published, on the paper's own test flights:",
            *(_row(name, row, keys) for name, row in numbers["published"].items()),
        ]
    )


def _row(label: str, row: Mapping[str, float], keys: list[list[str]]) -> str:
    cells = ("".join(f"{row[k]:<9.4g}" if k in row else f"{'':<9}" for k in group) + "  " for group in keys)
    return f"{label:<26}{''.join(cells)}".rstrip()
