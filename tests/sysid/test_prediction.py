"""Predictions against SciPy, exact data predicted exactly, and the metrics against hand calculations."""

from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from cfb_mjx.errors import CfbError
from cfb_mjx.logs import FlightLog
from cfb_mjx.model import Quadrotor
from cfb_mjx.sysid import HORIZONS, evaluate, replay
from cfb_mjx.sysid.evaluation import _refuse_diverged, before_and_after
from cfb_mjx.sysid.flight import ROWS, prepare_flight
from cfb_mjx.sysid.metrics import geodesic_deg, intervals, metrics
from cfb_mjx.sysid.prediction import start_of_windows, starts_of_windows
from cfb_mjx.sysid.replay import Lane, replays
from cfb_mjx.sysid.sensor_faults import SensorFaults
from cfb_mjx.sysid.windows import find_windows

MASS, INERTIA, LAG, GAIN, ROTOR_INERTIA, HALF = 0.044, np.array([3.3e-5, 3.6e-5, 5.9e-5]), 0.05, 2900.0, 5e-8, 0.03535


def derivative(_, x, u):
    """The paper's equations, written out here and not taken from the library."""
    q, omega, speed = x[6:10], x[10:13], x[13:17]
    s = speed / 2900
    thrust = np.maximum(-0.23 * s**3 + 0.562 * s**2 - 0.043 * s, 0)
    drag = 1e-4 * (-3.4 * s**3 + 8.7 * s**2 + 2.9 * s)
    speed_rate = (GAIN * u - speed) / LAG
    torque = np.array(
        [
            HALF * np.dot([-1, -1, 1, 1], thrust),
            HALF * np.dot([-1, 1, 1, -1], thrust),
            np.dot([-1, 1, -1, 1], ROTOR_INERTIA * speed_rate + drag),
        ]
    )
    up = Rotation.from_quat(q, scalar_first=True).as_matrix()[:, 2]
    acceleration = up * thrust.sum() / MASS - [0, 0, 9.81]
    omega_rate = (torque - np.cross(omega, INERTIA * omega)) / INERTIA
    w, v = q[0], q[1:]
    q_rate = 0.5 * np.concatenate([[-v @ omega], w * omega + np.cross(v, omega)])
    return np.concatenate([x[3:6], acceleration, q_rate, omega_rate, speed_rate])


