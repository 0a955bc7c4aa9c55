"""All that a drone lacks at once, on a drone of the independent simulator that lacks much."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cfb_mjx.model import Quadrotor
from cfb_mjx.model.effects import BatterySag
from cfb_mjx.model.effects.battery_sag import NOMINAL_VOLTAGE
from cfb_mjx.parameters import Entry, load_model_file, save_model_file
from cfb_mjx.reference_simulator import Case, fly_campaigns
from cfb_mjx.sysid import evaluate
from cfb_mjx.sysid.refinement.numbers import PLANT
from cfb_mjx.sysid.rotors.flown_motors import Told, flown_motors
from cfb_mjx.sysid.sensor_faults import HEALTHY
from cfb_mjx.sysid.tracing import closing, motors
from cfb_mjx.sysid.tracing.evidence import Evidence, alike
from cfb_mjx.sysid.tracing.hypothesis import Fit, strengths
from cfb_mjx.sysid.tracing.jointly import beside_hold
from cfb_mjx.sysid.tracing.motors import MOTORS, motors_of
from cfb_mjx.sysid.tracing.rules import Rules
from cfb_mjx.sysid.tracing.search import Search
from cfb_mjx.sysid.tracing.sensors import check_sensors
from cfb_mjx.sysid.tracing.together import _with, fit_together, names_to_fit, of_type, paired
from cfb_mjx.sysid.tracing.trace import Trace
from cfb_mjx.view.closing import _held, verdict

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
    search = Search.start(campaign.fit, GUARDS.parameters(), 0.008, check, (), PLANT, RULES)
    return fit_together(campaign.fit, GUARDS, search)


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


def test_motors_that_are_as_declared_stay_so(whole):
    assert not whole.motors
    assert not set(MOTORS) & {part.name for part in whole.parts}


@pytest.fixture(scope="module")
def other_motors():
    """A drone of motors with several faults, on which rotor speeds were measured."""
    names = {"motor_gain_mismatch": 0.8, "motor_asymmetry": 0.8, "battery_sag": 1.0, "rotor_drag": 1.0}
    return fly_campaigns([Case("motors", 9023, tuple(names.items()))], duration_scale=0.35)[0]


def test_effects_of_the_motors_are_named_from_rotor_speeds_alone(other_motors):
    """A battery's level would say what all four gains say: beside these it stays as it is declared."""
    found = motors_of(other_motors.fit, GUARDS, _search(other_motors))
    assert not found.entries
    told = {each.name: each for each in found.effects}
    assert set(told) >= {"motor_gain_mismatch", "motor_asymmetry", "battery_sag"}
    truth = other_motors.truth["effects"]
    battery = truth["battery_sag"]
    of_all = (NOMINAL_VOLTAGE / battery["sag_voltage"]) ** battery["sag"]
    gains = told["motor_gain_mismatch"]
    np.testing.assert_allclose(
        gains.effect.relative, np.array(truth["motor_gain_mismatch"]["ratio"]) * of_all - 1, atol=0.006
    )
    assert np.max(gains.std["relative"]) < 0.01
    assert float(told["battery_sag"].effect.level) == 0.0
    assert "level" not in told["battery_sag"].std
    assert all(each.t > 8 for each in told.values() if each.name.startswith("motor_"))
    assert not any(each.alike for each in told.values())


def test_a_load_that_is_tried_beside_a_centre_of_gravity_hangs_on_the_axis(whole):
    """Its place beside the axis would say the same; without the other it is free."""
    seen = Evidence(20.0, 9.0, 1e-9, np.array([0.5]))
    others = tuple(n for n in whole.fit.numbers if n.effect != "cog_offset")
    for numbers, free in ((whole.fit.numbers, set()), (others, {0, 1})):
        _, added = _with(replace(whole.fit, numbers=numbers), strengths("payload")[0], seen)
        assert {n.index for n in added if n.field == "offset"} == free
        assert {n.field for n in added} >= {"mass", "height"}


def test_numbers_that_go_together_name_each_others_effects():
    names = ["lag", "delay", "delay", "drag"]
    together = np.array(
        [[1.0, 0.1, -0.95, 0.0], [0.1, 1.0, 0.0, np.nan], [-0.95, 0.0, 1.0, 0.2], [0.0, np.nan, 0.2, 1.0]]
    )
    assert alike(names, together, "lag", 0.9) == ["delay"]
    assert alike(names, together, "delay", 0.9) == ["lag"]
    assert alike(names, together, "drag", 0.9) == []


