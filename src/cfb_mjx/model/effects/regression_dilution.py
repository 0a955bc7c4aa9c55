"""Small torques answered by less than their size: what forecasts best where a torque is known only roughly. No physics.

    (tau_x, tau_y) *= 1 - dilution knee^2 / (knee^2 + tau_x^2 + tau_y^2)

of all torques of the effects before it and the rotors. In gentle flight the torques of rotors and air nearly cancel, a
controller cancels what the model misses as well, and the small sum a model computes is mostly error: of a small one
only a share is to be expected (attenuation by errors in variables), of a large one all of it. A model with a larger
inertia does the same to all torques, and errs wherever they are large.

For predictors only (`cfb refine --predictor`): a plant with it would listen to its rotors less the gentler it is flown.
"""

from __future__ import annotations

from typing import ClassVar

import equinox as eqx
from jaxtyping import Array, Float

from cfb_mjx.model.effects.base import Condition, Effect, Wrench
from cfb_mjx.model.effects.fields import number
from cfb_mjx.model.vector import Vec


class RegressionDilution(Effect):
    """Torque about x and y *= 1 - dilution knee^2 / (knee^2 + tau_x^2 + tau_y^2)."""

    name: ClassVar[str] = "regression_dilution"
    units: ClassVar[dict[str, str]] = {"dilution": "1", "knee": "N m"}
    source: ClassVar[str] = "W. Fuller, Measurement Error Models, 1987, chapter 1 (attenuation)"
    prior: ClassVar[dict[str, tuple[float, float]]] = {"dilution": (0.0, 1.0), "knee": (5e-5, 5e-3)}
    strengths: ClassVar[tuple[str, ...]] = ("dilution",)
    searched: ClassVar[bool] = False

    dilution: Float[Array, "*batch"] = eqx.field(converter=number)
    """Share of a small torque that is not answered."""
    knee: Float[Array, "*batch"] = eqx.field(converter=number)
    """Torque of which half of that share is."""

    @classmethod
    def neutral(cls) -> RegressionDilution:
        return cls(dilution=0.0, knee=5e-4)

    def body(self, wrench: Wrench, condition: Condition) -> Wrench:
        x, y, z = wrench.torque
        kept = 1 - self.dilution * self.knee**2 / (self.knee**2 + x * x + y * y)
        return Wrench(wrench.force, Vec(kept * x, kept * y, z))
