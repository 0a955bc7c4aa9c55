"""All rotors have more or less aerodynamic torque than the model says: torque_scale *= 1 + relative."""

from __future__ import annotations

from typing import ClassVar

import equinox as eqx
from jaxtyping import Array, Float

from cfb_mjx.model.effects.base import Effect
from cfb_mjx.model.effects.fields import number
from cfb_mjx.parameters.parameters import Limits, Parameters


class TorqueScale(Effect):
    """torque_scale *= 1 + relative."""

    name: ClassVar[str] = "torque_scale"
    meaning: ClassVar[str] = "the rotors' reaction torque differs from the declared torque curve"
    experiment: ClassVar[str] = "yaw turns and stops at constant height (cfb excite single-motor)"
    units: ClassVar[dict[str, str]] = {"relative": "1"}
    source: ClassVar[str] = "How to Model Your Crazyflie Brushless, ICRA 2026, eq. 9"
    prior: ClassVar[dict[str, tuple[float, float]]] = {"relative": (-0.5, 0.5)}
    limits: ClassVar[dict[str, Limits]] = {"relative": Limits(-0.95, 9.0, -0.8, 3.0)}
    strengths: ClassVar[tuple[str, ...]] = ("relative",)

    relative: Float[Array, "*batch"] = eqx.field(converter=number)
    """Relative change of every rotor's aerodynamic torque."""

    @classmethod
    def neutral(cls) -> TorqueScale:
        return cls(relative=0.0)

    def change(self, parameters: Parameters) -> Parameters:
        changed = parameters.torque_scale * (1 + self.relative[..., None])
        return eqx.tree_at(lambda p: p.torque_scale, parameters, changed)
