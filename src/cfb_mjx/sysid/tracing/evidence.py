"""Whether a term improves data it was not fitted on beyond chance: blocked cross-validation on inner products."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import norm

FOLDS = 5
RIDGE = 1e-2
"""Prior precision of every number in units of its column's scale (half the prior range): weak, and proper."""


@dataclass(frozen=True)
class Evidence:
    """For adding some columns to others.

    Attributes:
        gain: half the drop of the sum of squares on blocks left out: nats of log-likelihood.
        t: cross-fitted score statistic, standard normal where the added columns explain nothing.
        p_value: one-sided, of ``t``.
        values: of the added columns fitted to all blocks, in units of their scale.
    """

    gain: float
    t: float
    p_value: float
    values: np.ndarray


@dataclass(frozen=True)
class Prior:
    """What is known of numbers beforehand, in units of their columns' scale: normal, one by one.

    Attributes:
        center: (k,).
        precision: (k,).
    """

    center: np.ndarray
    precision: np.ndarray

    @classmethod
    def weak(cls, count: int) -> Prior:
        """A step not too long, whatever the numbers are now."""
        return cls(np.zeros(count), np.full(count, RIDGE))

    def pulled(self, at: int, value: float, precision: float) -> Prior:
        """The same with more known of one number."""
        center, both = self.center.copy(), self.precision.copy()
        both[at] += precision
        center[at] = (self.precision[at] * center[at] + precision * value) / both[at]
        return Prior(center, both)

    def of(self, positions: list[int]) -> Prior:
        """Of some of the numbers."""
        return Prior(self.center[positions], self.precision[positions])

    def __add__(self, other: Prior) -> Prior:
        pairs = (self.center, other.center), (self.precision, other.precision)
        return Prior(*(np.concatenate(pair) for pair in pairs))


def solve(total: np.ndarray, columns: list[int], scale: np.ndarray, prior: Prior | None = None) -> np.ndarray:
    """Values of some columns (units of their scale) that explain the residual best; ``total`` is (c, c)."""
    prior = prior or Prior.weak(len(columns))
    s = scale[columns]
    a = total[np.ix_(columns, columns)] * np.outer(s, s) + np.diag(prior.precision)
    return np.linalg.solve(a, total[columns, 0] * s + prior.precision * prior.center)


def alike(effects: Sequence[str], correlation: np.ndarray, name: str, limit: float) -> list[str]:
    """Effects of which a number goes with one of this effect's.

    Args:
        effects: of each number.
        correlation: (n, n) of the numbers; NaN for those that go with none.
        name: of the effect.
        limit: correlation from which on two go together.
    """
    every = np.array(effects)
    most = np.nan_to_num(np.abs(correlation))[every == name].max(axis=0)
    return [other for other in dict.fromkeys(effects) if other != name and most[every == other].max() > limit]


def covariance(
    blocks: np.ndarray, columns: list[int], scale: np.ndarray, values: np.ndarray, prior: Prior | None = None
) -> np.ndarray:
    """(k, k) covariance of `solve`'s values, from the scatter of the blocks' gradients where that is larger."""
    prior = prior or Prior.weak(len(columns))
    s = scale[columns]
    a = blocks.sum(0)[np.ix_(columns, columns)] * np.outer(s, s) + np.diag(prior.precision)
    inverse = np.linalg.inv(a)
    gradient = blocks[:, columns, 0] * s - np.einsum(
        "bij,j->bi", blocks[:, columns][:, :, columns] * np.outer(s, s), values
    )
    sandwich = inverse @ (gradient.T @ gradient) @ inverse
    ratio = np.sqrt(np.maximum(np.diag(sandwich) / np.diag(inverse), 1.0))
    return inverse * np.outer(ratio, ratio)


def dealt(counts: Sequence[int]) -> np.ndarray:
    """The fold of every block of flights with so many blocks each.

    A fold leaves out some of every flight, and of each flight another part of the way: dealt one after the other, what
    only the same few blocks of alike flights show could end up in one fold.
    """
    return np.concatenate([(np.arange(count) - i) % FOLDS for i, count in enumerate(counts)])


def evidence(
    blocks: np.ndarray,
    base: list[int],
    added: list[int],
    scale: np.ndarray,
    prior: Prior | None = None,
    fold: np.ndarray | None = None,
) -> Evidence:
    """Compare a fit of ``base`` with one of ``base`` and ``added`` columns, on blocks left out.

    Args:
        blocks: (b, c, c) inner products; column 0 is the residual.
        base: columns that are free anyway.
        added: columns in question.
        scale: (c,) unit of each column.
        prior: of ``base`` and ``added``, in this order.
        fold: (b,) of each block, `dealt`; None where all are of one flight.
    """
    prior = prior or Prior.weak(len(base) + len(added))
    few = prior.of(list(range(len(base))))
    fold = dealt([len(blocks)]) if fold is None else fold
    total = blocks.sum(0)
    both = base + added
    gain, score, noise, white = 0.0, 0.0, 0.0, 0.0
    for f in range(FOLDS):
        test = fold == f
        train = total - blocks[test].sum(0)
        less = _full(train.shape[0], base, solve(train, base, scale, few), scale) if base else np.zeros(train.shape[0])
        more = _full(train.shape[0], both, solve(train, both, scale, prior), scale)
        g = blocks[test]
        r, z = -less, more - less
        r[0] = 1.0  # the residual itself, minus what the base explains
        rz = np.einsum("i,bij,j->b", r, g, z)
        zz = np.einsum("i,bij,j->b", z, g, z)
        gain += float(np.sum(rz - 0.5 * zz))
        score += float(np.sum(rz))
        noise += float(np.sum((rz - zz) ** 2))
        white += float(np.sum(zz))
    # Innovations have unit variance; where they scatter more than that between blocks, the scatter counts.
    t = score / np.sqrt(max(noise, white, 1e-30))
    return Evidence(gain, t, float(norm.sf(t)), solve(total, both, scale, prior)[len(base) :])


def _full(size: int, columns: list[int], values: np.ndarray, scale: np.ndarray) -> np.ndarray:
    out = np.zeros(size)
    out[columns] = values * scale[columns]
    return out
