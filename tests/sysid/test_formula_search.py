"""What a formula makes needless, told from stand-ins for the fits."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from cfb_mjx.sysid.tracing import formula
from cfb_mjx.sysid.tracing.columns import neutral_effects, term_columns
from cfb_mjx.sysid.tracing.search import Hypothesis


class _Search:
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
    monkeypatch.setattr(formula, "propose", lambda *_: ([slope], {slope: 9.0}))
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
