"""One GPU kernel for a whole rollout: the state of a drone stays in registers from the first step to the last.

XLA turns a loop over time into kernels that are launched in every step, with the state in memory between them. Here a
single Pallas program for Triton flies a block of drones from start to end.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from cfb_mjx.engine.scalars import Program, shaped


@dataclass(frozen=True)
class Tuning:
    """How drones are distributed on the GPU.

    One drone per thread: two would share nothing and need twice the registers, and a step needs about half of the
    registers of a thread. Four warps, because a multiprocessor has four schedulers: smaller blocks would leave some of
    them idle if there are fewer blocks than multiprocessors, and larger blocks would leave multiprocessors idle.
    """

    block: int = 128
    """Drones per program; a power of two, as Triton requires."""
    warps: int = 4
    """Warps (32 threads each) per program."""


def fly(
    step: Program,
    constants: Sequence[Array],
    own: Sequence[bool],
    start: Sequence[Float[Array, " drones"]],
    commands: Float[Array, "rows inputs"] | Float[Array, "rows inputs drones"],
    *,
    hold: int,
    every: int,
    tuning: Tuning,
    interpret: bool = False,
) -> Float[Array, "kept numbers drones"]:
    """Every drone's state after each ``every`` commands, each held for ``hold`` steps.

    Args:
        step: step from the constants, the numbers of the state and a row of inputs to the new numbers of the state.
        constants: (...) for all drones or (drones, ...), float32.
        own: which constants differ between drones.
        start: numbers of the initial state.
        commands: commands for all drones, or one sequence per drone.
        hold: steps per command.
        every: commands per returned state; must divide the number of commands.
        tuning: distribution of the drones.
        interpret: evaluate the kernel in plain JAX, on any device (for tests).
    """
    from jax.experimental import pallas as pl
    from jax.experimental.pallas import triton as language

    drones, rows, block, inputs = start[0].shape[0], commands.shape[0], tuning.block, commands.shape[1]
    used = [i for i, matters in enumerate(step.used[: len(constants)]) if matters]
    private, common = [i for i in used if own[i]], [i for i in used if not own[i]]
    # Tables of numbers as flat arrays, one line per number; empty tables are no operands.
    tables = {
        "start": start,
        "commands": [commands],
        "private": [constants[i].reshape(drones, -1).T for i in private],
        "common": [constants[i] for i in common],
    }
    tables = {name: jnp.concatenate([x.reshape(-1) for x in arrays]) for name, arrays in tables.items() if arrays}

    def kernel(*refs):
        refs, out = dict(zip(tables, refs[:-1], strict=True)), refs[-1]
        first = pl.program_id(0) * block
        # The last block may extend beyond the last drone: there it computes with ones and stores nothing.
        there = first + jnp.arange(block, dtype=jnp.int32) < drones

        def each(line):
            return pl.ds(line * drones + first, block)

        def read(name, line):
            return language.load(refs[name].at[each(line)], mask=there, other=1.0)

        def taken(which, lines, number):
            """Arrays of numbers whose lines are consecutive."""
            for i in which:
                shape = constants[i].shape[1:] if own[i] else constants[i].shape
                yield i, shaped(shape, (number(next(lines)) for _ in range(math.prod(shape))))

        known = dict(taken(private, map(np.int32, itertools.count()), functools.partial(read, "private")))
        known |= dict(taken(common, map(np.int32, itertools.count()), lambda line: refs["common"][line]))
        arguments = [known.get(i) for i in range(len(constants))]

        def obey(row, state):
            lines = (row * np.int32(inputs) + np.int32(i) for i in range(inputs))
            shared = commands.ndim == 2
            command = shaped((inputs,), (refs["commands"][x] if shared else read("commands", x) for x in lines))

            def one(_, state):
                after = step(*arguments, *(shaped((), [x]) for x in state), command)
                return tuple(jnp.broadcast_to(x[()], (block,)) for x in after)

            return _repeat(hold, one, state)

        def keep(k, state):
            state = _repeat(every, lambda row, state: obey(k * np.int32(every) + row, state), state)
            for i, number in enumerate(state):
                language.store(out.at[each(k * np.int32(len(start)) + np.int32(i))], number, mask=there)
            return state

        _repeat(rows // every, keep, tuple(read("start", np.int32(i)) for i in range(len(start))))

    flown = pl.pallas_call(
        kernel,
        out_shape=jax.ShapeDtypeStruct((rows // every * len(start) * drones,), jnp.float32),
        grid=(pl.cdiv(drones, block),),
        # Nothing to overlap: the loop loads only commands.
        compiler_params=language.CompilerParams(num_warps=tuning.warps, num_stages=1),
        interpret=interpret,
        name="rollout",
    )(*tables.values())
    return flown.reshape(-1, len(start), drones)


def _repeat(count: int, function: Callable, state: tuple) -> tuple:
    # 32-bit counters even if JAX uses 64 bits.
    if count == 1:
        return function(np.int32(0), state)
    return jax.lax.fori_loop(np.int32(0), np.int32(count), function, state)
