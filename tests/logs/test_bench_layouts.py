"""Bench tables under the names of the programs that write them: four rotors on a scale, dead sensors, voltage."""

from pathlib import Path

import numpy as np
import pytest

from cfb_mjx.errors import CfbError
from cfb_mjx.logs.bench_layouts import in_si, read_bench_table, recognises
from cfb_mjx.logs.bench_tables import MapTable, MotorRecord, SteadyPoints, joined
from cfb_mjx.logs.tabular import Table, read_table
from cfb_mjx.sysid.rotors.tables import fit_steady

KF, RPM = 3.72e-8, 30 / np.pi
RNG = np.random.default_rng(3)
U = RNG.uniform(0.15, 0.95, 80)
VOLT = np.linspace(3.9, 3.3, 80)
SPEED = 350 + 613 * U * VOLT
GRAMS = 4 * KF * SPEED**2 / 9.81e-3


def read(folder, columns, rotors=None):
    path = folder / "bench.csv"
    rows = zip(*(np.broadcast_to(c, U.shape) for c in columns.values()), strict=True)
    path.write_text("\n".join([",".join(columns), *(",".join(repr(float(x)) for x in row) for row in rows)]) + "\n")
    return read_bench_table(read_table(path), path, rotors)


def vehicle(**changes):
    columns = {"pwm": 65535 * U, "vbat[V]": VOLT, **{f"rpm{i}": SPEED * RPM for i in (1, 2, 3, 4)}, "thrust[g]": GRAMS}
    return {k: v for k, v in (columns | changes).items() if v is not None}


@pytest.mark.parametrize(
    "columns",
    [
        vehicle(),
        {"weight[g]": GRAMS, **vehicle(**{"thrust[g]": None}), "v[V]": VOLT, "i[A]": 1.0, "p[W]": VOLT},
        {"Throttle (%)": 100 * U, "Voltage (V)": VOLT, "Motor Optical Speed (RPM)": SPEED * RPM,
         "Thrust (N)": GRAMS * 9.81e-3 / 4},
        {"ESC signal (µs)": 1000 + 1000 * U, "Thrust (kgf)": GRAMS / 4e3, "Motor Optical Speed (RPM)": SPEED * RPM,
         "Voltage (V)": VOLT},
        {"Powertrain 1 - throttle (%)": 100 * U, "Powertrain 1 - thrust (N)": GRAMS * 9.81e-3 / 4,
         "Powertrain 1 - rotational speed (rpm)": SPEED * RPM, "Powertrain 1 - voltage (V)": VOLT},
    ],
    ids=["systemid", "weight", "one rotor", "RCbenchmark", "Tyto"],
)  # fmt: skip
def test_thrust_of_one_rotor_and_steady_points(tmp_path, columns):
    assert recognises(dict.fromkeys(columns, U))
    parts, _ = read(tmp_path, columns)
    (points,) = [p for p in parts if isinstance(p, SteadyPoints)]
    (table,) = [p for p in parts if isinstance(p, MapTable)]
    assert np.allclose(table.force, KF * table.rotor_speed**2, rtol=1e-3)
    fit = fit_steady([points])
    assert fit.per_volt == pytest.approx(613, rel=1e-3)
    assert fit.offset == pytest.approx(350, abs=1)
    assert fit.gain == pytest.approx(613 * 3.7, rel=1e-3)
    assert fit.spread < 1 < 40 < fit.spread_without_voltage


def test_a_dead_sensor_is_left_out_with_a_word(tmp_path):
    lost = SPEED * RPM
    lost[::10] = 0.0
    parts, notes = read(tmp_path, vehicle(rpm1=0.0 * U, rpm2=lost))
    table = next(p for p in parts if isinstance(p, MapTable))
    assert np.allclose(table.force, KF * table.rotor_speed**2, rtol=1e-3)
    assert any("rpm1 reads 0 in 100%" in n for n in notes)
    assert any("8 readings of 0 under command in rpm2" in n for n in notes)
    with pytest.raises(CfbError, match="no rotor speed sensor reads anything"):
        read(tmp_path, vehicle(**{f"rpm{i}": 0.0 * U for i in (1, 2, 3, 4)}))


