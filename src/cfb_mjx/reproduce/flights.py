"""Which flights stand in for the paper's own, which are not public."""

from __future__ import annotations

from pathlib import Path

from cfb_mjx.files import shipped
from cfb_mjx.logs import FlightLog, read_log

REAL_MASS_KG = 0.045
"""The drone of the public flights carries an AI-deck and a flow deck."""
SOURCE = (
    "the public IDSIA nano-drone system-identification benchmark (Busetto et al., Control Engineering Practice 172, "
    "2026)"
)
GENERATED = "a flight that comes with the project, made by another program (`data/flight_logs`)"


def generated(name: str) -> FlightLog:
    """A flight log that is shipped."""
    return read_log(shipped("data", "flight_logs", f"{name}.mcap"))


def real_flights(folder: Path | None) -> list[FlightLog]:
    """All flights of a folder with ``fit`` and ``validation``; none where there is no folder."""
    if folder is None:
        return []
    return [read_log(path) for part in ("fit", "validation") for path in sorted((folder / part).glob("*.parquet"))]
