"""The script for SLURM, with SLURM's own commands replaced by ones that note what they are asked for."""

import os
import subprocess
from pathlib import Path

from cfb_mjx.commands.line import parse

SCRIPT = Path(__file__).resolve().parents[2] / "scripts" / "slurm_sweep.sh"
JOB = {"SLURM_JOB_NODELIST": "n[1-2]", "SLURM_JOB_ID": "70001", "SLURM_JOB_NUM_NODES": "2", "SLURM_CPUS_PER_TASK": "8"}


def run(folder: Path, *words: str) -> subprocess.CompletedProcess:
    for name, does in {"srun": 'printf "%s\\n" "$RAY_AUTH_TOKEN" "$@"', "scontrol": 'printf "n1\\nn2\\n"'}.items():
        (folder / name).write_text(f"#!/bin/sh\n{does}\n")
        (folder / name).chmod(0o755)
    environment = os.environ | JOB | {"PATH": f"{folder}:{os.environ['PATH']}"}
    return subprocess.run(["bash", SCRIPT, *words], capture_output=True, text=True, env=environment, check=False)


def test_ray_is_started_on_all_machines_and_the_sweep_on_the_first(tmp_path):
    done = run(tmp_path, "a sweep.yaml", "out", "--retries", "5")
    assert done.returncode == 0, done.stderr
    token, *words = done.stdout.splitlines()
    assert len(token) == 64
    outer, inner = words[: words.index("--")], words[words.index("--") + 1 :]
    assert outer[:3] == ["--nodes=2", "--ntasks=2", "--ntasks-per-node=1"]
    assert outer[3:10] == ["python", "-m", "ray.scripts.symmetric_run", "--address", "n1:30001", "--min-nodes", "2"]
    assert inner == ["cfb", "sweep", "a sweep.yaml", "-o", "out", "--address", "n1:30001", "--retries", "5"]
    assert parse("sweep", inner[2:]).retries == 5


def test_without_a_folder_it_says_how_it_is_called(tmp_path):
    done = run(tmp_path, "sweep.yaml")
    assert done.returncode == 2
    assert done.stderr.startswith("usage: sbatch")
