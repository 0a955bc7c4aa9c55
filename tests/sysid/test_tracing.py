"""Tracing on drones of the reference simulator (cfb_mjx.reference_simulator), and the pieces it is made of."""

from __future__ import annotations

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import norm

from cfb_mjx.errors import CfbError
from cfb_mjx.logs import with_other
from cfb_mjx.logs.resample import interpolate
from cfb_mjx.model import Quadrotor
from cfb_mjx.model.effects import CATALOGUE, SENSOR_FAULTS, Inertia, RateDamping, RotorDrag
from cfb_mjx.parameters import load_model_file, save_model_file
from cfb_mjx.reference_simulator import Case, fly_campaigns
from cfb_mjx.sysid import evaluate
from cfb_mjx.sysid.flight import prepare_flight
from cfb_mjx.sysid.sensor_faults import HEALTHY, SensorFaults
from cfb_mjx.sysid.tracing.checkpoint import Checkpoint
from cfb_mjx.sysid.tracing.closing import close_loop
from cfb_mjx.sysid.tracing.evidence import dealt, evidence
from cfb_mjx.sysid.tracing.formula import with_library
from cfb_mjx.sysid.tracing.hypothesis import Hypothesis, moved, neutral_effects, shapes, strengths, term_columns
from cfb_mjx.sysid.tracing.jointly import as_it_is, beside_each_other, everything, needless, one_by_one, told_apart
from cfb_mjx.sysid.tracing.named_effects import fit_named_effects
from cfb_mjx.sysid.tracing.residuals import find_spectral_lines, residual_rows
from cfb_mjx.sysid.tracing.search import Search
from cfb_mjx.sysid.tracing.sensors import check_sensors, lags
from cfb_mjx.sysid.tracing.together import asked
from cfb_mjx.sysid.tracing.trace import trace

# One worker: every program is compiled once.
pytestmark = pytest.mark.xdist_group("tracing")

MANY = (
    ("prop_damage", 0.8),
    ("rotor_drag", 0.6),
    ("thrust_scale", 0.6),
    ("cog_offset", 0.5),
    ("gyroscopic", 0.6),
    ("thrust_tilt", 0.6),
)
CASES = [
    Case("clean", 9001, ()),
    Case("drag", 9002, (("rotor_drag", 1.0),)),
    Case("late", 9003, (("sensor_delay", 1.0),)),
    Case("stretched", 9004, (("sensor_velocity_scale", 1.0),)),
    Case("filtered", 9005, (("sensor_gyro_lowpass", 1.0),)),
    Case("periodic", 9006, (("outside_periodic", 1.0),)),
    Case("limited", 98012, (("esc_rate_limit", 1.0),)),
    Case("nicked", 9008, (("prop_damage", 1.0),)),
    Case("sticky", 9009, (("motor_hysteresis", 1.0),)),
    Case("many", 9010, MANY),
    Case("loaded", 9012, (("payload", 0.8), ("cog_offset", 1.0))),
]


@pytest.fixture(scope="module")
def campaigns():
    """A third of the usual length: enough for strong effects."""
    return {c.case.name: c for c in fly_campaigns(CASES, duration_scale=0.35)}


@pytest.fixture(scope="module")
def base():
    return load_model_file("cfb-guards")


def test_healthy_sensors_agree_with_each_other(campaigns):
    check = check_sensors(campaigns["clean"].fit, 0.008, 0.0)
    assert check.faults.healthy
    assert not check.findings
    assert set(check.measured) == set(SENSOR_FAULTS) - {"sensor_time_shift"}
    for name, (value, std) in check.measured.items():
        assert abs(value - SENSOR_FAULTS[name].healthy) < 5 * std
        assert std < 0.002


