"""The benchmark's numbers against brute force in plain NumPy, its rules, and the command's refusals."""

import json
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from plant import Plant, derivative, fly
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from cfb_mjx.cli import main
from cfb_mjx.errors import CfbError
from cfb_mjx.logs import FlightLog, idsia
from cfb_mjx.model import Quadrotor
from cfb_mjx.model.effects import BladeFlapping
from cfb_mjx.sysid import nanodrone
from cfb_mjx.sysid.observer import Observer
from cfb_mjx.sysid.sensor_faults import SensorFaults

ROWS = 58
GUARDS = Quadrotor.from_file("cfb-guards")


@pytest.fixture(scope="module")
def log() -> FlightLog:
    """58 rows at 100 Hz: 8 windows; made of a plant's flight, with times and signals taken as they come."""
    made = fly(Plant(), 0.6, 5)[0].rows(np.arange(0, 4 * (ROWS // 2), 2)[:ROWS])
    return made.replace(time=0.01 * np.arange(len(made)), metadata={"name": "tiny", "observation_delay": 0.008})


def angle(p, q):
    return (Rotation.from_quat(p, scalar_first=True).inv() * Rotation.from_quat(q, scalar_first=True)).magnitude()


def brute(log, predict_one):
    """Metrics by loops over windows and steps; ``predict_one(row)`` yields the 50 predicted states."""
    total = np.zeros((50, 4))
    count = 0
    for row in range(len(log) - 50):
        for h, (p, v, q, w) in enumerate(predict_one(row)):
            k = row + h + 1
            total[h] += [
                np.linalg.norm(p - log.position[k]),
                np.linalg.norm(v - log.velocity[k]),
                angle(q, log.quaternion[k]),
                np.linalg.norm(w - log.body_rate[k]),
            ]
        count += 1
    mean = total / count
    found = {}
    for i, (quantity, unit) in enumerate(
        [("position", "m"), ("velocity", "mps"), ("attitude", "rad"), ("rate", "radps")]
    ):
        found |= {f"{quantity}_mean_{unit}@{h}": mean[h - 1, i] for h in (1, 10, 50)}
        found[f"{quantity}_sum_{unit}"] = mean[:, i].sum()
    return found


def at(log, row):
    return log.position[row], log.velocity[row], log.quaternion[row], log.body_rate[row]


def integrated(log, row):
    """The paper's equations with the rotor speed of the step's first row, RK4."""
    plant = Plant()
    x = np.concatenate([*at(log, row), np.zeros(4)])[None]
    for h in range(50):
        speed = log.rotor_speed[row + h]
        x[0, 13:17] = speed
        # Commands that hold the speed: the derivative of rotor speed is then zero.
        u = (speed / 2900.0)[None]
        dt, push = 0.005, np.zeros((1, 3))
        for _ in range(2):
            k1 = derivative(plant, x, u, push)
            k2 = derivative(plant, x + 0.5 * dt * k1, u, push)
            k3 = derivative(plant, x + 0.5 * dt * k2, u, push)
            k4 = derivative(plant, x + dt * k3, u, push)
            x = x + dt / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
            x[:, 6:10] /= np.linalg.norm(x[:, 6:10])
        yield x[0, :3], x[0, 3:6], x[0, 6:10], x[0, 10:13]


def held(log, row):
    p, v, q, w = at(log, row)
    for h in range(1, 51):
        turn = Rotation.from_rotvec(w * 0.01 * h)
        turned = (Rotation.from_quat(q, scalar_first=True) * turn).as_quat(scalar_first=True)
        yield p + 0.01 * h * v, v, turned, w


def thrown(log, row):
    """Thrust of the paper's constants turning with a constant body rate, by an integrator of SciPy's."""
    p, v, q, w = at(log, row)
    turned = Rotation.from_quat(q, scalar_first=True)

    def slope(t, x, lift):
        up = (turned * Rotation.from_rotvec(w * t)).apply([0.0, 0.0, 1.0])
        return np.concatenate([x[3:], up * lift - [0.0, 0.0, 9.81]])

    x = np.concatenate([p, v])
    for k in range(50):
        lift = 3.72e-8 * np.sum(log.rotor_speed[row + k] ** 2) / 0.045
        x = solve_ivp(slope, (0.01 * k, 0.01 * (k + 1)), x, args=(lift,), rtol=1e-10, atol=1e-12).y[:, -1]
        q = (turned * Rotation.from_rotvec(w * 0.01 * (k + 1))).as_quat(scalar_first=True)
        yield x[:3], x[3:], q, w


def test_metrics_are_those_of_brute_force(log):
    found = nanodrone.benchmark([log], {"declared": nanodrone.Contestant(GUARDS)})
    assert found["windows"] == found["flights"]["tiny"]["windows"] == ROWS - 50
    expected = {
        "naive": brute(log, lambda row: [at(log, row)] * 50),
        "hold": brute(log, lambda row: held(log, row)),
        "physics": brute(log, lambda row: thrown(log, row)),
        "declared": brute(log, lambda row: integrated(log, row)),
    }
    for name, numbers in expected.items():
        assert set(found["rows"][name]) == set(numbers)
        for key, value in numbers.items():
            # The thrust of a step of physics is that halfway through its turn.
            close = pytest.approx(value, rel=1e-4 if name == "physics" else 1e-5)
            assert found["rows"][name][key] == close, (name, key)
        assert found["flights"]["tiny"]["rows"][name] == found["rows"][name]


@pytest.mark.parametrize("observer", [None, Observer()], ids=["model", "observer"])
def test_a_prediction_knows_rotor_speeds_up_to_its_step_only(log, observer):
    changed = np.array(log.rotor_speed)
    changed[30:] += 200.0
    row, before = 3, nanodrone.find_starts(log)
    contestant = nanodrone.Contestant(GUARDS, observer)
    other = log.replace(rotor_speed=changed)
    a = nanodrone.predict(contestant, log, before)
    b = nanodrone.predict(contestant, other, nanodrone.find_starts(other))
    # Step h is driven by row 3 + h - 1: the first that may differ is h = 28.
    for x, y in zip(a, b, strict=True):
        np.testing.assert_array_equal(x[row, : 30 - row], y[row, : 30 - row])
    assert not np.allclose(a[3][row, 30 - row], b[3][row, 30 - row])


def test_an_observer_uses_nothing_but_the_past(log):
    model = Quadrotor(GUARDS.parameters, (BladeFlapping(-5e-4, 0.0),))  # so that velocity matters
    rng = np.random.default_rng(0)
    spoilt = {}
    for name in ("position", "velocity", "quaternion", "body_rate", "specific_force", "command"):
        values = np.array(getattr(log, name))
        values[7:] = np.abs(rng.normal(size=values[7:].shape))
        spoilt[name] = values
    spoilt["quaternion"][7:] /= np.linalg.norm(spoilt["quaternion"][7:], axis=1, keepdims=True)
    contestant = nanodrone.Contestant(model, Observer())
    a, b = (nanodrone.predict(contestant, x, nanodrone.find_starts(x)) for x in (log, log.replace(**spoilt)))
    for x, y in zip(a, b, strict=True):
        np.testing.assert_array_equal(x[:7], y[:7])


@pytest.mark.parametrize("observer", [None, Observer()], ids=["model", "observer"])
def test_a_stretched_velocity_column_is_known_at_the_start_and_put_back(log, observer):
    model = Quadrotor(GUARDS.parameters, (BladeFlapping(-5e-4, 0.0),))  # so that velocity matters
    stretch = np.array([1.09, 1.09, 0.98])
    stretched = log.replace(velocity=log.velocity * stretch)
    faults = SensorFaults(velocity_scale=1.09, vertical_scale=0.98)
    a, b = nanodrone.find_starts(log), nanodrone.find_starts(stretched)
    true = nanodrone.predict(nanodrone.Contestant(model, observer), log, a)
    found = nanodrone.predict(nanodrone.Contestant(model, observer, faults), stretched, b)
    for x, y, factor in zip(found, true, (1, stretch, 1, 1), strict=True):
        np.testing.assert_allclose(x, y * factor, rtol=1e-9, atol=1e-12)
    ignored = nanodrone.predict(nanodrone.Contestant(model, observer), stretched, b)
    assert np.abs(ignored[0] - true[0]).max() > 1e-4


@pytest.mark.parametrize("observer", [None, Observer()], ids=["model", "observer"])
def test_of_a_column_stretched_with_the_attitude_only_the_position_is_put_right(log, observer):
    model = Quadrotor(GUARDS.parameters, (BladeFlapping(-5e-4, 0.0),))
    faults = SensorFaults(
        velocity_scale=1.16, vertical_scale=1.0, velocity_rise=0.3, velocity_fade=0.7, with_attitude=1
    )
    memory = faults.stretch.memory(log.time, log.velocity)
    led = log.replace(position=faults.stretch.left(log.position, memory))
    a, b = nanodrone.find_starts(log), nanodrone.find_starts(led)
    true = nanodrone.predict(nanodrone.Contestant(model, observer), log, a)
    found = nanodrone.predict(nanodrone.Contestant(model, observer, faults), led, b)
    for x, y in zip(found[1:], true[1:], strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-9, atol=1e-9)
    # Carried along the flown velocities, the lags take off the position what they do along the predicted ones.
    carried = faults.stretch.carried(
        memory[a.row], np.full(50, 0.01), np.concatenate([log.velocity[a.row, None], true[1]], 1)
    )
    np.testing.assert_allclose(found[0], faults.stretch.left(true[0], carried[:, 1:]), atol=1e-9)
    assert np.abs(found[0] - true[0]).max() > 1e-4


def test_an_exact_model_with_an_observer_beats_hold():
    # Rows of 10 ms and the speed of the row before are what is left to err.
    long = fly(Plant(), 3.0, 6, noise=0.0)[0]
    rows = np.searchsorted(long.time, 0.01 * np.arange(298))
    steady = long.rows(rows).replace(time=0.01 * np.arange(298), metadata={"observation_delay": 0.008})
    contestants = {"model": nanodrone.Contestant(GUARDS), "model_observer": nanodrone.Contestant(GUARDS, Observer())}
    found = nanodrone.benchmark([steady], contestants)["rows"]
    for name in ("model", "model_observer"):
        for key in ("attitude_sum_rad", "velocity_sum_mps", "rate_sum_radps"):
            assert found[name][key] < 0.6 * found["hold"][key], (name, key)


def test_windows_end_at_missing_rows_and_stride_skips(log):
    double = FlightLog(
        **{
            name: np.concatenate([getattr(log, name)] * 3)
            for name in ("position", "velocity", "quaternion", "body_rate", "specific_force", "command", "rotor_speed")
        },
        time=0.01 * np.arange(3 * ROWS),
        metadata={"name": "long"},
    )
    assert len(nanodrone.find_starts(double)) == 3 * ROWS - 50
    gap = double.rows(np.delete(np.arange(3 * ROWS), 60))
    rows = nanodrone.find_starts(gap).row
    # Row 60 is now what was row 61: windows lie before it or start at it.
    assert list(rows) == [*range(10), *range(60, 3 * ROWS - 1 - 50)]
    assert list(nanodrone.find_starts(gap, 7).row) == [r for r in range(0, 3 * ROWS, 7) if r in rows]


@pytest.mark.parametrize(
    ("change", "needle"),
    [
        (lambda log: log.replace(time=log.time * 0.4), "0.01 s"),
        (lambda log: log.replace(rotor_speed=None), "rotor speeds"),
        (lambda log: log.rows(np.arange(40)), "51 rows"),
    ],
)
def test_flights_that_are_not_of_the_benchmark_are_refused(log, change, needle):
    with pytest.raises(CfbError, match=needle):
        nanodrone.benchmark([change(log)], {})


def test_the_command_refuses_bad_folders_in_one_sentence(tmp_path, capsys):
    (tmp_path / "empty").mkdir()
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "x.csv").write_text("a,b\n1,2\n3,4\n")
    for folder, needle in (("absent", "not a folder"), ("empty", "no .parquet"), ("other", "missing column")):
        assert main(["benchmark-nanodrone", str(tmp_path / folder)]) == 2
        text = capsys.readouterr().err
        assert needle in text
        assert len(text.strip().splitlines()) == 1
    assert main(["benchmark-nanodrone", str(tmp_path / "other"), "--stride", "0"]) == 2
    assert "--stride" in capsys.readouterr().err


@pytest.fixture
def folder(tmp_path) -> Path:
    """A folder with one flight in the benchmark's own layout: on the ground, in the air, on the ground."""
    log = fly(Plant(mass=np.array([0.045])), 3.4, 7)[0]
    time = 0.01 * np.arange(338)
    log = log.rows(np.searchsorted(log.time, time))
    high = np.where(np.abs(time - 1.69) < 1.6, log.position[:, 2], 0.0)
    force = Rotation.from_quat(log.quaternion, scalar_first=True).apply(np.array(log.specific_force))
    columns = {"t": time, "Vbat": np.full(338, 3.7)} | dict.fromkeys(idsia.STAMPS, time)
    for i, names in enumerate(("x", "y", "z")):
        columns[names] = high if names == "z" else log.position[:, i]
        columns[f"v{names}"], columns[f"w{names}"] = log.velocity[:, i], log.body_rate[:, i]
        columns[f"a{names}"] = force[:, i]
    for motor in range(4):
        columns[f"m{motor + 1}_thrust"] = log.command[:, motor]
        columns[f"m{motor + 1}_erpm"] = log.rotor_speed[:, motor] * 360 / (2 * np.pi)
    columns |= {name: log.quaternion[:, i] for i, name in enumerate(idsia.QUATERNION)}
    (tmp_path / "flights").mkdir()
    columns = {name: np.array(values) for name, values in columns.items()}  # arrow wants them writable
    pq.write_table(pa.table(columns), tmp_path / "flights" / "made.parquet")
    return tmp_path / "flights"


def test_processed_files_count_row_by_row(folder, tmp_path, capsys, monkeypatch):
    """As the benchmark's own evaluation takes them: the ground too, copies that were held too."""
    monkeypatch.setattr("cfb_mjx.runtime.configure_jax", lambda x64: None)
    out = tmp_path / "result.json"
    assert main(["benchmark-nanodrone", str(folder), "--official"]) == 2
    assert "is a raw merge of the benchmark" in capsys.readouterr().err
    table = pq.read_table(folder / "made.parquet")
    held = {name: table[name].to_numpy().copy() for name in table.column_names}
    for name in ("x", "y", "z", *idsia.STAMPS):
        held[name][100:110] = held[name][100]
    pq.write_table(pa.table(held | {"rx": np.zeros(338)}), folder / "made.parquet")
    assert main(["benchmark-nanodrone", str(folder), "--official", "--stride", "7", "--json", str(out)]) == 0
    found = json.loads(out.read_text())
    start = np.arange(0, 338 - 50, 7)
    assert found["windows"] == len(start)
    position = np.stack([held[axis] for axis in "xyz"], axis=1)
    ahead = position[start[:, None] + np.arange(1, 51)] - position[start][:, None]
    expected = np.linalg.norm(ahead, axis=2).mean(axis=0).sum()
    assert found["rows"]["naive"]["position_sum_m"] == pytest.approx(expected, rel=1e-9)
    assert found["official"] is True


def test_the_command_writes_its_table_and_json(folder, tmp_path, capsys, monkeypatch):
    # The session's own settings of jax stay: others would compile every program anew.
    monkeypatch.setattr("cfb_mjx.runtime.configure_jax", lambda x64: None)
    out = tmp_path / "result.json"
    assert main(["benchmark-nanodrone", str(folder), "--model", "cfb-guards", "--json", str(out)]) == 0
    printed = capsys.readouterr().out
    found = json.loads(out.read_text())
    judged = {"declared", "plant", "plant_observer", "model", "model_observer"}
    assert set(found["rows"]) == {"naive", "hold", "physics"} | judged
    assert set(found["flights"]["made"]["rows"]["model"]) == set(found["rows"]["naive"])
    assert found["windows"] > 50
    assert found["published"]["physics"]["attitude_sum_rad"] == 5.101
    own = ("cfb-guards, 45 g", "cfb-idsia", "cfb-idsia with observer", "model", "model with observer")
    for label in ("naive", "hold", "physics (rate held)", *own, "LSTM"):
        assert f"\n{label} " in printed
