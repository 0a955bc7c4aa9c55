"""Battery sag: the same command turns the rotors slower on a weaker battery.

    steady rotor speed *= 1 + level + slope (V - 3.7 V) / 3.7 V

Slope 1 is a motor whose speed is proportional to the voltage, 0 one whose controller makes up for it. V is what was
read, through a first-order filter of time constant ``lag``: with a short one the rotors feel every dip under load, with
a long one they answer to how empty the battery is. Remembered are V, 3.7 V until a log says otherwise, and when it was
last read: the first reading is taken as it is, unknown ones are passed over. Between readings V stays.
"""

from __future__ import annotations

from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from cfb_mjx.model.effects.base import Effect, Memory, Motors, Reading
from cfb_mjx.model.effects.fields import number
from cfb_mjx.model.vector import Vec
from cfb_mjx.parameters.limits import Limits
from cfb_mjx.parameters.parameters import Parameters

NOMINAL_VOLTAGE = 3.7
"""Of one lithium-polymer cell, V."""
_LONG_AGO = 1000.0  # s


class BatterySag(Effect):
    """Steady rotor speed *= 1 + level + slope (V - 3.7) / 3.7."""

    name: ClassVar[str] = "battery_sag"
    meaning: ClassVar[str] = "rotor speed follows the battery's voltage"
    experiment: ClassVar[str] = "hover from a full battery to an empty one with the voltage logged"
    units: ClassVar[dict[str, str]] = {"level": "1", "slope": "1", "lag": "s"}
    source: ClassVar[str] = (
        "Q. Quan, Introduction to Multicopter Design and Control, 2017, ch. 4 (motor and ESC model: speed against "
        "voltage)"
    )
    prior: ClassVar[dict[str, tuple[float, float]]] = {"level": (-0.1, 0.1), "slope": (0.0, 1.2), "lag": (0.002, 5.0)}
    limits: ClassVar[dict[str, Limits]] = {
        "level": Limits(-0.95, 2.0, -0.3, 0.3),
        "slope": Limits(-1.0, 4.0, 0.0, 1.5),
        "lag": Limits(0.0001, 1000.0, 0.001, 60.0),
    }
    strengths: ClassVar[tuple[str, ...]] = ("level", "slope")
    probes: ClassVar[tuple[dict[str, float], ...]] = ({"lag": 0.02}, {"lag": 0.5})

    level: Float[Array, "*batch"] = eqx.field(converter=number)
    """Relative change at 3.7 V."""
    slope: Float[Array, "*batch"] = eqx.field(converter=number)
    """Relative change of speed per relative change of voltage."""
    lag: Float[Array, "*batch"] = eqx.field(converter=number, default=0.02)
    """Of what the rotors feel behind what was read, s."""

    @classmethod
    def neutral(cls) -> BatterySag:
        return cls(level=0.0, slope=0.0)

    def start(self, rotor_speed: Vec, parameters: Parameters) -> Memory:
        one = rotor_speed[0]
        return Vec(jnp.full_like(one, NOMINAL_VOLTAGE)), Vec(jnp.full_like(one, -_LONG_AGO))

    def sense(self, memory: Memory, reading: Reading) -> Memory:
        (voltage,), (time,) = memory
        now = jnp.asarray(reading.time, time.dtype)
        known = jnp.isfinite(reading.voltage)
        # Not multiplied by the unknown: NaN would come through any weight, and through the derivative.
        measured = jnp.where(known, reading.voltage, voltage).astype(voltage.dtype)
        kept = jnp.exp(-jnp.maximum(now - time, 0.0) / self.lag)
        return Vec(measured + (voltage - measured) * kept), Vec(jnp.where(known, now, time))

    def motors(
        self, motors: Motors, rotor_speed: Vec, memory: Memory, dt: Any, parameters: Parameters
    ) -> tuple[Motors, Memory]:
        (voltage,), _ = memory
        factor = 1 + self.level + self.slope * ((voltage - NOMINAL_VOLTAGE) / NOMINAL_VOLTAGE)
        return Motors(motors.target * factor, motors.time_constant), memory
