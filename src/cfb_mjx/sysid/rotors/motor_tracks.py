"""Commands and measured rotor speeds of single motors, cut at gaps into pieces of one shape."""

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
"""Rows of a piece. With the number of pieces rounded up to a power of two, most fits share one compiled program."""
FEWEST_PIECES = 32
WARM_UP = 0.2
"""At most this long, s, and at most a quarter of a piece: the rows in which a filter finds its state are not judged."""
FEWEST_ROWS = 24


class Tracks(eqx.Module):
    """S pieces, each of one motor, N rows; the last row of a short piece is repeated."""

    time: Float[AnyArray, "s n"]
    """Since the piece's first row, s."""
    command: Float[AnyArray, "s n"]
    rotor_speed: Float[AnyArray, "s n"]
    """rad/s; 0 where not measured."""
    measured: Float[AnyArray, "s n"]
    """1 where a rotor speed was measured; 0 elsewhere, in the padding and at the first row, which starts the filter."""
    judged: Float[AnyArray, "s n"]
    """1 for measured rows behind the warm-up."""


@dataclass(frozen=True)
class MotorData:
    """Tracks of several recordings together, and where each comes from.

    Attributes:
        tracks: padded.
        motor: (pieces,) motor number of the tracks that are not padding.
        noise: white noise of a rotor speed row, rad/s, seen in third differences.
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
        """Rows that are judged."""
        return int(self.tracks.judged.sum())


def gather(records: Sequence[MotorRecord], motor: int | None = None) -> MotorData | None:
    """Cut recordings into tracks; ``motor`` picks one motor. None where nothing long enough is left."""
    pieces, owners, noise, ratio, interval = [], [], [], [], []
    for record in records:
        for column, number in enumerate(record.motors):
            if motor not in (None, number):
                continue
            command, speed = record.command[:, column], record.rotor_speed[:, column]
            turning = np.isfinite(speed) & (command > 0.05)
            if turning.any():
                ratio.append(np.median(speed[turning] / command[turning]))
            # Bursts leave the median of the differences alone; missing readings are left out.
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
    """Pieces of one motor's gapless stretch, overlapping by their warm-up; every row is judged once at most."""
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
