"""Files of trained policies: weights and the complete observation contract in one small ``.npz``."""

from __future__ import annotations

import json
import zipfile
from dataclasses import dataclass, field
from hashlib import sha256
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from cfb_mjx.control.neural import WRITTEN, Gru, Network, NeuralController
from cfb_mjx.envs.observation import Layout
from cfb_mjx.errors import CfbError
from cfb_mjx.files import read_bytes, replacing

FORMAT = "cfb_mjx policy 1"
SUFFIXES = (".npz", ".onnx")
GRU = (
    "r = sigmoid(x Wr + br + h Ur + dr), z = sigmoid(x Wz + bz + h Uz + dz), c = tanh(x Wc + bc + r (h Uc + dc)), "
    "h = (1 - z) c + z h, from h = 0; input_weight [Wr, Wz, Wc], hidden_weight [Ur, Uz, Uc], biases likewise; hashed "
    "in its place among the layers as input_weight, input_bias, hidden_weight, hidden_bias"
)
"""A recurrent unit, as policy files and contracts write it."""
_GRU_ARRAYS = ("input_weight", "input_bias", "hidden_weight", "hidden_bias")


@dataclass(frozen=True)
class PolicyFile:
    """A trained policy with its origin.

    ``training`` holds the configuration, the model YAML of the training, seed and versions. It holds no dates or times,
    so that the same training on the same machine gives the same file. ``card`` is Markdown for people: how it was
    trained, and what it scored.
    """

    controller: NeuralController
    task: str
    training: dict[str, Any] = field(default_factory=dict)
    card: str = ""

    @property
    def lumped_delay(self) -> bool:
        """Whether the policy was trained with a gyro as late as the pose: `cfb_mjx.envs.Task.lumped_delay`."""
        return bool(self.training.get("config", {}).get("lumped_delay", True))

    @property
    def weights_sha256(self) -> str:
        """SHA-256 of weights and biases, first layer first, as little-endian float32.

        A recurrent unit is a layer too: weights and biases of its input, then those of its state (`Gru`).
        """
        return sha256(b"".join(np.asarray(x, "<f4").tobytes() for x in self.controller.network.parts)).hexdigest()

    @property
    def about(self) -> dict[str, Any]:
        """Everything but the weights, for JSON: what policy files hold."""
        network = self.controller.network
        found = {
            "format": FORMAT,
            "task": self.task,
            "layers": len(network.weights),
            "activation": network.activation,
            "output": f"u = (1 + {WRITTEN[network.limit]}) / 2",
            "observation": vars(self.controller.layout),
            "weights_sha256": self.weights_sha256,
            "training": self.training,
        }
        found |= about_gru(network) if self.controller.recurrent else {}
        return found | ({"card": self.card} if self.card else {})


def shipped_policies() -> dict[str, Path]:
    """Names and files of the policies shipped with the library."""
    folder = Path(__file__).resolve().parents[1] / "policies"
    return {path.parent.name: path for path in sorted(folder.glob("*/policy.npz"))}


def save_policy(policy: PolicyFile, path: str | Path) -> None:
    """Write a policy file, atomically.

    Raises:
        CfbError: the file cannot be written.
    """
    network = policy.controller.network
    arrays: dict[str, Any] = {f"weight_{i}": np.asarray(w, np.float32) for i, w in enumerate(network.weights)}
    arrays |= {f"bias_{i}": np.asarray(b, np.float32) for i, b in enumerate(network.biases)}
    if network.gru is not None:
        arrays |= {f"gru_{name}": np.asarray(getattr(network.gru, name), np.float32) for name in _GRU_ARRAYS}
    arrays["about"] = np.frombuffer(json.dumps(policy.about, indent=1).encode(), np.uint8)
    with replacing(path) as temporary, open(temporary, "wb") as file:
        np.savez_compressed(file, **arrays)


def load_policy(path: str | Path) -> PolicyFile:
    """Read a policy written by `save_policy`, or by `write_onnx`.

    Args:
        path: file, or the name of a shipped policy.

    Raises:
        CfbError: there is no such file, or it is not a policy, or damaged.
    """
    path = shipped_policies().get(str(path), path)
    read_bytes(path, 1)
    if Path(path).suffix == ".onnx":
        return _load_onnx(path)
    try:
        with open(path, "rb") as file, np.load(file, allow_pickle=False) as archive:
            about = json.loads(archive["about"].tobytes())
            if about["format"] != FORMAT:
                raise CfbError(f"{path}: the policy has another format ({about['format']!r}, not {FORMAT!r}).")
            shown, activation = about["observation"], about["activation"]
            limit = next(name for name, text in WRITTEN.items() if f"(1 + {text}) / 2" in about["output"])
            layout = Layout.from_document(shown)
            weights = tuple(jnp.asarray(archive[f"weight_{i}"]) for i in range(about["layers"]))
            biases = tuple(jnp.asarray(archive[f"bias_{i}"]) for i in range(about["layers"]))
            recurrent = about.get("gru")
            gru = Gru(*(jnp.asarray(archive[f"gru_{name}"]) for name in _GRU_ARRAYS)) if recurrent else None
            network = Network(weights, biases, activation, limit, gru, recurrent["after_layers"] if recurrent else 0)
    except (OSError, ValueError, KeyError, TypeError, EOFError, StopIteration, zipfile.BadZipFile):
        raise CfbError(
            f"{path}: is not a policy of cfb_mjx, or is damaged; give a policy.npz written by cfb train."
        ) from None
    if not network.fits(layout.size) or not all(bool(jnp.all(jnp.isfinite(x))) for x in network.parts):
        raise CfbError(f"{path}: the weights do not fit the observation, or are not finite; train it again.")
    return PolicyFile(NeuralController(network, layout), about["task"], about["training"], str(about.get("card", "")))


def _load_onnx(path: str | Path) -> PolicyFile:
    from cfb_mjx.control.onnx_file import read_with_about

    controller, about = read_with_about(path)
    if about.get("format") != FORMAT:
        raise CfbError(f"{path}: the policy has another format ({about.get('format')!r}, not {FORMAT!r}).")
    try:
        policy = PolicyFile(controller, about["task"], about["training"], str(about.get("card", "")))
        same = policy.weights_sha256 == about["weights_sha256"]
    except KeyError as error:
        raise CfbError(f"{path}: what it says about the policy lacks {error}; write it again.") from None
    if not same:
        raise CfbError(
            f"{path}: the weights are not those that it was written with; write it again, or read them with "
            "cfb_mjx.control.read_onnx."
        )
    return policy


def about_gru(network: Network) -> dict[str, Any]:
    """Say where the recurrent unit of a network is, how many numbers it keeps, and what it computes; for JSON."""
    return {"gru": {"after_layers": network.before, "size": network.sizes[network.before][1], "computes": GRU}}
