"""Compare the hot paths with the limits of the machine: operations and bytes per step over measured peak rates.

The operations, transcendental functions and bytes of a step are counted in the trace of the program.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from cfb_mjx.bench import workloads
from cfb_mjx.bench.machine import Peaks, peaks
from cfb_mjx.engine import primitive
from cfb_mjx.optional import not_none

PLAIN = {
    "add", "sub", "mul", "div", "max", "min", "neg", "abs", "sqrt", "rsqrt", "sign", "floor", "round", "clamp",
    "add_any", "square",
}  # fmt: skip
TRANSCENDENTAL = {
    "exp", "exp2", "expm1", "log", "log1p", "tanh", "sin", "cos", "tan", "atan2", "asin", "acos", "logistic", "pow",
    "erf", "erf_inv", "cbrt",
}  # fmt: skip
REDUCTIONS = {"reduce_sum", "reduce_max", "reduce_min", "cumsum"}


class Operations(NamedTuple):
    """Counts of one call."""

    plain: float
    """Additions, multiplications, comparisons, divisions, roots; two for each multiply-accumulate of a product."""
    transcendental: float
    """Exponentials, tangents and other transcendental functions, each counted once."""
    moved: float
    """Bytes that pass from one step of a loop to the next, or in and out of a matrix product."""

    def __add__(self, other: tuple[Any, ...]) -> Operations:
        return Operations(*(a + b for a, b in zip(self, other, strict=True)))

    def times(self, factor: float) -> Operations:
        """Return the counts of ``factor`` calls."""
        return Operations(*(factor * x for x in self))


NOTHING = Operations(0.0, 0.0, 0.0)


def operations(function: Callable, *arguments: Any) -> Operations:
    """Count the operations of a call of ``function``, in its trace, before the compiler simplifies it.

    The body of a loop counts once per iteration, or once in all if the number of iterations is unknown. Of several
    branches, the most expensive one counts.
    """
    return _of(jax.make_jaxpr(function)(*arguments).jaxpr)


def _of(jaxpr) -> Operations:
    return sum(map(_equation, jaxpr.eqns), NOTHING)


def _equation(equation) -> Operations:
    name, parameters = equation.primitive.name, equation.params
    if name == "scan":
        body = _plain(parameters["jaxpr"])
        # Recognised by the number of axes, because the names depend on the version of jax: sequences that are read or
        # written have one axis less in the body. The carry comes before them.
        read = [b for a, b in zip(equation.invars, body.invars, strict=True) if _deeper(a, b)]
        written = [b for a, b in zip(equation.outvars, body.outvars, strict=True) if _deeper(a, b)]
        carry = body.outvars[: len(body.outvars) - len(written)]
        crossing = 2 * _bytes(carry) + _bytes(read) + _bytes(written)
        return (_of(body) + Operations(0.0, 0.0, crossing)).times(parameters["length"])
    if name == "cond":
        return max((_of(_plain(branch)) for branch in parameters["branches"]), key=lambda o: o.plain + o.transcendental)
    if name in primitive.OPERATIONS:
        given = [jax.ShapeDtypeStruct(v.aval.shape, v.aval.dtype) for v in equation.invars]
        return _of(primitive.meaning(name, given, parameters).jaxpr)
    inner = [_plain(p) for p in parameters.values() if hasattr(_plain(p), "eqns")]
    if inner:
        return sum(map(_of, inner), NOTHING)
    out = equation.outvars[0].aval
    if not hasattr(out, "dtype") or not jnp.issubdtype(out.dtype, jnp.floating):
        return NOTHING
    if name == "dot_general":
        (left, _), _ = parameters["dimension_numbers"]
        contracted = math.prod(equation.invars[0].aval.shape[i] for i in left)
        return Operations(2.0 * out.size * contracted, 0.0, _bytes(equation.invars) + _bytes(equation.outvars))
    if name in REDUCTIONS:
        return Operations(float(equation.invars[0].aval.size), 0.0, 0.0)
    if name == "integer_pow":
        return Operations(float(out.size) * max(1, abs(parameters["y"]) - 1), 0.0, 0.0)
    if name in PLAIN:
        return Operations(float(out.size), 0.0, 0.0)
    return Operations(0.0, float(out.size), 0.0) if name in TRANSCENDENTAL else NOTHING


def _plain(jaxpr):
    return jaxpr.jaxpr if hasattr(jaxpr, "jaxpr") else jaxpr


def _deeper(outside, inside) -> bool:
    return outside.aval.ndim > inside.aval.ndim


def _bytes(variables) -> float:
    return float(
        sum(
            v.aval.size * v.aval.dtype.itemsize
            for v in variables
            if hasattr(v.aval, "dtype") and not jnp.issubdtype(v.aval.dtype, jax.dtypes.prng_key)
        )
    )


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
    function, arguments = not_none(work.trace)
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
