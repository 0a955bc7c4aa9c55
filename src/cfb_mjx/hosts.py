"""Several processes, on one machine or many, that run as one; values that must be equal come from the first process.

Every process runs the same program; arrays are divided over the devices of all of them (`cfb_mjx.devices`). Only the
first process reads and writes files, so that the others need no common folder. ``jax.distributed.initialize`` must come
before anything else; for ``cfb train --coordinator``, `cfb_mjx.joining` calls it.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils

from cfb_mjx.errors import CfbError


def first() -> bool:
    """Whether this is the first process, which reads and writes files and prints."""
    return jax.process_index() == 0


def from_first(produce: Callable[[], Any]) -> Any:
    """Call ``produce`` in the first process only, and return its result (JSON values) in every process.

    Raises:
        CfbError: ``produce`` raised it; it is raised in every process.
    """
    if jax.process_count() == 1:
        return produce()
    said: dict[str, Any] = {}
    if first():
        try:
            said["found"] = produce()
        except CfbError as error:
            said["refused"] = str(error)
    content = json.dumps(said).encode()
    # Only arrays of equal size can be sent: first the length, then the content.
    length = int(multihost_utils.broadcast_one_to_all(np.asarray(len(content), np.int32)))
    padded = np.frombuffer(content.ljust(length)[:length], np.uint8)
    said = json.loads(multihost_utils.broadcast_one_to_all(padded).tobytes())
    if "refused" in said:
        raise CfbError(said["refused"])
    return said["found"]


def as_first(tree: Any) -> Any:
    """Return the arrays of the first process in every process; the same computation may round differently elsewhere."""
    if jax.process_count() == 1:
        return tree
    arrays, rest = eqx.partition(tree, eqx.is_array)
    return eqx.combine(jax.tree.map(jnp.asarray, multihost_utils.broadcast_one_to_all(arrays)), rest)
