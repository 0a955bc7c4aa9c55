import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet as pq
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from synthetic_logs import same_data

from cfb_mjx.errors import CfbError
from cfb_mjx.logs import read_log, read_tabular, validate, write_tabular
from cfb_mjx.logs.tabular import COLUMNS


@pytest.fixture(params=[".parquet", ".csv"])
def path(request, tmp_path):
    return tmp_path / f"log_07{request.param}"


def table_of(log, tmp_path):
    write_tabular(log, tmp_path / "source.parquet")
    return pq.read_table(tmp_path / "source.parquet")


def save(table, path):
    (pq.write_table if path.suffix == ".parquet" else pyarrow.csv.write_csv)(table, path)


def test_round_trip(flight, path):
    write_tabular(flight, path)
    log = read_log(path)
    assert same_data(log, flight)
    assert dict(log.metadata) == {
        "name": "log_07",
        "source": path.name,
        "format": "tabular",
        "observation_delay": None,
    }


def test_optional_columns_may_be_missing_or_empty(short, path, tmp_path):
    bare = short.replace(rotor_speed=None, battery_voltage=None)
    write_tabular(bare, path)
    assert same_data(read_log(path), bare)
    write_tabular(short.replace(rotor_speed=np.full_like(short.rotor_speed, np.nan)), path)
    assert read_log(path).rotor_speed is None


def test_invalid_rotor_speeds_stay_invalid(short, path):
    speed = short.rotor_speed.copy()
    speed[3:5, 2] = np.nan
    write_tabular(short.replace(rotor_speed=speed), path)
    assert np.array_equal(read_log(path).rotor_speed, speed, equal_nan=True)


def test_extra_columns_spaces_order_and_integers(short, path, tmp_path):
    table = table_of(short, tmp_path)
    table = table.select(table.column_names[::-1])
    table = table.rename_columns([f" {n} " if n == "t" else n for n in table.column_names])
    table = table.append_column("note", pa.array(["x"] * len(short)))
    save(table, path)
    assert same_data(read_log(path), short)


def test_missing_columns_are_all_listed(short, path, tmp_path):
    save(table_of(short, tmp_path).drop_columns(["qw", "u3", "omega2"]), path)
    with pytest.raises(CfbError, match=r"missing columns qw, u3, omega2; the tabular layout is t, px py pz"):
        read_log(path)


def test_text_cell_is_named(short, path, tmp_path):
    table = table_of(short, tmp_path)
    cells = [str(v) for v in table["wy"].to_pylist()]
    cells[4] = "oops"
    index = table.column_names.index("wy")
    save(table.set_column(index, "wy", pa.array(cells)), path)
    with pytest.raises(CfbError, match="column wy holds 'oops' in row 4"):
        read_log(path)


def test_column_of_dates_is_named(short, path, tmp_path):
    table = table_of(short, tmp_path)
    dates = pa.array(np.arange(len(short)).astype("datetime64[s]"))
    save(table.set_column(0, "t", dates), path)
    with pytest.raises(CfbError, match="column t holds '1970"):
        read_log(path)


def test_duplicate_column(short, path, tmp_path):
    table = table_of(short, tmp_path)
    save(table.append_column("t", table["t"]), path)
    with pytest.raises(CfbError, match="'t' appears twice"):
        read_log(path)


def test_missing_cell_is_named(short, path, tmp_path):
    table = table_of(short, tmp_path)
    cells = table["vx"].to_pylist()
    cells[6] = None
    save(table.set_column(table.column_names.index("vx"), "vx", pa.array(cells)), path)
    with pytest.raises(CfbError, match=r"column vx has no value \(NaN\) in row 6"):
        read_log(path)


def test_unreadable_files(short, path, tmp_path):
    with pytest.raises(CfbError, match="there is no such file"):
        read_log(tmp_path / "nothing.parquet")
    with pytest.raises(CfbError, match="this is a folder, but not the folder of a ROS 2 bag"):
        read_log(tmp_path)
    path.write_bytes(b"")
    with pytest.raises(CfbError, match="the file is empty"):
        read_log(path)
    write_tabular(short, path)
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    if path.suffix == ".csv":
        log = read_log(path)
        assert len(log) < len(short)
        assert same_data(log, short.rows(slice(0, len(log))))
        assert "left out" in log.metadata["warnings"][0]
    else:
        with pytest.raises(CfbError, match=path.name):
            read_log(path)
    path.write_bytes(whole[:4])
    with pytest.raises(CfbError, match=path.name):
        read_log(path)


def test_header_only(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text(",".join(c for names in COLUMNS.values() for c in names) + "\n")
    with pytest.raises(CfbError, match="0 rows"):
        read_log(path)


def test_something_else_entirely(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("a,b\n1,2\n")
    with pytest.raises(CfbError, match="none is known by its name to hold time, position, attitude, motors"):
        read_log(path)


def test_only_known_endings_are_written(short, tmp_path):
    with pytest.raises(CfbError, match=r"\.parquet or \.csv"):
        write_tabular(short, tmp_path / "log.txt")
    assert not list(tmp_path.iterdir())


def test_unknown_format_and_options(short, path):
    write_tabular(short, path)
    with pytest.raises(CfbError, match="unknown log format 'rosbag'"):
        read_log(path, format="rosbag")
    with pytest.raises(CfbError, match="no option --motor-shift"):
        read_log(path, motor_shift=0.0)
    assert same_data(read_log(path, format="tabular"), short)


_small = settings(max_examples=60, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))


@_small
@given(values=st.lists(st.floats(-1e3, 1e3), min_size=8, max_size=8))
def test_any_values_survive(short, tmp_path_factory, values):
    log = short.rows(slice(0, 8)).replace(velocity=np.column_stack([values] * 3))
    for ending in (".parquet", ".csv"):
        path = tmp_path_factory.getbasetemp() / f"values{ending}"
        write_tabular(log, path)
        assert np.array_equal(read_tabular(path).velocity, log.velocity)


@_small
@given(data=st.data(), ending=st.sampled_from([".parquet", ".csv"]))
def test_damaged_bytes_never_surprise(short, tmp_path_factory, data, ending):
    path = tmp_path_factory.getbasetemp() / f"damaged{ending}"
    write_tabular(short, path)
    content = bytearray(path.read_bytes())
    for _ in range(data.draw(st.integers(1, 5))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    cut = data.draw(st.one_of(st.just(len(content)), st.integers(0, len(content))))
    path.write_bytes(bytes(content[:cut]))
    try:
        log = read_log(path)
    except CfbError as error:
        message = str(error)
        assert path.name in message
        assert "\n" not in message
    else:
        assert same_data(validate(log, path), log)
