"""Flips as one manoeuvre: climb towards a raised target, turn, and be caught at the start (paper section VI).

The same target controller climbs and catches; between the two a flip policy holds rate and speed. The
whole is a controller and flies wherever others do.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from cfb_mjx.control.neural import NeuralController
from cfb_mjx.envs.observation import Estimate, Memory, observation, remember
from cfb_mjx.errors import CfbError
from cfb_mjx.model.state import AnyArray

CLIMB, TURN, CATCH = range(3)
"""The phases, in order."""


class Knobs(NamedTuple):
    """What of a flip its user may set. A phase ends with its time, or earlier with the speed or angle of its own."""

    climb_m: Float[Array, ""] | float
    """How far above the start the target of the climb is: the farther, the harder the drone climbs."""
    climb_s: Float[Array, ""] | float
    """How long it climbs at most."""
    turn_s: Float[Array, ""] | float
    """How long it turns after that at most."""
    speed_mps: Float[Array, ""] | float
    """Along the body's z axis, asked of the flip policy."""
    rate_radps: Float[Array, ""] | float
    """About the body's x axis, asked of the flip policy."""
    climb_mps: Float[Array, ""] | float = math.inf
    """The climb is over once the drone rises so fast."""
    turn_rad: Float[Array, ""] | float = math.inf
    """The turn is over once the drone has turned so far."""


class ManoeuvreMemory(NamedTuple):
    """What each phase's policy remembers, kept up to date in all of them, and how far the manoeuvre is."""

    climb: Memory
    turn: Memory
    catch: Memory
    phase: Int[Array, ""]
    """Of the last command."""
    count: Int[Array, ""]  # pyright: ignore[reportIncompatibleMethodOverride]  # nobody counts in it
    """Commands given in this phase."""
    roll: Float[Array, ""]
    """Of the last estimate, rad."""
    turned: Float[Array, ""]
    """Since the turn began, rad."""


class Manoeuvre(eqx.Module):
    """A controller that flips and returns to where it began, which is the target.

    Attributes:
        holder: flies to targets.
        turner: a flip policy, with set-points of speed and rate.
        knobs: when and what.
    """

    holder: NeuralController
    turner: NeuralController
    # Arrays, so that one compiled program flies all knobs.
    knobs: Knobs = eqx.field(converter=lambda knobs: Knobs(*map(jnp.asarray, knobs)))

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
        turn, roll = self.turner.start(estimate, command), roll_angle(estimate.quaternion)
        nothing = jnp.asarray(0)
        return ManoeuvreMemory(climb, turn, catch, nothing, nothing, roll, jnp.zeros_like(roll))

    def command(self, memory: ManoeuvreMemory, estimate: Estimate) -> tuple[ManoeuvreMemory, Float[Array, "4"]]:
        """New memory and command."""
        phase, count, roll, turned = self._advance(memory, estimate)
        raised, held, turning = self._raised(estimate), self.holder.layout, self.turner.layout
        climbing, catching = observation(held, memory.climb, raised), observation(held, memory.catch, estimate)
        holding = self.holder.act(jnp.where(phase == CLIMB, climbing, catching))
        setpoint = jnp.stack([jnp.asarray(x, holding.dtype) for x in (self.knobs.speed_mps, self.knobs.rate_radps)])
        spinning = self.turner.act(observation(turning, memory.turn, estimate, setpoint))
        u = jnp.where(phase == TURN, spinning, holding)
        caught = remember(held, memory.catch, estimate, u)
        # An integral gathered while turning says nothing about what holding needs.
        still = jnp.where(phase == CATCH, caught.integral, jnp.zeros_like(caught.integral))
        caught = eqx.tree_at(lambda m: m.integral, caught, still)
        climbed, spun = remember(held, memory.climb, raised, u), remember(turning, memory.turn, estimate, u)
        return ManoeuvreMemory(climbed, spun, caught, phase, count, roll, turned), u

    def _advance(self, memory: ManoeuvreMemory, estimate: Estimate):
        """Phase of the command that is due, commands given in it so far, roll, and angle turned."""
        roll, knobs = roll_angle(estimate.quaternion), self.knobs
        turned = jnp.where(memory.phase == TURN, memory.turned + nearest(roll - memory.roll), 0.0)
        # A little more, so that a time that ends with a command's own is not missed by a rounding.
        elapsed = memory.count * self.control_dt_s + 1e-6
        climbed = (elapsed >= knobs.climb_s) | (estimate.velocity[2] >= knobs.climb_mps)
        round_about = (elapsed >= knobs.turn_s) | (turned >= knobs.turn_rad)
        over = ((memory.phase == CLIMB) & climbed) | ((memory.phase == TURN) & round_about)
        return memory.phase + over, jnp.where(over, 1, memory.count + 1), roll, turned

    def _raised(self, estimate: Estimate) -> Estimate:
        up = jnp.zeros_like(estimate.position).at[2].set(self.knobs.climb_m)
        return eqx.tree_at(lambda e: e.position, estimate, estimate.position - up)


def roll_angle(quaternion: Float[AnyArray, "*times 4"]) -> Float[Array, "*times"]:
    """Direction of the body's z axis in the world's YZ plane, rad in (-pi, pi]: the roll of flips about x."""
    w, x, y, z = jnp.moveaxis(quaternion, -1, 0)
    return jnp.arctan2(2 * (w * x - y * z), 1 - 2 * (x * x + y * y))


def nearest(angle: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """The same angle between -pi and pi."""
    return angle - 2 * jnp.pi * jnp.round(angle / (2 * jnp.pi))


def unwrapped(angle: Float[Array, "*batch times"]) -> Float[Array, "*batch times"]:
    """The angle without jumps of a whole turn, from its first value on, rad."""
    steps = nearest(jnp.diff(angle, axis=-1))
    return angle[..., :1] + jnp.concatenate([jnp.zeros_like(angle[..., :1]), jnp.cumsum(steps, axis=-1)], axis=-1)
