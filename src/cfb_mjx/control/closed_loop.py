"""Fast rollouts with a controller in the loop, on the true state and without noise.

Training and evaluation (`cfb_mjx.envs`, `cfb_mjx.train.flying`) add delayed estimates, noise and limits.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from cfb_mjx.control.controllers import Controller, require_motor_commands
from cfb_mjx.control.neural import NeuralController
from cfb_mjx.engine.batching import LANES, PACKED_BYTES, axes, differentiated_as, examples, grouped, one_of_many
from cfb_mjx.engine.cpu_kernel import one_kernel
from cfb_mjx.envs.observation import StateEstimate, observation, remember
from cfb_mjx.model.quadrotor import Quadrotor, prepare
from cfb_mjx.model.rollout import fits_one_kernel, fly_rows, in_components
from cfb_mjx.model.state import State, stack
from cfb_mjx.model.vector import Vec
from cfb_mjx.runtime import cores

FEW = 8
"""Largest number of drones that are flown in one compiled function on a CPU, with matrix products written out as sums.
For so few drones, calling a function for every layer and sum of every command takes longer than the arithmetic. With
more drones a matrix library is faster."""
AT_ONCE = 1024
"""Number of drones whose numbers fit in the second-level cache of a CPU core, with room for other data."""


def at_once() -> int:
    """Largest number of drones under one network that a CPU flies at once; more are flown in groups one after another.

    If a device has several cores, XLA divides the computation of a group between them, which pays for large groups
    only.
    """
    share = cores() // jax.local_device_count()
    return AT_ONCE if share < 2 else 4 * AT_ONCE * share


class ClosedLoop(NamedTuple):
    """Result of `rollout_closed_loop`."""

    state: State
    """State after every ``every``-th command, leading axis ``commands // every``."""
    command: Float[Array, "kept 4"]
    """The command before each kept state, motors M1..M4, 0 to 1."""
    memory: Any
    """Final memory of the controller; pass it to the next rollout to continue the flight."""


