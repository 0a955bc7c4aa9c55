"""Compare the Crazyflie's own estimate with motion capture in the same files; write a table into docs/logs.md.

    python scripts/estimates.py NAME=FOLDER ...

All files below FOLDER that hold both are used. Only medians over flights are written; the flights do not become part of
the project.
"""

import argparse
from pathlib import Path

import numpy as np
from marked_block import write_block
from scipy.linalg import polar

from cfb_mjx.errors import CfbError
from cfb_mjx.logs import FlightLog, motion_capture, read_log
from cfb_mjx.runtime import environment

ROOT = Path(__file__).resolve().parents[1]
SPAN, TURNING = 0.4, 0.1
"""Interval over which an attitude is compared with the gyro, s, and the least rotation in it, rad rms."""


def turned(log: FlightLog) -> np.ndarray:
    """Return the ratio of the attitude's rotation to the gyro's about body x and y, shape (2,).

    It is the symmetric part of the linear map from the gyro's rotations to those of the attitude, so the ratio does not
    depend on the axes of the attitude.
    """
    gyro, pose = motion_capture.turned_by_gyro(log), motion_capture.Capture(log.time, log.position, log.quaternion)
    late = motion_capture.delay_behind(log, gyro, pose)
    x, y = motion_capture.turns(log, gyro, pose, late, SPAN)
    mapped = np.linalg.lstsq(np.column_stack([x, np.ones(len(x))]), y, rcond=None)[0][:3].T
    stretch = np.diag(polar(mapped)[1])[:2]
    return np.where(np.std(x, axis=0)[:2] > TURNING, stretch, np.nan)


def ratios(path: Path) -> list[float] | None:
    """Return ratios of estimate to motion capture (tilt, horizontal speed, climb) and to the gyro (rotations)."""
    try:
        estimate, captured = read_log(path), read_log(path, motion_capture=True)
    except CfbError as error:
        print(f"{path}: {error}")
        return None
    rows = np.searchsorted(estimate.time, captured.time)
    pairs = [
        [motion_capture.lean(q) for q in (estimate.quaternion[rows], captured.quaternion)],
        [log[:, :2] for log in (estimate.velocity[rows], captured.velocity)],
        [log[:, 2:] for log in (estimate.velocity[rows], captured.velocity)],
    ]
    return [*(float(np.sum(a * b) / np.sum(b * b)) for a, b in pairs), *turned(estimate), *turned(captured)]


def main(folders: dict[str, Path]) -> None:
    columns = "leans", "moves", "climbs", "turns about x", "about y", "capture turns about x", "about y"
    lines = [f"| | flights | {' | '.join(columns)} |", f"|---|---:|{'---:|' * len(columns)}"]
    for name, folder in folders.items():
        found = [r for path in sorted(folder.rglob("*")) if path.is_file() and (r := ratios(path)) is not None]
        cells = []
        for column in np.array(found).T:
            told = column[np.isfinite(column)]
            error = 1.25 * np.std(told) / np.sqrt(len(told))
            cells.append(f"{np.median(told):.3f} ± {error:.3f}")
        lines.append(f"| {name} | {len(found)} | {' | '.join(cells)} |")
    said = environment()
    lines += ["", f"Written by `scripts/estimates.py` on {said['date']} with cfb_mjx {said['cfb_mjx']}."]
    write_block(ROOT / "docs" / "logs.md", "estimates", "\n".join(lines))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="+", metavar="NAME=FOLDER")
    main({name: Path(folder) for name, _, folder in (x.partition("=") for x in parser.parse_args().folders)})
