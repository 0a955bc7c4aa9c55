"""What an ONNX model does to its first input, as layers of a policy."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from cfb_mjx.control.foreign import Dense, Layer, Unit
from cfb_mjx.control.neural import ACTIVATIONS, LIMITS
from cfb_mjx.errors import CfbError

_HALF = np.float32(0.5)


def policy_layers(onnx: Any, model: Any, limit: str | None) -> tuple[list[Layer], str, str]:
    """Return the layers of a policy, the activation between them, and the limit of its outputs.

    Args:
        onnx: the package.
        model: model whose first input is the observation and whose first output is the action.
        limit: limit of the action where the model has none.

    Raises:
        CfbError: an operator is not one of fully connected layers or a GRU, or their order is not that of a policy.
    """
    return _policy(_Graph(onnx, model).result(), limit)


def reset_and_update_swapped(gates: np.ndarray) -> np.ndarray:
    """Return the gates of a recurrent unit, (3 n, ...), in the order of ONNX (update, reset, candidate), or back."""
    first, second, candidate = np.split(gates, 3)
    return np.concatenate([second, first, candidate])


class _Scale(NamedTuple):
    """Each number times its own factor, plus its own term."""

    scale: np.ndarray
    shift: np.ndarray


class _Function(NamedTuple):
    name: str


class _Unknown(NamedTuple):
    """What an operator gives that is not one of fully connected layers."""

    operator: str


class _State(NamedTuple):
    """Hidden state, an input of the model."""


_Chain = tuple[Any, ...]
"""What is done to the observation, in order: layers, scales and functions."""
_SAME_NUMBERS = ("Identity", "Flatten", "Reshape", "Cast", "Dropout", "Expand", "Unsqueeze", "Squeeze")
_FUNCTIONS = {"Tanh": "tanh", "Relu": "relu", "Sigmoid": "sigmoid", "Swish": "swish"}


class _Graph:
    """Follows the observation through a model."""

    def __init__(self, onnx: Any, model: Any):
        self.onnx, self.graph = onnx, model.graph
        self.values: dict[str, Any] = {x.name: onnx.numpy_helper.to_array(x) for x in model.graph.initializer}
        inputs = [x.name for x in model.graph.input if x.name not in self.values]
        self.values |= dict.fromkeys(inputs[1:], _State()) | {inputs[0]: ()}

    def result(self) -> Any:
        """Return what is done to the observation until it is the first output, as a chain.

        Raises:
            CfbError: an operator on the way is not one of fully connected layers.
        """
        for node in self.graph.node:
            given = [self.values.get(name) for name in node.input]
            settings = {x.name: self.onnx.helper.get_attribute_value(x) for x in node.attribute}
            unknown = next((x for x in given if isinstance(x, _Unknown)), None)
            # Shapes may come from anywhere: only the number of values matters, in the end.
            if unknown is not None and not (node.op_type in _SAME_NUMBERS and not isinstance(given[0], _Unknown)):
                found = unknown
            else:
                found = self._of(node.op_type, given, settings)
            self.values |= dict.fromkeys(filter(None, node.output), _Unknown(node.op_type) if found is None else found)
        found = self.values[self.graph.output[0].name]
        if isinstance(found, _Unknown):
            raise CfbError(
                f"the operator {found.operator} is not one of fully connected layers; export the policy alone, with "
                "its action as the first output."
            )
        if not isinstance(found, tuple) or isinstance(found, _State):
            raise CfbError("the first output does not depend on the observation; make the action the first one.")
        return found

    def _of(self, operator: str, given: list[Any], settings: dict[str, Any]) -> Any:
        """Value of an operator; None if it is none of fully connected layers."""
        if operator == "Constant":
            value = next(iter(settings.values()))
            if "value" in settings:
                return self.onnx.numpy_helper.to_array(value)
            return np.asarray(value, np.int64 if "int" in next(iter(settings)) else np.float32)
        first = given[0]
        if operator in _SAME_NUMBERS:
            return first
        if operator == "Transpose" and isinstance(first, np.ndarray):
            return np.transpose(first, settings.get("perm"))
        if operator in ("Mul", "Add", "Sub", "Div"):
            return _arithmetic(operator, *given)
        if not _is_chain(first):
            return None
        if operator in _FUNCTIONS:
            return (*first, _Function(_FUNCTIONS[operator])) if settings.get("alpha", 1.0) == 1.0 else None
        if operator == "Clip":
            limits = [*given[1:], *(settings[x] for x in ("min", "max") if x in settings)]
            limits = [np.asarray(x, float).reshape(-1).tolist() for x in limits]
            return (*first, _Function("clip")) if limits == [[-1.0], [1.0]] else None
        if operator == "MatMul" and isinstance(given[1], np.ndarray) and given[1].ndim == 2:
            return _followed(first, Dense(given[1], np.zeros(given[1].shape[1], given[1].dtype)))
        if operator == "Gemm" and isinstance(given[1], np.ndarray) and not settings.get("transA", 0):
            weight = given[1].T if settings.get("transB", 0) else given[1]
            bias = np.zeros(weight.shape[1], weight.dtype) if len(given) < 3 or given[2] is None else given[2]
            kind = weight.dtype.type
            bias = np.broadcast_to(bias.reshape(-1), weight.shape[1:]) * kind(settings.get("beta", 1.0))
            return _followed(first, Dense(weight * kind(settings.get("alpha", 1.0)), bias))
        return _gru(first, given, settings) if operator == "GRU" else None


def _is_chain(value: Any) -> bool:
    return isinstance(value, tuple) and not isinstance(value, _State | _Unknown)


def _arithmetic(operator: str, first: Any, second: Any) -> Any:
    if _is_chain(first) and _is_chain(second):
        pair = sorted((first, second), key=len)
        gated = operator == "Mul" and pair[1] == (*pair[0], _Function("sigmoid"))
        return (*pair[0], _Function("swish")) if gated else None
    if not _is_chain(first):
        if operator in ("Sub", "Div"):
            return None
        first, second = second, first
    if not _is_chain(first) or not isinstance(second, np.ndarray) or second.shape[:-1] != (1,) * (second.ndim - 1):
        return None
    number = second.reshape(-1)
    one, nothing = np.ones_like(number), np.zeros_like(number)
    scale = {"Mul": number, "Div": one / number if operator == "Div" else one}.get(operator, one)
    return _followed(first, _Scale(scale, {"Add": number, "Sub": -number}.get(operator, nothing)))


def _followed(chain: _Chain, item: Layer | _Scale) -> _Chain:
    """Chain with one more item, which becomes part of a layer if it is beside one."""
    *before, last = chain or (None,)
    if isinstance(item, _Scale):
        if isinstance(last, Dense):
            return *before, Dense(last.weight * item.scale, last.bias * item.scale + item.shift)
        if isinstance(last, _Scale):
            return *before, _Scale(last.scale * item.scale, last.shift * item.scale + item.shift)
        return *chain, item
    weight, bias, *rest = item
    if isinstance(last, _Scale):
        bias = bias + np.broadcast_to(last.shift, weight.shape[:1]) @ weight
        weight = np.broadcast_to(last.scale, weight.shape[:1])[:, None] * weight
    elif isinstance(last, Dense):
        weight, bias = last.weight @ weight, last.bias @ weight + bias
    else:
        return *chain, item
    return *before, type(item)(weight, bias, *rest)


def _gru(first: _Chain, given: list[Any], settings: dict[str, Any]) -> _Chain | None:
    arrays = [x for x in given[1:4] if isinstance(x, np.ndarray) and len(x) == 1]
    kept = given[5] if len(given) > 5 else None
    plain = settings.get("linear_before_reset") == 1 and settings.get("direction", b"forward") == b"forward"
    if not plain or "clip" in settings or "activations" in settings or len(arrays) < 2 or not isinstance(kept, _State):
        return None
    inputs, hidden = arrays[0][0], arrays[1][0]
    biases = np.split(arrays[2][0], 2) if len(arrays) > 2 else np.zeros((2, len(inputs)), inputs.dtype)
    inputs, hidden, *biases = map(reset_and_update_swapped, (inputs, hidden, *biases))
    return _followed(first, Unit(inputs.T, biases[0], hidden.T, biases[1]))


def _policy(chain: _Chain, limit: str | None) -> tuple[list[Layer], str, str]:
    """Layers, activation between them, and limit of the outputs."""
    *items, last = chain or (None,)
    if isinstance(last, _Scale):
        if not all(np.all(part == _HALF) for part in last):
            raise CfbError(
                "the output must be actions from -1 to 1, or commands (1 + action) / 2; found another scale."
            )
        *items, last = items or (None,)
    if isinstance(last, _Function):
        if last.name not in LIMITS:
            raise CfbError(f"the output must be limited by a tanh or a clip from -1 to 1; found {last.name}.")
        # A tanh stays within the limits of a clip that comes after it.
        if limit not in (None, last.name) and (last.name, limit) != ("tanh", "clip"):
            raise CfbError(f"the model limits its output by {last.name} already; leave out the limit {limit}.")
        limit = last.name
    elif last is not None:
        items.append(last)
    if limit not in LIMITS:
        raise CfbError(f"the model does not limit its output; give a limit, {' or '.join(LIMITS)}; found {limit}.")
    layers = [item for item in items if isinstance(item, Dense | Unit)]
    activation = next((item.name for item in items if isinstance(item, _Function)), "tanh")
    # Every layer but the last has its activation, a recurrent unit none.
    wanted = [[_said(x)] if x is layers[-1] or isinstance(x, Unit) else [_said(x), activation] for x in layers]
    found = [_said(item) for item in items]
    if found != [word for words in wanted for word in words] or activation not in ACTIVATIONS:
        raise CfbError(
            f"between two layers there must be one activation ({', '.join(ACTIVATIONS)}), always the same, and none "
            f"after a GRU; found {', '.join(found) or 'no layer'}."
        )
    return layers, activation, limit


def _said(item: Any) -> str:
    if isinstance(item, _Function):
        return item.name
    return {Dense: "a layer", Unit: "a GRU"}.get(type(item), "a scale")
