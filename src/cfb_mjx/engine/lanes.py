"""What many steps of many examples of a system mean, forward, and their derivatives pushed along and pulled back.

An example of a system, a drone say, is called a lane, and so is its place along the last axis of every array.
`cfb_mjx.engine.primitive` makes operations of jax of the three functions here.
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
    """What the engine advances. Compiled programs are kept by the two functions, so they are those of a module."""

    prepare: Callable[[Any], Any]
    """From the constants, a pytree, what every step needs of them."""
    step: Callable[[Any, Any, Array, bool], Any]
    """From what is prepared, the state (a pytree of numbers), a row of inputs, and whether there is no derivative of
    the step to be had (so that it may keep XLA from computing parts twice), the next state."""


class Flight(NamedTuple):
    """What is static in a flight: everything but its arrays (state, rows of inputs, the system's constants)."""

    system: System
    structure: Any
    """Of (state, rows, constants)."""
    static: tuple
    """Leaves that are no arrays; None in the place of arrays."""
    state: int
    """How many of the arrays are the state's, the first ones; the rows come next."""
    hold: int
    """Steps for which a row of commands is held."""
    every: int
    """Rows from one state that is kept to the next."""

    @property
    def arrays(self) -> int:
        """How many arrays there are."""
        return self.static.count(None)


class _Lanes:
    """The lanes of one flight and what they are flown with; their axis is the last one of whatever has it.

    The state is one array per number: put together as one, XLA would copy it in every step. What steps need of the
    constants (`System.prepare`) is computed once, number by number (`cfb_mjx.engine.scalars`): so a number has the axis
    only where it depends on something that has it, and derivatives by numbers stay among numbers.
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
        # Systems consist of numbers (`scalars.consists_of`), so there is a program.
        self.prepare = not_none(scalars.trace(prepared, *examples, elementwise=HELD))
        (self.structure,) = structure
        self.prepared = self.prepared_from(self.model)
        shapes = [x.shape for x in self.prepare.traced.out_avals]
        self.prepared_axes = [-1 if x.ndim > len(s) else None for x, s in zip(self.prepared, shapes, strict=True)]

    def _whole(self, state: Sequence, model: Sequence) -> tuple[Any, Any, Any]:
        remaining = iter([*state, None, *model])
        leaves = [next(remaining) if x is None else x for x in self.flight.static]
        return jax.tree.unflatten(self.flight.structure, leaves)

    def prepared_from(self, model: Sequence[np.ndarray]) -> list[Array]:
        """What steps need, from the model's numbers."""
        return [_put_together(x, self.state[0].dtype) for x in self.prepare(*model)]

    def step(self, numbers: list[Array], row: Array, prepared: list[Array], plain: bool) -> list[Array]:
        """One step of one lane; ``plain``: no derivative of it is taken."""
        state = self._whole(numbers, [None] * len(self.model))[0]
        return jax.tree.leaves(self.flight.system.step(jax.tree.unflatten(self.structure, prepared), state, row, plain))

    def used(self) -> list[bool]:
        """Which of what is prepared a step depends on."""
        numbers, row, prepared = self.first()
        return scalars.used(lambda prepared: self.step(numbers, row, prepared, False), prepared)

    def first(self) -> tuple[list[Array], Array, list[Array]]:
        """Numbers, row and what is prepared of one drone at its first step."""
        row = self.rows[0, 0] if self.row_axis is None else self.rows[0, 0, :, 0]
        prepared = [x if a is None else x[..., 0] for x, a in zip(self.prepared, self.prepared_axes, strict=True)]
        return [x[0] for x in self.state], row, prepared

    def each(self, function: Callable, state: list[Array], row: Array, *own: list[Array]) -> Any:
        """``function(numbers, row, prepared, *own)`` of every drone; its own arrays have the axis."""
        axes = (-1, self.row_axis, self.prepared_axes, *(-1 for _ in own))
        return jax.vmap(function, axes, -1, axis_size=self.lanes)(state, row, self.prepared, *own)

    def along(self, advanced: Callable, kept: Callable = lambda state: None) -> tuple[Any, Any]:
        """From the first state through all steps.

        Args:
            advanced: of a state and a row of commands, returns the next state and what to keep of the step.
            kept: what to keep of a state that is kept.

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
        """All drones after a step."""
        return self.each(partial(self.step, plain=True), state, row)


def _put_together(numbers: np.ndarray, dtype) -> Array:
    """One array of numbers; with the axis of the drones, if one of them has it."""
    if not numbers.shape:
        return jnp.asarray(numbers.item(), dtype)
    block = np.broadcast_shapes(*map(np.shape, numbers.flat))
    alike = [jnp.broadcast_to(jnp.asarray(x, dtype), block) for x in numbers.flat]
    return jnp.stack(alike).reshape(*numbers.shape, *block)


def _entries(packed: Array, axis: int = 0) -> list[Array]:
    # split, not indexing: its transpose is one concatenation, and not a sum of arrays that are mostly zero.
    return [jnp.squeeze(x, axis) for x in jax.lax.split(packed, (1,) * packed.shape[axis], axis)]


PACKING = {True: (jnp.stack, _entries), False: (list, lambda numbers, axis=0: numbers)}
"""What makes one array of arrays and takes it apart again, and what leaves them as they are."""


def flown(flight, batched, moving, lanes, packed, *arrays):
    """The states that are kept: their numbers, (kept, lanes) each.

    Where ``packed``, here and below, what a loop keeps is one array, which `one_kernel` writes in place, and the result
    is (kept, numbers, lanes); elsewhere XLA leaves out what nobody needs.
    """
    drones = _Lanes(flight, batched, lanes, arrays)
    kept = drones.along(lambda state, row: (drones.forward(state, row), None), PACKING[packed][0])[0]
    return [kept] if packed else kept


def pushed(flight, batched, moving, lanes, packed, *operands):
    """Tangents of the kept states; operands are the flight's arrays and the tangents of those that are ``moving``."""
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
    """Cotangents, drone by drone, of the ``moving`` arrays; operands are the arrays and the kept states' cotangents.

    The states of all steps are kept, the rest of a step is computed again: to store that costs more.
    """
    drones, count = _Lanes(flight, batched, lanes, operands[: flight.arrays]), flight.state
    dtype = drones.state[0].dtype
    rows_move, moved = count in moving, [i - count - 1 for i in moving if i > count]
    model = [list(x.flat) for x in drones.model]
    axes = jax.tree.map(lambda x: -1 if jnp.ndim(x) else None, model)
    which = _both(scalars.changed_by(drones.prepare, moved), drones.used())

    def before(numbers, row, prepared, cotangents):
        """Cotangents before a step, of one drone."""

        def after(numbers, row, some):
            return drones.step(numbers, row, _replaced(prepared, which, some), plain=False)

        some = [prepared[i] for i in which]
        if rows_move:
            return jax.vjp(after, numbers, row, some)[1](cotangents)
        of_numbers, of_some = jax.vjp(lambda numbers, some: after(numbers, row, some), numbers, some)[1](cotangents)
        return of_numbers, jnp.zeros(0, row.dtype), of_some

    # Positions, for instance, are needed only by what depends on them.
    numbers, row, prepared = drones.first()
    cotangents = [jnp.zeros_like(x) for x in numbers]
    used = scalars.used(lambda numbers: before(numbers, row, prepared, cotangents), numbers)
    needed = [i for i, u in enumerate(used) if u]
    pack, unpack = PACKING[packed]
    kept = drones.along(lambda state, row: (drones.forward(state, row), pack([state[i] for i in needed])))[1]
    nowhere = [jnp.zeros(lanes, dtype)] * count

    def of_model(of_some):
        """Cotangents of the model's own numbers from those of what is prepared."""
        return jax.vmap(of_one_model, (-1, axes), -1, axis_size=lanes)(of_some, model)

    def of_one_model(of_some, model):

        def some_from(moved_model):
            whole = zip(drones.model, _replaced(model, moved, moved_model), strict=True)
            made = drones.prepared_from([scalars.shaped(like.shape, numbers) for like, numbers in whole])
            return [made[i] for i in which]

        return jax.vjp(some_from, [model[i] for i in moved])[1](of_some)[0]

    # Sums over steps are what takes longest, to read and to write: where the model's numbers are far fewer than what is
    # prepared from them, each step's cotangents become theirs first.
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
        shapes = [drones.prepare.traced.out_avals[i].shape for i in which]
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
