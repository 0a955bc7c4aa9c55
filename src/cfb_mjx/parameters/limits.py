"""Where a number may lie, declared once beside its unit: what cannot be is refused, what is unusual is warned of."""

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
"""Share of a limit by which a number may pass it: what single precision does to it."""
_OTHERS = {
    "kg": (("g", 1e-3),),
    "m": (("mm", 1e-3), ("cm", 1e-2)),
    "s": (("ms", 1e-3),),
    "rad": (("deg", math.pi / 180),),
    "rad/s": (("rpm", math.pi / 30),),
    "kg m^2": (("g cm^2", 1e-7), ("g m^2", 1e-3)),
}
"""What numbers are often written in instead of their unit."""


@dataclass(frozen=True)
class Limits:
    """Of one number, in its unit; all ends belong to the ranges.

    From ``hard_low`` to ``hard_high`` lies what can be; what lies beyond is refused. From ``soft_low`` to ``soft_high``
    lies what laboratories do; of what lies beyond a user is warned.
    """

    hard_low: float
    hard_high: float
    soft_low: float
    soft_high: float

    def __post_init__(self):
        if not self.hard_low <= self.soft_low <= self.soft_high <= self.hard_high:
            raise ValueError(f"{self}: soft limits must lie between hard ones")

    def holds(self, value):
        """Whether numbers lie within the hard limits, one by one; NaN does not. NumPy or jax, also traced."""
        return (value >= _down(self.hard_low)) & (value <= _up(self.hard_high))

    def usual(self, value):
        """Whether numbers lie within the soft limits."""
        return (value >= _down(self.soft_low)) & (value <= _up(self.soft_high))

    def check(self, value: Any, name: str, unit: str, warn: bool = False) -> None:
        """Refuse what cannot be. Nothing is said of traced numbers.

        Args:
            value: number or array.
            name: of it, for messages: "FILE: parameters.mass".
            unit: of it.
            warn: also warn of what is unusual.

        Raises:
            CfbError: a number beyond the hard limits, named.
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
            text = f"{said} is unusual; mostly it lies between {span}{self._hint(number, unit)}."
            warnings.warn(text, CfbWarning, stacklevel=3)

    def _hint(self, number: float, unit: str) -> str:
        for other, factor in _OTHERS.get(unit, ()):
            if self.usual(number * factor):
                return f": in {unit}, {number:g} {other} is {number * factor:.6g}"
        return ""


def concrete(value: Any) -> np.ndarray | None:
    """The numbers of an array in float64; None where they are not known yet (traced), or not in this process."""
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
    """The first of the chosen numbers, and how it is written."""
    index = tuple(map(int, np.argwhere(chosen)[0]))
    number = float(numbers[index])
    return f"{name}{''.join(f'[{i}]' for i in index)} = {number:g}", number


def _span(low: float, high: float, unit: str) -> str:
    return f"{low:g} and {high:g}" + ("" if unit == "1" else f" {unit}")
