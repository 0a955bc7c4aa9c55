"""Drones of the reference simulator flown by others than their own controller, and what is measured of such flights."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cfb_mjx.control.policy_file import load_policy
from cfb_mjx.errors import CfbError
from cfb_mjx.loop import flights, trials
from cfb_mjx.loop.flights import FIT, HELD_OUT, fly_campaign
from cfb_mjx.loop.trials import controller_of, figure_eight, fly_trials
from cfb_mjx.reference_simulator import Case, physics
from cfb_mjx.reference_simulator import constants as c
from cfb_mjx.reference_simulator.airframe import P, Q, V
from cfb_mjx.reference_simulator.controller import (
    POSITION,
    SETPOINT_COLUMNS,
    VELOCITY,
    YAW_ANGLE,
    YAW_RATE,
    OtherController,
    relative,
)
from cfb_mjx.reference_simulator.manoeuvres import MANOEUVRES
from cfb_mjx.reference_simulator.sensors import QUIET, draw_instruments
from cfb_mjx.reference_simulator.simulation import Lane, simulate

pytestmark = pytest.mark.xdist_group("loop")

HOVER = c.HOVER_SPEED / c.MOTOR_GAIN
# The end of a noisy flight, from before any other controller could fly a plant: campaigns must stay what they were.
BEFORE_POSE = [
    *(0.9286349408332036, -1.1273545422753337, 1.0810925325141159),
    *(-0.624441767467177, -0.5503681333353501, 0.013299323343159652),
    *(0.9987054796626886, -0.014855167668076624, 0.026788365494882106, 0.040608771951206456),
]
BEFORE_MOTORS = [
    *(0.5860074769207294, 0.5544518196383612, 0.5794613565270467, 0.5773556115053025),
    *(1723.6995516977001, 1599.1365653032583, 1699.0469964389888, 1671.547034406841),
]


@pytest.fixture(scope="module")
def target():
    return load_policy("target").controller


@pytest.fixture
def short_warm_up(monkeypatch):
    monkeypatch.setattr(c, "WARM_UP_TICKS", 100)


def lane(setpoints, noisy=False, every=1):
    rng = np.random.default_rng(3)
    rows = np.arange(0, len(setpoints) * c.SETPOINT_TICKS, every)
    instruments = draw_instruments(rng) if noisy else QUIET
    return Lane(physics.nominal(), instruments, setpoints, rows, 3.7, np.zeros(3), rng)


def test_what_is_only_logged_has_noise_of_its_own():
    """The first hundred numbers of every stream of a few flights: none of them comes twice."""
    case, body, instruments = Case("drone", 3), physics.nominal(), QUIET
    drawn = []
    for index in range(2):
        for attempt in range(2):
            flown = flights._lane(case, index, "figure8", attempt, body, instruments, 0.01)
            drawn += [flown.rng.standard_normal(100), flights._logging(case, index, attempt).standard_normal(100)]
    assert len(np.unique(drawn)) == 800


def still(seconds):
    setpoints = np.zeros((round(seconds / (c.SETPOINT_TICKS * c.TICK)), SETPOINT_COLUMNS))
    setpoints[:, POSITION] = [0.3, -0.2, 1.0]
    return setpoints


def test_the_built_in_controller_flies_as_it_did_before_there_were_others():
    setpoints = MANOEUVRES["lateral"](np.random.default_rng(5), 3.0, 1.0)
    flight = simulate([lane(setpoints, noisy=True)])[0]
    np.testing.assert_allclose(flight.pose[-1], BEFORE_POSE, rtol=0, atol=1e-7)
    np.testing.assert_allclose(flight.motors[-1], BEFORE_MOTORS, rtol=1e-7)


def test_constant_hover_commands_hold_a_quiet_drone(short_warm_up):
    asked = []

    def fly(memory, seen):
        asked.append(seen)
        return (memory or 0) + 1, np.full((4, 1), HOVER)

    flight = simulate([lane(still(1.0))], OtherController(4, fly))[0]
    assert not flight.crashed
    assert np.abs(flight.pose[:, P] - [0.3, -0.2, 1.0]).max() < 0.01
    assert len(asked) == -(-(c.WARM_UP_TICKS + 500 + 1) // 4)
    assert np.abs(asked[-1].position).max() < 0.01


def test_commands_are_held_and_memory_is_carried(short_warm_up):
    def fly(memory, seen):
        memory = 0 if memory is None else memory + 1
        return memory, np.full((4, 1), HOVER + 0.01 * (-1) ** memory)

    flight = simulate([lane(still(0.5))], OtherController(4, fly))[0]
    command = flight.motors[:, 0]
    changes = np.flatnonzero(np.diff(command)) + 1
    np.testing.assert_array_equal(changes, np.arange(4, len(command), 4))


def test_what_a_controller_sees_is_relative_to_a_target_that_moves_and_turns():
    rng = np.random.default_rng(0)
    goal, late, gyro = np.zeros((SETPOINT_COLUMNS, 1)), rng.normal(size=(10, 1)), rng.normal(size=(3, 1))
    goal[POSITION, 0], goal[VELOCITY, 0] = rng.normal(size=3), rng.normal(size=3)
    goal[YAW_ANGLE], goal[YAW_RATE] = 0.7, 0.4
    late[Q] /= np.linalg.norm(late[Q])
    seen = relative(goal, late, gyro)
    heading = Rotation.from_euler("z", 0.7)
    np.testing.assert_allclose(seen.position[:, 0], heading.inv().apply((late[P] - goal[POSITION])[:, 0]))
    np.testing.assert_allclose(seen.velocity[:, 0], heading.inv().apply((late[V] - goal[VELOCITY])[:, 0]))
    turned = heading.inv() * Rotation.from_quat(late[Q, 0], scalar_first=True)
    shown = Rotation.from_quat(seen.quaternion[:, 0], scalar_first=True)
    np.testing.assert_allclose(shown.as_matrix(), turned.as_matrix(), atol=1e-12)
    np.testing.assert_allclose(seen.body_rate[:, 0], gyro[:, 0] - [0, 0, 0.4])


def test_a_shipped_policy_flies_the_nominal_plant(target):
    flight = simulate([lane(still(2.0), noisy=True)], controller_of([target]))[0]
    assert not flight.crashed
    assert np.linalg.norm(flight.pose[:, P] - [0.3, -0.2, 1.0], axis=1).mean() < 0.03


def test_only_like_policies_fly_side_by_side(target):
    with pytest.raises(CfbError, match="same observation"):
        controller_of([target, load_policy("target-adaptive").controller])


def test_a_campaign_holds_what_tracing_needs(target, short_warm_up):
    case = Case("heavy", 61_990, (("payload", 1.0),))
    flown = fly_campaign(case, target, duration_scale=0.06)
    assert (len(flown.fit), len(flown.held_out)) == (len(FIT), len(HELD_OUT))
    assert flown.truth["labels"] == ["payload"]
    assert max(flown.tries) == 1
    names = [log.name for log in flown.fit + flown.held_out]
    assert len(set(names)) == len(names)
    for log in flown.fit + flown.held_out:
        assert log.observation_delay == c.POSE_TICKS * c.TICK
        assert log.position[:, 2].min() > 0.2
        assert np.ptp(log.command) > 0.005


def test_a_drone_that_cannot_be_kept_in_the_air_is_said_so(target, monkeypatch):
    monkeypatch.setattr(flights, "TRIES", 2)
    dropped = SimpleNamespace(crashed=True)
    monkeypatch.setattr(flights, "simulate", lambda lanes, controller: [dropped] * len(lanes))
    with pytest.raises(CfbError, match=r"lost-cause: .*in the air .*long_hover"):
        fly_campaign(Case("lost-cause", 61_991), target, duration_scale=0.1)


def test_the_figure_eight_moves_as_its_velocity_says():
    time = np.linspace(0, trials.TRACK_S, 20_001)
    place, velocity = figure_eight(time)
    np.testing.assert_allclose(np.gradient(place, time, axis=0)[1:-1], velocity[1:-1], atol=1e-3)
    np.testing.assert_array_equal(figure_eight(np.array([-1.0]))[1], 0.0)


def test_trials_are_the_same_for_every_policy_and_name_crashes(target, monkeypatch, short_warm_up):
    monkeypatch.setattr(trials, "HOVERS", 2)
    monkeypatch.setattr(trials, "TRACKS", 1)
    monkeypatch.setattr(trials, "HOVER_S", 1.2)
    monkeypatch.setattr(trials, "TRACK_S", 3.2)
    off = target.layout
    wild = type(target)(type(target.network)(*_turned_round(target.network)), off)
    judged = fly_trials(Case("windy", 61_992, (("wind", 1.0),)), {"a": target, "b": target, "wild": wild}, "a")
    assert judged["a"] == judged["b"]
    assert judged["a"].to_json()["crashed"] == 0
    assert 0 < max(judged["a"].hover_mm) < 100
    assert judged["without_effect"] != judged["a"]
    assert judged["wild"].to_json()["crashed"] == 3
    assert np.isnan(judged["wild"].hover_mm).all()


def _turned_round(network):
    """The same network with its last layer's signs turned: it does the opposite."""
    return (*network.weights[:-1], -network.weights[-1]), network.biases
