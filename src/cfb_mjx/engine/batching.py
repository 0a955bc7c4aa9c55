"""Turn functions of many examples into functions of one example that JAX can transform."""

from __future__ import annotations

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax.custom_batching import custom_vmap
from jax.custom_derivatives import SymbolicZero


def one_of_many(together: Callable) -> Callable:
    """Return the function of one example whose ``vmap``, also nested, is ``together``.

    Args:
        together: called as ``together(own, *leaves)``. ``own`` marks the leaves that have a leading axis of examples
            (at least one has; the others are the same for all examples). Returns a list of arrays with that axis.

    Returns:
        A function of leaves without that axis; it returns a list of arrays without it.
    """

    @custom_vmap
    def one(*leaves):
        single = _over(together, (True,) * len(leaves))
        return [x[0] for x in single(*(x[None] for x in leaves))]

    @one.def_vmap
    def many(size, own, *leaves):
        results = _over(together, tuple(own))(*leaves)
        return results, [True] * len(results)

    return one


def _over(together: Callable, own: tuple[bool, ...]) -> Callable:
    @custom_vmap
    def many(*leaves):
        return together(own, *leaves)

    @many.def_vmap
    def more(size, outer, *leaves):
        """Merge two axes of examples into one."""
        inner = examples(own, [x[0] if o else x for x, o in zip(leaves, outer, strict=True)])

        def merged(x, o, mine):
            if not (o or mine):
                return x
            x = x if o else x[None]
            x = x if mine else x[:, None]
            return jnp.broadcast_to(x, (size, inner, *x.shape[2:])).reshape(size * inner, *x.shape[2:])

        both = tuple(o or mine for o, mine in zip(outer, own, strict=True))
        results = _over(together, both)(*map(merged, leaves, outer, own))
        return [x.reshape(size, inner, *x.shape[1:]) for x in results], [True] * len(results)

    return many


def examples(own: tuple[bool, ...], leaves) -> int:
    """Number of examples: the length of the leading axis of the leaves that are ``own``."""
    return next(x.shape[0] for x, mine in zip(leaves, own, strict=True) if mine)


def axes(own: tuple[bool, ...]) -> tuple[int | None, ...]:
    """``in_axes`` for a `jax.vmap` over the leaves that are ``own``."""
    return tuple(0 if mine else None for mine in own)


def differentiated_as(function: Callable, plain: Callable) -> Callable:
    """``function`` with the derivatives of ``plain``, of all orders and in both modes."""
    outer = jax.custom_jvp(function)

    # Constant arguments stay out of the tangents: otherwise every gradient would cost as much as one by all leaves.
    @functools.partial(outer.defjvp, symbolic_zeros=True)
    def rule(leaves, tangents):
        moving = [i for i, tangent in enumerate(tangents) if not isinstance(tangent, SymbolicZero)]

        def along(*moved):
            filled = list(leaves)
            for i, x in zip(moving, moved, strict=True):
                filled[i] = x
            return plain(*filled)

        return jax.jvp(along, [leaves[i] for i in moving], [tangents[i] for i in moving])

    return outer
