"""Test the importers on randomly damaged recordings of every format; write the result into docs/logs.md.

    python scripts/damage_importers.py [-n 10000] [--seed 0] [-o docs/logs.md]

A damaged file must be refused with a `CfbError`, be read with a warning, or give exactly the undamaged flight. For a
format without checksums the reader notes that it has none; if there is no such note either, a change counts as unseen.
No log may have values that no flight can have. The exit status is 1 if anything else happens, if a file takes more than
20 s, or if the process grows by 1 GB.
"""

from __future__ import annotations

import argparse
import collections
import resource
import sys
import tempfile
import time
import warnings
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests" / "logs"))
import foreign_logs  # noqa: E402
from marked_block import write_block  # noqa: E402
from synthetic_logs import make_flight  # noqa: E402

from cfb_mjx.errors import CfbError  # noqa: E402
from cfb_mjx.logs import read_log, write_mcap, write_tabular  # noqa: E402
from cfb_mjx.logs.flight_log import OPTIONAL, REQUIRED  # noqa: E402

CHECKED = ("micro SD card", "MCAP bag", "MCAP of JSON", "own MCAP", "own parquet", "npz")
"""Formats with checksums that cover every value."""
SLOW, LARGE = 20.0, 1 << 30


def samples(folder: Path) -> dict[str, list[tuple[Path, dict]]]:
    """Write small undamaged files of every format; return their paths with the options to read them."""
    flight = make_flight(duration=0.4, rate=100.0)
    imu, motors, state = (list(v) for v in (foreign_logs.IMU, foreign_logs.MOTOR, foreign_logs.STATE))
    everything = foreign_logs.STATE | foreign_logs.IMU | foreign_logs.MOTOR | foreign_logs.RPM | foreign_logs.BATTERY
    events = [
        foreign_logs.event(flight, foreign_logs.IMU | foreign_logs.MOTOR),
        foreign_logs.event(flight, foreign_logs.STATE, name="estimate", identifier=5, every=2, delay=0.001),
    ]
    files = {
        "new.usd": foreign_logs.usd_card_bytes([foreign_logs.event(flight, everything)]),
        "events.usd": foreign_logs.usd_card_bytes(events),
        "old.usd": foreign_logs.usd_card_bytes([foreign_logs.event(flight, everything)], version=1),
        "flight.ulg": foreign_logs.ulog(flight),
    }
    for name, data in files.items():
        (folder / name).write_bytes(data)
    bag = foreign_logs.Bag()
    bag.custom("/cf231/imu", flight, imu + motors)
    bag.custom("/cf231/state", flight, state)
    bag.pose("/cf231/pose", flight)
    bag.write(folder / "bag.mcap")
    messages = sorted(bag.messages, key=lambda m: m[0])
    topics, launch = folder / "crazyflies.yaml", folder / "launch.yaml"
    foreign_logs.write_crazyflies_yaml(topics, {"imu": imu + motors, "state": state})
    launch.write_text(
        f"genericLogTopic_imu_Variables: {imu + motors}\ngenericLogTopic_state_Variables: {state}\n", encoding="utf-8"
    )
    foreign_logs.write_sqlite(folder / "bag", messages, 32)
    (database,) = (folder / "bag").glob("*.db3")
    foreign_logs.write_ros1(folder / "flight.bag", messages)
    foreign_logs.write_radio_csv(folder / "dense.csv", flight, [state + imu + motors])
    foreign_logs.write_radio_csv(folder / "sparse.csv", flight, [state, imu, motors], every=[2, 1, 1])
    foreign_logs.write_channels(folder / "json.mcap", foreign_logs.json_channels(flight))
    write_mcap(flight, folder / "ours.mcap")
    for name in ("ours.parquet", "ours.csv"):
        write_tabular(flight, folder / name)
    import pyarrow.parquet as pq

    table = pq.read_table(folder / "ours.parquet")
    pq.write_table(table, folder / "plain.parquet", compression="none")
    np.savez(folder / "flight.npz", **{name: table[name].to_numpy() for name in table.column_names})
    return {
        "micro SD card": [(folder / name, {}) for name in files if name.endswith("usd")],
        "MCAP bag": [(folder / "bag.mcap", {"topics_yaml": topics})],
        "MCAP of JSON": [(folder / "json.mcap", {})],
        "own MCAP": [(folder / "ours.mcap", {})],
        "own parquet": [(folder / "ours.parquet", {})],
        "npz": [(folder / "flight.npz", {})],
        "sqlite3 bag": [(database, {"topics_yaml": topics})],
        "ROS 1 bag": [(folder / "flight.bag", {"topics_yaml": launch})],
        "ULog": [(folder / "flight.ulg", {})],
        "parquet without checksums": [(folder / "plain.parquet", {})],
        "radio csv": [(folder / "dense.csv", {}), (folder / "sparse.csv", {})],
        "tabular csv": [(folder / "ours.csv", {})],
    }