def rollout_closed_loop(
    model: Quadrotor,
    controller: Controller,
    state: State,
    commands: int,
    *,
    target: Float[Array, "3"] | tuple[float, float, float] = (0.0, 0.0, 0.0),
    memory: Any = None,
    every: int = 1,
) -> ClosedLoop:
    """Fly ``commands`` commands of a controller that sees the true state.

    Use ``jax.vmap`` over model, state, target and memory. Many drones under one network are computed with the drones as
    the last axis, however the call is batched; on a CPU this is faster than the same loop under ``vmap``. The result is
    differentiable with respect to all arrays, in both modes.

    Args:
        model: the drone; its step must divide the controller's.
        controller: a `NeuralController` without set-points, a `PidController`, a `MellingerController` or a
            controller of your own.
        state: initial state, without batch axes.
        commands: number of commands; each is held for ``controller.control_dt_s``.
        target: position to hold, world, m.
        memory: memory of the controller; by default that of a controller that has held ``state`` in hover for long.
        every: commands per kept state; must divide ``commands``.

    Returns:
        The kept states and commands, and the final memory.

    Raises:
        CfbError: the control step is not a multiple of the model's, or the policy does not command the motors.
        ValueError: ``every`` does not divide ``commands``, or the policy needs set-points.
    """
    hold = model.steps_per_command(controller.control_dt_s)
    if commands < 1 or every < 1 or commands % every:
        raise ValueError(f"{commands} commands cannot be kept every {every}")
    if isinstance(controller, NeuralController) and controller.layout.setpoint_scales:
        raise ValueError("a policy with set-points cannot be flown to a target alone")
    require_motor_commands(controller, "rollout_closed_loop")
    given = (model, controller, state, jnp.asarray(target, model.parameters.mass.dtype), memory)
    leaves, structure = jax.tree.flatten(jax.tree.map(jnp.asarray, given))
    results: list[Any] = []

    def loop(drones, parts):
        leaves, *results[:] = jax.tree.flatten(_loop(drones, parts, hold, commands, every))
        return leaves

    def plainly(*leaves):
        return loop(_Drones(None, False, False), jax.tree.unflatten(structure, leaves))

    def together(own, *leaves):
        size = examples(own, leaves)
        parts, own_parts = jax.tree.unflatten(structure, leaves), jax.tree.unflatten(structure, own)
        if size == 1:
            # All drones share the model and the network.
            alone = jax.tree.map(lambda x, mine: x[0] if mine else x, parts[:2], own_parts[:2])
            parts, own_parts = (*alone, *parts[2:]), (*jax.tree.map(lambda _: False, own_parts[:2]), *own_parts[2:])
            leaves, own = jax.tree.leaves(parts), tuple(jax.tree.leaves(own_parts))
        own_models, own_controllers = (any(jax.tree.leaves(x)) for x in own_parts[:2])
        if not isinstance(controller, NeuralController) or own_controllers:
            return jax.vmap(plainly, in_axes=axes(own))(*leaves)
        if size > at_once() and jax.default_backend() == "cpu":
            return in_groups(own, leaves)
        # The kernels know networks that their observation alone determines.
        plain = fits_one_kernel(model) and not controller.recurrent
        fits = plain and len({x.dtype for x in leaves}) == 1
        few = fits and size <= FEW
        drones = _Drones(size, own_models, few, between=fits and FEW < size <= LANES)

        def flown(*leaves):
            model, controller, *rest = jax.tree.unflatten(structure, leaves)
            if own_models:
                model = jax.tree.map(drones.given, model, own_parts[0])
            rest = (jax.tree.map(drones.given, x, mine) for x, mine in zip(rest, own_parts[2:], strict=True))
            return loop(drones, (model, controller.written_out() if few else controller, *rest))

        leaves = [jnp.moveaxis(x, 0, -1) if mine else x for x, mine in zip(leaves, own, strict=True)]
        found = grouped(flown, leaves, own, size) if few else flown(*leaves)
        return [jnp.moveaxis(x, -1, 0) for x in found]

    def in_groups(own, leaves):
        def one(own_leaves):
            mine = iter(own_leaves)
            return one_of_many(together)(*(next(mine) if m else x for x, m in zip(leaves, own, strict=True)))

        return jax.lax.map(one, [x for x, m in zip(leaves, own, strict=True) if m], batch_size=at_once())

    flown = differentiated_as(one_of_many(together), plainly)(*leaves)
    return jax.tree.unflatten(results[0], flown)


class _Drones(NamedTuple):
    """How the drones are batched: their axis is the last one of every array."""

    size: int | None
    """Number of drones; None means one drone without the axis."""
    own_models: bool
    """Whether the models have the axis too."""
    few: bool
    """Whether the whole loop is one compiled function."""
    between: bool = False
    """Whether everything between two evaluations of the network is one compiled function."""

    @property
    def many(self) -> bool:
        """Whether moving numbers costs more than calling functions."""
        return self.size is not None and self.size > LANES

    def each(self, function: Callable, *arguments) -> Any:
        """``function(model, ...)`` for each drone; all arguments after the model have the axis."""
        if self.size is None:
            return function(*arguments)
        axes = (-1 if self.own_models else None, *(-1 for _ in arguments[1:]))
        return jax.vmap(function, in_axes=axes, out_axes=-1, axis_size=self.size)(*arguments)

    def given(self, x: Array, own: bool) -> Array:
        """Add the axis to an array that does not have it."""
        return x if own else jnp.broadcast_to(x[..., None], (*x.shape, self.size))


