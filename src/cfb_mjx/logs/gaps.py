"""Definition of a gap in the samples, for every kind of recording, and helpers for runs of rows."""

from __future__ import annotations

import itertools

import numpy as np


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
