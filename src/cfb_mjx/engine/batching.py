"""Turn functions of many examples into functions of one example that JAX can transform.

Large batches are computed a few examples at a time, each group in one compiled function.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
from jax.custom_batching import custom_vmap
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array

from cfb_mjx.engine.cpu_kernel import one_kernel


def one_of_many(together: Callable) -> Callable:
    """Return the function of one example whose ``vmap``, also nested, is ``together``.

    Args:
        together: called as ``together(own, *leaves)``. ``own`` marks the leaves that have a leading axis of examples
            (at least one has; the others are the same for all examples). Returns a list of arrays with that axis.

    Returns:
        A function of leaves without that axis; it returns a list of arrays without it.
    """

    @custom_vmap
    def one(*leaves):
        single = _over(together, (True,) * len(leaves))
        return [x[0] for x in single(*(x[None] for x in leaves))]

    @one.def_vmap
    def many(size, own, *leaves):
        results = _over(together, tuple(own))(*leaves)
        return results, [True] * len(results)

    return one


def _over(together: Callable, own: tuple[bool, ...]) -> Callable:
    @custom_vmap
    def many(*leaves):
        return together(own, *leaves)

    @many.def_vmap
    def more(size, outer, *leaves):
        """Merge two axes of examples into one."""
        inner = examples(own, [x[0] if o else x for x, o in zip(leaves, outer, strict=True)])

        def merged(x, o, mine):
            if not (o or mine):
                return x
            x = x if o else x[None]
            x = x if mine else x[:, None]
            return jnp.broadcast_to(x, (size, inner, *x.shape[2:])).reshape(size * inner, *x.shape[2:])

        both = tuple(o or mine for o, mine in zip(outer, own, strict=True))
        results = _over(together, both)(*map(merged, leaves, outer, own))
        return [x.reshape(size, inner, *x.shape[1:]) for x in results], [True] * len(results)

    return many


def examples(own: tuple[bool, ...], leaves) -> int:
    """Number of examples: the length of the leading axis of the leaves that are ``own``."""
    return next(x.shape[0] for x, mine in zip(leaves, own, strict=True) if mine)


def axes(own: tuple[bool, ...]) -> tuple[int | None, ...]:
    """``in_axes`` for a `jax.vmap` over the leaves that are ``own``."""
    return tuple(0 if mine else None for mine in own)


def differentiated_as(function: Callable, plain: Callable) -> Callable:
    """``function`` with the derivatives of ``plain``, of all orders and in both modes."""
    outer = jax.custom_jvp(function)

    # Constant arguments stay out of the tangents: otherwise every gradient would cost as much as one by all leaves.
    @functools.partial(outer.defjvp, symbolic_zeros=True)
    def rule(leaves, tangents):
        moving = [i for i, tangent in enumerate(tangents) if not isinstance(tangent, SymbolicZero)]

        def along(*moved):
            filled = list(leaves)
            for i, x in zip(moving, moved, strict=True):
                filled[i] = x
            return plain(*filled)

        return jax.jvp(along, [leaves[i] for i in moving], [tangents[i] for i in moving])

    return outer


MANY = 8192
"""Fewest examples per call of `for_some` on a GPU."""


def for_some(function: Callable[..., Sequence], needed: Array, leaves: Sequence, block: int) -> list:
    """``function(True, *leaves)`` where it is needed, and zeros elsewhere, computed for the examples that need it.

    Under ``vmap``, also nested, these are gathered and computed a block at a time, so that the cost is in proportion to
    their number; without any there is none. Forward-mode derivatives of all orders are computed in the same way.

    Args:
        function: from a flag and arrays to a sequence of arrays. Where the flag is False, the example only fills a
            block, and its results are not used. It must not close over arrays that are being traced.
        needed: whether the results are needed; for one example, as the leaves.
        leaves: arguments of the function.
        block: number of examples per call on a CPU; elsewhere at least `MANY`, and a quarter of them.
    """

    def together(own: tuple[bool, ...], needed: Array, *leaves: Array) -> list[Array]:
        size, own = examples(own, (needed, *leaves)), own[1:]
        needed = jnp.broadcast_to(needed, (size,))
        # Other devices than a CPU take as long for few examples as for many: a few blocks for all of them.
        width = min(block if jax.default_backend() == "cpu" else max(block, MANY, -(-size // 4)), size)
        one = [x[0] if mine else x for x, mine in zip(leaves, own, strict=True)]
        shapes = jax.eval_shape(function, jnp.asarray(True), *one)
        every = jax.vmap(function, in_axes=(0, *axes(own)), axis_size=width)

        def compute() -> list[Array]:
            rank = jnp.cumsum(needed)
            count = rank[-1]

            def some(at: Array, found: list[Array]) -> tuple[Array, list[Array]]:
                ranks = at + jnp.arange(1, width + 1)
                # Blocks are filled with their first example, whose work is being done anyway.
                real = ranks <= count
                index = jnp.searchsorted(rank, jnp.where(real, ranks, at + 1))
                now = every(real, *(x[index] if mine else x for x, mine in zip(leaves, own, strict=True)))
                put = jax.lax.dynamic_update_slice_in_dim
                return at + width, [put(x, y, at, 0) for x, y in zip(found, now, strict=True)]

            room = -(-size // width) * width
            start = jnp.zeros_like(count), [jnp.zeros((room, *x.shape), x.dtype) for x in shapes]
            found = jax.lax.while_loop(lambda c: c[0] < count, lambda c: some(*c), start)[1]
            place = jnp.maximum(rank - 1, 0)
            return [jnp.where(needed.reshape(size, *(1,) * (x.ndim - 1)), x[place], 0) for x in found]

        nothing = [jnp.zeros((size, *x.shape), x.dtype) for x in shapes]
        return jax.lax.cond(jnp.any(needed), compute, lambda: nothing)

    outer = jax.custom_jvp(one_of_many(together))

    @functools.partial(outer.defjvp, symbolic_zeros=True)
    def rule(given, tangents):
        needed, *leaves = given
        moving = [i for i, tangent in enumerate(tangents[1:]) if not isinstance(tangent, SymbolicZero)]
        count = len(leaves)

        def pushed(real, *both):
            def along(*moved):
                filled = list(both[:count])
                for i, x in zip(moving, moved, strict=True):
                    filled[i] = x
                return list(function(real, *filled))

            return jax.jvp(along, [both[i] for i in moving], list(both[count:]))[1]

        # Apart from the tangents, of which `jax.jacfwd` has many for one result.
        found = outer(*given)
        return found, for_some(pushed, needed, [*leaves, *(tangents[i + 1] for i in moving)], block)

    return outer(needed, *leaves)


LANES = 128
"""Examples per group. The numbers of one step of a derivative must fit into the nearest cache, and the start of a
kernel must be short compared with its work. From 64 to 256 the speed is within a fifth."""

PACKED_BYTES = 2**17
"""Largest array that is packed within a kernel, in bytes. XLA divides an operation that reads and writes 512 kB between
threads, which jaxlib 0.10.1 cannot do within a kernel."""


def grouped(
    function: Callable[..., Sequence[Array]], arrays: Sequence[Array], batched: Sequence[bool], size: int
) -> list[Array]:
    """``function(*arrays)`` for a function that treats all examples alike.

    Args:
        function: function of the arrays of some examples that returns arrays. The last axis of the results and of the
            ``batched`` arguments is the example.
        arrays: arguments of one dtype, (..., size) if ``batched``.
        batched: which arguments differ between examples; at least one.
        size: number of examples.

    Returns:
        The results, (..., size).
    """
    groups = -(-size // LANES)
    # Whole vector registers; a single group needs no padding.
    lanes = size if groups == 1 else 8 * -(-size // (8 * groups))
    shapes = [x.shape[:-1] if b else x.shape for x, b in zip(arrays, batched, strict=True)]
    results: list[tuple[int, ...]] = []
    packs: list[list[int]] = []

    def one(own: Array, *rest: Array) -> list[Array]:
        shared = rest[0] if rest else jnp.zeros(0, own.dtype)
        given, at = [], {True: 0, False: 0}
        for shape, b in zip(shapes, batched, strict=True):
            rows = slice(at[b], at[b] + math.prod(shape))
            given.append(own[rows].reshape(*shape, lanes) if b else shared[rows].reshape(shape))
            at[b] = rows.stop
        found = function(*given)
        results[:] = [x.shape[:-1] for x in found]
        packs[:] = _packs([x.nbytes for x in found])
        # For `one_kernel`: the kernel must use what the function ignores.
        used = own[:1] + (shared[0] if shared.size else 0)
        rows = [x.reshape(-1, lanes) for x in found]
        # An array alone in its pack may be large: it is returned as a loop wrote it.
        return [rows[p[0]] if len(p) == 1 else jnp.concatenate([rows[i] for i in p]) for p in packs] + [used]

    # Few arrays in and out, because each of them is work for the caller of a kernel.
    own = jnp.concatenate([x.reshape(-1, size) for x, b in zip(arrays, batched, strict=True) if b])
    shared = [x.reshape(-1) for x, b in zip(arrays, batched, strict=True) if not b]
    shared = [jnp.concatenate(shared)] if shared else []
    if groups == 1:
        found = one_kernel(one, own, *shared)
    else:
        # A group consists of every so many-th example: if the batch is divided over devices, so is every group.
        own = jnp.pad(own, ((0, 0), (0, groups * lanes - size)), mode="edge")
        own = jnp.moveaxis(own.reshape(-1, lanes, groups), -1, 0)
        found = jax.lax.map(lambda rows: one_kernel(one, rows, *shared), own)
        found = [jnp.moveaxis(x, 0, -1).reshape(x.shape[1], -1)[:, :size] for x in found]
    pieces = []
    for pack, rows in zip(packs, found[:-1], strict=True):
        start = 0
        for shape in (results[i] for i in pack):
            pieces.append(rows[start : start + math.prod(shape)].reshape(*shape, size))
            start += math.prod(shape)
    return pieces


def _packs(sizes: Sequence[int]) -> list[list[int]]:
    """Partition neighbours of these sizes, in bytes, into packs of at most `PACKED_BYTES`."""
    packs: list[list[int]] = []
    total = 0
    for i, size in enumerate(sizes):
        if not packs or total + size > PACKED_BYTES:
            packs.append([])
            total = 0
        packs[-1].append(i)
        total += size
    return packs
