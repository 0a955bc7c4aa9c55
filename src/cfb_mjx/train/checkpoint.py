"""Files of complete training states, so that an interrupted training continues to the same result."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from cfb_mjx.errors import CfbError
from cfb_mjx.files import read_bytes, replacing


def save_checkpoint(path: Path, state: Any, about: dict[str, Any]) -> None:
    """Write the arrays of a state, atomically.

    Args:
        path: file to write.
        state: pytree; its arrays are stored.
        about: description of the state, for JSON.

    Raises:
        CfbError: the file cannot be written.
    """
    leaves = jax.tree.leaves(eqx.filter(state, eqx.is_array))  # of jax or of numpy
    arrays: dict[str, Any] = {f"{i:05d}": np.asarray(leaf) for i, leaf in enumerate(leaves)}
    with replacing(path) as temporary, open(temporary, "wb") as file:
        np.savez(file, about=np.frombuffer(json.dumps(about).encode(), np.uint8), **arrays)


def read_about(path: Path) -> dict[str, Any]:
    """Return the description of a checkpoint.

    Raises:
        CfbError: the file is not a checkpoint, or is damaged.
    """
    read_bytes(path, 1)
    try:
        with open(path, "rb") as file, np.load(file, allow_pickle=False) as archive:
            return json.loads(archive["about"].tobytes())
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        raise CfbError(f"{path}: is not a checkpoint of a training, or is damaged; train without --resume.") from None


def load_state(path: Path, like: Any) -> Any:
    """Read the state of a checkpoint.

    Args:
        path: file to read.
        like: state whose structure and constants the result has.

    Raises:
        CfbError: the file is damaged, or belongs to another training.
    """
    arrays, constants = eqx.partition(like, eqx.is_array)
    leaves, structure = jax.tree.flatten(arrays)
    try:
        with open(path, "rb") as file, np.load(file, allow_pickle=False) as archive:
            found = [archive[f"{i:05d}"] for i in range(len(archive.files) - 1)]
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        raise CfbError(f"{path}: is damaged; train without --resume.") from None
    same = len(found) == len(leaves) and all(
        a.shape == b.shape and a.dtype == b.dtype for a, b in zip(found, leaves, strict=True)
    )
    if not same:
        raise CfbError(f"{path}: holds another kind of training than this version's; train without --resume.")
    return eqx.combine(jax.tree.unflatten(structure, [jnp.asarray(x) for x in found]), constants)
