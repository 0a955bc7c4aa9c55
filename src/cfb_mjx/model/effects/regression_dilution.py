"""Small torques of gentle flights answered by less than their size, the body rate returns instead. No physics.

    unanswered = dilution / (1 + (tau_x^2 + tau_y^2) / knee^2 + m / turning^2)
    tau_i     <- (1 - unanswered) tau_i - unanswered reversion I_i omega_i,    i = x, y
    time_constant m' = omega_x^2 + omega_y^2 - m

of all torques of the rotors and all other effects. In gentle flight the torques of rotors and air nearly cancel, a
controller cancels what the model misses as well, and the small sum a model computes is mostly error: of a small one
only a share is to be expected (attenuation by errors in variables), of a large one, or in a flight that has been
turning hard of late, all of it. In place of the rest is what follows on average, whatever brings it about: the body
rate returns to zero (reversion to the mean). A model with a larger inertia does the former to all torques, and errs
wherever they are large; one with more damping does the latter, and errs there as well.

For predictors only (`cfb refine --predictor`): a plant with it would listen to its rotors less the gentler it is flown.
"""

from __future__ import annotations

from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from cfb_mjx.model.effects.base import EXPECTATION, Condition, Effect, Memory, Wrench
from cfb_mjx.model.effects.fields import number
from cfb_mjx.model.vector import Vec
from cfb_mjx.parameters.limits import Limits
from cfb_mjx.parameters.parameters import Parameters


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
    # Of all torques there are.
    rank: ClassVar[int] = EXPECTATION
    searched: ClassVar[bool] = False

    dilution: Float[Array, "*batch"] = eqx.field(converter=number)
    """Share of a small torque of a gentle flight that is not answered."""
    knee: Float[Array, "*batch"] = eqx.field(converter=number)
    """Torque of which half of that share is."""
    reversion: Float[Array, "*batch"] = eqx.field(converter=number)
    """How fast the body rate returns to zero where no torque is answered."""
    turning: Float[Array, "*batch"] = eqx.field(converter=number)
    """Rms body rate about x and y of a flight in which half of that share of a small torque is."""
    time_constant: Float[Array, "*batch"] = eqx.field(converter=number)
    """How long the flight is remembered: within `prior`, what it does; longer, which flight it is."""

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
        # Exact for a constant body rate: rows of a log may be far apart.
        return (Vec(turned + (x * x + y * y - turned) * (1 - jnp.exp(-dt / self.time_constant))),)
