"""What `cfb_mjx.bench.scaling` measures: one core and two, in processes bound to them."""

import os

import pytest

from cfb_mjx.bench.scaling import scaling

SEVERAL = hasattr(os, "sched_getaffinity") and len(os.sched_getaffinity(0)) > 1


@pytest.mark.skipif(not SEVERAL, reason="needs two cores")
def test_one_core_and_two_are_measured():
    one, two = scaling(repetitions=2, drones={"rollout": 64})
    assert (one["what"], one["devices"], one["ratio"]) == ("rollout", 1, 1.0)
    assert (two["what"], two["devices"]) == ("rollout", 2)
    assert two["ratio"] == pytest.approx(two["steps_per_s"] / one["steps_per_s"])
    assert one["steps_per_s"] > 1e3


@pytest.mark.skipif(not SEVERAL, reason="needs two cores")
def test_where_one_core_is_all_there_is_nothing_is_measured(monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0})
    assert scaling() == []
