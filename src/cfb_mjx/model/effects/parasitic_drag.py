"""Parasitic drag of the airframe: a force against the velocity through the air."""

from __future__ import annotations

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from cfb_mjx.model.effects.base import Condition, Effect, Wrench
from cfb_mjx.model.effects.fields import number, vector
from cfb_mjx.model.vector import Vec
from cfb_mjx.parameters.parameters import Limits


class ParasiticDrag(Effect):
    """F_i = -(linear_i + quadratic_i sqrt(v_i^2 + cross (|v|^2 - v_i^2))) v_i along each body axis i.

    v is the velocity through the air in body axes. With ``cross`` 0 the axes are independent; with ``cross`` 1 the
    force grows with the speed |v|, as for a bluff body.
    """

    name: ClassVar[str] = "parasitic_drag"
    meaning: ClassVar[str] = "the body drags against motion, with the square of speed"
    experiment: ClassVar[str] = (
        "straight passes at constant speed, 0.5 to 3 m/s, back and forth, along both body axes, the fastest as fast "
        "as there is room for"
    )
    units: ClassVar[dict[str, str]] = {"linear": "N s/m", "quadratic": "N s^2/m^2", "cross": "1"}
    source: ClassVar[str] = (
        "linear part: drone-models cf21B_500 (drag matrix); quadratic part: bluff-body drag, 0.5 rho C_d A"
    )
    prior: ClassVar[dict[str, tuple[float, float]]] = {
        "linear": (0.0, 0.05),
        "quadratic": (0.0, 0.02),
        "cross": (0.0, 1.0),
    }
    limits: ClassVar[dict[str, Limits]] = {
        "linear": Limits(0.0, 10.0, 0.0, 0.2),
        "quadratic": Limits(0.0, 1.0, 0.0, 0.1),
        "cross": Limits(0.0, 1.0, 0.0, 1.0),
    }
    # At hover the linear part is the same as `rotor_drag`, under which the search looks for it.
    strengths: ClassVar[tuple[str, ...]] = ("quadratic",)
    feels_air: ClassVar[bool] = True
    probes: ClassVar[tuple[dict[str, float], ...]] = ({"cross": 0.0}, {"cross": 1.0})

    linear: Float[Array, "*batch 3"] = eqx.field(converter=vector(3))
    quadratic: Float[Array, "*batch 3"] = eqx.field(converter=vector(3))
    cross: Float[Array, "*batch"] = eqx.field(converter=number, default=0.0)
    """Weight of the speed across an axis in the drag along it, 0 to 1."""

    @classmethod
    def neutral(cls) -> ParasiticDrag:
        return cls(linear=0.0, quadratic=0.0)

    def body(self, wrench: Wrench, condition: Condition) -> Wrench:
        velocity = condition.airspeed_body
        square = velocity.dot(velocity)
        # The square root has no derivative at rest; the small number is far below any measurable drag.
        speed = velocity.map(lambda v: jnp.sqrt(v * v + self.cross * (square - v * v) + 1e-12))
        coefficient = Vec.unstack(self.linear) + Vec.unstack(self.quadratic) * speed
        return Wrench(wrench.force - coefficient * velocity, wrench.torque)
