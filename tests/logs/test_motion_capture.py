"""Pose by motion capture that was logged beside an estimate."""

from pathlib import Path

import foreign_logs as foreign
import numpy as np
import pytest
import yaml
from synthetic_logs import make_flight

from cfb_mjx.cli import main
from cfb_mjx.errors import CfbError
from cfb_mjx.files import shipped
from cfb_mjx.logs import read_log, rotation, write_mcap
from cfb_mjx.logs.consistency import comparisons

REAL = Path(__file__).parents[3] / "shared" / "real2"
POSE = {f"locSrv.{v}": "f" for v in ("x", "y", "z", "qw", "qx", "qy", "qz")}
LEAN, FAST, LATE = 1.06, 1.08, 0.003


@pytest.fixture(scope="module")
def flown():
    return make_flight(duration=6.0, rate=500.0, excitation=1.5)


def estimated(log, lean=LEAN, fast=FAST):
    """What an estimator makes of a flight: it leans and moves further than it should."""
    return log.replace(
        quaternion=rotation.exponential(lean * rotation.rotation_vector(log.quaternion)),
        velocity=log.velocity * [fast, fast, 1.0],
    )


AXES = np.array([0.01, -0.02, 0.04])
"""How the markers sit on the drone, rad."""


def captured(log, rng=None, flipped=(0.0, 0.0), lost=(0.0, 0.0)):
    """100 Hz, in millimetres; between two moments the markers are taken for others, between others there are none."""
    rows = slice(0, None, 5)
    time = log.time[rows]
    wrong = (time >= flipped[0]) & (time < flipped[1])
    turn = rotation.exponential(np.where(wrong[:, None], [0.0, 0.0, 0.4], 0.0))
    quaternion = rotation.multiply(rotation.multiply(log.quaternion[rows], turn), rotation.exponential(AXES))
    position = np.round(log.position[rows], 3)
    if rng is not None:
        quaternion = rotation.multiply(quaternion, rotation.exponential(0.002 * rng.standard_normal((len(time), 3))))
    values = np.concatenate([position, quaternion], axis=1)
    event = foreign.event(log, {}, name="estPose", identifier=1, every=5, delay=LATE)
    there = (time < lost[0]) | (time >= lost[1])
    event.time, event.columns, event.variables = event.time[there], list(values[there].T), POSE
    return event


def saved(path, log, pose=None):
    state = foreign.event(estimated(log), foreign.STATE | foreign.IMU | foreign.MOTOR)
    path.write_bytes(foreign.usd_card_bytes([state] + ([] if pose is None else [pose])))
    return path


def off(log, flown):
    """How far a log is from what was flown `LATE` before: rms in m, m/s and rad."""

    def at(values):
        return np.stack([np.interp(log.time - LATE, flown.time, column) for column in values.T], axis=1)

    truly = rotation.tidy(at(flown.quaternion) / np.linalg.norm(at(flown.quaternion), axis=1, keepdims=True))
    turn = rotation.rotation_vector(rotation.multiply(rotation.conjugate(truly), log.quaternion))
    errors = log.position - at(flown.position), log.velocity - at(flown.velocity), turn
    return [float(np.sqrt(np.mean(np.sum(e[50:-50] ** 2, axis=1)))) for e in errors]


def test_the_estimate_is_taken_and_what_it_is_worth_is_said(flown, tmp_path):
    log = read_log(saved(tmp_path / "log", flown, captured(flown)), keep_ground=True)
    assert log.metadata["variables"]["quaternion"]["variables"][0] == "stateEstimate.qw"
    (note,) = [n for n in log.metadata["notes"] if "motion capture" in n]
    assert "leans 1.06 times as far and moves 1.08 times as fast" in note
    assert "--motion-capture" in note


def test_an_estimate_that_agrees_gets_no_word(flown, tmp_path):
    state = foreign.event(flown, foreign.STATE | foreign.IMU | foreign.MOTOR)
    (tmp_path / "log").write_bytes(foreign.usd_card_bytes([state, captured(flown)]))
    assert not any("motion capture" in n for n in read_log(tmp_path / "log", keep_ground=True).metadata["notes"])


def test_where_the_drone_was_comes_back(flown, tmp_path):
    path = saved(tmp_path / "log", flown, captured(flown, np.random.default_rng(3)))
    options = {"keep_ground": True}
    log = read_log(path, motion_capture=True, **options)
    assert log.observation_delay == pytest.approx(LATE, abs=1e-3)
    position, velocity, attitude = off(log, flown)
    assert position < 1e-3
    assert velocity < 0.04
    assert attitude < 4e-3
    _, estimate_velocity, estimate_attitude = off(read_log(path, **options), flown)
    assert estimate_velocity > 3 * velocity
    assert estimate_attitude > 3 * attitude


