"""Signals of a formula's terms, drawn from the drivers of residuals, are those the formula acts on."""

from __future__ import annotations

import numpy as np
import pytest

from cfb_mjx.model.effects.formula import PLACES, TERMS
from cfb_mjx.model.rotors import TORQUE_SIGNS
from cfb_mjx.sysid.tracing.formula import Term
from cfb_mjx.sysid.tracing.residuals import PATTERNS, UNITS
from cfb_mjx.sysid.tracing.structure import Pooled
from cfb_mjx.view.closing_figures import panels_of, signal_of


@pytest.fixture
def drivers():
    rng = np.random.default_rng(0)
    return {name: rng.standard_normal(50) for name in UNITS}


@pytest.mark.parametrize("name", [*TERMS, *PLACES])
def test_every_signal_of_the_library_can_be_drawn(drivers, name):
    values = signal_of(name, drivers)
    assert values.shape == (50,)
    assert np.isfinite(values).all()


def test_signals_are_products_of_their_factors(drivers):
    d = drivers
    np.testing.assert_allclose(signal_of("v_x w_z", d), d["velocity x"] * d["rate z"])
    np.testing.assert_allclose(signal_of("z^2", d), d["height"] ** 2)
    np.testing.assert_allclose(signal_of("n_roll n_yaw", d), d["rotor roll"] * d["rotor yaw"] / 1594.0**2)
    np.testing.assert_allclose(signal_of("n", d), d["rotor mean"] / 1594.0 - 1)
    speed = np.sqrt(d["velocity x"] ** 2 + d["velocity y"] ** 2 + d["velocity z"] ** 2)
    np.testing.assert_allclose(signal_of("|v| v_y", d), speed * d["velocity y"])


def test_the_rotors_patterns_are_the_formulas():
    np.testing.assert_array_equal([PATTERNS[key] for key in ("roll", "pitch", "yaw")], np.asarray(TORQUE_SIGNS))


def test_a_panel_shows_the_axis_of_its_term(drivers):
    axes = {"torque x": np.zeros(50), "force z": np.zeros(50), "world force x": np.zeros(50)}
    pooled = Pooled(axes, {name: "m/s^2" for name in axes}, drivers, np.zeros(50, int))
    made = [("world force_z", "z"), ("world force_x", "x^2"), ("torque_x", "1"), ("torque_x", "v_x w_z")]
    panels = panels_of([Term(axis, signal, "N", 1.0, 0.1, 9.0) for axis, signal in made], pooled, pooled, 3)
    assert [(p.axis, p.signal) for p in panels] == [
        ("force z", "z"),
        ("world force x", "x^2"),
        ("torque x", "v_x w_z"),
    ]
    np.testing.assert_allclose(panels[2].before.drivers["v_x w_z"], signal_of("v_x w_z", drivers))
