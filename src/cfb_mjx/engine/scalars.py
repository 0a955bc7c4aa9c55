"""Evaluate a function of small arrays one number at a time.

GPU registers hold numbers, and a kernel language such as Triton's has no arrays of three. This module therefore
evaluates JAX's trace of a function again with every array taken apart. Operations that only move numbers (slices,
stacks, reshapes) happen in Python; computations are done number by number. A number may itself be a block of drones. So
the code that flies one drone in plain JAX also serves inside a kernel, without a second version.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import ShapedArray
from jax.extend.core import ClosedJaxpr, Literal  # pyright: ignore[reportPrivateImportUsage]  # jax 0.12 hides it

_ELEMENTWISE = """
    abs add and ceil clamp convert_element_type cos div eq exp expm1 floor ge gt integer_pow is_finite le log log1p lt
    max min mul ne neg not or pow rsqrt select_n sign sin sqrt square sub tan tanh
"""
ELEMENTWISE = frozenset(_ELEMENTWISE.split())
"""Operations that exist in Triton's language as well as in JAX's; all have one result."""
CALLS = frozenset(("jit", "pjit", "closed_call", "custom_jvp_call"))


def _broadcast(array: np.ndarray, shape, broadcast_dimensions, **_) -> np.ndarray:
    placed = [1] * len(shape)
    for dimension, size in zip(broadcast_dimensions, array.shape, strict=True):
        placed[dimension] = size
    return np.broadcast_to(array.reshape(placed), shape)


def _slice(array: np.ndarray, start_indices, limit_indices, strides) -> np.ndarray:
    strides = strides or (1,) * array.ndim
    return array[tuple(slice(*which) for which in zip(start_indices, limit_indices, strides, strict=True))]


def _sum(array: np.ndarray, axes, **_) -> np.ndarray:
    first = np.moveaxis(array, axes, range(len(axes)))
    kept = first.shape[len(axes) :]
    # The extra axis keeps every row an array: NumPy would return a sum of all numbers as a scalar.
    rows = first.reshape(-1, 1, *kept)
    total = rows[0]
    for row in rows[1:]:
        total = total + row
    return total.reshape(kept)


def _unstack(array: np.ndarray, axis: int) -> tuple[np.ndarray, ...]:
    rows = np.moveaxis(array, axis, 0)
    # A slice remains an array; indexing a row of one number would not.
    return tuple(rows[i : i + 1].reshape(rows.shape[1:]) for i in range(len(rows)))


MOVES: dict[str, Callable[..., np.ndarray | tuple[np.ndarray, ...]]] = {
    "broadcast_in_dim": _broadcast,
    "concatenate": lambda *arrays, dimension: np.concatenate(arrays, axis=dimension),
    "copy": lambda array: array,
    # Barriers keep XLA from computing things twice; the compiler of a kernel finds common subexpressions by itself.
    "optimization_barrier": lambda *arrays: arrays,
    "reduce_sum": _sum,
    "reshape": lambda array, new_sizes, **_: array.reshape(new_sizes),
    "slice": _slice,
    "squeeze": lambda array, dimensions: array.squeeze(dimensions),
    "stack": lambda *arrays, axis: np.stack(arrays, axis=axis),
    "transpose": lambda array, permutation: array.transpose(permutation),
    "unstack": _unstack,
}
"""Operations that move numbers, or add them up, on arrays of objects."""


@dataclass(frozen=True)
class Program:
    """A traced function of arrays that consists of known operations."""

    traced: ClosedJaxpr
    used: tuple[bool, ...]
    """Whether the results depend on each argument."""

    def __call__(self, *arguments: np.ndarray | None) -> list[np.ndarray]:
        """Evaluate with arrays of numbers; arguments that are not used may be None."""
        return _run(self.traced.jaxpr, self.traced.consts, arguments)


def trace(function: Callable, *examples: Any, elementwise: frozenset[str] = ELEMENTWISE) -> Program | None:
    """Return the program of ``function``, or None if it contains unknown operations.

    Args:
        function: function of arrays that returns a sequence of arrays and closes over no traced values.
        examples: arrays or `jax.ShapeDtypeStruct`, one per argument.
        elementwise: known operations besides `MOVES`.
    """
    traced = jax.make_jaxpr(function)(*examples)
    if not consists_of(traced.jaxpr, elementwise):
        return None
    needed = _needed(traced.jaxpr)[1]
    return Program(traced, tuple(v in needed for v in traced.jaxpr.invars))


def shaped(shape: tuple[int, ...], numbers: Iterable) -> np.ndarray:
    """An array of objects that holds ``numbers`` unchanged: NumPy's constructors would convert them."""
    array = np.empty(shape, object)
    for index, number in zip(np.ndindex(shape), numbers, strict=True):
        array[index] = number
    return array


