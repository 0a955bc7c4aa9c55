"""Compute a batch a few examples at a time, each group in one compiled function."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
from jaxtyping import Array

from cfb_mjx.engine.cpu_kernel import one_kernel

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
