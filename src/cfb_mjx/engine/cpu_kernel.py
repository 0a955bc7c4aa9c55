"""A computation that XLA's CPU compiler turns into one function, instead of one call per fused operation."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
from jax.experimental.xla_metadata import set_xla_metadata
from jaxtyping import Array

from cfb_mjx.engine.scalars import ELEMENTWISE

_MORE = """
    acos acosh and asin asinh atan atan2 atanh cbrt cosh erf erf_inv erfc exp2 logistic rem round shift_left
    shift_right_arithmetic shift_right_logical sinh xor
"""
HELD = ELEMENTWISE | frozenset(_MORE.split())
"""Operations that such a function holds as well as any other, beside moving numbers about and adding them up. Not known
of the rest: matrix products are slow there, sorting and loops are other functions."""


def one_kernel(function: Callable[..., Any], *arrays: Array) -> Any:
    """``function(*arrays)``, for CPU: compiled as one function with its loops inside.

    XLA's CPU runtime otherwise calls every fused operation of every turn of a loop on its own: a time step of a hundred
    drones is some thirty calls of a few hundred nanoseconds, which is most of its time. XLA does the same by itself for
    loops over less than 1 kB, by marking a call it does not inline; here the mark is set from outside. Nothing else
    depends on it: a compiler that does not know the mark computes the same, slower.

    Only for what moves little: within such a function XLA copies an array of which a slice is updated together with
    others (pack what a loop keeps of every turn into one array), and a matrix product is a plain loop.

    Args:
        function: its result must depend on every argument, also after the compiler has simplified it: jaxlib 0.10.1
            aborts where a marked call ignores one.
        arrays: its arguments.
    """

    def inner(*arrays):
        # Calls within inherit the mark unless told otherwise, and then are not inlined either.
        with set_xla_metadata(xla_cpu_small_call="false", inlineable="true"):
            return function(*arrays)

    # A constant would be taken into the function, which then ignores the argument.
    arrays = jax.lax.optimization_barrier(arrays)
    with set_xla_metadata(xla_cpu_small_call="true", inlineable="false"):
        return jax.jit(inner)(*arrays)
