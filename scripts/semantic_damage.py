"""Test the check of flights on logs whose signals contradict each other; write the result into a page.

    python scripts/semantic_damage.py [FLIGHT...] [-n 20] [-o docs/logs.md] [--unseen]

FLIGHT are recordings of real drones or of any simulator; the default is the shipped flights. Every contradiction of
``tests/logs/contradictions.py`` is applied to N of them, evenly spread over the list. All are also read undamaged, to
count false alarms. With ``--unseen``, for flights on which no threshold was chosen, only the totals are written. The
exit status is 1 if fewer than 95 % of the visible contradictions are noticed, or if there is a false alarm.
"""

from __future__ import annotations

import argparse
import sys
from collections import defaultdict
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests" / "logs"))
from contradictions import CONTRADICTIONS, shows  # noqa: E402
from marked_block import write_block  # noqa: E402

from cfb_mjx.errors import CfbError  # noqa: E402
from cfb_mjx.logs import FlightLog, read_log, validate  # noqa: E402


def noticed(log: FlightLog) -> str | None:
    """Return the message of the check, or None."""
    try:
        checked = validate(log, "flight")
    except CfbError as error:
        return str(error)
    doubts = [w for w in checked.metadata.get("warnings") or () if "contradict" in w]
    return doubts[0] if doubts else None


def main() -> int:
    """Run the study and write the block of the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("flights", nargs="*", type=Path)
    parser.add_argument("-n", type=int, default=20, help="number of flights to damage")
    parser.add_argument("-o", "--output", type=Path, default=ROOT / "docs" / "logs.md")
    parser.add_argument("--unseen", action="store_true", help="no threshold was chosen on these flights")
    arguments = parser.parse_args()
    paths = arguments.flights or sorted((ROOT / "data" / "flight_logs").glob("*.mcap"))
    logs, alarms = [], []
    for path in paths:
        try:
            log = read_log(path)
        except CfbError as error:
            alarms.append(str(error))
            continue
        if noticed(log) or any("contradict" in w for w in log.metadata.get("warnings") or ()):
            alarms.append(f"{path.name}: {noticed(log)}")
        else:
            logs.append(log)
    chosen = [logs[i] for i in np.unique(np.linspace(0, len(logs) - 1, arguments.n).round().astype(int))]
    # Visible, noticed, right advice; noticed although not visible.
    counts: dict[str, list[int]] = defaultdict(lambda: [0, 0, 0, 0])
    for name, contradiction in CONTRADICTIONS.items():
        for log in chosen:
            said = noticed(contradiction.change(log))
            if not shows(log, contradiction):
                counts[name][3] += said is not None
                continue
            counts[name][0] += 1
            counts[name][1] += said is not None
            right = said is not None and any(a in said for a in contradiction.advice)
            counts[name][2] += right
            if not right:
                print(f"{name} in {log.name}: {said}")
    total = np.array(list(counts.values())).sum(axis=0)
    rows = [f"| {name} | {c[0]} | {c[1]} | {c[2]} |" for name, c in counts.items()]
    said = (
        f"{len(CONTRADICTIONS)} contradictions in {len(chosen)} flights each: of {total[0]} that show (the flight "
        f"moves along the axis in question) {total[1]} were noticed ({total[1] / total[0]:.1%}), {total[2]} with the "
        f"right advice ({total[2] / total[0]:.1%}). False alarms: {len(alarms)} of {len(paths)} undamaged flights."
    )
    table = ["", "| contradiction | shows in | noticed | right advice |", "|---|---:|---:|---:|", *rows]
    text = said if arguments.unseen else "\n".join([said, *table])
    print(text)
    for alarm in alarms:
        print("FALSE ALARM", alarm)
    write_block(arguments.output, "contradictions-unseen" if arguments.unseen else "contradictions", text)
    return int(total[1] < 0.95 * total[0] or len(alarms) > 0)


if __name__ == "__main__":
    sys.exit(main())