def test_where_nothing_turns_the_markers_are_taken_as_they_sit(tmp_path):
    """Without turns their axes are not told; one that says so would be noise."""
    still = make_flight(duration=4.0, rate=500.0, excitation=0.02)
    log = read_log(saved(tmp_path / "log", still, captured(still)), motion_capture=True, keep_ground=True)
    assert "its axes turned by 0.0, 0.0, 0.0 deg" in log.metadata["notes"][-1]


def test_markers_taken_for_others_are_left_out_and_what_is_lost_is_a_gap(flown, tmp_path):
    pose = captured(flown, flipped=(2.0, 2.6), lost=(4.0, 4.5))
    log = read_log(saved(tmp_path / "log", flown, pose), motion_capture=True, keep_ground=True)
    assert len(log.gaps()) == 2
    for start, stop in ((2.05, 2.55), (4.05, 4.45)):
        assert not np.any((log.time > start) & (log.time < stop))
    assert off(log, flown)[2] < 4e-3
    (note,) = [n for n in log.metadata["notes"] if "motion capture" in n]
    assert "60 that turn differently from the gyro left out" in note


def test_what_has_none_is_refused(flown, tmp_path, capsys):
    path = saved(tmp_path / "log", flown)
    with pytest.raises(CfbError, match=r"log: no motion capture with position and attitude was logged \(locSrv.x"):
        read_log(path, motion_capture=True)
    write_mcap(flown, tmp_path / "own.mcap")
    with pytest.raises(CfbError, match="--motion-capture"):
        read_log(tmp_path / "own.mcap", motion_capture=True)
    assert main(["import", str(path), "-o", str(tmp_path / "a.mcap"), "--motion-capture"]) == 2
    assert "no motion capture" in capsys.readouterr().err
    assert not (tmp_path / "a.mcap").exists()


@pytest.mark.parametrize(
    ("quaternion", "said"),
    [
        ([0.0, 0.0, 0.0, 0.0], "has 0 samples with an attitude"),
        ([1.0, 0.0, 0.0, 0.0], "does not turn as the gyro does"),
    ],
)
def test_positions_alone_are_no_attitude(flown, tmp_path, quaternion, said):
    """What firmware logs where motion capture sends no attitude."""
    pose = captured(flown)
    pose.columns = [*pose.columns[:3], *(np.full(len(pose.time), x) for x in quaternion)]
    path = saved(tmp_path / "log", flown, pose)
    assert not any("motion capture" in n for n in read_log(path, keep_ground=True).metadata["notes"])
    with pytest.raises(CfbError, match=said):
        read_log(path, motion_capture=True, keep_ground=True)


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ("locSrv", "each with position and quaternion"),
        ([{"position": {"variables": ["a", "b", "c"], "unit": "m"}}], "each with position and quaternion"),
        ([{"position": 3, "quaternion": {"variables": list("wxyz")}}], r"motion_capture.position must be a mapping"),
        ([{"position": {"derived": "x"}, "quaternion": {"variables": list("wxyz")}}], "must be a mapping with 'var"),
    ],
)
def test_a_mapping_that_says_it_wrong_is_refused(flown, tmp_path, wrong, said):
    mapping = yaml.safe_load(shipped("configs", "logs", "crazyflie.yaml").read_text())
    (tmp_path / "mine.yaml").write_text(yaml.safe_dump(mapping | {"motion_capture": wrong}))
    with pytest.raises(CfbError, match=said):
        read_log(saved(tmp_path / "log", flown), mapping=tmp_path / "mine.yaml")


@pytest.mark.parametrize("flight", ["campaign_a/validation/figure8_60_run4", "campaign_b/validation/y_150_run3"])
def test_real_motion_capture_turns_as_the_gyro_and_the_estimate_further(flight):
    if not (path := REAL / flight).exists():
        pytest.skip("../shared/real2 is not beside this checkout")

    def turned(log):
        """How much further than the gyro, about the axis with most of it."""
        compared = comparisons(log)["attitude"]
        axis = int(np.argmax(np.std(compared.integrated[:, :2], axis=0)))
        x, y = compared.integrated[:, axis], compared.measured[:, axis]
        return float(x @ y / (x @ x))

    estimate, captured = read_log(path), read_log(path, motion_capture=True)
    assert turned(captured) == pytest.approx(1.0, abs=0.02)
    assert turned(estimate) > turned(captured) + 0.005
