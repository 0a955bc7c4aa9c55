"""Every trap of the benchmark's files, set one by one in a synthetic file of that layout."""

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from synthetic_logs import make_flight, same_data

from cfb_mjx.errors import CfbError
from cfb_mjx.logs import idsia, read_idsia, read_log, rotation, write_mcap
from cfb_mjx.logs.alignment import delay_by_samples

GROUND = 200  # rows before and after the flight


@pytest.fixture(scope="session")
def truth():
    return make_flight(duration=14.0, rate=100.0, noise=0.02)


@pytest.fixture
def columns(truth):
    """The file as a dictionary: two seconds on the ground, the flight, two seconds on the ground."""
    log = delay_by_samples(truth, 0)

    def padded(values, ground):
        return np.concatenate([np.full(GROUND, ground), values, np.full(GROUND, ground)])

    n = len(log) + 2 * GROUND
    out = {"t": 0.01 * np.arange(n)}
    stamp = 62.5 + out["t"] + 0.002 * np.sin(out["t"])
    force = rotation.to_world(log.quaternion, log.specific_force)
    for i, axis in enumerate("xyz"):
        out[axis] = padded(log.position[:, i] * [1, 1, 0][i] + [0, 0, 0.8][i], 0.0)
        out[f"v{axis}"] = padded(log.velocity[:, i], 0.0)
        out[f"w{axis}"] = padded(log.body_rate[:, i], 0.0)
        out[f"a{axis}"] = padded(force[:, i], [0.0, 0.0, 9.81][i])
    for i, name in enumerate(("qw", "qx", "qy", "qz")):
        out[name] = padded(log.quaternion[:, i], [1.0, 0, 0, 0][i])
    for m in range(4):
        out[f"m{m + 1}_thrust"] = padded(log.command[:, m], 0.0)
        out[f"m{m + 1}_erpm"] = padded(log.rotor_speed[:, m] * 360 / (2 * np.pi), 0.0)
    out |= dict.fromkeys(idsia.STAMPS, stamp)
    out["Vbat"] = padded(log.battery_voltage, 4.1)
    return {k: v.copy() for k, v in out.items()}


def read(columns, tmp_path, **options):
    path = tmp_path / "square_01.parquet"
    pq.write_table(pa.table(columns), path)
    return read_log(path, **options)


def motors_early(columns, samples):
    """Shift the motor packets ahead of the state, as the benchmark's merge did."""
    for name in (*idsia.COMMAND, *idsia.ERPM):
        columns[name] = np.roll(columns[name], -samples)


def expected_rows(truth):
    # z is above 0.35 m from the first to the last row of the flight.
    return slice(100, len(truth) - 1 - 50 + 1)


def test_conversion(columns, truth, tmp_path):
    log = read(columns, tmp_path)
    rows = expected_rows(truth)
    assert len(log) == rows.stop - rows.start
    assert log.time[0] == 0.0
    assert np.allclose(log.quaternion, truth.quaternion[rows])
    assert np.allclose(log.specific_force, truth.specific_force[rows])
    assert np.allclose(log.body_rate, truth.body_rate[rows])
    assert np.array_equal(log.command, truth.command[rows])
    assert np.allclose(log.rotor_speed, truth.rotor_speed[rows])
    assert np.allclose(log.battery_voltage, truth.battery_voltage[rows])
    assert (log.name, log.metadata["source"], log.metadata["format"]) == ("square_01", "square_01.parquet", "idsia")
    assert log.metadata["vehicle_mass"] == 0.045
    assert log.observation_delay == 0.008
    assert log.metadata["cleaning"]["time_of_first_row"] == pytest.approx(3.0)
    assert len(log.gaps()) == 0


def test_import_to_mcap_is_identical(columns, tmp_path):
    log = read(columns, tmp_path)
    write_mcap(log, tmp_path / "square_01.mcap")
    back = read_log(tmp_path / "square_01.mcap")
    assert same_data(back, log)
    assert back.metadata["alignment"] == log.metadata["alignment"]
    assert (back.name, back.observation_delay) == (log.name, log.observation_delay)