@pytest.mark.parametrize(
    ("case", "fault", "truth", "tolerance"),
    [
        ("late", "sensor_delay", lambda t: 0.002 * t["extra_delay"], 0.001),
        ("stretched", "sensor_velocity_scale", lambda t: t["velocity_scale"], 0.003),
        # A second-order low-pass delays slow motion by sqrt(2) over its corner.
        ("filtered", "sensor_gyro_lowpass", lambda t: np.sqrt(2) / (2 * np.pi * t["gyro_corner"]), 0.002),
    ],
)
def test_sensor_faults_are_named_and_measured(campaigns, case, fault, truth, tolerance):
    campaign = campaigns[case]
    check = check_sensors(campaign.fit, 0.008, 0.0)
    assert [f.name for f in check.findings] == [fault]
    assert check.findings[0].value == pytest.approx(truth(campaign.truth["effects"][fault]), abs=tolerance)
    # With the fault told, the declared model scores better on other flights; no other effect is needed for that.
    model = Quadrotor.from_file(load_model_file("cfb-guards"))
    key = "rate_rmse_radps@0.2s" if "gyro" in fault else "velocity_rmse_mps@0.2s"
    before = evaluate(model, campaign.held_out).metrics("commands_in")[key]
    after = evaluate(model, campaign.held_out, faults=check.faults).metrics("commands_in")[key]
    assert after < 0.8 * before


@pytest.mark.parametrize(
    ("pose", "gyro", "knocks"),
    [
        (0.0, 0.0, 1e-3),
        (0.012, 0.0, 3e-3),
        (0.0, 0.008, 3e-3),
        (0.02, 0.01, 5e-4),
        (-0.008, 0.0, 5e-4),
        (0.03, 0.0, 5e-4),
    ],
)
@pytest.mark.parametrize("away", [-1.0, 0.0, 1.0])
def test_lags_are_told_apart_however_inexact_the_velocity_is(pose, gyro, knocks, away):
    found = {f.name: f.value for f in lags((pose - gyro, 2e-4), (pose + away * knocks, knocks))}
    there = {"sensor_delay": pose, "sensor_gyro_lowpass": gyro}
    assert set(found) == {name for name, value in there.items() if value}
    for name, value in found.items():
        assert value == pytest.approx(there[name], abs=7e-4)


@pytest.mark.parametrize(("across", "up"), [(1.09, 1.0), (1.0, 0.94), (1.05, 1.10)])
def test_a_velocity_stretched_along_some_axes_only_is_told_from_one_stretched_along_all(campaigns, across, up):
    """As an estimator does that takes horizontal velocity from optical flow and vertical velocity from a ranger."""
    stretch = np.array([across, across, up])
    flights = [log.replace(velocity=log.velocity * stretch) for log in campaigns["clean"].fit]
    check = check_sensors(flights, 0.008, 0.0)
    assert [f.name for f in check.findings] == ["sensor_velocity_scale"]
    np.testing.assert_allclose(check.faults.stretch.scale, stretch, atol=0.004)
    assert check.findings[0].p_value < 1e-6
    assert check.findings[0].parameters == {
        "scale": check.faults.velocity_scale,
        "vertical": check.faults.vertical_scale,
    }
    assert set(check.findings[0].uncertainty) == {"scale", "vertical"}
    told = SensorFaults.from_mappings(check.faults.to_mappings(), "drone.yaml")
    assert told == check.faults
    healthy = check_sensors(campaigns["clean"].fit, 0.008, 0.0)
    for log, bad in zip(campaigns["clean"].fit, flights, strict=True):
        np.testing.assert_allclose(check.gyro_bias[log.name], healthy.gyro_bias[log.name], atol=1e-4)
        np.testing.assert_allclose(told.repaired(bad).velocity, log.velocity, atol=0.005 * np.abs(log.velocity).max())


