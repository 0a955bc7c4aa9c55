"""What an algorithm is to the pipeline: a state, and a step of it."""

from __future__ import annotations

from typing import Any, Protocol

from jaxtyping import PRNGKeyArray

from cfb_mjx.control.neural import NeuralController


class Algorithm(Protocol):
    """The pipeline knows no more of it. States are pytrees of arrays: whole, they are a checkpoint."""

    updates: int
    """Of a whole training."""
    steps_per_update: int
    """Commands flown in one."""

    def begin(self, key: PRNGKeyArray, controller: NeuralController) -> Any:
        """The first state, from an initial controller."""

    def update(self, state: Any) -> tuple[Any, dict]:
        """One update; metrics are scalars. Compiled."""

    def controller(self, state: Any) -> NeuralController:
        """The controller as it stands."""
