"""The simulated drone: rotors, bodies, delay, effects and rollouts."""

from typing import TYPE_CHECKING

from cfb_mjx.model.bodies import Body, RigidBody
from cfb_mjx.model.delay import DelayLine
from cfb_mjx.model.effects import CATALOGUE, Condition, Effect, ParasiticDrag, Wrench, register
from cfb_mjx.model.quadrotor import Quadrotor, begin, specific_force, step
from cfb_mjx.model.randomised import require_possible, sample_drone
from cfb_mjx.model.rollout import in_chunks, rollout, rollout_final
from cfb_mjx.model.rotors import (
    balanced_thrust_to_weight,
    hover_command,
    hover_rotor_speed,
    rotor_speed_history,
    thrust,
    torque,
)
from cfb_mjx.model.state import State

if TYPE_CHECKING:
    from cfb_mjx.model.mjx_body import MjxBody
    from cfb_mjx.model.mujoco_body import MujocoBody
    from cfb_mjx.model.scene import Scene, SceneState

__all__ = [
    "CATALOGUE",
    "Body",
    "Condition",
    "DelayLine",
    "Effect",
    "MjxBody",
    "MujocoBody",
    "ParasiticDrag",
    "Quadrotor",
    "RigidBody",
    "Scene",
    "SceneState",
    "State",
    "Wrench",
    "balanced_thrust_to_weight",
    "begin",
    "hover_command",
    "hover_rotor_speed",
    "in_chunks",
    "register",
    "require_possible",
    "rollout",
    "rollout_final",
    "rotor_speed_history",
    "sample_drone",
    "specific_force",
    "step",
    "thrust",
    "torque",
]


def __getattr__(name: str):
    # Importing MuJoCo takes a second, and the closed-form body does not need it.
    if name == "MjxBody":
        from cfb_mjx.model.mjx_body import MjxBody

        return MjxBody
    if name == "MujocoBody":
        from cfb_mjx.model.mujoco_body import MujocoBody

        return MujocoBody
    if name in ("Scene", "SceneState"):
        from cfb_mjx.model import scene

        return getattr(scene, name)
    raise AttributeError(f"module 'cfb_mjx.model' has no attribute {name!r}")
