"""Identification: physical by construction, honest about what it cannot tell, unbiased under feedback."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from plant import Plant, derivative, fly
from scipy.integrate import solve_ivp

from cfb_mjx.errors import CfbError
from cfb_mjx.logs.resample import interpolate
from cfb_mjx.parameters import load_model_file
from cfb_mjx.sysid.identification import flight_data, likelihood
from cfb_mjx.sysid.identification.filters import detect
from cfb_mjx.sysid.identification.fitting import fit
from cfb_mjx.sysid.identification.flight_data import prepare
from cfb_mjx.sysid.identification.noise import Noise
from cfb_mjx.sysid.identification.solver import OUTLIER, RIDGE, tempered
from cfb_mjx.sysid.identification.uncertainty import Scores, assess
from cfb_mjx.sysid.identification.unknowns import choose

NOMINAL = load_model_file("cfb-guards").parameters()
# They share compiled programs.
pytestmark = pytest.mark.xdist_group("fitting")


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


AXES = ("inertia_xx", "inertia_yy", "inertia_zz")


@pytest.mark.parametrize(
    "free", [AXES, *([a for a in AXES if a != left] for left in AXES), *([a] for a in AXES)], ids=lambda x: "-".join(x)
)
@pytest.mark.parametrize("preset", ["cfb-guards", "cfb"])
def test_axes_that_are_free_move_and_the_others_stay_and_the_body_stays_possible(free, preset):
    nominal = load_model_file(preset).parameters()
    unknowns = choose(tuple(free), nominal)
    rng = np.random.default_rng(5)
    np.testing.assert_allclose(unknowns.apply(unknowns.start).inertia, nominal.inertia, rtol=1e-9)
    reached = []
    for size in (0.1, 1.0, 4.0) * 10:
        inertia = np.asarray(unknowns.apply(jnp.asarray(size * rng.normal(size=len(free)))).inertia)
        assert inertia.min() > 0
        assert 2 * inertia.max() <= inertia.sum() * (1 + 1e-12)
        for i, axis in enumerate(AXES):
            if axis not in free:
                assert inertia[i] == pytest.approx(float(nominal.inertia[i]), rel=1e-12)
        reached.append(inertia)
    assert all(np.ptp([r[AXES.index(axis)] for r in reached]) > 0.3e-5 for axis in free)
    assert np.linalg.cond(unknowns.slope(unknowns.start)) < 50


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


def test_parts_of_the_data_say_what_all_say(campaign, monkeypatch):
    """A fit's sums, part by part, are those of all rows at once; also where nothing counts in a part."""
    data = prepare(campaign[1][:2])
    unknowns, noise = choose("inertia,rotor_inertia,motor,command_hold", NOMINAL), Noise.first(data)
    levels = noise.to_vector() + 0.1 * np.random.default_rng(3).normal(size=17)
    whole = jax.tree.map(jnp.asarray, data.segments)
    monkeypatch.setattr(flight_data, "_COUNTS", (3,))
    some = flight_data.parts(data.segments)
    assert len(some) > 2
    assert sum(len(part.valid) for part in some) == len(whole.valid)

    def sums(segments):
        driven = likelihood._driven(unknowns, unknowns.start, noise, segments, False, False)
        weighed = likelihood._weights(unknowns, unknowns.start, noise, segments, False, False)
        return (
            likelihood._likelihood(levels, unknowns, unknowns.start, segments, driven, False, False),
            likelihood._squares(unknowns.start, unknowns, noise, segments, weighed, False, False),
        )

    once, each = sums(whole), [jax.tree.leaves(sums(part)) for part in some]
    for a, b in zip(jax.tree.leaves(once), map(sum, zip(*each, strict=True)), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-7, atol=1e-9 * np.max(np.abs(b)))
    fit_of_parts, fit_of_all = (
        likelihood.scores_of(unknowns, unknowns.start, noise, segments, False, False) for segments in (some, [whole])
    )
    np.testing.assert_allclose(fit_of_parts[0], fit_of_all[0], rtol=1e-9, atol=1e-9)
    # Any other solver sees all parts, too.
    fixed = unknowns, unknowns.start, noise, some, False, False, likelihood.Prior(jnp.ones(len(unknowns.names)))
    ours, theirs = (
        likelihood._fit_vector(*fixed, solver) for solver in (None, optx.LevenbergMarquardt(rtol=1e-9, atol=1e-9))
    )
    np.testing.assert_allclose(ours, theirs, atol=3e-3)
    names = unknowns.names
    np.testing.assert_allclose(*(assess(scores, names).std for _, scores in (fit_of_parts, fit_of_all)), rtol=1e-6)


