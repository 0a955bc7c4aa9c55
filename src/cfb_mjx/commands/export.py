"""``cfb export``: a policy as C for the drone."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from cfb_mjx.commands.command import Command, OutputFolder, Result, command
from cfb_mjx.files import require_no_file, write_json

if TYPE_CHECKING:
    from cfb_mjx.deploy.check import Check


@dataclass(frozen=True)
class Exported(Result):
    """A policy as C, and how that was found to be.

    Attributes:
        name: of the policy.
        step_s: time from one of its commands to the next.
        weights_sha256: of its networks, by what they do.
        folder: with sources, firmware app and contract.
        check: what was found (``check.numbers``, ``check.faults``); None: it was not asked for.
        results: the file with these numbers.
    """

    name: str
    step_s: float
    weights_sha256: Mapping[str, str]
    folder: Path
    check: Check | None = None
    results: Path | None = None

    def __str__(self) -> str:
        hashes = ", ".join(f"{name} {value[:12]}" for name, value in self.weights_sha256.items())
        lines = [
            f"{self.name}: a step every {1e3 * self.step_s:g} ms; weights {hashes}",
            f"C sources, firmware app and contract: {self.folder}",
        ]
        if self.check is not None:
            lines += [f"  {text}" if good else f"  {text}   <- too much" for text, good in self.check.findings]
            lines.append(f"results: {self.results}")
        return "\n".join(lines)

    @property
    def complaint(self) -> str | None:
        """That it is not to be flown."""
        faults = [] if self.check is None else self.check.faults
        return f"{self.folder}: do not fly this; {faults[0]}." if faults else None


@command
class Export(Command):
    """Write a policy as C for the drone: a plain library, an app for the Crazyflie's firmware, and its contract.

    C11, single precision, static memory. contract.json says what every number means; README.md how to fly it, and what
    it does when an estimate cannot be.

    Attributes:
        policy: a shipped policy (target, target-analytic, target-adaptive, flip), a policy file of `cfb train`, or
            the name of a flip (double-flip, triple-flip ...).
        output: folder to write to.
        knobs: of a flip policy: a shipped manoeuvre or a YAML file (`cfb fly --keep`); flip by default.
        holder: the target policy that climbs and catches in a flip; by default the one its knobs were found with.
        check: compile it, compare it with JAX on 10 000 random sequences and in closed loop, and measure what it costs
            on the drone's processor (sizes need arm-none-eabi-gcc, instruction counts also qemu-system-arm).
    """

    policy: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="POLICY")]
    output: OutputFolder
    knobs: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    holder: Annotated[str | None, tyro.conf.arg(metavar="POLICY")] = None
    check: bool = False

    def run(self) -> Exported:
        """Write the export, and check it if that is asked for.

        Raises:
            CfbError: no such policy, a folder that cannot be written, or no compiler for the check.
        """
        from cfb_mjx.runtime import configure_jax, environment

        require_no_file(self.output)
        configure_jax(x64=False)
        from cfb_mjx.deploy.deployment import find_deployment
        from cfb_mjx.deploy.export import RESULTS, export_policy

        deployment = find_deployment(self.policy, self.knobs, self.holder)
        exported = export_policy(deployment, self.output)
        check = results = None
        if self.check:
            from cfb_mjx.deploy.check import check_export

            check, results = check_export(exported), exported.folder / RESULTS
            write_json(results, check.numbers | {"environment": environment()})
        hashes = {name: policy.weights_sha256 for name, policy in deployment.policies.items()}
        step_s = deployment.holder.controller.control_dt_s
        return Exported(deployment.name, step_s, hashes, exported.folder, check, results)
