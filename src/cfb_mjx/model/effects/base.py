"""What an effect is: parameters plus pure functions that may change the command, the rotor loads or the wrench."""

from __future__ import annotations

from typing import ClassVar

import equinox as eqx

from cfb_mjx.model.rotors import RotorLoads
from cfb_mjx.model.vector import Vec
from cfb_mjx.parameters.parameters import Parameters


class Condition(eqx.Module):
    """Flight condition an effect sees, at one integration stage. All `Vec`, SI."""

    position: Vec
    """Centre of gravity, world."""
    velocity: Vec
    """Of the centre of gravity, world."""
    velocity_body: Vec
    """Of the rotors' centre, body axes."""
    quaternion: Vec
    body_rate: Vec
    rotor_speed: Vec
    parameters: Parameters


class Wrench(eqx.Module):
    """Force and torque on the body, body axes, about the centre of the rotors: N and N m."""

    force: Vec
    torque: Vec


class Effect(eqx.Module):
    """One physical effect. Subclasses hold their parameters as fields and override what they change.

    Every subclass sets ``name`` (DESIGN names), ``units`` (per field), ``source``, ``prior`` (per field, the plausible
    range as low and high) and has a ``neutral()`` at which it vanishes.
    """

    name: ClassVar[str]
    units: ClassVar[dict[str, str]]
    source: ClassVar[str]
    prior: ClassVar[dict[str, tuple[float, float]]]

    @classmethod
    def neutral(cls) -> Effect:
        """The effect at the values where it vanishes."""
        raise TypeError(f"{cls.__name__} must say at which values it vanishes")

    def command(self, command: Vec, parameters: Parameters) -> Vec:
        """Change what the motors receive, once per step."""
        return command

    def rotors(self, loads: RotorLoads, condition: Condition) -> RotorLoads:
        """Change thrust and torque rotor by rotor."""
        return loads

    def body(self, wrench: Wrench, condition: Condition) -> Wrench:
        """Change the force and torque on the body."""
        return wrench
