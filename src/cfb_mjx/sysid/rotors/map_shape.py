"""Where a rotor's cubic does what no rotor does: falls with rotor speed, or is negative."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

SIGMA = 2900.0
"""Reference rotor speed of the paper, and about the fastest a rotor turns, rad/s."""


@dataclass(frozen=True)
class Shape:
    """Where a cubic misbehaves between standstill and ``top``; lists of (from, to), rad/s.

    Attributes:
        falling: stretches in which the curve does not increase with rotor speed.
        negative: stretches in which it is below zero.
        measured: (lowest, highest) measured rotor speed.
        top: where the check ends.
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
        """What to know about the curve, one phrase each."""
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
    """Check a cubic through the origin from standstill to full speed (2900 rad/s, or what was measured beyond).

    Args:
        coefficients: (3,) of s^3, s^2, s.
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
    """Where a quadratic is below zero on (0, top)."""
    roots = np.roots(polynomial)
    real = [float(r.real) for r in roots if abs(r.imag) < 1e-12 and 0 < r.real < top]
    edges = [0.0, *sorted(real), top]
    found = []
    for a, b in itertools.pairwise(edges):
        if np.polyval(polynomial, 0.5 * (a + b)) < 0:
            found.append((a * sigma, b * sigma))
    return tuple(found)
