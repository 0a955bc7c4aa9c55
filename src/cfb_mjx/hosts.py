"""Several processes, on one machine or many, that run as one: what they must agree on comes from the first.

Every process runs the same program; arrays are divided over the devices of all of them (`cfb_mjx.devices`). Files are
read and written by the first alone, so that the others need no common folder. ``jax.distributed.initialize`` comes
before anything else; for ``cfb train --coordinator`` `cfb_mjx.joining` calls it.
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
    """Whether this process is the one that reads, writes and talks."""
    return jax.process_index() == 0


def from_first(produce: Callable[[], Any]) -> Any:
    """What ``produce`` returns in the first process (JSON terms), in every process; the others do not call it.

    Raises:
        CfbError: in every process, where the first raises it.
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
    # Arrays only, and of one size everywhere: first how long it is, then what it says.
    length = int(multihost_utils.broadcast_one_to_all(np.asarray(len(content), np.int32)))
    padded = np.frombuffer(content.ljust(length)[:length], np.uint8)
    said = json.loads(multihost_utils.broadcast_one_to_all(padded).tobytes())
    if "refused" in said:
        raise CfbError(said["refused"])
    return said["found"]


def as_first(tree: Any) -> Any:
    """The arrays of the first process, in every process: elsewhere the same computation may have rounded otherwise."""
    if jax.process_count() == 1:
        return tree
    arrays, rest = eqx.partition(tree, eqx.is_array)
    return eqx.combine(jax.tree.map(jnp.asarray, multihost_utils.broadcast_one_to_all(arrays)), rest)
