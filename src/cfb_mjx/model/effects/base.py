"""Interface of an effect: parameters with pure functions that may change the drone, motors, rotor loads or wrench."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import equinox as eqx
from jaxtyping import Array

from cfb_mjx.model.rotors import RotorLoads
from cfb_mjx.model.vector import Vec
from cfb_mjx.parameters.parameters import Limits, Parameters

INERTIAL, CONSTRAINT, EXPECTATION = 9, 10, 11
"""Values of `Effect.rank` for effects that act on the body after all others: effects that use the torque of all forces
(`INERTIAL`), forces that follow from all other forces, such as the tension of a string (`CONSTRAINT`), and statistical
corrections that are not physics (`EXPECTATION`)."""

Memory = tuple[Vec, ...]
"""Hidden state of one effect, carried from step to step, such as a delay line or a swinging load."""


class Condition(eqx.Module):
    """Flight condition that an effect sees at one stage of the integrator. Vectors are `Vec`; SI units."""

    position: Vec
    """Position of the centre of gravity, world."""
    velocity: Vec
    """Velocity of the centre of gravity, world."""
    velocity_body: Vec
    """Velocity of the rotors' centre, body axes."""
    airspeed_body: Vec
    """Velocity of the rotors' centre through the air, body axes: `velocity_body` minus that of the air there."""
    quaternion: Vec
    body_rate: Vec
    rotor_speed: Vec
    parameters: Parameters
    """Parameters after the changes of all effects, with `Vec` in place of arrays."""
    memory: Memory = ()
    """Memory of the effect that receives this condition."""
    loads: RotorLoads | None = None
    """Loads of the rotors, including all effects on them; only `Effect.body` receives them."""


class Wrench(eqx.Module):
    """Force [N] and torque about the rotors' centre [N m] on the body, body axes."""

    force: Vec
    torque: Vec


class Motors(eqx.Module):
    """Response of each motor during one step."""

    target: Vec
    """Steady rotor speed for the current command, rad/s."""
    time_constant: Vec
    """Time constant of the lag towards `target`, s."""


class Reading(eqx.Module):
    """Measurements in one row of a log that concern hidden states, beside the state of the drone."""

    voltage: Array
    """Battery voltage under load, V; NaN if unknown."""
    time: Array
    """Time since the log began, s."""
    other: tuple[Vec, ...] = ()
    """Other drones that flew at the same time (`cfb_mjx.model.effects.downwash.Other`); NaN while one is unknown."""