@pytest.mark.parametrize("scale", [0.88, 1.12])
def test_a_gyro_out_of_scale_is_measured_and_taken_out(campaigns, scale):
    """As one of another range than its driver believes; also where it lags besides."""
    flights = [log.replace(body_rate=scale * log.body_rate) for log in campaigns["filtered"].fit]
    check, other = (check_sensors(logs, 0.008, 0.0) for logs in (flights, campaigns["filtered"].fit))
    assert {f.name for f in check.findings} == {"sensor_gyro_lowpass", "sensor_gyro_scale"}
    assert check.faults.gyro_scale == pytest.approx(scale, abs=0.005)
    assert check.faults.gyro_lag == pytest.approx(other.faults.gyro_lag, abs=1e-3)
    told = SensorFaults.from_mappings(check.faults.to_mappings(), "drone.yaml")
    assert told == check.faults
    for log, bad in zip(campaigns["filtered"].fit, flights, strict=True):
        right = SensorFaults(gyro_lag=told.gyro_lag).repaired(log).body_rate
        np.testing.assert_allclose(told.repaired(bad).body_rate, right, atol=0.01 * np.abs(right).max())
    model = Quadrotor.from_file(load_model_file("cfb-guards"))
    key, held_out = "rate_rmse_radps@0.2s", campaigns["filtered"].held_out
    bad = [log.replace(body_rate=scale * log.body_rate) for log in held_out]
    before, after, whole = (
        evaluate(model, logs, faults=faults).metrics("commands_in")[key]
        for logs, faults in ((bad, HEALTHY), (bad, told), (held_out, other.faults))
    )
    assert after < 0.8 * before
    # Errors are those of what such a gyro records.
    assert after == pytest.approx(scale * whole, rel=0.05)


def test_a_gyro_that_is_said_to_be_late_is_no_finding(campaigns, base):
    logs = campaigns["clean"].fit
    late = [log.replace(body_rate=interpolate(log.time, log.body_rate, log.time - 0.006)) for log in logs]
    assert {f.name for f in check_sensors(late, 0.008, 0.0).findings} == {"sensor_gyro_lowpass"}
    said = check_sensors(late, 0.008, 0.006)
    assert not said.findings
    drone = base.with_values("late", gyro_delay=0.006).parameters()
    right = prepare_flight(said.corrected(logs[0]), 0.008, 0.0)
    told, untold = (
        Search.start(late, parameters, 0.008, said).flights(Hypothesis(()))[0]
        for parameters in (drone, base.parameters())
    )
    wrong = [np.abs(flight.body_rate - right.body_rate)[right.valid > 0].mean() for flight in (told, untold)]
    # What is left is noise that was averaged over two rows, twice.
    assert wrong[0] < 0.4 * wrong[1]


def test_repairs_undo_faults(campaigns):
    log = campaigns["clean"].fit[0]
    shifted = log.replace(
        command=np.concatenate([np.repeat(log.command[:1], 2, axis=0), log.command[:-2]]), velocity=1.1 * log.velocity
    )
    interval = log.nominal_interval
    repaired = SensorFaults(velocity_scale=1.1, motor_shift=2 * interval).repaired(shifted)
    inner = np.isin(repaired.time, log.time)
    assert inner.all()
    rows = np.searchsorted(log.time, repaired.time)
    np.testing.assert_allclose(repaired.velocity, log.velocity[rows])
    # Rows are evenly spaced in this log wherever no row is missing.
    even = np.abs(np.interp(repaired.time + 2 * interval, log.time, log.time) - repaired.time - 2 * interval) < 1e-9
    steady = even & (np.diff(log.time, append=log.time[-1])[rows] < 1.1 * interval)
    error = np.abs(repaired.command - log.command[rows])[steady]
    assert np.median(error) < 1e-9
    assert SensorFaults().repaired(log) is log


def test_evidence_is_calibrated_on_noise():
    rng = np.random.default_rng(1)
    statistics = []
    for _ in range(300):
        x = rng.normal(size=(40, 30, 3))
        blocks = np.einsum("bri,brj->bij", x, x)
        statistics.append(evidence(blocks, [], [1, 2], np.ones(3)).t)
    # Fitting on the other blocks leaves noise a little below zero: never too sure.
    assert -0.6 < np.mean(statistics) < 0.1
    assert np.mean(np.array(statistics) > norm.isf(0.05)) < 0.1
    x[..., 0] += 0.3 * x[..., 1]
    found = evidence(np.einsum("bri,brj->bij", x, x), [2], [1], np.ones(3))
    assert found.p_value < 1e-6
    assert found.values[0] == pytest.approx(0.3, abs=0.1)


def test_a_line_in_every_flight_is_found_and_noise_has_none(campaigns, base):
    for name in ("periodic", "clean"):
        campaign = campaigns[name]
        search = Search.start(campaign.fit, base.parameters(), 0.008, check_sensors(campaign.fit, 0.008, 0.0))
        lines = find_spectral_lines(residual_rows(search, search.nothing()))
        if name == "clean":
            assert not lines
        else:
            truth = campaign.truth["effects"]["outside_periodic"]["spin_frequency"] / (2 * np.pi)
            assert lines
            assert all(line.frequency == pytest.approx(truth, abs=0.1) for line in lines)


