"""The results of ``cfb bench`` as sentences and as a Markdown page."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax

from cfb_mjx.bench import workloads
from cfb_mjx.bench.roofline import section


def body(row: dict) -> str:
    """Format the body of a row; of a peer its name, version and cores."""
    if "name" not in row:
        return row["body"]
    return f"{row['name']} {row['version']}" + (f", {_cores(row['cores'])}" if row["cores"] else "")


def _all(result: Mapping[str, Any]) -> list[dict]:
    """Rows and peers, by batch size."""
    return sorted([*result["rows"], *result["peers"]], key=lambda row: row["drones"])


def _cores(count: int) -> str:
    return f"{count} core{'s' if count > 1 else ''}"


def ratios(result: Mapping[str, Any]) -> list[str]:
    """Return sentences that compare the rows of each batch size."""
    lines = []
    for drones in sorted({row["drones"] for row in result["rows"]}):
        rows = [row for row in result["rows"] if row["drones"] == drones]
        peers = [peer for peer in result["peers"] if peer["drones"] == drones]

        def speed(what, body="rigid", rows=rows, **wanted):
            wanted = {"what": what, "body": body} | ({"devices": 1} | wanted if body == "rigid" else wanted)
            fitting = (row["steps_per_s"] for row in rows if all(row.get(k) == v for k, v in wanted.items()))
            return next(fitting, None)

        found = _beside_peers(peers, speed)
        if ten := speed("rollout_ten"):
            found.append(f"a gradient for ten parameters costs {speed('rollout_hundred') / ten:.1f} x the same rollout")
        if plain := speed("rollout", "rigid-plain"):
            found.append(f"the kernel {speed('rollout') / plain:.2f} x the plain program")
        free, floor, stock = (speed("rollout", name) for name in ("mjx", "mjx-floor", "mjx-stock"))
        if free and floor and stock:
            found.append(f"MJX without floor {free / stock:.2f} x stock mjx.step")
            found.append(f"MJX without floor {free / floor:.1f} x MJX with floor")
        lines += [f"{drones} drone{'s' if drones > 1 else ''}: {line}" for line in found]
    return lines


def _beside_peers(peers: list[dict], speed) -> list[str]:
    lines = []
    for what, title in (("rollout", "closed form"), ("rollout_policy", "the same network in the loop")):
        name, parts = "", []
        for peer in (peer for peer in peers if peer["what"] == what):
            # Compare with as many devices as the peer has cores, if that was measured, else with one.
            ours = speed(what, devices=peer["cores"]) if peer["cores"] else None
            on = f"{_cores(peer['cores'])} each" if ours else "one device of ours"
            parts.append(f"{(ours or speed(what)) / peer['steps_per_s']:.1f} x ({on})")
            name = f"{peer['name']} {peer['version']}"
        if parts:
            lines.append(f"{title} {', '.join(parts)} {name}")
    alone = speed("network_alone")
    one = next((p["steps_per_s"] for p in peers if (p["what"], p["cores"]) == ("rollout_policy", 1)), None)
    if alone and one:
        lines.append(f"the network alone, without simulation, {alone / one:.1f} x crazyflow in the loop (1 core each)")
    return lines


def text(result: Mapping[str, Any]) -> str:
    """Return all rows as a table, and the comparison."""
    head = f"{'what':<20}{'body':<18}{'drones':>7}{'devices':>8}{'steps/s':>12}{'compile s':>11}{'memory MB':>11}"
    lines = [head, *map(_line, _all(result))]
    if "roofline" in result:
        lines.append(section(result["roofline"]))
    return "\n".join([*lines, *ratios(result)])


def _line(row: dict) -> str:
    return (
        f"{row['what']:<20}{body(row):<18}{row['drones']:>7}{row.get('devices', ''):>8}{row['steps_per_s']:>12.3g}"
        f"{row['compile_s']:>11.2f}{_memory(row):>11}"
    )


def _memory(row: dict) -> str:
    return f"{row['peak_mb']:.1f}" if "peak_mb" in row else ""


def page(result: dict, flags: str) -> str:
    """Return the results as a Markdown page.

    Args:
        result: the results of `benchmark`.
        flags: ``XLA_FLAGS`` of the process that measured them.
    """
    facts = ", ".join(f"{name} {value}" for name, value in result["environment"].items())
    table = [
        "| what | body | drones | devices | steps/s | compile, s | memory, MB |",
        "|---|---|---:|---:|---:|---:|---:|",
    ]
    for row in _all(result):
        table.append(
            f"| {row['what']} | {body(row)} | {row['drones']} | {row.get('devices', '')} | {row['steps_per_s']:.3g} "
            f"| {row['compile_s']:.2f} | {_memory(row)} |"
        )
    gpu = "" if jax.default_backend() != "cpu" else "On a GPU: [performance-gpu.md](performance-gpu.md).\n"
    comparison = "\n".join(f"- {line}" for line in ratios(result))
    return f"""# Performance

