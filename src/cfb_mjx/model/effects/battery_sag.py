"""Battery sag: at the same command the rotors turn slower on a weaker battery.

    steady rotor speed *= 1 + level + slope (V - 3.7 V) / 3.7 V

Slope 1 describes a motor whose speed is proportional to the voltage, slope 0 a controller that compensates for it. V is
the battery's voltage behind a first-order filter with time constant ``lag``. With a short lag the rotors follow every
dip under load, with a long one only the state of charge.

In simulation V is the voltage of a cell with state of charge s, open-circuit voltage E and resistance R:

    E(s) = 3.685 + 0.2156 s - 0.1178 s^2 + 0.3201 s^3 - 1.031 exp(-35 s)
    E - R i = P / i,   P = power mean_j((Omega_j / 1594 rad/s)^3),   capacity s' = -i

where i is the current and P the power of the rotors, which grows with the cube of their speed. A cell gives at most
E^2 / (4 R); if more power is asked for, it stays at E / 2. An empty cell (s = 0) has 2.65 V and stays empty.

Along a log V follows the readings of the log. The first reading is taken unfiltered, unknown readings are skipped, and
V is constant between readings, also in predictions that start from the log. If a log has no voltage, V is 3.7 V,
because the charge of that battery is unknown. The memory holds V, the time of the last reading, s, and whether the
flight is a simulation (no log has been read yet).
"""

from __future__ import annotations

from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from cfb_mjx.model.effects.base import Condition, Effect, Memory, Motors, Reading
from cfb_mjx.model.effects.fields import HOVER_SPEED, number
from cfb_mjx.model.vector import Vec
from cfb_mjx.parameters.parameters import Limits, Parameters

NOMINAL_VOLTAGE = 3.7
"""Voltage of one lithium-polymer cell that is half full, at the load of hover, V."""
_LONG_AGO = 1000.0  # s


