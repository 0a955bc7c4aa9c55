"""Measure the library on a GPU, write docs/performance-gpu.md and benchmarks/gpu.json.

    python scripts/gpu.py [--only SECTION ...] [--seconds 500]
    python scripts/gpu.py --page-only

Needs a GPU that jax uses, and no network. Results are kept after every row, and what fails is kept too; a section is
not begun when the time is up. With --only the other sections stay as they were measured before.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from cfb_mjx.files import write_json, write_text
from cfb_mjx.runtime import configure_jax, environment

ROOT = Path(__file__).resolve().parents[1]
DRONES = (1024, 8192, 65536, 524288, 2097152)
REPETITIONS = 5
HOVER_MM = 30.0


def best(work) -> dict:
    """A row of a workload: the fastest of several runs."""
    seconds = min(work.seconds() for _ in range(REPETITIONS))
    return {
        "what": work.what,
        "body": work.body,
        "drones": work.drones,
        "steps": work.steps,
        "steps_per_s": work.drones * work.steps / seconds,
        "compile_s": round(work.compile_s, 2),
        "memory_mb": round(work.peak_mb, 1),
    }


def over_batches(make, drones, found: list, keep) -> None:
    """Rows for one workload after the other; the first batch that fails is the last."""
    for count in drones:
        try:
            found.append(best(make(count)))
        except Exception as error:
            found.append({"drones": count, "failed": f"{type(error).__name__}: {error}".splitlines()[0][:200]})
        print(json.dumps(found[-1]), flush=True)
        keep()
        if "failed" in found[-1]:
            break


def machine(found: list, keep) -> None:
    """Bytes the GPU moves per second, in a program of one line."""
    import jax
    import jax.numpy as jnp

    x = jnp.linspace(0.0, 1.0, 2**28)
    program = jax.jit(lambda x: x + 1.0)
    jax.block_until_ready(program(x))
    seconds = []
    for _ in range(REPETITIONS):
        begin = time.perf_counter()
        jax.block_until_ready(program(x))
        seconds.append(time.perf_counter() - begin)
    found.append({"what": "bytes read and written", "per_s": 2 * x.nbytes / min(seconds)})


def open_loop(found: list, keep) -> None:
    """Rollouts with every tuning of the kernel, and without it."""
    from cfb_mjx.bench import workloads
    from cfb_mjx.engine.gpu import using
    from cfb_mjx.engine.gpu_kernel import Tuning

    over_batches(workloads.rollout, DRONES, found, keep)
    over_batches(lambda n: workloads.rollout(n, "rigid-plain"), DRONES[1::2], found, keep)
    over_batches(workloads.rollout_randomised, DRONES[:4], found, keep)
    over_batches(workloads.rollout_kept, (8192, 65536), found, keep)
    for block, warps in ((64, 2), (256, 8), (256, 4), (64, 1), (32, 1)):
        with using("kernel", Tuning(block, warps)):
            over_batches(lambda n: workloads.rollout(n, "rigid"), (DRONES[3],), found, keep)
        found[-1]["body"] = f"rigid, {block} drones by {warps} warps"


def policy(found: list, keep) -> None:
    """The shipped network in the loop."""
    from cfb_mjx.bench import workloads

    over_batches(workloads.rollout_policy, (8192, 65536, 524288), found, keep)


def gradient(found: list, keep) -> None:
    """By all parameters, by ten, and the loss alone."""
    from cfb_mjx.bench import workloads

    for make in (workloads.rollout_gradient, workloads.rollout_ten, workloads.rollout_hundred):
        over_batches(make, (8192, 65536, 524288), found, keep)


def mjx(found: list, keep) -> None:
    """The MJX body, with and without floor, and plain `mjx.step`."""
    from cfb_mjx.bench import workloads

    workloads.MJX_WORK = 2_000_000
    for make in (
        lambda n: workloads.rollout(n, "mjx"),
        workloads.stock_mjx,
        lambda n: workloads.rollout(n, "mjx-floor"),
    ):
        over_batches(make, (8192, 65536), found, keep)


def ppo(found: list, keep) -> None:
    """Updates of PPO."""
    from cfb_mjx.bench import workloads

    over_batches(workloads.ppo_update, (512, 8192), found, keep)


class Reached(Exception):
    """The hover policy is good enough."""


NOMINAL = ("randomisation.magnitude=0", "randomisation.graded=0.0")
BATCH = ("ppo.drones=8192", "ppo.minibatches=16", "ppo.steps=600000000", "ppo.value_hidden=[256,256,256]")
TRAININGS = {
    "back-propagation": ("quick-analytic", (*NOMINAL, "checkpoints=40"), HOVER_MM),
    # To its end, or to that of the time: what a large batch reaches.
    "PPO": ("target", (*NOMINAL, *BATCH, "checkpoints=30"), 0.0),
}


def hover(found: list, keep) -> None:
    """Learning curves on the nominal drone: when the policy holds it within 30 mm."""
    from cfb_mjx.train.config import load_config
    from cfb_mjx.train.run import Training, train

    for name, (config, changes, enough) in TRAININGS.items():
        training, began, curve = Training.prepare(load_config(config, changes), {}), time.perf_counter(), []
        found.append({"what": name, "config": config, "changes": list(changes), "curve": curve})

        def report(row, began=began, curve=curve, enough=enough):
            curve.append({k: round(v, 3) for k, v in row.items()} | {"wall_s": round(time.perf_counter() - began, 1)})
            print(json.dumps(curve[-1]), flush=True)
            keep()
            if row["hover_mm"] < enough:
                raise Reached

        with tempfile.TemporaryDirectory() as folder, contextlib.suppress(Reached):
            train(training, Path(folder) / "out", report=report)


def tests(found: list, keep) -> None:
    """What the GPU computes, beside doubles on the CPU."""
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-s", "-p", "no:cacheprovider", "tests/engine/test_on_gpu.py"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        env=os.environ | {"XLA_PYTHON_CLIENT_PREALLOCATE": "false"},
    )
    lines = done.stdout.strip().splitlines()
    print(done.stdout[-6000:], done.stderr[-500:], flush=True)
    found.append({"what": "tests/engine/test_on_gpu.py", "result": lines[-1] if lines else done.stderr[-200:]})


SECTIONS = {f.__name__: f for f in (machine, open_loop, policy, gradient, mjx, ppo, hover, tests)}
TITLES = {
    "open_loop": "Open loop",
    "policy": "A policy in the loop",
    "gradient": "Gradients",
    "mjx": "MJX",
    "ppo": "Updates of PPO",
}
WORDS = {
    "open_loop": """500 steps of 4 ms, one command held per drone; `rollout_randomised`: every drone with its own
