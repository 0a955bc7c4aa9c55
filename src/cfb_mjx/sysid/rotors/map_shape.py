"""Check of a rotor's fitted cubic: where it falls with rotor speed or is negative, which no rotor does."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

SIGMA = 2900.0
"""Reference rotor speed of the paper, and about the fastest a rotor turns, rad/s."""


@dataclass(frozen=True)
class Shape:
    """Ranges of rotor speed (from, to), rad/s, in which a cubic is unphysical, between standstill and ``top``.

    Attributes:
        falling: ranges in which the curve does not increase with rotor speed.
        negative: ranges in which the curve is negative.
        measured: lowest and highest measured rotor speed, rad/s.
        top: upper end of the check, rad/s.
    """

    falling: tuple[tuple[float, float], ...]
    negative: tuple[tuple[float, float], ...]
    measured: tuple[float, float]
    top: float

    @property
    def increasing_where_measured(self) -> bool:
        """Whether the curve increases over the whole measured range."""
        low, high = self.measured
        return not any(a < high and b > low for a, b in self.falling)

    def notes(self) -> list[str]:
        """Remarks on the curve, one phrase each."""
        low, high = self.measured
        found = []
        for word, stretches in (("negative", self.negative), ("does not increase", self.falling)):
            for a, b in stretches:
                inside = a < high and b > low
                place = (
                    "within the measured range" if inside else "outside the measured range, an artefact of the cubic"
                )
                found.append(f"{word} from {a:.0f} to {b:.0f} rad/s ({place})")
        return found


def shape_of(coefficients: np.ndarray, measured: tuple[float, float], sigma: float = SIGMA) -> Shape:
    """Check a cubic through the origin from standstill to full speed (2900 rad/s, or the highest measured speed).

    Args:
        coefficients: (3,) of s^3, s^2, s with ``s = Omega / sigma``.
        measured: lowest and highest measured rotor speed, rad/s.
        sigma: reference rotor speed, rad/s.
    """
    c3, c2, c1 = coefficients
    top = max(SIGMA, measured[1])
    return Shape(
        falling=_stretches([3 * c3, 2 * c2, c1], top / sigma, sigma),
        negative=_stretches([c3, c2, c1], top / sigma, sigma),
        measured=measured,
        top=top,
    )


def _stretches(polynomial: list[float], top: float, sigma: float) -> tuple[tuple[float, float], ...]:
    """Ranges in (0, top) in which a polynomial is negative, scaled by ``sigma``."""
    roots = np.roots(polynomial)
    real = [float(r.real) for r in roots if abs(r.imag) < 1e-12 and 0 < r.real < top]
    edges = [0.0, *sorted(real), top]
    found = []
    for a, b in itertools.pairwise(edges):
        if np.polyval(polynomial, 0.5 * (a + b)) < 0:
            found.append((a * sigma, b * sigma))
    return tuple(found)
