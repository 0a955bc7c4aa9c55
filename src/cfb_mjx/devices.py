"""Work divided over devices: those of this process, or those of several processes that run as one (`cfb_mjx.hosts`).

What is divided is always a batch: drones, windows, segments of flights. Each device runs the program of its own share
(`jax.shard_map`), which is the program one device would run on a smaller batch; dividing a program compiled for the
whole batch is left to the compiler only where it is little more than matrix products and sums.
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
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from cfb_mjx.errors import CfbError
from cfb_mjx.runtime import cores

AXIS = "devices"


def over_cores(function: Callable[[Any], Any], items: Iterable[Any]) -> Iterator[Any]:
    """``map(function, items)``, several at a time, each on a core: for compiled programs that use one.

    The first goes alone, so that what it compiles is compiled once; of the rest no more are begun than there are cores.
    """
    items = iter(items)
    yield from map(function, islice(items, 1))
    if cores() == 1:
        yield from map(function, items)
        return
    # Set for a thread by a context, this would not hold in others.
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
    """Devices that share a batch. Methods that place or fetch are called by every process, in the same order."""

    mesh: Mesh

    @classmethod
    def take(cls, count: int = 1) -> Devices:
        """The first ``count`` devices of this process, or of every process where several run as one.

        Raises:
            CfbError: there are fewer.
        """
        if count < 1:
            raise CfbError(f"--devices must be at least 1, found {count}.")
        if count > jax.local_device_count():
            raise CfbError(f"{count} devices were asked for, {jax.local_device_count()} are here; ask for fewer.")
        chosen = [d for process in range(jax.process_count()) for d in jax.local_devices(process)[:count]]
        return cls(Mesh(np.array(chosen), (AXIS,)))

    @property
    def count(self) -> int:
        """Of all processes together."""
        return self.mesh.size

    @property
    def several(self) -> bool:
        """Whether there is anything to divide."""
        return self.count > 1

    def require(self, examples: int, what: str) -> None:
        """Refuse a batch that cannot be divided evenly.

        Raises:
            CfbError: naming ``what`` there are so many of.
        """
        if examples % self.count:
            raise CfbError(
                f"{examples} {what} cannot be spread over {self.count} devices evenly; change how many they are."
            )

    def along(self, tree: Any, axis: int = 0) -> Any:
        """``tree`` with this axis of every array divided; every process gives the same whole arrays.

        Within a compiled function the arrays are asked to be divided so; outside of one they are placed so. The axis
        must divide by `count`: see `require` and `padded`.
        """
        return self._as(tree, _spec(axis))

    def whole(self, tree: Any) -> Any:
        """``tree`` with every array on every device; as `along`, within a compiled function or outside."""
        return self._as(tree, PartitionSpec())

    def here(self, tree: Any) -> Any:
        """The whole of divided arrays as numpy arrays, in every process."""
        arrays, rest = eqx.partition(tree, eqx.is_array)
        if any(not x.is_fully_addressable and not x.is_fully_replicated for x in jax.tree.leaves(arrays)):
            arrays = jax.jit(lambda x: x, out_shardings=NamedSharding(self.mesh, PartitionSpec()))(arrays)
        return eqx.combine(jax.tree.map(np.asarray, arrays), rest)

    def padded(self, tree: Any) -> Any:
        """``tree`` with the last example repeated until the leading axis can be divided; numpy arrays."""
        return jax.tree.map(lambda x: last_repeated(x, -(-len(x) // self.count) * self.count), tree)

    def divided(self, function: Callable, in_axes: tuple, out_axes: Any) -> Callable:
        """``function``, each device working on its share alone.

        Args:
            function: of pytrees of arrays; must treat examples independently.
            in_axes: of every argument the axis to divide, or None for what every device gets whole.
            out_axes: the same of the results; a pytree prefix.

        Returns:
            A function of the same arguments, with the same results, to be called within a compiled one.
        """
        if not self.several:
            return function

        def call(*arguments):
            arrays, rest = eqx.partition(arguments, eqx.is_array)
            shared = jax.shard_map(
                lambda *x: function(*eqx.combine(self._together(x), rest)),
                mesh=self.mesh,
                in_specs=tuple(map(_spec, in_axes)),
                out_specs=jax.tree.map(_spec, out_axes),
                # Scans begin with constants, which the check takes for another kind than what follows.
                check_vma=False,
            )
            return shared(*arrays)

        return call

    def mapped(self, function: Callable) -> Callable:
        """``jax.vmap(function)`` with the examples divided; compiled by the caller."""
        batched = jax.vmap(function)

        def call(*arguments):
            return self.divided(batched, (0,) * len(arguments), 0)(*arguments)

        return call

    def shared(self, batch: Any) -> Any:
        """A batch (an `equinox.Module` with a field ``over``) placed on these devices, and knowing it: see `mapped`."""
        if not self.several:
            return batch
        return replace(self.along(self.padded(batch)), over=self)

    def _together(self, arrays: Any) -> Any:
        """The same, after a word with the other devices: XLA's CPU client runs programs that exchange nothing one after
        another on one thread, and those that do side by side."""
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
    """``jax.vmap(function)`` over a batch that is divided over devices, if it is."""
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
    # Not device_put: it would send the array around to see that all processes gave the same.
    held = np.asarray(x)
    return jax.make_array_from_callback(held.shape, sharding, lambda index: held[index])


def last_repeated(x: Any, count: int) -> np.ndarray:
    """``x`` with its last row again and again, up to so many rows."""
    x = np.asarray(x)
    return np.concatenate([x, np.repeat(x[-1:], count - len(x), axis=0)])
