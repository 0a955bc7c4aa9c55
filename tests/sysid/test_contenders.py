"""In which order the effects that explain the flights about as well are tried, and that one in vain ends nothing."""

from dataclasses import asdict
from types import SimpleNamespace

import numpy as np
import pytest

from cfb_mjx.sysid.tracing import trace
from cfb_mjx.sysid.tracing.evidence import Evidence
from cfb_mjx.sysid.tracing.hypothesis import Fit, Hypothesis
from cfb_mjx.sysid.tracing.jointly import ERRORS
from cfb_mjx.sysid.tracing.rules import RULES

NOTHING = Fit(SimpleNamespace(present=()), None, np.ones(len(ERRORS)), np.ones((1, len(ERRORS))))


def _ranking(gains: dict[str, tuple[float, int]]) -> list:
    columns = {name: [SimpleNamespace(effect=name)] * numbers for name, (_, numbers) in gains.items()}
    return [(Evidence(gain, 20.0, 1e-9, np.zeros(1)), columns[name]) for name, (gain, _) in gains.items()]


@pytest.fixture
def contest(monkeypatch):
    """Run `contenders` on made-up fits: gain when ranked, numbers, gain when fitted, error left, plausible."""

    def run(**made):
        fits = {
            name: Fit(
                SimpleNamespace(name=name, shift=0.0), None, np.full(len(ERRORS), error), np.ones((1, len(ERRORS)))
            )
            for name, (_, _, _, error, _) in made.items()
        }
        rules = SimpleNamespace(**asdict(RULES), stretched=lambda hypothesis, name: not made[name][4])
        search = SimpleNamespace(with_candidate=lambda hypothesis, variant, found: variant[0].effect, rules=rules)
        monkeypatch.setattr(trace, "fitted", lambda search, name, whole: fits[name])
        monkeypatch.setattr(trace, "confirm", lambda search, poorer, richer: SimpleNamespace(gain=made[richer.name][2]))
        monkeypatch.setattr(trace, "_without_lead", lambda search, hypothesis: np.log(made[hypothesis.name][3]))
        ranking = _ranking({name: (gain, numbers) for name, (gain, numbers, *_) in made.items()})
        options, stretched = trace.contenders(search, NOTHING, ranking, lambda _: None)
        return [name for name, _ in options], stretched

    return run


def test_the_likeliest_comes_first_and_the_others_wait(contest):
    found = contest(drag=(100, 1, 300.0, 0.9, True), wind=(90, 1, 500.0, 0.7, True), inertia=(80, 3, 400.0, 0.8, True))
    assert found == (["wind", "inertia", "drag"], set())


def test_of_those_that_gain_nearly_the_same_the_better_predictor_comes_first(contest):
    assert contest(delay=(100, 1, 2600.0, 0.95, True), lag=(98, 1, 2500.0, 0.85, True))[0] == ["lag", "delay"]
    assert contest(delay=(100, 1, 2600.0, 0.95, True), lag=(98, 1, 2000.0, 0.85, True))[0] == ["delay", "lag"]


def test_where_all_explain_less_than_what_is_there_the_search_goes_on(contest):
    made = {"delay": (100, 1, -20.0, 1.0, True), "lag": (98, 1, -50.0, 1.1, True)}
    assert contest(**made)[0] == ["delay", "lag"]
    diverged = {"delay": (100, 1, 20.0, np.inf, True), "lag": (98, 1, 19.0, np.inf, True)}
    assert contest(**diverged)[0][0] == "delay"


def test_predictions_that_diverge_are_worse_than_all_others(monkeypatch):
    search = SimpleNamespace(settled=lambda hypothesis, lead_free: hypothesis)
    for error, expected in ((np.nan, np.inf), (np.inf, np.inf), (1.0, 0.0)):
        monkeypatch.setattr(trace, "prediction_errors", lambda search, held, e=error: np.array([1.0, e]))
        assert trace._without_lead(search, Hypothesis(())) == expected


def test_of_those_that_predict_alike_too_the_one_with_fewer_numbers_comes_first(contest):
    assert contest(gains=(100, 4, 1000.0, 0.8, True), level=(98, 1, 990.0, 0.8, True))[0] == ["level", "gains"]


def test_the_stretched_and_the_far_behind_are_not_tried(contest):
    options, stretched = contest(
        drag=(100, 1, 300.0, 0.9, True), wind=(90, 1, 500.0, 0.7, False), gyroscopic=(10, 1, 600.0, 0.5, True)
    )
    assert options == ["drag"]
    assert stretched == {"wind"}