class BatterySag(Effect):
    """Steady rotor speed *= 1 + level + slope (V - 3.7) / 3.7."""

    name: ClassVar[str] = "battery_sag"
    meaning: ClassVar[str] = "rotor speed follows the battery's voltage"
    experiment: ClassVar[str] = "hover from a full battery to an empty one with the voltage logged"
    units: ClassVar[dict[str, str]] = {
        "level": "1",
        "slope": "1",
        "lag": "s",
        "charge": "1",
        "capacity": "A s",
        "resistance": "ohm",
        "power": "W",
    }
    source: ClassVar[str] = (
        "Q. Quan, Introduction to Multicopter Design and Control, 2017, ch. 4 (motor and ESC model: speed against "
        "voltage); M. Chen, G. Rincon-Mora, Accurate electrical battery model, IEEE Trans. Energy Conversion 21(2), "
        "2006, eq. 2 (open-circuit voltage)"
    )
    prior: ClassVar[dict[str, tuple[float, float]]] = {
        "level": (-0.1, 0.1),
        "slope": (0.0, 1.2),
        "lag": (0.002, 5.0),
        "charge": (0.05, 1.0),
        "capacity": (900.0, 1800.0),
        "resistance": (0.02, 0.2),
        "power": (3.0, 15.0),
    }
    limits: ClassVar[dict[str, Limits]] = {
        "level": Limits(-0.95, 2.0, -0.3, 0.3),
        "slope": Limits(-1.0, 4.0, 0.0, 1.5),
        "lag": Limits(0.0001, 1000.0, 0.001, 60.0),
        "charge": Limits(0.0, 1.0, 0.0, 1.0),
        "capacity": Limits(1.0, 36000.0, 900.0, 1800.0),
        "resistance": Limits(0.0, 10.0, 0.005, 0.5),
        "power": Limits(0.0, 1000.0, 1.0, 30.0),
    }
    strengths: ClassVar[tuple[str, ...]] = ("level", "slope")
    # Along a log the readings take the place of the cell.
    assumed: ClassVar[tuple[str, ...]] = ("charge", "capacity", "resistance", "power")
    # The level scales the gains of all motors by one factor.
    said_by: ClassVar[dict[str, str]] = {"level": "motor_gain_mismatch"}
    probes: ClassVar[tuple[dict[str, float], ...]] = ({"lag": 0.02}, {"lag": 0.5})

    level: Float[Array, "*batch"] = eqx.field(converter=number)
    """Relative change at 3.7 V."""
    slope: Float[Array, "*batch"] = eqx.field(converter=number)
    """Relative change of speed per relative change of voltage."""
    lag: Float[Array, "*batch"] = eqx.field(converter=number, default=0.02)
    """Time constant of the filter on the battery's voltage, s."""
    charge: Float[Array, "*batch"] = eqx.field(converter=number, default=0.5)
    """State of charge at the start of a simulation: 1 full, 0 empty."""
    capacity: Float[Array, "*batch"] = eqx.field(converter=number, default=1260.0)
    """Charge of a full cell, A s; default: 350 mAh, the drone's own battery."""
    resistance: Float[Array, "*batch"] = eqx.field(converter=number, default=0.05)
    """Resistance of cell, plug and wires, ohm: a drone of the IDSIA nano-drone benchmark dips by 0.1 V in hover."""
    power: Float[Array, "*batch"] = eqx.field(converter=number, default=7.0)
    """Power of the four rotors at 1594 rad/s, W. The default is 3.9 W at the shafts (0.43 N at a torque of 5.7 mm times
    the thrust: firmware, platform CF21BL) at an efficiency of motors and controllers of 55 %."""

    @classmethod
    def neutral(cls) -> BatterySag:
        return cls(level=0.0, slope=0.0)

    def start(self, rotor_speed: Vec, parameters: Parameters) -> Memory:
        one = rotor_speed[0]
        full = jnp.asarray(self.charge, one.dtype) + 0.0 * one
        voltage, _ = self.loaded(full, rotor_speed)
        return Vec(voltage), Vec(jnp.full_like(one, -_LONG_AGO)), Vec(full), Vec(jnp.ones_like(one))

    def loaded(self, charge: Any, rotor_speed: Vec) -> tuple[Any, Any]:
        """Voltage [V] and current [A] of a cell that drives the rotors at the given speeds."""
        open_ = 3.685 + charge * (0.2156 + charge * (-0.1178 + charge * 0.3201)) - 1.031 * jnp.exp(-35 * charge)
        power = 0.25 * self.power * (rotor_speed * (1 / HOVER_SPEED)).map(lambda x: x * x * x).sum()
        left = open_ * open_ - 4 * self.resistance * power
        able = left > 0
        voltage = 0.5 * (open_ + jnp.where(able, jnp.sqrt(jnp.where(able, left, 1.0)), 0.0))
        return voltage, power / voltage

    def sense(self, memory: Memory, reading: Reading) -> Memory:
        (voltage,), (time,), charge, (alone,) = memory
        voltage = jnp.where(alone > 0, NOMINAL_VOLTAGE, voltage).astype(voltage.dtype)
        now = jnp.asarray(reading.time, time.dtype)
        known = jnp.isfinite(reading.voltage)
        # Selected, not weighted: NaN passes through any weight, and through the derivative.
        measured = jnp.where(known, reading.voltage, voltage).astype(voltage.dtype)
        kept = jnp.exp(-jnp.maximum(now - time, 0.0) / self.lag)
        felt = measured + (voltage - measured) * kept
        return Vec(felt), Vec(jnp.where(known, now, time)), charge, Vec(0.0 * alone)

    def advance(self, condition: Condition, acceleration: Vec, dt: Any) -> Memory:
        (voltage,), time, (charge,), (alone,) = condition.memory
        now, current = self.loaded(charge, condition.rotor_speed)
        felt = voltage + (now - voltage) * (1 - jnp.exp(-dt / self.lag))
        left = charge - current * dt / self.capacity
        simulated = alone > 0
        voltage = jnp.where(simulated, felt, voltage)
        charge = jnp.where(simulated, jnp.where(left > 0, left, 0.0), charge)
        return Vec(voltage), time, Vec(charge), Vec(alone)

    def motors(
        self, motors: Motors, rotor_speed: Vec, memory: Memory, dt: Any, parameters: Parameters
    ) -> tuple[Motors, Memory]:
        voltage = memory[0][0]
        factor = 1 + self.level + self.slope * ((voltage - NOMINAL_VOLTAGE) / NOMINAL_VOLTAGE)
        return Motors(motors.target * factor, motors.time_constant), memory
