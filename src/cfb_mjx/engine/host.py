"""Functions on the host, of many examples at once, within compiled programs."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from cfb_mjx.engine.batching import one_of_many

PIECE_BYTES = 2**16
"""Largest array that is handed over. Larger ones are copied by another thread of jaxlib, which waits for the
very program that waits for the copy: on a machine with few cores it then waits for ever."""


def on_host(
    function: Callable[[np.ndarray], np.ndarray], width: int, x: Float[Array, " inputs"]
) -> Float[Array, " width"]:
    """Call a function of NumPy arrays on the host; under ``vmap``, also nested, once for all examples.

    Args:
        function: from (examples, inputs) to (examples, width); examples must not influence each other.
        width: number of results per example.
        x: inputs of one example.
    """

    def together(own: tuple[bool, ...], rows: Array) -> list[Array]:
        most = max(1, PIECE_BYTES // (max(rows.shape[1], width) * rows.dtype.itemsize))
        cuts = list(range(most, rows.shape[0], most))
        pieces = jnp.split(rows, cuts)
        results = [jax.ShapeDtypeStruct((len(piece), width), rows.dtype) for piece in pieces]

        def call(*pieces) -> list[np.ndarray]:
            found = function(np.concatenate([np.asarray(piece) for piece in pieces]))
            return np.split(np.asarray(found, rows.dtype), cuts)

        return [jnp.concatenate(jax.pure_callback(call, results, *pieces, vmap_method="sequential"))]

    return one_of_many(together)(x)[0]
