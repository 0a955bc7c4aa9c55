"""Count floating-point operations, transcendental functions and bytes moved in the trace of a program."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from cfb_mjx.engine import primitive

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
