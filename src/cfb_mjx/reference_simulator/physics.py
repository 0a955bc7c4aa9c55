"""Parameters of drones: nominal values, those of effects (zero: absent), and stacking over lanes (drones)."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np

from cfb_mjx.reference_simulator import constants as c

# Parameters of one drone. An effect changes a copy. What differs from these values in any lane is simulated.
NOMINAL: dict[str, object] = {
    "mass": c.MASS,
    "cog": (0.0, 0.0, 0.0),  # m, from the rotors' centre
    "inertia": np.diag(c.INERTIA),  # about the centre of gravity
    "gain": (c.MOTOR_GAIN,) * 4,
    "lag": c.MOTOR_LAG,
    "thrust_scale": 1.0,
    "thrust_bend": 0.0,  # change of the scale per unit of Omega / SPEED_SCALE
    "torque_scale": 1.0,
    "blades": np.ones((2, 4)),  # thrust and torque of each propeller over those of an undamaged one
    "rotor_drag": (0.0, 0.0),  # N s/m per rotor at hover thrust, along body x and y
    "rotor_drag_speed": 8.0,  # m/s at which it saturates
    "body_drag": (0.0, 0.0, 0.0),  # N s^2/m^2
    "body_drag_cross": 0.0,
    "wind": (0.0, 0.0),  # N, horizontal, world, at 1 m height
    "gust": 0.0,  # N rms
    "shear": 0.15,  # exponent of the wind's profile
    "convergence": 0.0,  # 1/s: speed of the air towards the middle of the room per distance from it
    "inflow": 0.0,
    "ground": 0.0,  # m^2: square of the effective radius over 16
    "ground_core": 0.06,  # m of height below which the effect levels off
    "ground_wash": 2.5,  # m/s of lateral speed that halves it
    "sag": 0.0,  # exponent
    "sag_voltage": 3.7,
    "tilt": np.zeros((2, 4)),  # rad: tilt of each rotor's axis towards body x and y
    "gyro_inertia": 0.0,
    "asymmetry": 0.0,  # log(spin-down constant / spin-up constant)
    "asymmetry_width": 80.0,  # rad/s: width of the transition between the two
    "delay_ms": 0,
    "esc_rate": 0.0,  # 1/s; 0: none
    "play": 0.0,  # half the mean play of a speed controller, as a share of full command
    "play_share": 0.0,  # share of the command that passes through the play
    "spin_limit": 0.0,  # rad/s^2: limit of a rotor's acceleration; 0: none
    "second_lag": 0.0,  # s
    "flapping": 0.0,  # N m s/m of all rotors at hover
    "flapping_cross": 0.0,
    "flapping_climb": 0.0,
    "bob_mass": 0.0,
    "bob_length": 0.15,
    "thermal_drop": 0.0,
    "thermal_time": 20.0,
    "wash": 0.0,
    "pairs": (0.0, 0.0),
    "flex": 0.0,  # kg m^2: inertia of the part on the spring
    "flex_frequency": 30.0,  # rad/s
    "flex_damping": 0.05,
    "tether": 0.0,  # N/m
    "tether_point": (0.0, 0.0, 0.0),
    "spin_torque": 0.0,  # N m
    "spin_frequency": 8.0,  # rad/s
    "wall": 0.0,  # N
    "wall_x": 1.0,
    "wall_depth": 0.5,
    "wake": 0.0,  # N s^2/m^2: force in another drone's wake over the square of the air's speed
    "wake_width": 0.045,  # m from the axis at which the wake's speed has fallen to half, beside the other drone
    "wake_growth": 0.077,  # growth of that width per distance
    "wake_pace": 0.6,  # speed at which the wake moves on, over that of the air on its axis
    # These change the logged columns only.
    "motor_shift": 0,  # ticks by which the motor columns are late
    "extra_delay": 0,  # ticks by which pose and velocity are later than declared
    "velocity_scale": 1.0,
    "gyro_corner": 0.0,  # Hz; 0: none
}


def nominal() -> dict[str, np.ndarray]:
    """Return a copy of the nominal parameters."""
    return {name: np.array(value, dtype=float) for name, value in NOMINAL.items()}


def stack(drones: list[dict[str, np.ndarray]]) -> SimpleNamespace:
    """Stack the parameters of F drones along a last axis; ``on`` names those that differ from nominal."""
    physics = SimpleNamespace(**{name: np.stack([d[name] for d in drones], axis=-1) for name in NOMINAL})
    physics.on = frozenset(
        name for name, value in NOMINAL.items() if any(np.any(d[name] != np.asarray(value)) for d in drones)
    )
    physics.inverse_inertia = np.moveaxis(np.linalg.inv(np.moveaxis(physics.inertia, -1, 0)), 0, -1).copy()
    physics.inverse_mass = 1.0 / physics.mass
    return physics


def attach(drone: dict[str, np.ndarray], mass: float, place: np.ndarray, inertia: np.ndarray) -> None:
    """Attach a body of ``mass`` at ``place`` (3,), with ``inertia`` (3,) about its centre, to a drone, in place."""
    arm = place - drone["cog"]
    total = drone["mass"] + mass
    reduced = drone["mass"] * mass / total
    drone["inertia"] = drone["inertia"] + np.diag(inertia) + reduced * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    drone["cog"] = drone["cog"] + mass / total * arm
    drone["mass"] = total
