"""The results of ``cfb bench`` as sentences and as a Markdown page."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import jax

from cfb_mjx.bench import workloads
from cfb_mjx.bench.first_call import START_UP
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
            found.append(f"MJX 1 m above a floor {floor / free:.1f} x MJX without one")
        lines += [f"{drones} drone{'s' if drones > 1 else ''}: {line}" for line in found]
    return lines


COMPARED = (
    ("rollout", "rigid", "crazyflow", "closed form"),
    ("rollout_policy", "rigid", "crazyflow", "the same network in the loop"),
    ("gymnasium", "rigid", "crazyflow", "environment for Gymnasium"),
    ("rollout_randomised", "rigid", "l2f", "closed form of randomised drones"),
    ("rollout", "mjx-floor", "mujoco.batch", "MJX 1 m above a floor"),
    ("rollout", "mujoco-floor", "mujoco.batch", "MuJoCo 1 m above a floor"),
)
"""Rows and peers that are compared: what and body of ours, the peer, and how a sentence names them."""


def _beside_peers(peers: list[dict], speed) -> list[str]:
    lines = []
    for what, body, name, title in COMPARED:
        of_peer = "rollout" if what == "rollout_randomised" else what
        found, parts = [p for p in peers if (p["name"], p["what"]) == (name, of_peer)], []
        for peer in found:
            # Compare with as many devices as the peer has cores, if that was measured, else with one.
            ours = speed(what, body, devices=peer["cores"]) if peer["cores"] and body == "rigid" else None
            alike = f"{_cores(peer['cores'])} each" if ours else "one device of ours"
            if not ours and peer["cores"]:
                alike += f", {_cores(peer['cores'])} of it"
            if ours := ours or speed(what, body):
                parts.append(f"{ours / peer['steps_per_s']:.1f} x ({alike})")
        if parts:
            lines.append(f"{title} {', '.join(parts)} {name} {found[0]['version']}")
    alone = speed("network_alone", "none")
    one = next((p["steps_per_s"] for p in peers if (p["what"], p["cores"]) == ("rollout_policy", 1)), None)
    if alone and one:
        lines.append(f"the network alone, without simulation, {alone / one:.1f} x crazyflow in the loop (1 core each)")
    return lines


def goals(result: Mapping[str, Any]) -> list[tuple[str, str]]:
    """What was aimed at on two cores of a CPU, and what was measured; without what was not measured."""

    def best(kind: str, **wanted) -> float:
        rows = (r for r in result[kind] if all(r.get(k) == v for k, v in wanted.items()))
        return max((row["steps_per_s"] for row in rows), default=math.nan)

    ppo = {row["devices"]: row["steps_per_s"] / 2 for row in result.get("scaling", []) if row["what"] == "ppo"}
    start = {row["command"]: row["seconds"] for row in result.get("start_up", [])}
    found = []
    if not math.isnan(floor := best("rows", what="rollout", body="mjx-floor")):
        number = f"{floor / 1e6:.1f} M on one device"
        if not math.isnan(alone := best("peers", name="mujoco.batch", cores=1)):
            number += f"; `mujoco.batch` alone {alone / 1e6:.2f} M on one core"
        found.append(("1 M steps/s a core above a floor that is rarely touched", number))
    if ppo:
        number = f"{ppo[2] / 1e3:.0f} k (one core: {ppo[1] / 1e3:.0f} k)"
        if not math.isnan(brax := best("peers", name="brax", cores=2)):
            number += f"; Brax's own PPO on the same task, networks, batches and epochs {brax / 2e3:.0f} k"
        found.append(("PPO: 276 k commands/s on two cores, flights and learning", number))
    ours, theirs = best("rows", what="gymnasium"), best("peers", what="gymnasium", cores=1)
    if not math.isnan(ours + theirs):
        number = (
            f"{ours / 1e6:.2f} M steps/s of 8 ms on one device; crazyflow's {theirs / 1e6:.2f} M of 2 ms on one core, "
        )
        number += "without delay, noise and randomised drones"
        found.append(("environment for Gymnasium beside crazyflow's, the best batch", number))
    return found + [(f"`{c}` in under {limit} s", f"{start[c]:.2f} s") for c, limit in START_UP.items() if c in start]


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
        f"{_seconds(row):>11}{_memory(row):>11}"
    )


def _seconds(row: dict) -> str:
    return f"{row['compile_s']:.2f}" if "compile_s" in row else ""


def _memory(row: dict) -> str:
    return f"{row['peak_mb']:.1f}" if row.get("peak_mb") is not None else ""


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
            f"| {_seconds(row)} | {_memory(row)} |"
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
| `gymnasium` | steps of 8 ms of the environment for Gymnasium, with randomised drones, delays and noise |

| body | meaning |
|---|---|
| `rigid` | closed form |
| `mjx` | MuJoCo XLA without contact |
| `mjx-floor` | MuJoCo XLA with a floor 1 m below the drones, which fly as in closed form unless they are near it |
| `mujoco-floor` | the same with MuJoCo's C (`MujocoBody`) |
| `mjx-stock` | plain `mjx.step` on the same MJCF without contact |

The runs take turns with those of crazyflow. It simulates first-principles dynamics under rotor-velocity control at
500 Hz (`sim.step(500)`), and with the same network in its loop at 250 Hz, a command every 8 ms. Its process has XLA's
default options and one device. It is measured twice: free to use all cores, as XLA's library for matrix products does,
and bound to one core, as are `mujoco.batch`, MuJoCo's C alone (the drone 1 m above a floor under a constant force, 50
steps per call), and crazyflow's `ReachPosEnv` (steps of 2 ms of the same dynamics). `l2f`, the C++ of Learning to Fly,
is bound to one core (Runge-Kutta steps of 10 ms, one call from Python per step, on drones that it draws).
Brax's own PPO trains on the same task for a few updates. This library runs with the option that the `cfb` command sets
on CPU ([model.md](model.md#speed)): `XLA_FLAGS={flags}`.

{_goals_section(result)}
{comparison}

{gpu}
{chr(10).join(table)}

{first_call_section(result["first_call"], result.get("start_up", []))}
{scaling_section(result.get("scaling"))}
{section(result["roofline"]) if "roofline" in result else ""}
<!-- growth: begin -->
<!-- growth: end -->
"""


def _goals_section(result: Mapping[str, Any]) -> str:
    if "scaling" not in result:
        return ""
    lines = "\n".join(f"| {goal} | {number} |" for goal, number in goals(result))
    return f"""## Goals

| aimed at | measured in this run |
|---|---|
{lines}

## Ratios
"""


def first_call_section(rows: list[dict], start_up: list[dict]) -> str:
    """Return the section on the first call, as Markdown."""
    begun = "".join(f"\n- `{row['command']}`: {row['seconds']:.2f} s" for row in start_up)
    lines = "\n".join(f"| {row['cache']} | {row['import_s']:.1f} | {row['call_s']:.1f} |" for row in rows)
    return f"""## The first call

A new process loads the library and simulates 4096 drones for half a second, as the `cfb` command would. The cache of
compiled programs is on by default, in the user's cache folder.

| cache | loading, s | first call, s |
|---|---:|---:|
{lines}

New processes, the best of three:
{begun}
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