class Recorded(Checkpoint):
    """A checkpoint that remembers every state it was given."""

    def save(self, progress):
        super().save(progress)
        STATES.append(self.path.read_text())


STATES: list[str] = []


@pytest.fixture(scope="module")
def closed(campaigns, base, tmp_path_factory):
    """The loop closed on drag, with a checkpoint; six flights are enough for it."""
    path = tmp_path_factory.mktemp("search") / "search.json"
    campaign = campaigns["drag"]
    STATES.clear()
    return close_loop(campaign.fit[:6], campaign.held_out, base, checkpoint=Recorded(path, {"a": "b"})), path


def test_drag_is_named_measured_and_bought(closed, campaigns):
    diagnosis, _ = closed
    assert [item.name for item in diagnosis.reported] == ["rotor_drag"]
    truth = campaigns["drag"].truth["effects"]["rotor_drag"]
    # The plant's drag saturates at speed, so the linear coefficient comes out below its slope at rest.
    total = 4 * np.mean(truth["rotor_drag"])
    found = diagnosis.reported[0].parameters["coefficient"]
    assert 0.6 * total < found < 1.05 * total
    assert diagnosis.reported[0].p_value < 1e-6
    before, after = (e.metrics("commands_in") for e in (diagnosis.before, diagnosis.after))
    assert after["velocity_rmse_mps@0.5s"] < 0.5 * before["velocity_rmse_mps@0.5s"]
    assert not diagnosis.faults.to_mappings()
    report = diagnosis.to_json()
    json.dumps(report, default=float)
    assert report["unexplained"] is False


def test_evidence_lies_where_an_effect_acts(closed):
    diagnosis, _ = closed
    (drag,) = diagnosis.reported
    domains = drag.verdict.domains
    assert sum(domains.values()) == pytest.approx(drag.verdict.gain)
    # The drag acts above the centre of gravity, so the body turns too; the rotors do not feel it.
    assert domains["force"] > 0.5 * drag.verdict.gain
    assert domains["torque"] > 0.2 * drag.verdict.gain
    assert domains["rotor_speed"] == 0.0
    assert drag.to_json()["held_out_gain_nats_by_domain"] == domains


def test_a_diagnosis_holds_what_was_weighed_and_both_models(closed):
    diagnosis, _ = closed
    before, after = diagnosis.models
    assert [type(e).name for e in (*before.effects, *after.effects)] == ["rotor_drag"]
    assert diagnosis.candidates
    assert "rotor_drag" not in {each.name for each in diagnosis.candidates}
    gains = [each.gain for each in diagnosis.candidates]
    assert gains == sorted(gains, reverse=True)
    assert all(each.why for each in diagnosis.candidates)
    with_drag, without = (np.concatenate([row.specific_force[row.valid] for row in rows]) for rows in _rows(diagnosis))
    assert np.mean(with_drag**2) < 0.7 * np.mean(without**2)


def _rows(diagnosis):
    """Residuals of the held-out flights, of the corrected model first."""
    return diagnosis.held_out.rows[::-1]


def test_the_corrected_model_predicts_as_reported(closed, campaigns, tmp_path):
    diagnosis, _ = closed
    path = tmp_path / "model.yaml"
    save_model_file(diagnosis.model_file("closed", {"command": "test"}), path)
    model = Quadrotor.from_file(str(path))
    assert [type(e) for e in model.effects] == [RotorDrag]
    again = evaluate(model, campaigns["drag"].held_out).metrics("commands_in")
    reported = diagnosis.after.metrics("commands_in")
    for key, value in reported.items():
        assert again[key] == pytest.approx(value, rel=1e-6)


