"""What a gap in the samples is, for every kind of recording."""

from __future__ import annotations

import itertools

import numpy as np


def longest_step(interval: float) -> float:
    """Two rows further apart than this, s, have a gap between them: three nominal intervals + 0.5 ms."""
    return 3.0 * interval + 0.5e-3


def stretches(time: np.ndarray, longest: float) -> list[slice]:
    """The contiguous stretches of rows between steps longer than ``longest`` (s), in order."""
    gaps = np.flatnonzero(np.diff(time) > longest) + 1
    return [slice(a, b) for a, b in itertools.pairwise([0, *gaps.tolist(), len(time)]) if b > a]


def changes(values: np.ndarray) -> np.ndarray:
    """Which rows of (n, columns) differ from the one before; the first does."""
    return np.concatenate([[True], (np.diff(values, axis=0) != 0).any(axis=1)])


def runs(mask: np.ndarray) -> list[tuple[int, int]]:
    """First row of every run of true values, and the row behind its last."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]
