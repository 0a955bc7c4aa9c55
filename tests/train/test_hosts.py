"""Two processes train as one, and one of them may die: `cfb train --coordinator` as a user types it."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import jax
import numpy as np
import pytest

from cfb_mjx.control.policy_file import load_policy
from cfb_mjx.errors import CfbError
from cfb_mjx.joining import BOUND, Hosts, _arguments
from cfb_mjx.train.checkpoint import read_about
from cfb_mjx.train.run import CHECKPOINT, CURVE, POLICY

# They share compiled programs, and would starve others of both cores.
pytestmark = pytest.mark.xdist_group("hosts")

LIMIT_S = 240
"""No process is waited for longer."""
RTOL, ATOL = 1e-5, 1e-6
"""Of single precision: sums over devices may be taken in another order. The curve is written with six digits."""
SIZES = (
    "checkpoints=8",
    "network.hidden=[8, 8]",
    "ppo.drones=8",
    "ppo.unroll=4",
    "ppo.steps=1280",
    "ppo.minibatches=2",
    "ppo.copies=2",
    "ppo.epochs=1",
    "ppo.value_hidden=[8]",
)


class Training:
    """``cfb train`` in processes of its own, which are gone when the block ends."""

    def __init__(self, cache: Path, output: Path, processes: int, *more: str):
        address = f"127.0.0.1:{_free_port()}"
        environment = os.environ | {"JAX_COMPILATION_CACHE_DIR": str(cache)}
        self.processes = []
        for process in range(processes):
            hosts = ("--devices", "2")
            if processes > 1:
                hosts = ("--coordinator", address, "--processes", str(processes), "--process", str(process))
            command = ("train", "target", "-o", str(output), *hosts, *more, "--set", *SIZES)
            self.processes.append(
                subprocess.Popen(
                    [sys.executable, "-m", "cfb_mjx.cli", *command],
                    stdout=subprocess.PIPE,
                    stderr=subprocess.PIPE,
                    text=True,
                    env=environment,
                )
            )

    def __enter__(self):
        return self

    def __exit__(self, *_):
        for process in self.processes:
            process.kill()
            process.communicate()

    def ended(self) -> list[tuple[int, str, str]]:
        """Status, output and errors of every process."""
        found = []
        for process in self.processes:
            out, err = process.communicate(timeout=LIMIT_S)
            found.append((process.returncode, out, err))
        return found


def _free_port() -> int:
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return one.getsockname()[1]


def curve(folder: Path) -> np.ndarray:
    """Rows of the learning curve, without the clock."""
    lines = (folder / CURVE).read_text().splitlines()
    names = lines[0].split(",")
    kept = [i for i, name in enumerate(names) if name != "seconds"]
    return np.array([[float(line.split(",")[i]) for i in kept] for line in lines[1:]])


def weights(folder: Path) -> list[np.ndarray]:
    return [np.asarray(x) for x in jax.tree.leaves(load_policy(folder / POLICY).controller)]


def same(one: Path, other: Path) -> None:
    np.testing.assert_allclose(curve(one), curve(other), rtol=RTOL, atol=ATOL)
    for a, b in zip(weights(one), weights(other), strict=True):
        np.testing.assert_allclose(a, b, rtol=RTOL, atol=ATOL)


@pytest.fixture(scope="module")
def cache(pytestconfig) -> Path:
    """Of compiled programs, kept beside pytest's own."""
    return pytestconfig.cache.mkdir("jax_hosts")


@pytest.fixture(scope="module")
def alone(cache, tmp_path_factory) -> Path:
    """What one process with two devices makes of it."""
    folder = tmp_path_factory.mktemp("alone") / "run"
    with Training(cache, folder, 1) as training:
        [(status, _, errors)] = training.ended()
    assert status == 0, errors
    return folder


@pytest.mark.long
def test_two_processes_train_what_one_does(cache, alone, tmp_path):
    folder = tmp_path / "run"
    with Training(cache, folder, 2) as training:
        ends = training.ended()
    assert [status for status, *_ in ends] == [0, 0], ends
    same(alone, folder)
    assert len(curve(folder)) == 8
    # The first alone writes and talks.
    assert {p.name for p in folder.iterdir()} == {p.name for p in alone.iterdir()}
    assert str(folder / POLICY) in ends[0][1]
    assert ends[1][1:] == ("", "")


LISTENING = """
import sys
from pathlib import Path
from cfb_mjx.joining import Hosts, _join
_join(Hosts(sys.argv[1], 1, 0))
for table in ("tcp", "tcp6"):
    for line in Path(f"/proc/self/net/{table}").read_text().splitlines()[1:]:
        _, place, _, state = line.split()[:4]
        address, _, port = place.partition(":")
        if state == "0A" and int(port, 16) == int(sys.argv[1].rpartition(":")[2]):
            print(table, address)
"""


@pytest.mark.skipif(not Path("/proc/self/net/tcp").exists(), reason="needs Linux's table of sockets")
def test_process_0_listens_where_it_is_told_to_and_nowhere_else():
    command = [sys.executable, "-c", LISTENING, f"127.0.0.1:{_free_port()}"]
    environment = {key: value for key, value in os.environ.items() if key != BOUND}
    done = subprocess.run(command, capture_output=True, text=True, check=True, env=environment)
    assert done.stdout.split("\n")[0] in ("tcp 0100007F", "tcp6 0000000000000000FFFF00000100007F")
    assert done.stdout.count("\n") == 1