@pytest.mark.parametrize("samples", [-2, -1, 0, 1, 2])
def test_packet_shift_is_undone(columns, truth, tmp_path, samples):
    # The measuring chain of the real drone delays the gyro by CHAIN_LAG; here there is none, so add it.
    shifted = make_flight(duration=14.0, rate=100.0, noise=0.02, motor_lead=idsia.CHAIN_LAG)
    for m in range(4):
        columns[f"m{m + 1}_thrust"][GROUND:-GROUND] = shifted.command[:, m]
        columns[f"m{m + 1}_erpm"][GROUND:-GROUND] = shifted.rotor_speed[:, m] * 360 / (2 * np.pi)
    reference = read(columns, tmp_path, motor_shift=0.0)
    motors_early(columns, samples)
    log = read(columns, tmp_path)
    report = log.metadata["alignment"]
    assert report["applied_samples"] == samples
    assert report["applied_ms"] == 10.0 * samples
    assert report["applied"] is (samples != 0)
    assert report["shift_ms"] == pytest.approx(10 * samples + 3.5, abs=1.0)
    assert report["shift_std_ms"] < 1.0
    assert np.array_equal(log.command, reference.command)
    assert np.array_equal(log.rotor_speed, reference.rotor_speed)


def test_the_user_may_choose_the_shift(columns, truth, tmp_path):
    log = read(columns, tmp_path, motor_shift=0.03)
    rows = expected_rows(truth)
    assert np.array_equal(log.command, truth.command[rows.start - 3 : rows.stop - 3])
    assert log.metadata["alignment"]["chosen_by"] == "user"


def test_hover_is_left_unshifted(columns, tmp_path):
    hover = make_flight(duration=14.0, rate=100.0, noise=0.02, excitation=0.0, motor_lead=0.02)
    for m in range(4):
        columns[f"m{m + 1}_erpm"][GROUND:-GROUND] = hover.rotor_speed[:, m] * 360 / (2 * np.pi)
    log = read(columns, tmp_path)
    assert not log.metadata["alignment"]["reliable"]
    assert not log.metadata["alignment"]["applied"]


@pytest.mark.parametrize("stamp", idsia.STAMPS)
@pytest.mark.parametrize(("held", "gaps"), [(1, 0), (2, 0), (3, 1), (6, 1)])
def test_held_copies_become_gaps(columns, truth, tmp_path, stamp, held, gaps):
    start = GROUND + 500
    columns[stamp] = columns[stamp].copy()
    columns[stamp][start + 1 : start + 1 + held] = columns[stamp][start]
    log = read(columns, tmp_path)
    assert len(log.gaps()) == gaps
    dropped = held if gaps else 0
    assert len(log) == len(truth) - 150 - dropped
    counts = log.metadata["cleaning"]
    assert sum(v for k, v in counts.items() if k.endswith("_held")) == dropped
    assert counts["held_rows_kept"] == held - dropped
    if gaps:
        # The row that is held is genuine and stays; its copies go.
        assert log.time[log.gaps()[0]] == pytest.approx(0.01 * (500 - 100))
        assert np.diff(log.time)[log.gaps()[0]] == pytest.approx(0.01 * (held + 1))


def test_held_motor_packets_move_with_the_shift(columns, tmp_path):
    start = GROUND + 500
    motor = idsia.STAMPS[1]
    columns[motor] = columns[motor].copy()
    columns[motor][start + 1 : start + 4] = columns[motor][start]
    log = read(columns, tmp_path, motor_shift=0.02)
    assert log.time[log.gaps()[0]] == pytest.approx(0.01 * (500 - 100 + 2))