def apart(array, shape: tuple[int, ...]) -> np.ndarray:
    """Split ``array`` along its first axes, of this ``shape``, into an array of its entries."""
    return shaped(shape, (array[index] for index in np.ndindex(shape)))


def changed_by(program: Program, moved: Sequence[int]) -> list[bool]:
    """Which results may change if the arguments with indices ``moved`` change."""
    jaxpr = program.traced.jaxpr
    touched = {jaxpr.invars[i] for i in moved}
    for equation in jaxpr.eqns:
        if any(v in touched for v in equation.invars if not isinstance(v, Literal)):
            touched.update(equation.outvars)
    return [not isinstance(v, Literal) and v in touched for v in jaxpr.outvars]


def used(function: Callable, arguments: Sequence) -> list[bool]:
    """Which of ``arguments`` the result of ``function(arguments)`` depends on."""
    jaxpr = jax.make_jaxpr(lambda *arguments: function(list(arguments)))(*arguments).jaxpr
    needed = _needed(jaxpr)[1]
    return [v in needed for v in jaxpr.invars]


def _inner(equation) -> ClosedJaxpr:
    return equation.params["call_jaxpr" if "call_jaxpr" in equation.params else "jaxpr"]


def consists_of(jaxpr, elementwise: frozenset[str]) -> bool:
    """Whether everything the results depend on is a call, one of `MOVES`, or one of these operations."""
    for equation in _needed(jaxpr)[0]:
        name = equation.primitive.name
        if name in CALLS:
            if not consists_of(_inner(equation).jaxpr, elementwise):
                return False
        elif name not in elementwise and name not in MOVES:
            return False
    return True


def _needed(jaxpr) -> tuple[list, set]:
    """The equations on which the results depend, in order, and all variables they read."""
    needed, kept = {v for v in jaxpr.outvars if not isinstance(v, Literal)}, []
    for equation in reversed(jaxpr.eqns):
        if needed.intersection(equation.outvars):
            kept.append(equation)
            needed.update(v for v in equation.invars if not isinstance(v, Literal))
    return kept[::-1], needed


def _run(jaxpr, constants, arguments) -> list[np.ndarray]:
    values = dict(zip(jaxpr.constvars, map(_numbers, constants), strict=True))
    values.update(zip(jaxpr.invars, arguments, strict=True))

    def read(atom) -> np.ndarray:
        if not isinstance(atom, Literal):
            return values[atom]
        return _numbers(np.asarray(atom.val, cast(ShapedArray, atom.aval).dtype))

    for equation in _needed(jaxpr)[0]:
        name, inputs = equation.primitive.name, [read(atom) for atom in equation.invars]
        if name in CALLS:
            inner = _inner(equation)
            results = _run(inner.jaxpr, inner.consts, inputs)
        elif name in MOVES:
            results = MOVES[name](*inputs, **equation.params)
            results = results if isinstance(results, tuple) else (results,)
        else:
            results = (_each(equation, inputs),)
        values.update(zip(equation.outvars, results, strict=True))
    return [read(atom) for atom in jaxpr.outvars]


def _numbers(array) -> np.ndarray:
    """Convert an array to NumPy scalars, which can be written into a kernel where arrays cannot."""
    array = np.asarray(array)
    return apart(array, array.shape)


def _each(equation, inputs: Sequence[np.ndarray]) -> np.ndarray:
    shape = equation.outvars[0].aval.shape
    inputs = [np.broadcast_to(array, shape) for array in inputs]
    results = np.empty(shape, object)
    for index in np.ndindex(shape):
        numbers = [array[index] for array in inputs]
        block = np.broadcast_shapes(*map(np.shape, numbers))
        alike = [x if np.shape(x) == block else jnp.broadcast_to(x, block) for x in numbers]
        results[index] = equation.primitive.bind(*alike, **equation.params)
    return results