def test_an_interrupted_search_comes_to_the_result_of_one_that_was_not(closed, campaigns, base, tmp_path):
    diagnosis, _ = closed
    # Interrupted after the first round: an effect was taken in, and others are still to be tried in vain.
    checkpoint = Checkpoint(tmp_path / "search.json", {"a": "b"}, json.loads(STATES[0]))
    again = trace(campaigns["drag"].fit[:6], base.parameters(), checkpoint=checkpoint)
    whole = diagnosis.trace
    for a, b in zip(jax.tree.leaves(again.hypothesis.effects), jax.tree.leaves(whole.hypothesis.effects), strict=True):
        np.testing.assert_array_equal(a, b)
    for name in ("present", "lead", "shift"):
        assert getattr(again.hypothesis, name) == getattr(whole.hypothesis, name)
    np.testing.assert_array_equal(again.errors, whole.errors)
    assert json.dumps(again.tried) == json.dumps(whole.tried)
    for a, b in zip(again.found, whole.found, strict=True):
        for name in ("name", "p_value", "gain", "buys", "parameters", "uncertainty", "confusable"):
            assert getattr(a, name) == getattr(b, name)


def test_what_was_searched_for_can_be_given_up_again(closed):
    diagnosis, path = closed
    nothing = diagnosis.trace.search.nothing()
    hypothesis = Checkpoint(path, {"a": "b"}, json.loads(STATES[-1])).restore(nothing).hypothesis
    assert hypothesis.present == ("rotor_drag",)
    looked_for = {name for name, kind in CATALOGUE.items() if kind.searched and kind.needs is None}
    assert looked_for == {type(e).name for e in hypothesis.effects}
    assert hypothesis.terms == ()
    assert [c.effect for c in diagnosis.trace.search.own_columns(hypothesis)] == ["rotor_drag"]
    given_up = hypothesis.without("rotor_drag")
    np.testing.assert_array_equal(given_up.effect("rotor_drag").coefficient, 0.0)


def test_a_fold_leaves_out_another_part_of_every_flight():
    """Whatever the number of blocks of a flight: never the same of each, and as many in every fold as can be."""
    for count in range(1, 13):
        fold = dealt([count] * 5)
        assert set(np.bincount(fold, minlength=5)) == {count}
        for position in range(count):
            assert set(fold[position::count]) == set(range(5))


def test_named_effects_are_fitted_to_innovations(campaigns, base):
    campaign = campaigns["drag"]
    found = fit_named_effects(campaign.fit, base.parameters(), ("rotor_drag", "thrust_scale"))
    drag, thrust = found.effects
    total = 4 * np.mean(campaign.truth["effects"]["rotor_drag"]["rotor_drag"])
    assert 0.6 * total < float(drag.coefficient) < 1.05 * total
    assert abs(float(thrust.relative)) < 0.02
    assert 0 < found.uncertainty["rotor_drag"]["coefficient"] < 0.1 * total
    assert found.faults.healthy
    with pytest.raises(CfbError, match="warp"):
        fit_named_effects(campaign.fit, base.parameters(), ("warp",))


@pytest.mark.parametrize("guess", [0.1, 0.15, 0.2])
def test_a_limit_is_not_taken_for_half_of_it_and_another(campaigns, base, guess):
    """Of a limit on commands; from there a search goes on that only saw slopes at zero."""
    campaign = campaigns["limited"]
    flights = campaign.fit[:3]
    search = Search.start(flights, base.parameters(), 0.008, check_sensors(flights, 0.008, 0.0))
    nothing = search.learned(search.nothing())
    fitted = search.settled(nothing.having(CATALOGUE["esc_rate_limit"](slowness=guess)))
    limit = fitted.effect("esc_rate_limit")
    assert float(limit.slowness) * campaign.truth["effects"]["esc_rate_limit"]["esc_rate"] == pytest.approx(1, abs=0.1)
    assert float(limit.rotor) < 0.05


def test_a_wind_that_is_found_is_a_force_and_does_not_count_twice():
    """The drag found beside it does not act on it: its conductance stands for all there is."""
    (variant,) = strengths("wind")
    wind = neutral_effects(("wind",))[0]
    for column in variant:
        wind = moved(wind, column, 0.5, present=False)
    assert (float(wind.felt), float(wind.conductance)) == (0.0, pytest.approx(0.02))
    assert shapes(wind) == []
    np.testing.assert_allclose(wind.velocity, 0.5)


