"""The table of how cost grows: slopes, and runs that were ended at the limit."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from cfb_mjx.logs import FlightLog
from cfb_mjx.logs.validation import examine


@pytest.fixture(scope="module")
def growth():
    path = Path(__file__).resolve().parents[2] / "benchmarks" / "growth.py"
    spec = importlib.util.spec_from_file_location("growth", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def run(seconds, late=False):
    return {"wall_s": seconds, "cpu_s": 2 * seconds, "peak_mb": 100.0, "late": late}


def rows(costs, command="evaluate"):
    sizes = (5, 15, 60, 300, 1800)
    return [
        {"command": command, "series": "length", "size": n, "flight_s": n, "first": run(cost + 1), "again": run(cost)}
        for n, cost in zip(sizes, costs, strict=False)
    ]


def conditions(machine, limit=300):
    return {"environment": {"processor": machine}, "flights": "flights of a test", "limit_s": limit, "cores": 2}


def test_slopes_are_those_of_a_power(growth):
    found = growth.slopes(rows([3 * n**1.5 for n in (5, 15, 60, 300, 1800)]), "wall_s")
    assert found == pytest.approx((1.5, 1.5))
    assert growth.slopes(rows([2.0, 2.0, 2.0, 4.0]), "cpu_s")[1] == pytest.approx(np.log(2) / np.log(5))
    assert growth.slopes(rows([1.0]), "wall_s") is None


def test_a_run_that_was_ended_is_said_and_does_not_count(growth):
    measured = rows([1.0, 2.0, 3.0, 300.0])
    measured[3]["again"] = run(300.0, late=True)
    left_out = {"command": "evaluate", "series": "length", "size": 1800, "flight_s": 1800, "skipped": True}
    results = {
        "rows": [*measured, left_out],
        "each_s": 6,
        "conditions": {"evaluate": conditions("one")},
    }
    page = growth.section(results)
    assert "over 300" in page
    assert "left out" in page
    assert growth.slopes(measured, "wall_s") == growth.slopes(measured[:3], "wall_s")
    widths = {line.count("|") for line in page.splitlines() if line.startswith("| `cfb evaluate` | 1 |")}
    assert widths == {9}


def test_kept_rows_keep_the_machine_that_they_were_measured_on(growth, monkeypatch, tmp_path):
    def told(command, **_):
        return SimpleNamespace(stdout="flights of a test" if "--make" in command else '{"processor": "new"}')

    monkeypatch.setattr(growth.subprocess, "run", told)
    monkeypatch.setattr(growth, "_series", lambda name, series, *_: rows([1.0], name) if series == "length" else [])
    old = {"conditions": {"fit": conditions("old", 60), "refine": conditions("old", 60)}, "rows": rows([90.0], "fit")}
    arguments = SimpleNamespace(commands=["evaluate", "refine"], quick=True, flights=[], limit=300)
    results = growth.measure(tmp_path, arguments, old)
    machines = {name: made["environment"]["processor"] for name, made in results["conditions"].items()}
    assert machines == {"evaluate": "new", "fit": "old", "refine": "new"}
    text = growth.section(results)
    assert "; `cfb evaluate`, `cfb refine`: processor new, runs ended after 300 s; `cfb fit`: processor old, " in text


def test_a_process_is_measured_and_ended_at_its_limit(growth):
    done = growth.timed([sys.executable, "-c", "x = bytearray(50_000_000)"], 60.0, {})
    assert not done["late"]
    assert done["peak_mb"] > 50
    assert growth.timed([sys.executable, "-c", "import time; time.sleep(60)"], 0.2, {})["late"]


def test_a_joined_log_is_a_log(growth):
    """Also where flights repeat: rows that repeat earlier ones to the last bit would be refused."""
    rng, time = np.random.default_rng(0), np.arange(1000) * 0.002
    noise = {"position": 1e-3, "velocity": 0.01, "body_rate": 0.02, "specific_force": 0.2}
    columns = {name: size * rng.standard_normal((1000, 3)) for name, size in noise.items()}
    columns["specific_force"] = columns["specific_force"] + [0, 0, 9.81]
    command = 0.5 + 0.01 * rng.standard_normal((1000, 4))
    flight = FlightLog(time, quaternion=np.tile([1.0, 0, 0, 0], (1000, 1)), command=command, **columns)
    log = growth.joined([flight], 6.5, "long")
    assert log.duration == pytest.approx(6.5, abs=0.01)
    assert len(log.gaps()) == 2
    assert len(examine(log, Path("long.mcap"))[0]) == len(log)
