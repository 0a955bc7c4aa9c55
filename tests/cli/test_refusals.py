"""Bad input: one sentence that names the file, exit status 2, no traceback, earlier results as they were."""

import ast
import os
import re
import signal
import subprocess
import sys
import time
import warnings
from inspect import signature
from pathlib import Path
from typing import get_type_hints

import numpy as np
import pyarrow.csv
import pytest

import cfb_mjx
from cfb_mjx.cli import unusual_said_once
from cfb_mjx.interrupts import held_back
from cfb_mjx.parameters import load_model_file

CFB = str(Path(sys.executable).with_name("cfb"))


def refused(done, *needles):
    text = done.stdout + done.stderr
    assert done.returncode == 2, text
    assert "Traceback" not in text
    lines = [line for line in done.stderr.splitlines() if line.strip()]
    assert len(lines) == 1, text
    for needle in needles:
        assert needle in lines[0], lines[0]


@pytest.fixture
def table(files):
    return pyarrow.csv.read_csv(files / "flight.csv").to_pydict()


def write(path, columns):
    names = list(columns)
    rows = zip(*(columns[n] for n in names), strict=True)
    path.write_text(",".join(names) + "\n" + "\n".join(",".join(map(repr, r)) for r in rows) + "\n")
    return path


def drop(*names):
    return lambda c: {k: v for k, v in c.items() if k not in names}


def change(**functions):
    return lambda c: {k: functions[k](np.array(v)).tolist() if k in functions else v for k, v in c.items()}


def set_at(index, value):
    def put(column):
        column[index] = value
        return column

    return put


def scalar_last(columns):
    w, x, y, z = (columns[k] for k in ("qw", "qx", "qy", "qz"))
    return columns | {"qw": x, "qx": y, "qy": z, "qz": w}


BAD_TABLES = {
    "missing columns": (drop("vx", "u3"), "vx", "u3"),
    "NaN": (change(py=set_at(7, float("nan"))), "py"),
    "time runs backwards": (change(t=set_at(100, 0.1)), "time"),
    "gyro in deg/s": (change(wx=np.degrees, wy=np.degrees, wz=np.degrees), "deg"),
    "command as PWM": (change(**{f"u{i}": lambda u: np.round(u * 65535) for i in range(1, 5)}), "65535"),
    "acceleration in g": (change(**{f"a{k}": lambda a: a / 9.81 for k in "xyz"}), "g"),
    "quaternion norm": (change(**{f"q{k}": lambda q: 1.3 * q for k in "wxyz"}), "quaternion"),
    "quaternion order": (scalar_last, "quaternion"),
}


@pytest.mark.parametrize("name", BAD_TABLES)
def test_bad_tables(cfb, table, tmp_path, name):
    spoil, *needles = BAD_TABLES[name]
    path = write(tmp_path / "spoilt.csv", spoil(table))
    (tmp_path / "keep.json").write_text("{}")
    refused(cfb("evaluate", path, "--json", tmp_path / "keep.json"), "spoilt.csv", *needles)
    assert (tmp_path / "keep.json").read_text() == "{}"


@pytest.mark.parametrize("kind", ["mcap", "parquet", "csv"])
@pytest.mark.parametrize("keep", [0, 0.6])
def test_empty_and_truncated_files(cfb, files, tmp_path, kind, keep):
    whole = (files / f"flight.{kind}").read_bytes()
    path = tmp_path / f"cut.{kind}"
    path.write_bytes(whole[: int(keep * len(whole))])
    if kind == "csv" and keep:
        path.write_bytes(path.read_bytes().rsplit(b",", 3)[0])  # the cut falls inside a row
        done = cfb("import", path, "-o", tmp_path / "out.mcap")
        assert done.returncode == 0, done.stderr
        assert "the last line was cut short and was left out" in done.stdout
        return
    refused(cfb("import", path, "-o", tmp_path / "out.mcap"), f"cut.{kind}")
    assert not (tmp_path / "out.mcap").exists()


