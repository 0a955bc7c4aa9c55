"""A log prepared for fitting: contiguous segments on rows, padded to one shape, and the noise its sensors show."""

from __future__ import annotations

from dataclasses import dataclass, replace

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from cfb_mjx.devices import Devices, last_repeated
from cfb_mjx.logs import FlightLog
from cfb_mjx.model.state import AnyArray

ROWS_PER_SEGMENT = 641
"""Long flights are cut into overlapping segments of this many rows, which run side by side. One shape for all flights:
programs are compiled once and then come from the cache."""
_COUNTS = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32)


class Segments(eqx.Module):
    """S contiguous pieces of flight, N rows each; the last row of a short piece is repeated with zero time between."""

    interval: Float[AnyArray, "s n"]
    """Time from the previous row, s; 0 at the first row and in the padding."""
    valid: Float[AnyArray, "s n"]
    """1 for rows that are measured, 0 for the padding."""
    command: Float[AnyArray, "s n 4"]
    doubt: Float[AnyArray, "s n 4"]
    """Of a command's step to the next row, the part that the steps about it do not foretell: what may have been sent
    between the rows is uncertain by a share of it."""
    excess: Float[AnyArray, "s n 4"]
    """Mean of what is commanded until the next row, less ``command``: 0 as logged, see `innovation.as_held`."""
    rotor_speed: Float[AnyArray, "s n 4"]
    """Measured, rad/s; what it holds where ``measured`` is 0 means nothing."""
    measured: Float[AnyArray, " s"]
    """1 where every rotor speed of the piece was measured."""
    warm_up: Float[AnyArray, "s n"]
    """1 for rows used to find the rotor speed and the filter's state only."""
    body_rate: Float[AnyArray, "s n 3"]
    specific_force: Float[AnyArray, "s n 3"]
    over: Devices | None = eqx.field(static=True, default=None)
    """What they are divided over."""


@dataclass(frozen=True)
class FlightData:
    """Segments of several logs together."""

    segments: Segments | None
    """None where no stretch of any log is long enough."""
    log_of_segment: np.ndarray
    """(pieces,) index of the log each segment comes from; segments beyond are empty."""
    rate_noise: np.ndarray
    """(3,) gyro noise, rad/s."""
    specific_force_noise: np.ndarray
    """(3,) accelerometer noise, m/s^2."""
    rotor_speed_noise: float
    """rad/s; NaN where none was measured."""

    @property
    def rows(self) -> int:
        """Measured rows."""
        return 0 if self.segments is None else int(np.sum(np.asarray(self.segments.valid)))