def test_what_a_fit_works_with_has_types_of_its_own(campaign):
    """A number as weakly typed as Python's becomes another in the first round, and the second compiles anew."""
    data = prepare(campaign[1][:1])
    timed = dataclasses.replace(choose("inertia", NOMINAL), timed=1.0)
    for tree in (choose("inertia", NOMINAL), timed, Noise.first(data)):
        kinds = {(x.dtype, x.weak_type) for x in jax.tree.leaves(tree)}
        assert kinds == {(jnp.dtype(float), False)}


def test_uncertainty_of_a_linear_problem_matches_its_closed_form():
    rng = np.random.default_rng(2)
    jacobian = rng.normal(size=(40, 50, 3)) * [1.0, 5.0, 20.0]
    found = assess(Scores.of(rng.normal(size=(40, 50)), jacobian), ("inertia_xx", "inertia_yy", "rotor_inertia"))
    flat = jacobian.reshape(-1, 3)
    exact = np.sqrt(np.diag(np.linalg.inv(flat.T @ flat)))
    assert np.all(found.std >= exact * (1 - 1e-9))
    np.testing.assert_allclose(found.std, exact, rtol=0.3)
    assert found.names == []


def test_correlated_blocks_widen_the_uncertainty():
    rng = np.random.default_rng(3)
    jacobian = np.ones((60, 50, 1))
    independent = assess(Scores.of(rng.normal(size=(60, 50)), jacobian), ("motor_gain",)).std
    shared = assess(Scores.of(np.repeat(rng.normal(size=(60, 1)), 50, axis=1), jacobian), ("motor_gain",)).std
    assert shared > 4 * independent  # the truth: sqrt(50) = 7


def test_what_cannot_be_told_is_named_with_what_can():
    rng = np.random.default_rng(4)
    ratio = rng.normal(size=(20, 100)) * 10
    other = rng.normal(size=(20, 100)) * 10
    jacobian = np.stack([-ratio, ratio, other], axis=-1)  # only thrust_scale / mass matters
    found = assess(Scores.of(rng.normal(size=(20, 100)), jacobian), ("mass", "thrust_scale", "rotor_inertia"))
    assert found.names == ["mass", "thrust_scale"]
    assert found.combinations == ["mass / thrust_scale"]


def test_what_the_data_do_not_touch_is_named_without_a_combination():
    rng = np.random.default_rng(6)
    jacobian = np.stack([rng.normal(size=(20, 100)) * 10, np.zeros((20, 100))], axis=-1)
    found = assess(Scores.of(rng.normal(size=(20, 100)), jacobian), ("inertia_xx", "inertia_yy"))
    assert found.names == ["inertia_yy"]
    assert found.combinations == []


def test_hubers_loss():
    x = np.linspace(-12, 12, 49)
    expected = np.where(np.abs(x) <= OUTLIER, 0.5 * x**2, OUTLIER * (np.abs(x) - 0.5 * OUTLIER))
    np.testing.assert_allclose(0.5 * np.asarray(tempered(jnp.asarray(x), True)) ** 2, expected, rtol=1e-12)
    np.testing.assert_array_equal(tempered(jnp.asarray(x), False), x)


@pytest.fixture(scope="module")
def campaign():
    """Two drones with drawn parameters under feedback, with a wandering torque of 4 rad/s^2 nobody models."""
    rng = np.random.default_rng(7)

    def around(value, spread, *shape):
        return np.asarray(value) * (1 + spread * rng.uniform(-1, 1, (2, *shape)))

    plant = Plant(
        mass=np.full(2, 0.044),
        inertia=_possible(around([3.3e-5, 3.6e-5, 5.9e-5], 0.2, 3)),
        rotor_inertia=around(5e-8, 0.3),
        lag=around(0.05, 0.2),
        gain=around(2900.0, 0.1),
    )
    return plant, fly(plant, 12.0, seed=11, disturbance=4.0)


