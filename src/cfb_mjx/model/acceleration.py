"""Which way a rollout is computed: by the plain program, or on a GPU by one kernel (`cfb_mjx.model.kernel`).

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
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from cfb_mjx.model import kernel, numberwise
from cfb_mjx.model.quadrotor import Prepared, Quadrotor, advance
from cfb_mjx.model.state import Components, State
from cfb_mjx.model.transformable import axes, differentiated_as, examples, one_of_many
from cfb_mjx.model.vector import Vec

FEWEST_STEPS = 4
"""Shorter rollouts stay plain, so that XLA can merge them with what surrounds them (a policy, say)."""
MOST_NUMBERS = 2**30
"""In one array: beyond it Triton's addresses need 64 bits, and what is held for all drones gets too large anyway."""
OLDEST_GPU = 8.0
"""Compute capability that XLA compiles Triton for: Ampere."""

Way = Literal["plain", "kernel", "interpret"]
_forced: contextvars.ContextVar[tuple[Way, kernel.Tuning] | None] = contextvars.ContextVar("way", default=None)


@contextlib.contextmanager
def using(way: Way, tuning: kernel.Tuning | None = None) -> Iterator[None]:
    """Rollouts traced within go this way. Functions compiled before keep the way they were traced.

    ``"kernel"`` still computes the plain way where the program turns out to run on something else than CUDA;
    ``"interpret"`` carries the kernel out in plain JAX, for tests.
    """
    token = _forced.set((way, tuning or kernel.Tuning()))
    try:
        yield
    finally:
        _forced.reset(token)


def fly(
    plain: Callable,
    begin: Callable,
    prepared: Prepared,
    state: State,
    commands: Array,
    *,
    hold: int,
    every: int | None = None,
) -> Components:
    """``plain(prepared, state, commands)``, computed the way that suits the device.

    Args:
        plain: returns the components after each ``every`` commands (leading axis), or at the end if that is None.
        begin: returns the components at the beginning, from the same arguments.
        prepared: the model, for one drone, as are the others.
        state: at the beginning.
        commands: (rows, 4).
        hold: steps for which each command is held.
        every: commands per state, or None.
    """
    way, tuning = _forced.get() or (("kernel" if _suits_kernel() else "plain"), kernel.Tuning())
    if way == "plain" or commands.shape[0] * hold < FEWEST_STEPS:
        return plain(prepared, state, commands)
    leaves, structure = jax.tree.flatten(jax.tree.map(jnp.asarray, (prepared, state, commands)))
    components = jax.eval_shape(begin, prepared, state, commands)
    step = _step(prepared, components) if all(x.dtype == jnp.float32 for x in leaves) else None
    if step is None or not (_forced.get() or kernel_works()):
        return plain(prepared, state, commands)
    count = len(jax.tree.leaves(prepared))

    def plainly(*leaves):
        return jax.tree.leaves(plain(*jax.tree.unflatten(structure, leaves)))

    def plainly_together(own, *leaves):
        return jax.vmap(plainly, in_axes=axes(own))(*leaves)

    def by_kernel(own, *leaves):
        start = jax.vmap(lambda *leaves: begin(*jax.tree.unflatten(structure, leaves)), in_axes=axes(own))(*leaves)
        flown = kernel.fly(
            step,
            leaves[:count],
            own[:count],
            jax.tree.leaves(start),
            # Neighbouring threads fly neighbouring drones, whose commands must be neighbours in memory.
            jnp.moveaxis(leaves[-1], 0, 2) if own[-1] else leaves[-1],
            hold=hold,
            every=every or commands.shape[0],
            tuning=tuning,
            interpret=way == "interpret",
        )
        return [flown[0, i] if every is None else flown[:, i].T for i in range(flown.shape[1])]

    def together(own, *leaves):
        private = sum(x.size for x, mine in zip(leaves, own, strict=True) if mine)
        states = 1 if every is None else commands.shape[0] // every
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


def _step(prepared: Prepared, components: Components) -> numberwise.Program | None:
    """`advance` as a program of numbers, or None if it is none: MJX, say, or an effect that remembers arrays."""
    if any(x.shape for x in jax.tree.leaves(components)):
        return None
    leaves, structure = jax.tree.flatten((prepared, components, jax.ShapeDtypeStruct((4,), jnp.float32)))

    def step(*leaves):
        prepared, state, command = jax.tree.unflatten(structure, leaves)
        return jax.tree.leaves(advance(prepared, state, Vec.unstack(command)))

    return numberwise.trace(step, *(jax.ShapeDtypeStruct(x.shape, x.dtype) for x in leaves))


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


def _tried(way: Way, compiler_options: dict | None = None) -> bool:
    from cfb_mjx.model.rollout import rollout_final

    def flown(way: Way):
        model = Quadrotor.from_file("cfb-guards")
        commands = np.linspace(0.3, 0.8, 8).reshape(2, 4)
        flight = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), (model, model.hover_state(), commands))
        with using(way):
            fly = jax.vmap(
                lambda model, state, u: rollout_final(model, state, u[None], hold=8), in_axes=(None, None, 0)
            )
            final = jax.jit(fly, compiler_options=compiler_options)(*flight)
        return [np.asarray(x) for x in jax.tree.leaves(final)]

    try:
        # The caller may be in the middle of a trace, which another thread knows nothing of.
        with ThreadPoolExecutor(1) as thread:
            pairs = thread.submit(lambda: list(zip(*map(flown, (way, "plain")), strict=True))).result()
        if all(np.allclose(a, b, rtol=1e-4, atol=1e-4) for a, b in pairs):
            return True
        problem = "it computes something else"
    except Exception as error:
        problem = f"{type(error).__name__}: {error}".splitlines()[0]
    warnings.warn(f"The GPU kernel for rollouts does not work here ({problem}); they run without it.", stacklevel=2)
    return False
