"""Effects few blocks excite: what held-out flights must show of them, told from stand-ins for the fits."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from cfb_mjx.sysid.tracing import trace
from cfb_mjx.sysid.tracing.evidence import Evidence
from cfb_mjx.sysid.tracing.hypothesis import Fit, Hypothesis, neutral_effects, strengths
from cfb_mjx.sysid.tracing.rules import RULES
from cfb_mjx.sysid.tracing.trace import Found, Trace

NAMES = ("rotor_drag", "torque_scale", "gyroscopic")


@pytest.fixture
def tried(monkeypatch):
    """Names found where rotor drag is known; ``evidence`` (gain, t) by name on the fit flights, and what others say."""
    effects = neutral_effects(NAMES)
    base = Hypothesis(effects, ("rotor_drag",), origin=effects)

    def fit_of(hypothesis):
        return Fit(hypothesis, None, np.full(8, 0.9 ** len(hypothesis.present)), np.ones((1, 8)))

    def run(evidence, statistic=9.0, with_it=0.5, impossible=(), rules=RULES):
        asked = []

        def rank(search, fit, refused):
            left = [name for name in evidence if name not in {*fit.hypothesis.present, *refused}]
            pairs = [(Evidence(*evidence[name], 0.01, np.zeros(1)), strengths(name)[0]) for name in left]
            return sorted(pairs, key=lambda pair: -pair[0].gain)

        def richer(hypothesis, variant, _):
            asked.append(variant[0].effect)
            return hypothesis.having(hypothesis.effect(variant[0].effect))

        def errors(_, one):
            return np.full(8, with_it if len(one.present) > 1 else 1.0)

        def left_out(search, hypothesis, name):
            return SimpleNamespace(fit=fit_of(hypothesis.without(name)))

        monkeypatch.setattr(trace, "rank", rank)
        monkeypatch.setattr(trace, "fitted", lambda search, one, whole: fit_of(one))
        monkeypatch.setattr(trace, "completed", lambda search, fit: fit)
        monkeypatch.setattr(trace, "confirm", lambda *_: SimpleNamespace(t=statistic))
        monkeypatch.setattr(trace, "prediction_errors", errors)
        monkeypatch.setattr(trace, "leave_out", left_out)
        monkeypatch.setattr(trace, "summary", lambda s, f, name, less: Found(name, 0.01, 9.0, 0.1, {}, {}, [], base))
        search = SimpleNamespace(with_candidate=richer, rules=rules)
        judging = SimpleNamespace(
            weakly_excited_sure=rules.weakly_excited_sure,
            lowered=rules.lowered,
            stretched=lambda _, name: name in impossible,
        )
        judge = SimpleNamespace(nothing=lambda: base.without("rotor_drag"), rules=judging)
        first = Found("rotor_drag", 1e-9, 99.0, 0.4, {}, {}, [], base)
        found = Trace(base, None, [first], [], search, np.ones(8), np.ones(8), fit_of(base))
        result = trace.with_weakly_excited(found, judge)
        assert set(result.hypothesis.present) == {item.name for item in result.found}
        return [item.name for item in result.found], asked, result

    return run


def test_an_effect_that_held_out_flights_bear_out_is_taken_with_what_it_buys_there(tried):
    names, _, result = tried({"torque_scale": (20.0, 3.0)})
    assert names == ["torque_scale", "rotor_drag"]
    assert result.found[0].buys == pytest.approx(0.5)
    assert result.fit.hypothesis is result.hypothesis


@pytest.mark.parametrize(
    ("evidence", "statistic", "with_it"),
    [
        ((20.0, 1.9), 9.0, 0.5),  # says too little on the fit flights
        ((7.0, 3.0), 9.0, 0.5),
        ((20.0, 3.0), 3.9, 0.5),  # not borne out
        ((20.0, 3.0), 9.0, 0.95),  # matters too little
        ((20.0, 3.0), 9.0, 1.2),  # predicts worse
    ],
)
def test_an_effect_is_left_where_one_condition_fails(tried, evidence, statistic, with_it):
    names, _, _ = tried({"torque_scale": evidence}, statistic, with_it)
    assert names == ["rotor_drag"]


def test_no_more_than_two_are_tried_and_one_that_needs_an_impossible_strength_is_not_taken(tried):
    evidence = {"torque_scale": (20.0, 3.0), "gyroscopic": (30.0, 3.0)}
    names, asked, _ = tried(evidence, impossible=("gyroscopic",))
    assert asked == ["gyroscopic", "torque_scale"]
    assert "gyroscopic" not in names
    assert tried(evidence, rules=replace(RULES, weakly_excited_tried=1))[1] == ["gyroscopic"]
