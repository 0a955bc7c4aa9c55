"""Vortex ring state: a rotor that sinks into its own wake accelerates the air more and lifts less.

    f_i -= coefficient (Omega_i / 1594 rad/s) (w - w_h),  w_h = induced_velocity Omega_i / 1594 rad/s
    (w - w_h) / w_h = -1.125 m - 1.372 m^2 - 1.718 m^3 - 0.655 m^4,  m = v_i,z / w_h from -2 to 0

where w is the induced velocity and w_h its value in hover. The curve was measured on helicopters. In climb nothing
changes; in descents faster than twice the induced velocity the rotor is a windmill, and the curve is constant. The
coefficient has the meaning of that of `inflow_thrust`: thrust lost per flow through the rotor.

`cfb close-loop` does not search for it: in slow descents it looks like another strength of `inflow_thrust`. Name it if
a drone fell faster than half its induced velocity, 2 m/s.
"""

from __future__ import annotations

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from cfb_mjx.model.effects.base import Condition, Effect
from cfb_mjx.model.effects.fields import HOVER_SPEED, hub_velocities, number
from cfb_mjx.model.rotors import RotorLoads
from cfb_mjx.parameters.parameters import Limits

_CURVE = (-1.125, -1.372, -1.718, -0.655)
_WINDMILL = -2.0


class VortexRing(Effect):
    """f_i -= coefficient (Omega_i / 1594) (w - w_h) in descent."""

    name: ClassVar[str] = "vortex_ring"
    meaning: ClassVar[str] = "thrust falls in fast descent, the rotors sinking into their own wake"
    experiment: ClassVar[str] = "vertical descents at 1, 2, 3 and 4 m/s"
    units: ClassVar[dict[str, str]] = {"coefficient": "N s/m", "induced_velocity": "m/s"}
    source: ClassVar[str] = "J. G. Leishman, Principles of Helicopter Aerodynamics, 2nd ed. 2006, sec. 2.13.6"
    prior: ClassVar[dict[str, tuple[float, float]]] = {"coefficient": (0.0, 0.02), "induced_velocity": (3.0, 6.0)}
    limits: ClassVar[dict[str, Limits]] = {
        "coefficient": Limits(-1.0, 1.0, -0.01, 0.1),
        "induced_velocity": Limits(0.1, 100.0, 2.0, 10.0),
    }
    strengths: ClassVar[tuple[str, ...]] = ("coefficient",)
    assumed: ClassVar[tuple[str, ...]] = ("induced_velocity",)
    searched: ClassVar[bool] = False
    feels_air: ClassVar[bool] = True

    coefficient: Float[Array, "*batch"] = eqx.field(converter=number)
    """Thrust lost per velocity, per rotor at hover speed."""
    induced_velocity: Float[Array, "*batch"] = eqx.field(converter=number)
    """Induced velocity at hover speed."""

    @classmethod
    def neutral(cls) -> VortexRing:
        # Momentum theory: sqrt(0.108 N / (2 1.2 kg/m^3 pi (27.5 mm)^2)).
        return cls(coefficient=0.0, induced_velocity=4.35)

    def rotors(self, loads: RotorLoads, condition: Condition) -> RotorLoads:
        _, _, axial = hub_velocities(condition)
        ratio = condition.rotor_speed * (1 / HOVER_SPEED)
        hover = self.induced_velocity * ratio

        def faster(axial, hover):
            # w - w_h from the velocities themselves: for a stopped rotor their ratio does not exist.
            still = hover <= 1e-6
            share = jnp.clip(axial / jnp.where(still, 1.0, hover), _WINDMILL, 0.0)
            curve = 0.0
            for slope in reversed(_CURVE):
                curve = (curve + slope) * share
            return jnp.where(still, 0.0, hover * curve)

        lost = self.coefficient * ratio * axial.map(faster, hover)
        return RotorLoads(loads.thrust - lost, loads.torque, loads.rate)