def test_glitches_end_windows(columns, tmp_path):
    columns["wx"][GROUND + 400] = 13.0
    columns["vx"][GROUND + 800 :] += 1.0  # a jump of 1 m/s within 10 ms
    log = read(columns, tmp_path)
    assert len(log.gaps()) == 2
    assert log.metadata["cleaning"]["dropped_glitch"] == 3 + 4
    assert np.abs(log.body_rate).max() < 12.0


def test_a_held_velocity_is_no_glitch(columns, tmp_path):
    """After a held copy the velocity catches up in one row; the acceleration is that of two."""
    row = GROUND + 600
    columns["vz"][row:] += 0.25
    columns["vz"][row + 1 :] += 0.25
    columns[idsia.STAMPS[0]] = columns[idsia.STAMPS[0]].copy()
    assert read(columns, tmp_path).metadata["cleaning"]["dropped_glitch"] == 0
    columns["vz"][row] -= 0.25
    columns[idsia.STAMPS[0]][row] = columns[idsia.STAMPS[0]][row - 1]
    assert read(columns, tmp_path).metadata["cleaning"]["dropped_glitch"] == 0


def test_invalid_rotor_speeds(columns, tmp_path):
    row = GROUND + 300
    columns["m1_erpm"][row] = 65535
    columns["m2_erpm"][row + 1] = 1.9e6
    columns["m3_erpm"][row + 2] = np.nan
    log = read(columns, tmp_path)
    assert np.argwhere(np.isnan(log.rotor_speed)).tolist() == [[200, 0], [201, 1], [202, 2]]
    assert log.metadata["cleaning"]["invalid_rotor_speeds"] == 3


def test_missing_columns(columns, tmp_path):
    del columns["ay"], columns["m3_erpm"]
    with pytest.raises(CfbError, match=r"square_01\.parquet: missing columns ay, m3_erpm"):
        read(columns, tmp_path)


def test_bad_cells(columns, tmp_path):
    columns["vx"][5] = np.nan
    with pytest.raises(CfbError, match="column vx has no finite value in row 5"):
        read(columns, tmp_path)


def test_never_airborne(columns, tmp_path):
    columns["z"] *= 0.1
    with pytest.raises(CfbError, match="column z shows no flight"):
        read(columns, tmp_path)


def test_time_must_increase(columns, tmp_path):
    columns["t"][7] = 0.0
    with pytest.raises(CfbError, match="column t must increase"):
        read(columns, tmp_path)


def test_quaternions_must_be_unit(columns, tmp_path):
    columns["qw"][:] = 0.5
    with pytest.raises(CfbError, match="not unit quaternions"):
        read(columns, tmp_path)


def test_format_can_be_named(columns, tmp_path):
    path = tmp_path / "a.parquet"
    pq.write_table(pa.table(columns), path)
    assert same_data(read_log(path, format="idsia"), read_idsia(path))
    with pytest.raises(CfbError, match="none is known by its name to hold motors"):
        read_log(path, format="tabular")


def test_the_benchmarks_own_csv_files(columns, tmp_path):
    """Other names for the packets' stamps, two indices of pandas, booleans and empty motion capture beside the rest."""
    parquet = read(columns, tmp_path)
    n = len(columns["t"])
    names = {"ros_timestamp_x": "ros_timestamp", "ros_timestamp_y": "ros_timestamp_motors"}
    names["ros_timestamp"] = "ros_timestamp_image_accel"
    table = {"": np.arange(n), "Unnamed: 0": np.arange(n) + 4906}
    table |= {names.get(name, name): values for name, values in columns.items()}
    table |= {"is_flying": np.full(n, True), "qx_poses": [""] * n, "m1_rads2": columns["m1_erpm"] ** 2}
    path = tmp_path / "square_20251017_run1.csv"
    rows = zip(*table.values(), strict=True)
    path.write_text("\n".join([",".join(table), *(",".join(map(str, row)) for row in rows), ""]))
    log = read_log(path)
    assert log.metadata["format"] == "idsia"
    assert same_data(log, parquet)
