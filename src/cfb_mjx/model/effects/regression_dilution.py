"""A statistical correction, not physics: in gentle flight only a share of a computed torque acts, and the rate decays.

    unanswered = dilution / (1 + (tau_x^2 + tau_y^2) / knee^2 + m / turning^2)
    tau_i     <- (1 - unanswered) tau_i - unanswered reversion I_i omega_i,    i = x, y
    time_constant m' = omega_x^2 + omega_y^2 - m

applied to the sum of all torques of the rotors and all other effects. In gentle flight the torques of rotors and air
nearly cancel, and a controller cancels what the model misses as well, so the small sum that a model computes is mostly
error. The best forecast uses only a share of a small sum (attenuation by errors in variables), and all of a large one
or of any sum in a flight with recent fast rotations. The rest is replaced by the average response, whatever its cause:
the body rate returns to zero (reversion to the mean). A model with a larger inertia would attenuate all torques, and
one with more damping would brake all rotations; both would be wrong where these are large.

For predictors only (`cfb refine --predictor`): a plant with this effect would respond less to its rotors the more
gently it is flown.
"""

from __future__ import annotations

from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from cfb_mjx.model.effects.base import EXPECTATION, Condition, Effect, Memory, Wrench
from cfb_mjx.model.effects.fields import number
from cfb_mjx.model.vector import Vec
from cfb_mjx.parameters.parameters import Limits, Parameters


class RegressionDilution(Effect):
    """A share dilution / (1 + tau^2 / knee^2 + m / turning^2) of the torque about x and y gives way to a reversion."""

    name: ClassVar[str] = "regression_dilution"
    units: ClassVar[dict[str, str]] = {
        "dilution": "1",
        "knee": "N m",
        "reversion": "1/s",
        "turning": "rad/s",
        "time_constant": "s",
    }
    source: ClassVar[str] = "W. Fuller, Measurement Error Models, 1987, chapter 1 (attenuation)"
    prior: ClassVar[dict[str, tuple[float, float]]] = {
        "dilution": (0.0, 1.0),
        "knee": (5e-5, 5e-3),
        "reversion": (0.0, 20.0),
        "turning": (0.3, 30.0),
        "time_constant": (0.1, 2.0),
    }
    limits: ClassVar[dict[str, Limits]] = {
        "dilution": Limits(0.0, 1.0, 0.0, 1.0),
        "knee": Limits(1e-07, 1.0, 1e-06, 0.1),
        "reversion": Limits(0.0, 1000.0, 0.0, 100.0),
        "turning": Limits(0.001, 1000.0, 0.05, 100.0),
        "time_constant": Limits(0.001, 10000.0, 0.05, 60.0),
    }
    strengths: ClassVar[tuple[str, ...]] = ("dilution",)
    # Acts on the sum of all torques.
    rank: ClassVar[int] = EXPECTATION
    searched: ClassVar[bool] = False

    dilution: Float[Array, "*batch"] = eqx.field(converter=number)
    """Share of a small torque in gentle flight that does not act."""
    knee: Float[Array, "*batch"] = eqx.field(converter=number)
    """Torque at which that share is halved."""
    reversion: Float[Array, "*batch"] = eqx.field(converter=number)
    """Rate at which the body rate decays where no torque acts."""
    turning: Float[Array, "*batch"] = eqx.field(converter=number)
    """Root mean square of the body rate about x and y at which that share of a small torque is halved."""
    time_constant: Float[Array, "*batch"] = eqx.field(converter=number)
    """Averaging time of the body rate: within `prior` it describes the present motion; longer, the whole flight."""

    @classmethod
    def neutral(cls) -> RegressionDilution:
        return cls(dilution=0.0, knee=5e-4, reversion=4.0, turning=3.0, time_constant=1.0)

    def start(self, rotor_speed: Vec, parameters: Parameters) -> Memory:
        return (Vec(jnp.zeros_like(rotor_speed[0])),)

    def body(self, wrench: Wrench, condition: Condition) -> Wrench:
        x, y, z = wrench.torque
        ((turned,),) = condition.memory
        known = 1 + (x * x + y * y) / self.knee**2 + turned / self.turning**2
        unanswered = self.dilution / known
        inertia = Vec.unstack(condition.parameters.inertia)
        returning = inertia.map(lambda i, rate: self.reversion * i * rate, condition.body_rate)
        x, y = (torque - unanswered * (torque + back) for torque, back in ((x, returning[0]), (y, returning[1])))
        return Wrench(wrench.force, Vec(x, y, z))

    def advance(self, condition: Condition, acceleration: Vec, dt: Any) -> Memory:
        ((turned,),) = condition.memory
        x, y, _ = condition.body_rate
        # Exact for a constant body rate, because rows of a log may be far apart.
        return (Vec(turned + (x * x + y * y - turned) * (1 - jnp.exp(-dt / self.time_constant))),)