def test_how_many_rotors(tmp_path):
    alone = {"omega": SPEED, "force": 4 * KF * SPEED**2}
    (table,), _ = read(tmp_path, alone, rotors=4)
    assert np.allclose(table.force, KF * SPEED**2)
    parts, notes = read(tmp_path, vehicle())
    assert any("is the sum of 4 rotors" in n for n in notes)
    parts, _ = read(tmp_path, vehicle(), rotors=1)
    assert np.allclose(parts[-1].force, 4 * KF * parts[-1].rotor_speed ** 2, rtol=1e-3)


def test_a_scale_that_was_not_read(tmp_path):
    parts, notes = read(tmp_path, vehicle(**{"thrust[g]": 0.0 * U}))
    assert [type(p) for p in parts] == [SteadyPoints]
    assert any("the scale was not read" in n for n in notes)


def test_commands_under_the_name_of_rpm(tmp_path):
    with pytest.raises(
        CfbError, match=r"column rpm reaches 6807 rad/s .* these look like 16-bit commands; name the column pwm"
    ):
        read(tmp_path, {"rpm": np.linspace(5000, 65000, 80), "weight[g]": GRAMS})
    with pytest.raises(CfbError, match="has no rotor speed"):
        read(tmp_path, {"pwm": 65535 * U, "torque": GRAMS})


def test_thrust_and_speed_in_two_tables_are_joined_at_equal_commands(tmp_path):
    """One has the scale, the other the speeds, some counted double; a command only one of them has is left out."""
    levels = np.linspace(0.2, 0.9, 8)
    speed = 350 + 2300 * levels
    (thrust,), _ = read(
        tmp_path,
        {
            "pwm": 65535 * np.tile([*levels, 0.97], 9)[:80],
            "weight": 4e3 / 9.81 * KF * np.tile([*speed, 2600], 9)[:80] ** 2,
        },
    )
    each = np.repeat(levels, 10)
    readings = np.repeat(speed, 10)[:, None] * RNG.choice([1.0, 1.0, 2.0], (80, 4)) + RNG.normal(0, 3, (80, 4))
    columns = {"pwm": 65535 * each, "vbat[V]": VOLT} | {f"rpm{i}": readings[:, i - 1] * RPM for i in (1, 2, 3, 4)}
    (points,), _ = read(tmp_path, columns)
    notes = []
    table = joined(thrust, [points], None, notes)
    assert np.allclose(table.force, KF * table.rotor_speed**2, rtol=0.01)
    assert len(table.force) == 72  # the last level of every nine has no speed
    assert "thrust of 4 rotors" in notes[0]
    with pytest.raises(CfbError, match="give a table that has it at the same commands"):
        joined(thrust, [], None, [])


def test_a_unit_nobody_knows(tmp_path):
    with pytest.raises(CfbError, match=r"column thrust\[stone\] is in stone"):
        read(tmp_path, {"omega": SPEED, "thrust[stone]": GRAMS})


@pytest.mark.parametrize("late", [False, True])
def test_command_steps_act_where_the_speed_answers(tmp_path, late):
    """Scripts that write the row after waiting have the command of the interval before in it."""
    time = np.arange(400) * 0.01
    u = np.where(time % 1.0 < 0.5, 0.2, 0.7)
    speed, w = [], 350 + 613 * 3.8 * 0.2
    for now in u:
        before = w
        w += (350 + 613 * 3.8 * now - w) * (1 - np.exp(-0.01 / 0.05))
        speed.append(w if late else before)
    path = tmp_path / "steps.csv"
    body = [
        f"{float(1e3 * t)!r},{float(65535 * c)!r},{float(s * RPM)!r}" for t, c, s in zip(time, u, speed, strict=True)
    ]
    path.write_text("\n".join(["time[ms],pwm,rpm", *body, ""]))
    (record,), notes = read_bench_table(read_table(path), path)
    assert isinstance(record, MotorRecord)
    assert bool(notes) == late
    step = int(np.flatnonzero(np.diff(record.command[:, 0]) > 0.1)[0]) + 1
    gone = np.abs(np.diff(record.rotor_speed[:, 0]))
    assert gone[step] > 10 * gone[step - 1]


