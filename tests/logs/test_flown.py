"""Only measured flight is kept: no ground, no glitches, no frozen estimates, no lost rotor readings."""

from pathlib import Path

import numpy as np
import pytest
from synthetic_logs import make_flight, same_data

from cfb_mjx.errors import CfbError
from cfb_mjx.logs import read_log, write_tabular
from cfb_mjx.logs.flown import flown_part

HERE = Path("a.csv")


def with_ground(log, before=1.5, after=1.5):
    """The flight with the drone standing where it began and ended, motors off."""
    step = log.nominal_interval
    ends = [round(before / step), round(after / step)]

    def padded(values, ground):
        first, last = (
            np.tile(np.asarray(ground(v), float), (n, 1)) for v, n in zip((values[0], values[-1]), ends, strict=True)
        )
        return np.concatenate([first, values, last])

    count = len(log) + sum(ends)
    level = np.array([1.0, 0.0, 0.0, 0.0])
    return log.replace(
        time=np.arange(count) * step,
        position=padded(log.position, lambda p: [p[0], p[1], 0.02]),
        velocity=padded(log.velocity, lambda v: 0 * v),
        quaternion=padded(log.quaternion, lambda q: level),
        body_rate=padded(log.body_rate, lambda w: 0 * w),
        specific_force=padded(log.specific_force, lambda f: [0.0, 0.0, 9.81]),
        command=padded(log.command, lambda u: 0 * u),
        rotor_speed=padded(log.rotor_speed, lambda w: 0 * w),
        battery_voltage=None,
    )


@pytest.fixture(scope="module")
def log():
    return make_flight(duration=4.0, rate=100.0, excitation=0.3)


def test_a_flight_is_left_as_it_is(log):
    assert flown_part(log, HERE) is log


def test_the_ground_is_cut_with_a_word_and_kept_when_asked(log, tmp_path):
    path = tmp_path / "flight.parquet"
    write_tabular(with_ground(log), path)
    cut = read_log(path)
    assert log.duration - 1.0 < cut.duration < log.duration
    assert 1.5 < cut.time[0] < 2.5  # times stay those of the recording
    assert cut.command.min() > 0.2
    (note,) = [n for n in cut.metadata["notes"] if "--keep-ground" in n]
    assert "on the ground" in note
    assert f"begins at {cut.time[0]:.2f} s" in note
    whole = read_log(path, keep_ground=True)
    assert len(whole) >= len(with_ground(log)) - 3  # rows beside the leap onto the flight


def test_a_low_pass_of_the_motors_is_flight(log):
    falling = (log.time > 1.5) & (log.time < 1.9)
    low = log.replace(command=np.where(falling[:, None], 0.05, log.command))
    assert flown_part(low, HERE) is low


def test_a_landing_in_between_becomes_a_gap(log):
    twice = with_ground(log)
    both = twice.replace(
        **{
            f: np.concatenate([getattr(twice, f)] * 2)
            for f in ("position", "velocity", "quaternion", "body_rate", "specific_force", "command", "rotor_speed")
        },
        time=np.arange(2 * len(twice)) * twice.nominal_interval,
    )
    cut = flown_part(both, HERE)
    assert len(cut.gaps()) == 1
    assert 3.0 < np.diff(cut.time).max() < 4.5


def test_nothing_but_ground_is_refused(log):
    off = log.replace(command=0 * log.command)
    with pytest.raises(CfbError, match=r"a\.csv: the motors are off throughout.*--keep-ground"):
        flown_part(off, HERE)
    assert same_data(flown_part(off, HERE, keep_ground=True), off.replace(rotor_speed=off.rotor_speed))
    standing = log.replace(
        command=np.where(log.time[:, None] < 2.0, 0.0, 0.5 + 0 * log.command), position=0 * log.position
    )
    with pytest.raises(CfbError, match="there is no flight in it: the motors are low"):
        flown_part(standing, HERE)