def test_what_no_search_looks_for_takes_part_where_it_is_named_or_declared(campaigns, base):
    def names(*given, logs=campaigns["clean"].fit[:1]):
        return Search.start(logs, base.parameters(), 0.008, sensors, *given).names

    sensors = check_sensors(campaigns["clean"].fit, 0.008, 0.0)
    unsearched = {"position_moment", "rate_damping", "gust", "jet", "inertia_products", "vortex_ring", "wall_effect"}
    assert set(CATALOGUE) - set(names()) == unsearched | {"downwash"}
    beside = [with_other(log, log) for log in campaigns["clean"].fit[:1]]
    assert set(CATALOGUE) - set(names(logs=beside)) == unsearched
    assert "position_moment" in names((), ["position_moment"])
    assert "position_moment" in names((CATALOGUE["position_moment"].neutral(),))


def test_nothing_is_reported_on_a_clean_drone(campaigns, base):
    found = trace(campaigns["clean"].fit, base.parameters())
    assert found.found == []
    assert found.faults.healthy


def test_all_effects_at_neutral_replay_like_the_bare_model(campaigns, base):
    campaign = campaigns["clean"]
    search = Search.start(campaign.fit[:1], base.parameters(), 0.008, check_sensors(campaign.fit[:1], 0.008, 0.0))
    bare = evaluate(Quadrotor(base.parameters()), campaign.fit[:1]).metrics("commands_in")
    full = evaluate(search.nothing().model(base.parameters()), campaign.fit[:1]).metrics("commands_in")
    for key, value in bare.items():
        assert full[key] == pytest.approx(value, rel=1e-9)
    assert jnp.isfinite(jnp.asarray(list(full.values()))).all()


def test_flights_are_kept_for_the_last_time_shifts_only(closed):
    diagnosis, _ = closed
    search = dataclasses.replace(diagnosis.trace.search, logs=diagnosis.trace.search.logs[:1], _flights={})
    found = [search.flights(dataclasses.replace(diagnosis.hypothesis, shift=shift)) for shift in (0.0, 0.01, 0.02)]
    assert len(search._flights) == 2
    assert search.flights(dataclasses.replace(diagnosis.hypothesis, shift=0.01)) is found[1]


@pytest.mark.parametrize("axis", [1, 3])
def test_terms_of_formulas_are_the_derivatives_by_their_numbers(closed, axis):
    """Without replaying the model for each: so they must agree with replays."""
    diagnosis, _ = closed
    search, hypothesis = with_library(diagnosis.trace.search, diagnosis.hypothesis)
    search = dataclasses.replace(search, logs=search.logs[:1], _flights={})
    own, library = search.own_columns(hypothesis), term_columns(axis)
    quick = search.linearise_terms(hypothesis, own)[axis]
    slow = search.linearise(hypothesis, own + library)
    a, b = (x.blocks[:, :, [0, *x.index(own + library)]][:, [0, *x.index(own + library)]] for x in (quick, slow))
    size = np.sqrt(np.einsum("bii->bi", b)) + 1e-30
    assert np.max(np.abs(a - b) / (size[:, :, None] * size[:, None, :])) < 0.01


@pytest.mark.parametrize("value", ["fast", None, float("nan"), True])
def test_a_sensor_fault_without_a_sensible_number_is_refused(value):
    item = {"name": "sensor_delay", "parameters": {"delay": value}}
    with pytest.raises(CfbError, match=r"drone\.yaml: effects\.sensor_delay\.parameters\.delay"):
        SensorFaults.from_mappings([item], "drone.yaml")


def test_a_sensor_fault_has_no_parameters_but_its_own():
    item = {"name": "sensor_delay", "parameters": {"delay": 0.02, "vertical": 0.9}}
    with pytest.raises(CfbError, match=r"effects\.sensor_delay\.parameters\.vertical = 0\.9 .*sensor_delay has delay"):
        SensorFaults.from_mappings([item], "drone.yaml")


def test_an_unknown_sensor_fault_is_refused(base):
    with pytest.raises(CfbError, match="unknown effect 'sensor_mood'"):
        Quadrotor.from_file(dataclasses.replace(base, effects=({"name": "sensor_mood"},)))


