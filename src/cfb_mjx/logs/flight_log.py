"""One flight as arrays: the only form in which the rest of the library sees measured data.

A gap in the samples is defined here too, for every kind of recording.
"""

from __future__ import annotations

import dataclasses
import itertools
import json
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any

import numpy as np

from cfb_mjx.errors import CfbError
from cfb_mjx.files import plain


def longest_step(interval: float) -> float:
    """Longest step between two rows without a gap, s: three nominal intervals + 0.5 ms."""
    return 3.0 * interval + 0.5e-3


def stretches(time: np.ndarray, longest: float) -> list[slice]:
    """The contiguous stretches of rows between steps longer than ``longest`` (s), in order."""
    gaps = np.flatnonzero(np.diff(time) > longest) + 1
    return [slice(a, b) for a, b in itertools.pairwise([0, *gaps.tolist(), len(time)]) if b > a]


def changes(values: np.ndarray) -> np.ndarray:
    """(n,) mask of the rows of (n, columns) that differ from the row before; the first row counts as different."""
    return np.concatenate([[True], (np.diff(values, axis=0) != 0).any(axis=1)])


def runs(mask: np.ndarray) -> list[tuple[int, int]]:
    """Runs of true values, each as its first row and the row after its last."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]


REQUIRED = ("time", "position", "velocity", "quaternion", "body_rate", "specific_force", "command")
OPTIONAL = ("rotor_speed", "battery_voltage")
_BESIDE = "other"
# An alias, because inside the class the name slice is a method.
Rows = np.ndarray | slice
_WIDTH = {
    "position": 3,
    "velocity": 3,
    "quaternion": 4,
    "body_rate": 3,
    "specific_force": 3,
    "command": 4,
    "rotor_speed": 4,
    _BESIDE: 9,
}
_ARRAYS = (*REQUIRED, *OPTIONAL, _BESIDE)


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class FlightLog:
    """One flight, sampled at ``n`` instants that need not be evenly spaced. Arrays are float64 and read-only.

    A pause in the samples longer than `gap_threshold` is a gap: nothing in the library interpolates across it.

    Attributes:
        time: (n,) s, strictly increasing.
        position: (n, 3) m, world (z up).
        velocity: (n, 3) m/s, world.
        quaternion: (n, 4) ``[w, x, y, z]``, body to world, unit norm.
        body_rate: (n, 3) rad/s, body axes (the gyro).
        specific_force: (n, 3) m/s^2, body axes (the accelerometer: +9.81 along z at rest).
        command: (n, 4) in [0, 1], motors M1 to M4; a row holds from its time to the next row's.
        rotor_speed: (n, 4) rad/s, NaN where a sample is invalid; None if not measured.
        battery_voltage: (n,) V; None if not measured.
        metadata: JSON-like mapping with at least ``name``, ``source`` (file name), ``format`` and
            ``observation_delay`` (s by which position, velocity and quaternion lag their row's time; None: unknown).
        other: (n, 9) another drone that flew at the same time, at the rows' own times, world: position (m), velocity
            (m/s), and thrust over mass as a vector (m/s^2); NaN where unknown, None if there is none. `with_other`
            adds it; files do not hold it.

    Raises:
        ValueError: an array has the wrong shape. Only shapes are checked here; `validate` checks the content.
    """

    time: np.ndarray
    position: np.ndarray
    velocity: np.ndarray
    quaternion: np.ndarray
    body_rate: np.ndarray
    specific_force: np.ndarray
    command: np.ndarray
    rotor_speed: np.ndarray | None = None
    battery_voltage: np.ndarray | None = None
    metadata: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    other: np.ndarray | None = None

    def __post_init__(self):
        n = len(self.time)
        for field in _ARRAYS:
            value = getattr(self, field)
            if value is None and field not in REQUIRED:
                continue
            shape = (n, _WIDTH[field]) if field in _WIDTH else (n,)
            array = np.array(value, dtype=np.float64, order="C")
            if array.shape != shape:
                raise ValueError(f"FlightLog.{field} has shape {array.shape}, expected {shape}")
            array.flags.writeable = False
            object.__setattr__(self, field, array)
        # A round trip through JSON makes the metadata in memory equal to the metadata read back from a file.
        given = json.loads(json.dumps(plain(self.metadata), allow_nan=False))
        defaults = {"name": "log", "source": "", "format": "memory", "observation_delay": None}
        object.__setattr__(self, "metadata", MappingProxyType(defaults | given))

    @property
    def name(self) -> str:
        """Name of the log: the file name without its ending."""
        return self.metadata["name"]

    @property
    def observation_delay(self) -> float | None:
        """Lag of position, velocity and quaternion behind their row's time, s; None if unknown."""
        return self.metadata["observation_delay"]

    @property
    def duration(self) -> float:
        """Time between the first and the last row, s."""
        return float(self.time[-1] - self.time[0]) if len(self.time) else 0.0

    @property
    def nominal_interval(self) -> float:
        """Median of the positive sampling intervals, s."""
        steps = np.diff(self.time)
        steps = steps[steps > 0]
        return float(np.median(steps)) if len(steps) else 0.0

    @property
    def gap_threshold(self) -> float:
        """Longest step between two rows without a gap, s: three nominal intervals + 0.5 ms."""
        return longest_step(self.nominal_interval)

    def gaps(self) -> np.ndarray:
        """Indices ``i`` of the rows after which a gap begins: ``time[i + 1] - time[i] > gap_threshold``."""
        return np.flatnonzero(np.diff(self.time) > self.gap_threshold)

    def segments(self) -> list[slice]:
        """The contiguous stretches between gaps, in order, as slices of rows."""
        return stretches(self.time, self.gap_threshold)

    def slice(self, start: float, stop: float) -> FlightLog:
        """The rows with ``start <= time <= stop`` (s). Times keep their values."""
        return self.rows((self.time >= start) & (self.time <= stop))

    def split(self, share: float) -> tuple[FlightLog, FlightLog]:
        """Split in time into the first ``share`` (0 to 1) and the rest. Both include a row on the border."""
        border = self.time[0] + share * self.duration
        return self.slice(self.time[0], border), self.slice(border, self.time[-1])

    def rows(self, index: Rows) -> FlightLog:
        """The rows selected by ``index`` (a mask, indices or a slice)."""
        arrays = {f: getattr(self, f) for f in _ARRAYS}
        return self.replace(**{f: None if a is None else a[index] for f, a in arrays.items()})

    def replace(self, **changes) -> FlightLog:
        """A copy with some fields replaced. ``metadata`` is merged into the existing metadata."""
        if "metadata" in changes:
            changes["metadata"] = dict(self.metadata) | dict(changes["metadata"])
        return dataclasses.replace(self, **changes)

    def __len__(self) -> int:
        return len(self.time)

    def __repr__(self) -> str:
        rate = 1.0 / self.nominal_interval if self.nominal_interval else float("nan")
        return (
            f"FlightLog({self.name!r}, {len(self)} rows, {self.duration:.2f} s at {rate:.0f} Hz, "
            f"{len(self.gaps()) if len(self) else 0} gaps, rotor_speed={self.rotor_speed is not None}, "
            f"battery_voltage={self.battery_voltage is not None})"
        )

    def __reduce__(self):
        # A mappingproxy cannot be pickled.
        return FlightLog, (*(getattr(self, f) for f in (*REQUIRED, *OPTIONAL)), dict(self.metadata), self.other)


def require_own_names(logs: Sequence[FlightLog]) -> None:
    """Check that no two logs have the same name, because results are listed by name.

    Raises:
        CfbError: two logs have the same name.
    """
    names = [log.name for log in logs]
    for name in names:
        if names.count(name) > 1:
            raise CfbError(f"{name}: two logs have this name; rename one file, results are listed by name.")


def quantise_time(time: np.ndarray) -> np.ndarray:
    """Round times (s) to whole nanoseconds, the resolution of log files. Idempotent."""
    return from_nanoseconds(*to_nanoseconds(time))


def to_nanoseconds(time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Split times (s) into whole seconds and nanoseconds 0..999999999, both int64. Exact for epoch times too."""
    time = np.asarray(time, dtype=np.float64)
    seconds = np.floor(time)
    nanos = np.rint((time - seconds) * 1e9)
    carry = nanos >= 1e9
    return (seconds + carry).astype(np.int64), np.where(carry, 0, nanos).astype(np.int64)


def from_nanoseconds(seconds: np.ndarray, nanos: np.ndarray) -> np.ndarray:
    """Inverse of `to_nanoseconds`."""
    return np.asarray(seconds, dtype=np.float64) + np.asarray(nanos, dtype=np.float64) / 1e9
