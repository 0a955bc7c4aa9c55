"""All rotors give more or less thrust than the model says: thrust_scale *= 1 + relative."""

from __future__ import annotations

from typing import ClassVar

import equinox as eqx
from jaxtyping import Array, Float

from cfb_mjx.model.effects.base import Effect
from cfb_mjx.model.effects.fields import number
from cfb_mjx.parameters.parameters import Limits, Parameters


class ThrustScale(Effect):
    """thrust_scale *= 1 + relative."""

    name: ClassVar[str] = "thrust_scale"
    meaning: ClassVar[str] = "all rotors lift more or less than the declared thrust curve says"
    experiment: ClassVar[str] = "weigh the drone, then hover: mass and thrust cannot be told apart in flight"
    units: ClassVar[dict[str, str]] = {"relative": "1"}
    source: ClassVar[str] = "How to Model Your Crazyflie Brushless, ICRA 2026, eq. 8"
    prior: ClassVar[dict[str, tuple[float, float]]] = {"relative": (-0.2, 0.2)}
    limits: ClassVar[dict[str, Limits]] = {"relative": Limits(-0.95, 9.0, -0.6, 1.0)}
    strengths: ClassVar[tuple[str, ...]] = ("relative",)

    relative: Float[Array, "*batch"] = eqx.field(converter=number)
    """Relative change of every rotor's thrust."""

    @classmethod
    def neutral(cls) -> ThrustScale:
        return cls(relative=0.0)

    def change(self, parameters: Parameters) -> Parameters:
        changed = parameters.thrust_scale * (1 + self.relative[..., None])
        return eqx.tree_at(lambda p: p.thrust_scale, parameters, changed)
