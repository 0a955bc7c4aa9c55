"""Effects that a simulated drone can have. Each changes a copy of the nominal parameters and returns its draws.

``strength`` scales an effect: 1 is a strong effect of typical size, 0.3 a weak one. SI units.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from cfb_mjx.reference_simulator import constants as c
from cfb_mjx.reference_simulator.physics import attach

Drone = dict[str, np.ndarray]
Drawn = dict[str, object]
Effect = Callable[[np.random.Generator, Drone, float], Drawn]

EFFECTS: dict[str, Effect] = {}
OUTSIDE = "outside"
PAIRED = "downwash"
"""The effect that needs a second drone."""


def effect(draw: Effect) -> Effect:
    """Register an effect under the name of its function."""
    EFFECTS[draw.__name__] = draw
    return draw


def label(name: str) -> str:
    """Name that a perfect diagnosis would give to an effect."""
    return OUTSIDE if name.startswith(OUTSIDE) else name


def apply(name: str, rng: np.random.Generator, drone: Drone, strength: float) -> Drawn:
    """Add an effect to a drone, in place; the name ``outside`` draws one of the effects outside the catalogue."""
    if name == OUTSIDE:
        name = str(rng.choice([key for key in EFFECTS if key.startswith(OUTSIDE)]))
    return {"kind": name, "strength": strength} | EFFECTS[name](rng, drone, strength)


def put(drone: Drone, **values) -> Drawn:
    """Set parameters of a drone; return them as plain numbers for the truth."""
    for name, value in values.items():
        drone[name] = np.asarray(value, dtype=float)
    return {name: np.asarray(value).tolist() for name, value in values.items()}


def sign(rng: np.random.Generator, *shape: int):
    """Random signs."""
    return rng.choice([-1.0, 1.0], size=shape or None)


@effect
def rotor_drag(rng, drone, strength):
    total = strength * rng.uniform(0.012, 0.03)
    return put(drone, rotor_drag=total / 4 * (1 + rng.uniform(-0.12, 0.12, 2)), rotor_drag_speed=rng.uniform(6.0, 10.0))


@effect
def parasitic_drag(rng, drone, strength):
    size = strength * rng.uniform(0.005, 0.012)
    shape = np.array([rng.uniform(0.85, 1.0), rng.uniform(1.0, 1.15), rng.uniform(1.2, 1.6)])
    return put(drone, body_drag=size * shape, body_drag_cross=rng.uniform(0.1, 0.4))


@effect
def wind(rng, drone, strength):
    force, angle = strength * rng.uniform(0.006, 0.015), rng.uniform(0, 2 * np.pi)
    return put(
        drone,
        wind=force * np.array([np.cos(angle), np.sin(angle)]),
        gust=force * rng.uniform(0.15, 0.3),
        shear=rng.uniform(0.05, 0.15),
    )


@effect
def inflow_thrust(rng, drone, strength):
    return put(drone, inflow=strength * rng.uniform(5.0, 9.0))


@effect
def ground_effect(rng, drone, strength):
    core = rng.uniform(0.05, 0.08)
    gain = strength * rng.uniform(0.12, 0.3)  # of thrust at 0.1 m
    image = gain / (1 + 0.6 * gain)
    return put(drone, ground=image * (0.01 + core**2), ground_core=core, ground_wash=rng.uniform(2.0, 4.0)) | {
        "gain_at_100_mm": gain
    }


@effect
def battery_sag(rng, drone, strength):
    return put(drone, sag=strength * rng.uniform(0.7, 1.0), sag_voltage=rng.uniform(3.6, 3.8))


@effect
def motor_gain_mismatch(rng, drone, strength):
    ratio = 1 + strength * sign(rng, 4) * rng.uniform(0.02, 0.06, 4)
    return put(drone, gain=drone["gain"] * ratio) | {"ratio": ratio.tolist()}


@effect
def cog_offset(rng, drone, strength):
    size, angle = strength * rng.uniform(0.0015, 0.004), rng.uniform(0, 2 * np.pi)
    return put(drone, cog=drone["cog"] + size * np.array([np.cos(angle), np.sin(angle), 0.0]))


@effect
def thrust_tilt(rng, drone, strength):
    # All axes tilt one way (bent frame), and each a little sideways (twisted arms, which give a yaw torque).
    lean, angle = np.radians(rng.uniform(0.5, 1.5)), rng.uniform(0, 2 * np.pi)
    twist = np.radians(rng.uniform(0.0, 1.0)) * sign(rng)
    common = lean * np.array([[np.cos(angle)], [np.sin(angle)]])
    tangent = np.concatenate([-c.ROTOR_Y.T, c.ROTOR_X.T]) / (np.sqrt(2) * c.HALF)
    own = np.radians(0.2) * rng.standard_normal((2, 4))
    return put(drone, tilt=strength * (common + twist * tangent + own))


@effect
def gyroscopic(rng, drone, strength):
    return put(drone, gyro_inertia=strength * rng.uniform(3.0, 8.0) * c.ROTOR_INERTIA)


@effect
def motor_asymmetry(rng, drone, strength):
    difference = strength * rng.uniform(0.35, 0.8)
    return put(drone, asymmetry=np.log1p(difference), asymmetry_width=rng.uniform(50.0, 120.0))


@effect
def command_delay(rng, drone, strength):
    return put(drone, delay_ms=max(1, round(strength * rng.uniform(4.0, 12.0))))


@effect
def esc_rate_limit(rng, drone, strength):
    rate = rng.uniform(3.0, 6.0) / strength
    if rng.random() < 0.5:
        return put(drone, esc_rate=rate)
    # A current limit bounds the rotor's acceleration, which the motor's lag already keeps below the command's rate.
    return put(drone, spin_limit=0.2 * rate * c.MOTOR_GAIN)


@effect
def motor_second_order(rng, drone, strength):
    return put(drone, second_lag=strength * rng.uniform(0.008, 0.02))


@effect
def blade_flapping(rng, drone, strength):
    return put(
        drone,
        flapping=strength * rng.uniform(1.5e-4, 4e-4),
        flapping_cross=rng.uniform(0.1, 0.3),
        flapping_climb=rng.uniform(0.05, 0.2),
    )


@effect
def payload(rng, drone, strength):
    mass = strength * rng.uniform(0.003, 0.008)
    place = np.array([*rng.uniform(-5e-4, 5e-4, 2), -rng.uniform(0.01, 0.03)])
    side = 0.015
    attach(drone, mass, place, np.full(3, mass * side**2 / 6))
    return {"mass": mass, "place": place.tolist()}


@effect
def payload_swing(rng, drone, strength):
    return put(drone, bob_mass=strength * rng.uniform(0.003, 0.006), bob_length=rng.uniform(0.1, 0.2))


@effect
def thrust_scale(rng, drone, strength):
    change = strength * rng.uniform(0.04, 0.1) * sign(rng)
    return put(drone, thrust_scale=1 + change, thrust_bend=0.3 * change)


@effect
def torque_scale(rng, drone, strength):
    change = rng.uniform(-0.4, -0.2) if rng.random() < 0.5 else rng.uniform(0.25, 0.6)
    return put(drone, torque_scale=1 + strength * change)


@effect
def inertia(rng, drone, strength):
    ratio = 1 + strength * sign(rng, 3) * rng.uniform(0.1, 0.25, 3)
    root = np.sqrt(ratio)
    return put(drone, inertia=drone["inertia"] * np.outer(root, root)) | {"ratio": ratio.tolist()}


@effect
def motor_thermal_drift(rng, drone, strength):
    return put(drone, thermal_drop=strength * rng.uniform(0.03, 0.08), thermal_time=rng.uniform(10.0, 30.0))


@effect
def motor_time_constant(rng, drone, strength):
    change = rng.uniform(-0.25, -0.12) if rng.random() < 0.5 else rng.uniform(0.12, 0.3)
    return put(drone, lag=drone["lag"] * (1 + strength * change))


@effect
def sensor_time_shift(rng, drone, strength):
    return put(drone, motor_shift=int(sign(rng) * max(1, round(strength * rng.uniform(2.0, 8.0)))))


@effect
def sensor_velocity_scale(rng, drone, strength):
    return put(drone, velocity_scale=1 + strength * rng.uniform(0.05, 0.10))


@effect
def sensor_delay(rng, drone, strength):
    return put(drone, extra_delay=max(1, round(strength * rng.uniform(10.0, 20.0))))


@effect
def sensor_gyro_lowpass(rng, drone, strength):
    return put(drone, gyro_corner=rng.uniform(15.0, 40.0) / strength)


@effect
def outside_wash(rng, drone, strength):
    """Propeller wash: forward flight with a yaw rate rolls the drone."""
    return put(drone, wash=strength * rng.uniform(4e-5, 8e-5) * sign(rng))


@effect
def outside_pairs(rng, drone, strength):
    """Roll and pitch torques that grow with the square of the speed difference of diagonal rotors."""
    return put(drone, pairs=strength * rng.uniform(3e-9, 6e-9, 2) * sign(rng, 2))


@effect
def outside_flex(rng, drone, strength):
    """A part of the frame on a spring that oscillates about the pitch axis."""
    return put(
        drone,
        flex=strength * rng.uniform(0.15, 0.35) * c.INERTIA[1],
        flex_frequency=2 * np.pi * rng.uniform(3.0, 6.0),
        flex_damping=rng.uniform(0.03, 0.08),
    )


@effect
def outside_tether(rng, drone, strength):
    """Attraction to a point in the room, as by an elastic tether."""
    return put(
        drone,
        tether=strength * rng.uniform(0.01, 0.025),
        tether_point=[*rng.uniform(-0.8, 0.8, 2), rng.uniform(0.5, 1.5)],
    )


@effect
def outside_periodic(rng, drone, strength):
    """A torque that rotates at a fixed frequency."""
    return put(
        drone,
        spin_torque=strength * rng.uniform(1e-4, 2.5e-4),
        spin_frequency=2 * np.pi * rng.uniform(1.0, 2.0),
    )


@effect
def outside_wall(rng, drone, strength):
    """Attraction to a wall at the edge of the flight space."""
    return put(
        drone,
        wall=strength * rng.uniform(0.04, 0.08),
        wall_x=rng.uniform(1.2, 2.0),
        wall_depth=rng.uniform(0.35, 0.6),
    )


# New effects come last, because the seeds of studies depend on the order.
@effect
def prop_damage(rng, drone, strength):
    """A damaged propeller: less thrust, and more or less torque."""
    motor, blades = int(rng.integers(4)), drone["blades"].copy()
    blades[:, motor] *= 1 + strength * np.array([-rng.uniform(0.04, 0.1), sign(rng) * rng.uniform(0.05, 0.2)])
    return put(drone, blades=blades) | {"motor": motor + 1}


@effect
def motor_hysteresis(rng, drone, strength):
    """Speed controllers with hysteresis (play)."""
    return put(drone, play=strength * rng.uniform(0.006, 0.015), play_share=rng.uniform(0.6, 1.0))


@effect
def downwash(rng, drone, strength):
    """The wake of a second drone, which then takes part in all flights."""
    return put(
        drone,
        wake=strength * rng.uniform(0.003, 0.006),
        wake_width=rng.uniform(0.035, 0.055),
        wake_growth=rng.uniform(0.06, 0.1),
        wake_pace=rng.uniform(0.45, 0.75),
    )