def prepare(logs: list[FlightLog], warm_up: float = 0.4) -> FlightData:
    """Cut logs at their gaps into segments that overlap by ``warm_up`` seconds.

    Args:
        logs: flights.
        warm_up: time at the start of each segment in which the motor model forgets its guessed start, s (eight motor
            time constants).
    """
    pieces: list[tuple[FlightLog, int, int, int]] = []
    owners: list[int] = []
    for index, log in enumerate(logs):
        lead = min(max(2, round(warm_up / log.nominal_interval)), ROWS_PER_SEGMENT // 2)
        for stretch in log.segments():
            first, end = stretch.start, stretch.stop
            while end - first > lead + 16:
                last = min(first + ROWS_PER_SEGMENT, end)
                pieces.append((log, first, last, lead))
                owners.append(index)
                first = last - lead
                if last == end:
                    break
    built = [_segment(*piece, ROWS_PER_SEGMENT) for piece in pieces]
    noise = [_noise(log) for log in logs]
    return FlightData(
        segments=_padded(jax.tree.map(lambda *x: np.stack(x), *built)) if built else None,
        log_of_segment=np.array(owners, dtype=int),
        rate_noise=np.median([n[0] for n in noise], axis=0),
        specific_force_noise=np.median([n[1] for n in noise], axis=0),
        rotor_speed_noise=float(np.median([n[2] for n in noise])),
    )


def _padded(stacked: Segments) -> Segments:
    """Append segments that count for nothing up to the next count of `_COUNTS` (beyond, a multiple of the last)."""
    count = len(stacked.valid)
    wanted = next((n for n in _COUNTS if n >= count), -(-count // _COUNTS[-1]) * _COUNTS[-1])
    # Copies of a real segment: zeros would divide by zero.
    more = jax.tree.map(lambda x: np.concatenate([x, np.repeat(x[:1], wanted - count, axis=0)]), stacked)
    return replace(more, valid=more.valid * (np.arange(wanted) < count)[:, None])


def _segment(log: FlightLog, first: int, last: int, lead: int, width: int) -> Segments:
    rows = slice(first, last)
    count = last - first
    speed = np.zeros((count, 4)) if log.rotor_speed is None else log.rotor_speed[rows].copy()
    measured = log.rotor_speed is not None
    for motor in range(4 if measured else 0):
        good = np.isfinite(speed[:, motor])
        # A bad reading or two is bridged; a motor that is silent for longer makes the piece unmeasured.
        longest = max((len(list(run)) for run in _runs(~good)), default=0)
        if longest > 2 or not good.any():
            measured = False
            speed[:, motor] = 0.0
        else:
            speed[:, motor] = np.interp(np.arange(count), np.flatnonzero(good), speed[good, motor])

    doubt = _unforetold(log.time[rows], np.clip(log.command[rows], 0, 1))

    padding = np.arange(width) >= count
    return Segments(
        interval=np.where(padding, 0.0, last_repeated(np.concatenate([[0.0], np.diff(log.time[rows])]), width)),
        valid=(~padding).astype(float),
        command=last_repeated(np.clip(log.command[rows], 0, 1), width),
        doubt=np.concatenate([doubt, np.zeros((1 + width - count, 4))]),
        excess=np.zeros((width, 4)),
        rotor_speed=last_repeated(speed, width),
        measured=np.array(float(measured)),
        warm_up=(np.arange(width) < lead).astype(float),
        body_rate=last_repeated(log.body_rate[rows], width),
        specific_force=last_repeated(log.specific_force[rows], width),
    )


def _unforetold(time: np.ndarray, command: np.ndarray) -> np.ndarray:
    """(n - 1, 4) steps of the command without what the mean slope of the steps before and after would make.

    A step far larger than the others (a new set-point) came at one moment that no row tells, always the same one where
    rows and set-points are in step: it counts for still more, or a handful of them would decide the motors' lag.
    """
    interval, step = np.diff(time)[:, None], np.diff(command, axis=0)
    slope = step / interval
    before, after = np.concatenate([slope[:1], slope[:-1]]), np.concatenate([slope[1:], slope[-1:]])
    left = np.abs(step - 0.5 * (before + after) * interval)
    usual = np.maximum(np.median(left, axis=0), 0.3 * np.sqrt(np.mean(left**2, axis=0)))
    return left * np.maximum(1.0, left / np.maximum(4 * usual, 1e-12))


def _runs(mask: np.ndarray):
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(int), [0]])))
    return [range(a, b) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def white_noise(values: np.ndarray, time: np.ndarray | None = None) -> np.ndarray:
    """(k,) white noise on a smooth (n, k) signal from its third differences, robustly.

    With the rows' ``time`` (s) they are divided differences: at uneven rows plain ones take steady motion for noise.
    """
    if time is None:
        third = np.diff(values, n=3, axis=0) / np.sqrt(20.0)
    else:
        t = np.stack([time[i : len(time) - 3 + i] for i in range(4)])
        weight = np.stack([1 / np.prod([t[i] - t[j] for j in range(4) if j != i], axis=0) for i in range(4)])
        weight /= np.linalg.norm(weight, axis=0)
        third = sum(weight[i, :, None] * values[i : len(time) - 3 + i] for i in range(4))
    return 1.4826 * np.nanmedian(np.abs(third), axis=0)


def _noise(log: FlightLog) -> tuple[np.ndarray, np.ndarray, float]:
    speed = np.nan if log.rotor_speed is None else float(np.nanmean(white_noise(log.rotor_speed)))
    return white_noise(log.body_rate), white_noise(log.specific_force), speed
