"""Error bars hold the truth where the drone is not the preset, commands were not logged, or the mass is not known."""

import importlib.util
import json
from dataclasses import replace
from pathlib import Path

import equinox as eqx
import helpers
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from plant import Plant, fly
from scipy.integrate import quad, solve_ivp

from cfb_mjx.logs import read_log
from cfb_mjx.parameters import load_model_file
from cfb_mjx.sysid.identification.fitting import fit
from cfb_mjx.sysid.identification.flight_data import Segments, prepare
from cfb_mjx.sysid.identification.innovation import as_held, drive, innovations
from cfb_mjx.sysid.identification.noise import Noise
from cfb_mjx.sysid.identification.solver import descended
from cfb_mjx.sysid.identification.uncertainty import Scores, assess, most_contradicted
from cfb_mjx.sysid.identification.unknowns import at_the_border

PRESET = load_model_file("cfb-guards")
NOMINAL = PRESET.parameters()
GENERATOR = Path(__file__).resolve().parents[3] / "shared" / "cases" / "fit" / "make_fit_logs.py"
pytestmark = pytest.mark.xdist_group("fitting")  # they share compiled programs with test_fitting
DRONE = {
    "inertia_xx": 3.5e-5,
    "inertia_yy": 3.4e-5,
    "inertia_zz": 5.4e-5,
    "rotor_inertia": 4e-8,
    "motor_time_constant": 0.045,
    "motor_gain": 3000.0,
    "thrust_scale": 0.88,
    "torque_scale": 1.2,
}


def drone() -> Plant:
    """Thrust 12 % below the paper's curve, as real ones are, torque 20 % above."""
    return Plant(
        inertia=np.array([[DRONE[f"inertia_{a}"] for a in ("xx", "yy", "zz")]]),
        rotor_inertia=np.array([DRONE["rotor_inertia"]]),
        lag=np.array([DRONE["motor_time_constant"]]),
        gain=np.array([DRONE["motor_gain"]]),
        thrust_scale=np.array([DRONE["thrust_scale"]]),
        torque_scale=np.array([DRONE["torque_scale"]]),
    )


def scores(found, truth=DRONE) -> dict[str, float]:
    return {n: (e.value - truth[n]) / e.std for n, e in found.estimates.items() if n in truth}


@pytest.fixture(scope="module")
def flight():
    """250 Hz rows of a 500 Hz loop: every other command is not logged."""
    return fly(drone(), 12.0, seed=21, measure_rotors=False, dither=0.0, loop=1)[0]


@pytest.fixture(scope="module")
def found(flight):
    return fit([flight], NOMINAL, mass_std=0.0)


def test_a_drone_that_is_not_the_preset_is_within_its_error_bars(found):
    assert set(DRONE) <= set(found.estimates)
    assert max(map(abs, scores(found).values())) < 3.5, scores(found)
    assert all(found.estimates[n].std < 0.05 * value for n, value in DRONE.items())


def test_commands_between_the_rows_are_not_taken_for_a_faster_motor(found):
    assert found.hold == pytest.approx(0.002, abs=0.0005)
    assert found.estimates["motor_time_constant"].value == pytest.approx(0.045, rel=0.01)


def test_what_was_to_be_held_and_is_contradicted_is_freed_and_named(flight):
    found = fit([flight], NOMINAL, "inertia,rotor_inertia,motor", mass_std=0.0)
    assert {"thrust_scale", "torque_scale"} <= set(found.contradicted)
    assert max(map(abs, scores(found).values())) < 3.5, scores(found)


def test_an_inertia_that_is_contradicted_is_freed_as_a_whole(flight):
    """What moves one axis in the coordinates of the fit moves the two others: they moved, and were not named."""
    found = fit([flight], NOMINAL, "rotor_inertia,motor,thrust_scale,torque_scale", mass_std=0.0)
    assert {"inertia_xx", "inertia_yy", "inertia_zz"} == set(found.contradicted)
    assert max(map(abs, scores(found).values())) < 3.5, scores(found)


