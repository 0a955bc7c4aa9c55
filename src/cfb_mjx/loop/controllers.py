"""Adapter for trained policies (jax) as controllers of the reference simulator (NumPy)."""

from __future__ import annotations

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from cfb_mjx.control.neural import NeuralController
from cfb_mjx.envs.observation import Estimate
from cfb_mjx.errors import CfbError
from cfb_mjx.reference_simulator.constants import TICK
from cfb_mjx.reference_simulator.other_controller import OtherController, Seen


def controller_of(controllers: Sequence[NeuralController]) -> OtherController:
    """Combine policies into one controller of the simulator, with one lane per policy.

    Args:
        controllers: one policy per lane.

    Raises:
        CfbError: the policies differ in more than their weights, or their control step is not a multiple of a tick.
    """
    first = controllers[0]
    if any(jax.tree.structure(one) != jax.tree.structure(first) for one in controllers):
        raise CfbError("policies that fly side by side must have the same observation and layers.")
    every = first.control_dt_s / TICK
    if abs(every - round(every)) > 1e-6 or every < 1:
        raise CfbError(f"a policy's control step of {first.control_dt_s} s is not a multiple of the plants' {TICK} s.")
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *controllers)

    def fly(memory, seen: Seen):
        shown = [np.ascontiguousarray(x.T) for x in (seen.position, seen.velocity, seen.quaternion, seen.body_rate)]
        if memory is None:
            memory = _start(stacked, *shown)
        memory, command = _command(stacked, memory, *shown)
        return memory, np.asarray(command, float).T

    return OtherController(round(every), fly)


@eqx.filter_jit
def _start(controllers, *shown):
    return jax.vmap(lambda controller, *of: controller.start(Estimate(*of)))(controllers, *shown)


@eqx.filter_jit
def _command(controllers, memories, *shown):
    return jax.vmap(lambda controller, memory, *of: controller.command(memory, Estimate(*of)))(
        controllers, memories, *shown
    )
