"""Measure how the time and memory of the commands on flight logs grow with the length and the number of logs.

    python benchmarks/growth.py [--quick] [--commands evaluate fit] [--flights FOLDER ...] [--limit 300]

Writes ``benchmarks/growth.json`` and the block ``growth`` of ``docs/performance.md``. Every number comes from a process
of its own. The logs are real 500 Hz flights where FOLDER holds some, else flights of the reference simulator; they are
cut, joined with pauses and repeated to the wanted length. Cases that were measured before are measured anew; with
``--commands`` the other commands keep the numbers in the file, and the machine that they were measured on.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT / "scripts")]
FILE, PAGE = ROOT / "benchmarks" / "growth.json", ROOT / "docs" / "performance.md"
# The measuring process loads no library, because a process inherits the peak memory of the one that started it.
LENGTHS, COUNTS = (5, 15, 60, 300, 1800), (4, 10, 20, 40)
EACH = 6
"""Length of each log where the number of logs grows, s."""
JUDGED = 15
"""Length of the log that the effects found by close-loop are tested on, s."""
LIMIT = 300
PAUSE = 0.5
"""Pause between two flights that are joined, s: longer than any step between two rows, so a gap."""
FLIGHTS = (ROOT.parent / "shared" / "real2" / "campaign_a" / "fit", ROOT.parent / "shared" / "real2" / "campaign_a")
REFERENCE = "flights of the reference simulator, 500 Hz"
COMMANDS = ("evaluate", "fit", "refine", "close-loop")
LEAST = {"close-loop": 10}
"""Shortest total length of the logs that a command takes, s."""
MASS = ("--set", "mass=0.037")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="measure the two shortest cases of each series only")
    parser.add_argument("--commands", nargs="+", choices=COMMANDS, default=COMMANDS)
    parser.add_argument("--limit", type=float, default=LIMIT, help="seconds after which a run is ended")
    parser.add_argument("--flights", type=Path, nargs="*", default=[FLIGHTS[0], FLIGHTS[1] / "validation"])
    parser.add_argument("--json", type=Path, default=FILE)
    parser.add_argument("--page", type=Path, default=PAGE)
    parser.add_argument("--make", type=Path, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.make is not None:
        print(make_logs(arguments.flights, arguments.make, arguments.quick))
        return
    old = json.loads(arguments.json.read_text()) if arguments.json.exists() else {}
    with tempfile.TemporaryDirectory(prefix="cfb-growth-") as folder:
        results = measure(Path(folder), arguments, old)
    write(results, arguments.json, arguments.page)
    print(section(results))


def measure(folder: Path, arguments: argparse.Namespace, old: dict) -> dict:
    """Measure the commands that were asked for.

    Args:
        folder: an empty folder for logs, caches and results.
        arguments: of the command line.
        old: earlier results, of which those of other commands are kept.
    """
    logs = folder / "logs"
    logs.mkdir()
    make = [sys.executable, __file__, "--make", str(logs), "--flights", *map(str, arguments.flights)]
    source = subprocess.run(
        [*make, *(["--quick"] if arguments.quick else [])], check=True, capture_output=True, text=True
    ).stdout.strip()
    rows = [row for row in old.get("rows", []) if row["command"] not in arguments.commands]
    for name in arguments.commands:
        for series in ("length", "logs"):
            rows += _series(name, series, folder, arguments)
    facts = "import json; from cfb_mjx.runtime import environment; print(json.dumps(environment()))"
    conditions = {
        "environment": json.loads(subprocess.run([sys.executable, "-c", facts], capture_output=True, text=True).stdout),
        "flights": source,
        "limit_s": arguments.limit,
        "cores": len(os.sched_getaffinity(0)),
    }
    return {
        "conditions": old.get("conditions", {}) | dict.fromkeys(arguments.commands, conditions),
        "each_s": EACH,
        "rows": sorted(rows, key=lambda row: COMMANDS.index(row["command"])),
    }


def _series(name: str, series: str, folder: Path, arguments: argparse.Namespace) -> list[dict]:
    """Rows of one command while the length of a log, or the number of logs, grows.

    All cases of a series share a compile cache, which is empty at first: the first run of a later case shows what its
    size makes compile anew.
    """
    rows, late = [], False
    cache = folder / f"cache-{name}-{series}"
    for size in sizes(series, arguments.quick):
        row = {"command": name, "series": series, "size": size, "flight_s": size if series == "length" else EACH * size}
        if row["flight_s"] < LEAST.get(name, 0):
            continue
        rows.append(row)
        if late:
            row["skipped"] = True
            continue
        environment = os.environ | {"JAX_COMPILATION_CACHE_DIR": str(cache)}
        for run in ("first", "again"):
            with tempfile.TemporaryDirectory(dir=folder) as out:
                line = [sys.executable, "-m", "cfb_mjx.cli", *words(name, series, size, folder / "logs", Path(out))]
                row[run] = timed(line, arguments.limit, environment)
            print(name, series, size, run, row[run], file=sys.stderr, flush=True)
            # A run that was ended says nothing about the next, which has more of the cache.
            late = row[run]["late"]
    return rows


def sizes(series: str, quick: bool) -> tuple[int, ...]:
    """Lengths, s, or numbers of logs, ascending."""
    return (LENGTHS if series == "length" else COUNTS)[: 2 if quick else None]


def words(name: str, series: str, size: int, logs: Path, out: Path) -> list[str]:
    """The words of a ``cfb`` command on the logs of a case."""
    used = [logs / f"long{size}.mcap"] if series == "length" else [logs / f"log{i:02d}.mcap" for i in range(size)]
    paths = [str(path) for path in used]
    return {
        "evaluate": ["evaluate", *paths, *MASS, "--json", str(out / "errors.json")],
        "fit": ["fit", *paths, *MASS, "-o", str(out / "fitted.yaml"), "--parameters", "thrust_scale,motor_gain,cog"],
        "refine": ["refine", *paths, *MASS, "-o", str(out / "refined.yaml"), "--effects", "plant"],
        "close-loop": [
            *("close-loop", "--fit", *paths, "--held-out", str(logs / "judged.mcap"), *MASS),
            *("-o", str(out / "closed")),
        ],
    }[name]


def timed(line: list[str], limit: float, environment: dict[str, str]) -> dict:
    """Run a process to its end, or until a limit, s.

    Returns:
        ``wall_s``, ``cpu_s`` (user and system), ``peak_mb`` (the largest resident memory), ``status`` and ``late``
        (whether it was ended at the limit).
    """
    late = threading.Event()
    with tempfile.TemporaryFile() as said:
        begin = time.perf_counter()
        process = subprocess.Popen(line, env=environment, stdout=subprocess.DEVNULL, stderr=said)

        def end() -> None:
            late.set()
            process.kill()

        clock = threading.Timer(limit, end)
        clock.start()
        # The usage of this process alone; the sum over all children says nothing about the memory of one.
        _, status, usage = os.wait4(process.pid, 0)
        seconds = time.perf_counter() - begin
        clock.cancel()
        process.returncode = os.waitstatus_to_exitcode(status)
        if process.returncode and not late.is_set():
            said.seek(0)
            sys.exit(f"{' '.join(line)}: exit status {process.returncode}\n{said.read().decode()}")
    return {
        "wall_s": seconds,
        "cpu_s": usage.ru_utime + usage.ru_stime,
        "peak_mb": usage.ru_maxrss / (1e6 if sys.platform == "darwin" else 1e3),
        "late": late.is_set(),
    }


# ------------------------------------------------------------------------------------------------ the logs


def make_logs(folders: list[Path], out: Path, quick: bool) -> str:
    """Write the logs of all cases; return what they were made of."""
    from cfb_mjx.logs import read_log, write_mcap

    paths = sorted(path for folder in folders if folder.is_dir() for path in folder.iterdir())
    if paths:
        flights, source = [read_log(path) for path in paths], f"{len(paths)} real flights, 500 Hz"
    else:
        flights, source = reference_flights(), REFERENCE
    for seconds in sizes("length", quick):
        write_mcap(joined(flights, seconds, f"long{seconds}"), out / f"long{seconds}.mcap")
    for i in range(max(sizes("logs", quick))):
        write_mcap(joined(flights, EACH, f"log{i:02d}", i), out / f"log{i:02d}.mcap")
    write_mcap(joined(flights, JUDGED, "judged", len(flights) // 2), out / "judged.mcap")
    return source


def reference_flights():
    """Flights of one drone of the reference simulator, with rows every 2 ms."""
    from cfb_mjx.reference_simulator import Case, fly_campaigns

    campaign = fly_campaigns([Case("growth", 1)])[0]
    return [resampled(log) for log in (*campaign.fit, *campaign.held_out)]


def resampled(log, step: float = 0.002):
    """A log with rows every ``step`` seconds, which changes its size but not what it says."""
    import numpy as np

    time = np.arange(log.time[0], log.time[-1], step)
    names = [name for name in FIELDS if getattr(log, name) is not None]

    def at(values):
        flat = values.reshape(len(values), -1)
        return np.stack([np.interp(time, log.time, x) for x in flat.T], axis=1).reshape(-1, *values.shape[1:])

    found = {name: at(getattr(log, name)) for name in names}
    found["quaternion"] = found["quaternion"] / np.linalg.norm(found["quaternion"], axis=1, keepdims=True)
    return log.replace(time=time, **found)


FIELDS = (
    *("position", "velocity", "quaternion", "body_rate", "specific_force", "command"),
    *("rotor_speed", "battery_voltage"),
)


def joined(flights, seconds: float, name: str, first: int = 0):
    """A log of some length made of flights one after the other, with pauses between them.

    Args:
        flights: to join, again from the first one after the last.
        seconds: length of the result.
        name: of the result.
        first: index of the flight to begin with.
    """
    import numpy as np

    from cfb_mjx.logs import FlightLog

    parts, at, i, rng = [], 0.0, first, np.random.default_rng(first)
    while at < seconds:
        flight = flights[i % len(flights)]
        if i - first >= len(flights):
            # A log whose rows repeat earlier ones to the last bit is refused.
            changed = {name: getattr(flight, name) for name in ("position", "velocity", "body_rate", "specific_force")}
            flight = flight.replace(**{k: v + 1e-6 * rng.standard_normal(v.shape) for k, v in changed.items()})
        flight = flight.slice(flight.time[0], flight.time[0] + seconds - at)
        if len(flight) > 1:
            parts.append((flight.time - flight.time[0] + at, flight))
        at, i = at + flight.duration + PAUSE, i + 1
    names = [field for field in FIELDS if all(getattr(flight, field) is not None for _, flight in parts)]
    return FlightLog(
        time=np.concatenate([time for time, _ in parts]),
        **{field: np.concatenate([getattr(flight, field) for _, flight in parts]) for field in names},
        metadata={"name": name, "observation_delay": flights[0].observation_delay},
    )


# ------------------------------------------------------------------------------------------------ the page


def slopes(rows: list[dict], key: str) -> tuple[float, float] | None:
    """Slope of a number over the length of flight, both as logarithms: of all points, and of the last two.

    None if fewer than two cases were measured to their end.
    """
    points = [
        (math.log(row["flight_s"]), math.log(row["again"][key]))
        for row in rows
        if not row.get("skipped") and not row.get("again", {"late": True})["late"]
    ]
    if len(points) < 2:
        return None
    middle = [sum(x) / len(points) for x in zip(*points, strict=True)]
    over = sum((x - middle[0]) * (y - middle[1]) for x, y in points) / sum((x - middle[0]) ** 2 for x, _ in points)
    (x0, y0), (x1, y1) = points[-2:]
    return over, (y1 - y0) / (x1 - x0)


def section(results: dict) -> str:
    """Return the section on growth, as Markdown."""
    from campaign import measured_on

    conditions = {name: results["conditions"][name] for name in COMMANDS if name in results["conditions"]}
    lines = []
    for name in COMMANDS:
        for series in ("length", "logs"):
            rows = [row for row in results["rows"] if (row["command"], row["series"]) == (name, series)]
            lines += [_line(row, conditions[name]["limit_s"]) for row in rows]
    grown = []
    for name in COMMANDS:
        for series, what in (("length", "length of a log"), ("logs", "number of logs")):
            rows = [row for row in results["rows"] if (row["command"], row["series"]) == (name, series)]
            cells = [
                "" if found is None else f"{found[0]:.2f} | {found[1]:.2f}"
                for found in (slopes(rows, key) for key in ("wall_s", "cpu_s", "peak_mb"))
            ]
            if all(cells):
                grown.append(f"| `cfb {name}` | {what} | {' | '.join(cells)} |")
    facts = measured_on({f"`cfb {name}`": of["environment"] | _limits(of) for name, of in conditions.items()})
    head = "| command | what grows | wall, all | last two | CPU, all | last two | memory, all | last two |"
    return f"""## How cost grows with the flights

