"""Sets of weights that an exported policy takes without being flashed: what is in them, and what they fit."""

from __future__ import annotations

import json
import struct
from hashlib import sha256
from typing import Any
from zlib import crc32

import numpy as np

from cfb_mjx.control.policy_file import PolicyFile
from cfb_mjx.deploy.deployment import Deployment

FILE = "weights.bin"
MAGIC, VERSION = int.from_bytes(b"CFBW", "little"), 1
GOOD = 2
"""Status of a set that flies, `cfb_weights_status_t`."""
HEADER = struct.Struct("<5I")
"""Magic, version, architecture, number of floats, CRC-32 of all the others and of the floats."""


def weight_arrays(policy: PolicyFile) -> dict[str, np.ndarray]:
    """Weights and biases as the C has them, float32: layers, then the recurrent unit; a row for every output."""
    network, found = policy.controller.network, {}
    for i, (weight, bias) in enumerate(zip(network.weights, network.biases, strict=True)):
        found |= {f"weight_{i}": weight.T, f"bias_{i}": bias}
    if (gru := network.gru) is not None:
        found |= {"gru_input_weight": gru.input_weight.T, "gru_input_bias": gru.input_bias}
        found |= {"gru_hidden_weight": gru.hidden_weight.T, "gru_hidden_bias": gru.hidden_bias}
    # One row per output, so that the sums read memory in order.
    return {name: np.asarray(x, np.float32) for name, x in found.items()}


def numbers(deployment: Deployment) -> np.ndarray:
    """Numbers of a set, float32: the four outputs of a hover, then those of `weight_arrays`."""
    parts = [deployment.settled(), *weight_arrays(deployment.holder).values()]
    return np.concatenate([np.asarray(x, "<f4").reshape(-1) for x in parts])


def architecture(deployment: Deployment) -> int:
    """Hash of all that the C computes with but the numbers of a set, 32 bits.

    That is the first four bytes of SHA-256 of a JSON text: sizes of the layers, recurrent unit, activation, limit of
    the outputs, observation with its scales, and ranges of the outputs.
    """
    network = deployment.holder.controller.network
    fixed = {
        "sizes": network.sizes,
        "gru_after_layers": None if network.gru is None else network.before,
        "activation": network.activation,
        "limit": network.limit,
        "observation": vars(deployment.holder.controller.layout),
        "outputs": [[x.low, x.high] for x in deployment.action.outputs],
    }
    return int.from_bytes(sha256(json.dumps(fixed, sort_keys=True).encode()).digest()[:4], "little")


def weight_set(deployment: Deployment) -> bytes:
    """Contents of ``weights.bin``: header (`HEADER`), then `numbers`, all little-endian."""
    values = numbers(deployment)
    head, data = (MAGIC, VERSION, architecture(deployment), len(values)), values.tobytes()
    return HEADER.pack(*head, crc32(struct.pack("<4I", *head) + data)) + data


def about_set(deployment: Deployment) -> dict[str, Any]:
    """Describe the set for the contract."""
    *_, fits, count, crc = HEADER.unpack_from(weight_set(deployment))
    return {
        "file": FILE,
        "architecture": f"{fits:#010x}",
        "crc32": f"{crc:#010x}",
        "numbers": count,
        "layout": "uint32 magic, version, architecture, numbers, crc32 (of the four before it and the numbers); "
        "float32 outputs of a hover (4), then each layer's weights (outputs, inputs) and biases, then those of the "
        "recurrent unit; little-endian",
        "refused": "a set of another architecture, incomplete, with another CRC, or with numbers that are not finite; "
        "then, and while a set is being written, the weights in flash fly",
    }