@pytest.fixture(scope="module")
def exact_log():
    """A noise-free open-loop flight with an 8 ms delay, at 250 Hz, commands held between rows."""
    rng = np.random.default_rng(3)
    time = np.arange(0, 2.6, 0.004)
    slow = rng.normal(size=(len(time) // 5 + 1, 4)).repeat(5, axis=0)[: len(time)]
    command = np.clip(0.55 + 0.02 * slow, 0, 1)
    command[0] = 0.55
    x = np.concatenate([[0, 0, 10.0], np.zeros(3), [1, 0, 0, 0], np.zeros(3), np.full(4, GAIN * 0.55)])
    fine, states = [0.0], [x]
    for i, start in enumerate(time):
        grid = [0.002, 0.004]
        solution = solve_ivp(derivative, (0, 0.004), x, "DOP853", grid, args=(command[i],), rtol=1e-10, atol=1e-12)
        for t, y in zip(grid, solution.y.T, strict=True):
            fine.append(start + t)
            states.append(y)
        x = solution.y[:, -1]
    states = np.array(states)
    now = states[::2][: len(time)]
    late = states[np.maximum(2 * np.arange(len(time)) - 4, 0)]  # 8 ms earlier
    return FlightLog(
        time=time,
        position=late[:, 0:3],
        velocity=late[:, 3:6],
        quaternion=late[:, 6:10] / np.linalg.norm(late[:, 6:10], axis=1, keepdims=True),
        body_rate=now[:, 10:13],
        specific_force=np.tile([0.0, 0.0, 9.81], (len(time), 1)),
        command=command,
        rotor_speed=now[:, 13:17],
        battery_voltage=None,
        metadata={"name": "exact", "source": "exact.csv", "format": "tabular", "observation_delay": 0.008},
    )


@pytest.fixture(scope="module")
def evaluation(exact_log):
    return evaluate(Quadrotor.from_file("cfb-guards"), [exact_log])


def test_exact_data_is_predicted_exactly(evaluation):
    result = evaluation.to_json()
    assert result["windows"] == 8
    # What is left: linear interpolation of nothing (windows start on rows) and RK4 at 4 ms.
    assert result["commands_in"]["position_rmse_m@0.5s"] < 1e-6
    assert result["commands_in"]["attitude_rmse_deg@0.5s"] < 1e-4
    assert result["commands_in"]["rate_rmse_radps@0.5s"] < 1e-5
    # Rotor speeds between rows are taken as straight lines: not exact, but far below any sensor.
    assert result["rotor_speed_in"]["position_rmse_m@0.5s"] < 1e-3
    assert result["rotor_speed_in"]["attitude_rmse_deg@0.5s"] < 0.2
    assert result["hold"]["attitude_rmse_deg@0.5s"] > 1


def test_hold_is_constant_velocity_and_body_rate(evaluation, exact_log):
    log = evaluation.logs[0]
    i = int(np.searchsorted(exact_log.time, log.windows.start[2] - 1e-9))
    delayed = i + 2
    horizon = HORIZONS[-1]
    expected = exact_log.position[delayed] + horizon * exact_log.velocity[delayed]
    np.testing.assert_allclose(log.predictions["hold"].position[2, -1], expected, atol=1e-9)
    turn = Rotation.from_rotvec(exact_log.body_rate[i] * horizon)
    start = Rotation.from_quat(exact_log.quaternion[delayed], scalar_first=True)
    found = Rotation.from_quat(log.predictions["hold"].quaternion[2, -1], scalar_first=True)
    assert ((start * turn).inv() * found).magnitude() < 1e-9


def test_a_wrong_model_predicts_worse(exact_log, evaluation):
    wrong = evaluate(Quadrotor.from_file("cfb"), [exact_log]).metrics("commands_in")
    right = evaluation.metrics("commands_in")
    assert all(wrong[key] > 3 * right[key] for key in right if key.endswith("@0.5s"))


def test_pooling_is_over_windows_of_all_logs(exact_log):
    half = exact_log.slice(0.0, 2.0).replace(metadata={"name": "half"})
    model = Quadrotor.from_file("cfb")
    pooled, first, second = (evaluate(model, logs) for logs in ([exact_log, half], [exact_log], [half]))
    key = "velocity_rmse_mps@0.2s"
    n1, n2 = len(first.logs[0].windows), len(second.logs[0].windows)
    squares = n1 * first.metrics("commands_in")[key] ** 2 + n2 * second.metrics("commands_in")[key] ** 2
    assert pooled.metrics("commands_in")[key] == pytest.approx(np.sqrt(squares / (n1 + n2)))


def test_two_logs_of_one_name_and_no_window_are_refused(exact_log):
    model = Quadrotor.from_file("cfb-guards")
    with pytest.raises(CfbError, match=r"exact.*name"):
        evaluate(model, [exact_log, exact_log])
    with pytest.raises(CfbError, match=r"exact.*window"):
        evaluate(model, [exact_log.slice(0.0, 0.9)])


def test_a_model_that_diverges_is_refused_by_flight_and_window(exact_log):
    model = eqx.tree_at(lambda m: m.parameters.mass, Quadrotor.from_file("cfb-guards"), jnp.asarray(1e-200))
    with pytest.raises(CfbError, match=r"exact: the model diverges: (\d+) of \1 predictions .* from 0\.60 s on"):
        evaluate(model, [exact_log])
    kept = evaluate(model, [exact_log], keep_diverged=True).metrics("commands_in")
    assert not np.isfinite(kept["velocity_rmse_mps@0.5s"])


def test_geodesic_angle_matches_scipy_and_ignores_sign():
    rng = np.random.default_rng(0)
    p, q = (Rotation.random(50, rng=rng) for _ in range(2))
    expected = np.degrees((p.inv() * q).magnitude())
    found = geodesic_deg(p.as_quat(scalar_first=True), -q.as_quat(scalar_first=True))
    np.testing.assert_allclose(found, expected, atol=1e-9)
    tiny = Rotation.from_rotvec([1e-9, 0, 0]).as_quat(scalar_first=True)
    assert geodesic_deg(np.array([1.0, 0, 0, 0]), tiny) == pytest.approx(np.degrees(1e-9), rel=1e-6)


def test_bootstrap_intervals_cover_the_mean_of_independent_errors():
    """Coverage of the 95 % interval of the mean over repeated draws of known distribution."""
    rng = np.random.default_rng(1)
    key, hits = "position_mean_m@0.1s", 0
    for repeat in range(100):
        draw = {name: rng.exponential(size=(120, 1)) for name in ("position", "velocity", "attitude", "rate")}
        low, high = intervals([draw], (0.1,), resamples=200, seed=repeat)[key]
        hits += low <= 1.0 <= high
        assert low <= metrics(draw, (0.1,))[key] <= high
    assert 85 <= hits <= 100


def test_flights_side_by_side_start_as_one_by_one_whatever_has_no_window(exact_log):
    """Ten with windows, and one too short for any."""
    short = exact_log.rows(np.arange(len(exact_log)) < 100)
    logs = [exact_log.replace(command=exact_log.command * (1 - 0.01 * i)) for i in range(10)]
    logs[3:3], model = [short], Quadrotor.from_file("cfb-guards")
    windows = [find_windows(log, HORIZONS, 0.008, 0.0) for log in logs]
    assert [len(own) > 0 for own in windows] == [log is not short for log in logs]
    flights = [prepare_flight(log, 0.008, 0.0) if len(own) else None for log, own in zip(logs, windows, strict=True)]
    found = starts_of_windows(model, logs, windows, flights)
    for log, own, (speed, memory) in zip(logs, windows, found, strict=True):
        assert memory == ()
        assert speed.shape == (len(own), 4)
        if len(own):
            np.testing.assert_allclose(speed, start_of_windows(model, log, own, 0.008)[0], rtol=1e-12)


def test_long_flights_are_walked_along_in_smaller_groups(exact_log, monkeypatch):
    """Many long recordings at once would fill the memory; what is said of each stays the same."""
    flights = [prepare_flight(exact_log.rows(np.arange(len(exact_log)) < n), 0.008, 0.0) for n in (650, 400, 600)]
    model = Quadrotor.from_file("cfb-guards")
    lanes = [Lane(flight, flight.rotor_speed, 0.1 * i) for i, flight in enumerate(flights)]
    together = list(replays(model, lanes))
    monkeypatch.setattr("cfb_mjx.sysid.replay.MOST", len(flights[0].time) + 1)
    walked = []
    advance = replay._advance
    monkeypatch.setattr(replay, "_advance", lambda *x: walked.append(x) or advance(*x))
    apart = list(replays(model, lanes))
    assert len(walked) == sum(len(flight.time) // ROWS for flight in flights)
    for one, other, flight in zip(together, apart, flights, strict=True):
        assert len(one.rotor_speed) == len(flight.time)
        for a, b in zip(one, other, strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-12)


def test_rotor_speeds_run_on_from_block_to_block(exact_log):
    """Against the exact lag of first order, which knows no blocks."""
    model = Quadrotor.from_file("cfb")
    flight = prepare_flight(exact_log, 0.008, 0.0)
    (said,) = replays(model, [Lane(flight, flight.rotor_speed)])
    lag, gain = (np.asarray(getattr(model.parameters, f"motor_{x}")) for x in ("time_constant", "gain"))
    speed, n = gain * flight.command[0], len(exact_log)
    assert n > ROWS
    for row in range(n):
        np.testing.assert_allclose(said.rotor_speed[row], speed, rtol=1e-9)
        target = gain * flight.command[row]
        speed = target + (speed - target) * np.exp(-flight.interval[row] / lag)


def test_rotors_run_on_from_the_last_row_to_a_start_between_rows(exact_log):
    """Against the exact lag of first order; commands beyond the range are clipped."""
    time = np.arange(0, 2.0, 0.007)
    command = np.random.default_rng(4).uniform(-0.2, 1.2, (len(time), 4))
    log = exact_log.rows(np.arange(len(time))).replace(time=time, command=command)
    windows = find_windows(log, HORIZONS, 0.0, 0.0)
    found, _ = start_of_windows(Quadrotor.from_file("cfb-guards"), log, windows, 0.0)
    assert np.ptp(windows.start - time[windows.row]) > 0.003
    for start, speed in zip(windows.start, found, strict=True):
        rows = time <= start
        expected = GAIN * np.clip(command[0], 0, 1)
        for u, duration in zip(command[rows], np.diff(np.append(time[rows], start)), strict=True):
            target = GAIN * np.clip(u, 0, 1)
            expected = target + (expected - target) * np.exp(-duration / LAG)
        np.testing.assert_allclose(speed, expected, rtol=1e-9)


def test_before_and_after_are_told_apart(exact_log, evaluation):
    other = evaluate(Quadrotor.from_file("cfb"), [exact_log])
    told = before_and_after(other, evaluation)
    assert told["hold"] == evaluation.metrics("hold")
    for name, model in (("before", other), ("after", evaluation)):
        assert told[name] == model.metrics("commands_in")
        assert told[f"{name}_rotor_speed_in"] == model.metrics("rotor_speed_in")


def test_windows_with_rotor_speed_are_counted(exact_log):
    """Rotor speeds end at 1.5 s: 500 ms from 0.6, 0.8 and 1.0 s are within."""
    speed = np.where(exact_log.time[:, None] <= 1.5 + 1e-9, exact_log.rotor_speed, np.nan)
    told = evaluate(Quadrotor.from_file("cfb-guards"), [exact_log.replace(rotor_speed=speed)])
    assert told.to_json()["rotor_speed_in_windows"] == 3
    assert told.logs[0].predictions["rotor_speed_in"].position.shape == (3, len(HORIZONS), 3)


def test_the_first_window_that_diverges_is_one_of_those_with_rotor_speed(evaluation):
    """Of the windows from 0.6 s on, only those from 1.0 s on have rotor speeds; the second of these diverges."""
    log = evaluation.logs[0]
    there = log.windows.start > 0.99
    errors = {"rate": np.where(np.arange(there.sum()) == 1, np.inf, 0.0)[:, None]}
    spoiled = replace(log, measured=there, errors={"commands_in": None, "rotor_speed_in": errors})
    with pytest.raises(
        CfbError, match=r"1 of 6 predictions \(rotor_speed_in\) are not finite, the first from 1\.20 s on"
    ):
        _refuse_diverged(spoiled)


def test_holding_still_starts_from_what_was_recorded_whatever_the_faults(exact_log, evaluation):
    faults = SensorFaults(gyro_scale=1.1)
    held = evaluate(Quadrotor.from_file("cfb-guards"), [exact_log], faults=faults).logs[0].predictions["hold"]
    np.testing.assert_allclose(held.body_rate, evaluation.logs[0].predictions["hold"].body_rate, rtol=1e-12)
