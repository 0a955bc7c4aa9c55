"""Compare the hot paths with the limits of the machine: operations and bytes per step over measured peak rates."""

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
    """Measure the peak rates of the machine and the speed of every hot path.

    Args:
        drones: drones in the rollouts; few enough that their states stay in the cache of a core.
        repetitions: runs of every path; the best one counts.

    Returns:
        JSON values: ``machine`` (the peak rates) and ``rows`` (one per path).
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
    """Return the section with the results, as Markdown."""
    machine = found["machine"]
    rows = "\n".join(
        f"| {r['what']} | {r['drones']} | {r['steps_per_s']:.3g} | {r['ns_per_step']:.1f} | {r['plain']:.0f} "
        f"| {r['transcendental']:.1f} | {r['bytes']:.0f} | {r['plain_ns']:.1f} | {r['transcendental_ns']:.1f} "
        f"| {r['moved_ns']:.1f} | {r['accounted_for']:.0%} |"
        for r in found["rows"]
    )
    return f"""## Beside the machine's limit

XLA programs of one line, measured in the same run, reach {machine["plain"] / 1e9:.0f} G additions and
multiplications per second in cache, {machine["transcendental"] / 1e9:.2f} G tanh per second,
{machine["cache"] / 1e9:.0f} GB/s for a triad in cache and {machine["memory"] / 1e9:.0f} GB/s in memory, all in float32.

Operations, transcendental functions and bytes of one step of one drone are counted in the traced program, before the
compiler simplifies it. An addition, multiplication, comparison, division or root is one operation, a multiply-add two.
Bytes are those that pass from one step of a loop to the next or through a matrix product. Each count is divided by the
measured peak rate. *Accounted for* is the sum of these times over the measured time. The rest is divisions and roots
(which take longer than a multiplication), numbers that do not stay in registers between the parts of a step, loops and
calls. More than 100 % means that the compiler removed operations.

{HEAD}
|{"---|" * HEAD.count("| ")}
{rows}

`fit_jacobian` computes the residuals of a flight's predictions and their derivatives with respect to ten parameters; a
step is one row of the log. `ppo` is one update with the shipped configuration, flights and training; a step is one step
of the simulation. `rollout_ten` computes derivatives of a loss over 100 steps with respect to ten parameters.
"""
