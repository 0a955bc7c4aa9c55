"""A batch worked off a few examples at a time, each group in one compiled function."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
from jaxtyping import Array

from cfb_mjx.engine.cpu_kernel import one_kernel

LANES = 128
"""Examples in a group. A derivative's numbers of one step must fit into the nearest cache, and the start of a kernel be
little beside its work: from 64 to 256 speed is within a fifth."""

PACKED_BYTES = 2**17
"""Most of what is put together as one array within a kernel. An operation that reads and writes 512 kB is divided
between threads by XLA, which jaxlib 0.10.1 cannot do there."""


def grouped(
    function: Callable[..., Sequence[Array]], arrays: Sequence[Array], batched: Sequence[bool], size: int
) -> list[Array]:
    """``function(*arrays)`` for a function that treats every example alike.

    Args:
        function: takes the arrays of some examples and returns arrays; the last axis is the example, of the results and
            of the arguments that are ``batched``.
        arrays: arguments of one dtype, (..., size) where ``batched``.
        batched: which of them differ between examples; at least one.
        size: number of examples.

    Returns:
        The results, (..., size).
    """
    groups = -(-size // LANES)
    # Whole vector registers; with one group no filling up.
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
        # For `one_kernel`: whatever the function ignores, the kernel does not.
        used = own[:1] + (shared[0] if shared.size else 0)
        rows = [x.reshape(-1, lanes) for x in found]
        # What is alone may be large: it is returned as a loop wrote it.
        return [rows[p[0]] if len(p) == 1 else jnp.concatenate([rows[i] for i in p]) for p in packs] + [used]

    # Few arrays in and out: what a kernel is given and gives is work for its caller.
    own = jnp.concatenate([x.reshape(-1, size) for x, b in zip(arrays, batched, strict=True) if b])
    shared = [x.reshape(-1) for x, b in zip(arrays, batched, strict=True) if not b]
    shared = [jnp.concatenate(shared)] if shared else []
    if groups == 1:
        found = one_kernel(one, own, *shared)
    else:
        # A group is every so-manieth example: where the batch is divided over devices, so is every group.
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
    """Neighbours among things of these sizes, as many together as `PACKED_BYTES` allow."""
    packs: list[list[int]] = []
    total = 0
    for i, size in enumerate(sizes):
        if not packs or total + size > PACKED_BYTES:
            packs.append([])
            total = 0
        packs[-1].append(i)
        total += size
    return packs
