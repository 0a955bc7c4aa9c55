"""Flips as one manoeuvre: climb towards a raised target, turn, and be caught at the start (paper section VI).

The same target controller climbs and catches; in between a flip policy holds rate and speed. The whole manoeuvre is a
controller and can be used like any other.

`load_manoeuvre` and `save_manoeuvre` read and write files with the number of rotations and the numbers that shape them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import yaml
from jaxtyping import Array, Float, Int

from cfb_mjx.control.controllers import require_motor_commands
from cfb_mjx.control.neural import NeuralController
from cfb_mjx.documents import load_named, parse_yaml, refuse_unknown, shipped_names, told
from cfb_mjx.envs.observation import Memory, StateEstimate, observation, remember
from cfb_mjx.errors import CfbError
from cfb_mjx.files import write_text
from cfb_mjx.model.state import AnyArray

CLIMB, TURN, CATCH = range(3)
"""Phases of the manoeuvre, in order."""


class Knobs(NamedTuple):
    """Adjustable parameters of a flip. A phase ends when its time is over, or earlier at a certain speed or angle."""

    climb_m: Float[Array, ""] | float
    """Height of the climb's target above the start, m: the higher, the faster the drone climbs."""
    climb_s: Float[Array, ""] | float
    """Longest duration of the climb, s."""
    turn_s: Float[Array, ""] | float
    """Longest duration of the turn, s."""
    speed_mps: Float[Array, ""] | float
    """Speed along the body's z axis that the flip policy is to fly, m/s."""
    rate_radps: Float[Array, ""] | float
    """Rate about the body's x axis that the flip policy is to fly, rad/s."""
    climb_mps: Float[Array, ""] | float = math.inf
    """Upward speed at which the climb ends, m/s."""
    turn_rad: Float[Array, ""] | float = math.inf
    """Angle at which the turn ends, rad."""


class ManoeuvreMemory(NamedTuple):
    """Memories of the policies of all phases, all kept up to date, and the progress of the manoeuvre."""

    climb: Memory
    turn: Memory
    catch: Memory
    phase: Int[Array, ""]
    """Phase of the last command."""
    count: Int[Array, ""]  # pyright: ignore[reportIncompatibleMethodOverride]  # nobody counts in it
    """Number of commands given in this phase."""
    roll: Float[Array, ""]
    """Roll angle of the last estimate, rad."""
    turned: Float[Array, ""]
    """Angle turned since the turn began, rad."""


class Manoeuvre(eqx.Module):
    """A controller that flips and returns to its start, which is the target.

    Attributes:
        holder: policy that flies to targets.
        turner: flip policy, with set-points of speed and rate.
        knobs: parameters of the flip.
    """

    holder: NeuralController
    turner: NeuralController
    # Arrays, so that one compiled program serves all knobs.
    knobs: Knobs = eqx.field(converter=lambda knobs: Knobs(*map(jnp.asarray, knobs)))

    def __check_init__(self):
        if len(self.turner.layout.setpoint_scales) != 2 or self.holder.layout.setpoint_scales:
            raise CfbError("A flip needs a target policy, and a flip policy with set-points of speed and rate.")
        if self.holder.recurrent or self.turner.recurrent:
            raise CfbError("A flip needs fully connected policies, and one of these two is recurrent; train another.")
        require_motor_commands(self.holder, "a flip")
        require_motor_commands(self.turner, "a flip")
        if self.holder.control_dt_s != self.turner.control_dt_s:
            raise CfbError(
                f"The target policy commands every {self.holder.control_dt_s} s, the flip policy every "
                f"{self.turner.control_dt_s} s; train one of them again."
            )

    @property
    def control_dt_s(self) -> float:
        """Time between two commands, s."""
        return self.holder.control_dt_s

    def start(self, estimate: StateEstimate, command: Float[Array, "4"]) -> ManoeuvreMemory:
        """Return the memory at take-over."""
        climb, catch = (self.holder.start(seen, command) for seen in (self._raised(estimate), estimate))
        turn, roll = self.turner.start(estimate, command), roll_angle(estimate.quaternion)
        nothing = jnp.asarray(0)
        return ManoeuvreMemory(climb, turn, catch, nothing, nothing, roll, jnp.zeros_like(roll))

    def command(self, memory: ManoeuvreMemory, estimate: StateEstimate) -> tuple[ManoeuvreMemory, Float[Array, "4"]]:
        """Return the new memory and the command of M1..M4, each in [0, 1]."""
        phase, count, roll, turned = self._advance(memory, estimate)
        raised, held, turning = self._raised(estimate), self.holder.layout, self.turner.layout
        climbing, catching = observation(held, memory.climb, raised), observation(held, memory.catch, estimate)
        holding = self.holder.act(jnp.where(phase == CLIMB, climbing, catching))
        setpoint = jnp.stack([jnp.asarray(x, holding.dtype) for x in (self.knobs.speed_mps, self.knobs.rate_radps)])
        spinning = self.turner.act(observation(turning, memory.turn, estimate, setpoint))
        u = jnp.where(phase == TURN, spinning, holding)
        caught = remember(held, memory.catch, estimate, u)
        # An integral that grew during the turn says nothing about what holding needs.
        still = jnp.where(phase == CATCH, caught.integral, jnp.zeros_like(caught.integral))
        caught = eqx.tree_at(lambda m: m.integral, caught, still)
        climbed, spun = remember(held, memory.climb, raised, u), remember(turning, memory.turn, estimate, u)
        return ManoeuvreMemory(climbed, spun, caught, phase, count, roll, turned), u

    def _advance(self, memory: ManoeuvreMemory, estimate: StateEstimate):
        """Phase of the next command, number of commands in it so far, roll angle, and angle turned."""
        roll, knobs = roll_angle(estimate.quaternion), self.knobs
        turned = jnp.where(memory.phase == TURN, memory.turned + nearest(roll - memory.roll), 0.0)
        # The margin keeps rounding from missing a time that is a multiple of the control step.
        elapsed = memory.count * self.control_dt_s + 1e-6
        climbed = (elapsed >= knobs.climb_s) | (estimate.velocity[2] >= knobs.climb_mps)
        round_about = (elapsed >= knobs.turn_s) | (turned >= knobs.turn_rad)
        over = ((memory.phase == CLIMB) & climbed) | ((memory.phase == TURN) & round_about)
        return memory.phase + over, jnp.where(over, 1, memory.count + 1), roll, turned

    def _raised(self, estimate: StateEstimate) -> StateEstimate:
        up = jnp.zeros_like(estimate.position).at[2].set(self.knobs.climb_m)
        return eqx.tree_at(lambda e: e.position, estimate, estimate.position - up)


