"""The page of `cfb bench` says what was measured, and nothing of what was not."""

import os
from pathlib import Path

from cfb_mjx.bench.benchmark import Peer
from cfb_mjx.bench.page import goals, page, ratios
from cfb_mjx.bench.timed_process import without_options


def row(what, body, speed, devices=1, drones=64):
    of = {"what": what, "body": body, "drones": drones, "devices": devices}
    return of | {"steps_per_s": speed, "compile_s": 1.0, "peak_mb": None if what == "gymnasium" else 2.0}


def peer(name, what, speed, cores):
    of = {"name": name, "version": "1.2", "what": what, "drones": 64, "cores": cores}
    return of | {"steps_per_s": speed} | ({} if name == "brax" else {"compile_s": 0.5})


OURS = [
    row("rollout", "rigid", 8e7),
    row("rollout", "rigid", 1.2e8, devices=2),
    row("rollout_randomised", "rigid", 6e7),
    row("rollout", "mjx", 2e6),
    row("rollout", "mjx-floor", 1e7),
    row("rollout", "mujoco-floor", 8e6),
    row("rollout", "mjx-stock", 1e6),
    row("gymnasium", "rigid", 2e5),
]
RESULT = {
    "rows": OURS,
    "peers": [],
    "environment": {"processor": "P"},
    "first_call": [],
    "start_up": [{"command": "cfb --help", "seconds": 0.1}],
    "scaling": [],
}
PEERS = [
    peer("crazyflow", "rollout", 4e6, 2),
    peer("crazyflow", "rollout", 2e6, 1),
    peer("l2f", "rollout", 6e6, 1),
    peer("mujoco.batch", "rollout", 5e5, 1),
    peer("crazyflow", "gymnasium", 1e5, 1),
    peer("brax", "ppo", 2e4, 2),
]
PPO = [{"what": "ppo", "drones": 256, "devices": n, "steps_per_s": 4e5 * n, "ratio": float(n)} for n in (1, 2)]


def test_every_peer_is_compared_with_what_is_like_it():
    said = "\n".join(ratios(RESULT | {"peers": PEERS}))
    assert "closed form 30.0 x (2 cores each), 40.0 x (1 core each) crazyflow 1.2" in said
    assert "randomised drones 10.0 x (1 core each) l2f 1.2" in said
    assert "MJX 1 m above a floor 20.0 x (one device of ours, 1 core of it) mujoco.batch 1.2" in said
    assert "environment for Gymnasium 2.0 x (1 core each) crazyflow 1.2" in said
    assert dict(goals(RESULT | {"peers": PEERS, "scaling": PPO})) == {
        "1 M steps/s a core above a floor that is rarely touched": "10.0 M on one device; `mujoco.batch` alone 0.50 M "
        "on one core",
        "PPO: 276 k commands/s on two cores, flights and learning": "400 k (one core: 200 k); Brax's own PPO on the "
        "same task, networks, batches and epochs 10 k",
        "environment for Gymnasium beside crazyflow's, the best batch": "0.20 M steps/s of 8 ms on one device; "
        "crazyflow's 0.10 M of 2 ms on one core, without delay, noise and randomised drones",
        "`cfb --help` in under 0.3 s": "0.10 s",
    }


def test_nothing_is_said_of_what_was_not_measured():
    text = page(RESULT, "")
    assert "nan" not in text
    assert "| PPO" not in text
    assert "| gymnasium | rigid | 64 | 1 | 2e+05 | 1.00 |  |" in text
    # A peer on a GPU has no number of cores.
    on_gpu = [peer("crazyflow", "rollout", 4e6, None)]
    assert "closed form 20.0 x (one device of ours) crazyflow 1.2" in "\n".join(ratios(RESULT | {"peers": on_gpu}))


def test_peers_run_without_the_options_of_our_commands(tmp_path, monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", "--xla_force_host_platform_device_count=2")
    python = tmp_path / "python"
    python.write_text('#!/bin/sh\necho "ready none${XLA_FLAGS:-} 0.5 100"\nread line\n')
    python.chmod(0o755)
    found = Peer("crazyflow", Path(python), "rollout", 8)
    found.close()
    assert found.version == "none"
    assert "XLA_FLAGS" not in without_options()
    assert "XLA_FLAGS" in os.environ