def test_motors_of_another_kind_get_constants_of_their_own(campaign, monkeypatch):
    """No effect of the catalogue makes an offset of the steady speed. What is fitted with the constants, to more
    flights than are searched, stays as it was fitted: here a battery that these flights do not show."""
    battery = Told.of(BatterySag(level=0.0, slope=0.05, lag=0.01), "slope", 0.01)

    def with_a_battery(*given):
        return replace(anew := flown_motors(*given), effects=(*anew.effects, battery))

    monkeypatch.setattr(motors, "flown_motors", with_a_battery)
    entries = dict(GUARDS.entries)
    gain = entries["motor_gain"]
    entries["motor_gain"] = replace(gain, value=0.8 * np.asarray(gain.value))
    entries["motor_speed_offset"] = Entry(np.full(4, 400.0), "of other motors")
    base = replace(GUARDS, entries=entries)
    found = motors_of(campaign.fit, base, replace(_search(campaign), parameters=base.parameters()))
    assert {"motor_gain", "motor_speed_offset", "motor_time_constant"} <= set(found.entries)
    assert all(np.all(entry.std > 0) for entry in found.entries.values())
    np.testing.assert_allclose(found.entries["motor_gain"].value, gain.value, rtol=0.02)
    assert not {"motor_gain_mismatch", "motor_time_constant"} & {each.name for each in found.effects}
    assert any(each is battery for each in found.effects)


def test_effects_that_the_model_declares_stay_as_they_are():
    """What is known of the type is not fitted again; a drone's own place of the centre of gravity is."""
    declared = tuple({"name": name, "parameters": {}} for name in ("blade_flapping", "thrust_scale", "cog_offset"))
    known = names_to_fit(replace(GUARDS, effects=declared), motors_told=False)
    assert set(PLANT) - set(known) == {"blade_flapping", "thrust_scale"}
    told = names_to_fit(GUARDS, motors_told=True)
    assert set(PLANT) - set(told) == {"command_delay", "motor_asymmetry", "battery_sag"}
    assert set(PLANT) & set(MOTORS) == {"command_delay", "motor_asymmetry", "battery_sag"}


@pytest.fixture(scope="module")
def closed(campaign, whole):
    """What `close_loop` makes of it, the search having found nothing."""
    search = _search(campaign)
    fit = Fit(search.nothing(), None, np.ones(8), np.ones((1, 8)), beside_hold=9.0)
    check = check_sensors(campaign.fit, 0.008, 0.0)
    found = Trace(search.nothing(), check, [], [], search, np.ones(8), np.ones(8), fit)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(closing, "fit_together", lambda *_: whole)
        return closing._whole(found, campaign.fit, campaign.held_out, GUARDS, lambda _: None)


def test_the_corrected_model_predicts_what_the_report_says(campaign, closed, tmp_path):
    path = tmp_path / "model.yaml"
    save_model_file(closed.model_file("much-closed", {}), path)
    again = evaluate(Quadrotor.from_file(load_model_file(str(path))), campaign.held_out).metrics("commands_in")
    said = closed.to_json()["held_out"]["after"]
    for key, value in said.items():
        assert again[key] == pytest.approx(value, rel=1e-6), key


def test_effects_are_reported_in_the_order_of_what_they_buy(campaign, closed):
    found = closed.to_json()
    names = [effect["name"] for effect in found["effects"]]
    assert set(LACKS) <= set(names)
    assert set(names[:3]) <= set(LACKS)
    buys = [effect["buys"] for effect in found["effects"]]
    assert buys == sorted(buys, reverse=True)
    assert not found["unexplained"]
    assert not {"motors", "dropped"} & set(found)
    told = {part.name for part in closed.together.parts if part.told}
    for effect in found["effects"]:
        assert ("innovations" in effect) == (effect["name"] not in told)
    lift = found["effects"][names.index("thrust_scale")]["innovations"]["thrust_scale.relative"]
    assert not lift["contradicts"]
    assert lift["value"] == pytest.approx(campaign.truth["effects"]["thrust_scale"]["thrust_scale"] - 1, abs=0.03)
    for effect in found["unconfirmed"]:
        assert effect["name"] not in [item["name"] for item in closed.model_file("x", {}).effects]


def test_what_was_declared_of_the_motors_and_left_the_model_is_said(closed):
    """Constants fitted anew take its place: a reader of the report must not miss it unawares."""
    declared = {"name": "motor_asymmetry", "parameters": {"spin_up": 0.2}}
    anew = {"motor_gain": Entry(np.full(4, 1.1), "of other motors")}
    changed = replace(closed, base=replace(GUARDS, effects=(declared,)), motors=anew)
    assert "motor_asymmetry" not in {item["name"] for item in changed.model_file("x", {}).effects}
    found = changed.to_json()
    assert found["dropped"] == ["motor_asymmetry"]
    assert found["motors"]["motor_gain"]["value"] == [1.1] * 4
    assert "constants were fitted anew): motor_asymmetry." in _held(changed)


