"""Fly the compiled C in closed loop with the simulated drone, and the JAX policy with the same drone and noise."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from cfb_mjx.control.manoeuvre import Manoeuvre
from cfb_mjx.control.neural import NeuralController
from cfb_mjx.deploy.compiled import CompiledPolicy
from cfb_mjx.deploy.deployment import Deployment
from cfb_mjx.deploy.parity import begin
from cfb_mjx.envs import Estimate, TargetTask, Task
from cfb_mjx.envs.episode import Episode, reset, step, with_room
from cfb_mjx.model.quadrotor import Quadrotor
from cfb_mjx.model.state import State

Flier = NeuralController | Manoeuvre


class Beside(NamedTuple):
    """Two flights: C and JAX."""

    position: np.ndarray
    """(2, steps, 3), relative to the target, m."""
    command: np.ndarray
    """(2, steps, 4)."""
    dt: float
    """Time between two commands, s."""

    def command_difference(self, seconds: float | None = None) -> float:
        """Largest difference of a command, over all motors and the first ``seconds``."""
        until = None if seconds is None else round(seconds / self.dt)
        return float(np.abs(self.command[0, :until] - self.command[1, :until]).max())

    @property
    def distance_m(self) -> float:
        """Largest distance between the two drones at the same time."""
        return float(np.linalg.norm(self.position[0] - self.position[1], axis=-1).max())


def fly_beside(
    deployment: Deployment,
    compiled: CompiledPolicy,
    seconds: float,
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0),
    seed: int = 0,
) -> Beside:
    """Fly both from hover, with the noise of trainings.

    Args:
        deployment: the exported policies; a flip begins with the first step.
        compiled: the compiled C.
        seconds: duration, s.
        offset: start relative to the target, m.
        seed: seed of the noise, the same for both.
    """
    plant = deployment.plant()
    controller, dt = deployment.controller, deployment.controller.control_dt_s
    if dt < plant.dt:
        plant = replace(plant, dt=dt)
    task = TargetTask(layout=deployment.holder.controller.layout, lumped_delay=deployment.holder.lumped_delay)
    task, start = with_room(task, plant), plant.hover_state(offset)
    hover = jnp.full(4, deployment.hover_command(), jnp.float32)
    steps = round(seconds / dt)
    position, command = np.empty((2, steps, 3)), np.empty((2, steps, 4), np.float32)

    for which in range(2):
        episode, memory = _first(task, plant, controller, start, hover, jax.random.PRNGKey(seed))
        begin(deployment, compiled)
        for i in range(steps):
            if which == 0:
                seen = episode.estimate
                u = compiled.step(seen.position, seen.velocity, seen.quaternion, seen.body_rate)
            else:
                memory, u = _commanded(controller, memory, episode.estimate)
            command[which, i] = u
            episode = _flown(task, episode, jnp.asarray(u, jnp.float32))
            position[which, i] = episode.state.position
    return Beside(position, command, dt)


# Compiled once for all flights of a policy.
@eqx.filter_jit
def _first(task: Task, plant: Quadrotor, controller: Flier, start: State, hover: Array, key: Array):
    episode = reset(task, plant, key, start)
    return episode, controller.start(episode.estimate, hover)


@eqx.filter_jit
def _commanded(controller: Flier, memory: Any, estimate: Estimate):
    return controller.command(memory, estimate)


@eqx.filter_jit
def _flown(task: Task, episode: Episode, u: Array) -> Episode:
    return step(task, episode, u)[0]
