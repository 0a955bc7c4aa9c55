"""Choose how a rollout is computed: by the plain program, or by one GPU kernel (`cfb_mjx.engine.gpu_kernel`).

The choice is made at trace time. On a CPU the plain program is traced unchanged. On a GPU the kernel is used if it
supports the program: float32, known operations, more than a few steps, one device. Derivatives of all orders and in
both modes are those of the plain program.
"""

from __future__ import annotations

import contextlib
import contextvars
import functools
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from cfb_mjx.engine import gpu_kernel, scalars
from cfb_mjx.engine.batching import axes, differentiated_as, examples, one_of_many
from cfb_mjx.engine.lanes import System

FEWEST_STEPS = 4
"""Rollouts with fewer steps stay plain, so that XLA can fuse them with the surrounding computation (e.g. a policy)."""
MOST_NUMBERS = 2**30
"""Largest number of elements in one array: beyond it Triton's addresses need 64 bits, and the arrays get too large."""
OLDEST_GPU = 8.0
"""Lowest compute capability for which XLA compiles Triton: Ampere."""

Way = Literal["plain", "kernel", "interpret"]
_forced: contextvars.ContextVar[tuple[Way, gpu_kernel.Tuning] | None] = contextvars.ContextVar("way", default=None)


@contextlib.contextmanager
def using(way: Way, tuning: gpu_kernel.Tuning | None = None) -> Iterator[None]:
    """Force the way in which rollouts traced in this block are computed; compiled functions keep theirs.

    ``"kernel"`` falls back to the plain program if the compiled program runs on something other than CUDA;
    ``"interpret"`` evaluates the kernel in plain JAX, for tests.
    """
    token = _forced.set((way, tuning or gpu_kernel.Tuning()))
    try:
        yield
    finally:
        _forced.reset(token)


def fly(
    system: System,
    plain: Callable,
    begin: Callable,
    prepared: Any,
    state: Any,
    rows: Array,
    *,
    hold: int,
    every: int | None = None,
) -> Any:
    """``plain(prepared, state, rows)``, computed in the way that suits the device.

    Args:
        system: the system whose steps ``plain`` takes.
        plain: returns the numbers of the state after each ``every`` rows (leading axis), or only at the end if
            ``every`` is None.
        begin: returns the numbers of the initial state, from the same arguments.
        prepared: prepared constants of the system; for one lane, like state and rows.
        state: initial state.
        rows: inputs, (n, inputs).
        hold: number of steps for which each row is held.
        every: rows per returned state, or None.
    """
    way, tuning = _forced.get() or (("kernel" if _suits_kernel() else "plain"), gpu_kernel.Tuning())
    if way == "plain" or rows.shape[0] * hold < FEWEST_STEPS:
        return plain(prepared, state, rows)
    leaves, structure = jax.tree.flatten(jax.tree.map(jnp.asarray, (prepared, state, rows)))
    components = jax.eval_shape(begin, prepared, state, rows)
    step = _step(system, prepared, components, rows.shape[1]) if all(x.dtype == jnp.float32 for x in leaves) else None
    if step is None or not (_forced.get() or kernel_works()):
        return plain(prepared, state, rows)
    count = len(jax.tree.leaves(prepared))

    def plainly(*leaves):
        return jax.tree.leaves(plain(*jax.tree.unflatten(structure, leaves)))

    def plainly_together(own, *leaves):
        return jax.vmap(plainly, in_axes=axes(own))(*leaves)

    def by_kernel(own, *leaves):
        start = jax.vmap(lambda *leaves: begin(*jax.tree.unflatten(structure, leaves)), in_axes=axes(own))(*leaves)
        flown = gpu_kernel.fly(
            step,
            leaves[:count],
            own[:count],
            jax.tree.leaves(start),
            # Neighbouring threads fly neighbouring drones, so their commands must be neighbours in memory.
            jnp.moveaxis(leaves[-1], 0, 2) if own[-1] else leaves[-1],
            hold=hold,
            every=every or rows.shape[0],
            tuning=tuning,
            interpret=way == "interpret",
        )
        return [flown[0, i] if every is None else flown[:, i].T for i in range(flown.shape[1])]

    def together(own, *leaves):
        private = sum(x.size for x, mine in zip(leaves, own, strict=True) if mine)
        states = 1 if every is None else rows.shape[0] // every
        if max(private, examples(own, leaves) * states * len(jax.tree.leaves(components))) > MOST_NUMBERS:
            return plainly_together(own, *leaves)
        if way == "interpret":
            return by_kernel(own, *leaves)
        # The device is known for certain only when the program is compiled: GPU machines also have CPUs.
        ways = {"cuda": by_kernel, "default": plainly_together}
        return jax.lax.platform_dependent(*leaves, **{key: functools.partial(f, own) for key, f in ways.items()})

    flown = differentiated_as(one_of_many(together), plainly)(*leaves)
    return jax.tree.unflatten(jax.tree.structure(components), flown)


