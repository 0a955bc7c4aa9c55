"""Commands and measured rotor speeds of single motors, cut at gaps into pieces of equal shape."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import equinox as eqx
import numpy as np
from jaxtyping import Float

from cfb_mjx.logs.bench_tables import MotorRecord
from cfb_mjx.model.state import AnyArray
from cfb_mjx.sysid.identification.flight_data import white_noise

ROWS = 512
"""Rows per piece. As the number of pieces is rounded up to a power of two, most fits share one compiled program."""
FEWEST_PIECES = 32
"""Smallest number of pieces, with padding."""
WARM_UP = 0.2
"""Maximum warm-up of the filter, s, and at most a quarter of a piece; its rows do not count in the likelihood."""
FEWEST_ROWS = 24
"""Smallest number of measured rows in a piece."""


class Tracks(eqx.Module):
    """S pieces of N rows, each of one motor; short pieces are padded with their last row."""

    time: Float[AnyArray, "s n"]
    """Since the piece's first row, s."""
    command: Float[AnyArray, "s n"]
    rotor_speed: Float[AnyArray, "s n"]
    """rad/s; 0 where not measured."""
    measured: Float[AnyArray, "s n"]
    """1 where a rotor speed was measured, except in the padding and in the first row, which initialises the filter."""
    judged: Float[AnyArray, "s n"]
    """1 for measured rows after the warm-up, which count in the likelihood."""


@dataclass(frozen=True)
class MotorData:
    """Tracks of several recordings.

    Attributes:
        tracks: with padding.
        motor: (pieces,) motor number of each piece that is not padding.
        noise: white noise of the rotor speed per row, rad/s, from third differences.
        speed_per_command: median of rotor speed over command, rad/s.
        interval: median time between rows, s.
    """

    tracks: Tracks
    motor: np.ndarray
    noise: float
    speed_per_command: float
    interval: float

    @property
    def rows(self) -> int:
        """Number of rows that count in the likelihood."""
        return int(self.tracks.judged.sum())


def gather(records: Sequence[MotorRecord], motor: int | None = None) -> MotorData | None:
    """Cut recordings into tracks.

    Args:
        records: recordings.
        motor: number of the motor to pick; None: all motors.

    Returns:
        The tracks; None if no stretch is long enough.
    """
    pieces, owners, noise, ratio, interval = [], [], [], [], []
    for record in records:
        for column, number in enumerate(record.motors):
            if motor not in (None, number):
                continue
            command, speed = record.command[:, column], record.rotor_speed[:, column]
            turning = np.isfinite(speed) & (command > 0.05)
            if turning.any():
                ratio.append(np.median(speed[turning] / command[turning]))
            # The noise estimate is a median of differences, so bursts do not affect it.
            noise.append(float(white_noise(speed[np.isfinite(speed), None])[0]))
            for segment in record.segments():
                found = _cut(record.time[segment], command[segment], speed[segment])
                pieces += found
                owners += [number] * len(found)
                interval += [np.median(np.diff(piece["time"])[: piece["rows"] - 1]) for piece in found]
    if not pieces:
        return None
    width = max(FEWEST_PIECES, 1 << (len(pieces) - 1).bit_length())
    blank = {key: np.zeros((width - len(pieces), ROWS)) for key in Tracks.__annotations__}
    tracks = Tracks(**{key: np.concatenate([np.stack([p[key] for p in pieces]), blank[key]]) for key in blank})
    level = np.nanmedian(noise) if np.isfinite(noise).any() else np.nan
    return MotorData(
        tracks,
        np.array(owners),
        float(level) if np.isfinite(level) else 10.0,
        float(np.median(ratio)) if ratio else np.nan,
        float(np.median(interval)),
    )


def _cut(time: np.ndarray, command: np.ndarray, speed: np.ndarray) -> list[dict]:
    """Cut a gap-free stretch of one motor into pieces that overlap by the warm-up; each row counts at most once."""
    found, first, judged_from = [], 0, None
    known = np.isfinite(speed)
    while first < len(time) and known[first:].any():
        first += int(np.argmax(known[first:]))
        last = min(first + ROWS, len(time))
        lead = min(int(np.searchsorted(time[first:last] - time[first], WARM_UP)), ROWS // 4)
        if judged_from is None:
            judged_from = first + min(lead, (last - first) // 4)
        if known[first:last].sum() >= FEWEST_ROWS:
            rows = slice(first, last)
            skipped = max(judged_from - first, 2)
            found.append(_pad(time[rows] - time[first], command[rows], speed[rows], skipped))
        if last == len(time):
            break
        first, judged_from = last - lead, last
    return found


def _pad(time: np.ndarray, command: np.ndarray, speed: np.ndarray, lead: int) -> dict:
    count = len(time)

    def pad(values):
        return np.concatenate([values, np.full(ROWS - count, values[-1])])

    measured = np.isfinite(speed).astype(float)
    measured[0] = 0.0
    flags = np.concatenate([measured, np.zeros(ROWS - count)])
    return {
        "time": pad(time),
        "command": pad(command),
        "rotor_speed": pad(np.nan_to_num(speed)),
        "measured": flags,
        "judged": flags * (np.arange(ROWS) >= lead),
        "rows": count,
    }
