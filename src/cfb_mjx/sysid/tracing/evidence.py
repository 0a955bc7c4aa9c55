"""Blocked cross-validation on inner products: do additional columns explain data to which they were not fitted?"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import norm

FOLDS = 5
RIDGE = 1e-2
"""Weak prior precision of every parameter, in units of its column's scale (half the prior range)."""


@dataclass(frozen=True)
class Evidence:
    """Cross-validated evidence for adding columns to a fit.

    Attributes:
        gain: half the decrease of the sum of squares on the left-out blocks, in nats of log-likelihood.
        t: cross-fitted score statistic; standard normal if the added columns explain nothing.
        p_value: one-sided p-value of ``t``.
        values: of the added columns, fitted to all blocks, in units of their scale.
    """

    gain: float
    t: float
    p_value: float
    values: np.ndarray


@dataclass(frozen=True)
class Prior:
    """Independent normal prior of k parameters, in units of their columns' scale.

    Attributes:
        center: (k,) means.
        precision: (k,) inverse variances.
    """

    center: np.ndarray
    precision: np.ndarray

    @classmethod
    def weak(cls, count: int) -> Prior:
        """A weak prior on the step from the current values, which keeps it from becoming too long."""
        return cls(np.zeros(count), np.full(count, RIDGE))

    def pulled(self, at: int, value: float, precision: float) -> Prior:
        """The prior combined with one more normal prior for the parameter at position ``at``."""
        center, both = self.center.copy(), self.precision.copy()
        both[at] += precision
        center[at] = (self.precision[at] * center[at] + precision * value) / both[at]
        return Prior(center, both)

    def of(self, positions: list[int]) -> Prior:
        """The prior of the parameters at these positions."""
        return Prior(self.center[positions], self.precision[positions])

    def __add__(self, other: Prior) -> Prior:
        pairs = (self.center, other.center), (self.precision, other.precision)
        return Prior(*(np.concatenate(pair) for pair in pairs))


def solve(total: np.ndarray, columns: list[int], scale: np.ndarray, prior: Prior | None = None) -> np.ndarray:
    """Least-squares values of some columns, in units of their scale.

    Args:
        total: (c, c) inner products summed over blocks; index 0 is the residual.
        columns: positions of the k columns to fit.
        scale: (c,) unit of each column.
        prior: of the k values; weak by default.
    """
    prior = prior or Prior.weak(len(columns))
    s = scale[columns]
    a = total[np.ix_(columns, columns)] * np.outer(s, s) + np.diag(prior.precision)
    return np.linalg.solve(a, total[columns, 0] * s + prior.precision * prior.center)


def alike(effects: Sequence[str], correlation: np.ndarray, name: str, limit: float) -> list[str]:
    """Names of the effects that have a parameter strongly correlated with one of the given effect.

    Args:
        effects: (n,) effect to which each parameter belongs.
        correlation: (n, n) correlation of the parameters; NaN counts as zero.
        name: of the given effect.
        limit: absolute correlation above which two parameters count as strongly correlated.
    """
    every = np.array(effects)
    most = np.nan_to_num(np.abs(correlation))[every == name].max(axis=0)
    return [other for other in dict.fromkeys(effects) if other != name and most[every == other].max() > limit]


def covariance(
    blocks: np.ndarray, columns: list[int], scale: np.ndarray, values: np.ndarray, prior: Prior | None = None
) -> np.ndarray:
    """Covariance (k, k) of the values of `solve`, inflated to the sandwich estimate over blocks if that is larger.

    Args:
        blocks: (b, c, c) inner products; index 0 is the residual.
        columns: positions of the k fitted columns.
        scale: (c,) unit of each column.
        values: (k,) result of `solve`.
        prior: as for `solve`.
    """
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
    """Assign every block to a cross-validation fold, given the number of blocks of each flight.

    Each fold leaves out blocks of every flight. The assignment is offset from flight to flight: otherwise corresponding
    blocks of similar flights, which may be the only ones that show an effect, could all end up in the same fold.
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
    """Compare a fit of ``base`` with a fit of ``base`` and ``added`` by cross-validation over blocks.

    Args:
        blocks: (b, c, c) inner products; index 0 is the residual.
        base: positions of the columns of the smaller fit.
        added: positions of the columns to be tested.
        scale: (c,) unit of each column.
        prior: of ``base`` and ``added``, in this order.
        fold: (b,) fold of each block, from `dealt`; None if all blocks are of one flight.
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
    # Innovations have unit variance; use the scatter between blocks if it is larger than that implies.
    t = score / np.sqrt(max(noise, white, 1e-30))
    return Evidence(gain, t, float(norm.sf(t)), solve(total, both, scale, prior)[len(base) :])


def _full(size: int, columns: list[int], values: np.ndarray, scale: np.ndarray) -> np.ndarray:
    out = np.zeros(size)
    out[columns] = values * scale[columns]
    return out
