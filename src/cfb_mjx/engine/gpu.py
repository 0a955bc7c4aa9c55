"""Which way a rollout is computed: by the plain program, or on a GPU by one kernel (`cfb_mjx.engine.gpu_kernel`).

The choice is made while tracing. On a CPU nothing is ever changed: the plain program is traced as if this module did
not exist. On a GPU the kernel is taken for what it can do: float32, operations it knows, more than a few steps, one
device. Derivatives, of every order and in both modes, are those of the plain program.
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
"""Shorter rollouts stay plain, so that XLA can merge them with what surrounds them (a policy, say)."""
MOST_NUMBERS = 2**30
"""In one array: beyond it Triton's addresses need 64 bits, and what is held for all drones gets too large anyway."""
OLDEST_GPU = 8.0
"""Compute capability that XLA compiles Triton for: Ampere."""

Way = Literal["plain", "kernel", "interpret"]
_forced: contextvars.ContextVar[tuple[Way, gpu_kernel.Tuning] | None] = contextvars.ContextVar("way", default=None)


@contextlib.contextmanager
def using(way: Way, tuning: gpu_kernel.Tuning | None = None) -> Iterator[None]:
    """Rollouts traced within go this way. Functions compiled before keep the way they were traced.

    ``"kernel"`` still computes the plain way where the program turns out to run on something else than CUDA;
    ``"interpret"`` carries the kernel out in plain JAX, for tests.
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
    """``plain(prepared, state, rows)``, computed the way that suits the device.

    Args:
        system: whose step ``plain`` takes.
        plain: returns the numbers of the state after each ``every`` rows (leading axis), or at the end if that is None.
        begin: returns the numbers at the beginning, from the same arguments.
        prepared: what steps need of the system's constants, for one lane, as are the others.
        state: at the beginning.
        rows: (n, inputs).
        hold: steps for which each row is held.
        every: rows per state, or None.
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
            # Neighbouring threads fly neighbouring drones, whose commands must be neighbours in memory.
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
        # Where the program will run is known for certain when it is compiled: GPU machines have CPUs too.
        ways = {"cuda": by_kernel, "default": plainly_together}
        return jax.lax.platform_dependent(*leaves, **{key: functools.partial(f, own) for key, f in ways.items()})

    flown = differentiated_as(one_of_many(together), plainly)(*leaves)
    return jax.tree.unflatten(jax.tree.structure(components), flown)


def kernel_is_chosen() -> bool:
    """Whether rollouts the kernel can do are given to it here."""
    return _suits_kernel() and kernel_works()


def _step(system: System, prepared: Any, components: Any, inputs: int) -> scalars.Program | None:
    """A step as a program of numbers, or None if it is none: MJX, say, or an effect that remembers arrays."""
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

        # "gfx..." on AMD's, for which nothing here was tried.
        return float(jax.devices()[0].compute_capability) >= OLDEST_GPU
    except (ImportError, AttributeError, ValueError):
        return False


@functools.cache
def kernel_works() -> bool:
    """Whether the kernel compiles on this device and flies as the plain program does; tried once per process."""
    return _tried("kernel")


def _swing(damping: Array, state: tuple[Array, Array], row: Array, plain: bool) -> tuple[Array, Array]:
    angle, rate = state
    pull = row[0] * jnp.sqrt(jnp.abs(rate) + 1.0) - jnp.where(rate > 0.0, damping, 2.0 * damping) * rate
    return angle + 0.01 * rate, rate + 0.01 * (pull - jnp.sin(angle))


_PENDULUM = System(lambda damping: damping, _swing)
"""What the kernel is tried with."""


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
        # The caller may be in the middle of a trace, which another thread knows nothing of.
        with ThreadPoolExecutor(1) as thread:
            pairs = thread.submit(lambda: list(zip(*map(swung, (way, "plain")), strict=True))).result()
        if all(np.allclose(a, b, rtol=1e-4, atol=1e-4) for a, b in pairs):
            return True
        problem = "it computes something else"
    except Exception as error:
        problem = f"{type(error).__name__}: {error}".splitlines()[0]
    warnings.warn(f"The GPU kernel for rollouts does not work here ({problem}); they run without it.", stacklevel=2)
    return False
