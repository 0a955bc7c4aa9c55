"""Measure the library on a GPU, and write docs/performance-gpu.md and benchmarks/gpu.json.

    python scripts/gpu.py [--only SECTION ...] [--seconds 500]
    python scripts/gpu.py --page-only

Needs a GPU that jax uses, and no network. Results, failures included, are written after every row. After `--seconds`
no further section starts. With `--only` the other sections keep their earlier results.
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

from campaign import measured_on

from cfb_mjx.files import write_json, write_text
from cfb_mjx.runtime import configure_jax, environment

ROOT = Path(__file__).resolve().parents[1]
DRONES = (1024, 8192, 65536, 524288, 2097152)
REPETITIONS = 5
HOVER_MM = 30.0


def best(work) -> dict:
    """Measure a workload several times; return the fastest run as a row."""
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
    """Measure a workload for growing batches, until one fails."""
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
    """Measure the memory bandwidth of the GPU, with `x + 1` on a large array."""
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
    """Measure open-loop rollouts, with several tunings of the kernel and without it."""
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
    """Measure rollouts with a shipped policy in the loop."""
    from cfb_mjx.bench import workloads

    over_batches(workloads.rollout_policy, (8192, 65536, 524288), found, keep)


def gradient(found: list, keep) -> None:
    """Measure gradients with respect to all parameters and to ten, and the loss alone."""
    from cfb_mjx.bench import workloads

    for make in (workloads.rollout_gradient, workloads.rollout_ten, workloads.rollout_hundred):
        over_batches(make, (8192, 65536, 524288), found, keep)


def mjx(found: list, keep) -> None:
    """Measure the MJX body, with and without floor, and plain `mjx.step`."""
    from cfb_mjx.bench import workloads

    workloads.MJX_WORK = 2_000_000
    for make in (
        lambda n: workloads.rollout(n, "mjx"),
        workloads.stock_mjx,
        lambda n: workloads.rollout(n, "mjx-floor"),
    ):
        over_batches(make, (8192, 65536), found, keep)


def ppo(found: list, keep) -> None:
    """Measure updates of PPO."""
    from cfb_mjx.bench import workloads

    over_batches(workloads.ppo_update, (512, 8192), found, keep)


class Reached(Exception):
    """The policy hovers well enough; ends the training."""


NOMINAL = ("randomisation.magnitude=0", "randomisation.graded=0.0")
BATCH = ("ppo.drones=8192", "ppo.minibatches=16", "ppo.steps=600000000", "ppo.value_hidden=[256,256,256]")
TRAININGS = {
    "back-propagation": ("quick-analytic", (*NOMINAL, "checkpoints=40"), HOVER_MM),
    # Runs to its end or to the time limit, to show what a large batch reaches.
    "PPO": ("target", (*NOMINAL, *BATCH, "checkpoints=30"), 0.0),
}


def hover(found: list, keep) -> None:
    """Record learning curves on the nominal drone, up to a hover error below `HOVER_MM` or to their end."""
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
    """Run the tests that compare the results of the GPU with double precision on the CPU."""
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
    "open_loop": """500 steps of 4 ms. In `rollout`, every drone holds one command, and only the final state is
returned. In `rollout_randomised`, every drone also has its own parameters. `rollout_kept` takes a command per step and
returns every state. `rigid` is the closed form as one kernel, which keeps the state of a drone in registers for the
whole rollout; `rigid-plain` is the program that XLA compiles from it. The default of the kernel is 128 drones per block
of 4 warps; the last rows are other partitions.""",
    "policy": "The shipped policy `target-analytic` gives a command every 8 ms, for two steps (`rollout_closed_loop`).",
    "gradient": """Reverse mode through 100 steps, with respect to all parameters (`rollout_gradient`) and to ten