def test_a_contradiction_that_no_possible_value_explains_is_named_and_nothing_is_freed():
    """A fit that had asked for neither ended in an error, or in an inertia that no rigid body has."""
    twisted = replace(drone(), torque_scale=np.array([11.0]))
    found = fit(fly(twisted, 12.0, seed=5), NOMINAL, "thrust_scale,rotor_inertia,motor")
    assert "torque_scale" in found.unexplained
    assert found.parameters.torque_scale[0] == pytest.approx(1, abs=1e-6)
    assert found.model_file(PRESET, "a test").entries["thrust_scale"].std[0] > 0
    assert found.to_json()["held_fixed_unexplained"] == list(found.unexplained)


def test_commands_that_act_later_than_logged_do_not_hold_up_a_fit(monkeypatch):
    """How long a command acted is then at its bound, where every interval between rows had a corner of its own."""
    log = fly(drone(), 4.0, seed=8, row=1)[0]
    scattered = log.time + np.random.default_rng(1).uniform(-2e-4, 2e-4, len(log))
    late = log.rows(np.arange(len(log)) < len(log) - 2).replace(time=scattered[:-2], command=log.command[2:])
    tried = []

    def counted(about, *rest, **more):
        return descended(lambda x: tried.append(x) or about(x), *rest, **more)

    monkeypatch.setattr("cfb_mjx.sysid.identification.likelihood.descended", counted)
    found = fit([late], NOMINAL)
    assert found.hold == pytest.approx(1.5 * 0.002, rel=0.01)
    # The model has no such delay, so the motors seem slow.
    assert max(abs(z) for name, z in scores(found).items() if name != "motor_time_constant") < 3.5
    assert len(tried) < 200


def test_a_few_parts_of_the_flights_lead_where_all_lead(flight, found, monkeypatch):
    monkeypatch.setattr("cfb_mjx.sysid.identification.fitting.FEW", 1)
    monkeypatch.setattr("cfb_mjx.sysid.identification.flight_data._COUNTS", (2,))
    again = fit([flight], NOMINAL, mass_std=0.0)
    for name, estimate in found.estimates.items():
        assert again.estimates[name].value == pytest.approx(estimate.value, abs=0.02 * estimate.std)


def test_a_mass_that_is_off_is_in_the_error_bars_and_what_is_known_is_the_ratio(flight):
    wrong = PRESET.with_values("weighed", mass=0.92 * 0.044).parameters()
    found = fit([flight], wrong)
    scaled = ("inertia_xx", "inertia_yy", "inertia_zz", "rotor_inertia", "thrust_scale", "torque_scale")
    for name in scaled:
        value = found.estimates[name]
        assert value.value == pytest.approx(0.92 * DRONE[name], rel=0.05), name
        assert abs(value.value - DRONE[name]) < 2.5 * value.std, name  # 1.74 are the mass alone
        ratio = found.combinations[f"{name} / mass"]
        assert abs(ratio.value - DRONE[name] / 0.044) < 3.5 * ratio.std, name
        assert ratio.std < 0.8 * value.std / 0.044


