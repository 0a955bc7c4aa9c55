"""Which terms of the library stand beside what was found, told from inner products of made-up signals."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from cfb_mjx.model.effects.formula import PLACES
from cfb_mjx.sysid.tracing.formula import select
from cfb_mjx.sysid.tracing.hypothesis import LEAD, Column, Linear, term_columns
from cfb_mjx.sysid.tracing.rules import RULES

BLOCKS, ROWS, AXIS = 60, 200, 3


def _selected(signals: dict[str, np.ndarray], residual: np.ndarray):
    """Select among places along world x; ``signals`` and ``residual`` are (blocks, rows), noise is added."""
    rng = np.random.default_rng(0)
    residual = residual + rng.standard_normal(residual.shape)
    columns = [Column(LEAD, LEAD, None, (), 0.25)]
    columns += [c for c in term_columns(AXIS) if c.field == "place" and list(PLACES)[c.index[1]] in signals]
    # Derivatives are by the numbers themselves, which are counted in units of their scale.
    slopes = [rng.standard_normal(residual.shape)]
    slopes += [signals[list(PLACES)[c.index[1]]] / c.scale for c in columns[1:]]
    stacked = np.stack([residual, *slopes], axis=-1)
    blocks = np.einsum("brc,brd->bcd", stacked, stacked)
    linear = Linear(columns, blocks)
    search = SimpleNamespace(
        own_columns=lambda hypothesis: [], linearise_terms=lambda hypothesis, own: [linear], rules=RULES
    )
    chosen = select(search, None)
    return [list(PLACES)[c.index[1]] for c in chosen.sure], [
        [list(PLACES)[c.index[1]] for c in group] for group in chosen.weakly_excited
    ]


@pytest.fixture
def place():
    x, y = np.random.default_rng(1).uniform(-1.0, 1.0, (2, BLOCKS, ROWS))
    return {"x": x, "x^2": x**2, "y": y, "y^2": y**2}


def test_nothing_stands_on_noise(place):
    assert _selected(place, np.zeros((BLOCKS, ROWS))) == ([], [])


def test_a_slope_stands_alone(place):
    assert _selected(place, 0.3 * place["x"]) == (["x"], [])


def test_a_square_never_stands_without_its_coordinate(place):
    """Where a room's origin lies means nothing to a drone."""
    assert _selected(place, 0.5 * place["x^2"]) == (["x", "x^2"], [])


def test_what_few_blocks_excite_is_set_apart(place):
    """However much it gains there: flights nothing was fitted to have to bear it out."""
    few = place["x"] * np.where(np.arange(BLOCKS) < 5, 1.0, 0.01)[:, None]
    uneven = few * np.where(np.arange(BLOCKS) % 2, 0.9, 0.3)[:, None]
    sure, rare = _selected(place | {"x": few, "x^2": few**2}, uneven)
    assert sure == []
    assert rare == [["x"]]