Use this page to estimate the time and memory of rollouts, gradients and trainings on a CPU.

Written by `make bench` (`cfb bench --peer-python ... --markdown docs/performance.md`); do not edit.

{facts}

Speeds are steps per second of all drones together, float32, the best of several runs. Memory is that of the compiled
program's arguments, results and temporaries. One JAX device of a CPU is one core.

| what | measured program |
|---|---|
| `rollout` | open loop, {workloads.STEPS} steps of 4 ms (MJX fewer), one command held per drone, final state only |
| `rollout_kept` | a command per step, every state returned |
| `rollout_randomised` | as `rollout`, every drone with its own parameters |
| `rollout_gradient` | reverse-mode gradient of a 100-step rollout with respect to all parameters |
| `rollout_ten` | the same with respect to ten parameters |
| `rollout_hundred` | that 100-step rollout without gradient |
| `rollout_policy` | the shipped policy `target-analytic` in the loop (`rollout_closed_loop`), a command every 8 ms |
| `network_alone` | its network evaluated as often, without simulation and observation |

| body | meaning |
|---|---|
| `rigid` | closed form |
| `mjx` | MuJoCo XLA without contact |
| `mjx-floor` | MuJoCo XLA with floor contact |
| `mjx-stock` | plain `mjx.step` on the same MJCF without contact |

The runs take turns with those of crazyflow. It simulates first-principles dynamics under rotor-velocity control at
500 Hz (`sim.step(500)`), and with the same network in its loop at 250 Hz, a command every 8 ms. Its process has XLA's
default options and one device. It is measured twice: free to use all cores, as XLA's library for matrix products does,
and bound to one core. This library runs with the option that the `cfb` command sets on CPU
([model.md](model.md#speed)): `XLA_FLAGS={flags}`.

{comparison}

{gpu}
{chr(10).join(table)}

{first_call_section(result["first_call"])}
{scaling_section(result.get("scaling"))}
{section(result["roofline"]) if "roofline" in result else ""}
<!-- growth: begin -->
<!-- growth: end -->
"""


def first_call_section(rows: list[dict]) -> str:
    """Return the section on the first call, as Markdown."""
    lines = "\n".join(f"| {row['cache']} | {row['import_s']:.1f} | {row['call_s']:.1f} |" for row in rows)
    return f"""## The first call

A new process loads the library and simulates 4096 drones for half a second, as the `cfb` command would. The cache of
compiled programs is on by default, in the user's cache folder.

| cache | loading, s | first call, s |
|---|---:|---:|
{lines}
"""


def scaling_section(rows: list[dict] | None) -> str:
    """Return the section on two cores, as Markdown; empty if it was not measured."""
    if not rows:
        return ""
    lines = "\n".join(
        f"| {row['what']} | {row['drones']} | {row['devices']} | {row['steps_per_s']:.3g} | {row['ratio']:.2f} |"
        for row in rows
    )
    return f"""## From one core to two

One device in a process that is bound to one core, and two devices in a process that is bound to two. The runs take
turns, and the best one counts. `ppo` is one update with the shipped configuration.

| what | drones | devices | steps/s | relative to one |
|---|---:|---:|---:|---:|
{lines}
"""
