"""An effect as a user writes it, as the text of a file outside the package."""

AIR_DRAG = '''"""Drag of my airframe."""

from typing import ClassVar

import equinox as eqx
from jaxtyping import Array, Float

from cfb_mjx.model import Condition, Effect, Wrench
from cfb_mjx.model.effects.fields import number


class AirDrag(Effect):
    """F = -coefficient v, with v the velocity in body axes."""

    name: ClassVar[str] = "air_drag"
    units: ClassVar[dict[str, str]] = {"coefficient": "N s/m"}
    prior: ClassVar[dict[str, tuple[float, float]]] = {"coefficient": (0.0, 0.1)}
    strengths: ClassVar[tuple[str, ...]] = ("coefficient",)

    coefficient: Float[Array, "*batch"] = eqx.field(converter=number)

    @classmethod
    def neutral(cls):
        return cls(coefficient=0.0)

    def body(self, wrench: Wrench, condition: Condition) -> Wrench:
        return Wrench(wrench.force + condition.velocity_body * -self.coefficient, wrench.torque)
'''