def test_a_damaged_propeller_is_named_with_its_motor(campaigns, base):
    campaign = campaigns["nicked"]
    truth = campaign.truth["effects"]["prop_damage"]
    sensors = check_sensors(campaign.fit, 0.008, 0.0)
    search = Search.start(campaign.fit, base.parameters(), 0.008, sensors)
    hypothesis = search.learned(search.nothing())
    best = search.probes(hypothesis, search.whole(hypothesis))
    gains = {name: found.gain for name, (found, _) in best.items()}
    assert max(gains, key=gains.get) == "prop_damage"
    found, variant = best["prop_damage"]
    assert dict(variant[0].probe)["motor"] == truth["motor"]
    damaged = [1 + value * column.scale for value, column in zip(found.values, variant, strict=True)]
    np.testing.assert_allclose(damaged, np.array(truth["blades"])[:, truth["motor"] - 1], atol=0.01)


def test_play_of_the_speed_controllers_is_named_with_its_width(campaigns, base):
    campaign = campaigns["sticky"]
    found = trace(campaign.fit, base.parameters(), 0.008)
    assert found.hypothesis.present == ("motor_hysteresis",)
    truth, play = campaign.truth["effects"]["motor_hysteresis"], found.hypothesis.effect("motor_hysteresis")
    # The drone has several plays side by side, and half of its commands are not logged.
    assert float(play.width * play.share) == pytest.approx(truth["play"] * truth["play_share"], rel=0.4)


def test_many_effects_are_found_at_once(campaigns, base):
    """As many as a search that takes in one after the other ends with, each with its own number."""
    campaign = campaigns["many"]
    search = Search.start(campaign.fit, base.parameters(), 0.008, check_sensors(campaign.fit, 0.008, 0.0))
    found = everything(search)
    assert set(campaign.case.labels) <= set(found.hypothesis.present)
    assert len(found.hypothesis.present) < len(campaign.case.labels) + 2
    assert found.beside_hold < 0.2
    truth, model = campaign.truth["effects"], found.hypothesis.effect
    assert float(model("thrust_scale").relative) == pytest.approx(truth["thrust_scale"]["thrust_scale"] - 1, rel=0.1)
    np.testing.assert_allclose(model("cog_offset").offset, truth["cog_offset"]["cog"][:2], atol=1e-4)
    assert float(model("prop_damage").motor) == truth["prop_damage"]["motor"]
    # To first order each is missed.
    for name, (evidence_for, without) in one_by_one(search, found.hypothesis).items():
        assert name not in campaign.case.labels or evidence_for.t > 5
        assert name not in without.present


def test_what_stands_beside_others_is_told_from_what_stands_in_for_them(campaigns, base):
    """Of a drone with one drag two stand beside the declared model, and one beside the other."""
    campaign = campaigns["drag"]
    search = Search.start(campaign.fit, base.parameters(), 0.008, check_sensors(campaign.fit, 0.008, 0.0))
    nothing = search.learned(search.nothing())
    linear = search.whole(nothing)
    alone = {name for name, (found, _) in search.probes(nothing, linear).items() if found.gain > 20 and found.t > 5}
    assert {"rotor_drag", "parasitic_drag"} <= alone
    assert beside_each_other(search, nothing, linear, {"sensor_time_shift"})[0].name == "rotor_drag"
    found = everything(search).hypothesis
    assert found.present[0] == "rotor_drag"
    assert len(found.present) < 3
    # An effect that is not there is seen to be needless, the one that is not.
    both = search.settled(found.having(CATALOGUE["thrust_tilt"](tilt=[0.01, 0.0], twist=0.0)))
    assert set(needless(search, both)) == {"thrust_tilt"}


