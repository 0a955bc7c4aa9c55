"""Centre of gravity shifted against the rotors' centre along body x and y, in addition to the model's own offset."""

from __future__ import annotations

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from cfb_mjx.model.effects.base import Effect
from cfb_mjx.model.effects.fields import vector
from cfb_mjx.parameters.parameters import Limits, Parameters


class CogOffset(Effect):
    """center_of_gravity += (offset_x, offset_y, 0)."""

    name: ClassVar[str] = "cog_offset"
    meaning: ClassVar[str] = "the centre of gravity does not lie in the middle of the rotors"
    experiment: ClassVar[str] = "long hovers with the heading turned by 90 degrees in between"
    units: ClassVar[dict[str, str]] = {"offset": "m"}
    source: ClassVar[str] = "How to Model Your Crazyflie Brushless, ICRA 2026, domain randomisation (centre of gravity)"
    prior: ClassVar[dict[str, tuple[float, float]]] = {"offset": (-0.01, 0.01)}
    limits: ClassVar[dict[str, Limits]] = {"offset": Limits(-0.1, 0.1, -0.03, 0.03)}
    strengths: ClassVar[tuple[str, ...]] = ("offset",)

    offset: Float[Array, "*batch 2"] = eqx.field(converter=vector(2))
    """Shift along body x and y."""

    @classmethod
    def neutral(cls) -> CogOffset:
        return cls(offset=0.0)

    def change(self, parameters: Parameters) -> Parameters:
        changed = parameters.center_of_gravity + jnp.concatenate([self.offset, 0 * self.offset[..., :1]], axis=-1)
        return eqx.tree_at(lambda p: p.center_of_gravity, parameters, changed)
