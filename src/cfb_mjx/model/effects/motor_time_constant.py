"""Motors that respond faster or slower than the model's: T *= 1 + relative, the same for all four."""

from __future__ import annotations

from typing import ClassVar

import equinox as eqx
from jaxtyping import Array, Float

from cfb_mjx.model.effects.base import Effect
from cfb_mjx.model.effects.fields import number
from cfb_mjx.parameters.parameters import Limits, Parameters


class MotorTimeConstant(Effect):
    """T *= 1 + relative."""

    name: ClassVar[str] = "motor_time_constant"
    meaning: ClassVar[str] = "the motors respond slower or faster than declared"
    experiment: ClassVar[str] = "cfb excite single-motor: steps of one motor at a time, rotor speed logged"
    units: ClassVar[dict[str, str]] = {"relative": "1"}
    source: ClassVar[str] = "How to Model Your Crazyflie Brushless, ICRA 2026, eq. 5"
    prior: ClassVar[dict[str, tuple[float, float]]] = {"relative": (-0.5, 0.5)}
    limits: ClassVar[dict[str, Limits]] = {"relative": Limits(-0.95, 20.0, -0.8, 3.0)}
    strengths: ClassVar[tuple[str, ...]] = ("relative",)

    relative: Float[Array, "*batch"] = eqx.field(converter=number)
    """Relative change of the motors' time constant; above -1."""

    @classmethod
    def neutral(cls) -> MotorTimeConstant:
        return cls(relative=0.0)

    def change(self, parameters: Parameters) -> Parameters:
        changed = parameters.motor_time_constant * (1 + self.relative[..., None])
        return eqx.tree_at(lambda p: p.motor_time_constant, parameters, changed)