@pytest.mark.parametrize(
    ("arguments", "needles"),
    [
        (["evaluate", "absent.mcap"], ["absent.mcap"]),
        (["evaluate"], ["log"]),
        (["fly-away"], ["fly-away", "evaluate"]),
        (["demo-loop", "--effects", "gremlins"], ["gremlins", "payload"]),
        (["demo-loop", "--seeds", "0"], ["--seeds 0"]),
        (["evaluate", "FLIGHT", "--model", "cfb-unknown"], ["cfb-unknown", "cfb-guards"]),
        (["evaluate", "FLIGHT", "--set", "mass=heavy"], ["mass=heavy"]),
        (["evaluate", "FLIGHT", "--set", "mass=-1"], ["mass"]),
        (["evaluate", "FLIGHT", "--set", "mass=38.5"], ["parameters.mass = 38.5", "38.5 g is 0.0385"]),
        (["evaluate", "FLIGHT", "--set", "weight=1"], ["weight"]),
        (["fly", "pid", "--task", "hover", "--plants", "2", "--magnitude", "6"], ["--magnitude = 6", "at most"]),
        (["evaluate", "FLIGHT", "FLIGHT"], ["flight", "name"]),
        (["evaluate", "FLIGHT", "--json", "nowhere/x.json"], ["nowhere"]),
        (["import", "FLIGHT", "-o", "out.csv"], ["out.csv"]),
        (["import", "FLIGHT", "-o", "FLIGHT"], ["source"]),
        (["bench", "--drones", "0"], ["drones"]),
        (["bench", "--drones", "1", "--quick", "--peer-python", "absent-python"], ["absent-python"]),
    ],
)
def test_bad_arguments(cfb, files, tmp_path, arguments, needles):
    arguments = [str(files / "flight.mcap") if a == "FLIGHT" else a for a in arguments]
    refused(cfb(*arguments, cwd=tmp_path), *needles)
    assert (files / "flight.mcap").stat().st_size > 1000


@pytest.mark.parametrize(
    ("text", "needle"),
    [
        ("format: cfb_mjx model 1\nparameters: {colour: {value: 1, unit: kg, source: x}}", "colour"),
        ("format: cfb_mjx model 1\nparameters: {mass: {value: 0.04, source: x}}", "mass"),
        ("not: [closed", "YAML"),
        ("", "mapping"),
    ],
)
def test_bad_model_files(cfb, files, tmp_path, text, needle):
    (tmp_path / "m.yaml").write_text(text)
    refused(cfb("evaluate", files / "flight.mcap", "--model", tmp_path / "m.yaml"), "m.yaml", needle)


def test_what_is_unusual_is_said_once_and_in_one_sentence(capsys):
    with unusual_said_once():
        for _ in range(2):
            with warnings.catch_warnings():  # as libraries do: Python then forgets what it has shown
                load_model_file("cfb-guards").with_values("scales", mass=0.3)
    said = capsys.readouterr().err.splitlines()
    assert said == [
        "cfb: model cfb-guards: parameters.mass = 0.3 is unusual; usually it lies between 0.015 and 0.2 kg."
    ]


def run_after(preparation, *arguments, **options):
    """Start cfb after some Python in the same process; a preexec_fn would fork this one, with jax's threads in it."""
    code = f"import os, resource, signal, sys\n{preparation}\nos.execv(sys.argv[1], sys.argv[1:])"
    command = [sys.executable, "-c", code, CFB, *map(str, arguments)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **options)


def test_a_full_disk_costs_nothing(files, tmp_path):
    """A limit on file size makes the write fail half way, as a full disk would."""
    target = tmp_path / "out.mcap"
    target.write_text("earlier")
    limit = "signal.signal(signal.SIGXFSZ, signal.SIG_IGN); resource.setrlimit(resource.RLIMIT_FSIZE, (8192, 8192))"
    process = run_after(limit, "import", files / "flight.csv", "-o", target)
    out, err = process.communicate(timeout=120)
    refused(subprocess.CompletedProcess([], process.returncode, out, err), "out.mcap")
    assert target.read_text() == "earlier"
    assert [p.name for p in tmp_path.iterdir()] == ["out.mcap"]


