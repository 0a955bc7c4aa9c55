"""Flips as one manoeuvre: climb towards a raised target, turn, and be caught at the start (paper section VI).

The same target controller climbs and catches; between the two a flip policy holds rate and speed. All is a pilot, so it
flies wherever other controllers do.
"""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from cfb_mjx.control.neural import NeuralController
from cfb_mjx.envs.observation import Estimate, Memory, observation, remember
from cfb_mjx.errors import CfbError

CLIMB, TURN, CATCH = range(3)
"""The phases, in order."""


class Knobs(NamedTuple):
    """What of a flip its user may set."""

    climb_m: Float[Array, ""] | float
    """How far above the start the target of the climb is: the farther, the harder the drone climbs."""
    climb_s: Float[Array, ""] | float
    """How long it climbs."""
    turn_s: Float[Array, ""] | float
    """How long it turns after that."""
    speed_mps: Float[Array, ""] | float
    """Along the body's z axis, asked of the flip policy."""
    rate_radps: Float[Array, ""] | float
    """About the body's x axis, asked of the flip policy."""

    def phase(self, time: Float[Array, "*times"]) -> Int[Array, "*times"]:
        """`CLIMB`, `TURN` or `CATCH` for the command given at ``time`` [s]."""
        # Half a nanosecond: a switching time on a command's own time counts as reached.
        time = time + 5e-10
        return (time >= self.climb_s).astype(int) + (time >= self.climb_s + self.turn_s)


class ManoeuvreMemory(NamedTuple):
    """What each phase's policy remembers, kept up to date in all of them, and the number of commands given."""

    climb: Memory
    turn: Memory
    catch: Memory
    count: Int[Array, ""]


class Manoeuvre(eqx.Module):
    """A pilot that flips and returns to where it began, which is the target.

    Attributes:
        holder: flies to targets.
        turner: a flip policy, with set-points of speed and rate.
        knobs: when and what.
    """

    holder: NeuralController
    turner: NeuralController
    knobs: Knobs

    def __check_init__(self):
        if len(self.turner.layout.setpoint_scales) != 2 or self.holder.layout.setpoint_scales:
            raise CfbError("A flip needs a target policy, and a flip policy with set-points of speed and rate.")
        if self.holder.control_dt_s != self.turner.control_dt_s:
            raise CfbError(
                f"The target policy commands every {self.holder.control_dt_s} s, the flip policy every "
                f"{self.turner.control_dt_s} s; train one of them anew."
            )

    @property
    def control_dt_s(self) -> float:
        """Time between two commands, s."""
        return self.holder.control_dt_s

    def start(self, estimate: Estimate, command: Float[Array, "4"]) -> ManoeuvreMemory:
        """Memory at take-over."""
        climb, catch = (self.holder.start(seen, command) for seen in (self._raised(estimate), estimate))
        return ManoeuvreMemory(climb, self.turner.start(estimate, command), catch, jnp.asarray(0))

    def command(self, memory: ManoeuvreMemory, estimate: Estimate) -> tuple[ManoeuvreMemory, Float[Array, "4"]]:
        """New memory and command."""
        phase, raised = self.knobs.phase(memory.count * self.control_dt_s), self._raised(estimate)
        held, turned = self.holder.layout, self.turner.layout
        climbing, catching = observation(held, memory.climb, raised), observation(held, memory.catch, estimate)
        holding = self.holder.act(jnp.where(phase == CLIMB, climbing, catching))
        setpoint = jnp.stack([jnp.asarray(x, holding.dtype) for x in (self.knobs.speed_mps, self.knobs.rate_radps)])
        u = jnp.where(phase == TURN, self.turner.act(observation(turned, memory.turn, estimate, setpoint)), holding)
        after = ManoeuvreMemory(
            remember(held, memory.climb, raised, u),
            remember(turned, memory.turn, estimate, u),
            remember(held, memory.catch, estimate, u),
            memory.count + 1,
        )
        # An integral gathered while turning says nothing about what holding needs.
        still = jnp.where(phase == CATCH, after.catch.integral, 0.0)
        return after._replace(catch=eqx.tree_at(lambda m: m.integral, after.catch, still)), u

    def _raised(self, estimate: Estimate) -> Estimate:
        up = jnp.zeros_like(estimate.position).at[2].set(self.knobs.climb_m)
        return eqx.tree_at(lambda e: e.position, estimate, estimate.position - up)


def roll_angle(quaternion: Float[Array, "*times 4"]) -> Float[Array, "*times"]:
    """Direction of the body's z axis in the world's YZ plane, rad in (-pi, pi]: the roll of flips about x."""
    w, x, y, z = jnp.moveaxis(quaternion, -1, 0)
    return jnp.arctan2(2 * (w * x - y * z), 1 - 2 * (x * x + y * y))


def unwrapped(angle: Float[Array, "*batch times"]) -> Float[Array, "*batch times"]:
    """The angle without jumps of a whole turn, from its first value on, rad."""
    steps = jnp.diff(angle, axis=-1)
    steps = steps - 2 * jnp.pi * jnp.round(steps / (2 * jnp.pi))
    return angle[..., :1] + jnp.concatenate([jnp.zeros_like(angle[..., :1]), jnp.cumsum(steps, axis=-1)], axis=-1)


def as_knobs(values: dict[str, float]) -> Knobs:
    """Knobs of plain numbers, as arrays."""
    return jax.tree.map(jnp.asarray, Knobs(**values))
