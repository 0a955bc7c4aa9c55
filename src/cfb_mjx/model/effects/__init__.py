"""Physical effects that the basic model leaves out, one module each, and the catalogue of their names."""

from cfb_mjx.model.effects.base import Condition, Effect, Memory, Motors, Reading, Wrench, overrides
from cfb_mjx.model.effects.battery_sag import BatterySag
from cfb_mjx.model.effects.blade_flapping import BladeFlapping
from cfb_mjx.model.effects.catalogue import (
    CATALOGUE,
    KNOWN,
    SENSOR_FAULTS,
    effect_from_mapping,
    effect_to_mapping,
    register,
)
from cfb_mjx.model.effects.cog_offset import CogOffset
from cfb_mjx.model.effects.command_delay import CommandDelay
from cfb_mjx.model.effects.downwash import Downwash
from cfb_mjx.model.effects.esc_rate_limit import EscRateLimit
from cfb_mjx.model.effects.formula import ResidualFormula
from cfb_mjx.model.effects.ground_effect import GroundEffect
from cfb_mjx.model.effects.gust import Gust
from cfb_mjx.model.effects.gyroscopic import Gyroscopic
from cfb_mjx.model.effects.inertia import Inertia
from cfb_mjx.model.effects.inertia_products import InertiaProducts
from cfb_mjx.model.effects.inflow_thrust import InflowThrust
from cfb_mjx.model.effects.jet import Jet
from cfb_mjx.model.effects.motor_asymmetry import MotorAsymmetry
from cfb_mjx.model.effects.motor_gain_mismatch import MotorGainMismatch
from cfb_mjx.model.effects.motor_hysteresis import MotorHysteresis
from cfb_mjx.model.effects.motor_second_order import MotorSecondOrder
from cfb_mjx.model.effects.motor_thermal_drift import MotorThermalDrift
from cfb_mjx.model.effects.motor_time_constant import MotorTimeConstant
from cfb_mjx.model.effects.parasitic_drag import ParasiticDrag
from cfb_mjx.model.effects.payload import Payload
from cfb_mjx.model.effects.payload_swing import PayloadSwing
from cfb_mjx.model.effects.position_moment import PositionMoment
from cfb_mjx.model.effects.prop_damage import PropDamage
from cfb_mjx.model.effects.rate_damping import RateDamping
from cfb_mjx.model.effects.regression_dilution import RegressionDilution
from cfb_mjx.model.effects.rotor_drag import RotorDrag
from cfb_mjx.model.effects.thrust_scale import ThrustScale
from cfb_mjx.model.effects.thrust_tilt import ThrustTilt
from cfb_mjx.model.effects.torque_scale import TorqueScale
from cfb_mjx.model.effects.translational_lift import TranslationalLift
from cfb_mjx.model.effects.vortex_ring import VortexRing
from cfb_mjx.model.effects.wall_effect import WallEffect
from cfb_mjx.model.effects.wind import Wind

__all__ = [
    "CATALOGUE",
    "KNOWN",
    "SENSOR_FAULTS",
    "BatterySag",
    "BladeFlapping",
    "CogOffset",
    "CommandDelay",
    "Condition",
    "Downwash",
    "Effect",
    "EscRateLimit",
    "GroundEffect",
    "Gust",
    "Gyroscopic",
    "Inertia",
    "InertiaProducts",
    "InflowThrust",
    "Jet",
    "Memory",
    "MotorAsymmetry",
    "MotorGainMismatch",
    "MotorHysteresis",
    "MotorSecondOrder",
    "MotorThermalDrift",
    "MotorTimeConstant",
    "Motors",
    "ParasiticDrag",
    "Payload",
    "PayloadSwing",
    "PositionMoment",
    "PropDamage",
    "RateDamping",
    "Reading",
    "RegressionDilution",
    "ResidualFormula",
    "RotorDrag",
    "ThrustScale",
    "ThrustTilt",
    "TorqueScale",
    "TranslationalLift",
    "VortexRing",
    "WallEffect",
    "Wind",
    "Wrench",
    "effect_from_mapping",
    "effect_to_mapping",
    "overrides",
    "register",
]