def roll_angle(quaternion: Float[AnyArray, "*times 4"]) -> Float[Array, "*times"]:
    """Direction of the body's z axis in the world's YZ plane, rad in (-pi, pi]: the roll of flips about x."""
    w, x, y, z = jnp.moveaxis(quaternion, -1, 0)
    return jnp.arctan2(2 * (w * x - y * z), 1 - 2 * (x * x + y * y))


def nearest(angle: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """Wrap an angle to the interval from -pi to pi, rad."""
    return angle - 2 * jnp.pi * jnp.round(angle / (2 * jnp.pi))


def unwrapped(angle: Float[Array, "*batch times"]) -> Float[Array, "*batch times"]:
    """Remove jumps of full turns from a sequence of angles, starting at its first value, rad."""
    steps = nearest(jnp.diff(angle, axis=-1))
    return angle[..., :1] + jnp.concatenate([jnp.zeros_like(angle[..., :1]), jnp.cumsum(steps, axis=-1)], axis=-1)


FORMAT = "cfb_mjx manoeuvre 1"
_FOLDER = "manoeuvres"
_OPTIONAL = tuple(Knobs._field_defaults)
_NOT_NEGATIVE = ("climb_s", "turn_s")


@dataclass(frozen=True)
class ManoeuvreFile:
    """Contents of a manoeuvre YAML. Optional knobs that are missing have no effect."""

    rotations: int
    knobs: Knobs
    description: str = ""
    holder: str = "target"
    """Name or file of the target policy that climbs and catches, with which the knobs were found."""


def shipped_manoeuvres() -> list[str]:
    """Names of the manoeuvres shipped with the library."""
    return shipped_names(_FOLDER)


def load_manoeuvre(name_or_path: str | Path, changes: tuple[str, ...] = ()) -> ManoeuvreFile:
    """Read a shipped manoeuvre (``double-flip``) or a YAML file.

    Args:
        name_or_path: name or file.
        changes: changes of knobs, each ``KNOB=VALUE``.

    Raises:
        CfbError: there is no such file, a knob is unknown or missing, or a value is invalid; the message names it.
    """
    path, document = load_named(name_or_path, "manoeuvre", FORMAT, _FOLDER)
    refuse_unknown(document, {"format", "description", "rotations", "holder", "knobs"}, path, "")
    rotations, raw = document.get("rotations"), document.get("knobs")
    if not isinstance(rotations, int) or isinstance(rotations, bool) or rotations < 1:
        raise CfbError(f"{path}: rotations must be a whole number from 1, found {told(rotations)}.")
    if not isinstance(raw, dict):
        raise CfbError(f"{path}: knobs must be a mapping, found {told(raw)}.")
    refuse_unknown(raw, set(Knobs._fields), path, "knobs.")
    holder = document.get("holder", ManoeuvreFile.holder)
    if not isinstance(holder, str):
        raise CfbError(f"{path}: holder must be a policy's name or file, found {told(holder)}.")
    knobs = dict(raw)
    for change in changes:
        name, equals, text = change.partition("=")
        if not equals or name not in Knobs._fields:
            raise CfbError(f"--set {change}: write KNOB=VALUE, with one of {', '.join(Knobs._fields)}.")
        knobs[name] = parse_yaml(text, f"--set {change}")
    missing = [name for name in Knobs._fields if name not in knobs and name not in _OPTIONAL]
    if missing:
        raise CfbError(f"{path}: knobs.{missing[0]} is missing.")
    return ManoeuvreFile(
        rotations,
        Knobs(**{name: _number(value, name, path) for name, value in knobs.items()}),
        str(document.get("description", "")).strip(),
        holder,
    )


def save_manoeuvre(manoeuvre: ManoeuvreFile, path: str | Path) -> None:
    """Write a manoeuvre YAML, atomically.

    Raises:
        CfbError: the file cannot be written.
    """
    # Four digits: a tenth of a millimetre, a tenth of a millisecond.
    knobs = {name: round(float(x), 4) for name, x in manoeuvre.knobs._asdict().items() if math.isfinite(x)}
    document: dict[str, Any] = {"format": FORMAT, "description": manoeuvre.description}
    document |= {"rotations": manoeuvre.rotations, "holder": manoeuvre.holder, "knobs": knobs}
    write_text(path, yaml.safe_dump(document, sort_keys=False, width=120))


def _number(value: Any, name: str, path: Path) -> float:
    if not isinstance(value, int | float) or isinstance(value, bool) or math.isnan(value):
        raise CfbError(f"{path}: knobs.{name} must be a number, found {told(value)}.")
    if math.isinf(value) and name not in _OPTIONAL:
        raise CfbError(f"{path}: knobs.{name} must be finite.")
    if name in _NOT_NEGATIVE and value < 0:
        raise CfbError(f"{path}: knobs.{name} = {value} must not be negative.")
    return float(value)