def test_no_field_says_all_that_another_effect_says_unless_it_is_declared(campaigns, base):
    """Two such numbers, both free, cancel. An effect of which nothing else is left needs no word: it explains nothing
    beside the other, and no search keeps it."""
    logs, parameters = campaigns["drag"].fit, base.parameters()
    search = Search.start(logs, parameters, 0.008, check_sensors(logs, 0.008, 0.0))
    # With a load, so that its place shows.
    loaded = search.learned(search.nothing().having(CATALOGUE["payload"](mass=0.005, height=-0.02, offset=0.0)))
    variants = [variant for name in search.names for variant in strengths(name)]
    variants += [shapes(loaded.effect("payload"))]
    linear = search.linearise(loaded, [column for variant in variants for column in variant])
    products, where = linear.blocks.sum(axis=0), {id(v): linear.index(v) for v in variants}
    same = set()
    for one in variants:
        for other in variants:
            if one[0].effect != other[0].effect:
                index = where[id(other)]
                within = np.linalg.pinv(products[np.ix_(index, index)], hermitian=True)
                for column, i in zip(one, where[id(one)], strict=True):
                    if products[index, i] @ within @ products[index, i] > 0.9998 * products[i, i]:
                        same.add((column.effect, column.field, other[0].effect))
    numbers = {name: {column.field for v in variants if v[0].effect == name for column in v} for name in search.names}
    said = {(name, field, by) for name in search.names for field, by in CATALOGUE[name].said_by.items()}
    whole = {(name, by) for name, _, by in same if numbers[name] <= {f for n, f, b in same if (n, b) == (name, by)}}
    assert {each for each in same if (each[0], each[2]) not in whole} == said


def test_a_load_beside_the_axis_is_told_from_one_on_it_and_a_centre_of_gravity_of_its_own(campaigns, base):
    """The place of the load takes up the other, but for an inertia that is not there."""
    campaign = campaigns["loaded"]
    search = Search.start(campaign.fit, base.parameters(), 0.008, check_sensors(campaign.fit, 0.008, 0.0))
    aside = search.learned(search.nothing())
    aside = search.settled(aside.having(aside.effect("payload")), shrunk=True)
    assert np.hypot(*aside.effect("payload").offset) > 0.01
    found = told_apart(search, as_it_is(search, aside, whole=False)).hypothesis
    assert found.present == ("payload", "cog_offset")
    np.testing.assert_array_equal(found.effect("payload").offset, 0.0)
    truth = campaign.truth["effects"]
    mass, load = float(base.parameters().mass), float(found.effect("payload").mass)
    assert load == pytest.approx(truth["payload"]["mass"], rel=0.05)
    # There the whole drone's centre of gravity lies beside the axis, here the bare drone's.
    place = found.effect("cog_offset").offset * mass / (mass + load)
    np.testing.assert_allclose(place, truth["cog_offset"]["cog"][:2], atol=5e-5)
    # What that drone has needs no telling apart.
    fit = as_it_is(search, found, whole=False)
    assert told_apart(search, fit) is fit


def test_what_is_taken_out_goes_back_to_the_declared_model(campaigns, base):
    """Not to nothing: a declared drag that was found to be larger is as declared without that finding."""
    logs, parameters = campaigns["drag"].fit[:1], base.parameters()
    search = Search.start(logs, parameters, 0.008, check_sensors(logs, 0.008, 0.0), (RotorDrag(0.02),))
    found = search.nothing().having(RotorDrag(0.03))
    (column,) = strengths("rotor_drag")[0]
    assert search.prior(found, [column]).center * column.scale == pytest.approx([-0.01])
    assert float(found.without("rotor_drag").effect("rotor_drag").coefficient) == pytest.approx(0.02)


def test_the_innovations_contradict_what_predictions_only_wish_for(campaigns, base):
    """A clean drone has its declared inertia and no brake, whatever a model pretends."""
    sensors = check_sensors(campaigns["clean"].fit, 0.008, 0.0)
    search = Search.start(campaigns["clean"].fit, base.parameters(), 0.008, sensors, (), ["rate_damping"])
    model = Quadrotor(base.parameters(), (Inertia([0.25, 0.25, 0.25]), RateDamping(8e-5), RotorDrag(0.0)))
    found = asked(search, model, ["inertia", "rate_damping"])
    for number in found["inertia"][:2]:
        assert number.value == pytest.approx(0.0, abs=0.06)
        assert number.contradicts
    (brake,) = found["rate_damping"]
    assert brake.name == "rate_damping.coefficient"
    assert brake.contradicts
    assert abs(brake.value) < 3e-5
    honest = asked(search, Quadrotor(base.parameters(), (Inertia([0.0, 0.0, 0.0]),)), ["inertia"])
    assert not any(number.contradicts for number in honest["inertia"][:2])
