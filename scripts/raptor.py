"""RAPTOR's published policy as a controller, for comparison.

J. Eschmann, D. Albani, G. Loianno, RAPTOR: A Foundation Policy for Quadrotor Control, 2025. The policy adapts to any
quadrotor within its first second. Its weights are not part of this project: `pip install foundation-policy`.
Observation, order of the motors and normalisation are as that package documents them; errors of position and velocity
are limited as in its authors' adapter for PX4.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from cfb_mjx.envs.observation import StateEstimate, rotation_matrix

STEPS = 5
"""Control steps per evaluation of the network: 10 ms, as in its training."""
LARGEST_POSITION_ERROR_M, LARGEST_VELOCITY_ERROR_MPS = 0.5, 1.0


class Memory(eqx.Module):
    """State of the controller between two steps."""

    hidden: Float[Array, " hidden"]
    action: Float[Array, "4"]
    """Last action, range -1 to 1."""
    held: Array
    """Steps since the last evaluation."""


class RaptorController(eqx.Module):
    """The network: a ReLU layer, a gated recurrent unit and a linear layer."""

    first: tuple[Array, Array]
    recurrent: tuple[Array, Array, Array, Array]
    last: tuple[Array, Array]
    hidden: Array
    control_dt_s: float = eqx.field(static=True, default=0.002)

    @classmethod
    def published(cls) -> RaptorController:
        """Load the weights from the installed package, which checks them against an example."""
        from foundation_policy import Raptor

        dense, gru, out = Raptor().layers
        names = (dense.activation_function_name, out.activation_function_name)
        if names != ("RELU", "IDENTITY"):
            raise SystemExit(f"foundation-policy: unknown network with layers {names}; install version 1.0.2.")
        arrays = (
            (dense.weights, dense.biases[0]),
            (gru.weights_input, gru.biases_input, gru.weights_hidden, gru.biases_hidden),
            (out.weights, out.biases[0]),
            gru.initial_hidden_state,
        )
        return cls(*jax.tree.map(lambda x: jnp.asarray(x, jnp.result_type(float)), arrays))

    def start(self, estimate: StateEstimate, command: Float[Array, "4"]) -> Memory:
        """Return the memory at take-over."""
        return Memory(self.hidden, 2 * command - 1, jnp.asarray(0))

    def command(self, memory: Memory, estimate: StateEstimate) -> tuple[Memory, Float[Array, "4"]]:
        """Return the new memory and the command."""
        hidden, action = self._asked(memory, estimate)
        due = memory.held == 0
        hidden = jnp.where(due, hidden, memory.hidden)
        action = jnp.where(due, action, memory.action)
        return Memory(hidden, action, (memory.held + 1) % STEPS), (action + 1) / 2

    def _asked(self, memory: Memory, estimate: StateEstimate) -> tuple[Array, Array]:
        position = jnp.clip(estimate.position, -LARGEST_POSITION_ERROR_M, LARGEST_POSITION_ERROR_M)
        velocity = jnp.clip(estimate.velocity, -LARGEST_VELOCITY_ERROR_MPS, LARGEST_VELOCITY_ERROR_MPS)
        seen = jnp.concatenate(
            [position, rotation_matrix(estimate.quaternion).ravel(), velocity, estimate.body_rate, memory.action]
        )
        seen = jax.nn.relu(self.first[0] @ seen + self.first[1])
        weight_in, bias_in, weight, bias = self.recurrent
        given = jnp.split(weight_in @ seen + bias_in, 3)
        kept = jnp.split(weight @ memory.hidden + bias, 3)
        reset, update = (jax.nn.sigmoid(a + b) for a, b in zip(given[:2], kept[:2], strict=True))
        hidden = update * memory.hidden + (1 - update) * jnp.tanh(given[2] + reset * kept[2])
        return hidden, jnp.clip(self.last[0] @ hidden + self.last[1], -1.0, 1.0)
