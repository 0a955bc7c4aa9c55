"""Rollouts under a sequence of commands, and chunked execution of batches that do not fit into memory."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from cfb_mjx.devices import Devices
from cfb_mjx.engine import gpu, primitive, scalars
from cfb_mjx.engine.cpu_kernel import HELD
from cfb_mjx.engine.lanes import System
from cfb_mjx.model.quadrotor import Prepared, Quadrotor, advance, begin, prepare
from cfb_mjx.model.state import Components, State, stack, unstack
from cfb_mjx.model.vector import Vec

_MANY = 10
"""Number of steps from which it pays to fly drones in groups (`cfb_mjx.engine.primitive`)."""
_MOST_NUMBERS = 200
"""Largest number of values in a model that is flown in groups, where each value is computed separately. With the 231 of
a `ResidualFormula` groups take twice as long to compile and are no faster."""


def rollout(
    model: Quadrotor, state: State, commands: Float[Array, "steps 4"], *, hold: int = 1, every: int = 1
) -> State:
    """Fly ``commands`` and return the states after every ``every``-th command.

    Use ``jax.vmap`` over model, state and commands; the result is differentiable with respect to all three. A batch of
    commands is read fastest with the batch axis last: ``jax.vmap(rollout, in_axes=(None, 0, 2))`` for commands (steps,
    4, drones).

    Args:
        model: the drone.
        state: initial state, without batch axes.
        commands: (steps, 4), each in [0, 1].
        hold: number of steps of ``model.dt`` for which each command is held.
        every: number of commands per returned state; must divide ``steps``.

    Returns:
        `State` with leading axis ``steps // every``; its first entry is the state after ``every`` commands.

    Raises:
        ValueError: ``hold`` or ``every`` is below one, or ``every`` does not divide ``steps``.
    """
    steps = commands.shape[0]
    require_kept(steps, hold, every)
    prepared = prepare(model)

    def plain(prepared, state, commands):
        start = in_components(prepared, state, commands)
        if hold * steps >= _MANY and fits_one_kernel(model):
            return primitive.fly(SYSTEM, prepared.model, start, _rows(commands), hold, every)

        def some(components, rows):
            components = fly_rows(prepared, components, rows, hold)
            return components, components

        rows = jax.tree.map(lambda x: x.reshape(steps // every, every), Vec.unstack(commands))
        return jax.lax.scan(some, start, rows)[1]

    kept = gpu.fly(SYSTEM, plain, in_components, prepared, state, commands, hold=hold, every=every)
    return stack(kept, prepared.parameters.center_of_gravity)


def require_kept(steps: int, hold: int, every: int) -> None:
    """Refuse numbers of commands that a rollout cannot keep.

    Raises:
        ValueError: ``hold`` or ``every`` is below one, or ``every`` does not divide ``steps``.
    """
    if hold < 1 or every < 1 or steps % every:
        raise ValueError(f"{steps} commands, each held {hold} steps, cannot be kept every {every}")


def rollout_final(model: Quadrotor, state: State, commands: Float[Array, "steps 4"], *, hold: int = 1) -> State:
    """Fly ``commands`` and return only the last state, without storing the trajectory. Arguments as for `rollout`."""
    prepared = prepare(model)

    def plain(prepared, state, commands):
        start = in_components(prepared, state, commands)
        if hold * commands.shape[0] >= _MANY and fits_one_kernel(model):
            return primitive.fly(SYSTEM, prepared.model, start, _rows(commands), hold)
        return fly_rows(prepared, start, Vec.unstack(commands), hold)

    final = gpu.fly(SYSTEM, plain, in_components, prepared, state, commands, hold=hold)
    return stack(final, prepared.parameters.center_of_gravity)


def _prepared(model: Quadrotor) -> Prepared:
    # The preparation holds what steps need of the parameters; effects have their own arrays.
    return eqx.tree_at(lambda p: p.model.parameters, prepare(model), None)


def _stepped(prepared: Prepared, state: Components, row: Array, plain: bool) -> Components:
    return advance(dataclasses.replace(prepared, wrench_once=plain), state, Vec.unstack(row))


SYSTEM = System(_prepared, _stepped)
"""The drone as a system of `cfb_mjx.engine`."""


def _rows(commands: Float[Array, "rows 4"]) -> Float[Array, "rows 4"]:
    # Unstacked and stacked again, XLA reads each drone's own commands faster: row rollout of cfb bench.
    return Vec.unstack(commands).stack()


def fits_one_kernel(model: Quadrotor) -> bool:
    """Whether this backend computes many steps of the model in one function (`cfb_mjx.engine.cpu_kernel`)."""
    if jax.default_backend() != "cpu":
        return False
    leaves, structure = jax.tree.flatten(model)
    arrays = [isinstance(x, jax.Array | np.ndarray | np.generic) for x in leaves]
    given = tuple(jax.ShapeDtypeStruct(x.shape, x.dtype) if a else x for x, a in zip(leaves, arrays, strict=True))
    try:
        hash((structure, given))
    except TypeError:  # an effect holds a static value that is not hashable
        return False
    return _fits(structure, given)


@functools.lru_cache(maxsize=1024)
def _fits(structure, given: tuple) -> bool:
    """Whether steps of such a model consist of scalar operations that one compiled function can hold."""
    examples = [x for x in given if isinstance(x, jax.ShapeDtypeStruct)]

    def model_of(arrays) -> Quadrotor:
        left = iter(arrays)
        return jax.tree.unflatten(structure, [next(left) if isinstance(x, jax.ShapeDtypeStruct) else x for x in given])

    def begun(*arrays):
        model = model_of(arrays)
        return in_components(prepare(model), model.hover_state(), model.hover_command())

    def step(command, state, *arrays):
        return jax.tree.leaves(advance(prepare(model_of(arrays)), state, Vec.unstack(command)))

    numbers = all(jnp.issubdtype(x.dtype, jnp.floating) for x in examples)
    if not numbers or sum(x.size for x in examples) > _MOST_NUMBERS:
        return False
    state = jax.eval_shape(begun, *examples)
    if any(x.shape for x in jax.tree.leaves(state)):
        return False
    command = jax.ShapeDtypeStruct((4,), jax.tree.leaves(state)[0].dtype)
    return scalars.consists_of(jax.make_jaxpr(step)(command, state, *examples).jaxpr, HELD)


def fly_rows(prepared: Prepared, components: Components, rows: Vec, hold: int) -> Components:
    """Advance by all ``rows`` of commands (four arrays (n,)), each held for ``hold`` steps."""
    # Reverse mode stores the state of every step and computes the rest of the step again: storing the intermediate
    # results, twenty times as many, costs more than computing them.
    step = jax.checkpoint(lambda components, row: advance(prepared, components, row), prevent_cse=False)

    def one(components, row):
        if hold == 1:
            return step(components, row), None
        # scan, not fori_loop, because fori_loop has no reverse mode.
        return jax.lax.scan(lambda c, _: (step(c, row), None), components, length=hold)[0], None

    if rows[0].shape[0] == 1:
        return one(components, jax.tree.map(lambda x: x[0], rows))[0]
    return jax.lax.scan(one, components, rows)[0]


def in_components(prepared: Prepared, state: State, commands: Array) -> Components:
    """Convert a state to components, with a memory and in one precision."""
    # Otherwise the type of the scan's carry would change.
    dtype = jnp.result_type(prepared.parameters.mass, state.position, commands)
    components = unstack(begin(prepared.model, state), prepared.parameters.center_of_gravity)
    return jax.tree.map(lambda x: x.astype(dtype), components)


def in_chunks(
    function: Callable,
    size: int,
    *arguments: Any,
    progress: Callable[[int, int], None] | None = None,
    over: Devices | None = None,
) -> Any:
    """Compute ``vmap(function)(*arguments)`` for ``size`` examples at a time; the results are collected in host memory.

    If ``function`` draws large inputs (parameters, commands) from a PRNG key and returns small results, a million
    rollouts need the memory of ``size``.

    Args:
        function: maps one example (one entry of each argument) to a pytree of arrays.
        size: examples per compiled call.
        arguments: pytrees with a common leading axis.
        progress: called with (done, total) after each chunk.
        over: devices that share every chunk, `Devices.take(n)`: those of this process, or of several processes that
            run as one. In the latter case all processes must call this with the same arguments.

    Returns:
        The pytree of stacked results as numpy arrays, in every process.

    Raises:
        ValueError: there are no examples, or ``size`` is below one.
    """
    total = len(jax.tree.leaves(arguments)[0])
    if size < 1 or total < 1:
        raise ValueError(f"{total} examples cannot be run {size} at a time")
    over = over or Devices.take()
    batched = eqx.filter_jit(over.mapped(function))
    width = -(-min(size, total) // over.count) * over.count
    pieces = []
    for start in range(0, total, size):
        stop = min(start + size, total)
        # The last chunk is padded with its final example, to reuse the compiled program.
        index = np.minimum(np.arange(start, start + width), stop - 1)
        result = over.here(batched(*over.along(jax.tree.map(lambda x, i=index: x[i], arguments))))
        pieces.append(jax.tree.map(lambda x, n=stop - start: x[:n], result))
        if progress is not None:
            progress(stop, total)
    return jax.tree.map(lambda *parts: np.concatenate(parts), *pieces)
