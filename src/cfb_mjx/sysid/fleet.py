"""One model of a type of drone, from fits of several: what all have in common, and how far they differ.

Every drone is fitted on its own with the same numbers. A number of drone i is ``m + d_i + e_i``: ``m`` that of the
type, ``d_i`` the drone's own part, of standard deviation ``spread``, ``e_i`` the fit's error, whose covariance is
known. The spread follows from the scatter of the fits less what their errors explain (Hedges and Olkin, Statistical
Methods for Meta-Analysis, 1985, ch. 9), number by number; the type's numbers then are the generalised least-squares
mean with the whole covariance of every fit, so that what one fit cannot tell apart is told by the others.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from cfb_mjx.errors import CfbError
from cfb_mjx.model.effects import KNOWN, effect_to_mapping
from cfb_mjx.sysid.refinement import Number, Refinement


@dataclass(frozen=True)
class OfDrone:
    """What was fitted to one drone.

    Attributes:
        name: of the drone.
        numbers: what was fitted.
        values: of them.
        covariance: of their errors; zero where one stands at a bound.
    """

    name: str
    numbers: tuple[Number, ...]
    values: Float[np.ndarray, " n"]
    covariance: Float[np.ndarray, "n n"]

    @classmethod
    def fitted(cls, name: str, fit: Refinement) -> OfDrone:
        """From a fit: its deviations, which heed that windows overlap, with its correlation."""
        deviations = np.nan_to_num(fit.deviations)
        covariance = np.nan_to_num(fit.correlation) * np.outer(deviations, deviations)
        return cls(name, fit.numbers, fit.values, covariance)


@dataclass(frozen=True)
class Fleet:
    """The type of drone.

    Attributes:
        numbers: that were fitted to the drones.
        values: of the type.
        std: of the values.
        spread: standard deviation between drones.
        drones: how many tell each number.
    """

    numbers: tuple[Number, ...]
    values: Float[np.ndarray, " n"]
    std: Float[np.ndarray, " n"]
    spread: Float[np.ndarray, " n"]
    drones: Float[np.ndarray, " n"]

    def mappings(self, source: str) -> list[dict[str, Any]]:
        """Its effects as a model file has them, each with ``uncertainty`` and ``spread``.

        Args:
            source: of the numbers, for the file.
        """
        found = {}
        for number, value, std, spread in zip(self.numbers, self.values, self.std, self.spread, strict=True):
            if number.effect not in found:
                neutral = effect_to_mapping(KNOWN[number.effect].neutral())
                found[number.effect] = neutral | {"source": source, "uncertainty": {}, "spread": {}}
            parts = zip(("parameters", "uncertainty", "spread"), (value, std, spread), strict=True)
            for part, one in parts:
                held = found[number.effect][part]
                if number.index is None:
                    held[number.field] = float(one)
                else:
                    held.setdefault(
                        number.field, [0.0] * np.size(getattr(KNOWN[number.effect].neutral(), number.field))
                    )[number.index] = float(one)
        return list(found.values())


def fleet(drones: Sequence[OfDrone], own: Collection[str] = ()) -> Fleet:
    """What several drones of a type have in common.

    Args:
        drones: fits of the same numbers; one that a drone lacks is told by the others.
        own: effects that are a drone's alone: the type's value is neutral, the spread the scatter about it.

    Raises:
        CfbError: fewer than two drones.
    """
    if len(drones) < 2:
        raise CfbError("one drone says nothing of how drones differ; give the fits of at least two.")
    numbers = tuple(dict.fromkeys(_key(n) for drone in drones for n in drone.numbers))
    places = [[numbers.index(_key(n)) for n in drone.numbers] for drone in drones]
    count = len(numbers)
    values, errors = np.full((len(drones), count), np.nan), np.full((len(drones), count), np.nan)
    for i, (drone, at) in enumerate(zip(drones, places, strict=True)):
        values[i, at], errors[i, at] = drone.values, np.diag(drone.covariance)
    told = np.isfinite(values).sum(axis=0)
    neutral = np.array([n.of_neutral() for n in numbers])
    alone = np.array([n.effect in own for n in numbers])
    about = np.where(alone, neutral, np.nanmean(values, axis=0))
    free = np.where(alone, told, np.maximum(told - 1, 1))
    scatter = np.nansum((values - about) ** 2, axis=0) / free
    between = np.maximum(scatter - np.nanmean(errors, axis=0), 0.0)
    # What neither scatters nor is unsure (all fits at one bound) still needs a scale.
    least = np.array([1e-6 * n.scale for n in numbers]) ** 2
    matrix, pull = np.zeros((count, count)), np.zeros(count)
    for drone, at in zip(drones, places, strict=True):
        weight = np.linalg.inv(drone.covariance + np.diag((between + least)[at]))
        matrix[np.ix_(at, at)] += weight
        pull[at] += weight @ drone.values
    inside = np.flatnonzero(~alone)
    found, std = neutral.copy(), np.zeros(count)
    inverse = np.linalg.inv(matrix[np.ix_(inside, inside)])
    found[inside] = neutral[inside] + inverse @ (pull[inside] - matrix[np.ix_(inside, np.arange(count))] @ neutral)
    std[inside] = np.sqrt(np.diag(inverse))
    return Fleet(numbers, found, std, np.sqrt(between), told)


def _key(number: Number) -> Number:
    """The number whatever its bounds."""
    return Number(number.effect, number.field, number.index, -1.0, 1.0)