parameters; `rollout_kept`: a command per step and every state returned. `rigid` is the closed form in one kernel,
the state of a drone in registers from the first step to the last; `rigid-plain` the program XLA makes of it. The
kernel's default is 128 drones by 4 warps; the last rows are other ways to deal them out.""",
    "policy": "The shipped policy `target-analytic`, a command every 8 ms, two steps each (`rollout_closed_loop`).",
    "gradient": """Reverse mode through 100 steps: by all parameters, by ten; `rollout_hundred` is the loss alone, in
the kernel. The reverse pass has no kernel: it is the program XLA makes of it.""",
    "mjx": "`mjx-floor` is with floor contact, `mjx-stock` plain `mjx.step` on the same MJCF without contact.",
    "ppo": "Flights of all drones and the learning from them, configuration `target`; steps of 4 ms.",
}


def page(result: dict) -> str:
    """The results as Markdown."""
    sections = result["sections"]
    facts = {", ".join(f"{k} {v}" for k, v in s["environment"].items()) for s in sections.values()}
    text = ["# Performance on a GPU", ""]
    text += ["Written by `make gpu` (`scripts/gpu.py`); do not edit. float32, the best of several runs.", ""]
    text += [*sorted(facts), ""]
    if "machine" in sections:
        copied = sections["machine"]["rows"][0]["per_s"]
        text += [f"Measured in the same way: {copied / 1e12:.1f} TB/s read and written by `x + 1`.", ""]
    for name, title in TITLES.items():
        if name in sections:
            text += [f"## {title}", "", WORDS[name], "", *_table(sections[name]), ""]
    if "hover" in sections:
        text += ["## Learning to hover", "", *_hover(sections["hover"]["rows"]), ""]
    tried = [row["result"] for row in sections.get("tests", {}).get("rows", [])]
    said = tried[0] if tried else "not run in these runs"
    text += [
        "## Tests",
        "",
        f"`tests/engine/test_on_gpu.py`, beside doubles on the CPU of the same machine: {said}.",
        "",
    ]
    return "\n".join(text)


