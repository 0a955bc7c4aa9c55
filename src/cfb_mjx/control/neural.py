"""Fully connected networks as controllers."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
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
LIMITS: dict[str, Callable] = {"tanh": jnp.tanh, "clip": lambda x: jnp.clip(x, -1.0, 1.0)}
"""Functions that bring the last layer to -1..1."""
WRITTEN = {"tanh": "tanh(output)", "clip": "clip(output, -1, 1)"}
"""The same, as policy files and contracts write them."""


class Network(eqx.Module):
    """Weights (inputs, outputs) and biases, first layer first; the activation is applied between layers.

    The limit is applied after the last layer, by the controller.
    """

    weights: tuple[Float[Array, "_ _"], ...]
    biases: tuple[Float[Array, " _"], ...]
    activation: str = eqx.field(static=True, default="tanh")
    limit: str = eqx.field(static=True, default="tanh")

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
    """A network that turns observations into commands u = (1 + tanh(output)) / 2, or with a clip for the tanh.

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
        """Return the command, 0 to 1, for an observation."""
        network = self.network if shown.ndim == 1 else self.network.columns
        return 0.5 * (1 + LIMITS[self.network.limit](network(shown)))

    def written_out(self) -> NeuralController:
        """Return the same controller for use within one compiled function (`WrittenOut`)."""
        network = self.network
        written = WrittenOut(network.weights, network.biases, network.activation, network.limit)
        return NeuralController(written, self.layout)

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
    mean, std = (x[obs_key] if isinstance(x, dict) else x for x in (statistics.mean, statistics.std))
    # The second half of the last layer is the standard deviation.
    last = max(policy, key=_natural)
    policy = {**policy, last: {part: np.asarray(x)[..., : x.shape[-1] // 2] for part, x in policy[last].items()}}
    given = {"mean": mean, "std": std} if normalized else {}
    try:
        return foreign_controller(policy, layout, activation=activation, limit="tanh", **given)
    except CfbError as error:
        raise CfbError(f"brax_controller: {error}") from None


def foreign_controller(
    params: Mapping[str, Any],
    layout: Layout,
    *,
    activation: str,
    limit: str,
    mean: Any = None,
    std: Any = None,
) -> NeuralController:
    """Convert a fully connected policy of another library to a controller that acts deterministically.

    The policy must have been trained on this library's observation (`cfb_mjx.envs.gym`, `cfb_mjx.envs.brax_env`), with
    actions from -1 to 1. ``save_policy`` then writes it for ``cfb fly`` and ``cfb export``.

        foreign_controller(model.policy.state_dict(), task.layout, activation="tanh", limit="clip")    # SB3's PPO
        foreign_controller(model.actor.state_dict(), task.layout, activation="relu", limit="tanh")     # SB3's SAC
        foreign_controller(variables["params"], layout, activation="swish", limit="tanh")              # Flax

    Args:
        params: ``state_dict()`` of a PyTorch module (layers in order of their definition) or parameters of a Flax
            module (nested dictionaries; layers in the order of the numbers in their names). Layers of value networks
            and standard deviations are left out.
        layout: observation layout of the task.
        activation: activation of the hidden layers: ``tanh``, ``relu`` or ``swish``.
        limit: how the action is limited: ``clip`` (Stable-Baselines3's PPO) or ``tanh`` (SAC, Brax).
        mean: mean by which observations were normalised, (inputs,); None: they were not.
        std: standard deviation likewise, with what the library adds to it (``sqrt(var + epsilon)``). A clip of
            normalised observations is not reproduced.

    Raises:
        CfbError: an unknown activation or limit, layers that are not fully connected, or layers that do not fit each
            other, the layout's input size, or four motors.
    """
    if activation not in ACTIVATIONS or limit not in LIMITS:
        raise CfbError(
            f"activation must be one of {', '.join(ACTIVATIONS)} and limit of {', '.join(LIMITS)}, found "
            f"{activation!r} and {limit!r}."
        )
    if (mean is None) != (std is None):
        raise CfbError("give both mean and std of the observations, or neither.")
    weights, biases = _layers(params)
    sizes = [w.shape for w in weights]
    fits = bool(sizes) and sizes[0][0] == layout.size and sizes[-1][1] == 4
    if not fits or any(a[1] != b[0] for a, b in pairwise(sizes)) or [len(b) for b in biases] != [s[1] for s in sizes]:
        found = ", ".join(f"{a} x {b}" for a, b in sizes) or "none"
        raise CfbError(
            f"the policy must be fully connected layers from {layout.size} inputs, the layout's, to 4 outputs, "
            f"each fitting the next; found {found}. Give the parameters of the policy alone."
        )
    if mean is not None:
        kind, mean, std = weights[0].dtype, np.asarray(mean, float), np.asarray(std, float)
        biases[0] = (biases[0] - (mean / std) @ weights[0]).astype(kind)
        weights[0] = (weights[0] / std[:, None]).astype(kind)
    network = Network(tuple(map(jnp.asarray, weights)), tuple(map(jnp.asarray, biases)), activation, limit)
    return NeuralController(network, layout)


_NOT_OF_A_POLICY = re.compile(r"value|critic|log_std|(^|\.)(vf|qf|q_net)")


def _layers(params: Mapping[str, Any]) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Weights (inputs, outputs) and biases of the fully connected layers of a policy, first layer first."""
    kinds = {"kernel": False, "weight": True}
    found: dict[str, dict[str, np.ndarray]] = {}

    def walk(tree: Mapping[str, Any], path: tuple[str, ...], natural: bool) -> None:
        names = sorted(tree, key=_natural) if natural else tree
        for name in names:
            value, *parts = tree[name], *path, *str(name).split(".")
            if isinstance(value, Mapping):
                walk(value, tuple(parts), natural)
            elif not _NOT_OF_A_POLICY.search(".".join(parts)):
                part = np.asarray(value)
                if part.ndim != {"bias": 1, "kernel": 2, "weight": 2}.get(parts[-1]):
                    raise CfbError(
                        f"the policy must be fully connected layers; {'.'.join(parts)} of shape {part.shape} is not of "
                        "one."
                    )
                found.setdefault(".".join(parts[:-1]), {})[parts[-1]] = part

    walk(params, (), any(isinstance(value, Mapping) for value in params.values()))
    weights, biases = [], []
    for layer in found.values():
        for kind, transposed in kinds.items():
            if kind in layer:
                weights.append(layer[kind].T if transposed else layer[kind])
                biases.append(layer.get("bias", np.zeros(weights[-1].shape[1], weights[-1].dtype)))
    return weights, biases


def _natural(name: str) -> list[tuple[int, str]]:
    """Sorts the numbers in names by value: layer_2 before layer_10."""
    return [(int(part), "") if part.isdigit() else (0, part) for part in re.split(r"(\d+)", name)]
