"""When an effect counts: material to all flights, or clear and material to one; never by crumbs of a large error."""

import numpy as np
import pytest

from cfb_mjx.sysid.tracing.evidence import Evidence
from cfb_mjx.sysid.tracing.hypothesis import Fit
from cfb_mjx.sysid.tracing.jointly import ERRORS
from cfb_mjx.sysid.tracing.rules import RULES

COUNT = len(ERRORS)


def fit(*flights: float) -> Fit:
    """Errors alike in all quantities, one number per flight."""
    by_flight = np.repeat(np.array(flights, dtype=float)[:, None], COUNT, axis=1)
    return Fit(None, None, np.sqrt(np.mean(by_flight**2, axis=0)), by_flight)


DECLARED = fit(1.0, 1.0, 1.0, 1.0)


def test_a_drop_of_all_flights_is_enough():
    assert RULES.lowers(fit(1.0, 1.0), fit(0.9, 0.9), DECLARED, clear=False)


def test_a_drop_in_one_flight_needs_a_clear_statistic():
    poorer, richer = fit(1.0, 1.0, 1.0, 1.0), fit(0.9, 1.0, 1.0, 1.0)
    assert not RULES.lowers(poorer, richer, DECLARED, clear=False)
    assert RULES.lowers(poorer, richer, DECLARED, clear=True)


def test_crumbs_of_a_large_error_do_not_count():
    declared, poorer, richer = fit(1.0, 1.0), fit(0.1, 0.1), fit(0.09, 0.09)
    assert not RULES.lowers(poorer, richer, declared, clear=True)


def test_getting_worse_is_not_material():
    assert not RULES.lowers(fit(1.0, 1.0), fit(1.2, 1.0), fit(1.0, 1.0), clear=True)


@pytest.mark.parametrize(
    ("gain", "p_value", "tried", "counts"),
    [(30.0, 1e-6, 23, True), (30.0, 1e-3, 23, False), (30.0, 1e-3, 5, True), (4.0, 1e-6, 23, False)],
)
def test_chance_is_counted_once_per_effect_tried(gain, p_value, tried, counts):
    assert RULES.significant(Evidence(gain, RULES.clear, p_value, np.zeros(1)), tried) == counts