def _loop(drones: _Drones, parts: Sequence[Any], hold: int, commands: int, every: int) -> ClosedLoop:
    model, controller, state, target, memory = parts
    prepared = drones.each(prepare, model) if drones.own_models else prepare(model)

    def begin(prepared, state):
        command = prepared.model.hover_command()
        return in_components(prepared, state, command), command

    def whole(prepared, at):
        return stack(at, prepared.parameters.center_of_gravity)

    def seen(prepared, at, target):
        state = whole(prepared, at)
        return StateEstimate(state.position - target, state.velocity, state.quaternion, state.body_rate)

    def moved(prepared, at, command):
        return fly_rows(prepared, at, Vec.unstack(command[None]), hold)

    at, command = drones.each(begin, prepared, state)
    if memory is None:
        memory = controller.start(drones.each(seen, prepared, at, target), command)

    def kept_of(at, command):
        return drones.each(whole, prepared, at), command

    def one(carry, _):
        at, memory, before = carry
        memory, command = controller.command(memory, drones.each(seen, prepared, at, target))
        command = command.astype(before.dtype)
        return (drones.each(moved, prepared, at, command), memory, command), None

    def after(prepared, target, at, memory, command):
        """Apply a network's ``command``: next state, memory and observation."""
        memory = remember(controller.layout, memory, drones.each(seen, prepared, at, target), command)
        at = drones.each(moved, prepared, at, command)
        return at, memory, observation(controller.layout, memory, drones.each(seen, prepared, at, target))

    if drones.between:
        shown = observation(controller.layout, memory, drones.each(seen, prepared, at, target))
        if sum(x.nbytes for x in jax.tree.leaves((at, memory, shown))) <= PACKED_BYTES:
            return _by_kernel(
                drones, controller, after, kept_of, prepared, target, (at, memory, shown), commands, every
            )
    pack, unpack = _packing(jax.eval_shape(kept_of, at, command)) if drones.few else (lambda x: x, lambda x: x)

    # The memory is shifted by one place in every iteration; with two iterations per turn it is copied half as often.
    turns = 2 if drones.many and every > 1 else 1

    def some(carry, _):
        carry = jax.lax.scan(one, carry, length=every, unroll=turns)[0]
        at, _, command = carry
        return carry, pack(kept_of(at, command))

    (_, memory, _), kept = jax.lax.scan(some, (at, memory, command), length=commands // every)
    state, command = unpack(kept)
    return ClosedLoop(state, command, memory)


def _by_kernel(drones, controller, after, kept_of, prepared, target, first, commands: int, every: int) -> ClosedLoop:
    """Fly a network's loop with one kernel per command.

    All changing numbers are in one array, the numbers that differ between drones in a second, shared ones in a third.
    """
    leaves, static = eqx.partition(prepared, eqx.is_array)
    shared, own = ((), (leaves, target)) if drones.own_models else (leaves, target)
    (pack, unpack), (pack_own, unpack_own) = _packing(first), _packing(own)
    flat, whole = ravel_pytree(shared)

    def kernel(packed, command, own, *shared):
        leaves, target = unpack_own(own) if drones.own_models else (whole(*shared), unpack_own(own))
        changed = pack(after(eqx.combine(leaves, static), target, *unpack(packed)[:2], command))
        # The last row is for `one_kernel`: the kernel must use what the function ignores.
        return jnp.concatenate([changed, sum(x[:1] for x in (packed, command, own, *shared))])

    own, shared = pack_own(own), () if drones.own_models else (flat,)

    def one(carry, _):
        packed, before = carry
        command = controller.act(packed[-controller.layout.size :]).astype(before.dtype)
        return (one_kernel(kernel, packed, command, own, *shared)[:-1], command), None

    def some(carry, _):
        carry = jax.lax.scan(one, carry, length=every)[0]
        return carry, carry

    start = pack(first), jnp.zeros((4, drones.size), own.dtype)
    (packed, _), kept = jax.lax.scan(some, start, length=commands // every)
    state, command = jax.vmap(lambda packed, command: kept_of(unpack(packed)[0], command))(*kept)
    return ClosedLoop(state, command, unpack(packed)[1])


def _packing(example: Any) -> tuple[Callable, Callable]:
    """Functions that pack a tree of arrays (..., drones) into one array, as `one_kernel` needs it, and unpack it."""
    leaves, structure = jax.tree.flatten(example)
    ends = np.cumsum([math.prod(x.shape[:-1]) for x in leaves])

    def pack(tree):
        return jnp.concatenate([x.reshape(-1, x.shape[-1]) for x in jax.tree.leaves(tree)])

    def unpack(packed):
        pieces = zip(jnp.split(packed, ends[:-1], axis=-2), leaves, strict=True)
        return jax.tree.unflatten(structure, [x.reshape(*packed.shape[:-2], *like.shape) for x, like in pieces])

    return pack, unpack
