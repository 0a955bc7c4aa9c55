"""Policies of other libraries as controllers."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from cfb_mjx.control.neural import ACTIVATIONS, LIMITS, Gru, Network, NeuralController
from cfb_mjx.envs.observation import Layout
from cfb_mjx.errors import CfbError


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
    gru_after: int | None = None,
) -> NeuralController:
    """Convert a policy of another library, fully connected or with a GRU, to a controller that acts deterministically.

    The policy must have been trained on this library's observation (`cfb_mjx.envs.gym`, `cfb_mjx.envs.brax_env`), with
    actions from -1 to 1. ``save_policy`` then writes it for ``cfb fly`` and ``cfb export``.

        foreign_controller(model.policy.state_dict(), task.layout, activation="tanh", limit="clip")    # SB3's PPO
        foreign_controller(model.actor.state_dict(), task.layout, activation="relu", limit="tanh")     # SB3's SAC
        foreign_controller(variables["params"], layout, activation="swish", limit="tanh")              # Flax

    Args:
        params: ``state_dict()`` of a PyTorch module (layers in order of their definition) or parameters of a Flax
            module (nested dictionaries; layers in the order of the numbers in their names). Layers of value networks
            and standard deviations are left out. One layer may be a GRU: ``GRU`` or ``GRUCell`` of PyTorch, or
            ``GRUCell`` of Flax, with nothing applied to what it gives; its state is zero at the start.
        layout: observation layout of the task.
        activation: activation of the hidden layers: ``tanh``, ``relu`` or ``swish``.
        limit: how the action is limited: ``clip`` (Stable-Baselines3's PPO) or ``tanh`` (SAC, Brax).
        mean: mean by which observations were normalised, (inputs,); None: they were not.
        std: standard deviation likewise, with what the library adds to it (``sqrt(var + epsilon)``). A clip of
            normalised observations is not reproduced.
        gru_after: number of fully connected layers before the GRU; needed for Flax if it fits behind several.

    Raises:
        CfbError: an unknown activation or limit, layers that are neither fully connected nor one GRU, or layers that do
            not fit each other, the layout's input size, or four motors.
    """
    if activation not in ACTIVATIONS or limit not in LIMITS:
        raise CfbError(
            f"activation must be one of {', '.join(ACTIVATIONS)} and limit of {', '.join(LIMITS)}, found "
            f"{activation!r} and {limit!r}."
        )
    layers = _layers(params)
    if gru_after is not None or any(isinstance(value, Mapping) for value in params.values()):
        layers = _placed(layers, layout.size, gru_after)
    return assembled(layers, layout, activation, limit, mean, std)


class Unit(NamedTuple):
    """Arrays of a `Gru`, as numbers of NumPy, whose precision is the other library's."""

    input_weight: np.ndarray
    input_bias: np.ndarray
    hidden_weight: np.ndarray
    hidden_bias: np.ndarray


class Dense(NamedTuple):
    """Weights (inputs, outputs) and biases."""

    weight: np.ndarray
    bias: np.ndarray


Layer = Unit | Dense


def assembled(
    layers: Sequence[Layer], layout: Layout, activation: str, limit: str, mean: Any = None, std: Any = None
) -> NeuralController:
    """Return the controller of layers, at most one of them a recurrent unit; arguments as for `foreign_controller`.

    Raises:
        CfbError: several units, only one of mean and std, or layers that do not fit each other, the layout's input
            size, or four motors.
    """
    if (mean is None) != (std is None):
        raise CfbError("give both mean and std of the observations, or neither.")
    layers = list(layers)
    units = [i for i, layer in enumerate(layers) if isinstance(layer, Unit)]
    if len(units) > 1:
        raise CfbError(f"{_ONE_GRU}; found {len(units)}.")
    if mean is not None and layers:
        layers[0] = _normalised(layers[0], np.asarray(mean, float), np.asarray(std, float), layout.size)
    dense = [layer for layer in layers if not isinstance(layer, Unit)]
    weights, biases = tuple(jnp.asarray(x.weight) for x in dense), tuple(jnp.asarray(x.bias) for x in dense)
    gru = Gru(*map(jnp.asarray, layers[units[0]])) if units else None
    network = Network(weights, biases, activation, limit, gru, units[0] if units else 0)
    if not network.fits(layout.size):
        found = ", ".join(f"{a} x {b}" for a, b in network.sizes) or "none"
        raise CfbError(
            f"the policy must be fully connected layers from {layout.size} inputs, the layout's, to 4 outputs, "
            f"each fitting the next; found {found}. Give the parameters of the policy alone."
        )
    return NeuralController(network, layout)


def _normalised(layer: Layer, mean: np.ndarray, std: np.ndarray, inputs: int) -> Layer:
    """First layer with the normalisation of its inputs folded in."""
    weight, bias = layer[:2]
    if mean.shape != (inputs,) or std.shape != (inputs,):
        raise CfbError(f"mean and std must be {inputs} numbers each; found shapes {mean.shape} and {std.shape}.")
    if len(weight) != inputs:
        return layer
    kind, weight, bias = weight.dtype, weight / std[:, None], bias - (mean / std) @ weight
    weight, bias = weight.astype(kind), bias.astype(kind)
    return layer._replace(input_weight=weight, input_bias=bias) if isinstance(layer, Unit) else Dense(weight, bias)


_NOT_OF_A_POLICY = re.compile(r"value|critic|log_std|(^|\.)(vf|qf|q_net)")
_OF_PYTORCH = re.compile(r"(weight|bias)_(ih|hh)((?:_l\d+)?(?:_reverse)?)")
_OF_FLAX = re.compile(r"[ih][a-z]")
_INPUTS, _KEPT = ("ir", "iz", "in"), ("hr", "hz", "hn")
_ONE_GRU = "a policy may have one recurrent layer, a GRU of one layer and one direction"


def _layers(params: Mapping[str, Any]) -> list[Layer]:
    """Layers of a policy, first layer first; of nested dictionaries in the order of their names."""
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
                is_gru = _OF_PYTORCH.fullmatch(parts[-1])
                kind = is_gru[1] if is_gru else parts[-1]
                if part.ndim != {"bias": 1, "kernel": 2, "weight": 2}.get(kind):
                    raise CfbError(
                        f"the policy must be fully connected layers; {'.'.join(parts)} of shape {part.shape} is not of "
                        "one."
                    )
                # The six layers of a recurrent cell of Flax are one layer.
                at, within = parts[:-1], parts[-1]
                if natural and at and _OF_FLAX.fullmatch(at[-1]):
                    at, within = at[:-1], f"{at[-1]}.{within}"
                found.setdefault(".".join(at), {})[within] = part

    walk(params, (), any(isinstance(value, Mapping) for value in params.values()))
    layers: list[Layer] = []
    for name, layer in found.items():
        if any(map(_OF_PYTORCH.fullmatch, layer)):
            layers.append(_gru_of_pytorch(name, layer))
        elif any("." in key for key in layer):
            layers.append(_gru_of_flax(name, layer))
        for kind, transposed in kinds.items():
            if kind in layer:
                weight = layer[kind].T if transposed else layer[kind]
                layers.append(Dense(weight, layer.get("bias", np.zeros(weight.shape[1], weight.dtype))))
    return layers


def _gru_of_pytorch(name: str, layer: dict[str, np.ndarray]) -> Unit:
    marks = {found[3] for found in map(_OF_PYTORCH.fullmatch, layer) if found}
    mark = min(marks)
    given = {key.removesuffix(mark) if mark else key: x for key, x in layer.items()}
    inputs, kept = given.get("weight_ih"), given.get("weight_hh")
    if len(marks) > 1 or mark not in ("", "_l0") or inputs is None or kept is None:
        raise CfbError(f"{_ONE_GRU}; {name or 'this one'} has more.")
    if {inputs.shape[0], kept.shape[0]} != {3 * kept.shape[1]}:
        raise CfbError(f"{_ONE_GRU}; {name or 'this one'} is another kind, an LSTM for instance.")
    nothing = np.zeros(len(inputs), inputs.dtype)
    return Unit(inputs.T, given.get("bias_ih", nothing), kept.T, given.get("bias_hh", nothing))


def _gru_of_flax(name: str, layer: dict[str, np.ndarray]) -> Unit:
    gates = {key.partition(".")[0] for key in layer}
    if gates != {*_INPUTS, *_KEPT} or any(f"{gate}.kernel" not in layer for gate in gates):
        raise CfbError(f"{_ONE_GRU}; {name or 'this one'} is another kind, an LSTM for instance.")

    def beside(gates):
        weights = [layer[f"{gate}.kernel"] for gate in gates]
        biases = [
            layer.get(f"{gate}.bias", np.zeros(w.shape[1], w.dtype)) for gate, w in zip(gates, weights, strict=True)
        ]
        return np.concatenate(weights, axis=1), np.concatenate(biases)

    return Unit(*beside(_INPUTS), *beside(_KEPT))


def _placed(layers: list[Layer], inputs: int, gru_after: int | None) -> list[Layer]:
    """Layers with the recurrent unit where it is, as the sizes say, or the user.

    Names of Flax give the order of layers of one kind only.
    """
    units = [layer for layer in layers if isinstance(layer, Unit)]
    others = [layer for layer in layers if not isinstance(layer, Unit)]
    places = range(len(others))
    if gru_after is not None and (len(units) != 1 or gru_after not in places):
        raise CfbError(f"gru_after must be from 0 to {len(others) - 1} for this policy with {len(units)} GRU.")
    orders = [[*others[:at], *units, *others[at:]] for at in (places if gru_after is None else (gru_after,))]
    fitting = [order for order in orders if _chained(order, inputs)]
    if units and len(fitting) > 1:
        raise CfbError("the GRU fits behind several layers; say behind how many it is (gru_after).")
    return fitting[0] if units and fitting else layers


def _chained(layers: list[Layer], inputs: int) -> bool:
    for layer in layers:
        if len(layer[0]) != inputs:
            return False
        inputs = len(layer.hidden_weight) if isinstance(layer, Unit) else layer.weight.shape[1]
    return True


def _natural(name: str) -> list[tuple[int, str]]:
    """Sorts the numbers in names by value: layer_2 before layer_10."""
    return [(int(part), "") if part.isdigit() else (0, part) for part in re.split(r"(\d+)", name)]
