"""Whether a term improves data it was not fitted on beyond chance: blocked cross-validation on inner products."""

from __future__ import annotations

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


def solve(
    total: np.ndarray, columns: list[int], scale: np.ndarray, pull: tuple[int, float, float] | None = None
) -> np.ndarray:
    """Values of some columns (units of their scale) that explain the residual best; ``total`` is (c, c).

    ``pull`` (position, value, precision) holds one of them near a value known beforehand.
    """
    s = scale[columns]
    a = total[np.ix_(columns, columns)] * np.outer(s, s) + RIDGE * np.eye(len(columns))
    b = total[columns, 0] * s
    if pull is not None:
        at, value, precision = pull
        a[at, at] += precision
        b[at] += precision * value
    return np.linalg.solve(a, b)


def covariance(
    blocks: np.ndarray, columns: list[int], scale: np.ndarray, values: np.ndarray, precision: float = 0.0
) -> np.ndarray:
    """(k, k) covariance of `solve`'s values, from the scatter of the blocks' gradients where that is larger.

    ``precision`` is what is known of the first column beforehand.
    """
    s = scale[columns]
    total = blocks.sum(0)
    a = total[np.ix_(columns, columns)] * np.outer(s, s) + RIDGE * np.eye(len(columns))
    a[0, 0] += precision
    inverse = np.linalg.inv(a)
    gradient = blocks[:, columns, 0] * s - np.einsum(
        "bij,j->bi", blocks[:, columns][:, :, columns] * np.outer(s, s), values
    )
    sandwich = inverse @ (gradient.T @ gradient) @ inverse
    ratio = np.sqrt(np.maximum(np.diag(sandwich) / np.diag(inverse), 1.0))
    return inverse * np.outer(ratio, ratio)


def evidence(blocks: np.ndarray, base: list[int], added: list[int], scale: np.ndarray) -> Evidence:
    """Compare a fit of ``base`` with one of ``base`` and ``added`` columns, on blocks left out.

    Args:
        blocks: (b, c, c) inner products; column 0 is the residual.
        base: columns that are free anyway.
        added: columns in question.
        scale: (c,) unit of each column.
    """
    count = len(blocks)
    fold = np.arange(count) % FOLDS
    total = blocks.sum(0)
    both = base + added
    gain, score, noise, white = 0.0, 0.0, 0.0, 0.0
    for f in range(FOLDS):
        test = fold == f
        train = total - blocks[test].sum(0)
        less = _full(train.shape[0], base, solve(train, base, scale), scale) if base else np.zeros(train.shape[0])
        more = _full(train.shape[0], both, solve(train, both, scale), scale)
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
    return Evidence(gain, t, float(norm.sf(t)), solve(total, both, scale)[len(base) :])


def _full(size: int, columns: list[int], values: np.ndarray, scale: np.ndarray) -> np.ndarray:
    out = np.zeros(size)
    out[columns] = values * scale[columns]
    return out
