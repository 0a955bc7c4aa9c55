"""Flights that replace the paper's flights, which are not public."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from cfb_mjx.errors import CfbError
from cfb_mjx.files import shipped
from cfb_mjx.logs import FlightLog, read_log

if TYPE_CHECKING:
    from cfb_mjx.parameters import ModelFile

NO_LOGS = (".md", ".txt", ".yaml", ".yml", ".json", ".png")

REAL_MASS_KG = 0.045
"""Mass of the drone of the public flights, which carries an AI-deck and a flow deck."""
SOURCE = (
    "the public IDSIA nano-drone system-identification benchmark (Busetto et al., Control Engineering Practice 172, "
    "2026)"
)
SKIPPED = "Real flights. Skipped: give --real FOLDER to include them."
GENERATED = "a flight that comes with the project, made by another program (`data/flight_logs`)"


def generated(name: str) -> FlightLog:
    """A shipped flight log."""
    return read_log(shipped("data", "flight_logs", f"{name}.mcap"))


@dataclass(frozen=True)
class Given:
    """Flights given by the user for an item."""

    logs: tuple[FlightLog, ...]
    mass: float | None = None
    """Weighed mass of the drone, kg; None: the mass of the model."""

    @classmethod
    def read(cls, folder: Path, mass: float | None) -> Given:
        """Read all flight logs in a folder and its subfolders.

        Raises:
            CfbError: the folder has no flight logs, or one cannot be read.
        """
        if not folder.is_dir():
            raise CfbError(f"{folder}: there is no such folder; --flights takes a folder of flight logs.")
        paths = [p for p in sorted(folder.rglob("*")) if p.is_file() and p.name[0] != "." and p.suffix not in NO_LOGS]
        if not paths:
            raise CfbError(f"{folder}: holds no flight logs.")
        return cls(tuple(map(read_log, paths)), mass)

    def drone(self, preset: str) -> ModelFile:
        """A preset with the weighed mass."""
        from cfb_mjx.parameters import load_model_file

        file = load_model_file(preset)
        return file if self.mass is None else file.with_values("weighed", mass=self.mass)

    def said(self) -> str:
        """Phrase with the names of the flights and the mass."""
        mass = "the mass of the preset" if self.mass is None else f"a mass of {self.mass:g} kg, as weighed"
        return f"{len(self.logs)} flights given with --flights ({', '.join(log.name for log in self.logs)}), {mass}"


def require_real(folder: Path | None) -> None:
    """Check that a folder, if given, contains real flights.

    Raises:
        CfbError: the folder contains none.
    """
    if folder is not None and not _paths(folder):
        raise CfbError(
            f"{folder}: has no fit/*.parquet or validation/*.parquet; give another folder, or leave --real out."
        )


def real_flights(folder: Path | None) -> list[FlightLog]:
    """All flights of a folder with subfolders ``fit`` and ``validation``; empty for None."""
    return [] if folder is None else [read_log(path) for path in _paths(folder)]


def _paths(folder: Path) -> list[Path]:
    return [path for part in ("fit", "validation") for path in sorted((folder / part).glob("*.parquet"))]
