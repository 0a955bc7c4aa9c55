"""Bench tables: what is read, and one clear sentence for what is not."""

import numpy as np
import pytest

from cfb_mjx.errors import CfbError
from cfb_mjx.logs.bench_tables import MapTable, MotorRecord, read_bench, recognises

TIME = np.arange(100) * 0.01
SPEED = np.linspace(400.0, 2700.0, 100)
STEPS = {"t": TIME, "u": np.linspace(0.2, 0.9, 100), "omega": SPEED}
MAP = {"motor": np.tile([1, 2, 3, 4], 25), "omega": SPEED, "force": 3.7e-8 * SPEED**2, "torque": 1e-10 * SPEED**2}


def write(folder, columns, name="bench.csv"):
    rows = zip(*columns.values(), strict=True)
    lines = [",".join("" if x != x else repr(float(x)) for x in row) for row in rows]
    (folder / name).write_text("\n".join([",".join(columns), *lines]) + "\n")
    return folder / name


def test_steps_of_one_motor_and_of_several(tmp_path):
    one = read_bench(write(tmp_path, STEPS))
    assert isinstance(one, MotorRecord)
    assert (one.name, one.motors, one.command.shape) == ("bench", (0,), (100, 1))
    gappy = SPEED.copy()
    gappy[5] = np.nan
    several = {"t": TIME, "u": STEPS["u"], "omega2": SPEED, "omega4": gappy}
    found = read_bench(write(tmp_path, several))
    assert found.motors == (2, 4)
    np.testing.assert_array_equal(found.command[:, 0], found.command[:, 1])
    assert np.isnan(found.rotor_speed[5, 1])


def test_maps_from_csv_and_parquet(tmp_path):
    import pyarrow as pa
    import pyarrow.parquet as pq

    pq.write_table(pa.table({k: v for k, v in MAP.items() if k != "motor"}), tmp_path / "map.parquet")
    for path in (write(tmp_path, MAP), tmp_path / "map.parquet"):
        found = read_bench(path)
        assert isinstance(found, MapTable)
        np.testing.assert_allclose(found.force, MAP["force"])
    assert set(found.motor) == {0}


def test_flights_are_not_taken_for_bench_tables():
    flight = dict.fromkeys(["t", "px", "qw", "u1", "omega1"], TIME)
    assert not recognises(flight)
    assert recognises(STEPS)
    assert recognises(MAP)


def spoilt(base, **changes):
    return {k: v for k, v in (base | changes).items() if v is not None}


def with_nan(column):
    column = np.array(column, dtype=float)
    column[7] = np.nan
    return column


BAD = {
    "rpm": (spoilt(STEPS, omega=SPEED * 9.55), "rpm", "2 pi / 60"),
    "a wild reading": (spoilt(STEPS, omega=np.where(TIME == 0.5, 65535.0, SPEED)), "single readings"),
    "negative speed": (spoilt(STEPS, omega=-SPEED), "negative"),
    "percent": (spoilt(STEPS, u=100 * STEPS["u"]), "percent", "100"),
    "PWM": (spoilt(STEPS, u=np.round(65535 * STEPS["u"])), "65535"),
    "NaN in the command": (spoilt(STEPS, u=with_nan(STEPS["u"])), "column u", "row 7"),
    "time runs backwards": (spoilt(STEPS, t=np.where(TIME == 0.5, 0.1, TIME)), "row 50", "sort"),
    "milliseconds": (spoilt(STEPS, t=1000 * TIME), "convert it to s"),
    "no command": (spoilt(STEPS, u=None), "missing column u"),
    "no speed": (spoilt(STEPS, omega=None, rpm=SPEED), "omega"),
    "one of two commands": (spoilt(STEPS, omega=None, u=None, u1=STEPS["u"], omega1=SPEED, omega2=SPEED), "u2"),
    "neither kind": ({"omega": SPEED, "thrust": SPEED}, "neither", "thrust"),
    "grams": (spoilt(MAP, force=MAP["force"] * 102), "grams"),
    "millinewtons": (spoilt(MAP, force=MAP["force"] * 1000), "millinewtons"),
    "force downwards": (spoilt(MAP, force=-MAP["force"]), "positive"),
    "torque in mN m": (spoilt(MAP, torque=MAP["torque"] * 1000), "millinewton metres"),
    "NaN in the force": (spoilt(MAP, force=with_nan(MAP["force"])), "column force", "row 7"),
    "map in rpm": (spoilt(MAP, omega=SPEED * 9.55), "rpm"),
    "map without speed": (spoilt(MAP, omega=None), "missing column omega"),
    "no such motor": (spoilt(MAP, motor=np.zeros(100)), "1, 2, 3 or 4"),
    "no rows": ({k: v[:0] for k, v in MAP.items()}, "bench.csv"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_tables_are_refused_in_one_sentence(tmp_path, name):
    columns, *needles = BAD[name]
    with pytest.raises(CfbError) as refusal:
        read_bench(write(tmp_path, columns))
    text = str(refusal.value)
    assert "\n" not in text
    for needle in ("bench.csv", *needles):
        assert needle in text


def test_empty_and_missing_files(tmp_path):
    (tmp_path / "empty.csv").write_text("")
    with pytest.raises(CfbError, match=r"empty\.csv.*empty"):
        read_bench(tmp_path / "empty.csv")
    with pytest.raises(CfbError, match=r"none\.csv.*no such file"):
        read_bench(tmp_path / "none.csv")