def test_the_first_paragraph_says_what_the_drone_has_what_it_buys_and_what_to_do(closed):
    text = verdict(closed)
    has, buys, do = text.split(". ", 2)[0], text, text.rsplit(". ", 1)[-1]
    assert has.startswith(f"The drone flies with {len(closed.reported)} effects the model lacks")
    assert "0.5 s ahead goes from" in buys
    assert do.startswith("Fly and train with model.yaml")


def test_a_whole_that_is_hardly_better_than_the_search_does_not_replace_it(campaign, closed, whole):
    found = replace(closed.trace, fit=replace(closed.trace.fit, beside_hold=whole.beside_hold))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(closing, "fit_together", lambda *_: whole)
        assert closing._whole(found, campaign.fit, campaign.held_out, GUARDS, lambda _: None) is None


def test_what_the_rotor_speeds_tell_stands_unless_predictions_are_worse(campaign, whole, monkeypatch):
    """Other effects may hide in predictions what a battery does to the motors."""
    part = replace(whole.parts[0], told=True)
    found = {}
    for t in (-1.0, -5.0):
        monkeypatch.setattr(closing, "paired", lambda *_, t=t: (t, 0.5))
        entry = closing._reported(_search(campaign), part, None, campaign.held_out)
        found[t] = closing._stands(entry, part)
        assert entry.p_value == part.p_value
    assert found == {-1.0: True, -5.0: False}
    entry = closing._reported(_search(campaign), replace(part, told=False), None, campaign.held_out)
    assert not closing._stands(entry, replace(part, told=False))


def _search(campaign):
    check = check_sensors(campaign.fit, 0.008, 0.0)
    return Search.start(campaign.fit, GUARDS.parameters(), 0.008, check, (), PLANT)


def test_numbers_of_a_type_move_within_what_its_drones_differ():
    effects = (
        {
            "name": "thrust_scale",
            "parameters": {"relative": -0.12},
            "uncertainty": {"relative": 0.01},
            "spread": {"relative": 0.02},
        },
        {
            "name": "blade_flapping",
            "parameters": {"coefficient": -6e-4, "climb": [-0.2, 0.1]},
            "uncertainty": {"coefficient": None, "climb": [None, None]},
            "spread": {"coefficient": 2e-5, "climb": [0.1, 0.0]},
        },
        {"name": "cog_offset", "parameters": {"offset": [0.0, 0.0]}, "spread": {"offset": [2e-4, 2e-4]}},
        {"name": "rotor_drag", "parameters": {"coefficient": 0.01}},
    )
    base = replace(GUARDS, effects=effects)
    found = {n.name: (n.low, n.high) for n in of_type(base, 2.0)}
    assert set(found) == {"thrust_scale.relative", "blade_flapping.coefficient", "blade_flapping.climb[0]"}
    reach = 2 * np.hypot(0.02, 0.01)
    assert found["thrust_scale.relative"] == pytest.approx((-0.12 - reach, -0.12 + reach))
    assert found["blade_flapping.climb[0]"] == pytest.approx((-0.4, 0.0))
    assert "cog_offset" in names_to_fit(base, motors_told=True)
    assert not {"thrust_scale", "blade_flapping", "rotor_drag"} & set(names_to_fit(base, motors_told=True))


def test_what_moved_within_the_type_is_written_with_its_own_number(closed, whole):
    """It is no effect the model lacks, and keeps the spread for the next drone."""
    declared = {"name": "thrust_scale", "parameters": {"relative": 0.0}, "spread": {"relative": 0.2}}
    typed = replace(
        closed,
        base=replace(GUARDS, effects=(declared,)),
        together=replace(whole, typical=frozenset({"thrust_scale"})),
        reported=[item for item in closed.reported if item.name != "thrust_scale"],
        unconfirmed=[],
    )
    (item,) = [e for e in typed.model_file("x", {}).effects if e["name"] == "thrust_scale"]
    own = next(part for part in whole.parts if part.name == "thrust_scale")
    assert item["parameters"]["relative"] == pytest.approx(own.parameters["relative"], abs=0.01)
    assert item["spread"] == {"relative": 0.2}
    assert item["uncertainty"]["relative"] > 0
    assert "Changed within the spread of the type: thrust_scale." in _held(typed)
