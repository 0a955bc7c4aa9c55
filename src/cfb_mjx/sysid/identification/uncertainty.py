"""Uncertainty of a fit: covariance from the whitened Jacobian, block bootstrap, and unidentified directions."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from cfb_mjx.sysid.identification.unknowns import OFFSETS

LOOSEST = 0.5
"""A direction with a larger standard deviation than this is not identified: 50 % of a value, or half the unit of
`cfb_mjx.sysid.identification.unknowns.OFFSETS` (5 mm, 100 rad/s, 2 ms)."""
SHARE = 0.3
"""A parameter belongs to an unidentified direction if its component there is larger than this."""


@dataclass(frozen=True)
class Uncertainty:
    """Uncertainty of k quantities, relative or in the units of `cfb_mjx.sysid.identification.unknowns.OFFSETS`.

    Attributes:
        covariance: (k, k) of the identified part.
        correlation: (k, k).
        unidentified: unit vectors (k,) of the directions that the data do not determine.
        names: of the parameters that those directions move.
        combinations: identified combinations of these parameters, as text; empty if there are none.
        order: (k,) names of all quantities, in the order of the covariance.
        products: the combinations as powers by name, each with its relative standard deviation.
    """

    covariance: np.ndarray
    correlation: np.ndarray
    unidentified: list[np.ndarray]
    names: list[str]
    combinations: list[str]
    order: tuple[str, ...]
    products: list[tuple[dict[str, float], float]]

    @property
    def std(self) -> np.ndarray:
        """Standard deviations (k,)."""
        return np.sqrt(np.diag(self.covariance))


class Scores(NamedTuple):
    """What the uncertainty of a fit needs of residuals and Jacobians in B blocks of rows, which need not be kept."""

    information: np.ndarray
    """(B, k, k) sums of products of derivatives over each block."""
    gradient: np.ndarray
    """(B, k) sums of derivatives times residuals over each block."""
    triangle: np.ndarray
    """(k, k) R of the QR decomposition of all derivatives."""

    @classmethod
    def of(cls, residual: np.ndarray, jacobian: np.ndarray) -> Scores:
        """Sum whitened residuals (B, ...) and their derivatives (B, ..., k)."""
        blocks, k = len(residual), jacobian.shape[-1]
        # Not -1, because there may be no block in which anything counts.
        rows = math.prod(residual.shape[1:])
        residual, jacobian = residual.reshape(blocks, rows), jacobian.reshape(blocks, rows, k)
        turned = np.swapaxes(jacobian, 1, 2)
        return cls(turned @ jacobian, (turned @ residual[..., None])[..., 0], _triangle(jacobian.reshape(-1, k)))

    @classmethod
    def joined(cls, parts: Sequence[Scores]) -> Scores:
        """The scores of several parts of the data."""
        information, gradient, triangle = (np.concatenate(x) for x in zip(*parts, strict=True))
        return cls(information, gradient, _triangle(triangle))

    def columns(self, chosen: list[int]) -> Scores:
        """The scores of some of the quantities."""
        return Scores(self.information[:, chosen][..., chosen], self.gradient[:, chosen], self.triangle[:, chosen])


def _triangle(rows: np.ndarray) -> np.ndarray:
    return np.asarray(np.linalg.qr(rows, mode="r"))


CLEAR = 4.0
"""A fixed value is contradicted if a fit would move it by at least this many of its standard deviations."""


def assess(
    scores: Scores,
    names: tuple[str, ...],
    priors: dict[str, float] | None = None,
    blur: np.ndarray | float = 0.0,
    bootstraps: int = 400,
) -> Uncertainty:
    """Compute the uncertainty at the optimum.

    The covariance is that of the normal equations, by SVD, widened to that of a block bootstrap if the latter is
    larger: the bootstrap accounts for correlation within blocks and for an imperfect noise model.

    Args:
        scores: of the derivatives with respect to relative changes of the quantities. The blocks are what the bootstrap
            resamples.
        names: of the k quantities.
        priors: standard deviations of normal priors about the optimum, by name.
        blur: (k,) standard deviations that are added and do not decrease with more data.
        bootstraps: number of resamples of the blocks.
    """
    k = len(names)
    known = np.diag([1 / (priors or {}).get(name, np.inf) for name in names])
    # QR first: the SVD of the small triangle has the same singular values without squaring the condition number.
    triangle = _triangle(np.concatenate([scores.triangle, known]))
    _, singular, rows = np.linalg.svd(triangle)
    loose = singular < max(1 / LOOSEST, 1e-7 * singular[0])
    keep = rows[~loose].T
    covariance = keep @ np.diag(singular[~loose] ** -2.0) @ keep.T
    covariance = np.maximum(1.0, _inflation(scores, known**2, keep, covariance, bootstraps)) * covariance
    covariance = covariance + np.diag(np.broadcast_to(blur, k) ** 2)
    deviation = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    free = [row for row, is_loose in zip(rows, loose, strict=True) if is_loose]
    moved = [name for i, name in enumerate(names) if any(abs(v[i]) > SHARE for v in free)]
    correlation = covariance / np.outer(deviation, deviation)
    # Include the free directions, with a standard deviation of at most 10 (a factor of e^10).
    size = np.minimum(1 / np.maximum(singular[loose], 1e-9), 10.0)
    everything = covariance + (rows[loose].T * size**2) @ rows[loose]
    products = _products(everything, len(free), [i for i, name in enumerate(names) if name in moved], names)
    return Uncertainty(covariance, correlation, free, moved, [_told(p) for p, _ in products], names, products)


def most_contradicted(scores: Scores, names: tuple[str, ...], free: tuple[str, ...], held: list[str]) -> str | None:
    """Name of the fixed quantity whose value the data contradict most, if by `CLEAR` standard deviations or more.

    A score test (Rao 1948) of each fixed quantity alone, with all free quantities adjusting to it. The variance of the
    score is the larger of the model's and that of the scatter between blocks.

    Args:
        scores: at the optimum of the free quantities.
        names: of the k quantities.
        free: names of the quantities that were fitted.
        held: names of the fixed quantities to test.
    """
    information, gradient = scores.information.sum(axis=0), scores.gradient
    columns = [names.index(name) for name in free]
    following = np.linalg.lstsq(information[np.ix_(columns, columns)], information[columns], rcond=1e-9)[0]
    strongest, found = CLEAR, None
    for name in held:
        i = names.index(name)
        left = information[i, i] - information[i, columns] @ following[:, i]
        if left < max(1 / LOOSEST**2, 1e-7 * information[i, i]):
            continue  # not distinguishable from the free quantities
        each = gradient[:, i] - gradient[:, columns] @ following[:, i]
        z = abs(each.sum()) / np.sqrt(max(left, len(each) * np.var(each)))
        if z > strongest:
            strongest, found = z, name
    return found


def _inflation(scores: Scores, known, keep, covariance, bootstraps) -> np.ndarray:
    """Factors (k, k) that widen the model's covariance to that of the block bootstrap; at least 1."""
    blocks, k = scores.gradient.shape
    if blocks < 8 or keep.shape[1] == 0:
        return np.ones((k, k))
    information, gradient = scores.information, scores.gradient
    rng = np.random.default_rng(0)
    draws = rng.integers(0, blocks, (bootstraps, blocks))
    moves = []
    for draw in draws:
        # One Gauss-Newton step from the optimum approximates a refit of the resampled data.
        a, g = information[draw].sum(0) + known, gradient[draw].sum(0)
        moves.append(-keep @ np.linalg.lstsq(keep.T @ a @ keep, keep.T @ g, rcond=None)[0])
    spread = np.std(moves, axis=0)
    ratio = spread / np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    return np.outer(np.maximum(ratio, 1), np.maximum(ratio, 1))


