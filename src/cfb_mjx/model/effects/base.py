"""What an effect is: parameters plus pure functions that may change the drone, its motors, the loads or the wrench."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import equinox as eqx
from jaxtyping import Array

from cfb_mjx.model.rotors import RotorLoads
from cfb_mjx.model.vector import Vec
from cfb_mjx.parameters.limits import Limits
from cfb_mjx.parameters.parameters import Parameters

INERTIAL, CONSTRAINT, EXPECTATION = 9, 10, 11
"""Ranks of how the body takes the torque of all forces, of a force that follows from all others (a string's tension),
and of what is no physics but an expectation."""

Memory = tuple[Vec, ...]
"""What one effect remembers from step to step: hidden states such as a delay line or a swinging load."""


class Condition(eqx.Module):
    """Flight condition an effect sees, at one integration stage. All `Vec`, SI."""

    position: Vec
    """Centre of gravity, world."""
    velocity: Vec
    """Of the centre of gravity, world."""
    velocity_body: Vec
    """Of the rotors' centre, body axes."""
    airspeed_body: Vec
    """Of the rotors' centre through the air, body axes: `velocity_body` less the air's own velocity there."""
    quaternion: Vec
    body_rate: Vec
    rotor_speed: Vec
    parameters: Parameters
    """With what effects change in them; `Vec` in place of arrays."""
    memory: Memory = ()
    """Of the effect that is asked."""
    loads: RotorLoads | None = None
    """Of the rotors, all effects on them included; only `Effect.body` is told."""


class Wrench(eqx.Module):
    """Force and torque on the body, body axes, about the centre of the rotors: N and N m."""

    force: Vec
    torque: Vec


class Motors(eqx.Module):
    """What each motor does during one step."""

    target: Vec
    """Steady rotor speed the command leads to, rad/s."""
    time_constant: Vec
    """Lag towards it, s."""


class Reading(eqx.Module):
    """What a log says about hidden conditions at one row, beside the state."""

    voltage: Array
    """Of the battery under load, V; NaN where unknown."""
    time: Array
    """Since the log began, s."""


class Effect(eqx.Module):
    """One physical effect. Subclasses hold their parameters as fields and override what they change.

    Every subclass sets ``name`` (DESIGN names), ``units`` (per field), ``source``, ``prior`` (per field, the plausible
    range as low and high: where a search looks), ``limits`` (per field, what can be at all and what is usual) and has a
    ``neutral()`` at which it vanishes. For tracing it says which fields measure its
    strength (``strengths``; the others describe its shape), at which values it is looked for first (``probes``) and
    whether a search looks for it at all or only who names it gets it fitted (``searched``).
    """

    name: ClassVar[str]
    meaning: ClassVar[str] = ""
    """What it is, half a sentence for reports; by default the docstring's first paragraph, which documents it there."""
    experiment: ClassVar[str] = ""
    """Flights that tell about it, for reports; by default those that excite it."""
    coarse: ClassVar[dict[int, float]] = {}
    """Probes, by their number, at which the slope at zero says little of the strength: each with the share of the prior
    range at which the effect is looked for there."""
    units: ClassVar[dict[str, str]]
    source: ClassVar[str] = "not given"
    prior: ClassVar[dict[str, tuple[float, float]]]
    limits: ClassVar[dict[str, Limits]] = {}
    strengths: ClassVar[tuple[str, ...]]
    probes: ClassVar[tuple[dict[str, float], ...]] = ({},)
    searched: ClassVar[bool] = True
    assumed: ClassVar[tuple[str, ...]] = ()
    """Fields that no flight tells: whoever fits leaves them as they are given."""
    said_by: ClassVar[dict[str, str]] = {}
    """Fields that say what another effect says, with its name: beside that one whoever fits leaves them as given."""
    rank: ClassVar[int] = 0
    """Which of two effects acts first where the second sees what the first leaves; by their names where it is equal.

    The order of a model's list means nothing. Below `INERTIAL`, effects on the body only add to the wrench.
    """
    feels_air: ClassVar[bool] = False
    """Whether it depends on `Condition.airspeed_body`."""

    def __check_init__(self):
        for field, limits in self.limits.items():
            limits.check(getattr(self, field), f"{self.name}.{field}", self.units[field])

    @classmethod
    def neutral(cls) -> Effect:
        """The effect at the values where it vanishes."""
        raise TypeError(f"{cls.__name__} must say at which values it vanishes")

    @classmethod
    def migrated(cls, values: Mapping[str, Any], parameters: Parameters | None) -> Mapping[str, Any]:
        """What a model file of an earlier version says, in today's fields; ``parameters`` are the file's own.

        Raises:
            CfbError: it cannot be said; what to write instead.
        """
        return values

    def change(self, parameters: Parameters) -> Parameters:
        """Change the drone itself, once per rollout."""
        return parameters

    def start(self, rotor_speed: Vec, parameters: Parameters) -> Memory:
        """Memory after a long steady flight at ``rotor_speed``."""
        return ()

    def begin(self, rotor_speed: Vec, parameters: Parameters, dt: float) -> Memory:
        """`start` of a flight in steps of ``dt`` seconds, where those decide how much there is to remember."""
        return self.start(rotor_speed, parameters)

    def sense(self, memory: Memory, reading: Reading) -> Memory:
        """Take over what a log measured of the hidden state."""
        return memory

    def command(self, command: Vec, memory: Memory, dt: Any, parameters: Parameters) -> tuple[Vec, Memory]:
        """Change what the motors receive during the next ``dt`` seconds."""
        return command, memory

    def motors(
        self, motors: Motors, rotor_speed: Vec, memory: Memory, dt: Any, parameters: Parameters
    ) -> tuple[Motors, Memory]:
        """Change how the motors answer, from ``rotor_speed`` on."""
        return motors, memory

    def air(self, condition: Condition) -> Vec:
        """Velocity of the air at the drone, world, that this effect brings about; the air of all effects adds up.

        In ``condition`` the air is taken to be still.
        """
        return Vec(0.0, 0.0, 0.0)

    def rotors(self, loads: RotorLoads, condition: Condition) -> RotorLoads:
        """Change thrust and torque rotor by rotor."""
        return loads

    def body(self, wrench: Wrench, condition: Condition) -> Wrench:
        """Change the force and torque on the body."""
        return wrench

    def advance(self, condition: Condition, acceleration: Vec, dt: Any) -> Memory:
        """Memory after ``dt`` seconds that began in ``condition`` with this acceleration (world, m/s^2)."""
        return condition.memory

    def follow(self, condition: Condition, acceleration: Vec, missed: Vec, dt: Any) -> Memory:
        """`advance` beside a log, where ``acceleration`` was measured.

        ``missed`` is how much of it the model does not say: it tells how far off the memory is.
        """
        return self.advance(condition, acceleration, dt)


def in_order(effects: Sequence[Effect]) -> list[int]:
    """Positions of effects in the order in which they act, whatever the order they are listed in."""
    return sorted(range(len(effects)), key=lambda i: (type(effects[i]).rank, type(effects[i]).name))


def overrides(effect: Effect, hook: str) -> bool:
    """Whether the effect does anything in one of the functions above."""
    return getattr(type(effect), hook) is not getattr(Effect, hook)