(`rollout_ten`). `rollout_hundred` is the loss alone, in the kernel. The reverse pass has no kernel; it is the program
that XLA compiles.""",
    "mjx": "`mjx-floor` is with a floor 1 m below, `mjx-stock` plain `mjx.step` on the same MJCF without contact.",
    "ppo": "One update flies all drones and trains on the flights, with the configuration `target` and steps of 4 ms.",
}


def page(result: dict) -> str:
    """Return the page of the results, as Markdown."""
    sections = result["sections"]
    text = ["# Performance on a GPU", ""]
    text += ["Use this page to estimate the speed and memory of rollouts, gradients and trainings on a GPU.", ""]
    text += ["```sh", "make gpu", "```", ""]
    text += [
        "Written by `make gpu` (`scripts/gpu.py`); do not edit. All numbers are float32, the best of several runs.",
        "",
    ]
    text += [measured_on({name: section["environment"] for name, section in sections.items()}), ""]
    if "machine" in sections:
        copied = sections["machine"]["rows"][0]["per_s"]
        text += [f"Memory bandwidth, measured in the same way: `x + 1` reads and writes {copied / 1e12:.1f} TB/s.", ""]
    text += _goals(sections)
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
        f"`tests/engine/test_on_gpu.py` compares the GPU with double precision on the CPU of the same machine: {said}.",
        "",
    ]
    return "\n".join(text)


def _goals(sections: dict) -> list[str]:
    """What was aimed at, what was measured, and what holds what was not reached."""

    def best(section: str, what: str, body: str = "rigid") -> float:
        rows = sections.get(section, {}).get("rows", [])
        return max((r["steps_per_s"] for r in rows if (r.get("what"), r.get("body")) == (what, body)), default=0.0)

    rows = []
    if opened := best("open_loop", "rollout"):
        rows.append(("open loop, 2e10 steps/s", f"{opened:.2g}", ""))
    if looped := best("policy", "rollout_policy"):
        rows.append(("a policy of 4 x 32 in the loop, 1e9 steps/s", f"{looped:.2g}", ""))
    if backward := best("gradient", "rollout_gradient"):
        ratio, plain = (
            best("gradient", "rollout_hundred") / backward,
            best("open_loop", "rollout", "rigid-plain") / backward,
        )
        held = (
            f"the reverse pass has no kernel, so that the states of all steps pass through memory; the gradient costs "
            f"{plain:.0f} times XLA's own program of the forward pass"
        )
        rows.append(("a gradient, 4 times the forward pass", f"{ratio:.0f} times", held if ratio > 4 else ""))
    points = [
        (point["seconds"], row["what"])
        for row in sections.get("hover", {}).get("rows", [])
        for point in row["curve"]
        if point["hover_mm"] < HOVER_MM
    ]
    if points:
        seconds, what = min(points)
        compiling = max(
            (r["compile_s"] for r in sections.get("ppo", {}).get("rows", []) if "compile_s" in r), default=0.0
        )
        held = f"compiling one update of PPO takes {compiling:.0f} s of it"
        rows.append(
            (f"a hover policy ({HOVER_MM:.0f} mm) in 10 s", f"{seconds:.0f} s by {what}", held if seconds > 10 else "")
        )
    if not rows:
        return []
    table = [f"| {goal} | {number} | {held or 'reached'} |" for goal, number, held in rows]
    return ["## Goals", "", "| aimed at | measured | what holds it |", "|---|---|---|", *table, ""]


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
    text = [f"On the nominal drone: the first point of the learning curve below {HOVER_MM:.0f} mm, and the best point."]
    text += [
        "",
        "| training | commands | updates, s | with start and tests, s | hover, mm |",
        "|---|---:|---:|---:|---:|",
    ]
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
    text += [
        "",
        f"Configurations: {'; '.join(changes)}. The time of the updates includes the compilation of the first.",
    ]
    return text


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="+", choices=SECTIONS, default=list(SECTIONS))
    parser.add_argument("--seconds", type=float, default=500)
    parser.add_argument("--json", type=Path, default=ROOT / "benchmarks" / "gpu.json")
    parser.add_argument("--page", type=Path, default=ROOT / "docs" / "performance-gpu.md")
    parser.add_argument("--page-only", action="store_true")
    options = parser.parse_args()
    # Earlier sections stay, each with the machine that it was measured on.
    result = json.loads(options.json.read_text()) if options.json.exists() else {"sections": {}}
    if options.page_only:
        write_text(options.page, page(result))
        return 0
    began = time.perf_counter()
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
    configure_jax(x64=False)
    import jax

    # A program from the cache would take no time to compile.
    jax.config.update("jax_enable_compilation_cache", False)
    if jax.default_backend() != "gpu":
        print("jax finds no GPU on this machine.", file=sys.stderr)
        return 2
    for name in options.only:
        if time.perf_counter() - began > options.seconds:
            print(f"{name}: not started, because --seconds have passed", file=sys.stderr)
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
