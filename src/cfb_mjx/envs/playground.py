"""Tasks as environments of MuJoCo Playground, for its trainers and trainers written for them.

    import cfb_mjx.envs.playground  # registers them
    from mujoco_playground import registry

    env = registry.load("CfbTarget", config_overrides={"model": "cfb", "magnitude": 1.0})

These are `BraxEnv` with Playground's interface: the simulation's state is in ``state.data``, sizes are shapes, and a
configuration selects the drone. `cfb_mjx.envs.brax_env.wrap` begins every episode on its own drone; Playground's own
wrapper always returns to the first one.
"""

from __future__ import annotations

from typing import Any, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
from jaxtyping import Array, Float
from mujoco import mjx

from cfb_mjx.envs.brax_env import BraxEnv
from cfb_mjx.envs.episode import Episode
from cfb_mjx.envs.flip import FlipTask
from cfb_mjx.envs.target import TargetTask
from cfb_mjx.envs.task import Task
from cfb_mjx.errors import CfbError
from cfb_mjx.files import shipped
from cfb_mjx.model.mjx_body import BODY_NAME
from cfb_mjx.parameters import load_randomisation
from cfb_mjx.quiet import quietly

try:
    with quietly():
        from brax.envs import base as brax
        from ml_collections import config_dict
        from mujoco_playground import (  # pyright: ignore[reportMissingImports]  # whoever wants this installs it
            MjxEnv,
            State,
            dm_control_suite,
        )
except ImportError as error:
    raise CfbError(f"MuJoCo Playground is not installed ({error}): pip install playground.") from None


CAMERA = "track"
"""Default camera of `CfbEnv.render`: it stays beside the drone."""
PLACE, AXES = (0.0, -0.35, 0.15), (1.0, 0.0, 0.0, 0.0, 0.4, 0.92)


class Data(eqx.Module):
    """State of the simulation, and what rendering needs of MuJoCo's data."""

    episode: Episode

    @property
    def qpos(self) -> Float[Array, "*batch 7"]:
        """Position of the rotors' centre, m, and quaternion (w, x, y, z)."""
        return jnp.concatenate([self.episode.state.position, self.episode.state.quaternion], axis=-1)

    @property
    def qvel(self) -> Float[Array, "*batch 6"]:
        """Velocity of the rotors' centre, m/s, world axes, and body rate, rad/s, body axes."""
        return jnp.concatenate([self.episode.state.velocity, self.episode.state.body_rate], axis=-1)

    @property
    def mocap_pos(self) -> Float[Array, "*batch 0 3"]:
        """Empty: there are no mocap bodies."""
        return jnp.zeros((*self.qpos.shape[:-1], 0, 3))

    @property
    def mocap_quat(self) -> Float[Array, "*batch 0 4"]:
        """Empty: there are no mocap bodies."""
        return jnp.zeros((*self.qpos.shape[:-1], 0, 4))

    @property
    def xfrc_applied(self) -> Float[Array, "*batch 2 6"]:
        """Zero: the rotors' forces are not MuJoCo's."""
        return jnp.zeros((*self.qpos.shape[:-1], 2, 6))


def default_config() -> config_dict.ConfigDict:
    """Default configuration: the nominal drone with guards, randomised by ``magnitude`` times ``randomisation``.

    ``randomisation`` names ranges; an empty string means no randomisation.
    """
    task = TargetTask()
    return config_dict.create(
        ctrl_dt=task.layout.control_dt_s,
        sim_dt=0.004,
        episode_length=task.episode_steps,
        action_repeat=1,
        model="cfb-guards",
        randomisation="paper",
        magnitude=1.0,
        asymmetric=True,
    )


class CfbEnv(MjxEnv):
    """One drone on a task, for MuJoCo Playground.

    Args:
        config: configuration; default: `default_config`.
        config_overrides: changes of single entries.
        task: task to fly, in place of the paper's first task with the configuration's randomisation.

    Raises:
        CfbError: as for `BraxEnv`, or the configuration's control step is not the task's.
    """

    task_type: type[Task] = TargetTask

    def __init__(
        self,
        config: config_dict.ConfigDict | None = None,
        config_overrides: dict[str, Any] | None = None,
        task: Task | None = None,
    ):
        super().__init__(default_config() if config is None else config, config_overrides)
        own = self._config
        if task is None:
            ranges = load_randomisation(own.randomisation) if own.randomisation else None
            task = self.task_type(randomisation=ranges, magnitude=own.magnitude)
        self._env = BraxEnv(task, own.model, asymmetric=own.asymmetric)
        real = self._env.dt, float(self._env.sys.dt)
        if (own.ctrl_dt, own.sim_dt) != real:
            raise CfbError(
                f"ctrl_dt = {own.ctrl_dt:g}, sim_dt = {own.sim_dt:g} in the configuration, but the task's commands are "
                f"{real[0]:g} s apart and the model's steps {real[1]:g} s; set these values, or give your own task."
            )
        seen = mujoco.MjSpec.from_file(self.xml_path)
        # Tasks fly about the origin, also below it.
        for floor in [geom for geom in seen.geoms if geom.type == mujoco.mjtGeom.mjGEOM_PLANE]:
            seen.delete(floor)
        seen.body(BODY_NAME).add_camera(name=CAMERA, mode=mujoco.mjtCamLight.mjCAMLIGHT_TRACK, pos=PLACE, xyaxes=AXES)
        seen.stat.extent = 2.0  # the near clipping plane is a share of it
        self._mj_model = seen.compile()

    @property
    def task(self) -> Task:
        """The task that is flown."""
        return self._env.task

    def reset(self, rng: jax.Array) -> State:
        """Begin an episode, as `BraxEnv.reset`."""
        return _shown(self._env.reset(rng))

    def step(self, state: State, action: jax.Array) -> State:
        """Fly one command, as `BraxEnv.step`."""
        flying = brax.State(state.data.episode, state.obs, state.reward, state.done, state.metrics, state.info)
        return _shown(self._env.step(flying, action))

    @property
    def action_size(self) -> int:
        """Number of actions, one per motor."""
        return self._env.action_size

    @property
    def xml_path(self) -> str:
        """Path of the MJCF that is rendered."""
        return str(shipped("assets", "cfb.xml"))

    @property
    def mj_model(self) -> mujoco.MjModel:
        """MuJoCo model for rendering; the flight follows the drone's own model."""
        return self._mj_model

    @property
    def mjx_model(self) -> mjx.Model:
        """The rendering model for MJX."""
        return mjx.put_model(self._mj_model)

    def render(self, trajectory: Any, height: int = 240, width: int = 320, camera: str | None = CAMERA, **options: Any):
        """Render states, as Playground does; by default with a camera beside the drone."""
        return super().render(trajectory, height, width, camera, **options)

    @property
    def _mjx_model(self) -> mjx.Model:
        return self.mjx_model

    @_mjx_model.setter
    def _mjx_model(self, _: mjx.Model) -> None:
        # Playground's wrapper for randomisation sets this, but no drone would fly differently for it.
        raise CfbError(
            "randomization_fn is not supported: set `randomisation` and `magnitude` in the configuration instead."
        )


class CfbFlipEnv(CfbEnv):
    """One drone on the paper's second task."""

    task_type = FlipTask


def _shown(state: brax.State) -> State:
    episode = cast(Episode, state.pipeline_state)
    return State(Data(episode), state.obs, state.reward, state.done, state.metrics, state.info)


for name, kind in {"CfbTarget": CfbEnv, "CfbFlip": CfbFlipEnv}.items():
    dm_control_suite.register_environment(name, kind, default_config)
