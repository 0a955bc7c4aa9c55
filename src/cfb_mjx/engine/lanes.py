"""Many steps of many examples of a system: forward, with tangents pushed forward, and with cotangents pulled back.

An example of a system, e.g. a drone, is called a lane, and so is its index along the last axis of every array.
`cfb_mjx.engine.primitive` makes primitives of JAX of the three functions here.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from cfb_mjx.engine import scalars
from cfb_mjx.engine.cpu_kernel import HELD
from cfb_mjx.optional import not_none


class System(NamedTuple):
    """A system for the engine. Compiled programs are cached by the two functions, so use functions of a module."""

    prepare: Callable[[Any], Any]
    """Function of the constants (a pytree) that returns what every step needs of them."""
    step: Callable[[Any, Any, Array, bool], Any]
    """Function of the prepared constants, the state (a pytree of numbers), a row of inputs and a flag; returns the next
    state. The flag says that no derivative of the step is taken, so that the step may keep XLA from computing parts
    twice."""


class Flight(NamedTuple):
    """The static part of a flight: everything except its arrays (state, rows of inputs, constants of the system)."""

    system: System
    structure: Any
    """Structure of (state, rows, constants)."""
    static: tuple
    """Leaves that are not arrays; None in the place of arrays."""
    state: int
    """Number of arrays of the state, which come first; the rows follow."""
    hold: int
    """Number of steps for which a row is held."""
    every: int
    """Number of rows per kept state."""

    @property
    def arrays(self) -> int:
        """Total number of arrays."""
        return self.static.count(None)


class _Lanes:
    """The lanes of one flight and its inputs and constants; the lane is the last axis of every array that has it.

    The state is one array per number, because XLA would copy a packed array in every step. What steps need of the
    constants (`System.prepare`) is computed once, number by number (`cfb_mjx.engine.scalars`). A number therefore has
    the axis only if it depends on something that has it, and derivatives with respect to numbers remain numbers.
    """

    def __init__(self, flight: Flight, batched: Sequence[bool], lanes: int, arrays: Sequence[Array]):
        self.flight, self.lanes, count = flight, lanes, flight.state
        self.state = [jnp.broadcast_to(x, (lanes,)) for x in arrays[:count]]
        dtype = self.state[0].dtype
        self.rows = arrays[count].reshape(-1, flight.every, *arrays[count].shape[1:])
        self.row_axis = -1 if batched[count] else None
        own = batched[count + 1 : flight.arrays]
        given = zip(arrays[count + 1 : flight.arrays], own, strict=True)
        self.model = [scalars.apart(x, x.shape[:-1] if b else x.shape) for x, b in given]
        structure = []

        def prepared(*model):
            made = flight.system.prepare(self._whole([None] * count, model)[-1])
            leaves, *structure[:] = jax.tree.flatten(made)
            return [jnp.asarray(x, dtype) for x in leaves]

        examples = [jax.ShapeDtypeStruct(x.shape, dtype) for x in self.model]
        # Systems consist of numbers (`scalars.consists_of`), so the program exists.
        self.prepare = not_none(scalars.trace(prepared, *examples, elementwise=HELD))
        (self.structure,) = structure
        self.prepared = self.prepared_from(self.model)
        shapes = [np.shape(x) for x in self.prepare.traced.out_avals]
        self.prepared_axes = [-1 if x.ndim > len(s) else None for x, s in zip(self.prepared, shapes, strict=True)]

    def _whole(self, state: Sequence, model: Sequence) -> tuple[Any, Any, Any]:
        remaining = iter([*state, None, *model])
        leaves = [next(remaining) if x is None else x for x in self.flight.static]
        return jax.tree.unflatten(self.flight.structure, leaves)

    def prepared_from(self, model: Sequence[np.ndarray]) -> list[Array]:
        """Prepared constants, from the numbers of the model."""
        return [_put_together(x, self.state[0].dtype) for x in self.prepare(*model)]

    def step(self, numbers: list[Array], row: Array, prepared: list[Array], plain: bool) -> list[Array]:
        """One step of one lane; ``plain`` says that no derivative of it is taken."""
        state = self._whole(numbers, [None] * len(self.model))[0]
        return jax.tree.leaves(self.flight.system.step(jax.tree.unflatten(self.structure, prepared), state, row, plain))

    def used(self) -> list[bool]:
        """Which of the prepared constants a step depends on."""
        numbers, row, prepared = self.first()
        return scalars.used(lambda prepared: self.step(numbers, row, prepared, False), prepared)

    def first(self) -> tuple[list[Array], Array, list[Array]]:
        """Numbers of the state, row and prepared constants of the first drone at its first step."""
        row = self.rows[0, 0] if self.row_axis is None else self.rows[0, 0, :, 0]
        prepared = [x if a is None else x[..., 0] for x, a in zip(self.prepared, self.prepared_axes, strict=True)]
        return [x[0] for x in self.state], row, prepared

    def each(self, function: Callable, state: list[Array], row: Array, *own: list[Array]) -> Any:
        """``function(numbers, row, prepared, *own)`` for every drone; the arrays in ``own`` have the axis."""
        axes = (-1, self.row_axis, self.prepared_axes, *(-1 for _ in own))
        return jax.vmap(function, axes, -1, axis_size=self.lanes)(state, row, self.prepared, *own)

    def along(self, advanced: Callable, kept: Callable = lambda state: None) -> tuple[Any, Any]:
        """Scan from the first state through all steps.

        Args:
            advanced: function of a state and a row; returns the next state and what to keep of the step.
            kept: function of a kept state; returns what to keep of it.

        Returns:
            What is kept of states, (kept, ...), and of steps, (kept, every, hold, ...).
        """

        def one(state, row):
            return jax.lax.scan(lambda state, _: advanced(state, row), state, length=self.flight.hold)

        def some(state, rows):
            state, steps = jax.lax.scan(one, state, rows)
            return state, (kept(state), steps)

        return jax.lax.scan(some, self.state, self.rows)[1]

    def forward(self, state: list[Array], row: Array) -> list[Array]:
        """States of all drones after a step."""
        return self.each(partial(self.step, plain=True), state, row)


def _put_together(numbers: np.ndarray, dtype) -> Array:
    """Stack numbers in one array, with the axis of the drones if one of them has it."""
    if not numbers.shape:
        return jnp.asarray(numbers.item(), dtype)
    block = np.broadcast_shapes(*map(np.shape, numbers.flat))
    alike = [jnp.broadcast_to(jnp.asarray(x, dtype), block) for x in numbers.flat]
    return jnp.stack(alike).reshape(*numbers.shape, *block)


def _entries(packed: Array, axis: int = 0) -> list[Array]:
    # split, not indexing: its transpose is one concatenation, not a sum of arrays that are mostly zero.
    return [jnp.squeeze(x, axis) for x in jax.lax.split(packed, (1,) * packed.shape[axis], axis)]


PACKING = {True: (jnp.stack, _entries), False: (list, lambda numbers, axis=0: numbers)}
"""Functions that stack arrays in one and take it apart again (True), or leave them unchanged (False)."""


def flown(flight, batched, moving, lanes, packed, *arrays):
    """The kept states: one array (kept, lanes) per number.

    If ``packed``, here and below, a loop stores what it keeps in one array, which `one_kernel` writes in place, and the
    result is (kept, numbers, lanes). Otherwise XLA leaves out what is not needed.
    """
    drones = _Lanes(flight, batched, lanes, arrays)
    kept = drones.along(lambda state, row: (drones.forward(state, row), None), PACKING[packed][0])[0]
    return [kept] if packed else kept


def pushed(flight, batched, moving, lanes, packed, *operands):
    """Tangents of the kept states; operands are the flight's arrays and the tangents of the ``moving`` ones."""
    arrays, own = list(operands[: flight.arrays]), list(batched[: flight.arrays])
    moved = [_each(arrays[i], own[i], lanes) for i in moving]
    for i in moving:
        own[i] = True

    def function(*moved):
        for i, x in zip(moving, moved, strict=True):
            arrays[i] = x
        return flown(flight, own, (), lanes, packed, *arrays)

    given = zip(operands[flight.arrays :], batched[flight.arrays :], strict=True)
    return jax.jvp(function, moved, [_each(x, b, lanes) for x, b in given])[1]