def test_commands_between_rows_move_the_rotors_as_far_as_they_did():
    """A 500 Hz staircase through a first-order lag, known to SciPy, against what is made of every fifth command."""
    time = np.arange(0, 0.6, 0.002)
    command = 0.5 + 0.1 * np.sin(2 * np.pi * 6 * time) + 0.05 * np.cos(2 * np.pi * 9 * time)
    log = fly(Plant(), 0.8, seed=1, row=5)[0]
    rows = slice(0, len(time), 5)
    segments = prepare([log]).segments
    count = len(time[rows])
    logged = np.full((1, segments.valid.shape[1], 4), command[rows][-1])
    logged[0, :count] = command[rows, None]
    segments = jax.tree.map(jnp.asarray, eqx.tree_at(lambda s: s.command, segments, logged))
    held = as_held(NOMINAL, jnp.asarray(0.002), segments)
    made, excess = (np.asarray(x)[0, :, 0] for x in (held.command, held.excess))
    shrunk = 0.05 * (1 - np.exp(-0.01 / 0.05))  # integral of the lag's decay over an interval of rows

    def constant(u, start):
        return u + (start - u) * np.exp(-0.01 / 0.05)

    worst = {"held": 0.0, "made": 0.0, "mean without excess": 0.0, "mean": 0.0}
    for k in range(2, count - 1):
        piece = slice(5 * k, 5 * k + 5)
        speed, way = 0.45, 0.0
        for u in command[piece]:
            # The speed, and its integral.
            of = solve_ivp(
                lambda _, x, u=u: ((u - x[0]) / 0.05, x[0]), (0, 0.002), (speed, way), rtol=1e-10, atol=1e-12
            )
            speed, way = of.y[:, -1]
        for name, u in (("held", command[5 * k]), ("made", made[k])):
            worst[name] = max(worst[name], abs(constant(u, 0.45) - speed))
        # A path towards one constant through the speeds at both rows, as measured ones would be joined.
        goal = 0.45 + (speed - 0.45) / (1 - np.exp(-0.01 / 0.05))
        mean = goal + (0.45 - goal) * shrunk / 0.01
        for name, more in (("mean without excess", 0.0), ("mean", excess[k])):
            worst[name] = max(worst[name], abs(mean + more - way / 0.01))
    assert worst["made"] < 0.03 * worst["held"]
    assert worst["mean"] < 0.05 * worst["mean without excess"]


def test_a_product_less_sure_than_half_its_value_is_not_told():
    """Thrust scale / gain^0.33 is known to 42 %; as gain / thrust scale^3 to three times that."""
    told = np.array([-0.31, 0.95]) / np.hypot(0.31, 0.95)
    jacobian = np.full((4, 25, 1), 0.24) * told
    found = assess(Scores.of(np.zeros((4, 25)), jacobian), ("motor_gain", "thrust_scale"))
    assert found.names == ["motor_gain", "thrust_scale"]
    assert found.products == []


def test_a_prior_bounds_what_the_data_leave_free_and_products_carry_their_std():
    rng = np.random.default_rng(4)
    shared, own = rng.normal(size=(20, 100)) * 30, rng.normal(size=(20, 100)) * 30
    jacobian = np.stack([2 * shared, shared, own, -own], axis=-1)  # motor_gain^2 thrust_scale, inertia_xx / mass
    names = ("motor_gain", "thrust_scale", "inertia_xx", "mass")
    found = assess(Scores.of(rng.normal(size=(20, 100)), jacobian), names, {"mass": 0.05})
    assert found.names == ["motor_gain", "thrust_scale"]
    assert found.combinations == ["thrust_scale * motor_gain^2"]
    assert found.std[2:] == pytest.approx([0.05, 0.05], rel=0.02)
    [(powers, std)] = found.products
    assert powers == {"thrust_scale": 1.0, "motor_gain": 2.0}
    assert std == pytest.approx(1 / np.sqrt(np.sum(shared**2)), rel=0.3)


def test_only_what_the_data_contradict_is_named():
    rng = np.random.default_rng(5)
    jacobian = rng.normal(size=(30, 50, 3)) * 10
    names, free = ("inertia_xx", "motor_gain", "thrust_scale"), ("inertia_xx",)
    noise = rng.normal(size=(30, 50))
    flat = jacobian.reshape(-1, 3)

    def settled(wrong):
        residual = (noise + jacobian @ wrong).reshape(-1)
        return (residual - flat[:, :1] @ np.linalg.lstsq(flat[:, :1], residual, rcond=None)[0]).reshape(30, 50)

    held = ["motor_gain", "thrust_scale"]
    assert most_contradicted(Scores.of(settled(np.zeros(3)), jacobian), names, free, held) is None
    assert most_contradicted(Scores.of(settled(np.array([0, 0, 0.1])), jacobian), names, free, held) == "thrust_scale"


