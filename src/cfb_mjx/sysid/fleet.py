"""Model of a type of drone from fits of several drones: common values and the spread between drones.

Every drone is fitted on its own with the same parameters. A parameter of drone i is ``m + d_i + e_i``: ``m`` is the
value of the type, ``d_i`` the drone's deviation with standard deviation ``spread``, and ``e_i`` the error of the fit,
whose covariance is known. For each parameter, the spread is the scatter of the fits minus the part that their errors
explain (Hedges and Olkin, Statistical Methods for Meta-Analysis, 1985, ch. 9). The values of the type are the
generalised least-squares mean with the full covariance of every fit, so parameters that one fit cannot separate are
separated by the others.
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
    """Fit of one drone.

    Attributes:
        name: of the drone.
        numbers: the n fitted parameters.
        values: (n,) of the parameters.
        covariance: (n, n) of their errors; zero for a parameter at a bound.
    """

    name: str
    numbers: tuple[Number, ...]
    values: Float[np.ndarray, " n"]
    covariance: Float[np.ndarray, "n n"]

    @classmethod
    def fitted(cls, name: str, fit: Refinement) -> OfDrone:
        """Create from a refinement, with its standard deviations (which account for overlapping windows)."""
        deviations = np.nan_to_num(fit.deviations)
        covariance = np.nan_to_num(fit.correlation) * np.outer(deviations, deviations)
        return cls(name, fit.numbers, fit.values, covariance)


@dataclass(frozen=True)
class Fleet:
    """Parameters of a type of drone.

    Attributes:
        numbers: the n fitted parameters.
        values: (n,) of the type.
        std: (n,) standard deviations of the values.
        spread: (n,) standard deviations between drones.
        drones: (n,) number of drones to which each parameter was fitted.
    """

    numbers: tuple[Number, ...]
    values: Float[np.ndarray, " n"]
    std: Float[np.ndarray, " n"]
    spread: Float[np.ndarray, " n"]
    drones: Float[np.ndarray, " n"]

    def mappings(self, source: str) -> list[dict[str, Any]]:
        """Effects in the format of a model file, each with ``uncertainty`` and ``spread``.

        Args:
            source: origin of the values, for the file.
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
    """Combine the fits of several drones of one type.

    Args:
        drones: fits of the same parameters; a parameter may be missing in some of them.
        own: names of effects that are specific to a drone. The type's value is neutral, and the spread is the scatter
            about it.

    Raises:
        CfbError: there are fewer than two drones.
    """
    if len(drones) < 2:
        raise CfbError("the spread between drones cannot be determined from one; give the fits of at least two.")
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
    # A parameter with neither scatter nor uncertainty (all fits at one bound) still needs a positive variance.
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
    """The parameter with standard bounds, so that parameters with different bounds compare equal."""
    return Number(number.effect, number.field, number.index, -1.0, 1.0)
