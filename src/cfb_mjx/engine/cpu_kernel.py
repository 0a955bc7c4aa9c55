"""Let XLA's CPU compiler make one function of a computation, in place of one call per fused operation."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.experimental.xla_metadata import set_xla_metadata
from jaxtyping import Array

from cfb_mjx.engine.scalars import ELEMENTWISE

_MORE = """
    acos acosh and asin asinh atan atan2 atanh cbrt cosh erf erf_inv erfc exp2 logistic rem round shift_left
    shift_right_arithmetic shift_right_logical sinh xor
"""
HELD = ELEMENTWISE | frozenset(_MORE.split())
"""Operations that such a function supports, besides moving and adding numbers. The others are excluded: matrix products
are slow in it, and sorting and loops become functions of their own."""


def one_kernel(function: Callable[..., Any], *arrays: Array) -> Any:
    """``function(*arrays)``, compiled for the CPU as one function with its loops inside.

    XLA's CPU runtime otherwise calls every fused operation in every iteration of a loop separately. A time step of a
    hundred drones is about thirty calls of a few hundred nanoseconds, which is most of its time. XLA merges loops over
    less than 1 kB by itself, by marking a call that it does not inline; this function sets the same mark. Nothing else
    depends on the mark: a compiler that does not know it computes the same, slower.

    Use it only if little data is moved. Within such a function XLA copies an array if a slice of it is updated together
    with others (pack what a loop stores per iteration into one array), and a matrix product is a plain loop.

    Args:
        function: function of arrays. Its result must depend on every argument even after the compiler's
            simplifications: jaxlib 0.10.1 aborts if a marked call ignores one.
        arrays: its arguments.
    """

    def inner(*arrays):
        # Nested calls inherit the mark unless told otherwise, and would not be inlined either.
        with set_xla_metadata(xla_cpu_small_call="false", inlineable="true"):
            return function(*arrays)

    # Otherwise a constant would become part of the function, which then ignores the argument.
    arrays = jax.lax.optimization_barrier(arrays)
    with set_xla_metadata(xla_cpu_small_call="true", inlineable="false"):
        return jax.jit(inner)(*arrays)


def apart(function: Callable[[], Any]) -> Any:
    """``function()`` as arrays that XLA's CPU compiler does not join with what is made of them.

    With `cfb_mjx.runtime.XLA_CPU_FLAGS` it computes a function once for every number of an array that is put together
    from its results: up to a thousand times slower. Barriers and loops of one step are gone before it does that; a
    loop stays whose number of steps it does not know. Without derivatives in reverse mode.

    Args:
        function: function that closes over its arrays.
    """
    nothing = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(function))
    once = jax.lax.optimization_barrier(jnp.asarray(1))
    return jax.lax.while_loop(lambda at: at[0] < once, lambda at: (at[0] + 1, function()), (0, nothing))[1]
