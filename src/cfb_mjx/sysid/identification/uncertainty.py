"""How sure a fit is: covariance from the whitened Jacobian, block bootstrap, and what the data cannot tell at all."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cfb_mjx.sysid.identification.unknowns import OFFSETS

LOOSEST = 0.5
"""A direction in which the estimate is free by more than this is not identified: 50 % of a value, half the unit of
`cfb_mjx.sysid.identification.unknowns.OFFSETS` (5 mm, 100 rad/s, 2 ms)."""
SHARE = 0.3
"""A parameter belongs to an unidentified direction when its component there is at least this."""


@dataclass(frozen=True)
class Uncertainty:
    """Of the named quantities: relative, or in the units of `cfb_mjx.sysid.identification.unknowns.OFFSETS`.

    Attributes:
        covariance: (k, k), of the identified part.
        correlation: (k, k).
        unidentified: directions (unit vectors) the data leave free.
        names: of the parameters those directions move.
        combinations: what *is* identified among them, as text; empty where nothing is.
    """

    covariance: np.ndarray
    correlation: np.ndarray
    unidentified: list[np.ndarray]
    names: list[str]
    combinations: list[str]

    @property
    def std(self) -> np.ndarray:
        """(k,) standard deviations."""
        return np.sqrt(np.diag(self.covariance))


def assess(residual: np.ndarray, jacobian: np.ndarray, names: tuple[str, ...], bootstraps: int = 400) -> Uncertainty:
    """Uncertainty at the optimum.

    Args:
        residual: (blocks, ...) whitened; the first axis is what the bootstrap resamples.
        jacobian: (blocks, ..., k) its derivatives by relative changes of the named quantities.
        names: of the k parameters.
        bootstraps: resamples of the blocks.

    The covariance is that of the normal equations, by SVD, widened to the block bootstrap's where that is larger: the
    bootstrap sees correlation within a block and a noise model that is not quite right.
    """
    k = len(names)
    residual, jacobian = residual.reshape(len(residual), -1), jacobian.reshape(len(residual), -1, k)
    flat = jacobian.reshape(-1, k)
    # QR first: the SVD of the small triangle has the same singular values without squaring the condition number.
    triangle = np.linalg.qr(flat, mode="r")
    _, singular, rows = np.linalg.svd(triangle)
    loose = singular < max(1 / LOOSEST, 1e-7 * singular[0])
    keep = rows[~loose].T
    covariance = keep @ np.diag(singular[~loose] ** -2.0) @ keep.T
    covariance = np.maximum(1.0, _inflation(jacobian, residual, keep, covariance, bootstraps)) * covariance
    deviation = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    free = [row for row, is_loose in zip(rows, loose, strict=True) if is_loose]
    moved = [name for i, name in enumerate(names) if any(abs(v[i]) > SHARE for v in free)]
    return Uncertainty(covariance, covariance / np.outer(deviation, deviation), free, moved, _combinations(free, names))


def _inflation(jacobian, residual, keep, covariance, bootstraps) -> np.ndarray:
    """(k, k) factor by which the block bootstrap's standard deviations exceed the model's."""
    blocks, k = jacobian.shape[0], jacobian.shape[2]
    if blocks < 8 or keep.shape[1] == 0:
        return np.ones((k, k))
    information = np.einsum("bni,bnj->bij", jacobian, jacobian)
    gradient = np.einsum("bni,bn->bi", jacobian, residual)
    rng = np.random.default_rng(0)
    draws = rng.integers(0, blocks, (bootstraps, blocks))
    moves = []
    for draw in draws:
        # One Gauss-Newton step from the optimum: a refit of the resampled data to first order.
        a, g = information[draw].sum(0), gradient[draw].sum(0)
        moves.append(-keep @ np.linalg.lstsq(keep.T @ a @ keep, keep.T @ g, rcond=None)[0])
    spread = np.std(moves, axis=0)
    ratio = spread / np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    return np.outer(np.maximum(ratio, 1), np.maximum(ratio, 1))


def _combinations(free: list[np.ndarray], names: tuple[str, ...]) -> list[str]:
    """What stays identified within each unidentified direction, in words."""
    found = []
    for direction in free:
        members = [i for i in range(len(names)) if abs(direction[i]) > SHARE]
        if len(members) == 1:
            continue  # nothing: the data do not depend on it
        if any(names[i] in OFFSETS for i in members):
            found.append(f"{', '.join(names[i] for i in members)} only together")
            continue
        # Any power product orthogonal to the direction is identified; pairs with the first member are enough.
        first, *others = members
        for other in others:
            power = -direction[first] / direction[other]
            found.append(f"{names[first]} {_times(names[other], power)}")
    return found


def _times(name: str, power: float) -> str:
    nearest = round(power)
    if nearest and abs(power - nearest) < 0.1 * abs(nearest):
        power = nearest
    exponent = "" if abs(power) == 1 else f"^{abs(power):.3g}"
    return f"{'*' if power > 0 else '/'} {name}{exponent}"
