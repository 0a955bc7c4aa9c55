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
        order: (k,) of the names, as the rows of the covariance.
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
        """(k,) standard deviations."""
        return np.sqrt(np.diag(self.covariance))


CLEAR = 4.0
"""What is held is contradicted where a fit would move it by so many of its standard deviations."""


def assess(
    residual: np.ndarray,
    jacobian: np.ndarray,
    names: tuple[str, ...],
    priors: dict[str, float] | None = None,
    blur: np.ndarray | float = 0.0,
    bootstraps: int = 400,
) -> Uncertainty:
    """Uncertainty at the optimum.

    Args:
        residual: (blocks, ...) whitened; the first axis is what the bootstrap resamples.
        jacobian: (blocks, ..., k) its derivatives by relative changes of the named quantities.
        names: of the k parameters.
        priors: standard deviations of what is known without the data, about the optimum.
        blur: (k,) standard deviations that no amount of data makes smaller.
        bootstraps: resamples of the blocks.

    The covariance is that of the normal equations, by SVD, widened to the block bootstrap's where that is larger: the
    bootstrap sees correlation within a block and a noise model that is not quite right.
    """
    k = len(names)
    residual, jacobian = residual.reshape(len(residual), -1), jacobian.reshape(len(residual), -1, k)
    flat = jacobian.reshape(-1, k)
    known = np.diag([1 / (priors or {}).get(name, np.inf) for name in names])
    # QR first: the SVD of the small triangle has the same singular values without squaring the condition number.
    triangle = np.linalg.qr(np.concatenate([flat, known]), mode="r")
    _, singular, rows = np.linalg.svd(triangle)
    loose = singular < max(1 / LOOSEST, 1e-7 * singular[0])
    keep = rows[~loose].T
    covariance = keep @ np.diag(singular[~loose] ** -2.0) @ keep.T
    covariance = np.maximum(1.0, _inflation(jacobian, residual, known**2, keep, covariance, bootstraps)) * covariance
    covariance = covariance + np.diag(np.broadcast_to(blur, k) ** 2)
    deviation = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    free = [row for row, is_loose in zip(rows, loose, strict=True) if is_loose]
    moved = [name for i, name in enumerate(names) if any(abs(v[i]) > SHARE for v in free)]
    correlation = covariance / np.outer(deviation, deviation)
    # With what is free as well, known to a factor of e^10 at least.
    size = np.minimum(1 / np.maximum(singular[loose], 1e-9), 10.0)
    everything = covariance + (rows[loose].T * size**2) @ rows[loose]
    products = _products(everything, len(free), [i for i, name in enumerate(names) if name in moved], names)
    return Uncertainty(covariance, correlation, free, moved, [_told(p) for p, _ in products], names, products)


def most_contradicted(
    residual: np.ndarray, jacobian: np.ndarray, names: tuple[str, ...], free: tuple[str, ...], held: list[str]
) -> str | None:
    """The held quantity that the data would move by most of its standard deviations, if by `CLEAR` or more.

    A score test (Rao 1948): of each held quantity alone, with all that is free following. The score's variance is the
    larger of the model's and that of the blocks.

    Args:
        residual: (blocks, ...) whitened, at the optimum of what is free.
        jacobian: (blocks, ..., k) its derivatives.
        names: of the k quantities.
        free: names that were fitted.
        held: names to test.
    """
    k = len(names)
    residual, jacobian = residual.reshape(len(residual), -1), jacobian.reshape(len(residual), -1, k)
    information = np.einsum("bni,bnj->ij", jacobian, jacobian)
    gradient = np.einsum("bni,bn->bi", jacobian, residual)
    columns = [names.index(name) for name in free]
    following = np.linalg.lstsq(information[np.ix_(columns, columns)], information[columns], rcond=1e-9)[0]
    strongest, found = CLEAR, None
    for name in held:
        i = names.index(name)
        left = information[i, i] - information[i, columns] @ following[:, i]
        if left < max(1 / LOOSEST**2, 1e-7 * information[i, i]):
            continue  # nothing that the data know apart from what is free
        scores = gradient[:, i] - gradient[:, columns] @ following[:, i]
        z = abs(scores.sum()) / np.sqrt(max(left, len(scores) * np.var(scores)))
        if z > strongest:
            strongest, found = z, name
    return found


def _inflation(jacobian, residual, known, keep, covariance, bootstraps) -> np.ndarray:
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
        a, g = information[draw].sum(0) + known, gradient[draw].sum(0)
        moves.append(-keep @ np.linalg.lstsq(keep.T @ a @ keep, keep.T @ g, rcond=None)[0])
    spread = np.std(moves, axis=0)
    ratio = spread / np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    return np.outer(np.maximum(ratio, 1), np.maximum(ratio, 1))


def _products(
    covariance: np.ndarray, unknown: int, members: list[int], names: tuple[str, ...]
) -> list[tuple[dict[str, float], float]]:
    """Products of powers that the data tell of quantities which they do not tell one by one, with relative std.

    As many quantities as there are unknown directions are taken as given, the least known first; each of the others is
    known together with them.
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
    """As text: ``thrust_scale * motor_gain^2``."""
    parts = []
    for name, power in powers.items():
        sign = ("* " if power > 0 else "/ ") if parts else ("" if power > 0 else "1 / ")
        parts.append(f"{sign}{name}" + ("" if abs(power) == 1 else f"^{abs(power):.3g}"))
    return " ".join(parts)


def _told(powers: dict[str, float]) -> str:
    if any(name in OFFSETS for name in powers):
        return f"{', '.join(powers)} only together"
    return power_product(powers)