class Effect(eqx.Module):
    """One physical effect. Subclasses hold its parameters as fields and override the functions of what it changes.

    Every subclass defines ``name``, ``units`` (per field), ``source``, ``prior`` (per field, the plausible range (low,
    high) in which a search looks), ``limits`` (per field, the possible and the usual range) and ``neutral()``, the
    values at which the effect vanishes.

    For the search it also defines ``strengths``, the fields that measure how strong the effect is (all other fields
    describe its shape), ``probes``, the values of the shape at which the search first looks for the effect, and
    ``searched``: if False, the effect is fitted only where the user names it.
    """

    name: ClassVar[str]
    meaning: ClassVar[str] = ""
    """The effect in half a sentence, for reports; default: the first paragraph of the docstring."""
    experiment: ClassVar[str] = ""
    """Flights that reveal the effect, for reports; default: flights that excite it."""
    coarse: ClassVar[dict[int, float]] = {}
    """Probes, by index, at which the derivative at zero strength says little about the strength. The value is the
    finite-difference step that the search uses there, as a share of the prior range."""
    units: ClassVar[dict[str, str]]
    source: ClassVar[str] = "not given"
    prior: ClassVar[dict[str, tuple[float, float]]]
    limits: ClassVar[dict[str, Limits]] = {}
    strengths: ClassVar[tuple[str, ...]]
    probes: ClassVar[tuple[dict[str, float], ...]] = ({},)
    searched: ClassVar[bool] = True
    needs: ClassVar[str | None] = None
    """Attribute of a flight log without which no flight shows the effect; a search then leaves it out."""
    assumed: ClassVar[tuple[str, ...]] = ()
    """Fields that no flight determines; fits leave them as given."""
    said_by: ClassVar[dict[str, str]] = {}
    """Fields that do the same as another effect, with the name of that effect. Together with it, fits leave them as
    given."""
    rank: ClassVar[int] = 0
    """Order in which effects act, if one uses the result of another: lower ranks first, equal ranks sorted by name.

    The order of a model's list of effects has no influence. On the body, effects below `INERTIAL` only add to the
    wrench.
    """
    feels_air: ClassVar[bool] = False
    """Whether the effect depends on `Condition.airspeed_body`."""

    def __check_init__(self):
        for field, limits in self.limits.items():
            limits.check(getattr(self, field), f"{self.name}.{field}", self.units[field])

    @classmethod
    def neutral(cls) -> Effect:
        """Return the effect at the values where it vanishes."""
        raise TypeError(f"{cls.__name__} must define neutral(), which returns the effect at values where it vanishes")

    @classmethod
    def migrated(cls, values: Mapping, parameters: Parameters | None) -> Mapping:
        """Translate the fields of an earlier version's model file into the present fields.

        Args:
            values: fields as the file gives them.
            parameters: parameters of the same file.

        Raises:
            CfbError: a field cannot be translated; the message says what to write instead.
        """
        return values

    def change(self, parameters: Parameters) -> Parameters:
        """Change the parameters of the drone, once per rollout."""
        return parameters

    def start(self, rotor_speed: Vec, parameters: Parameters) -> Memory:
        """Return the memory after a long steady flight at ``rotor_speed`` [rad/s]."""
        return ()

    def begin(self, rotor_speed: Vec, parameters: Parameters, dt: float) -> Memory:
        """`start` for a flight in steps of ``dt`` seconds, for memories whose size depends on the step."""
        return self.start(rotor_speed, parameters)

    def sense(self, memory: Memory, reading: Reading) -> Memory:
        """Update the memory with what a log measured of the hidden state."""
        return memory

    def command(self, command: Vec, memory: Memory, dt: Any, parameters: Parameters) -> tuple[Vec, Memory]:
        """Change what the motors receive during the next ``dt`` seconds."""
        return command, memory

    def motors(
        self, motors: Motors, rotor_speed: Vec, memory: Memory, dt: Any, parameters: Parameters
    ) -> tuple[Motors, Memory]:
        """Change the response of the motors in a step that begins at ``rotor_speed`` [rad/s]."""
        return motors, memory

    def air(self, condition: Condition) -> Vec:
        """Velocity of the air that this effect causes at the drone, world, m/s. The velocities of all effects add up.

        ``condition`` is computed in still air.
        """
        return Vec(0.0, 0.0, 0.0)

    def rotors(self, loads: RotorLoads, condition: Condition) -> RotorLoads:
        """Change thrust and torque of each rotor."""
        return loads

    def body(self, wrench: Wrench, condition: Condition) -> Wrench:
        """Change the force and torque on the body."""
        return wrench

    def advance(self, condition: Condition, acceleration: Vec, dt: Any) -> Memory:
        """Memory after a step of ``dt`` seconds that began in ``condition`` with this acceleration (world, m/s^2)."""
        return condition.memory

    def follow(self, condition: Condition, acceleration: Vec, missed: Vec, dt: Any) -> Memory:
        """`advance` along a log, where ``acceleration`` was measured.

        ``missed`` is the part of it that the model does not explain; an effect may correct its memory with it.
        """
        return self.advance(condition, acceleration, dt)


def in_order(effects: Sequence[Effect]) -> list[int]:
    """Indices of effects in the order in which they act, whatever their order in the list."""
    return sorted(range(len(effects)), key=lambda i: (type(effects[i]).rank, type(effects[i]).name))


def overrides(effect: Effect, hook: str) -> bool:
    """Whether an effect overrides one of the functions of `Effect`."""
    return getattr(type(effect), hook) is not getattr(Effect, hook)
