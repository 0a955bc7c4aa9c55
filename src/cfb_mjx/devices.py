"""Divide work over the devices of this process, or of several processes that run as one (`cfb_mjx.hosts`).

The work is always a batch: drones, windows, segments of flights. Each device runs the program for its share of the
batch (`jax.shard_map`). The compiler divides a program for the whole batch only where that is mostly matrix products
and sums.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import islice
from typing import Any, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.flatten_util import ravel_pytree
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from cfb_mjx.errors import CfbError
from cfb_mjx.runtime import cores

AXIS = "devices"


def over_cores(function: Callable[[Any], Any], items: Iterable[Any]) -> Iterator[Any]:
    """Yield ``map(function, items)``, computed in parallel on all cores, for compiled programs that use one core.

    The first item runs alone, so that its programs are compiled once. At most as many others run as there are cores.

    Args:
        function: function of one item.
        items: inputs.
    """
    items = iter(items)
    yield from map(function, islice(items, 1))
    if cores() == 1:
        yield from map(function, items)
        return
    # A context manager may have set this for one thread; the other threads need it too.
    x64 = bool(cast(Any, jax.config).jax_enable_x64)

    def alike(item: Any) -> Any:
        with jax.enable_x64(x64):
            return function(item)

    with ThreadPoolExecutor(cores()) as threads:
        waiting: deque[Future] = deque()
        for item in items:
            waiting.append(threads.submit(alike, item))
            if len(waiting) == cores():
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()


@dataclass(frozen=True)
class Devices:
    """Devices that share a batch. All processes must call methods that place or fetch arrays, in the same order."""

    mesh: Mesh

    @classmethod
    def take(cls, count: int = 1) -> Devices:
        """Return the first ``count`` devices of this process, or of every process if several run as one.

        Raises:
            CfbError: there are fewer devices.
        """
        if count < 1:
            raise CfbError(f"--devices must be at least 1, found {count}.")
        if count > jax.local_device_count():
            raise CfbError(f"--devices {count}: only {jax.local_device_count()} are available; give a smaller number.")
        chosen = [d for process in range(jax.process_count()) for d in jax.local_devices(process)[:count]]
        return cls(Mesh(np.array(chosen), (AXIS,)))

    @property
    def count(self) -> int:
        """Number of devices of all processes together."""
        return self.mesh.size

    @property
    def several(self) -> bool:
        """Whether there is more than one device."""
        return self.count > 1

    def require(self, examples: int, what: str) -> None:
        """Refuse a batch that cannot be divided evenly.

        Args:
            examples: size of the batch.
            what: name of the examples in the message.

        Raises:
            CfbError: the batch cannot be divided evenly.
        """
        if examples % self.count:
            raise CfbError(
                f"{examples} {what} cannot be divided evenly over {self.count} devices; change one of the numbers."
            )

    def along(self, tree: Any, axis: int = 0) -> Any:
        """Return ``tree`` with one axis of every array divided over the devices.

        Within a compiled function this constrains the sharding of the arrays, elsewhere it places them. The length of
        the axis must be a multiple of `count`: see `require` and `padded`.

        Args:
            tree: pytree of whole arrays, the same in every process.
            axis: axis to divide.
        """
        return self._as(tree, _spec(axis))

    def whole(self, tree: Any) -> Any:
        """Return ``tree`` with every array on every device, within a compiled function or outside."""
        return self._as(tree, PartitionSpec())

    def here(self, tree: Any) -> Any:
        """Return divided arrays as whole numpy arrays, in every process."""
        arrays, rest = eqx.partition(tree, eqx.is_array)
        if any(not x.is_fully_addressable and not x.is_fully_replicated for x in jax.tree.leaves(arrays)):
            arrays = jax.jit(lambda x: x, out_shardings=NamedSharding(self.mesh, PartitionSpec()))(arrays)
        return eqx.combine(jax.tree.map(np.asarray, arrays), rest)

    def padded(self, tree: Any) -> Any:
        """Return ``tree`` as numpy arrays, with the last example repeated until the leading axis can be divided."""
        return jax.tree.map(lambda x: last_repeated(x, -(-len(x) // self.count) * self.count), tree)

    def divided(self, function: Callable, in_axes: tuple, out_axes: Any) -> Callable:
        """Return ``function`` with its work divided over the devices.

        Args:
            function: function of pytrees of arrays that treats examples independently, but for `total`.
            in_axes: axis to divide of every argument; None for arguments that every device gets whole.
            out_axes: the same for the results, a pytree prefix; None for results that are the same on every device.

        Returns:
            A function with the same arguments and results, to be called within a compiled function.
        """
        if not self.several:
            return function

        def call(*arguments):
            arrays, rest = eqx.partition(arguments, eqx.is_array)
            shared = jax.shard_map(
                lambda *x: function(*eqx.combine(self._together(x), rest)),
                mesh=self.mesh,
                in_specs=tuple(map(_spec, in_axes)),
                out_specs=jax.tree.map(_spec, out_axes, is_leaf=lambda axis: axis is None),
                # The check rejects scans that begin with constants.
                check_vma=False,
            )
            return shared(*arrays)

        return call

    def own(self, x: Any) -> Any:
        """Within `divided`: this device's rows of an array that every device holds."""
        if not self.several:
            return x
        length = len(x) // self.count
        return jax.lax.dynamic_slice_in_dim(x, jax.lax.axis_index(AXIS) * length, length)

    def total(self, tree: Any) -> Any:
        """Within `divided`: the sum of every array over the devices, in one exchange."""
        if not self.several:
            return tree
        numbers, unravel = ravel_pytree(tree)
        return unravel(jax.lax.psum(numbers, AXIS))

    def mapped(self, function: Callable) -> Callable:
        """Return ``jax.vmap(function)`` with the examples divided over the devices; the caller compiles it."""
        batched = jax.vmap(function)

        def call(*arguments):
            return self.divided(batched, (0,) * len(arguments), 0)(*arguments)

        return call

    def shared(self, batch: Any) -> Any:
        """Place a batch on these devices and set its field ``over`` (an `equinox.Module`), for `mapped`."""
        if not self.several:
            return batch
        return replace(self.along(self.padded(batch)), over=self)

    def _together(self, arrays: Any) -> Any:
        """Return the arrays after a collective operation that does not change them.

        XLA's CPU client runs programs without communication one after the other on one thread, and programs with
        communication in parallel.
        """
        if self.mesh.devices.flat[0].platform != "cpu":
            return arrays
        leaves, structure = jax.tree.flatten(arrays)
        never = jax.lax.psum(jax.lax.axis_index(AXIS), AXIS) < 0
        return jax.tree.unflatten(structure, [*leaves[:-1], jnp.where(never, jnp.zeros_like(leaves[-1]), leaves[-1])])

    def _as(self, tree: Any, spec: PartitionSpec) -> Any:
        if not self.several:
            return tree
        sharding = NamedSharding(self.mesh, spec)
        return jax.tree.map(lambda x: _placed(x, sharding) if eqx.is_array_like(x) else x, tree)