def test_too_few_steady_points():
    few = SteadyPoints("a", U[:4], SPEED[:4], None)
    with pytest.raises(CfbError, match="a: 4 steady points at 4 different commands"):
        fit_steady([few])
    one = SteadyPoints("a", np.full(20, 0.5), SPEED[:20], None)
    with pytest.raises(CfbError, match="at 1 different commands"):
        fit_steady([one])


def test_readings_that_are_counted_double_at_a_command_that_is_held(tmp_path):
    """With half of the sensors wrong the median of a row is of no rotor."""
    u = np.repeat([0.3, 0.6], 40)
    speed = 350 + 613 * 3.7 * u
    wrong = np.where(np.arange(80)[:, None] % 2 == 0, [2.0, 2.0, 1.0, 1.0], 1.0) * speed[:, None]
    columns = {"pwm": 65535 * u, "vbat[V]": 3.7} | {f"rpm{i}": wrong[:, i - 1] * RPM for i in (1, 2, 3, 4)}
    (points,), notes = read(tmp_path, columns)
    assert np.allclose(points.rotor_speed, speed)
    assert any("80 of 320 readings of speed differ strongly from most others" in n for n in notes)


def test_sensors_that_count_blades_twice(tmp_path):
    """A fifth of the settings read double: left out as outliers."""
    wrong = np.where(np.arange(80) % 5 == 0, 2.0, 1.0) * SPEED + RNG.normal(0, 5, 80)
    fit = fit_steady([SteadyPoints("a", U, wrong, VOLT)])
    assert fit.per_volt == pytest.approx(613, abs=6)
    assert fit.outliers == pytest.approx(0.2, abs=0.02)
    assert abs(fit.offset - 350) < 4 * fit.offset_std


RC = {
    "ESC signal (µs)": 1000 + 1000 * U, "Torque (N·m)": -1e-3 * U, "Thrust (gf)": GRAMS / 4, "Voltage (V)": VOLT,
    "Motor Electrical Speed (RPM)": SPEED * RPM, "Motor Optical Speed (RPM)": SPEED * RPM,
    "Motor Efficiency (%)": 50 * U,
}  # fmt: skip


def points_and_map(parts):
    (points,) = [p for p in parts if isinstance(p, SteadyPoints)]
    (table,) = [p for p in parts if isinstance(p, MapTable)]
    return points, table


@pytest.mark.parametrize("dead", ["Motor Electrical Speed (RPM)", "Motor Optical Speed (RPM)"])
def test_of_two_speed_sensors_the_one_that_reads(tmp_path, dead):
    parts, _ = read(tmp_path, RC | {dead: 0 * U})
    points, table = points_and_map(parts)
    assert np.allclose(points.rotor_speed, SPEED)
    assert np.allclose(table.force, KF * table.rotor_speed**2, rtol=1e-3)


def test_speed_sensors_that_disagree_are_named(tmp_path):
    parts, notes = read(tmp_path, RC | {"Motor Electrical Speed (RPM)": 6 / 7 * SPEED * RPM})
    assert np.allclose(points_and_map(parts)[0].rotor_speed, SPEED)
    assert any("Motor Electrical Speed (RPM) reads 0.857 times Motor Optical Speed (RPM)" in n for n in notes)


def test_columns_named_after_a_powertrain_of_ones_own(tmp_path):
    """Tyto's letters, explanations in brackets before the unit, a stand's name."""
    names = {
        "ESC throttle (μs)": 1000 + 1000 * U, "force Fz (thrust) (N)": GRAMS * 9.81e-3 / 4,
        "torque MZ (torque) (N⋅m)": 1e-3 * U, "voltage (V)": VOLT, "rotation speed (rad/s)": SPEED,
    }  # fmt: skip
    one = {f"Left arm - {name}": values for name, values in names.items()}
    parts, _ = read(tmp_path, one)
    points, table = points_and_map(parts)
    assert np.allclose(points.command, U)
    assert np.allclose(table.force, KF * table.rotor_speed**2, rtol=1e-3)
    assert table.torque is not None
    with pytest.raises(CfbError, match=r"2 powertrains side by side \(left arm, right arm\)"):
        read(tmp_path, one | {f"Right arm - {name}": values for name, values in names.items()})


