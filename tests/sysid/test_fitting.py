"""Identification: physical by construction, honest about what it cannot tell, unbiased under feedback."""

import jax.numpy as jnp
import numpy as np
import pytest
from plant import Plant, derivative, fly
from scipy.integrate import solve_ivp

from cfb_mjx.errors import CfbError
from cfb_mjx.parameters import load_model_file
from cfb_mjx.sysid.fitting import fit
from cfb_mjx.sysid.uncertainty import assess
from cfb_mjx.sysid.unknowns import choose

NOMINAL = load_model_file("cfb-guards").parameters()


def test_the_plant_of_these_tests_follows_scipy():
    plant = Plant()
    rng = np.random.default_rng(0)
    x = np.concatenate([np.zeros(6), [1, 0, 0, 0], rng.normal(size=3), np.full(4, 1500.0)])[None]
    u, push = np.array([[0.5, 0.6, 0.55, 0.52]]), np.array([[1.0, -2.0, 0.5]])
    exact = solve_ivp(
        lambda _, y: derivative(plant, y[None], u, push)[0], (0, 0.002), x[0], method="DOP853", rtol=1e-11, atol=1e-12
    ).y[:, -1]
    from plant import _rk4

    stepped = _rk4(plant, _rk4(plant, x, u, push, 0.001), u, push, 0.001)[0]
    np.testing.assert_allclose(stepped, exact, rtol=1e-8, atol=1e-9)


@pytest.mark.parametrize("scale", [0.1, 1.0, 5.0])
def test_every_vector_is_a_possible_rigid_body(scale):
    unknowns = choose("inertia,mass,rotor_inertia,motor", NOMINAL)
    rng = np.random.default_rng(1)
    for _ in range(50):
        found = unknowns.apply(jnp.asarray(scale * rng.normal(size=len(unknowns.names))))
        inertia = np.asarray(found.inertia)
        assert inertia.min() > 0
        assert 2 * inertia.max() <= inertia.sum() * (1 + 1e-12)
        assert float(found.mass) > 0
        assert np.all(np.asarray(found.motor_time_constant) > 0)


def test_start_is_the_nominal_drone_and_names_are_checked():
    unknowns = choose("J_m, inertia", NOMINAL)
    assert unknowns.names == ("inertia_xx", "inertia_yy", "inertia_zz", "rotor_inertia")
    np.testing.assert_allclose(unknowns.values(unknowns.start), [3.3e-5, 3.6e-5, 5.9e-5, 5e-8])
    with pytest.raises(CfbError, match="colour"):
        choose("inertia,colour", NOMINAL)
    with pytest.raises(CfbError):
        choose("", NOMINAL)


def test_uncertainty_of_a_linear_problem_matches_its_closed_form():
    rng = np.random.default_rng(2)
    jacobian = rng.normal(size=(40, 50, 3)) * [1.0, 5.0, 20.0]
    found = assess(rng.normal(size=(40, 50)), jacobian, ("inertia_xx", "inertia_yy", "rotor_inertia"))
    flat = jacobian.reshape(-1, 3)
    exact = np.sqrt(np.diag(np.linalg.inv(flat.T @ flat)))
    assert np.all(found.std >= exact * (1 - 1e-9))
    np.testing.assert_allclose(found.std, exact, rtol=0.3)
    assert found.names == []


def test_correlated_blocks_widen_the_uncertainty():
    rng = np.random.default_rng(3)
    jacobian = np.ones((60, 50, 1))
    independent = assess(rng.normal(size=(60, 50)), jacobian, ("motor_gain",)).std
    shared = assess(np.repeat(rng.normal(size=(60, 1)), 50, axis=1), jacobian, ("motor_gain",)).std
    assert shared > 4 * independent  # the truth: sqrt(50) = 7


def test_what_cannot_be_told_is_named_with_what_can():
    rng = np.random.default_rng(4)
    ratio = rng.normal(size=(20, 100)) * 10
    other = rng.normal(size=(20, 100)) * 10
    jacobian = np.stack([-ratio, ratio, other], axis=-1)  # only thrust_scale / mass matters
    found = assess(rng.normal(size=(20, 100)), jacobian, ("mass", "thrust_scale", "rotor_inertia"))
    assert found.names == ["mass", "thrust_scale"]
    assert found.combinations == ["mass / thrust_scale"]


@pytest.fixture(scope="module")
def campaign():
    """Two drones with drawn parameters under feedback, with a wandering torque of 4 rad/s^2 nobody models."""
    rng = np.random.default_rng(7)

    def around(value, spread, *shape):
        return np.asarray(value) * (1 + spread * rng.uniform(-1, 1, (2, *shape)))

    plant = Plant(
        mass=np.full(2, 0.044),
        inertia=around([3.3e-5, 3.6e-5, 5.9e-5], 0.2, 3),
        rotor_inertia=around(5e-8, 0.3),
        lag=around(0.05, 0.2),
        gain=around(2900.0, 0.1),
    )
    return plant, fly(plant, 12.0, seed=11, disturbance=4.0)


def test_inertia_and_motors_come_back_from_disturbed_flights_under_feedback(campaign):
    plant, logs = campaign
    for i, log in enumerate(logs):
        found = fit([log], NOMINAL).estimates
        truth = {
            "inertia_xx": plant.inertia[i, 0],
            "inertia_yy": plant.inertia[i, 1],
            "motor_time_constant": plant.lag[i],
            "motor_gain": plant.gain[i],
        }
        for name, value in truth.items():
            tolerance = 0.1 if name.startswith("inertia") else 0.02
            assert found[name].value == pytest.approx(value, rel=tolerance), name
            assert abs(found[name].value - value) < 4 * found[name].std, name
        # No model of the disturbance is needed to see it: its level is part of the answer.


def test_the_common_scale_of_mass_inertia_and_thrust_cannot_be_told(campaign):
    """Twice the mass, inertia and thrust is the same flight; with the inertia known, the thrust scale can be told."""
    _, logs = campaign
    found = fit(logs[:1], NOMINAL, "mass,inertia,rotor_inertia,thrust_scale,torque_scale")
    assert {"mass", "inertia_xx", "inertia_yy", "thrust_scale"} <= set(found.unidentifiable)
    assert not {"mass", "inertia_xx", "inertia_yy", "thrust_scale"} & set(found.estimates)
    ratio = float(found.parameters.mass / found.parameters.thrust_scale[0])
    assert ratio == pytest.approx(0.044, rel=0.01)


def test_too_short_a_log_is_refused(campaign):
    _, logs = campaign
    with pytest.raises(CfbError, match=r"plant0.*too short"):
        fit([logs[0].slice(0.0, 0.3)], NOMINAL)
