"""Read files about motors and rotors: bench tables, recognised by their columns, and flights."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from cfb_mjx.errors import CfbError
from cfb_mjx.files import read_bytes
from cfb_mjx.logs.bench_layouts import Bench, read_bench_table, recognises
from cfb_mjx.logs.bench_tables import MapTable, MotorRecord, SteadyPoints, ThrustPoints, joined, record_of
from cfb_mjx.logs.flight_log import FlightLog
from cfb_mjx.logs.reading import read_log
from cfb_mjx.logs.tabular import read_table


@dataclass(frozen=True)
class RotorFiles:
    """Data of motors and rotors from several files.

    Attributes:
        records: time series of motors, from flights and benches.
        tables: steady force and torque against rotor speed.
        points: steady rotor speeds against command.
        flights: the flight logs among the files.
        notes: what the readers did, in words.
    """

    records: list[MotorRecord] = field(default_factory=list)
    tables: list[MapTable] = field(default_factory=list)
    points: list[SteadyPoints] = field(default_factory=list)
    flights: list[FlightLog] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


def read_rotor_files(paths: Sequence[Path], rotors: int | None = None) -> RotorFiles:
    """Read flights and bench tables.

    Args:
        paths: flights and bench tables, in any order.
        rotors: number of rotors that produce the measured force and torque; None: as in `read_bench_table`.

    Returns:
        The data of all files.

    Raises:
        CfbError: a file is neither a flight nor a bench table, or a flight has no rotor speeds.
    """
    found, thrust = RotorFiles(), []
    for path in paths:
        bench = _bench(path, rotors)
        if bench is None:
            log = read_log(path, keep_ground=True)
            record = record_of(log)
            if record is None:
                raise CfbError(f"{path}: holds no rotor speeds; log them, or leave this flight out.")
            bench = Bench([record], [])
            found.flights.append(log)
        found.notes.extend(bench.notes)
        for part in bench.parts:
            kinds = {MapTable: found.tables, SteadyPoints: found.points, ThrustPoints: thrust}
            kinds.get(type(part), found.records).append(part)
    found.tables.extend(joined(part, found.points, rotors, found.notes) for part in thrust)
    return found


def _bench(path: Path, rotors: int | None) -> Bench | None:
    """Content of a bench table; None if the file is not one."""
    head = read_bytes(path, 4)
    if path.suffix.lower() not in (".csv", ".txt", ".tsv", ".parquet") and head != b"PAR1":
        return None
    table = read_table(path)
    return read_bench_table(table, path, rotors) if recognises(table) else None
