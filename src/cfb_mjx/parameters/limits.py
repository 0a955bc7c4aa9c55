"""Limits of numbers, declared once beside their units: impossible values are refused, unusual ones give a warning."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
from jax.core import Tracer

from cfb_mjx.errors import CfbError, CfbWarning

_SLACK = 1e-6
"""Relative amount by which a number may exceed a limit: the rounding of single precision."""
_OTHERS = {
    "kg": (("g", 1e-3),),
    "m": (("mm", 1e-3), ("cm", 1e-2)),
    "s": (("ms", 1e-3),),
    "rad": (("deg", math.pi / 180),),
    "rad/s": (("rpm", math.pi / 30),),
    "kg m^2": (("g cm^2", 1e-7), ("g m^2", 1e-3)),
}
"""Other units in which numbers are often given, with factors, by unit."""


@dataclass(frozen=True)
class Limits:
    """Limits of one number, in its unit; all ends belong to the ranges.

    Values outside ``hard_low`` to ``hard_high`` are impossible and refused. Values outside ``soft_low`` to
    ``soft_high`` are unusual and give a warning.
    """

    hard_low: float
    hard_high: float
    soft_low: float
    soft_high: float

    def __post_init__(self):
        if not self.hard_low <= self.soft_low <= self.soft_high <= self.hard_high:
            raise ValueError(f"{self}: soft limits must lie between hard ones")

    def holds(self, value):
        """Whether each number is within the hard limits; NaN is not. For NumPy and JAX, also traced."""
        return (value >= _down(self.hard_low)) & (value <= _up(self.hard_high))

    def usual(self, value):
        """Whether each number is within the soft limits."""
        return (value >= _down(self.soft_low)) & (value <= _up(self.soft_high))

    def check(self, value: Any, name: str, unit: str, warn: bool = False) -> None:
        """Refuse impossible values. Traced numbers are not checked.

        Args:
            value: number or array.
            name: its name in messages, for example "FILE: parameters.mass".
            unit: its unit.
            warn: whether unusual values give a warning.

        Raises:
            CfbError: a number outside the hard limits.
        """
        numbers = concrete(value)
        if numbers is None:
            return
        impossible = np.asarray(~self.holds(numbers))
        if impossible.any():
            said, number = _first(name, numbers, impossible)
            span = _span(self.hard_low, self.hard_high, unit)
            raise CfbError(f"{said} must lie between {span}{self._hint(number, unit)}.")
        unusual = np.asarray(~self.usual(numbers))
        if warn and unusual.any():
            said, number = _first(name, numbers, unusual)
            span = _span(self.soft_low, self.soft_high, unit)
            text = f"{said} is unusual; usually it lies between {span}{self._hint(number, unit)}."
            warnings.warn(text, CfbWarning, stacklevel=3)

    def _hint(self, number: float, unit: str) -> str:
        for other, factor in _OTHERS.get(unit, ()):
            if self.usual(number * factor):
                return f": in {unit}, {number:g} {other} is {number * factor:.6g}"
        return ""


def concrete(value: Any) -> np.ndarray | None:
    """Numbers of an array in float64; None if they are traced, or not all in this process."""
    if isinstance(value, Tracer) or (isinstance(value, jax.Array) and not value.is_fully_addressable):
        return None
    try:
        return np.asarray(value, np.float64)
    except (TypeError, ValueError):
        return None


def _down(limit: float) -> float:
    return limit - _SLACK * abs(limit)


def _up(limit: float) -> float:
    return limit + _SLACK * abs(limit)


def _first(name: str, numbers: np.ndarray, chosen: np.ndarray) -> tuple[str, float]:
    """Text "name[index] = number" of the first chosen number, and the number."""
    index = tuple(map(int, np.argwhere(chosen)[0]))
    number = float(numbers[index])
    return f"{name}{''.join(f'[{i}]' for i in index)} = {number:g}", number


def _span(low: float, high: float, unit: str) -> str:
    return f"{low:g} and {high:g}" + ("" if unit == "1" else f" {unit}")