def test_lost_rotor_readings_become_nan(log):
    speed = log.rotor_speed.copy()
    speed[50:60, 1] = 0.0
    found = flown_part(log.replace(rotor_speed=speed), HERE)
    assert np.isnan(found.rotor_speed[50:60, 1]).all()
    assert np.isnan(found.rotor_speed).sum() == 10
    assert "motor 2 2.5%" in found.metadata["warnings"][0]


def test_a_rotor_at_rest_without_command_stays_at_zero(log):
    ground = with_ground(log)
    found = flown_part(ground, HERE, keep_ground=True)
    assert (found.rotor_speed[:100] == 0).all()


def test_a_leap_of_the_motion_capture_is_left_out(log):
    position = log.position.copy()
    position[200:212] += [3.0, 0.0, 0.0]
    found = flown_part(log.replace(position=position), HERE)
    assert len(found) == len(log) - 14
    assert np.abs(np.diff(found.position[:, 0])).max() < 0.3
    assert len(found.gaps()) == 1
    assert "jumps" in found.metadata["warnings"][0]


def test_a_frozen_estimate_is_left_out(log):
    held = {f: getattr(log, f).copy() for f in ("position", "velocity", "quaternion")}
    for values in held.values():
        values[100:140] = values[99]
    found = flown_part(log.replace(**held), HERE)
    assert len(found) == len(log) - 40
    assert "stay exactly the same: 40 rows" in found.metadata["warnings"][0]


def test_a_pose_held_between_its_packets_is_not_frozen(log):
    rows = np.arange(len(log)) // 10 * 10
    slow = log.replace(**{f: getattr(log, f)[rows] for f in ("position", "velocity", "quaternion")})
    assert flown_part(slow, HERE) is slow


def test_logs_of_ones_own_are_not_cut(log, tmp_path):
    from cfb_mjx.logs import write_mcap

    ground = with_ground(log)
    write_mcap(ground, tmp_path / "a.mcap")
    assert len(read_log(tmp_path / "a.mcap")) == len(ground)


@pytest.mark.parametrize(
    ("spans", "kept"),
    [
        (["1:1.5"], lambda t: (t < 1.0) | (t > 1.5)),
        ([":0.5", "3.2:"], lambda t: (t > 0.5) & (t < 3.2)),
        (["1:2", "1.5:2.5"], lambda t: (t < 1.0) | (t > 2.5)),
    ],
)
def test_stretches_are_cut_as_asked(log, tmp_path, spans, kept):
    path = tmp_path / "flight.parquet"
    write_tabular(log, path)
    cut = read_log(path, cut=spans)
    np.testing.assert_array_equal(cut.time, log.time[kept(log.time)])
    assert any(note.startswith(f"--cut {' '.join(spans)}") for note in cut.metadata["notes"])


def test_a_cut_takes_out_what_would_be_refused(log, tmp_path):
    path = tmp_path / "flight.csv"
    spoiled = (log.time > 1.0) & (log.time < 1.2)
    write_tabular(log.replace(body_rate=np.where(spoiled[:, None], np.nan, log.body_rate)), path)
    with pytest.raises(CfbError, match="no value"):
        read_log(path)
    assert len(read_log(path, cut=["1:1.2"]).gaps()) == 1


@pytest.mark.parametrize(
    ("span", "said"),
    [
        ("5", "A:B"),
        (":", "A:B"),
        ("a:b", "A:B"),
        ("3:2", "A:B"),
        ("nan:2", "A:B"),
        ("", "A:B"),
        ("90:95", "times are 0 to"),
        ("0:100", "cut less"),
    ],
)
def test_a_cut_that_cuts_nothing_or_all_is_refused(log, tmp_path, span, said):
    path = tmp_path / "flight.parquet"
    write_tabular(log, path)
    with pytest.raises(CfbError, match=said):
        read_log(path, cut=[span])
