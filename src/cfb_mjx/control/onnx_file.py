"""Policies as ONNX files: for other runtimes, and from other libraries. Needs the extra ``onnx``."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from cfb_mjx import __version__
from cfb_mjx.control.foreign import assembled
from cfb_mjx.control.neural import Gru, NeuralController
from cfb_mjx.control.onnx_graph import policy_layers, reset_and_update_swapped
from cfb_mjx.envs.observation import Layout
from cfb_mjx.errors import CfbError
from cfb_mjx.files import read_bytes, replacing, require_ending

if TYPE_CHECKING:
    from cfb_mjx.control.policy_file import PolicyFile

SUFFIX = ".onnx"
PROPERTY = "cfb_mjx"
"""Key of the model's properties under which the policy file's description is, as JSON."""
_OPSET, _IR = 17, 8
"""Versions of the operators and of the format: those of 2022, which every runtime reads."""


def _onnx() -> Any:
    try:
        import onnx
    except ImportError:
        raise CfbError("ONNX files need the package onnx; pip install 'cfb_mjx[onnx]'.") from None
    return onnx


def write_onnx(policy: PolicyFile, path: str | Path) -> None:
    """Write a policy as an ONNX model, atomically.

    The model takes an ``observation``, (1, ``layout.size``) float32 (`cfb_mjx.envs.observation.Layout`), and gives a
    ``command``, (1, 4) from 0 to 1. That of a policy with a GRU of n numbers also takes its state, ``hidden``, (1, n),
    zero at the start, and gives ``next_hidden``. ``load_policy`` and ``cfb fly`` read it again.

    Args:
        policy: the policy.
        path: file, ending in ``.onnx``.

    Raises:
        CfbError: another ending, the package onnx is not installed, or the file cannot be written.
    """
    path = require_ending(path, (SUFFIX,), "an ONNX model must end in .onnx")
    onnx, network = _onnx(), policy.controller.network
    nodes, arrays = [], {}

    def node(operator: str, inputs: list[str], output: str, **settings) -> str:
        nodes.append(onnx.helper.make_node(operator, inputs, [output], output, **settings))
        return output

    def constant(name: str, value: Any) -> str:
        arrays[name] = np.asarray(value, getattr(value, "dtype", np.float32))
        return name

    inputs, outputs, at = {"observation": policy.controller.layout.size}, {"command": 4}, "observation"
    for i, (weight, bias) in enumerate(zip(network.weights, network.biases, strict=True)):
        if network.gru is not None and i == network.before:
            n = network.gru.size
            inputs["hidden"] = outputs["next_hidden"] = n
            first = constant("first_axis", np.zeros(1, np.int64))
            names = [constant(f"gru_{name}", x) for name, x in _as_onnx(network.gru).items()]
            rows = [node("Unsqueeze", [x, first], f"{x}_row") for x in (at, "hidden")]
            given = [rows[0], *names, "", rows[1]]
            # The first output, the state after every step of a sequence, is not asked for.
            unit = onnx.helper.make_node(
                "GRU", given, ["", "next_hidden_row"], "gru", hidden_size=n, linear_before_reset=1
            )
            nodes.append(unit)
            at = node("Squeeze", ["next_hidden_row", first], "next_hidden")
        parts = [constant(f"{name}_{i}", np.asarray(x, np.float32)) for name, x in (("weight", weight), ("bias", bias))]
        at = node("Gemm", [at, *parts], f"sum_{i}")
        if i + 1 < len(network.weights):
            at = _activated(node, network.activation, at, f"layer_{i}")
    if network.limit == "clip":
        at = node("Clip", [at, constant("least", -1.0), constant("most", 1.0)], "action")
    else:
        at = node("Tanh", [at], "action")
    half = constant("half", 0.5)
    node("Add", [node("Mul", [at, half], "half_action"), half], "command")

    def values(sizes: dict[str, int]) -> list:
        kind = onnx.TensorProto.FLOAT
        return [onnx.helper.make_tensor_value_info(name, kind, [1, size]) for name, size in sizes.items()]

    stored = [onnx.numpy_helper.from_array(np.asarray(x), name) for name, x in arrays.items()]
    graph = onnx.helper.make_graph(nodes, policy.task, values(inputs), values(outputs), stored)
    model = onnx.helper.make_model(
        graph,
        opset_imports=[onnx.helper.make_opsetid("", _OPSET)],
        ir_version=_IR,
        producer_name="cfb_mjx",
        producer_version=__version__,
    )
    onnx.helper.set_model_props(model, {PROPERTY: json.dumps(policy.about)})
    onnx.checker.check_model(model)
    with replacing(path) as temporary:
        temporary.write_bytes(model.SerializeToString(deterministic=True))


def _activated(node: Callable[..., str], activation: str, at: str, name: str) -> str:
    if activation == "swish":
        return node("Mul", [at, node("Sigmoid", [at], f"{name}_gate")], name)
    return node({"tanh": "Tanh", "relu": "Relu"}[activation], [at], name)


def _as_onnx(gru: Gru) -> dict[str, np.ndarray]:
    """Arrays of a recurrent unit as ONNX has them: (1, gates, ...), update before reset."""
    arrays = {
        "W": np.asarray(gru.input_weight, np.float32).T,
        "R": np.asarray(gru.hidden_weight, np.float32).T,
        "B": np.asarray(gru.input_bias, np.float32),
    }
    found = {name: reset_and_update_swapped(x) for name, x in arrays.items()}
    kept = reset_and_update_swapped(np.asarray(gru.hidden_bias, np.float32))
    return {name: x[None] for name, x in (found | {"B": np.concatenate([found["B"], kept])}).items()}


def read_onnx(
    path: str | Path, layout: Layout | None = None, *, limit: str | None = None, mean: Any = None, std: Any = None
) -> NeuralController:
    """Read a policy from an ONNX model, of this library or of another.

    Models of other libraries must be fully connected and trained on this library's observation; ``torch.onnx.export``
    writes such, of Stable-Baselines3's policies too, whose first output is then the action. ``save_policy`` keeps the
    result for ``cfb fly`` and ``cfb export``.

    Args:
        path: file.
        layout: observation layout of the task; None: the one in the file, which models of this library have.
        limit: how the action is limited where the model does not do it: ``clip`` (Stable-Baselines3's PPO) or ``tanh``.
        mean: mean by which observations were normalised outside of the model, (inputs,); None: they were not.
        std: standard deviation likewise; see `cfb_mjx.control.foreign_controller`.

    Raises:
        CfbError: the package onnx is not installed, the file is not an ONNX model, there is no layout, an operator is
            not one of fully connected layers, or the layers do not fit the layout or four motors.
    """
    return read_with_about(path, layout, limit=limit, mean=mean, std=std)[0]


def read_with_about(
    path: str | Path, layout: Layout | None = None, *, limit: str | None = None, mean: Any = None, std: Any = None
) -> tuple[NeuralController, dict[str, Any]]:
    """Read a policy and what this library wrote about it, empty for other models; arguments as for `read_onnx`."""
    onnx = _onnx()
    read_bytes(path, 1)
    # protobuf and onnx raise many kinds of errors for damaged files.
    damaged = (
        f"{path}: is no ONNX model, is damaged, or its weights are in a file that is not beside it; copy it again."
    )
    try:
        model = onnx.load(str(path))
        about = json.loads(next((p.value for p in model.metadata_props if p.key == PROPERTY), "{}"))
        shown = Layout.from_document(about["observation"]) if about else None
    except Exception:
        raise CfbError(damaged) from None
    if layout is not None and shown is not None and layout != shown:
        raise CfbError(f"{path}: has an observation layout of its own, which is another one; leave out the layout.")
    if (layout := layout or shown) is None:
        raise CfbError(
            f"{path}: does not say what the policy observes; read it with cfb_mjx.control.read_onnx(path, layout) and "
            "keep it with save_policy."
        )
    try:
        layers, activation, limit = policy_layers(onnx, model, limit)
        return assembled(layers, layout, activation, limit, mean, std), about
    except CfbError as error:
        raise CfbError(f"{path}: {error}") from None
    except Exception:
        raise CfbError(damaged) from None