def damaged(data: bytes, rng: np.random.Generator) -> bytes:
    """Damage a file one to three times: change a bit or byte, truncate it, or remove, repeat or overwrite a piece."""
    out = bytearray(data)
    for _ in range(rng.integers(1, 4)):
        if not out:
            break
        at, length = int(rng.integers(len(out))), int(rng.integers(1, 200))
        match rng.integers(7):
            case 0:
                out[at] ^= 1 << int(rng.integers(8))
            case 1:
                out[at] = int(rng.integers(256))
            case 2:
                out = out[:at]
            case 3:
                del out[at : at + length]
            case 4:
                out[at:at] = out[at : at + length]
            case 5:
                out[at : at + length] = bytes(len(out[at : at + length]))
            case 6:
                out[at : at + length] = rng.bytes(len(out[at : at + length]))
    return bytes(out)


def same(a, b) -> bool:
    """Whether two logs have the same data, bit for bit, NaN included."""
    for field in (*REQUIRED, *OPTIONAL):
        x, y = getattr(a, field), getattr(b, field)
        if (x is None) != (y is None) or (x is not None and x.tobytes() != y.tobytes()):
            return False
    return True


def plausible(log) -> bool:
    """Whether the values of a log are possible in a flight."""
    limits = {"position": 1e4, "velocity": 60.0, "body_rate": 70.0, "specific_force": 320.0}
    return all(np.abs(getattr(log, f)).max() <= limit for f, limit in limits.items())


def outcome_of(path: Path, options: dict, truth) -> tuple[str, str]:
    """Read a damaged file; return the outcome, and the fault of the reader or an empty string."""
    began = time.monotonic()
    try:
        log = read_log(path, **options)
    except CfbError as error:
        found = "refused", "a message of several lines" if "\n" in str(error) else ""
    except Exception as error:  # a fault of the reader
        found = "crashed", f"{type(error).__name__}: {error}"
    else:
        told = [*(log.metadata.get("warnings") or ())]
        unsure = any("no checksums" in note for note in log.metadata.get("notes") or ())
        changed = "said to have no checksums" if unsure else "unseen"
        outcome = "warned" if told else "unchanged" if same(log, truth) else changed
        found = outcome, "" if plausible(log) else "values that no flight has"
    if time.monotonic() - began > SLOW:
        return found[0], f"took {time.monotonic() - began:.0f} s"
    return found


def main() -> int:
    """Damage and read the files, count the outcomes, and write the block of the page."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-n", type=int, default=10_000, help="number of damaged files")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("-o", "--output", type=Path, default=ROOT / "docs" / "logs.md")
    arguments = parser.parse_args()
    warnings.simplefilter("error")
    rng = np.random.default_rng(arguments.seed)
    counts: dict[str, collections.Counter] = collections.defaultdict(collections.Counter)
    failures, slowest, before = [], 0.0, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with tempfile.TemporaryDirectory() as name:
        formats = samples(Path(name))
        for format, files in formats.items():
            originals = [(p.read_bytes(), read_log(p, **o), p, o) for p, o in files]
            for k in range(-(-arguments.n // len(formats))):
                data, truth, path, options = originals[k % len(originals)]
                path.write_bytes(damaged(data, rng))
                began = time.monotonic()
                outcome, fault = outcome_of(path, options, truth)
                slowest = max(slowest, time.monotonic() - began)
                if outcome == "unseen" and format in CHECKED:
                    fault = "read without a warning, but the data differ"
                if fault:
                    failures.append(f"{path.name} {k}: {fault}")
                counts[format][outcome] += 1
                path.write_bytes(data)
    grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) * 1024
    if grown > LARGE:
        failures.append(f"the process grew by {grown >> 20} MiB")
    text = report(arguments, counts, failures, slowest, grown)
    print(text)
    print("\n".join(failures[:40]))
    write_block(arguments.output, "damage", text)
    return 1 if failures else 0


def report(arguments, counts: dict, failures: list[str], slowest: float, grown: int) -> str:
    """Return the result as a sentence and a table."""
    outcomes = ("refused", "warned", "unchanged", "said to have no checksums", "unseen")
    rows = []
    for format, counter in counts.items():
        checked = "yes" if format in CHECKED else "no"
        rows.append(f"| {format} | {checked} | " + " | ".join(str(counter[o]) for o in outcomes) + " |")
    unchecked = [c for f, c in counts.items() if f not in CHECKED]
    unseen = sum(c["unseen"] for c in unchecked) / max(sum(c.total() for c in unchecked), 1)
    many = f"{sum(c.total() for c in counts.values())} damaged files (seed {arguments.seed}):"
    head = (
        f"{many} nothing but `CfbError` was raised, the slowest took {slowest:.1f} s, the process grew by "
        f"{grown >> 20} MiB; none was read wrongly without a word where there is a checksum; of those without, "
        f"{unseen:.1%} differ unseen, none by values that no flight has."
    )
    table = [f"| format | checksum | {' | '.join(outcomes)} |", "|---|---|" + "---:|" * len(outcomes), *rows]
    return "\n".join([f"{many} {len(failures)} FAILURES." if failures else head, "", *table])


if __name__ == "__main__":
    sys.exit(main())