def mapped(function: Callable, over: Devices | None) -> Callable:
    """Return ``jax.vmap(function)``, divided over the devices ``over`` unless that is None."""
    return jax.vmap(function) if over is None else over.mapped(function)


def _spec(axis: int | None) -> PartitionSpec:
    return PartitionSpec() if axis is None else PartitionSpec(*[None] * axis, AXIS)


def _placed(x: Any, sharding: NamedSharding) -> Any:
    if isinstance(x, Tracer):
        return jax.lax.with_sharding_constraint(x, sharding)
    if isinstance(x, jax.Array) and jnp.issubdtype(x.dtype, jax.dtypes.prng_key):
        data = _placed(jax.random.key_data(x), sharding)
        return jax.random.wrap_key_data(data, impl=jax.random.key_impl(x))
    if sharding.is_fully_addressable:
        return jax.device_put(x, sharding)
    # device_put would communicate to check that all processes have the same array.
    held = np.asarray(x)
    return jax.make_array_from_callback(held.shape, sharding, lambda index: held[index])


def last_repeated(x: Any, count: int) -> np.ndarray:
    """Return ``x`` with its last row repeated, up to ``count`` rows."""
    x = np.asarray(x)
    return np.concatenate([x, np.repeat(x[-1:], count - len(x), axis=0)])
