"""Logs prepared for fitting: gap-free segments of rows, padded to one shape, and the noise of the sensors."""

from __future__ import annotations

from dataclasses import dataclass, replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from cfb_mjx.devices import Devices, last_repeated
from cfb_mjx.logs import FlightLog
from cfb_mjx.model.state import AnyArray

ROWS_PER_SEGMENT = 641
"""Long flights are cut into overlapping segments of this many rows, which are processed in parallel. With one shape for
all flights, programs are compiled once and then come from the cache."""
_COUNTS = (1, 2, 4)
"""Numbers of segments to which the data are padded. More segments are processed in parts of the largest number: few
programs then serve flights of any length, and the numbers of a part fit into a core's cache."""


class Segments(eqx.Module):
    """S gap-free pieces of flight of N rows; short pieces are padded with their last row and zero intervals."""

    interval: Float[AnyArray, "s n"]
    """Time from the previous row, s; 0 at the first row and in the padding."""
    valid: Float[AnyArray, "s n"]
    """1 for measured rows, 0 for the padding."""
    command: Float[AnyArray, "s n 4"]
    """0 to 1."""
    doubt: Float[AnyArray, "s n 4"]
    """Part of a command's step to the next row that the neighbouring steps do not predict. The commands sent between
    the rows are uncertain by a share of it."""
    excess: Float[AnyArray, "s n 4"]
    """Mean command until the next row minus ``command``; 0 for a log as read (`innovation.as_held`)."""
    rotor_speed: Float[AnyArray, "s n 4"]
    """Measured, rad/s; meaningless where ``measured`` is 0."""
    measured: Float[AnyArray, " s"]
    """1 if every rotor speed of the piece was measured."""
    warm_up: Float[AnyArray, "s n"]
    """1 for rows that only serve to initialise the rotor speed and the filters."""
    body_rate: Float[AnyArray, "s n 3"]
    """rad/s."""
    specific_force: Float[AnyArray, "s n 3"]
    """m/s^2."""
    over: Devices | None = eqx.field(static=True, default=None)
    """Devices over which the segments are divided."""


@dataclass(frozen=True)
class FlightData:
    """Segments of several logs, and the noise of their sensors.

    Attributes:
        segments: None if no stretch of any log is long enough.
        log_of_segment: (pieces,) index of the log of each segment; further segments are padding.
        rate_noise: (3,) gyro noise, rad/s.
        specific_force_noise: (3,) accelerometer noise, m/s^2.
        rotor_speed_noise: rad/s; NaN if rotor speed was not measured.
    """

    segments: Segments | None
    log_of_segment: np.ndarray
    rate_noise: np.ndarray
    specific_force_noise: np.ndarray
    rotor_speed_noise: float

    @property
    def rows(self) -> int:
        """Number of measured rows."""
        return 0 if self.segments is None else int(np.sum(np.asarray(self.segments.valid)))


def prepare(logs: list[FlightLog], warm_up: float = 0.4) -> FlightData:
    """Cut logs at their gaps into segments that overlap by ``warm_up`` seconds.

    Args:
        logs: flights.
        warm_up: time at the start of each segment, s, in which the motor model's initial error decays (eight motor time
            constants).
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


def parts(segments: Segments, over: Devices | None = None) -> list[Segments]:
    """Segments in parts of at most the largest of `_COUNTS` per device, as jax arrays, each divided over devices."""
    found, most = [], _COUNTS[-1] * (1 if over is None else over.count)
    for first in range(0, len(segments.valid), most):
        part = jax.tree.map(lambda x, f=first: x[f : f + most], segments)
        if over is None or not over.several:
            found.append(jax.tree.map(jnp.asarray, part))
            continue
        # What is added to divide evenly counts for nothing.
        valid = np.concatenate([part.valid, np.zeros((-len(part.valid) % over.count, part.valid.shape[1]))])
        found.append(eqx.tree_at(lambda s: s.valid, over.shared(part), over.along(valid)))
    return found


def _padded(stacked: Segments) -> Segments:
    """Pad with invalid segments to the next number in `_COUNTS`, or to a multiple of the largest."""
    count = len(stacked.valid)
    wanted = next((n for n in _COUNTS if n >= count), -(-count // _COUNTS[-1]) * _COUNTS[-1])
    # The padding copies a real segment, because zeros would cause divisions by zero.
    more = jax.tree.map(lambda x: np.concatenate([x, np.repeat(x[:1], wanted - count, axis=0)]), stacked)
    return replace(more, valid=more.valid * (np.arange(wanted) < count)[:, None])


def _segment(log: FlightLog, first: int, last: int, lead: int, width: int) -> Segments:
    rows = slice(first, last)
    count = last - first
    speed = np.zeros((count, 4)) if log.rotor_speed is None else log.rotor_speed[rows].copy()
    measured = log.rotor_speed is not None
    for motor in range(4 if measured else 0):
        good = np.isfinite(speed[:, motor])
        # Interpolate up to two invalid readings in a row; with a longer hole the piece counts as not measured.
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
    """Parts (n - 1, 4) of the command's steps that the mean slope of the neighbouring steps does not predict.

    A step far larger than the others (a new set-point) occurred at an unknown moment between the rows, always the same
    moment if rows and set-points are synchronous. Its uncertainty is increased further; otherwise a few such steps
    would dominate the estimate of the motors' lag.
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
    """Robust estimate (k,) of the white noise on smooth signals from their third differences.

    Args:
        values: (n, k) signals.
        time: (n,) of the rows, s. If given, divided differences are used: with uneven rows, plain differences of a
            steady motion look like noise.
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
