"""Fully connected networks as controllers."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from cfb_mjx.envs.observation import Layout, Memory, StateEstimate, observation, remember, start
from cfb_mjx.errors import CfbError

ACTIVATIONS: dict[str, Callable] = {"tanh": jnp.tanh, "relu": jax.nn.relu, "swish": jax.nn.swish}


class Network(eqx.Module):
    """Weights (inputs, outputs) and biases, first layer first; the activation is applied between layers."""

    weights: tuple[Float[Array, "_ _"], ...]
    biases: tuple[Float[Array, " _"], ...]
    activation: str = eqx.field(static=True, default="tanh")

    @classmethod
    def random(cls, key: PRNGKeyArray, sizes: tuple[int, ...], activation: str = "tanh", last: float = 1.0) -> Network:
        """Draw LeCun-uniform weights, with zero biases; the weights of the last layer are scaled by ``last``."""
        weights = []
        for i, (inputs, outputs) in enumerate(pairwise(sizes)):
            bound = (3 / inputs) ** 0.5 * (last if i == len(sizes) - 2 else 1.0)
            weights.append(jax.random.uniform(jax.random.fold_in(key, i), (inputs, outputs), float, -bound, bound))
        return cls(tuple(weights), tuple(jnp.zeros(n) for n in sizes[1:]), activation)

    def __call__(self, x: Float[Array, "*batch inputs"]) -> Float[Array, "*batch outputs"]:
        return self._through(lambda weight, bias, x: x @ weight + bias, x)

    def columns(self, x: Float[Array, "inputs drones"]) -> Float[Array, "outputs drones"]:
        """Evaluate for many inputs along the last axis."""
        # Without the barrier XLA would split the product into one per part of a concatenated x, and add them up.
        x = jax.lax.optimization_barrier(x)
        return self._through(lambda weight, bias, x: weight.T @ x + bias[:, None], x)

    def _through(self, layer: Callable, x: Array) -> Array:
        *hidden, last = zip(self.weights, self.biases, strict=True)
        for weight, bias in hidden:
            x = ACTIVATIONS[self.activation](layer(weight, bias, x))
        return layer(*last, x)


_SUMS_FAIL = jax.__version_info__ >= (0, 11)
"""jaxlib 0.12 cannot compile such a sum over at most `_FEW` columns ("Fusion kind not implemented on CPU")."""
_FEW = 8


class WrittenOut(Network):
    """A network with its products written as sums, for one compiled function, in which XLA has no matrix library."""

    def columns(self, x: Float[Array, "inputs drones"]) -> Float[Array, "outputs drones"]:
        def layer(weight, bias, x):
            if _SUMS_FAIL and x.shape[1] <= _FEW:
                return weight.T @ x + bias[:, None]
            return jnp.sum(weight[:, :, None] * x[:, None, :], axis=0) + bias[:, None]

        return self._through(layer, x)


class NeuralController(eqx.Module):
    """A network that turns observations into commands u = (1 + tanh(output)) / 2.

    `start` and `command` also accept many drones along the last axis of every array (`cfb_mjx.envs.observation`).
    """

    network: Network
    layout: Layout = eqx.field(static=True, default_factory=Layout)

    @classmethod
    def random(
        cls,
        key: PRNGKeyArray,
        layout: Layout,
        hidden: tuple[int, ...] = (32, 32, 32, 32),
        activation: str = "tanh",
        hover: float = 0.55,
    ) -> NeuralController:
        """Draw a random controller that commands about ``hover`` whatever it sees."""
        network = Network.random(key, (layout.size, *hidden, 4), activation, last=0.01)
        bias = jnp.full(4, jnp.arctanh(2 * hover - 1))
        return cls(eqx.tree_at(lambda n: n.biases[-1], network, bias), layout)

    @property
    def control_dt_s(self) -> float:
        """Time between two commands, s."""
        return self.layout.control_dt_s

    def act(self, shown: Float[Array, " size *drones"]) -> Float[Array, " 4 *drones"]:
        """Return the command in (0, 1) for an observation."""
        network = self.network if shown.ndim == 1 else self.network.columns
        return 0.5 * (1 + jnp.tanh(network(shown)))

    def written_out(self) -> NeuralController:
        """Return the same controller for use within one compiled function (`WrittenOut`)."""
        network = self.network
        return NeuralController(WrittenOut(network.weights, network.biases, network.activation), self.layout)

    def start(self, estimate: StateEstimate, command: Float[Array, " 4 *drones"] | float = 0.55) -> Memory:
        """Return the memory of a controller that has commanded ``command`` on ``estimate`` for long."""
        return start(self.layout, estimate, command)

    def command(
        self, memory: Memory, estimate: StateEstimate, setpoint: Float[Array, " setpoints *drones"] | None = None
    ) -> tuple[Memory, Float[Array, " 4 *drones"]]:
        """New memory and command; call it every ``layout.control_dt_s``. Policies with set-points need ``setpoint``."""
        u = self.act(observation(self.layout, memory, estimate, setpoint))
        return remember(self.layout, memory, estimate, u), u


def brax_controller(
    params: Any, layout: Layout, *, normalized: bool, activation: str = "tanh", obs_key: str = "state"
) -> NeuralController:
    """Convert a policy of Brax's PPO or SAC to a controller that acts deterministically.

    Args:
        params: result of the trainer: statistics of the normaliser, policy, and anything after them.
        layout: observation layout of the task on which the policy was trained.
        normalized: whether it was trained with ``normalize_observations``. If so, the normalisation is folded into the
            first layer. Brax returns the statistics in either case.
        activation: activation of the hidden layers: ``tanh``, ``relu`` or ``swish``.
        obs_key: key of the observation that the policy reads.

    Raises:
        CfbError: the network is not fully connected, or its input size differs from the layout's.
    """
    statistics, policy = params[0], params[1]["params"]
    layers = [policy.get(f"hidden_{i}") for i in range(len(policy))]
    if activation not in ACTIVATIONS or None in layers:
        raise CfbError("brax_controller: the policy must be fully connected, with activation tanh, relu or swish.")
    weights, biases = ([np.asarray(layer[part]) for layer in layers] for part in ("kernel", "bias"))
    if normalized:
        mean, std = (np.asarray(x[obs_key] if isinstance(x, dict) else x) for x in (statistics.mean, statistics.std))
        biases[0] = biases[0] - (mean / std) @ weights[0]
        weights[0] = weights[0] / std[:, None]
    if weights[0].shape[0] != layout.size:
        raise CfbError(f"brax_controller: the policy takes {weights[0].shape[0]} inputs, the layout has {layout.size}.")
    # The second half of the last layer is the standard deviation.
    weights[-1], biases[-1] = weights[-1][:, :4], biases[-1][:4]
    return NeuralController(
        Network(tuple(map(jnp.asarray, weights)), tuple(map(jnp.asarray, biases)), activation), layout
    )