@pytest.mark.skipif(os.geteuid() == 0, reason="the superuser may write anywhere")
def test_a_folder_without_permission(cfb, files, tmp_path):
    tmp_path.chmod(0o500)
    refused(cfb("import", files / "flight.csv", "-o", tmp_path / "out.mcap"), "out.mcap")


@pytest.fixture
def ctrl_c():
    """Heard, also where the tests themselves were started with it ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def test_ctrl_c_waits_until_jaxlib_is_loaded(ctrl_c):
    after = []

    def load():
        with held_back():
            signal.raise_signal(signal.SIGINT)
            after.append("loaded")

    with pytest.raises(KeyboardInterrupt):
        load()
    assert after == ["loaded"]
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_ctrl_c_leaves_earlier_results(files, tmp_path):
    (tmp_path / "keep.json").write_text("{}")
    arguments = ["evaluate", files / "flight.mcap", "--json", tmp_path / "keep.json"]
    process = run_after("signal.signal(signal.SIGINT, signal.default_int_handler)", *arguments)
    time.sleep(1.0)
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=120)
    assert process.returncode == 130, out + err
    assert "interrupted" in err
    assert "Traceback" not in err
    assert (tmp_path / "keep.json").read_text() == "{}"


def test_ctrl_c_in_a_callback_of_the_garbage_collector_is_not_lost():
    """Python discards what such a callback raises; jax has one, and Ctrl-C may land in it."""
    code = """
import gc, os, signal, sys
from cfb_mjx import cli
signal.signal(signal.SIGINT, signal.default_int_handler)
struck = []
def strike(phase, details):
    if not struck:
        struck.append(phase)
        os.kill(os.getpid(), signal.SIGINT)
        for _ in range(1000): pass
def command(arguments):
    gc.callbacks.append(strike)
    gc.collect()
    assert struck
    signal.sigtimedwait([], 60)
    return 0
cli._dispatch = command
sys.exit(cli.main([]))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=100)
    assert done.returncode == 130, done.stderr
    assert "interrupted" in done.stderr
    assert "Traceback" not in done.stderr


def _messages(source: Path):
    """Texts of a module that a user may read: all but its docstrings, with what f-strings put in left blank."""
    tree = ast.parse(source.read_text())
    documented = (ast.Module, ast.ClassDef, ast.FunctionDef)
    docstrings = {
        id(node.body[0].value)
        for node in ast.walk(tree)
        if isinstance(node, documented) and node.body and isinstance(node.body[0], ast.Expr)
    }
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in docstrings:
            yield node.value


def test_flags_in_messages_are_flags_of_the_commands():
    from cfb_mjx.commands import COMMANDS, load

    commands = [load(command) for command in COMMANDS]
    options = {f"--{name.replace('_', '-')}" for command in commands for name in signature(command).parameters}
    hints = (hint for command in commands for hint in get_type_hints(command, include_extras=True).values())
    marks = (mark for hint in hints for mark in getattr(hint, "__metadata__", ()))
    options |= {alias for mark in marks for alias in getattr(mark, "aliases", None) or ()}
    options |= {
        "--help",
        "--version",
        "--install-completion",
        "--no",
        "--head",
    }  # every command's, cfb's, a switch's, ray's
    package = Path(cfb_mjx.__file__).parent
    named = {
        (flag, str(source.relative_to(package)))
        for source in package.rglob("*.py")
        for text in _messages(source)
        for flag in re.findall(r"(?<![\w-])--[a-z][a-z-]*[a-z]\b(?!_)", text)
    }
    assert ("--keep-ground", "logs/flown.py") in named
    assert sorted(pair for pair in named if pair[0] not in options) == []