def kernel_is_chosen() -> bool:
    """Whether rollouts that the kernel supports are computed by it on this machine."""
    return _suits_kernel() and kernel_works()


def _step(system: System, prepared: Any, components: Any, inputs: int) -> scalars.Program | None:
    """A step as a program of numbers, or None if it is none, e.g. with MJX or an effect with arrays in its memory."""
    if any(x.shape for x in jax.tree.leaves(components)):
        return None
    leaves, structure = jax.tree.flatten((prepared, components, jax.ShapeDtypeStruct((inputs,), jnp.float32)))

    def step(*leaves):
        prepared, state, row = jax.tree.unflatten(structure, leaves)
        return jax.tree.leaves(system.step(prepared, state, row, True))

    return scalars.trace(step, *(jax.ShapeDtypeStruct(x.shape, x.dtype) for x in leaves))


def _suits_kernel() -> bool:
    # XLA splits plain programs between devices, but not a kernel.
    if jax.default_backend() != "gpu" or jax.device_count() > 1:
        return False
    try:
        from jax.experimental.pallas.triton import CompilerParams  # noqa: F401

        # "gfx..." on AMD GPUs, on which nothing here has been tested.
        return float(jax.devices()[0].compute_capability) >= OLDEST_GPU
    except (ImportError, AttributeError, ValueError):
        return False


@functools.cache
def kernel_works() -> bool:
    """Whether the kernel compiles on this device and agrees with the plain program; tested once per process."""
    return _tried("kernel")


def _swing(damping: Array, state: tuple[Array, Array], row: Array, plain: bool) -> tuple[Array, Array]:
    angle, rate = state
    pull = row[0] * jnp.sqrt(jnp.abs(rate) + 1.0) - jnp.where(rate > 0.0, damping, 2.0 * damping) * rate
    return angle + 0.01 * rate, rate + 0.01 * (pull - jnp.sin(angle))


_PENDULUM = System(lambda damping: damping, _swing)
"""System with which the kernel is tested."""


def _tried(way: Way, compiler_options: dict | None = None) -> bool:
    def plain(damping, state, rows):
        return jax.lax.scan(lambda state, row: (_PENDULUM.step(damping, state, row, True), None), state, rows)[0]

    def swung(way: Way):
        damping, angle = jnp.linspace(0.1, 0.5, 200, dtype=jnp.float32), jnp.linspace(-2.0, 2.0, 200, dtype=jnp.float32)
        rows = jnp.full((8, 1), 0.5, jnp.float32)

        def one(damping, angle):
            return fly(_PENDULUM, plain, lambda _, state, __: state, damping, (angle, 0.0 * angle), rows, hold=1)

        with using(way):
            final = jax.jit(jax.vmap(one), compiler_options=compiler_options)(damping, angle)
        return [np.asarray(x) for x in final]

    try:
        # The caller may be in the middle of a trace, which does not affect another thread.
        with ThreadPoolExecutor(1) as thread:
            pairs = thread.submit(lambda: list(zip(*map(swung, (way, "plain")), strict=True))).result()
        if all(np.allclose(a, b, rtol=1e-4, atol=1e-4) for a, b in pairs):
            return True
        problem = "its results differ from the plain program's"
    except Exception as error:
        problem = f"{type(error).__name__}: {error}".splitlines()[0]
    warnings.warn(f"The GPU kernel for rollouts does not work here ({problem}); rollouts run without it.", stacklevel=2)
    return False
