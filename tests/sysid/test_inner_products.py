"""Inner products of whitened residuals, block by block, however the blocks come."""

from __future__ import annotations

import weakref
from collections.abc import Iterator

import jax.numpy as jnp
import numpy as np
import pytest

from cfb_mjx.sysid.flight import ROWS
from cfb_mjx.sysid.tracing.innovations import CHANNELS, FIRST, inner_products, innovations, levels_from
from cfb_mjx.sysid.tracing.signals import Blocks, Signals, joined

NOISE = {"gyro": np.full(3, 0.02), "velocity": 0.01, "rotor": 5.0, "accelerometer": 0.1}


def drawn(count: int, columns: int, seed: int) -> Blocks:
    """Noise in some blocks, the first of which has rows that do not count."""
    random = np.random.default_rng(seed)
    # The columns come first in memory, as replays return them.
    signals = (np.moveaxis(random.normal(size=(columns, count, ROWS, wide)), 0, -1) for wide in (CHANNELS, 3))
    valid = np.ones((count, ROWS, CHANNELS))
    valid[0, :100] = 0.0
    return Blocks(Signals(*signals), np.full((count, ROWS), 0.002), valid)


@pytest.mark.parametrize("columns", [1, 16, 37])
def test_inner_products_are_those_of_all_blocks_at_once(columns):
    """Twelve blocks of three groups of columns are more than a batch, and the last batch is not full."""
    levels = levels_from(jnp.asarray(FIRST), NOISE)
    pieces = [drawn(count, columns, seed) for seed, count in enumerate((5, 1, 6))]
    error = np.asarray(innovations(joined(pieces), levels)[0]).reshape(12, -1, columns)
    wanted = np.einsum("bri,brj->bij", error, error)
    found = inner_products(iter(pieces), levels)
    np.testing.assert_allclose(found, wanted, rtol=1e-9, atol=1e-9 * np.abs(wanted).max())


def test_few_pieces_are_held_at_a_time():
    """Two batches of the filter are 16 pieces of 4 blocks."""
    alive: list[weakref.ref] = []
    most = 0

    def pieces() -> Iterator[Blocks]:
        nonlocal most
        for seed in range(50):
            most = max(most, sum(there() is not None for there in alive))
            piece = drawn(4, 2, seed)
            alive.append(weakref.ref(piece.interval))
            yield piece

    assert len(inner_products(pieces(), levels_from(jnp.asarray(FIRST), NOISE))) == 200
    assert most < 25
