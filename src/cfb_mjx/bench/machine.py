"""Measure the limits of this machine with small loops: multiply-adds, tanh, and memory access."""

from __future__ import annotations

import time
from typing import NamedTuple

import jax
import jax.numpy as jnp

IN_CACHE, IN_MEMORY = 4096, 2**25
"""Sizes of an array that stays in the fastest cache of a core, and of one that fits into no cache."""
_CHAINS, _LONG, _TURNS = 4, 32, 400


class Peaks(NamedTuple):
    """Rates per second that XLA programs reach in float32."""

    plain: float
    """Additions and multiplications."""
    transcendental: float
    """Evaluations of tanh."""
    cache: float
    """Bytes of a triad (a = b + s c) on arrays of `IN_CACHE` numbers."""
    memory: float
    """Bytes of a triad on arrays of `IN_MEMORY` numbers."""


def peaks(repetitions: int = 5) -> Peaks:
    """Measure this machine."""
    return Peaks(
        _rate(_multiply_adds, 2.0 * IN_CACHE * _CHAINS * _LONG * _TURNS, repetitions),
        _rate(_tangents, 1.0 * IN_CACHE * _TURNS, repetitions),
        _rate(_triads, 12.0 * IN_CACHE * _TURNS, repetitions),
        _rate(_triad, 12.0 * IN_MEMORY, repetitions, 2 * IN_MEMORY),
    )


def _rate(function, amount: float, repetitions: int, size: int = IN_CACHE) -> float:
    x = 1.0 + 1e-3 * jnp.arange(size, dtype=jnp.float32) / size
    compiled = jax.jit(function).lower(x).compile()
    jax.block_until_ready(compiled(x))
    best = float("inf")
    for _ in range(repetitions):
        begin = time.perf_counter()
        jax.block_until_ready(compiled(x))
        best = min(best, time.perf_counter() - begin)
    return amount / best


def _multiply_adds(x):
    # One pass over the array with much work per number, in parallel chains, so that no multiply-add waits.
    def turn(_, x):
        chains = [x * (1 + 0.1 * i) for i in range(_CHAINS)]
        for _ in range(_LONG):
            chains = [0.5 * c + x for c in chains]
        return sum(chains) / (2 * _CHAINS)

    return jax.lax.fori_loop(0, _TURNS, turn, x)


def _tangents(x):
    return jax.lax.fori_loop(0, _TURNS, lambda _, y: jnp.tanh(y) + 0.5, x)


def _triads(x):
    return jax.lax.fori_loop(0, _TURNS, lambda _, pair: (pair[1], pair[0] + 0.5 * pair[1]), (x, x + 1))


def _triad(x):
    a, b = x.reshape(2, -1)
    return a + 0.5 * b
