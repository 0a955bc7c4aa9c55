"""Late estimates: a buffer that gives back what was true some time ago, between samples if need be."""

from __future__ import annotations

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, PyTree

from cfb_mjx.errors import CfbError
from cfb_mjx.model.state import State

_SLACK = 1e-3
"""Of a sample: delays and steps are rounded to float32, and 0.008 / 0.004 must not become 3 samples for that."""


class DelayLine(eqx.Module):
    """The most recent samples of a pytree, newest first along a leading axis. Immutable: `push` returns a new one."""

    samples: PyTree
    dt: float = eqx.field(static=True)

    @classmethod
    def filled(cls, sample: PyTree, dt: float, longest_delay: float) -> DelayLine:
        """A line that has seen ``sample`` for ever.

        Args:
            sample: pytree of arrays.
            dt: time between pushes, s.
            longest_delay: the longest delay that will be asked for, s (static; it sets the size).
        """
        count = math.ceil(longest_delay / dt - _SLACK) + 1
        return cls(jax.tree.map(lambda x: jnp.repeat(jnp.asarray(x)[None], count, axis=0), sample), dt)

    def push(self, sample: PyTree) -> DelayLine:
        """Append the newest sample, forget the oldest."""
        shifted = jax.tree.map(
            lambda line, new: jnp.concatenate([jnp.asarray(new, line.dtype)[None], line[:-1]]), self.samples, sample
        )
        return DelayLine(shifted, self.dt)

    def push_all(self, samples: PyTree) -> DelayLine:
        """`push` of several samples, oldest first along a leading axis."""
        count = jax.tree.leaves(self.samples)[0].shape[0]
        shifted = jax.tree.map(
            lambda line, new: jnp.concatenate([jnp.asarray(new, line.dtype)[::-1], line])[:count], self.samples, samples
        )
        return DelayLine(shifted, self.dt)

    def read(self, delay: Float[Array, ""] | float) -> PyTree:
        """The sample ``delay`` seconds before the newest, linear between samples.

        Quaternions of a `State` are interpolated along the shorter way and normalised. A delay that is traced and does
        not lie within the line reads as NaN, and so fails whatever is computed from it.

        Raises:
            CfbError: the delay is negative, or longer than the line.
        """
        count = jax.tree.leaves(self.samples)[0].shape[0]
        if not isinstance(delay, Tracer) and not _fits(np.asarray(delay) / self.dt, count):
            longest = (count - 1) * self.dt
            raise CfbError(
                f"A delay of {delay:g} s does not fit in a line of {longest:g} s; fill one for the longest delay."
            )
        at = jnp.asarray(delay) / self.dt
        inside = jnp.where(at < 0, 0.0, jnp.where(at > count - 1, count - 1.0, at))
        at = jnp.where(_fits(at, count), inside, jnp.nan)
        # Weights instead of indexing: the same cost for few samples, and differentiable in the delay.
        weights = jnp.maximum(0.0, 1.0 - jnp.abs(jnp.arange(count) - at))

        def blend(line):
            # A count or a flag is blended as a number; weights cast to integers would lose it.
            line = line if jnp.issubdtype(line.dtype, jnp.inexact) else line.astype(weights.dtype)
            return jnp.tensordot(weights.astype(line.dtype), line, axes=1)

        def read_node(node):
            if not isinstance(node, State):
                return blend(node)
            q = node.quaternion
            nearest = q[jnp.argmax(weights)]
            aligned = jnp.where((q @ nearest)[:, None] < 0, -q, q)
            mixed = blend(aligned)
            return State(
                position=blend(node.position),
                velocity=blend(node.velocity),
                quaternion=mixed / jnp.linalg.norm(mixed),
                body_rate=blend(node.body_rate),
                rotor_speed=blend(node.rotor_speed),
                memory=jax.tree.map(blend, node.memory),
            )

        return jax.tree.map(read_node, self.samples, is_leaf=lambda x: isinstance(x, State))


def _fits(at, count: int):
    return (at >= -_SLACK) & (at <= count - 1 + _SLACK)