def pulled(flight, batched, moving, lanes, packed, *operands):
    """Cotangents of the ``moving`` arrays, per drone; operands are the arrays and the cotangents of the kept states.

    The states of all steps are stored; the rest of a step is computed again, because storing it costs more.
    """
    drones, count = _Lanes(flight, batched, lanes, operands[: flight.arrays]), flight.state
    dtype = drones.state[0].dtype
    rows_move, moved = count in moving, [i - count - 1 for i in moving if i > count]
    model = [list(x.flat) for x in drones.model]
    axes = jax.tree.map(lambda x: -1 if jnp.ndim(x) else None, model)
    which = _both(scalars.changed_by(drones.prepare, moved), drones.used())

    def before(numbers, row, prepared, cotangents):
        """Cotangents before a step of one drone, from those after it."""

        def after(numbers, row, some):
            return drones.step(numbers, row, _replaced(prepared, which, some), plain=False)

        some = [prepared[i] for i in which]
        if rows_move:
            return jax.vjp(after, numbers, row, some)[1](cotangents)
        of_numbers, of_some = jax.vjp(lambda numbers, some: after(numbers, row, some), numbers, some)[1](cotangents)
        return of_numbers, jnp.zeros(0, row.dtype), of_some

    # For example, positions are needed only if something depends on them.
    numbers, row, prepared = drones.first()
    cotangents = [jnp.zeros_like(x) for x in numbers]
    used = scalars.used(lambda numbers: before(numbers, row, prepared, cotangents), numbers)
    needed = [i for i, u in enumerate(used) if u]
    pack, unpack = PACKING[packed]
    kept = drones.along(lambda state, row: (drones.forward(state, row), pack([state[i] for i in needed])))[1]
    nowhere = [jnp.zeros(lanes, dtype)] * count

    def of_model(of_some):
        """Cotangents of the model's numbers from those of the prepared constants."""
        return jax.vmap(of_one_model, (-1, axes), -1, axis_size=lanes)(of_some, model)

    def of_one_model(of_some, model):

        def some_from(moved_model):
            whole = zip(drones.model, _replaced(model, moved, moved_model), strict=True)
            made = drones.prepared_from([scalars.shaped(like.shape, numbers) for like, numbers in whole])
            return [made[i] for i in which]

        return jax.vjp(some_from, [model[i] for i in moved])[1](of_some)[0]

    # Reading and writing the sums over steps takes most of the time. If the model has far fewer numbers than the
    # prepared constants, the cotangents of each step are converted to the model's numbers first.
    early = 2 * sum(len(model[i]) for i in moved) < len(which)

    def over_row(carry, states_and_row):
        states, row = states_and_row

        def one(carry, state):
            cotangents, of_row, total = carry
            state = _replaced(nowhere, needed, unpack(state))
            cotangents, now_row, now = drones.each(before, state, row, cotangents)
            now = of_model(now) if early else now
            return (cotangents, of_row + now_row, jax.tree.map(jnp.add, total, now)), None

        cotangents, total = carry
        nothing = jnp.zeros((4 if rows_move else 0, lanes), dtype)
        (cotangents, of_row, total), _ = jax.lax.scan(one, (cotangents, nothing, total), states, reverse=True)
        return (cotangents, total), of_row

    def backward(carry, given):
        of_kept, *states_and_rows = given
        cotangents, total = carry
        cotangents = [x + y for x, y in zip(cotangents, of_kept, strict=True)]
        return jax.lax.scan(over_row, (cotangents, total), states_and_rows, reverse=True)

    if early:
        shapes = [[()] * len(model[i]) for i in moved]
    else:
        shapes = [np.shape(drones.prepare.traced.out_avals[i]) for i in which]
    zeros = jax.tree.map(lambda s: jnp.zeros((*s, lanes), dtype), shapes, is_leaf=lambda s: isinstance(s, tuple))
    of_kept = zip(operands[flight.arrays :], batched[flight.arrays :], strict=True)
    given = [_each(x, b, lanes) for x, b in of_kept], kept, drones.rows
    (first, total), of_rows = jax.lax.scan(backward, (nowhere, zeros), given, reverse=True)
    of_rows = of_rows.reshape(operands[count].shape[0], *of_rows.shape[2:])
    found = dict(enumerate(first)) | {count: of_rows}
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


def _each(x: Array, batched: bool, lanes: int) -> Array:
    return x if batched else jnp.broadcast_to(x[..., None], (*x.shape, lanes))
