"""What a formula makes needless, told from stand-ins for the fits."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from cfb_mjx.sysid.tracing import formula
from cfb_mjx.sysid.tracing.formula import Selection
from cfb_mjx.sysid.tracing.hypothesis import Hypothesis, neutral_effects, term_columns
from cfb_mjx.sysid.tracing.rules import RULES


class _Search:
    rules = RULES
    names = ("wind", "rotor_drag")

    def settled(self, hypothesis):
        return hypothesis


@pytest.mark.parametrize(("without_wind", "left"), [(1.0, ("rotor_drag",)), (2.0, ("wind", "rotor_drag"))])
def test_wind_gives_way_to_a_place_only_if_nothing_misses_it(monkeypatch, without_wind, left):
    """Constant forces come with the place when wind goes, and go with it when wind stays."""
    effects = neutral_effects(_Search.names)
    hypothesis = Hypothesis(effects, _Search.names, origin=effects)
    slope = next(c for c in term_columns(3) if c.field == "place" and c.index == (0, 1))

    def errors(_, one):
        # A formula halves what the declared model scores; rotor drag is missed in any case.
        scored = 0.5 * (without_wind if "wind" not in one.present else 1.0) if one.terms else 1.0
        return np.full(8, scored * (1.0 if "rotor_drag" in one.present else 3.0))

    def said(_, one, name, terms):
        assert set(terms) <= set(one.terms)  # a formula is asked for no term that is not its own
        return False

    monkeypatch.setattr(formula, "with_library", lambda search, one: (search, one))
    monkeypatch.setattr(formula, "select", lambda *_: Selection([slope], gains={slope: 9.0}))
    monkeypatch.setattr(formula, "fit_formula", lambda _, one, terms: (replace(one, terms=tuple(terms)), None))
    monkeypatch.setattr(formula, "prediction_errors", errors)
    monkeypatch.setattr(formula, "mimicked", said)
    monkeypatch.setattr(formula, "terms_of", lambda one, *_: list(one.terms))
    found = SimpleNamespace(
        search=_Search(), hypothesis=hypothesis, declared_errors=np.full(8, 1.0), errors=np.full(8, 1.0)
    )
    _, proposal = formula.explain(found)
    assert proposal.hypothesis.present == left
    assert slope in proposal.terms
    assert len(proposal.terms) == (1 if "wind" in left else 4)


@pytest.fixture
def rare(monkeypatch):
    """A function of the statistic of a rare term and of the errors with it: whether `_with_weakly_excited` keeps it."""
    sure, seldom = (c for c in term_columns(3) if c.field == "place" and c.index in ((0, 1), (0, 2)))
    effects = neutral_effects(_Search.names)
    base = Hypothesis(effects, (), origin=effects)

    def run(statistic: float, with_it: float):
        def errors(_, one):
            return np.full(8, with_it if seldom in one.terms else 0.8 if one.terms else 1.0)

        monkeypatch.setattr(formula, "with_library", lambda search, one: (search, one))
        monkeypatch.setattr(formula, "fit_formula", lambda _, one, terms: (replace(one, terms=tuple(terms)), None))
        monkeypatch.setattr(formula, "prediction_errors", errors)
        monkeypatch.setattr(formula, "confirm", lambda *_: SimpleNamespace(t=statistic))
        held_out = SimpleNamespace(nothing=lambda: base, rules=RULES)
        found = formula._with_weakly_excited(_Search(), base, [sure], Selection([sure], [[seldom]]), held_out)
        return found == [sure, seldom]

    return run


def test_a_rare_term_is_kept_if_other_flights_bear_it_out_and_it_matters_there(rare):
    assert rare(statistic=6.0, with_it=0.5)
    assert not rare(statistic=2.0, with_it=0.5)
    assert not rare(statistic=6.0, with_it=0.79)


@pytest.mark.parametrize(("with_terms", "told"), [(0.5, True), (0.7, False)])
def test_what_held_out_flights_alone_show_must_be_large_beside_effects_fitted_to_them(monkeypatch, with_terms, told):
    slope = next(c for c in term_columns(3) if c.field == "place" and c.index == (0, 1))
    effects = neutral_effects(_Search.names)
    base = Hypothesis(effects, ("rotor_drag",), origin=effects)

    def fitted(_, one, terms):
        return replace(one, terms=tuple(terms), present=(*one.present, "fitted")), None

    def errors(_, one):
        # As found on other flights 1.0; fitted to these, the same effects score 0.8.
        return np.full(8, with_terms if one.terms else 0.8 if "fitted" in one.present else 1.0)

    monkeypatch.setattr(formula, "with_library", lambda search, one: (search, one))
    monkeypatch.setattr(formula, "select", lambda *_: Selection([slope]))
    monkeypatch.setattr(formula, "fit_formula", fitted)
    monkeypatch.setattr(formula, "prediction_errors", errors)
    monkeypatch.setattr(formula, "terms_of", lambda one, *_: list(one.terms))
    held_out = SimpleNamespace(nothing=lambda: base, rules=RULES)
    assert formula.only_there(held_out, base) == ([slope] if told else [])
