"""Numbers fitted to predictions and to innovations, on flights of the independent simulator and on the shipped ones."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cfb_mjx.errors import CfbError
from cfb_mjx.logs import read_log, resample
from cfb_mjx.model import Quadrotor
from cfb_mjx.model.effects import Inertia, PayloadSwing, RotorDrag, Wind
from cfb_mjx.parameters import load_model_file
from cfb_mjx.reference_simulator import EFFECTS, Case, fly_campaigns
from cfb_mjx.reference_simulator.effects import put
from cfb_mjx.sysid import evaluate
from cfb_mjx.sysid.refinement import Number, free_numbers, plausible_numbers, refine
from cfb_mjx.sysid.refinement.fitting import _prepared
from cfb_mjx.sysid.refinement.numbers import INERTIA, with_values
from cfb_mjx.sysid.refinement.predictions import TRIM, Predictions, _unwrapped, kinds_alike
from cfb_mjx.sysid.repeatability import repeated

pytestmark = pytest.mark.xdist_group("refinement")

DRAG = Path(__file__).resolve().parents[2] / "data" / "flight_logs" / "drag.mcap"
GUARDS = load_model_file("cfb-guards").parameters


@pytest.fixture(scope="module")
def campaign():
    return fly_campaigns([Case("drag", 9007, (("rotor_drag", 1.0),))], duration_scale=0.35)[0]


@pytest.fixture(scope="module")
def refined(campaign):
    numbers = plausible_numbers(GUARDS(), ("rotor_drag", "inertia"))
    return refine(Quadrotor(GUARDS()), campaign.fit, numbers)


def test_drag_comes_back_and_flights_not_fitted_are_predicted_better(campaign, refined):
    truth = campaign.truth["effects"]["rotor_drag"]
    # The plant's drag saturates at speed, so the linear coefficient comes out below its slope at rest.
    total = 4 * np.mean(truth["rotor_drag"])
    found = dict(zip([n.name for n in refined.numbers], refined.values, strict=True))
    assert 0.6 * total < found["rotor_drag.coefficient"] < 1.05 * total
    assert all(abs(found[f"inertia.relative[{i}]"]) < 0.05 for i in range(2))
    assert refined.cost[1] < 0.6 * refined.cost[0]
    key = "velocity_rmse_mps@0.5s"
    before = evaluate(Quadrotor(GUARDS()), campaign.held_out).metrics("commands_in")[key]
    assert evaluate(refined.model, campaign.held_out).metrics("commands_in")[key] < 0.5 * before


def test_what_no_flight_tells_is_not_fitted():
    """A wind's conductance, a battery's charge: they stay as given, and a wind beside a drag does not count twice."""
    names = [n.name for n in plausible_numbers(GUARDS(), ("wind", "battery_sag"))]
    assert names == [
        *(f"wind.velocity[{i}]" for i in range(3)),
        *(f"battery_sag.{f}" for f in ("level", "slope", "lag")),
    ]
    beside_gains = {n.name for n in plausible_numbers(GUARDS(), ("battery_sag", "motor_gain_mismatch"))}
    assert beside_gains >= {"battery_sag.slope", "motor_gain_mismatch.relative[3]"}
    assert "battery_sag.level" not in beside_gains
    for asked, conductance in ((("wind",), 0.02), (("wind", "rotor_drag"), 0.0)):
        model = _prepared(Quadrotor(GUARDS()), plausible_numbers(GUARDS(), asked))
        assert float(model.effects[0].conductance) == pytest.approx(conductance)
    given = Quadrotor(GUARDS(), (Wind(0.0, 0.03), RotorDrag(0.01)))
    assert float(_prepared(given, plausible_numbers(GUARDS(), ("wind",))).effects[0].conductance) == pytest.approx(0.03)


def test_air_drawn_to_the_middle_of_a_room_is_told_by_the_moments(monkeypatch):
    """Flown closed loop through air that converges, with drag and hub moments that saturate.

    The gradient over the coefficient of the hub moment is the air's convergence, and without the effect the flights not
    fitted to are predicted worse.
    """
    convergence = 0.4
    monkeypatch.setitem(EFFECTS, "circulating_room", lambda rng, drone, strength: put(drone, convergence=convergence))
    strengths = (("rotor_drag", 1.0), ("blade_flapping", 1.0), ("circulating_room", 1.0))
    flown = fly_campaigns([Case("room", 9010, strengths)], duration_scale=0.35)[0]
    beside = ("rotor_drag", "blade_flapping")
    found = refine(Quadrotor(GUARDS()), flown.fit, plausible_numbers(GUARDS(), (*beside, "position_moment")))
    value = dict(zip([n.name for n in found.numbers], found.values, strict=True))
    per_speed = value["blade_flapping.coefficient"]
    told = [value[f"position_moment.gradient[{i}]"] / per_speed for i in range(2)]
    np.testing.assert_allclose(told, convergence, rtol=0.2)
    # Held at nothing: left out, all would be compiled anew.
    held = [replace(n, low=-1e-12, high=1e-12) if n.effect == "position_moment" else n for n in found.numbers]
    still = refine(Quadrotor(GUARDS()), flown.fit, held)
    errors = [evaluate(one.model, flown.held_out).metrics("commands_in") for one in (found, still)]
    for key in ("attitude_mean_deg@0.5s", "velocity_mean_mps@0.5s"):
        assert errors[0][key] < 0.3 * errors[1][key]


def test_trims_of_healthy_flights_are_small_and_have_no_mean(refined):
    trims = np.array(list(refined.trims.values()))
    assert np.abs(trims).max() < 0.3 * TRIM
    assert np.abs(trims.mean(axis=0)).max() < 0.01 * TRIM


def test_without_trims_the_numbers_stand_for_flights_whose_trim_nobody_knows(campaign, refined):
    found = refine(Quadrotor(GUARDS()), campaign.fit, refined.numbers, trimmed=False)
    assert all(not np.any(trim) for trim in found.trims.values())
    np.testing.assert_allclose(found.values[0], refined.values[0], rtol=0.05)
    assert refined.cost[1] < found.cost[1] < 1.05 * refined.cost[1]


def test_inputs_of_the_windows_are_made_when_needed(campaign):
    """They were kept for every kind of prediction and model tried, more than the flights themselves."""
    model = _prepared(Quadrotor(GUARDS()), plausible_numbers(GUARDS(), ("rotor_drag",)))
    data = Predictions.of(model, campaign.fit, np.ones(len(campaign.fit)))

    def held() -> int:
        return sum(x.nbytes for x in jax.live_arrays())

    before = held()
    began = data.started(model)
    assert np.isfinite(began.cost(model, np.zeros((len(campaign.fit), 3))))
    assert held() - before < 0.1 * sum(windows.command.nbytes for _, windows, _ in data.flown)


def test_the_gradient_is_that_of_the_loss(campaign):
    numbers = plausible_numbers(GUARDS(), ("rotor_drag", "inertia"))
    model = _prepared(Quadrotor(GUARDS()), numbers)
    flights = len(campaign.fit)
    share = np.linspace(0.5, 1.5, flights)
    data = Predictions.of(model, campaign.fit, share).started(model)
    count = sum(len(part.flight) for part in data.parts) * 5 * 2
    values, trims = np.array([n.of(model) for n in numbers]) + 1e-4, np.full((flights, 3), 1e-5)
    normal = data.normal_equations(model, numbers, values, trims)

    def loss(values, trims):
        prior = 0.5 * np.sum((trims / TRIM) ** 2) + 0.5e4 * np.sum((share @ trims / TRIM / flights) ** 2)
        return data.cost(with_values(model, numbers, values), trims) * count - prior

    for i in (0, 2):
        number = numbers[i]
        step = 1e-5 * number.scale * np.eye(len(numbers))[i]
        slope = (loss(values + step, trims) - loss(values - step, trims)) / 2e-5
        assert normal.gradient[i] == pytest.approx(slope, rel=1e-4, abs=1e-4)
    turn = np.zeros((flights, 3))
    turn[1, 0] = 1e-5 * TRIM
    slope = (loss(values, trims + turn) - loss(values, trims - turn)) / 2e-5
    assert normal.gradient[len(numbers) + 3] == pytest.approx(slope, rel=1e-4)


def test_flights_logged_at_several_rates_are_fitted_together():
    """The same flight at 250 and at 500 Hz: each costs what it costs by itself."""
    log = read_log(DRAG).slice(0.0, 5.0)
    fast = resample(log, 500.0).replace(metadata={"name": "fast"})
    model = _prepared(Quadrotor(GUARDS()), plausible_numbers(GUARDS(), ("rotor_drag",)))
    cost = {}
    for name, logs in (("slow", [log]), ("fast", [fast]), ("both", [log, fast])):
        data = Predictions.of(model, logs, np.ones(len(logs))).started(model)
        cost[name] = data.cost(model, np.zeros((len(logs), 3)))
    assert cost["slow"] == pytest.approx(cost["fast"], rel=0.02)
    assert cost["both"] == pytest.approx((cost["slow"] + cost["fast"]) / 2, rel=0.01)


def test_numbers_stay_within_their_bounds(campaign):
    drag, *inertia = plausible_numbers(GUARDS(), ("rotor_drag", "inertia"))
    drag = replace(drag, high=0.002)
    start = Quadrotor(GUARDS(), (RotorDrag(0.5), Inertia.neutral()))
    found = refine(start, campaign.fit[:2], [drag, *inertia], iterations=2)
    assert found.values[0] == 0.002
    assert found.at_bound(drag)
    assert not found.at_bound(inertia[0])
    assert np.isnan(found.deviations[0])
    assert float(found.model.effects[0].coefficient) == 0.002


def test_what_is_plausible():
    numbers = {n.name: n for n in plausible_numbers(GUARDS(), ("inertia", "inflow_thrust"))}
    assert numbers["inertia.relative[0]"].high == INERTIA == -numbers["inertia.relative[0]"].low
    # A disc between its neighbours, in momentum theory: thrust at hover and in a slow climb, by fixed-point iteration.
    lift, area = float(GUARDS().mass) * 9.81 / 4, np.pi * float(GUARDS().rotor_spacing / 2) ** 2
    induced = np.sqrt(lift / (2 * 1.2 * area))
    # Blades of infinite slope hold the inflow through the disc: the induced velocity falls by what the climb adds.
    climb = 1e-4
    climbing = 2 * 1.2 * area * induced * (induced - climb)
    assert numbers["inflow_thrust.coefficient"].high == pytest.approx((lift - climbing) / climb, rel=1e-6)
    free = {n.name: n for n in free_numbers(("inertia",))}
    assert free["inertia.relative[0]"].high > 1
    with pytest.raises(CfbError, match="warp"):
        plausible_numbers(GUARDS(), ("warp",))
    with pytest.raises(CfbError, match="predictors only"):
        plausible_numbers(GUARDS(), ("rotor_drag", "regression_dilution"))
    assert {n.name for n in free_numbers(("regression_dilution",))} == {
        f"regression_dilution.{field}" for field in ("dilution", "knee", "reversion", "turning", "time_constant")
    }


def test_nothing_to_fit_and_nothing_to_fit_to_are_refused(campaign):
    with pytest.raises(CfbError, match="at least one number"):
        refine(Quadrotor(GUARDS()), campaign.fit, [])
    short = campaign.fit[0].rows(np.arange(len(campaign.fit[0])) < 50)
    with pytest.raises(CfbError, match="no prediction window"):
        refine(Quadrotor(GUARDS()), [short], [Number("rotor_drag", "coefficient", None, 0.0, 0.05)])


def test_what_is_missed_twice_shows():
    log = read_log(DRAG)
    wrong = Quadrotor(replace(GUARDS(), inertia=GUARDS().inertia * jnp.array([2.0, 2.0, 1.0])))
    later = log.rows(log.time > log.time[0] + 0.5)
    same = repeated(wrong, log, later)
    assert same.correlation[:2] == pytest.approx(1.0, abs=0.02)
    assert same.distance < 0.01
    right = repeated(Quadrotor(GUARDS()), log, later)
    assert np.all(right.rms[:2] < 0.5 * same.rms[:2])
    with pytest.raises(CfbError, match="too short"):
        repeated(wrong, log, log.rows(log.time < log.time[0] + 5))


def test_what_is_left_without_an_effect(campaign, refined):
    """Leaving out what is there costs much, what is not there nothing; the other numbers make up for what they can."""
    costs = {name: sum(loss.sum() for loss in refined.without([name]).losses) for name in ("rotor_drag", "inertia")}
    whole = sum(loss.sum() for loss in refined.left.losses)
    assert costs["rotor_drag"] > 1.3 * whole
    assert costs["inertia"] < 1.02 * whole
    assert refined.growth(["inertia"]) < 0.02 * refined.cost[1] < refined.growth(["rotor_drag"])
    # Fitted anew without the effect, flights are predicted no better than the others made up for it.
    anew = refine(Quadrotor(GUARDS()), campaign.fit, plausible_numbers(GUARDS(), ("inertia",)), iterations=4)
    again = sum(loss.sum() for loss in anew.left.losses)
    assert again == pytest.approx(costs["rotor_drag"], rel=0.1)
    assert np.all(np.abs(refined.correlation[np.isfinite(refined.correlation)]) < 1 + 1e-9)


def test_every_second_window_tells_nearly_as_much(campaign, refined):
    found = refine(Quadrotor(GUARDS()), campaign.fit, refined.numbers, most_windows=len(refined.left.losses[0]) // 2)
    assert len(found.left.losses[0]) <= len(refined.left.losses[0]) // 2 + len(campaign.fit)
    assert found.values[0] == pytest.approx(refined.values[0], rel=0.05)


def test_flights_of_a_rare_kind_count_as_much_as_the_many(campaign):
    wild = campaign.fit[0]

    def named(log, name):
        return log.replace(metadata={**log.metadata, "name": name})

    same = [named(wild, f"again {k}") for k in range(4)]
    assert set(kinds_alike(Quadrotor(GUARDS()), [wild, *same]).values()) == {0.2}
    still = wild.replace(quaternion=np.tile(wild.quaternion[:1], (len(wild), 1)), body_rate=0.01 + 0 * wild.body_rate)
    both = kinds_alike(Quadrotor(GUARDS()), [*same, named(still, "still")])
    assert both == {one.name: 0.25 for one in same} | {"still": 1.0}


def test_a_load_on_a_string_is_found_from_far_off():
    """Its swing at the start of a window follows from the flight before, by the model as the fit has it at that step.

    Held as the model before the fit had it, the length stays wrong.
    """
    flown = fly_campaigns([Case("slung", 9011, (("payload_swing", 1.0),))], duration_scale=0.35)[0]
    truth = flown.truth["effects"]["payload_swing"]
    start = Quadrotor(GUARDS(), (PayloadSwing(mass=0.0005, length=0.5, damping_ratio=0.1),))
    found = refine(start, flown.fit, plausible_numbers(GUARDS(), ("payload_swing",)))
    value = dict(zip([n.name for n in found.numbers], found.values, strict=True))
    assert value["payload_swing.mass"] == pytest.approx(truth["bob_mass"], rel=0.05)
    assert value["payload_swing.length"] == pytest.approx(truth["bob_length"], rel=0.05)
    assert abs(value["payload_swing.pivot"]) < 1e-3


def test_numbers_too_short_for_differences_are_refused(campaign):
    numbers = plausible_numbers(GUARDS(), ("rotor_drag",))
    with jax.enable_x64(False), pytest.raises(CfbError, match="64-bit"):
        refine(Quadrotor(GUARDS()), campaign.fit, numbers)


@pytest.mark.parametrize("angle", [3.0, np.pi - 1e-4, np.pi - 1e-9])
def test_a_slope_sees_no_jump_where_half_a_circle_is_passed(angle):
    """A drone that has turned over errs by half a circle one way or the other."""
    axis, sizes = np.array([0.6, 0.0, 0.8]), np.array([[0.1, 1.0]])
    near = np.array([[angle * axis / 0.1, np.zeros(3)]])
    for step in (1e-3, -1e-3):
        beyond = angle + step
        said = beyond if beyond < np.pi else beyond - 2 * np.pi
        found = np.array([[said * axis / 0.1, np.ones(3)]])
        plain = _unwrapped(found, near, sizes)
        np.testing.assert_allclose(plain[0, 0], beyond * axis / 0.1, rtol=1e-9)
        np.testing.assert_array_equal(plain[0, 1], found[0, 1])
