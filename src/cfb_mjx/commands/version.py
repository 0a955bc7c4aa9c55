"""``cfb version``: print the installed versions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from cfb_mjx.commands.command import Command, Result, command


@dataclass(frozen=True)
class Versions(Result):
    """The installed versions.

    Attributes:
        environment: date, machine and versions, by name.
    """

    environment: Mapping[str, str]

    def __str__(self) -> str:
        return "\n".join(f"{name}: {value}" for name, value in self.environment.items())


@command
class Version(Command):
    """Print the versions of cfb_mjx and its dependencies, the machine and the date."""

    def run(self) -> Versions:
        """Look up the versions."""
        from cfb_mjx.runtime import environment

        return Versions(environment())