def test_a_stand_that_counts_a_pull_as_negative(tmp_path):
    parts, notes = read(tmp_path, RC | {"Thrust (gf)": -GRAMS / 4})
    table = points_and_map(parts)[1]
    assert np.allclose(table.force, KF * table.rotor_speed**2, rtol=1e-3)
    assert any("falls with speed; its sign was changed" in n for n in notes)


def test_a_rotor_of_another_size_is_refused_for_its_size(tmp_path):
    with pytest.raises(CfbError, match=r"Thrust \(N\) comes to 18 N per rotor, more than any rotor of a Crazyflie"):
        read(tmp_path, {k: v for k, v in RC.items() if "gf" not in k} | {"Thrust (N)": 18 * U / U.max()})


def test_rows_far_apart_are_points_by_themselves(tmp_path):
    parts, notes = read(tmp_path, {"Time (s)": 2.2 * np.arange(80)} | RC)
    points, table = points_and_map(parts)
    assert len(points.command) == len(table.rotor_speed) == 80
    assert any("2.2 s apart" in n for n in notes)


def test_a_clock_that_stands_at_first(tmp_path):
    time = np.maximum(0.02 * (np.arange(80) - 2), 0.0)
    time[5] = 0.01
    parts, notes = read(tmp_path, {"Time (s)": time} | RC)
    (record,) = [p for p in parts if isinstance(p, MotorRecord)]
    assert len(record.time) in (76, 77)  # one more row where its command belongs to the row before
    assert any("3 rows whose time does not increase" in n for n in notes)
    assert any("in no row are both speed and Thrust (gf) steady" in n for n in notes)
    with pytest.raises(CfbError, match="t does not increase"):
        read(tmp_path, {"Time (s)": 0.02 * (np.arange(80) % 20)} | RC)


def test_sensors_that_are_read_in_turns(tmp_path):
    slow = np.linspace(0.2, 0.9, 80)
    speed = 350 + 613 * 3.7 * slow
    force = KF * speed**2
    turn = np.arange(80) % 3
    parts, notes = read(
        tmp_path,
        {
            "u": slow,
            "rpm": np.where(turn == 0, speed * RPM, np.nan),
            "Thrust (N)": np.where(turn == 1, force, np.nan),
        },
    )
    table = points_and_map(parts)[1]
    assert len(table.force) > 70
    assert np.allclose(table.force, KF * table.rotor_speed**2, rtol=0.02)
    assert any("read in turns" in n for n in notes)


def test_a_controller_that_keeps_the_speed_does_not_follow_the_voltage():
    kept = 350 + 2000 * U + RNG.normal(0, 5, 80)
    fit = fit_steady([SteadyPoints("a", U, kept, VOLT)])
    assert fit.per_volt is None
    assert fit.gain == pytest.approx(2000, rel=0.01)


@pytest.mark.parametrize(
    ("column", "reading", "key", "value"),
    [
        ("pwm", 65535.0, "u", 1.0),
        ("pwm", 0.9, "u", 0.9),
        ("throttle (%)", 40.0, "u", 0.4),
        ("ESC signal (µs)", 1250.0, "u", 0.25),
        ("rpm", 60.0, "omega", 2 * np.pi),
        ("omega [Hz]", 1.0, "omega", 2 * np.pi),
        ("thrust [g]", 1000.0, "force", 9.81),
        ("thrust [mN]", 250.0, "force", 0.25),
        ("torque [Nmm]", 3.0, "torque", 0.003),
        ("torque [gf·cm]", 1000.0, "torque", 0.0980665),
        ("vbat [mV]", 3700.0, "vbat", 3.7),
    ],
)
def test_readings_in_si_by_hand(column, reading, key, value):
    values = in_si(Table({column: np.array([reading, reading])}), Path("bench.csv"), []).values[key]
    np.testing.assert_allclose(values, value, rtol=1e-12)
