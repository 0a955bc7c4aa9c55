"""Random numbers for many examples, each from a key of its own: those of `jax.random`, drawn faster on CPUs.

There ``jax.vmap`` of `jax.random` spends most of its time on loops over the few numbers of one key. Here all numbers of
a batch pass through one long loop, which a CPU computes sixteen at a time.
"""

from __future__ import annotations

import math
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray, UInt32

from cfb_mjx.engine.batching import one_of_many
from cfb_mjx.engine.cpu_kernel import apart

_ROTATIONS = ((13, 15, 26, 6), (17, 29, 16, 24))
_PARITY = 0x1BD11BDA


def normal(key: PRNGKeyArray, shape: tuple[int, ...] = (), dtype=jnp.float32) -> Float[Array, "..."]:
    """``jax.random.normal(key, shape, dtype)``, the same numbers.

    Args:
        key: key of one example.
        shape: shape of the result for one example.
        dtype: floating dtype.
    """
    raw = jnp.issubdtype(key.dtype, jnp.uint32) and key.shape == (2,)
    # jax adds these as it loads.
    settings = cast(Any, jax.config)
    threefry = settings.jax_default_prng_impl == "threefry2x32" and settings.jax_threefry_partitionable
    if not (raw and threefry and jnp.dtype(dtype) == jnp.float32 and jax.default_backend() == "cpu"):
        return jax.random.normal(key, shape, dtype)
    count = math.prod(shape)

    def together(own: tuple[bool, ...], keys: Array) -> list[Array]:
        bits = apart(lambda: jax.vmap(lambda key: _bits(key, count))(keys).reshape(-1))
        return [apart(lambda: _normal_of(bits)).reshape(-1, *shape)]

    return one_of_many(together)(key)[0]


def _bits(key: UInt32[Array, "2"], count: int) -> UInt32[Array, " count"]:
    """``jax.random.bits(key, (count,))``: Threefry-2x32 with 20 rounds (Salmon et al. 2011), written out."""
    at = jnp.arange(count, dtype=jnp.uint32)
    parts = (key[0], key[1], key[0] ^ key[1] ^ jnp.uint32(_PARITY))
    high, low = jnp.zeros_like(at) + parts[0], at + parts[1]
    for block in range(5):
        for distance in _ROTATIONS[block % 2]:
            high = high + low
            low = high ^ ((low << jnp.uint32(distance)) | (low >> jnp.uint32(32 - distance)))
        high = high + parts[(block + 1) % 3]
        low = low + parts[(block + 2) % 3] + jnp.uint32(block + 1)
    return high ^ low


def _normal_of(bits: UInt32[Array, " n"]) -> Float[Array, " n"]:
    """What `jax.random.normal` makes of random bits."""
    one, lowest = np.float32(1), np.nextafter(np.float32(-1), np.float32(0))
    from_zero = jax.lax.bitcast_convert_type((bits >> jnp.uint32(9)) | jnp.uint32(0x3F800000), jnp.float32) - one
    return np.float32(np.sqrt(2)) * jax.lax.erf_inv(jnp.maximum(lowest, from_zero * (one - lowest) + lowest))