def test_a_name_that_other_machines_cannot_reach_is_refused(monkeypatch):
    def resolve(name, port):
        return [(socket.AF_INET, None, 0, "", ({"localhost": "127.0.0.1"}.get(name, "127.0.1.1"), 0))]

    monkeypatch.setattr(socket, "getaddrinfo", resolve)
    monkeypatch.delenv(BOUND, raising=False)
    assert _arguments(Hosts("localhost:99", 2, 0))["coordinator_bind_address"] == "localhost:99"
    with pytest.raises(CfbError, match=r"node-a is 127\.0\.1\.1 on this machine, where no other machine can reach"):
        _arguments(Hosts("node-a:99", 2, 0))
    _arguments(Hosts("node-a:99", 2, 1))  # only process 0 listens
    monkeypatch.setenv(BOUND, "10.0.0.1:99")
    assert _arguments(Hosts("node-a:99", 2, 0))["coordinator_bind_address"] == "10.0.0.1:99"


@pytest.mark.parametrize(("killed", "goes_on"), [(1, 2), pytest.param(0, 1, marks=pytest.mark.long)])
def test_two_processes_train_what_one_does_even_if_one_dies(cache, alone, tmp_path, killed, goes_on):
    folder, left = tmp_path / "run", 1 - killed
    with Training(cache, folder, 2) as training:
        deadline = time.monotonic() + LIMIT_S
        while not (folder / CHECKPOINT).exists() and time.monotonic() < deadline:
            time.sleep(0.01)
        training.processes[killed].send_signal(signal.SIGKILL)
        begin = time.monotonic()
        ends = training.ended()
        assert time.monotonic() - begin < 60
    assert ends[killed][0] == -signal.SIGKILL
    status, _, errors = ends[left]
    assert status == 3
    last = errors.splitlines()[-1]
    assert last.startswith(f"cfb: process {killed} of 2 stopped"), errors
    assert "--resume" in last
    assert "Traceback" not in errors
    # What is on disk is whole, and not the end.
    done = read_about(folder / CHECKPOINT)["updates"]
    assert 0 < done < 40
    rows = curve(folder)
    np.testing.assert_allclose(rows, curve(alone)[: len(rows)], rtol=RTOL, atol=ATOL)
    with Training(cache, folder, goes_on, "--resume") as training:
        ends = training.ended()
    assert {status for status, *_ in ends} == {0}, ends
    same(alone, folder)


def test_rollouts_and_evaluation_over_two_processes_are_those_of_one(tmp_path):
    worker, address = Path(__file__).parents[1] / "on_hosts.py", f"127.0.0.1:{_free_port()}"
    running = [
        subprocess.Popen(
            [sys.executable, worker, address, str(count), str(process), tmp_path / f"{count}{process}.npz"],
            stderr=subprocess.PIPE,
            text=True,
        )
        for count, process in ((1, 0), (2, 0), (2, 1))
    ]
    try:
        for process in running:
            _, errors = process.communicate(timeout=LIMIT_S)
            assert process.returncode == 0, errors
    finally:
        for process in running:
            process.kill()
            process.communicate()
    one, *both = (np.load(tmp_path / f"{name}.npz") for name in ("10", "20", "21"))
    for other in both:
        for name in one.files:
            np.testing.assert_allclose(other[name], one[name], rtol=1e-12, atol=1e-12)
    for archive in (one, *both):
        archive.close()


def test_what_the_first_refuses_all_refuse(cache, alone):
    before = (alone / POLICY).read_bytes()
    with Training(cache, alone, 2) as training:
        ends = training.ended()
    for status, _, errors in ends:
        assert status == 2
        assert "holds a training already" in errors
    assert (alone / POLICY).read_bytes() == before


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (("--coordinator", "somewhere"), "write HOST:PORT"),
        (("--coordinator", "a:1", "--processes", "2"), "needs --processes N and --process I"),
        (("--coordinator", "a:1", "--processes", "2", "--process", "2"), "it must be 0 to 1"),
        (("--processes", "2"), "need --coordinator"),
        (("--coordinator", "auto", "--process", "1"), "leave them out"),
        (("--coordinator", "auto"), "no cluster is found here"),
        (("--devices", "3"), "cannot be divided evenly over 3 devices"),
    ],
)
def test_what_makes_no_sense_gets_one_sentence(options, sentence, tmp_path):
    clean = {key: value for key, value in os.environ.items() if not key.startswith(("SLURM", "OMPI"))}
    command = [sys.executable, "-m", "cfb_mjx.cli", "train", "target", "-o", str(tmp_path / "run"), *options]
    done = subprocess.run(command, capture_output=True, text=True, timeout=LIMIT_S, env=clean, check=False)
    assert done.returncode == 2, done.stderr
    assert sentence in done.stderr
    assert "Traceback" not in done.stderr
    assert not (tmp_path / "run" / CHECKPOINT).exists()
