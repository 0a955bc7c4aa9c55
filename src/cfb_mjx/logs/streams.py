"""Streams of logged variables, each with its own time stamps: sorting, holding and differentiating them."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np

from cfb_mjx.errors import CfbError
from cfb_mjx.logs.flight_log import changes, longest_step

_MOSTLY_NEW = 0.7
RADIO_WRAP_MS = 1 << 24  # a log packet has three bytes for its time stamp in ms, which overflows after 4.7 h


@dataclasses.dataclass(frozen=True)
class Stream:
    """Variables sampled together.

    Attributes:
        name: name of the event, log block or topic, for messages and metadata.
        time: (n,) s, increasing, on a clock shared by all streams of a file.
        values: logged name to (n,) float64 as logged; NaN where a sample is missing.
        float32: whether the numbers were transmitted as float32, so that integers above 2^24 lost their low bits.
        slack: s by which the time stamp of a sample may be later than a row that uses it.
    """

    name: str
    time: np.ndarray
    values: dict[str, np.ndarray]
    float32: bool = False
    # Half a nanosecond, because rounding after a change of origin may shift stamps of the same clock.
    slack: float = 0.5e-9

    @property
    def interval(self) -> float:
        """Median sampling interval, s; 0 for a single sample, which makes it too old for every later row."""
        return float(np.median(np.diff(self.time))) if len(self.time) > 1 else 0.0

    @property
    def gap_threshold(self) -> float:
        """Longest step between two samples without a gap, s (as in `FlightLog`)."""
        return longest_step(self.interval)


def unwrap(ticks: np.ndarray, modulus: int) -> tuple[np.ndarray, int]:
    """Undo overflows of a counter: add ``modulus`` from every row where the int64 ticks fall by more than half of it.

    Returns:
        The continued ticks and the number of overflows.
    """
    steps = np.diff(ticks)
    overflows = steps < -(modulus // 2)
    return ticks + modulus * np.concatenate([[0], np.cumsum(overflows)]), int(overflows.sum())


def ordered(stream: Stream, path: Path, notes: list[str], overtaking: float = 0.0) -> Stream:
    """The stream in order of time, without samples that repeat the time of the one before (counted in ``notes``).

    Args:
        stream: the samples as recorded.
        path: the file, for messages.
        notes: receives one line for each change.
        overtaking: s by which a sample may be earlier than the one before; such samples are sorted.

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
    """For each row time (s), the index of the last sample at or before it (0 if there is none) and its age, s.

    The age is NaN before the first sample, and infinite if the sample is older than the stream's gap threshold. A
    pause of one stream therefore becomes a gap of the log, not a frozen value.
    """
    index = np.searchsorted(stream.time, rows + stream.slack, side="right") - 1
    age = np.where(index >= 0, rows - stream.time[np.maximum(index, 0)], np.nan)
    stale = age > stream.gap_threshold
    return np.maximum(index, 0), np.where(stale, np.inf, np.maximum(age, 0.0))


def central_difference(stream: Stream, values: np.ndarray) -> np.ndarray:
    """Derivative of ``values`` (n, ...) at the stream's samples, by central differences.

    One-sided differences next to gaps; NaN for a sample between two gaps.
    """
    before, after, span = neighbours(stream)
    span = np.where(span > 0, span, np.nan).reshape(-1, *[1] * (values.ndim - 1))
    return (values[after] - values[before]) / span


def neighbours(stream: Stream) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """For each sample, the indices of the one before and the one after, and the time between those two, s.

    Where a gap or the end of the stream comes next, the sample itself takes the place of its neighbour.
    """
    t, n = stream.time, len(stream.time)
    inside = np.diff(t) <= stream.gap_threshold  # whether there is no gap between samples i and i + 1
    before = np.where(np.concatenate([[False], inside]), np.arange(n) - 1, np.arange(n))
    after = np.where(np.concatenate([inside, [False]]), np.arange(n) + 1, np.arange(n))
    return before, after, t[after] - t[before]


def fresh(values: np.ndarray) -> np.ndarray:
    """Mask of the samples of (n, columns) that differ from the one before, if many samples are repeats; else all true.

    A value that the firmware updates at 100 Hz and logs at 500 Hz is a staircase, so differences of neighbouring
    samples are no derivative.
    """
    new = changes(values)
    return new if new.mean() < _MOSTLY_NEW and new.sum() > 2 else np.ones(len(values), dtype=bool)
