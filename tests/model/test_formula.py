"""A formula acts as it reads: closed forms, and its round trip through a model file."""

from __future__ import annotations

import helpers
import jax
import jax.numpy as jnp
import numpy as np

from cfb_mjx.model import Quadrotor
from cfb_mjx.model.effects import ResidualFormula, effect_from_mapping, effect_to_mapping
from cfb_mjx.model.effects.formula import AXES, PLACES, TERMS


def _formula(**terms) -> ResidualFormula:
    body, place = np.zeros((6, len(TERMS))), np.zeros((3, len(PLACES)))
    for (axis, signal), value in terms.get("body", {}).items():
        body[AXES.index(axis), list(TERMS).index(signal)] = value
    for (axis, signal), value in terms.get("place", {}).items():
        place["xyz".index(axis), list(PLACES).index(signal)] = value
    return ResidualFormula(body, place)


def test_terms_act_along_their_axes(guards, fly_fleet):
    damping, spring = 6e-5, 0.05
    formula = _formula(
        body={("torque_z", "w_z"): -damping}, place={("x", "x"): -spring, ("z", "1"): 0.044 * 9.81, ("y", "1"): 0.001}
    )
    y = np.zeros(17)
    y[0], y[6], y[12] = 0.3, 1.0, 2.0  # away from the spring's rest, turning about the vertical, rotors off
    model = jax.tree.map(lambda x: x[None], Quadrotor(guards, (formula,), integrator="rk4"))
    flown = helpers.pack(fly_fleet(model, helpers.state_of(y), jnp.zeros((250, 4))))[0]
    t = 0.004 * np.arange(1, 251)
    # World forces stay in the world while the body turns under them; the weight is carried.
    np.testing.assert_allclose(flown[:, 0], 0.3 * np.cos(np.sqrt(spring / 0.044) * t), atol=1e-7)
    np.testing.assert_allclose(flown[:, 1], 0.5 * 0.001 / 0.044 * t**2, atol=1e-9)
    np.testing.assert_allclose(flown[:, 2], 0.0, atol=1e-9)
    np.testing.assert_allclose(flown[:, 12], 2.0 * np.exp(-damping / 5.9e-5 * t), rtol=1e-7)


def test_round_trip():
    formula = _formula(body={("force_x", "|v| v_x"): -0.01})
    again = effect_from_mapping(effect_to_mapping(formula), "here")
    jax.tree.map(np.testing.assert_array_equal, again, formula)
    assert not np.any(ResidualFormula.neutral().body_terms)
