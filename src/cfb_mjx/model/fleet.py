"""Many steps of many drones, and their derivatives, as operations that see the whole batch.

Written drone by drone under ``vmap``, a step is thirty small kernels over all drones, and its derivative two hundred;
between them every number goes through memory. On CPU the drones are flown a few at a time through all steps instead,
each group in one compiled function (`cfb_mjx.model.grouped`) whose numbers stay in the nearest cache, and so are their
derivatives. To form groups an operation has to know its batch, which code under ``vmap`` does not: hence primitives of
jax. There are three: the flight, its push of tangents forward, and its pull of cotangents back. All mean what the same
steps under ``vmap``, ``jvp`` and ``vjp`` mean, which is also how they are computed elsewhere.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from functools import lru_cache, partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array

from cfb_mjx.model import numberwise
from cfb_mjx.model.grouped import grouped
from cfb_mjx.model.quadrotor import Quadrotor, advance, prepare
from cfb_mjx.model.state import Components
from cfb_mjx.model.vector import Vec


class _Flight(NamedTuple):
    """What is static in a flight: everything but its arrays (state, rows of commands, the model's)."""

    structure: Any
    static: tuple
    """Leaves that are no arrays; None in the place of arrays."""
    state: int
    """How many of the arrays are the state's, the first ones; the rows come next."""
    hold: int

    @property
    def arrays(self) -> int:
        """How many arrays there are."""
        return self.static.count(None)


def fly(model: Quadrotor, state: Components, rows: Vec, hold: int) -> Components:
    """Advance ``state`` by all ``rows`` of commands, each held for ``hold`` steps; return the last state.

    Args:
        model: the drone, without batch axes; its body must be `RigidBody`.
        state: where it starts; every component a scalar.
        rows: four arrays (n,).
        hold: steps per row.
    """
    leaves, structure = jax.tree.flatten((state, rows.stack(), model))
    dynamic = [isinstance(x, jax.Array | np.ndarray | np.generic) for x in leaves]
    arrays = [jnp.asarray(x, leaves[0].dtype) for x, d in zip(leaves, dynamic, strict=True) if d]
    static = tuple(None if d else x for x, d in zip(leaves, dynamic, strict=True))
    flight = _Flight(structure, static, len(jax.tree.leaves(state)), hold)
    flown = _FLY.bind(*arrays, flight=flight, drones=None, batched=(False,) * len(arrays), moving=())
    return jax.tree.unflatten(jax.tree.structure(state), flown)


class _Drones:
    """The drones of one flight and what they are flown with; their axis is the last one of whatever has it.

    The state is one array (numbers, lanes), not one per number: what is kept of every step is then written in place.
    What steps need of the model (`prepare`) is computed once, number by number (`cfb_mjx.model.numberwise`): so a
    number has the axis only where it depends on something that has it, and derivatives by numbers stay among numbers.
    """

    def __init__(self, flight: _Flight, batched: Sequence[bool], lanes: int, arrays: Sequence[Array]):
        self.flight, self.lanes, count = flight, lanes, flight.state
        self.state = jnp.stack([jnp.broadcast_to(x, (lanes,)) for x in arrays[:count]])
        self.rows, self.row_axis = arrays[count], -1 if batched[count] else None
        own = batched[count + 1 : flight.arrays]
        self.model = [_taken_apart(x, b) for x, b in zip(arrays[count + 1 : flight.arrays], own, strict=True)]
        structure = []

        def prepared(*model):
            # What steps need of the parameters has been prepared; effects bring their own.
            made = eqx.tree_at(lambda p: p.model.parameters, prepare(self._whole([None] * count, model)[-1]), None)
            leaves, *structure[:] = jax.tree.flatten(made)
            return [jnp.asarray(x, self.state.dtype) for x in leaves]

        examples = [jax.ShapeDtypeStruct(x.shape, self.state.dtype) for x in self.model]
        self.prepare = numberwise.trace(prepared, *examples)
        (self.structure,) = structure
        self.prepared = self.prepared_from(self.model)
        shapes = [x.shape for x in self.prepare.traced.out_avals]
        self.prepared_axes = [-1 if x.ndim > len(s) else None for x, s in zip(self.prepared, shapes, strict=True)]

    def _whole(self, state: Sequence, model: Sequence) -> tuple[Components, Any, Quadrotor]:
        remaining = iter([*state, None, *model])
        leaves = [next(remaining) if x is None else x for x in self.flight.static]
        return jax.tree.unflatten(self.flight.structure, leaves)

    def prepared_from(self, model: Sequence[np.ndarray]) -> list[Array]:
        """What steps need, from the model's numbers."""
        return [_put_together(x, self.state.dtype) for x in self.prepare(*model)]

    def step(self, numbers: list[Array], row: Array, prepared: list[Array], wrench_once: bool) -> list[Array]:
        """One step of one drone."""
        made = dataclasses.replace(jax.tree.unflatten(self.structure, prepared), wrench_once=wrench_once)
        state = self._whole(numbers, [None] * len(self.model))[0]
        return jax.tree.leaves(advance(made, state, Vec.unstack(row)))

    def used(self) -> list[bool]:
        """Which of what is prepared a step depends on."""
        row = self.rows[0] if self.row_axis is None else self.rows[0, :, 0]
        prepared = [x if a is None else x[..., 0] for x, a in zip(self.prepared, self.prepared_axes, strict=True)]
        return numberwise.used(lambda prepared: self.step(_numbers(self.state[:, 0]), row, prepared, False), prepared)

    def each(self, function: Callable, state: Array, row: Array, *own: list[Array]) -> Any:
        """``function(numbers, row, prepared, *own)`` of every drone; its own arrays have the axis."""
        axes = (-1, self.row_axis, self.prepared_axes, *(-1 for _ in own))
        arguments = (_numbers(state), row, self.prepared, *own)
        return jax.vmap(function, axes, -1, axis_size=self.lanes)(*arguments)

    def along(self, advanced: Callable[[Array, Array], tuple[Array, Any]]) -> tuple[Array, Any]:
        """From the first state through all steps; ``advanced(state, row)`` also returns what to keep of a step."""
        hold = self.flight.hold

        def one(state, row):
            return jax.lax.scan(lambda state, _: advanced(state, row), state, length=hold)

        return jax.lax.scan(one, self.state, self.rows)

    def forward(self, state: Array, row: Array) -> Array:
        """All drones after a step."""
        how = partial(self.step, wrench_once=True)
        return jnp.stack(self.each(how, state, row))


def _taken_apart(array: Array, own: bool) -> np.ndarray:
    """The array of one drone, of numbers; where every drone has its own, a number is an array (lanes,)."""
    shape = array.shape[:-1] if own else array.shape
    numbers = np.empty(shape, object)
    for index in np.ndindex(shape):
        numbers[index] = array[index]
    return numbers


def _put_together(numbers: np.ndarray, dtype) -> Array:
    """One array of numbers; with the axis of the drones, if one of them has it."""
    if not numbers.shape:
        return jnp.asarray(numbers.item(), dtype)
    block = np.broadcast_shapes(*map(np.shape, numbers.flat))
    alike = [jnp.broadcast_to(jnp.asarray(x, dtype), block) for x in numbers.flat]
    return jnp.stack(alike).reshape(*numbers.shape, *block)


def _numbers(packed: Array) -> list[Array]:
    # split, not indexing: its transpose is one concatenation, and not a sum of arrays that are mostly zero.
    return [x.reshape(x.shape[1:]) for x in jax.lax.split(packed, (1,) * packed.shape[0])]


def _flown(flight, batched, moving, lanes, *arrays):
    drones = _Drones(flight, batched, lanes, arrays)
    return _numbers(drones.along(lambda state, row: (drones.forward(state, row), None))[0])


def _pushed(flight, batched, moving, lanes, *operands):
    """Tangents of the last state; operands are the flight's arrays and the tangents of those that are ``moving``."""
    arrays, own = list(operands[: flight.arrays]), list(batched[: flight.arrays])
    moved = [_each(arrays[i], own[i], lanes) for i in moving]
    for i in moving:
        own[i] = True

    def function(*moved):
        for i, x in zip(moving, moved, strict=True):
            arrays[i] = x
        return _flown(flight, own, (), lanes, *arrays)

    given = zip(operands[flight.arrays :], batched[flight.arrays :], strict=True)
    return jax.jvp(function, moved, [_each(x, b, lanes) for x, b in given])[1]


def _pulled(flight, batched, moving, lanes, *operands):
    """Cotangents, drone by drone, of the ``moving`` arrays; operands are the arrays and the last state's cotangents.

    The states of all steps are kept, the rest of a step is computed again: to store that costs more.
    """
    drones, count = _Drones(flight, batched, lanes, operands[: flight.arrays]), flight.state
    kept = drones.along(lambda state, row: (drones.forward(state, row), state))[1]
    rows_move, moved = count in moving, [i - count - 1 for i in moving if i > count]
    model = [list(x.flat) for x in drones.model]
    axes = jax.tree.map(lambda x: -1 if jnp.ndim(x) else None, model)
    which = _both(numberwise.changed_by(drones.prepare, moved), drones.used())

    def before(numbers, row, prepared, cotangents):
        """Cotangents before a step, of one drone."""

        def after(numbers, row, some):
            return drones.step(numbers, row, _replaced(prepared, which, some), wrench_once=False)

        some = [prepared[i] for i in which]
        if rows_move:
            return jax.vjp(after, numbers, row, some)[1](cotangents)
        of_numbers, of_some = jax.vjp(lambda numbers, some: after(numbers, row, some), numbers, some)[1](cotangents)
        return of_numbers, jnp.zeros(0, row.dtype), of_some

    def of_model(of_some):
        """Cotangents of the model's own numbers from those of what is prepared."""
        return jax.vmap(of_one_model, (-1, axes), -1, axis_size=lanes)(of_some, model)

    def of_one_model(of_some, model):

        def some_from(moved_model):
            made = drones.prepared_from(list(map(_shaped, _replaced(model, moved, moved_model), drones.model)))
            return [made[i] for i in which]

        return jax.vjp(some_from, [model[i] for i in moved])[1](of_some)[0]

    # Sums over steps are what takes longest, to read and to write: where the model's numbers are far fewer than what is
    # prepared from them, each step's cotangents become theirs first.
    early = 2 * sum(len(model[i]) for i in moved) < len(which)

    def backward(carry, states_and_row):
        states, row = states_and_row

        def one(carry, state):
            cotangents, of_row, total = carry
            cotangents, now_row, now = drones.each(before, state, row, _numbers(cotangents))
            now = of_model(now) if early else now
            return (jnp.stack(cotangents), of_row + now_row, jax.tree.map(jnp.add, total, now)), None

        cotangents, total = carry
        nothing = jnp.zeros((4 if rows_move else 0, lanes), cotangents.dtype)
        (cotangents, of_row, total), _ = jax.lax.scan(one, (cotangents, nothing, total), states, reverse=True)
        return (cotangents, total), of_row

    given = zip(operands[flight.arrays :], batched[flight.arrays :], strict=True)
    last = jnp.stack([_each(x, b, lanes) for x, b in given])
    if early:
        shapes = [[()] * len(model[i]) for i in moved]
    else:
        shapes = [drones.prepare.traced.out_avals[i].shape for i in which]
    zeros = jax.tree.map(lambda s: jnp.zeros((*s, lanes), last.dtype), shapes, is_leaf=lambda s: isinstance(s, tuple))
    (first, total), of_rows = jax.lax.scan(backward, (last, zeros), (kept, drones.rows), reverse=True)
    found = dict(enumerate(_numbers(first))) | {count: of_rows}
    for i, numbers in zip(moved, total if early else of_model(total), strict=True):
        found[i + count + 1] = jnp.stack(numbers).reshape(*drones.model[i].shape, lanes)
    return [found[i] for i in moving]


def _both(a: list[bool], b: list[bool]) -> list[int]:
    return [i for i, pair in enumerate(zip(a, b, strict=True)) if all(pair)]


def _replaced(items: list, which: Sequence[int], others: list) -> list:
    items = list(items)
    for i, x in zip(which, others, strict=True):
        items[i] = x
    return items


def _shaped(numbers: list, like: np.ndarray) -> np.ndarray:
    shaped = np.empty(like.shape, object)
    for index, number in zip(np.ndindex(like.shape), numbers, strict=True):
        shaped[index] = number
    return shaped


def _each(x: Array, batched: bool, lanes: int) -> Array:
    return x if batched else jnp.broadcast_to(x[..., None], (*x.shape, lanes))


OPERATIONS = {"fly": _flown, "fly_push": _pushed, "fly_pull": _pulled}
"""What each primitive means."""


def _evaluated(what, *operands, flight, drones, batched, moving, in_groups):
    """One of the three above for the whole batch."""
    if drones is None:
        operands, batched = [x[..., None] for x in operands], (True,) * len(operands)
    size = drones or 1

    def some(*operands):
        lanes = next(x.shape[-1] for x, b in zip(operands, batched, strict=True) if b)
        return what(flight, batched, moving, lanes, *operands)

    found = grouped(some, operands, batched, size) if in_groups else some(*operands)
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
        shapes = [()] * flight.state
        if what is _pulled:
            shapes = [operands[i].shape[:-1] if batched[i] else operands[i].shape for i in moving]
        axis = () if drones is None else (drones,)
        return [jax.core.ShapedArray((*shape, *axis), operands[0].dtype) for shape in shapes]

    plain = partial(_evaluated, what, in_groups=False)
    mlir.register_lowering(primitive, mlir.lower_fun(plain, multiple_results=True))
    fast = mlir.lower_fun(partial(_evaluated, what, in_groups=True), multiple_results=True)
    mlir.register_lowering(primitive, fast, platform="cpu")
    batching.primitive_batchers[primitive] = partial(_batch, primitive)
    ad.primitive_jvps[primitive] = partial(_differentiate, plain)
    return primitive


def meaning(name: str, operands: Sequence[jax.ShapeDtypeStruct], static: dict[str, Any]):
    """The plain steps that an operation of this name stands for, traced; for those who count what programs do."""
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
    """The new batch axis and the earlier one, where there is one, as a single last axis."""
    if axis is None and not batched:
        return x
    if drones is None:
        return jnp.moveaxis(x, axis, -1)
    x = x[None] if axis is None else jnp.moveaxis(x, axis, 0)
    x = x if batched else x[..., None]
    x = jnp.moveaxis(jnp.broadcast_to(x, (size, *x.shape[1:-1], drones)), 0, -2)
    return x.reshape(*x.shape[:-2], size * drones)


def _differentiate(plain, primals, tangents, **static):
    """Of the push and the pull: second derivatives, by the plain steps."""
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
        shared = [i for i, x in enumerate(found) if x is not None and not batched[count + i]]
        for i, total in zip(shared, _totals([found[i] for i in shared]), strict=True):
            found[i] = total
    return [None] * count + found


def _totals(parts: list[Array]) -> list[Array]:
    """The sum over the last axis of each."""
    if not parts:
        return []
    # One sum of many rows, since XLA compiles and calls every sum on its own.
    total = jnp.sum(jnp.concatenate([x.reshape(-1, x.shape[-1]) for x in parts]), axis=-1)
    ends = np.cumsum([x[..., 0].size for x in parts])
    return [y.reshape(x.shape[:-1]) for y, x in zip(jnp.split(total, ends[:-1]), parts, strict=True)]


_FLY = _primitive("fly")
_PUSH = _primitive("fly_push")
_PULL = _primitive("fly_pull")
ad.primitive_jvps[_FLY] = _push
ad.primitive_transposes[_PUSH] = _pull