def _table(section: dict) -> list[str]:
    lines = ["| what | body | drones | steps/s | compile, s | memory, MB |", "|---|---|---:|---:|---:|---:|"]
    for row in section["rows"]:
        if "failed" in row:
            lines.append(f"| {row['failed']} | | {row['drones']} | | | |")
            continue
        cells = row["what"], row["body"], row["drones"], f"{row['steps_per_s']:.3g}", row["compile_s"], row["memory_mb"]
        lines.append(f"| {' | '.join(map(str, cells))} |")
    return [*lines, *([f"\n{section['failed']}"] if "failed" in section else [])]


def _hover(rows: list) -> list[str]:
    text = [f"The nominal drone; the first point of the learning curve within {HOVER_MM:.0f} mm, and the best one."]
    text += ["", "| training | commands | seconds | with start and tests | hover, mm |", "|---|---:|---:|---:|---:|"]
    for row in rows:
        there = [point for point in row["curve"] if point["hover_mm"] < HOVER_MM]
        best = min(row["curve"], key=lambda point: point["hover_mm"])
        for at in there[:1] if best in there[:1] else [*there[:1], best]:
            cells = (
                f"{at['commands'] / 1e6:.1f} M",
                f"{at['seconds']:.0f}",
                f"{at['wall_s']:.0f}",
                f"{at['hover_mm']:.0f}",
            )
            text.append(f"| {row['what']} | {' | '.join(cells)} |")
    changes = [f"`{row['config']}` with {', '.join(row['changes'])}" for row in rows]
    return [*text, "", f"Configurations: {'; '.join(changes)}. Seconds of updates hold the compiling of the first."]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="+", choices=SECTIONS, default=list(SECTIONS))
    parser.add_argument("--seconds", type=float, default=500)
    parser.add_argument("--json", type=Path, default=ROOT / "benchmarks" / "gpu.json")
    parser.add_argument("--page", type=Path, default=ROOT / "docs" / "performance-gpu.md")
    parser.add_argument("--page-only", action="store_true")
    options = parser.parse_args()
    # Sections measured before stay, each with the machine it was measured on.
    result = json.loads(options.json.read_text()) if options.json.exists() else {"sections": {}}
    if options.page_only:
        write_text(options.page, page(result))
        return 0
    began = time.perf_counter()
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
    configure_jax(x64=False)
    import jax

    # A program from the cache would make compile time look like nothing.
    jax.config.update("jax_enable_compilation_cache", False)
    if jax.default_backend() != "gpu":
        print("There is no GPU here that jax uses.", file=sys.stderr)
        return 2
    for name in options.only:
        if time.perf_counter() - began > options.seconds:
            print(f"{name}: not begun, the time is up", file=sys.stderr)
            continue
        section = {"environment": environment(), "rows": []}
        result["sections"][name] = section
        begin = time.perf_counter()
        try:
            SECTIONS[name](section["rows"], lambda: write_json(options.json, result))
        except Exception as error:
            section["failed"] = f"{type(error).__name__}: {error}"[:500]
        section["seconds"] = round(time.perf_counter() - begin, 1)
        print(name, section["seconds"], "s", section.get("failed", ""), flush=True)
        write_json(options.json, result)
        write_text(options.page, page(result))
    return 0


if __name__ == "__main__":
    sys.exit(main())
