"""The parts of Brax that are used here, and a fix that makes its own PPO run on this version of JAX.

The fix does nothing once Brax no longer needs it.
"""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Iterator
from types import SimpleNamespace

import jax
import jax.numpy as jnp

from cfb_mjx.quiet import quietly


def parts() -> SimpleNamespace:
    """Return ``losses``, ``networks``, ``distribution`` and ``types`` of Brax's PPO."""
    with quietly():
        from brax.training import distribution, types
        from brax.training.agents.ppo import losses, networks
    return SimpleNamespace(losses=losses, networks=networks, distribution=distribution, types=types)


@contextlib.contextmanager
def brax_ppo() -> Iterator:
    """Yield ``brax.training.agents.ppo.train.train`` in a working state.

    Brax 0.14.2 calls ``jax.device_put_replicated``, which jax 0.10 has removed (google/brax issue 671). During the
    block jax has a function of that name again; if jax still has its own, nothing is changed.
    """
    with quietly():
        from brax.training.agents.ppo import train

    if _has_it():
        yield train.train
        return
    jax.device_put_replicated = _replicated
    try:
        yield train.train
    finally:
        del jax.device_put_replicated


def _has_it() -> bool:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return callable(jax.device_put_replicated)
    except AttributeError:
        return False


def _replicated(tree, devices):
    """Copy ``tree`` to every device, along a new leading axis that is spread over the devices."""
    mesh = jax.sharding.Mesh(devices, ("device",))
    spread = jax.sharding.NamedSharding(mesh, jax.sharding.PartitionSpec("device"))
    return jax.tree.map(
        lambda x: jax.device_put(jnp.broadcast_to(jnp.asarray(x), (len(devices), *jnp.shape(x))), spread), tree
    )
