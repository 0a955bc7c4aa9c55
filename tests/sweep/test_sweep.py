"""Sweeps on Ray, on this machine: workers and drivers are killed and nothing is lost."""

import csv
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
import yaml

from cfb_mjx.cli import main
from cfb_mjx.sweep.folder import read_record

# One after another: each takes the whole machine.
pytestmark = pytest.mark.xdist_group("ray")

CODE = """
import signal, sys
from cfb_mjx.cli import main
signal.signal(signal.SIGINT, signal.default_int_handler)
sys.exit(main(sys.argv[1:]))
"""
PATIENCE_S = 120


@pytest.fixture
def start(tmp_path, monkeypatch):
    """Start ``cfb sweep`` on a file with these keys; what is left of it at the end is killed."""
    monkeypatch.chdir(tmp_path)
    started = []

    def run(**keys) -> subprocess.Popen:
        document = {"format": "cfb_mjx sweep 1", "command": "fly", "arguments": {"controller": "pid"}} | keys
        Path("s.yaml").write_text(yaml.safe_dump(document))
        words = [sys.executable, "-c", CODE, "sweep", "s.yaml", "-o", "out", "--workers", "2"]
        process = subprocess.Popen(
            words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
        )
        started.append(process)
        return process

    yield run
    for process in started:
        process.kill()
        process.communicate()


def wait_for(what: Callable[[], object], process: subprocess.Popen):
    """The first truth of ``what`` while the process lives."""
    end = time.monotonic() + PATIENCE_S
    while time.monotonic() < end:
        if found := what():
            return found
        assert process.poll() is None, process.communicate()
        time.sleep(0.02)
    raise TimeoutError


def landed() -> set[str]:
    return {path.name for path in Path("out/done").glob("*")}


def stopped_at_work() -> tuple[str, int] | None:
    """A task and its worker, which has been stopped in the middle of it."""
    for place in Path("out/running").glob("*"):
        process = read_record(place).get("process")
        if process is None or not (place / "output.txt").exists():
            continue
        try:
            os.kill(process, signal.SIGSTOP)
        except ProcessLookupError:
            continue
        if read_record(place).get("process") == process and place.is_dir():
            return place.name, process
        os.kill(process, signal.SIGCONT)  # it had just landed
    return None


def file_of(name: str) -> tuple[int, int]:
    """What would change if the task landed again."""
    found = Path("out/done", name, "task.json").stat()
    return found.st_ino, found.st_mtime_ns


def alive(process: int) -> bool:
    """Whether a process is there and not a zombie."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


def test_a_worker_killed_in_a_sweep_of_forty_tasks_loses_nothing(start, monkeypatch, capsys):
    driver = start(over={"seed": list(range(40))})
    wait_for(lambda: len(landed()) >= 3, driver)
    victim, worker = wait_for(stopped_at_work, driver)
    assert main(["sweep", "s.yaml", "-o", "out"]) == 2  # beside the first
    assert (
        f"another cfb sweep is at work there; wait for it or stop it ({os.uname().nodename}" in capsys.readouterr().err
    )
    os.kill(worker, signal.SIGKILL)
    out, err = driver.communicate(timeout=PATIENCE_S)
    assert driver.returncode == 0, err
    assert "results: out/results.csv" in out
    assert err.count(" done; ") == 40
    names = {f"seed={seed}" for seed in range(40)}
    assert landed() == names
    for place in ("running", "failed"):
        assert list(Path("out", place).iterdir()) == []
    records = {name: read_record(Path("out/done", name)) for name in names}
    assert {name for name, record in records.items() if record["attempts"] == 2} == {victim}
    assert {record["attempts"] for name, record in records.items() if name != victim} == {1}
    assert all(records[f"seed={seed}"]["line"] == f"cfb fly pid --seed {seed} --json result.json" for seed in range(40))
    with open("out/results.csv") as file:
        rows = list(csv.DictReader(file))
    assert [row["name"] for row in rows] == [f"seed={seed}" for seed in range(40)]
    assert {row["state"] for row in rows} == {"done"}
    # Every seed its own flight, and the victim's is the one that its command line flies.
    assert len({row["mean_distance_mm"] for row in rows}) == 40
    assert main(["fly", "pid", "--seed", victim.removeprefix("seed="), "--json", "alone.json"]) == 0
    distance = json.loads(Path("alone.json").read_text())["mean_distance_mm"]
    (row,) = (row for row in rows if row["name"] == victim)
    assert float(row["mean_distance_mm"]) == pytest.approx(distance, rel=1e-3)
    before = {name: file_of(name) for name in names}
    monkeypatch.setitem(sys.modules, "ray", None)
    assert main(["sweep", "s.yaml", "-o", "out"]) == 0
    assert "all 40 tasks are done already" in capsys.readouterr().err
    assert before == {name: file_of(name) for name in names}


def test_a_sweep_goes_on_after_its_driver_died_and_past_a_bad_task(start):
    cases = [{"seed": seed} for seed in range(10)] + [{"model": "no-such-model"}]
    driver = start(each=cases)
    wait_for(lambda: len(landed()) >= 2, driver)
    driver.send_signal(signal.SIGKILL)
    driver.communicate()
    early = landed()
    assert len(early) < 10
    before = {name: file_of(name) for name in early}
    # At once: workers of the first may still be ending.
    out, err = start(each=cases).communicate(timeout=PATIENCE_S)
    assert landed() == {f"seed={seed}" for seed in range(10)}
    assert before == {name: file_of(name) for name in early}
    assert "already" in err
    *_, last = err.splitlines()
    assert last.startswith("cfb: 1 of 11 tasks failed; model=no-such-model: no-such-model: no such model")
    assert last.endswith("all reasons are in out/failed; run the same command again to retry.")
    assert "Traceback" not in err
    assert Path("out/failed/model=no-such-model.txt").read_text().startswith("no-such-model: no such model")
    assert "results: out/results.csv" in out
    with open("out/results.csv") as file:
        assert [row["state"] for row in csv.DictReader(file)] == ["done"] * 10 + ["failed"]


# A terminal sends Ctrl-C to all processes, a batch system SIGTERM to the first.
@pytest.mark.parametrize(("kill", "how"), [(os.killpg, signal.SIGINT), (os.kill, signal.SIGTERM)])
def test_a_sweep_that_is_stopped_says_so_and_leaves_no_worker(start, kill, how):
    driver = start(over={"seed": list(range(40))})
    worker = wait_for(lambda: [read_record(p).get("process") for p in Path("out/running").glob("*")], driver)[0]
    kill(driver.pid, how)
    _, err = driver.communicate(timeout=PATIENCE_S)
    assert driver.returncode == 130, err
    *_, told, last = err.splitlines()
    assert told.startswith("... stopped with ")
    assert told.endswith(" of 40 tasks done; run the same command again to continue")
    assert last == "cfb: interrupted; earlier results are as they were."
    end = time.monotonic() + 20
    while alive(worker) and time.monotonic() < end:
        time.sleep(0.1)
    assert not alive(worker)
    assert Path("out/results.csv").exists()
