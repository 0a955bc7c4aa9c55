"""Delayed estimates: a buffer of past samples that is read at any delay, with linear interpolation."""

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
"""Tolerance, in samples: delays and steps are rounded to float32, and 0.008 / 0.004 must not become 3 samples."""


class DelayLine(eqx.Module):
    """The most recent samples of a pytree, newest first along a leading axis. Immutable: `push` returns a new one."""

    samples: PyTree
    dt: float = eqx.field(static=True)

    @classmethod
    def filled(cls, sample: PyTree, dt: float, longest_delay: float) -> DelayLine:
        """Return a line in which all samples are ``sample``.

        Args:
            sample: pytree of arrays.
            dt: time between pushes, s.
            longest_delay: longest delay that will be read, s (static; it determines the size).
        """
        count = math.ceil(longest_delay / dt - _SLACK) + 1
        return cls(jax.tree.map(lambda x: jnp.repeat(jnp.asarray(x)[None], count, axis=0), sample), dt)

    def push(self, sample: PyTree) -> DelayLine:
        """Append the newest sample and drop the oldest."""
        shifted = jax.tree.map(
            lambda line, new: jnp.concatenate([jnp.asarray(new, line.dtype)[None], line[:-1]]), self.samples, sample
        )
        return DelayLine(shifted, self.dt)

    def push_all(self, samples: PyTree) -> DelayLine:
        """Append several samples, oldest first along a leading axis."""
        count = jax.tree.leaves(self.samples)[0].shape[0]
        shifted = jax.tree.map(
            lambda line, new: jnp.concatenate([jnp.asarray(new, line.dtype)[::-1], line])[:count], self.samples, samples
        )
        return DelayLine(shifted, self.dt)

    def read(self, delay: Float[Array, ""] | float) -> PyTree:
        """Return the sample ``delay`` seconds before the newest, interpolated linearly.

        Quaternions of a `State` are interpolated along the shorter arc and normalised. A traced delay that is negative
        or longer than the line gives NaN.

        Args:
            delay: time before the newest sample, s.

        Raises:
            CfbError: the delay is negative, or longer than the line.
        """
        count = jax.tree.leaves(self.samples)[0].shape[0]
        if not isinstance(delay, Tracer) and not _fits(np.asarray(delay) / self.dt, count):
            longest = (count - 1) * self.dt
            raise CfbError(
                f"A delay of {delay:g} s does not fit in a line of {longest:g} s; fill the line for the longest delay."
            )
        at = jnp.asarray(delay) / self.dt
        inside = jnp.where(at < 0, 0.0, jnp.where(at > count - 1, count - 1.0, at))
        at = jnp.where(_fits(at, count), inside, jnp.nan)
        # Weights, not indexing: the same cost for few samples, and differentiable with respect to the delay.
        weights = jnp.maximum(0.0, 1.0 - jnp.abs(jnp.arange(count) - at))

        def blend(line):
            # Integers and booleans are interpolated as floats: weights cast to integers would vanish.
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
