"""Parasitic drag of the airframe: a force against the velocity through still air."""

from __future__ import annotations

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from cfb_mjx.model.effects.base import Condition, Effect, Wrench
from cfb_mjx.model.effects.fields import vector
from cfb_mjx.model.vector import Vec


class ParasiticDrag(Effect):
    """F = -(linear + quadratic |v_i|) v_i on each body axis i, with v the velocity in body axes."""

    name: ClassVar[str] = "parasitic_drag"
    units: ClassVar[dict[str, str]] = {"linear": "N s/m", "quadratic": "N s^2/m^2"}
    source: ClassVar[str] = (
        "linear part: drone-models cf21B_500 (drag matrix); quadratic part: bluff-body drag, 0.5 rho C_d A"
    )
    prior: ClassVar[dict[str, tuple[float, float]]] = {"linear": (0.0, 0.05), "quadratic": (0.0, 0.02)}
    # The linear part is what `rotor_drag` does at hover; tracing looks for it there.
    strengths: ClassVar[tuple[str, ...]] = ("quadratic",)

    linear: Float[Array, "*batch 3"] = eqx.field(converter=vector(3))
    quadratic: Float[Array, "*batch 3"] = eqx.field(converter=vector(3))

    @classmethod
    def neutral(cls) -> ParasiticDrag:
        return cls(linear=0.0, quadratic=0.0)

    def body(self, wrench: Wrench, condition: Condition) -> Wrench:
        velocity = condition.velocity_body
        coefficient = Vec.unstack(self.linear) + Vec.unstack(self.quadratic) * velocity.map(jnp.abs)
        return Wrench(wrench.force - coefficient * velocity, wrench.torque)
