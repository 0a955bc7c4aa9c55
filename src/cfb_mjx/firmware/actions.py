"""What the four outputs of a policy mean: motor commands, or set-points of the firmware's own loops.

The loops run beneath the policy at 500 Hz on the drone's own state (`cfb_mjx.firmware.pid`). "body_rates" is what
papers call CTBR: collective thrust and body rates.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from cfb_mjx.firmware import pid
from cfb_mjx.firmware.pid import FirmwarePid, Setpoint
from cfb_mjx.model.state import State


class Output(NamedTuple):
    """One output of a policy; from 0 to 1 in the network's terms, from ``low`` to ``high`` in its unit."""

    name: str
    unit: str
    low: float
    high: float


@dataclass(frozen=True)
class Action:
    """Meaning of a policy's outputs, and the loop that follows them. Hashable.

    Attributes:
        name: name in configurations and policy files.
        words: what the policy commands, for texts.
        outputs: the four outputs.
    """

    name: str
    words: str
    outputs: tuple[Output, ...]

    @property
    def has_loop(self) -> bool:
        """Whether a loop of the firmware is between the policy and the motors."""
        return self.name != "motors"

    def values(self, outputs: Float[Array, "4"]) -> Float[Array, "4"]:
        """The policy's ``outputs`` [0 to 1] in the units of `outputs`."""
        low, span = (jnp.asarray(x, outputs.dtype) for x in self._range)
        return low + span * outputs

    def fractions(self, values: np.ndarray) -> np.ndarray:
        """Undo `values`: outputs from 0 to 1, (..., 4), of values in their units."""
        low, span = self._range
        return (values - low) / span

    @property
    def _range(self) -> tuple[np.ndarray, np.ndarray]:
        """Least value of every output, and how far its values reach."""
        low, high = np.array([(each.low, each.high) for each in self.outputs]).T
        return low, high - low

    def settled(self, motors: Float[Array, "4"]) -> Float[Array, "4"]:
        """Outputs of a policy that has long commanded what the motors do now, with set-points at rest.

        Args:
            motors: commands of M1..M4, 0 to 1.
        """
        if not self.has_loop:
            return motors
        rest = jnp.full(4, 0.5, motors.dtype)
        return rest.at[0].set(jnp.mean(motors)) if self.outputs[0] == _THRUST else rest


def _rates(limit: float, yaw_limit: float) -> tuple[Output, ...]:
    about = (("roll rate (about body x)", limit), ("pitch rate (y)", limit), ("yaw rate (z)", yaw_limit))
    return tuple(Output(name, "rad/s", -x, x) for name, x in about)


def _along(name: str, unit: str, limit: float) -> tuple[Output, ...]:
    return (*(Output(f"{name} along world {axis}", unit, -limit, limit) for axis in "xyz"), _YAW)


_THRUST = Output("mean command of the motors", "1", 0.0, 1.0)
_YAW = Output("yaw", "rad", -math.pi, math.pi)
ACTIONS = {
    action.name: action
    for action in (
        Action("motors", "the motors", tuple(Output(f"command of M{i}", "1", 0.0, 1.0) for i in (1, 2, 3, 4))),
        Action("body_rates", "thrust and body rates", (_THRUST, *_rates(15.0, 5.0))),
        Action(
            "attitude",
            "thrust and attitude",
            (_THRUST, *(Output(name, "rad", -math.pi / 3, math.pi / 3) for name in ("roll", "pitch")), _YAW),
        ),
        Action("velocity", "velocities", _along("velocity", "m/s", 2.0)),
        Action("position", "positions", _along("target +", "m", 1.0)),
    )
}
"""Actions by name. Roll and pitch are right-handed about body x and y."""


class InnerLoop(eqx.Module):
    """The firmware's loop beneath a policy."""

    firmware: FirmwarePid
    memory: Any


def start(action: Action, firmware: FirmwarePid, measurement: State) -> InnerLoop:
    """Return the loop of an action that has one after ``measurement``, with empty integrators."""
    memory = pid.init(firmware, measurement)
    # Arrays, so that episodes can be stacked.
    firmware = jax.tree.map(lambda x: jnp.asarray(x, memory.thrust.dtype), firmware)
    return InnerLoop(firmware, memory.rate if action.name == "body_rates" else memory)


def command(
    action: Action, loop: InnerLoop, measurement: State, outputs: Float[Array, "4"], target: Float[Array, "3"]
) -> tuple[InnerLoop, Float[Array, "4"]]:
    """One step of the loop, `cfb_mjx.firmware.pid.DT` seconds.

    Args:
        action: what the outputs mean.
        loop: the loop.
        measurement: state of the drone; its rotor speeds are not used.
        outputs: the policy's outputs [0 to 1], which are held between its commands.
        target: target of the policy, world, m; used by the action "position" alone.

    Returns:
        The new loop, and the command of M1..M4, each in [0, 1].
    """
    values, firmware = action.values(outputs), loop.firmware
    if action.name == "body_rates":
        rates, wanted = (pid.firmware_rates(x) for x in (jnp.asarray(measurement.body_rate), values[1:]))
        memory, motors = pid.rate_step(firmware, loop.memory, rates, wanted, pid.COUNTS * values[0])
        return InnerLoop(firmware, memory), motors
    if action.name == "attitude":
        setpoint = Setpoint.tilted(values[1], values[2], values[3], values[0])
    elif action.name == "velocity":
        setpoint = Setpoint.moving(values[:3], values[3])
    else:
        setpoint = Setpoint.hover(target + values[:3], values[3])
    memory, motors = pid.step(firmware, loop.memory, measurement, setpoint)
    return InnerLoop(firmware, memory), motors