def _possible(inertia: np.ndarray) -> np.ndarray:
    """Well inside what a body can have: at its border a fit gives no number."""
    return np.append(inertia[:, :2], np.minimum(inertia[:, 2:], 0.87 * inertia[:, :2].sum(1, keepdims=True)), axis=1)


def test_inertia_and_motors_come_back_from_disturbed_flights_under_feedback(campaign):
    plant, logs = campaign
    for i, log in enumerate(logs):
        result = fit([log], NOMINAL, "inertia,rotor_inertia,motor")
        assert max(abs(value) for value in result.whiteness.values()) < 0.1
        found = result.estimates
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


def test_a_round_ends_at_its_minimum_where_commands_were_not_logged(campaign):
    """Where the weights followed the vector no step along the slope lowered the sum: rounds ended 20 units above."""
    _, logs = campaign
    data = prepare(logs[:1])
    unknowns, noise = choose("inertia,rotor_inertia,motor,command_hold", NOMINAL), Noise.first(data)
    segments, ridge = jax.tree.map(jnp.asarray, data.segments), jnp.full(len(unknowns.names), RIDGE)
    weighed = likelihood._weights(unknowns, unknowns.start, noise, segments, True, False)
    assert jnp.max(weighed.doubt) > 0
    vector = likelihood._fit_vector(unknowns, unknowns.start, noise, [segments], True, False, likelihood.Prior(ridge))

    def residual(x):
        return likelihood._residual(x, unknowns, noise, segments, True, False, weighed).ravel()

    jacobian = np.asarray(jax.jacfwd(residual)(vector))
    slope = jacobian.T @ np.asarray(residual(vector)) + RIDGE**2 * vector
    assert slope @ np.linalg.solve(jacobian.T @ jacobian + RIDGE**2 * np.eye(len(slope)), slope) < 1e-4
    assert np.abs(vector).max() > 0.05, "nothing moved"


def test_a_gyro_that_is_known_to_be_late_costs_nothing(campaign):
    """Rows of what the gyro measured 16 ms ago: the same fit where the drone says so, another where it does not."""
    _, logs = campaign
    rate = interpolate(logs[0].time, logs[0].body_rate, logs[0].time - 0.016)
    late = dataclasses.replace(logs[0], body_rate=rate)
    drone = eqx.tree_at(lambda p: p.gyro_delay, NOMINAL, jnp.asarray(0.016))
    asked = "inertia,rotor_inertia,motor"
    known, told, untold = fit(logs[:1], NOMINAL, asked), fit([late], drone, asked), fit([late], NOMINAL, asked)

    def away(found):
        return max(abs(e.value - known.estimates[n].value) / known.estimates[n].std for n, e in found.estimates.items())

    assert away(told) < 0.5
    assert away(untold) > 5
    assert float(told.parameters.gyro_delay) == 0.016


def test_the_common_scale_of_mass_inertia_and_thrust_cannot_be_told(campaign):
    """Twice the mass, inertia and thrust is the same flight; with the inertia known, the thrust scale can be told."""
    _, logs = campaign
    found = fit(logs[:1], NOMINAL, "mass,inertia,thrust_scale")
    assert {"mass", "inertia_xx", "inertia_yy", "thrust_scale"} <= set(found.unidentifiable)
    assert not {"mass", "inertia_xx", "inertia_yy", "thrust_scale"} & set(found.estimates)
    ratio = float(found.parameters.mass / found.parameters.thrust_scale[0])
    assert ratio == pytest.approx(0.044, rel=0.01)