Written by `python benchmarks/growth.py`. {facts}.

The logs are joined with pauses of {PAUSE:g} s and repeated to the length. Where the number of logs grows, each is
{results["each_s"]:g} s long. Every number is of a process of its own. *First* and *again* are two runs of the same
command. The cache of compiled programs is empty before the first row of a command and kind of growth; the
difference between the two runs is what is compiled. After a run that was ended, larger cases are left out.

| command | logs | flight, s | first, s | again, s | CPU again, s | compiling, CPU s | memory, MB |
|---|---:|---:|---:|---:|---:|---:|---:|
{chr(10).join(lines)}

Slopes of the logarithm of the cost (*again*) over that of the length of flight, by least squares over all cases, and
between the last two: 1 is linear, less is sublinear because of what every process does once (loading, tracing).

{head}
|---|---|---:|---:|---:|---:|---:|---:|
{chr(10).join(grown)}
"""


def _limits(conditions: dict) -> dict[str, str]:
    return {
        "bound to": f"{conditions['cores']} core(s)",
        "runs ended after": f"{conditions['limit_s']:g} s",
        "logs of": conditions["flights"],
    }


def _line(row: dict, limit: float) -> str:
    logs = 1 if row["series"] == "length" else row["size"]
    begin = f"| `cfb {row['command']}` | {logs} | {row['flight_s']} |"
    if row.get("skipped"):
        return f"{begin} left out | | | | |"
    first, again = row["first"], row.get("again")

    def wall(run):
        return "" if run is None else f"over {limit:g}" if run["late"] else f"{run['wall_s']:.1f}"

    if again is None or again["late"] or first["late"]:
        peak = max(run["peak_mb"] for run in (first, again or first))
        rest = f"| | {peak:.0f}"
        if again is not None and not again["late"]:
            rest = f"{again['cpu_s']:.1f} | | {again['peak_mb']:.0f}"
        return f"{begin} {wall(first)} | {wall(again)} | {rest} |"
    return (
        f"{begin} {wall(first)} | {wall(again)} | {again['cpu_s']:.1f} | {max(0, first['cpu_s'] - again['cpu_s']):.1f} "
        f"| {again['peak_mb']:.0f} |"
    )


def write(results: dict, file: Path, page: Path) -> None:
    """Write the results, and the block of the page."""
    from marked_block import write_block

    from cfb_mjx.files import write_text

    write_text(file, json.dumps(results, indent=1) + "\n")
    write_block(page, "growth", section(results))


if __name__ == "__main__":
    main()
