"""Damage logs of other formats at random and see what the importers make of it; note the result in docs/logs.md.

    python scripts/damage_importers.py [-n 10000] [--seed 0] [-o docs/logs.md]

Every damaged file must be refused with a `CfbError`, be read with an entry in ``metadata["warnings"]``, or give exactly
the undamaged flight. A csv has no checksum, so a changed digit in it cannot be seen; such files are counted apart.
Exits with status 1 if anything else happens.
"""

from __future__ import annotations

import argparse
import collections
import sys
import tempfile
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests" / "logs"))
import foreign_logs  # noqa: E402
from marked_block import write_block  # noqa: E402
from synthetic_logs import make_flight  # noqa: E402

from cfb_mjx.errors import CfbError  # noqa: E402
from cfb_mjx.logs import read_log  # noqa: E402
from cfb_mjx.logs.flight_log import OPTIONAL, REQUIRED  # noqa: E402

SHARES = {"usd_card": 0.5, "crazyswarm": 0.25, "radio_csv": 0.25}
CHECKED = ("usd_card", "crazyswarm")  # formats with a checksum


def samples(folder: Path) -> dict[str, list[tuple[Path, dict]]]:
    """Small undamaged files of every format with the options to read them."""
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
    }
    for name, data in files.items():
        (folder / name).write_bytes(data)
    bag = foreign_logs.Bag()
    bag.custom("/cf231/imu", flight, imu + motors)
    bag.custom("/cf231/state", flight, state)
    bag.pose("/cf231/pose", flight)
    bag.write(folder / "bag.mcap")
    topics = folder / "crazyflies.yaml"
    foreign_logs.write_crazyflies_yaml(topics, {"imu": imu + motors, "state": state})
    foreign_logs.write_radio_csv(folder / "dense.csv", flight, [state + imu + motors])
    foreign_logs.write_radio_csv(folder / "sparse.csv", flight, [state, imu, motors], every=[2, 1, 1])
    return {
        "usd_card": [(folder / name, {}) for name in files],
        "crazyswarm": [(folder / "bag.mcap", {"topics_yaml": topics})],
        "radio_csv": [(folder / "dense.csv", {}), (folder / "sparse.csv", {})],
    }


def damaged(data: bytes, rng: np.random.Generator) -> bytes:
    """One to three of: a bit or byte changed, the end cut off, a piece lost, doubled, blanked or overwritten."""
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
    """Bit for bit the same data, NaN included."""
    for field in (*REQUIRED, *OPTIONAL):
        x, y = getattr(a, field), getattr(b, field)
        if (x is None) != (y is None) or (x is not None and x.tobytes() != y.tobytes()):
            return False
    return True


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-n", type=int, default=10_000, help="how many damaged files")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("-o", "--output", type=Path, default=ROOT / "docs" / "logs.md")
    arguments = parser.parse_args()
    rng = np.random.default_rng(arguments.seed)
    counts = {f: collections.Counter() for f in SHARES}
    failures = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for format, files in samples(folder).items():
            originals = [(p.read_bytes(), read_log(p, **o), p, o) for p, o in files]
            for k in range(round(SHARES[format] * arguments.n)):
                data, truth, path, options = originals[k % len(originals)]
                broken = damaged(data, rng)
                path.write_bytes(broken)
                try:
                    log = read_log(path, format=format, **options)
                except CfbError:
                    outcome = "refused"
                except Exception as error:  # what this script looks for
                    outcome = "crashed"
                    failures.append(f"{path.name} {k}: {type(error).__name__}: {error}")
                else:
                    outcome = "warned" if log.metadata["warnings"] else "unchanged" if same(log, truth) else "unseen"
                    if outcome == "unseen" and format in CHECKED:
                        failures.append(f"{path.name} {k}: read without a warning, but the data differ")
                counts[format][outcome] += 1
                path.write_bytes(data)
    line = report(arguments, counts, failures)
    print(line)
    print("\n".join(failures[:20]))
    write_block(arguments.output, "damage", line)
    return 1 if failures else 0


def report(arguments, counts: dict, failures: list[str]) -> str:
    """The result in one line."""
    parts = []
    for format, counter in counts.items():
        outcomes = ", ".join(f"{counter[o]} {o}" for o in ("refused", "warned", "unchanged", "unseen") if counter[o])
        parts.append(f"{format} {sum(counter.values())} ({outcomes})")
    verdict = "nothing but `CfbError` raised, no unseen change where there is a checksum"
    if failures:
        verdict = f"{len(failures)} FAILURES"
    return f"{arguments.n} damaged files (seed {arguments.seed}): {'; '.join(parts)}; {verdict}."


if __name__ == "__main__":
    sys.exit(main())