def test_outliers_hardly_move_a_robust_fit(campaign):
    _, logs = campaign
    rng = np.random.default_rng(9)
    rate = logs[0].body_rate.copy()
    bad = rng.choice(len(rate), 60, replace=False)
    rate[bad] += rng.choice([-3.0, 3.0], (60, 3))
    spoiled = dataclasses.replace(logs[0], body_rate=rate)
    request = "inertia,rotor_inertia"
    clean, plain, robust = (
        fit([log], NOMINAL, request, robust=r, mass_std=0.0)
        for log, r in ((logs[0], False), (spoiled, False), (spoiled, True))
    )
    np.testing.assert_allclose(robust.noise.gyro, clean.noise.gyro, rtol=0.15)
    assert np.all(np.asarray(plain.noise.gyro) > 5 * np.asarray(clean.noise.gyro))
    for name in ("inertia_xx", "inertia_yy"):
        assert abs(robust.estimates[name].value - clean.estimates[name].value) < 1.5 * clean.estimates[name].std
        assert robust.estimates[name].std < 0.9 * plain.estimates[name].std


def test_one_axis_excited_tells_one_axis():
    """Roll only, no yaw: J_zz and J_m leave no trace beyond noise, and are named."""
    log = fly(Plant(), 6.0, seed=4, goals=(1, 0, 0), dither=0.0)[0]
    found = fit([log], NOMINAL, "inertia,rotor_inertia")
    assert set(found.unidentifiable) == {"inertia_yy", "inertia_zz", "rotor_inertia"}
    assert abs(found.estimates["inertia_xx"].value - 3.3e-5) < 4 * found.estimates["inertia_xx"].std
    assert all("cannot tell" in reason for reason in found.unidentifiable.values())


def test_hover_alone_tells_no_inertia():
    log = fly(Plant(), 6.0, seed=4, goals=(0, 0, 0), dither=0.0, noise=0.2, gyro_feedback=0.0)[0]
    found = fit([log], NOMINAL, "inertia,rotor_inertia")
    assert set(found.unidentifiable) == set(found.names)


def test_shooting_agrees_with_innovations_without_disturbance(campaign):
    plant = Plant(inertia=np.array([[3.7e-5, 3.3e-5, 6.2e-5]]), rotor_inertia=np.array([6e-8]))
    log = fly(plant, 6.0, seed=6)[0]
    found = fit([log], NOMINAL, "inertia,rotor_inertia", estimator="shooting")
    truth = dict(zip((*AXES, "rotor_inertia"), (3.7e-5, 3.3e-5, 6.2e-5, 6e-8), strict=True))
    for name, value in truth.items():
        assert found.estimates[name].value == pytest.approx(value, rel=0.02), name
        assert abs(found.estimates[name].value - value) < 4 * found.estimates[name].std, name


def test_the_delay_of_the_pose_is_found_by_shooting():
    log = fly(Plant(), 6.0, seed=8)[0]
    log = dataclasses.replace(log, metadata={**log.metadata, "observation_delay": None})
    nominal = eqx.tree_at(lambda p: p.pose_delay, NOMINAL, jnp.asarray(0.003))
    found = fit([log], nominal, "inertia_xx,pose_delay")
    assert found.estimator == "shooting"
    assert found.estimates["pose_delay"].value == pytest.approx(0.008, abs=0.0003)
    innovation = fit([log], nominal, "inertia_xx,pose_delay", estimator="innovation")
    assert "pose_delay" in innovation.unidentifiable


def test_commands_that_answer_the_gyro_are_seen(campaign):
    _, logs = campaign
    segments = prepare([logs[0]]).segments
    rng = np.random.default_rng(3)
    count, rows = segments.valid.shape
    residual = rng.normal(size=(count, rows - 1, 8))
    command = 0.5 + 0.01 * rng.normal(size=(count, rows, 4))
    assert not detect(eqx.tree_at(lambda s: s.command, segments, command), residual).present
    # Roll commands that follow the roll innovation two rows later, under five times as much else.
    command[:, 3:] += 0.002 * residual[:, :-2, :1] * [-1, -1, 1, 1]
    assert detect(eqx.tree_at(lambda s: s.command, segments, command), residual).present


def test_too_short_a_log_is_refused(campaign):
    _, logs = campaign
    with pytest.raises(CfbError, match=r"plant0.*too short"):
        fit([logs[0].slice(0.0, 0.3)], NOMINAL)
