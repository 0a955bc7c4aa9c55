"""Many steps of many drones, and their derivatives, as primitives that see the whole batch.

Under ``vmap``, a step becomes thirty small kernels over all drones, and its derivative two hundred, and every number
passes through memory between them. On CPU the drones are therefore flown a few at a time through all steps, each group
in one compiled function (`cfb_mjx.engine.batching`) whose numbers stay in the nearest cache; the same holds for the
derivatives. To form groups an operation must know its batch, which code under ``vmap`` does not: hence primitives of
JAX. There are three: the flight, the push of its tangents forward, and the pull of its cotangents back. They are
defined by the same steps under ``vmap``, ``jvp`` and ``vjp``, which is also how they are computed on other devices.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array

from cfb_mjx.engine.batching import LANES, grouped
from cfb_mjx.engine.lanes import PACKING, Flight, System, flown, pulled, pushed
from cfb_mjx.optional import not_none


def fly(system: System, constants: Any, state: Any, rows: Array, hold: int, every: int | None = None) -> Any:
    """Advance ``state`` by all ``rows`` of inputs, each held for ``hold`` steps.

    Args:
        system: the system; its steps must consist of numbers (`cfb_mjx.engine.scalars.consists_of`).
        constants: constants of the system, a pytree without batch axes.
        state: initial state, a pytree of scalars.
        rows: inputs, (n, inputs).
        hold: steps per row.
        every: rows per returned state; must divide n.

    Returns:
        The states after every ``every`` rows, (n // every,); without ``every``, the last state.
    """
    leaves, structure = jax.tree.flatten((state, rows, constants))
    dynamic = [isinstance(x, jax.Array | np.ndarray | np.generic) for x in leaves]
    arrays = [jnp.asarray(x, leaves[0].dtype) for x, d in zip(leaves, dynamic, strict=True) if d]
    static = tuple(None if d else x for x, d in zip(leaves, dynamic, strict=True))
    count = len(jax.tree.leaves(state))
    flight = Flight(system, structure, static, count, hold, every or rows.shape[0])
    kept = _FLY.bind(*arrays, flight=flight, drones=None, batched=(False,) * len(arrays), moving=())
    return jax.tree.unflatten(jax.tree.structure(state), [x[0] for x in kept] if every is None else kept)


OPERATIONS = {"fly": flown, "fly_push": pushed, "fly_pull": pulled}
"""Definition of each primitive."""


def _evaluated(what, *operands, flight, drones, batched, moving, in_groups):
    """Evaluate one of the three functions above for the whole batch."""
    if drones is None:
        operands, batched = [x[..., None] for x in operands], (True,) * len(operands)
    size = drones or 1

    def some(*operands):
        lanes = next(x.shape[-1] for x, b in zip(operands, batched, strict=True) if b)
        return what(flight, batched, moving, lanes, in_groups, *operands)

    # With more drones than a group, storing intermediate states takes longer than computing them.
    in_groups = in_groups and (size <= LANES or operands[flight.state].shape[0] == flight.every)
    found = grouped(some, operands, batched, size) if in_groups else some(*operands)
    if in_groups and what is not pulled:
        found = PACKING[True][1](found[0], axis=1)
    return [x[..., 0] for x in found] if drones is None else list(found)


def _primitive(name: str) -> Primitive:
    primitive, what = Primitive(name), OPERATIONS[name]
    primitive.multiple_results = True

    @lru_cache(maxsize=256)
    def compiled(names, values):
        return jax.jit(partial(primitive.bind, **dict(zip(names, values, strict=True))))

    @primitive.def_impl
    def _(*operands, **static):
        return compiled(tuple(static), tuple(static.values()))(*operands)

    @primitive.def_abstract_eval
    def _(*operands, flight, drones, batched, moving):
        shapes = [(operands[flight.state].shape[0] // flight.every,)] * flight.state
        if what is pulled:
            shapes = [operands[i].shape[:-1] if batched[i] else operands[i].shape for i in moving]
        axis = () if drones is None else (drones,)
        return [ShapedArray((*shape, *axis), operands[0].dtype) for shape in shapes]

    plain = partial(_evaluated, what, in_groups=False)
    mlir.register_lowering(primitive, mlir.lower_fun(plain, multiple_results=True))
    fast = mlir.lower_fun(partial(_evaluated, what, in_groups=True), multiple_results=True)
    mlir.register_lowering(primitive, fast, platform="cpu")
    batching.primitive_batchers[primitive] = partial(_batch, primitive)
    ad.primitive_jvps[primitive] = partial(_differentiate, plain)
    return primitive


def meaning(name: str, operands: Sequence[jax.ShapeDtypeStruct], static: dict[str, Any]):
    """Trace the plain steps that define the primitive of this name, for tools that count operations."""
    return jax.make_jaxpr(partial(_evaluated, OPERATIONS[name], in_groups=False, **static))(*operands)


def _batch(primitive, operands, axes, *, flight, drones, batched, moving):
    size = next(x.shape[a] for x, a in zip(operands, axes, strict=True) if a is not None)
    joined = [_join(x, a, b, size, drones) for x, a, b in zip(operands, axes, batched, strict=True)]
    own = tuple(b or a is not None for a, b in zip(axes, batched, strict=True))
    found = primitive.bind(*joined, flight=flight, drones=size * (drones or 1), batched=own, moving=moving)
    where = [x.ndim - 1 for x in found]
    if drones is not None:
        found = [x.reshape(*x.shape[:-1], size, drones) for x in found]
    return found, where


def _join(x: Array, axis: int | None, batched: bool, size: int, drones: int | None) -> Array:
    """Merge the new batch axis and the earlier one, if any, into a single last axis."""
    if axis is None and not batched:
        return x
    if drones is None:
        # Without an earlier batch axis there is only the new one.
        return jnp.moveaxis(x, not_none(axis), -1)
    x = x[None] if axis is None else jnp.moveaxis(x, axis, 0)
    x = x if batched else x[..., None]
    x = jnp.moveaxis(jnp.broadcast_to(x, (size, *x.shape[1:-1], drones)), 0, -2)
    return x.reshape(*x.shape[:-2], size * drones)


def _differentiate(plain, primals, tangents, **static):
    """Derivatives of push and pull, i.e. second derivatives, by the plain steps."""
    moving = [i for i, t in enumerate(tangents) if type(t) is not ad.Zero]

    def function(*moved):
        operands = list(primals)
        for i, x in zip(moving, moved, strict=True):
            operands[i] = x
        return plain(*operands, **static)

    return jax.jvp(function, [primals[i] for i in moving], [tangents[i] for i in moving])


def _push(primals, tangents, *, flight, drones, batched, moving):
    moving = tuple(i for i, t in enumerate(tangents) if type(t) is not ad.Zero)
    pushed = _PUSH.bind(
        *primals,
        *(tangents[i] for i in moving),
        flight=flight,
        drones=drones,
        batched=batched + tuple(batched[i] for i in moving),
        moving=moving,
    )
    return _FLY.bind(*primals, flight=flight, drones=drones, batched=batched, moving=()), pushed


def _pull(cotangents, *operands, flight, drones, batched, moving):
    count = flight.arrays
    primals, tangents = operands[:count], operands[count:]
    wanted = [ad.is_undefined_primal(x) for x in tangents]
    cotangents = [ad.instantiate_zeros(x) for x in cotangents]
    pulled = iter(
        _PULL.bind(
            *primals,
            *cotangents,
            flight=flight,
            drones=drones,
            batched=batched[:count] + (drones is not None,) * flight.state,
            moving=tuple(i for i, w in zip(moving, wanted, strict=True) if w),
        )
    )
    found = [next(pulled) if w else None for w in wanted]
    if drones is not None:
        shared = {i: x for i, x in enumerate(found) if x is not None and not batched[count + i]}
        for i, total in zip(shared, _totals(list(shared.values())), strict=True):
            found[i] = total
    return [None] * count + found


def _totals(parts: list[Array]) -> list[Array]:
    """Sum of each array over its last axis."""
    if not parts:
        return []
    # One sum over all rows, because XLA compiles and calls every sum separately.
    total = jnp.sum(jnp.concatenate([x.reshape(-1, x.shape[-1]) for x in parts]), axis=-1)
    ends = np.cumsum([x[..., 0].size for x in parts])
    return [y.reshape(x.shape[:-1]) for y, x in zip(jnp.split(total, ends[:-1]), parts, strict=True)]


_FLY = _primitive("fly")
_PUSH = _primitive("fly_push")
_PULL = _primitive("fly_pull")
ad.primitive_jvps[_FLY] = _push
ad.primitive_transposes[_PUSH] = _pull
