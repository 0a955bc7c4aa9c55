"""A payload fixed to the body, ``height`` above the rotors' centre (negative: below) and ``offset`` beside it.

It adds its mass, moves the centre of gravity towards itself, and adds m M / (m + M) (|d|^2 - d_k^2) to the moment of
inertia about axis k, where d is the vector from the old centre of gravity to the payload (parallel-axis theorem about
the common centre of gravity). The payload's own moment of inertia is left out, and so are the products of inertia of a
payload that lies beside the z axis.
"""

from __future__ import annotations

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from cfb_mjx.model.effects.base import Effect
from cfb_mjx.model.effects.fields import number, vector
from cfb_mjx.parameters.parameters import Limits, Parameters


class Payload(Effect):
    """A point mass fixed to the body."""

    name: ClassVar[str] = "payload"
    meaning: ClassVar[str] = "the drone carries mass that was not declared"
    experiment: ClassVar[str] = "weigh the drone, then hover and cfb excite roll-pitch"
    units: ClassVar[dict[str, str]] = {"mass": "kg", "height": "m", "offset": "m"}
    source: ClassVar[str] = (
        "J. L. Meriam, L. G. Kraige, Engineering Mechanics: Dynamics, app. B (parallel-axis theorem)"
    )
    prior: ClassVar[dict[str, tuple[float, float]]] = {
        "mass": (0.0, 0.02),
        "height": (-0.05, 0.05),
        "offset": (-0.02, 0.02),
    }
    limits: ClassVar[dict[str, Limits]] = {
        "mass": Limits(0.0, 1.0, 0.0, 0.06),
        "height": Limits(-1.0, 1.0, -0.15, 0.15),
        "offset": Limits(-1.0, 1.0, -0.08, 0.08),
    }
    strengths: ClassVar[tuple[str, ...]] = ("mass",)
    # To first order; a mass beside the axis also changes the moments of inertia.
    said_by: ClassVar[dict[str, str]] = {"offset": "cog_offset"}
    # Added to the inertia and centre of gravity that other effects have changed.
    rank: ClassVar[int] = 1
    probes: ClassVar[tuple[dict[str, float], ...]] = (
        {"height": -0.02, "offset": 0.0},
        {"height": 0.02, "offset": 0.0},
    )

    mass: Float[Array, "*batch"] = eqx.field(converter=number)
    """Mass of the payload, a point."""
    height: Float[Array, "*batch"] = eqx.field(converter=number)
    """Height above the rotors' centre."""
    offset: Float[Array, "*batch 2"] = eqx.field(converter=vector(2), default=0.0)
    """Offset from the rotors' centre along the body's x and y axes."""

    @classmethod
    def neutral(cls) -> Payload:
        return cls(mass=0.0, height=-0.02)

    def change(self, parameters: Parameters) -> Parameters:
        total = parameters.mass + self.mass
        place = jnp.concatenate([self.offset, self.height[..., None]], axis=-1)
        way = place - parameters.center_of_gravity
        center = parameters.center_of_gravity + way * (self.mass / total)[..., None]
        squares = way * way
        added = (parameters.mass * self.mass / total)[..., None] * (squares.sum(-1, keepdims=True) - squares)
        return eqx.tree_at(
            lambda p: (p.mass, p.center_of_gravity, p.inertia), parameters, (total, center, parameters.inertia + added)
        )
