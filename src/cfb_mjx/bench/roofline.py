"""How near the hot paths come to what the machine can do: operations and bytes of a step beside measured peaks."""

from __future__ import annotations

from typing import Any

from cfb_mjx.bench import workloads
from cfb_mjx.bench.machine import Peaks, peaks
from cfb_mjx.bench.operations import operations

REPETITIONS = 5
HEAD = (
    "| path | drones | steps/s | ns per step | operations | tanh, exp ... | bytes | "
    "operations, ns | tanh ..., ns | bytes, ns | accounted for |"
)


def roofline(drones: int = 1024, repetitions: int = REPETITIONS) -> dict[str, Any]:
    """Measure the machine and every hot path on it.

    Args:
        drones: in the rollouts; few enough for their states to stay in a core's cache.
        repetitions: of every path; the best counts.
    """
    machine = peaks()
    makers = (
        lambda: workloads.rollout(drones),
        lambda: workloads.rollout_randomised(drones),
        lambda: workloads.rollout_policy(drones),
        lambda: workloads.rollout_gradient(drones),
        lambda: workloads.rollout_ten(drones),
        lambda: workloads.fit_jacobian(),
        lambda: workloads.ppo_update(),
    )
    rows = []
    for make in makers:
        work = make()
        seconds = min(work.seconds() for _ in range(repetitions))
        rows.append(_row(work, seconds, machine))
    return {"machine": machine._asdict(), "rows": rows}


def _row(work: workloads.Workload, seconds: float, machine: Peaks) -> dict[str, Any]:
    function, arguments = work.trace
    steps = work.drones * work.steps
    done = operations(function, *arguments)
    plain, transcendental, moved = (x / steps for x in done)
    spent = 1e9 * seconds / steps
    parts = {
        "plain_ns": 1e9 * plain / machine.plain,
        "transcendental_ns": 1e9 * transcendental / machine.transcendental,
        "moved_ns": 1e9 * moved / machine.cache,
    }
    return {
        "what": work.what,
        "drones": work.drones,
        "steps_per_s": steps / seconds,
        "ns_per_step": spent,
        "plain": plain,
        "transcendental": transcendental,
        "bytes": moved,
        **parts,
        "accounted_for": sum(parts.values()) / spent,
    }


def section(found: dict[str, Any]) -> str:
    """Markdown of the results."""
    machine = found["machine"]
    rows = "\n".join(
        f"| {r['what']} | {r['drones']} | {r['steps_per_s']:.3g} | {r['ns_per_step']:.1f} | {r['plain']:.0f} "
        f"| {r['transcendental']:.1f} | {r['bytes']:.0f} | {r['plain_ns']:.1f} | {r['transcendental_ns']:.1f} "
        f"| {r['moved_ns']:.1f} | {r['accounted_for']:.0%} |"
        for r in found["rows"]
    )
    return f"""## Beside the machine's limit

This machine, measured in the same run with XLA programs of one line: {machine["plain"] / 1e9:.0f} G additions and
multiplications per second in cache, {machine["transcendental"] / 1e9:.2f} G tanh per second,
{machine["cache"] / 1e9:.0f} GB/s for a triad in cache and {machine["memory"] / 1e9:.0f} GB/s in memory; all float32.

Operations, transcendental functions and bytes of one step of one drone are counted in the traced program, before the
compiler simplifies it: an addition, multiplication, comparison, division or root is one operation (a multiply-add two),
and bytes are what has to pass from one step of a loop to the next or through a matrix product. Each is divided by the
measured peak. Their sum over the measured time is what is accounted for; the rest is divisions and roots (which take
longer than a multiplication), numbers that do not fit into registers between the parts of a step, loops and calls. A
share above one means that the compiler found less to do than the definition says.

{HEAD}
|{"---|" * HEAD.count("| ")}
{rows}

`fit_jacobian`: residuals of a flight's predictions and their derivatives by ten parameters, a step being one row of the
log; `ppo`: one update with the shipped configuration, flights and learning, a step being one of the simulation.
`rollout_ten`: derivatives by ten parameters of a loss over 100 steps.
"""