def test_an_inertia_at_the_border_of_the_possible_gets_no_number():
    inside = NOMINAL
    assert at_the_border(inside) == {}
    flat = eqx.tree_at(lambda p: p.inertia, inside, jnp.asarray([3.0e-5, 3.0e-5, 5.99e-5]))
    reasons = at_the_border(flat)
    assert {"inertia_zz", "rotor_inertia", "torque_scale"} <= set(reasons)
    assert "inertia_zz > inertia_xx + inertia_yy" in reasons["inertia_zz"]


@pytest.mark.skipif(not GENERATOR.is_file(), reason="needs the generator in ../shared/cases/fit")
@pytest.mark.parametrize("rate", [250, 100])
def test_a_drone_of_a_foreign_simulator_is_within_its_error_bars(rate, tmp_path):
    """With its centre of gravity 3 mm off, which the accelerometer feels."""
    specification = importlib.util.spec_from_file_location("make_fit_logs", GENERATOR)
    made = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(made)
    case = {"m": 0.042, "J": [3.0e-5, 3.9e-5, 5.5e-5], "T": 0.043, "K": 3050.0, "Jm": 4e-8, "ts": 0.87, "qs": 1.25}
    paths = made.fly([case | {"cog": [0.003, -0.002, 0.0]}], 12.0 * 250 / rate, [2], ["rich"], [7])
    made.write(tmp_path / "log.csv", *paths, 0, 1000 // rate)
    truth = dict(zip(("inertia_xx", "inertia_yy", "inertia_zz"), case["J"], strict=True)) | {
        "motor_time_constant": 0.043,
        "motor_gain": 3050.0,
        "rotor_inertia": 4e-8,
        "thrust_scale": 0.87,
        "torque_scale": 1.25,
        "cog_x": 0.003,
        "cog_y": -0.002,
    }
    nominal = PRESET.with_values("weighed", mass=0.042).parameters()
    found = fit([read_log(tmp_path / "log.csv")], nominal, mass_std=0.0)
    assert max(map(abs, scores(found, truth).values())) < 3.5, json.dumps(scores(found, truth))


def test_noise_levels_come_back_from_their_vector_at_the_floor_too():
    for level in (-30.0, -5.0, 1.0):
        noise = Noise.from_vector(jnp.full(17, level).at[9].set(0.3))
        again = Noise.from_vector(noise.to_vector())
        for one, two in zip(jax.tree.leaves(noise), jax.tree.leaves(again), strict=True):
            np.testing.assert_allclose(two, one, rtol=2e-3)


def by_hand(rows, **fields) -> Segments:
    """A piece of flight without measured rotor speeds, every 10 ms; fields by row."""
    arrays = {
        "interval": np.append(0.0, np.full(rows - 1, 0.01)),
        "valid": np.ones(rows),
        "command": np.full((rows, 4), 0.55),
        "doubt": np.zeros((rows, 4)),
        "excess": np.zeros((rows, 4)),
        "rotor_speed": np.zeros((rows, 4)),
        "warm_up": np.zeros(rows),
        "body_rate": np.zeros((rows, 3)),
        "specific_force": np.zeros((rows, 3)),
    } | fields
    return Segments(**{k: jnp.asarray(v, float)[None] for k, v in arrays.items()}, measured=jnp.zeros(1))


NOISE = Noise(
    *(jnp.asarray(x) for x in ([0.01] * 3, [0.2] * 3, [1.0, 2.0, 3.0], 0.4, 0.3, 0.005, 0.5, 1.0, 20.0, 30.0, 0.3))
)


def test_loads_between_rows_are_means_along_the_motors_exact_path():
    """By quadrature along the exponentials; force at the rotors' centre by the coupled Newton-Euler equations."""
    rng = np.random.default_rng(8)
    drone = eqx.tree_at(lambda p: p.center_of_gravity, NOMINAL, jnp.array([0.003, -0.002, 0.001]))
    command, excess = rng.uniform(0.3, 0.8, (5, 4)), rng.uniform(-0.02, 0.02, (5, 4))
    rate = 5 * rng.normal(size=(5, 3))
    driven = drive(drone, NOISE, by_hand(5, command=command, excess=excess, body_rate=rate), use_measured=False)
    constants, lag, speed = helpers.constants_of(drone), 0.05, 2900 * command[0]
    for row in range(1, 5):
        goal = 2900 * command[row - 1]

        def torque(t, start=speed, goal=goal, more=2900 * excess[row - 1]):
            at = goal + (start - goal) * np.exp(-t / lag)
            force, about = helpers.rotor_wrench(constants, at + more, (goal - at) / lag)
            return about - np.cross(constants.center_of_gravity, force)

        means = [quad(lambda t, i=i: torque(t)[i], 0, 0.01, epsabs=0, epsrel=1e-10)[0] / 0.01 for i in range(3)]
        np.testing.assert_allclose(driven.torque[0, row - 1], means, rtol=1e-7, atol=1e-12)
        speed = goal + (speed - goal) * np.exp(-0.01 / lag)
        y = np.concatenate([np.zeros(6), [1.0, 0, 0, 0], rate[row], speed])
        felt = helpers.ode(constants, speed / 2900)(0.0, y)[5] + 9.81
        assert float(driven.force[0, row - 1]) == pytest.approx(felt, rel=1e-9)


def test_variances_of_the_first_row_by_hand():
    """Rotor speeds unknown by 0.1 of the gain each, commands between the rows by 0.3 of the doubt."""
    segments = by_hand(3, doubt=np.full((3, 4), 0.05))
    driven = drive(NOMINAL, NOISE, segments, use_measured=False)
    _, variance = innovations(NOMINAL, NOISE, segments, driven, use_measured=False)
    dt, lag, s = 0.01, 0.05, 0.55
    fade = np.exp(-dt / lag)
    # Slopes of paper eqs. 8 and 9 over rotor speed.
    lift = (-3 * 0.23 * s**2 + 2 * 0.562 * s - 0.043) / 2900
    drag = 1e-4 * (-3 * 3.4 * s**2 + 2 * 8.7 * s + 2.9) / 2900
    inertia, kick = np.array([3.3e-5, 3.6e-5, 5.9e-5]), np.array([0.0, 0.0, 0.5e-7 / 5.9e-5])
    pull = np.array([0.03535 * lift, 0.03535 * lift, drag]) / inertia - kick / lag
    start, more = 4 * (0.1 * 2900) ** 2, 4 * (0.3 * 2900 * 0.05 * (1 - fade)) ** 2
    # Measured once, the disturbance over an interval, the white acceleration, the rotors' error old and new.
    rate = 0.01**2 + (dt * np.array([1.0, 2.0, 3.0])) ** 2 + 0.2**2 * dt
    rate += (pull * lag * (1 - fade)) ** 2 * start + (kick + pull * dt / 2) ** 2 * more + 0.01**2
    force = 0.5**2 + 0.3**2 + (lift / 0.044) ** 2 * (fade**2 * start + more)
    np.testing.assert_allclose(variance[0, 0, :4], [*rate, force], rtol=1e-6)


def test_rows_that_warm_up_and_rotors_that_were_not_measured_do_not_count():
    rng = np.random.default_rng(9)
    segments = by_hand(6, warm_up=[1, 1, 1, 0, 0, 0], body_rate=rng.normal(size=(6, 3)), valid=[1, 1, 1, 1, 1, 0])
    error, variance = innovations(NOMINAL, NOISE, segments, drive(NOMINAL, NOISE, segments))
    counts = np.zeros((5, 8))
    counts[2:4, :4] = 1.0
    np.testing.assert_array_equal(error[0] != 0, counts)
    np.testing.assert_array_equal(variance[0] == 1, 1 - counts)
