"""Files of trained policies: weights and the complete observation contract in one small ``.npz``."""

from __future__ import annotations

import json
import zipfile
from dataclasses import dataclass, field
from hashlib import sha256
from itertools import pairwise
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from cfb_mjx.control.neural import ACTIVATIONS, WRITTEN, Network, NeuralController
from cfb_mjx.documents import with_former
from cfb_mjx.envs.observation import BEFORE_BENDS, Layout
from cfb_mjx.errors import CfbError
from cfb_mjx.files import read_bytes, replacing

FORMAT = "cfb_mjx policy 1"


@dataclass(frozen=True)
class PolicyFile:
    """A trained policy with its origin.

    ``training`` holds the configuration, the model YAML of the training, seed and versions. It holds no dates or times,
    so that the same training on the same machine gives the same file.
    """

    controller: NeuralController
    task: str
    training: dict[str, Any] = field(default_factory=dict)

    @property
    def lumped_delay(self) -> bool:
        """Whether the policy was trained with a gyro as late as the pose: `cfb_mjx.envs.Task.lumped_delay`."""
        return bool(self.training.get("config", {}).get("lumped_delay", True))

    @property
    def weights_sha256(self) -> str:
        """SHA-256 of weights and biases, first layer first, as little-endian float32."""
        network = self.controller.network
        layers = zip(network.weights, network.biases, strict=True)
        return sha256(b"".join(np.asarray(x, "<f4").tobytes() for layer in layers for x in layer)).hexdigest()


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
    about = {
        "format": FORMAT,
        "task": policy.task,
        "layers": len(network.weights),
        "activation": network.activation,
        "output": f"u = (1 + {WRITTEN[network.limit]}) / 2",
        "observation": vars(policy.controller.layout),
        "weights_sha256": policy.weights_sha256,
        "training": policy.training,
    }
    arrays["about"] = np.frombuffer(json.dumps(about, indent=1).encode(), np.uint8)
    with replacing(path) as temporary, open(temporary, "wb") as file:
        np.savez_compressed(file, **arrays)


def load_policy(path: str | Path) -> PolicyFile:
    """Read a policy written by `save_policy`.

    Args:
        path: file, or the name of a shipped policy.

    Raises:
        CfbError: there is no such file, or it is not a policy, or damaged.
    """
    path = shipped_policies().get(str(path), path)
    read_bytes(path, 1)
    try:
        with open(path, "rb") as file, np.load(file, allow_pickle=False) as archive:
            about = json.loads(archive["about"].tobytes())
            if about["format"] != FORMAT:
                raise CfbError(f"{path}: the policy has another format ({about['format']!r}, not {FORMAT!r}).")
            shown, activation = about["observation"], about["activation"]
            limit = next(name for name, text in WRITTEN.items() if f"(1 + {text}) / 2" in about["output"])
            settings = dict(with_former(shown, "position_scale_m", BEFORE_BENDS))
            settings |= {key: tuple(shown.get(key, ())) for key in ("setpoint_scales", "preview_s")}
            layout = Layout(**settings)
            weights = tuple(archive[f"weight_{i}"] for i in range(about["layers"]))
            biases = tuple(archive[f"bias_{i}"] for i in range(about["layers"]))
    except (OSError, ValueError, KeyError, TypeError, EOFError, StopIteration, zipfile.BadZipFile):
        raise CfbError(
            f"{path}: is not a policy of cfb_mjx, or is damaged; give a policy.npz written by cfb train."
        ) from None
    sizes = [layout.size, *(len(b) for b in biases)]
    fits = [w.shape for w in weights] == list(pairwise(sizes)) and sizes[-1] == 4
    if not fits or activation not in ACTIVATIONS or not all(np.all(np.isfinite(x)) for x in (*weights, *biases)):
        raise CfbError(f"{path}: the weights do not fit the observation, or are not finite; train it again.")
    network = Network(tuple(map(jnp.asarray, weights)), tuple(map(jnp.asarray, biases)), activation, limit)
    return PolicyFile(NeuralController(network, layout), about["task"], about["training"])
