"""What an algorithm is to the pipeline: a state, and a step of it."""

from __future__ import annotations

from functools import partial
from typing import Any, Protocol

import equinox as eqx
import jax
from jaxtyping import PRNGKeyArray

from cfb_mjx.control.neural import NeuralController
from cfb_mjx.envs.episode import Episode, Task, reset
from cfb_mjx.model.quadrotor import Quadrotor


class Algorithm(Protocol):
    """The pipeline knows no more of it. States are pytrees of arrays: whole, they are a checkpoint."""

    updates: int
    """Of a whole training."""
    steps_per_update: int
    """Commands flown in one."""

    def begin(self, key: PRNGKeyArray, controller: NeuralController) -> Any:
        """The first state, from an initial controller."""
        ...

    def update(self, state: Any) -> tuple[Any, dict]:
        """One update; metrics are scalars. Compiled."""
        ...

    def controller(self, state: Any) -> NeuralController:
        """The controller as it stands."""
        ...


def in_progress(task: Task, nominal: Quadrotor, drones: int, key: PRNGKeyArray) -> Episode:
    """Drones at random moments of their episodes, so that they do not all end at once."""
    of_episodes, of_counts = jax.random.split(key)
    begin = eqx.filter_jit(jax.vmap(partial(reset, task, nominal)))
    episodes = begin(jax.random.split(of_episodes, drones))
    counts = jax.random.randint(of_counts, (drones,), 0, task.episode_steps)
    return eqx.tree_at(lambda e: e.count, episodes, counts)


def strong(state: Any) -> Any:
    """The state without weak types: one would become strong in the first update, and the second compile afresh."""
    return jax.tree.map(lambda x: jax.lax.convert_element_type(x, x.dtype) if eqx.is_array(x) else x, state)
