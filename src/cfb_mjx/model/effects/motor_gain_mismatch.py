"""Motors that turn faster or slower than the model's for the same command: K_i *= 1 + relative_i."""

from __future__ import annotations

from typing import ClassVar

import equinox as eqx
from jaxtyping import Array, Float

from cfb_mjx.model.effects.base import Effect
from cfb_mjx.model.effects.fields import vector
from cfb_mjx.model.effects.motor_time_constant import MotorTimeConstant
from cfb_mjx.parameters.parameters import Limits, Parameters


class MotorGainMismatch(Effect):
    """K_i *= 1 + relative_i."""

    name: ClassVar[str] = "motor_gain_mismatch"
    meaning: ClassVar[str] = "single motors turn faster or slower than their command says"
    experiment: ClassVar[str] = MotorTimeConstant.experiment
    units: ClassVar[dict[str, str]] = {"relative": "1"}
    source: ClassVar[str] = (
        "Q. Quan, Introduction to Multicopter Design and Control, 2017, ch. 4 (steady speed is affine in throttle, "
        "fitted motor by motor)"
    )
    prior: ClassVar[dict[str, tuple[float, float]]] = {"relative": (-0.15, 0.15)}
    limits: ClassVar[dict[str, Limits]] = {"relative": Limits(-0.95, 5.0, -0.5, 0.5)}
    strengths: ClassVar[tuple[str, ...]] = ("relative",)

    relative: Float[Array, "*batch 4"] = eqx.field(converter=vector(4))
    """Relative change of each motor's gain, motors M1..M4."""

    @classmethod
    def neutral(cls) -> MotorGainMismatch:
        return cls(relative=0.0)

    def change(self, parameters: Parameters) -> Parameters:
        changed = parameters.motor_gain * (1 + self.relative)
        return eqx.tree_at(lambda p: p.motor_gain, parameters, changed)
