"""Moments of inertia that differ from the model's: J_k *= 1 + relative_k on each principal axis.

The result may violate the triangle inequality that holds for real bodies. The effect shows how far a flight asks for
another inertia, and its derivative must not stop at that border.
"""

from __future__ import annotations

from typing import ClassVar

import equinox as eqx
from jaxtyping import Array, Float

from cfb_mjx.model.effects.base import Effect
from cfb_mjx.model.effects.fields import vector
from cfb_mjx.parameters.parameters import Limits, Parameters


class Inertia(Effect):
    """J_k *= 1 + relative_k."""

    name: ClassVar[str] = "inertia"
    meaning: ClassVar[str] = "the moments of inertia differ from the declared ones"
    experiment: ClassVar[str] = "cfb excite roll-pitch: doublets about roll and pitch, and yaw turns both ways"
    units: ClassVar[dict[str, str]] = {"relative": "1"}
    source: ClassVar[str] = "How to Model Your Crazyflie Brushless, ICRA 2026, eq. 4"
    prior: ClassVar[dict[str, tuple[float, float]]] = {"relative": (-0.5, 0.5)}
    limits: ClassVar[dict[str, Limits]] = {"relative": Limits(-0.95, 20.0, -0.8, 4.0)}
    strengths: ClassVar[tuple[str, ...]] = ("relative",)

    relative: Float[Array, "*batch 3"] = eqx.field(converter=vector(3))
    """Change about body x, y and z; above -1."""

    @classmethod
    def neutral(cls) -> Inertia:
        return cls(relative=0.0)

    def change(self, parameters: Parameters) -> Parameters:
        changed = parameters.inertia * (1 + self.relative)
        return eqx.tree_at(lambda p: p.inertia, parameters, changed)
