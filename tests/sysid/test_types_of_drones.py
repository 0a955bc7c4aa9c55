"""What drones of a type have in common, on fits drawn from a type that is known."""

from __future__ import annotations

import numpy as np
import pytest

from cfb_mjx.errors import CfbError
from cfb_mjx.model.effects import effect_from_mapping
from cfb_mjx.sysid.fleet import OfDrone, fleet
from cfb_mjx.sysid.refinement import Number

NUMBERS = (
    Number("rotor_drag", "coefficient", None, 0.0, 0.05),
    Number("thrust_scale", "relative", None, -0.3, 0.3),
    Number("cog_offset", "offset", 0, -0.01, 0.01),
    Number("cog_offset", "offset", 1, -0.01, 0.01),
)
TYPE, SPREAD = np.array([0.015, -0.12, 0.0, 0.0]), np.array([0.002, 0.02, 2e-4, 2e-4])


def drones(rng, count, error=0.3, numbers=NUMBERS):
    """Fits of drones of the type, with errors as large as ``error`` spreads, two numbers' going together."""
    found = []
    for i in range(count):
        std = error * SPREAD * rng.uniform(0.5, 1.5, 4)
        correlation = np.eye(4)
        correlation[0, 1] = correlation[1, 0] = 0.8
        covariance = correlation * np.outer(std, std)
        values = rng.normal(TYPE, SPREAD) + rng.multivariate_normal(np.zeros(4), covariance)
        kept = [NUMBERS.index(n) for n in numbers]
        found.append(OfDrone(f"drone {i}", tuple(numbers), values[kept], covariance[np.ix_(kept, kept)]))
    return found


def test_the_type_and_its_spread_come_back_with_honest_errors():
    rng = np.random.default_rng(0)
    inside, spreads = [], []
    for _ in range(300):
        found = fleet(drones(rng, 8), own=("cog_offset",))
        inside.append(np.abs(found.values - TYPE)[:2] < 1.96 * found.std[:2])
        spreads.append(found.spread**2)
    # With eight drones the spread itself is uncertain; a normal interval then covers a little less.
    assert np.all(np.abs(np.mean(inside, axis=0) - 0.92) < 0.05)
    assert np.sqrt(np.mean(spreads, axis=0)) == pytest.approx(SPREAD, rel=0.1)
    assert np.all(found.values[2:] == 0)
    assert np.all(found.std[2:] == 0)


def test_the_mean_heeds_which_drones_know():
    """Of two numbers that one fit cannot tell apart it tells the sum; another drone's fit then tells both."""
    pair = NUMBERS[:2]
    blurred = np.array([[1.0, -0.999], [-0.999, 1.0]]) * np.outer([0.01, 0.1], [0.01, 0.1])
    sharp = np.diag([1e-4, 1e-3]) ** 2
    shift = np.array([0.01, -0.1])  # along what the first cannot tell
    fits = [OfDrone("a", pair, TYPE[:2] + shift, blurred), *(OfDrone(n, pair, TYPE[:2], sharp) for n in "bc")]
    found = fleet(fits)
    assert found.values == pytest.approx(TYPE[:2], abs=1e-3)
    assert np.abs(np.mean([f.values for f in fits], axis=0) - TYPE[:2]).max() > 3e-3


def test_numbers_that_a_drone_lacks_are_told_by_the_others():
    rng = np.random.default_rng(1)
    fits = [*drones(rng, 3), *drones(rng, 2, numbers=NUMBERS[:1])]
    found = fleet(fits)
    assert list(found.drones) == [5, 3, 3, 3]
    mapping = {item["name"]: item for item in found.mappings("flights")}
    assert len(mapping["cog_offset"]["parameters"]["offset"]) == 2
    for item in mapping.values():
        effect_from_mapping(item, "fleet")
        assert item["uncertainty"].keys() == item["spread"].keys()
        assert item["source"] == "flights"


def test_one_drone_is_no_fleet():
    with pytest.raises(CfbError, match="at least two"):
        fleet(drones(np.random.default_rng(2), 1))


def test_what_stands_at_a_bound_counts_as_it_is():
    numbers = NUMBERS[:1]
    fits = [OfDrone(n, numbers, np.array([0.05]), np.zeros((1, 1))) for n in "ab"]
    found = fleet(fits)
    assert found.values == pytest.approx([0.05])
    assert found.spread == pytest.approx([0.0])