def _products(
    covariance: np.ndarray, unknown: int, members: list[int], names: tuple[str, ...]
) -> list[tuple[dict[str, float], float]]:
    """Identified products of powers of quantities that are not identified alone, with relative standard deviations.

    As many quantities as there are unidentified directions are taken as given, the least known first. Each of the
    others is then identified in combination with them.
    """
    left, given = covariance.copy(), []
    for _ in range(min(unknown, len(members))):
        worst = max((i for i in members if i not in given), key=lambda i: round(left[i, i], 6))
        given.append(worst)
        left = left - np.outer(left[worst], left[worst]) / left[worst, worst]
    found = []
    for i in members:
        if i in given or left[i, i] > LOOSEST**2:
            continue
        power = np.linalg.solve(covariance[np.ix_(given, given)], covariance[given, i])
        powers = {names[i]: 1.0} | {names[g]: -float(p) for g, p in zip(given, power, strict=True) if abs(p) > 0.02}
        if len(powers) == 2:  # the least known first
            other, size = list(powers.items())[1]
            powers = {other: 1.0, names[i]: 1 / size}
        powers = {name: float(f"{p:.3g}") for name, p in powers.items()}
        weight = np.array([powers.get(name, 0.0) for name in names])
        deviation = float(np.sqrt(weight @ covariance @ weight))
        if deviation <= LOOSEST:  # as a power of the other it may be less sure than by itself
            found.append((powers, deviation))
    return found


def power_product(powers: dict[str, float]) -> str:
    """Format a product of powers as text, for instance ``thrust_scale * motor_gain^2``."""
    parts = []
    for name, power in powers.items():
        sign = ("* " if power > 0 else "/ ") if parts else ("" if power > 0 else "1 / ")
        parts.append(f"{sign}{name}" + ("" if abs(power) == 1 else f"^{abs(power):.3g}"))
    return " ".join(parts)


def _told(powers: dict[str, float]) -> str:
    if any(name in OFFSETS for name in powers):
        return f"{', '.join(powers)} only together"
    return power_product(powers)
