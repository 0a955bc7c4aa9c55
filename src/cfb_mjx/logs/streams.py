"""Logged variables that arrive in several streams, each with its own time stamps: ordering and holding them."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np

from cfb_mjx.errors import CfbError
from cfb_mjx.logs.gaps import changes, longest_step

_MOSTLY_NEW = 0.7
RADIO_WRAP_MS = 1 << 24  # a log packet carries its time stamp in three bytes of milliseconds: it wraps after 4.7 h


@dataclasses.dataclass(frozen=True)
class Stream:
    """Variables sampled together.

    Attributes:
        name: of the event, log block or topic, for messages and metadata.
        time: (n,) s, increasing, on a clock that all streams of a file share.
        values: logged name to (n,) float64 as logged; NaN where a sample is missing.
        float32: the numbers travelled as float32, so integers above 2^24 have lost their low bits.
        slack: s by which a sample may be stamped after a row and still count as known then.
    """

    name: str
    time: np.ndarray
    values: dict[str, np.ndarray]
    float32: bool = False
    # Half a nanosecond: stamps of one clock may differ by rounding after a change of origin.
    slack: float = 0.5e-9

    @property
    def interval(self) -> float:
        """Median sampling interval, s; 0 for a single sample, which therefore is too old for every later row."""
        return float(np.median(np.diff(self.time))) if len(self.time) > 1 else 0.0

    @property
    def gap_threshold(self) -> float:
        """Two samples further apart than this, s, have a gap between them (as in `FlightLog`)."""
        return longest_step(self.interval)


def unwrap(ticks: np.ndarray, modulus: int) -> tuple[np.ndarray, int]:
    """Undo overflows of a counter: int64 ticks that fall by more than half of ``modulus`` continue above it.

    Returns:
        The continued ticks and the number of overflows.
    """
    steps = np.diff(ticks)
    overflows = steps < -(modulus // 2)
    return ticks + modulus * np.concatenate([[0], np.cumsum(overflows)]), int(overflows.sum())


def ordered(stream: Stream, path: Path, notes: list[str], overtaking: float = 0.0) -> Stream:
    """The stream in order of time, without samples that repeat the time of the one before (counted in ``notes``).

    Args:
        overtaking: s by which a sample may be earlier than the one before and is then put in its place.

    Raises:
        CfbError: time goes back further: the file holds two recordings, or the vehicle restarted.
    """
    steps = np.diff(stream.time)
    if overtaking and (steps < 0).any() and steps.min() >= -overtaking:
        notes.append(f"{stream.name}: {int((steps < 0).sum())} samples arrived out of order and were sorted.")
        order = np.argsort(stream.time, kind="stable")
        stream = dataclasses.replace(
            stream, time=stream.time[order], values={k: v[order] for k, v in stream.values.items()}
        )
        steps = np.diff(stream.time)
    if (steps < 0).any():
        row = int(np.argmax(steps < 0)) + 1
        raise CfbError(
            f"{path}: the time of {stream.name} goes back from {stream.time[row - 1]:.3f} s to {stream.time[row]:.3f} "
            f"s at sample {row} (counted from 0), so the file holds two recordings or the vehicle restarted; split it "
            "there and import the parts one by one."
        )
    if (steps > 0).all():
        return stream
    keep = np.concatenate([[True], steps > 0])
    notes.append(f"{stream.name}: {int((~keep).sum())} samples repeat the time of the one before and were left out.")
    return dataclasses.replace(stream, time=stream.time[keep], values={k: v[keep] for k, v in stream.values.items()})


def hold(stream: Stream, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """For each row time (s) the index of the last sample at or before it (0 where there is none) and its age, s.

    The age is NaN before the first sample and infinite where the sample is older than the stream's gap threshold, so
    that a pause of one stream becomes a gap of the log instead of a frozen value.
    """
    index = np.searchsorted(stream.time, rows + stream.slack, side="right") - 1
    age = np.where(index >= 0, rows - stream.time[np.maximum(index, 0)], np.nan)
    stale = age > stream.gap_threshold
    return np.maximum(index, 0), np.where(stale, np.inf, np.maximum(age, 0.0))


def central_difference(stream: Stream, values: np.ndarray) -> np.ndarray:
    """Derivative of ``values`` (n, ...) over the stream's own samples: central inside, one-sided beside gaps, NaN if
    alone."""
    before, after, span = neighbours(stream)
    span = np.where(span > 0, span, np.nan).reshape(-1, *[1] * (values.ndim - 1))
    return (values[after] - values[before]) / span


def neighbours(stream: Stream) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """For each sample the one before and the one after, itself where a gap or the end is there, and the s between."""
    t, n = stream.time, len(stream.time)
    inside = np.diff(t) <= stream.gap_threshold  # whether sample i and i + 1 belong together
    before = np.where(np.concatenate([[False], inside]), np.arange(n) - 1, np.arange(n))
    after = np.where(np.concatenate([inside, [False]]), np.arange(n) + 1, np.arange(n))
    return before, after, t[after] - t[before]


def fresh(values: np.ndarray) -> np.ndarray:
    """Which samples of (n, columns) are new where most only repeat the one before; all are, where most are not.

    A value that the firmware updates at 100 Hz and logs at 500 Hz has steps, whose differences mean nothing.
    """
    new = changes(values)
    return new if new.mean() < _MOSTLY_NEW and new.sum() > 2 else np.ones(len(values), dtype=bool)
