"""Interface of a training algorithm: a state, and an update of it."""

from __future__ import annotations

from functools import partial
from typing import Any, Protocol

import equinox as eqx
import jax
from jaxtyping import PRNGKeyArray

from cfb_mjx.control.neural import NeuralController
from cfb_mjx.envs.episode import Episode, reset
from cfb_mjx.envs.task import Task
from cfb_mjx.model.quadrotor import Quadrotor


class Algorithm(Protocol):
    """Interface of an algorithm. States are pytrees of arrays; a complete state is a checkpoint."""

    updates: int
    """Number of updates in a whole training."""
    steps_per_update: int
    """Number of commands flown per update."""

    def begin(self, key: PRNGKeyArray, controller: NeuralController) -> Any:
        """Return the first state, from an initial controller."""
        ...

    def update(self, state: Any) -> tuple[Any, dict]:
        """Do one compiled update; return the new state and scalar metrics."""
        ...

    def controller(self, state: Any) -> NeuralController:
        """Return the present controller."""
        ...


def in_progress(task: Task, nominal: Quadrotor, drones: int, key: PRNGKeyArray) -> Episode:
    """Drones at random times within their episodes, so that the episodes do not all end at once."""
    of_episodes, of_counts = jax.random.split(key)
    begin = eqx.filter_jit(jax.vmap(partial(reset, task, nominal)))
    episodes = begin(jax.random.split(of_episodes, drones))
    counts = jax.random.randint(of_counts, (drones,), 0, task.episode_steps)
    return eqx.tree_at(lambda e: e.count, episodes, counts)


def strong(state: Any) -> Any:
    """Remove weak types from a state: they would become strong in the first update, and the second would recompile."""
    return jax.tree.map(lambda x: jax.lax.convert_element_type(x, x.dtype) if eqx.is_array(x) else x, state)
