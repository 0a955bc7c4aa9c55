"""Tables as people's scripts leave them: the same numbers whatever they are written with."""

import contextlib

import foreign_logs as foreign
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from synthetic_logs import make_flight

from cfb_mjx.errors import CfbError
from cfb_mjx.logs import read_log, read_radio_csv
from cfb_mjx.logs.tabular import Text, read_table

COLUMNS = ("t", "px", "u1")
ROWS = [[0.0, 1.25, 0.5], [0.01, -3e-05, 0.25], [0.02, 7.0, 1.0]]


def lines(delimiter=",", comma=False):
    def text(x):
        return repr(x).replace(".", ",") if comma else repr(x)

    return [delimiter.join(COLUMNS), *(delimiter.join(text(x) for x in row) for row in ROWS)]


def numbered(rows):
    return [",".join(["", *COLUMNS]), *(f"{i},{row}" for i, row in enumerate(rows[1:]))]


HABITS = {
    "plain": "\n".join(lines()) + "\n",
    "semicolons": "\n".join(lines(";")) + "\n",
    "decimal commas": "\n".join(lines(";", True)) + "\n",
    "tabs and decimal commas": "\n".join(lines("\t", True)) + "\n",
    "tabs": "\n".join(lines("\t")) + "\n",
    "pipes": "\n".join(lines("|")) + "\n",
    "spaces after commas": "\n".join(lines(", ")) + "\n",
    "white space": "\n".join(lines("   ")) + "\n",
    "comments": "# made by me\n" + "\n".join(lines()) + "\n# done\n",
    "names in a comment": "# " + "\n".join(lines(" ")) + "\n",
    "index of pandas": "\n".join(numbered(lines())) + "\n",
    "empty lines": "\n" + "\n\n".join(lines()) + "\n\n",
    "windows": "\r\n".join(lines()) + "\r\n",
    "quoted names": "\n".join([",".join(f'"{c}"' for c in COLUMNS), *lines()[1:]]) + "\n",
}


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-16-le", "utf-16-be", "latin-1"])
@pytest.mark.parametrize("habit", HABITS)
def test_the_same_numbers(tmp_path, habit, encoding):
    path = tmp_path / "a.csv"
    path.write_bytes(HABITS[habit].encode(encoding))
    table = read_table(path)
    assert tuple(table) == COLUMNS
    assert np.array_equal(np.stack(list(table.values()), axis=1), ROWS)


@pytest.mark.parametrize("word", ["nan", "NaN", "None", "null", "NA", "-", ""])
def test_words_for_no_value(tmp_path, word):
    path = tmp_path / "a.csv"
    path.write_text(f"t,px\n0.0,{word}\n0.1,2.0\n")
    assert np.isnan(read_table(path)["px"][0])


def test_a_last_line_that_was_cut_is_left_out_with_a_word(tmp_path):
    path = tmp_path / "a.csv"
    for rest, rows in (("0.03,1", 3), ("0.03,1\n", 3), ("0.03,1.0,0.4", 3), ("0.03,1.0,0.4\n", 4)):
        path.write_text(HABITS["plain"] + rest)
        table = read_table(path)
        assert len(table["t"]) == rows
        assert bool(table.warnings) == (rows == 3)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("t,px\n0,1\n0,1,2\n0,1\n", "row 1 .* has 3 cells, the header has 2"),
        ("0.0,1.0\n0.1,2.0\n", "the first line holds numbers, so the table has no header"),
        ("# only a comment\n", "the table has no lines"),
        ("\x00\x01\x02\x03binary\x00\x00", "neither a text table"),
    ],
)
def test_what_is_no_table(tmp_path, text, said):
    path = tmp_path / "a.csv"
    path.write_bytes(text.encode("latin-1"))
    with pytest.raises(CfbError, match=said):
        read_table(path)


def test_text_columns_keep_their_cells(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("t,mode\n0.0,hover\n0.1,land\n")
    column = read_table(path)["mode"]
    assert isinstance(column, Text)
    assert column.cells == ["hover", "land"]


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.binary(max_size=300))
def test_any_bytes_raise_nothing_but_cfb_error(tmp_path, data):
    path = tmp_path / "a.csv"
    path.write_bytes(data)
    with contextlib.suppress(CfbError):
        read_table(path)


@pytest.fixture(scope="module")
def flight():
    return make_flight(duration=3.0, rate=100.0)


STATE, IMU, MOTOR = list(foreign.STATE), list(foreign.IMU), list(foreign.MOTOR)


def same(log, flight):
    return all(
        np.abs(getattr(log, f) - getattr(flight, f)).max() < 2e-5
        for f in ("position", "velocity", "quaternion", "body_rate", "specific_force", "command")
    )


def test_blocks_of_cfclient_are_one_flight(flight, tmp_path):
    paths = []
    for number, block in enumerate((STATE[:6], STATE[6:], IMU, MOTOR)):
        paths.append(tmp_path / f"block{number}.csv")
        foreign.write_radio_csv(paths[-1], flight, [block])
    assert same(read_log(paths), flight)
    with pytest.raises(CfbError, match=r"no logged variables for velocity|no logged variables for"):
        read_log(paths[:1])
    late = tmp_path / "late.csv"
    foreign.write_radio_csv(late, flight, [MOTOR], start_ms=60_000)
    with pytest.raises(CfbError, match="these are not one flight"):
        read_log([*paths[:3], late])


@pytest.mark.parametrize("joint", ["_", "/", ""])
def test_names_joined_otherwise(flight, tmp_path, joint):
    path = tmp_path / "a.csv"
    foreign.write_radio_csv(path, flight, [STATE + IMU + MOTOR])
    head, rest = path.read_text().split("\n", 1)
    path.write_text(head.replace(".", joint) + "\n" + rest)
    assert same(read_log(path), flight)


def test_one_value_per_line(flight, tmp_path):
    path = tmp_path / "a.csv"
    foreign.write_radio_csv(path, flight.slice(0, 0.5), [STATE + IMU + MOTOR])
    names, *rows = [line.split(",") for line in path.read_text().splitlines()]
    cells = [f"{row[0]},{name},{value}" for row in rows for name, value in zip(names[1:], row[1:], strict=True)]
    path.write_text("\n".join(["timestamp,name,value", *cells, ""]))
    assert same(read_log(path), flight.slice(0, 0.5))


@pytest.mark.parametrize(
    ("name", "factor"), [("time", 1.0), ("t_ms", 1e3), ("time[us]", 1e6), ("Time (s)", 1.0), ("timestamp_ns", 1e9)]
)
def test_the_clock_by_its_name(flight, tmp_path, name, factor):
    path = tmp_path / "a.csv"
    foreign.write_radio_csv(path, flight, [STATE + IMU + MOTOR])
    head, *rest = path.read_text().splitlines()
    rows = [f"{float(r.split(',', 1)[0]) / 1e3 * factor!r},{r.split(',', 1)[1]}" for r in rest]
    path.write_text("\n".join([head.replace("Timestamp", name, 1), *rows, ""]))
    log = read_radio_csv(path)
    assert np.abs(log.time - flight.time).max() < 1e-6
