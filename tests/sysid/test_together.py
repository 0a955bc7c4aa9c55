"""All that a drone lacks at once, on a drone of the independent simulator that lacks much."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cfb_mjx.labelled_plants import Case, fly_campaigns
from cfb_mjx.model import Quadrotor
from cfb_mjx.model.effects import effect_to_mapping
from cfb_mjx.parameters import load_model_file
from cfb_mjx.sysid import evaluate
from cfb_mjx.sysid.refinement.numbers import PLANT
from cfb_mjx.sysid.sensor_faults import HEALTHY
from cfb_mjx.sysid.tracing.fits import beside_hold
from cfb_mjx.sysid.tracing.search import Search
from cfb_mjx.sysid.tracing.sensors import check_sensors
from cfb_mjx.sysid.tracing.together import Rules, fit_together, paired

pytestmark = pytest.mark.xdist_group("together")

GUARDS = load_model_file("cfb-guards")
LACKS = ("blade_flapping", "thrust_scale", "rotor_drag", "cog_offset")
RULES = Rules(steps=8, rounds=1, trial_steps=3, windows=150, motor_rows=6000)


@pytest.fixture(scope="module")
def campaign():
    case = Case("much", 9021, tuple((name, 1.5) for name in LACKS))
    return fly_campaigns([case], duration_scale=0.35)[0]


@pytest.fixture(scope="module")
def whole(campaign):
    check = replace(check_sensors(campaign.fit, 0.008, 0.0), faults=HEALTHY, findings=[])
    search = Search.start(campaign.fit, GUARDS.parameters(), 0.008, check, (), PLANT)
    return fit_together(campaign.fit, GUARDS, search, rules=RULES)


def test_what_a_drone_lacks_is_found_all_at_once(campaign, whole):
    names = [part.name for part in whole.parts]
    assert set(LACKS) <= set(names)
    truth = campaign.truth["effects"]
    found = {part.name: part.parameters for part in whole.parts}
    lift = truth["thrust_scale"]["thrust_scale"] - 1
    assert found["thrust_scale"]["relative"] == pytest.approx(lift, abs=0.02)
    before, after = (evaluate(model, campaign.held_out) for model in (Quadrotor.from_file(GUARDS), whole.model))
    assert beside_hold(after) < 0.35 * beside_hold(before)


def test_parts_come_in_the_order_of_what_they_buy_and_stand_on_other_flights(campaign, whole):
    buys = [part.buys for part in whole.parts]
    assert buys == sorted(buys, reverse=True)
    after = evaluate(whole.model, campaign.held_out)
    for part in whole.parts:
        if part.name in LACKS:
            t, p_value = paired(evaluate(part.without, campaign.held_out, keep_diverged=True), after)
            assert t > 2.3
            assert p_value < 0.02
    assert paired(after, after)[0] == 0.0


def test_motors_come_from_their_own_rotor_speeds(campaign, whole):
    assert {"motor_gain", "motor_speed_offset", "motor_time_constant"} <= set(whole.motors)
    assert all(np.all(entry.std > 0) for entry in whole.motors.values())
    assert not {"motor_gain_mismatch", "motor_time_constant"} & {part.name for part in whole.parts}


def test_effects_that_the_model_declares_stay_as_they_are(campaign, whole):
    """What is known of the type is not fitted again; a drone's own place of the centre of gravity is."""
    known = next(e for e in whole.model.effects if type(e).name == "blade_flapping")
    base = replace(GUARDS, effects=(effect_to_mapping(known), {"name": "cog_offset", "parameters": {"offset": [0, 0]}}))
    check = replace(check_sensors(campaign.fit, 0.008, 0.0), faults=HEALTHY, findings=[])
    search = Search.start(campaign.fit, base.parameters(), 0.008, check, Quadrotor.from_file(base).effects, PLANT)
    again = fit_together(campaign.fit, base, search, rules=replace(RULES, steps=2, rounds=0, trial_steps=1))
    kept = next(e for e in again.model.effects if type(e).name == "blade_flapping")
    assert float(kept.coefficient) == float(known.coefficient)
    assert "blade_flapping" not in [part.name for part in again.parts]
    assert "cog_offset" in [part.name for part in again.parts]
