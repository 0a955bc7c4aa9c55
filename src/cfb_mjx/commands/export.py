"""``cfb export``: write a policy as C for the drone."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from cfb_mjx.commands.command import Command, Ending, File, OutputFolder, Result, command
from cfb_mjx.files import require_folder, require_no_file, write_json

if TYPE_CHECKING:
    from cfb_mjx.deploy.check import Check


@dataclass(frozen=True)
class Exported(Result):
    """A policy as C, and the results of the check.

    Attributes:
        name: name of the policy.
        step_s: time between two of its commands, s.
        weights_sha256: SHA-256 of the weights of its networks, by their role.
        folder: folder with the sources, the firmware app and the contract.
        check: results of the check (``check.numbers``, ``check.faults``); None if no check was asked for.
        results: path of the file with these numbers; None if no check was asked for.
        onnx: path of the ONNX model; None if none was asked for.
    """

    name: str
    step_s: float
    weights_sha256: Mapping[str, str]
    folder: Path
    check: Check | None = None
    results: Path | None = None
    onnx: Path | None = None

    def __str__(self) -> str:
        hashes = ", ".join(f"{name} {value[:12]}" for name, value in self.weights_sha256.items())
        lines = [
            f"{self.name}: a step every {1e3 * self.step_s:g} ms; weights {hashes}",
            f"C sources, firmware app and contract: {self.folder}",
        ]
        if self.check is not None:
            lines += [f"  {text}" if good else f"  {text}   <- outside the limit" for text, good in self.check.findings]
            lines.append(f"results: {self.results}")
        if self.onnx is not None:
            lines.append(f"ONNX model: {self.onnx}")
        return "\n".join(lines)

    @property
    def complaint(self) -> str | None:
        """Why the export must not be flown; None if nothing is wrong with it, or if it was not checked."""
        faults = [] if self.check is None else self.check.faults
        return f"{self.folder}: do not fly this; {faults[0]}." if faults else None


@command
class Export(Command):
    """Write a policy as C for the drone: a plain library, an app for the Crazyflie's firmware, and its contract.

    The code is C11 in single precision with static memory. contract.json defines every input and output. README.md
    explains how to fly the policy, and what it does when an estimate is invalid.

    Attributes:
        policy: a shipped policy, a policy file (.npz of `cfb train`, .onnx), or the name of a flip.
            Shipped policies: target, target-analytic, target-adaptive, track, track-rates, flip, flip-analytic.
            Flips: double-flip, triple-flip ...
        output: folder to write to.
        knobs: settings of the flip, for a flip policy: a shipped manoeuvre or a YAML file of `cfb fly --keep`.
            Default: flip.
        holder: target policy that climbs before a flip and catches the drone after it.
            Default: the one with which the settings of the flip were found.
        check: compile the C, compare it with JAX on 10 000 random sequences and in closed loop, and measure its cost.
            The size on the drone's processor needs arm-none-eabi-gcc, the number of instructions also qemu-system-arm.
        loadable: keep a copy of the weights in memory that can be replaced over the radio, without flashing; writes
            weights.bin too, a set that fits every export of the same architecture. Not for flips.
        onnx: write the policy as an ONNX model too; of a flip, the policy that turns. Needs the package onnx.
    """

    policy: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="POLICY")]
    output: OutputFolder
    knobs: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    holder: Annotated[str | None, tyro.conf.arg(metavar="POLICY")] = None
    check: bool = False
    loadable: bool = False
    onnx: Annotated[File, Ending((".onnx",), "an ONNX model must end in .onnx")] = None

    def run(self) -> Exported:
        """Write the C, and check it if a check was asked for.

        Raises:
            CfbError: no such policy, a flip with loadable weights, a folder that cannot be written, no C compiler for
                the check, or no package onnx.
        """
        from cfb_mjx.runtime import configure_jax, environment

        require_no_file(self.output)
        require_folder(self.onnx)
        configure_jax(x64=False)
        from cfb_mjx.deploy.deployment import find_deployment
        from cfb_mjx.deploy.export import RESULTS, export_policy

        deployment = replace(find_deployment(self.policy, self.knobs, self.holder), loadable=self.loadable)
        if self.onnx is not None:
            # First, so that nothing is left behind where the package is missing.
            from cfb_mjx.control.onnx_file import write_onnx

            write_onnx(deployment.turner or deployment.holder, self.onnx)
        exported = export_policy(deployment, self.output)
        check = results = None
        if self.check:
            from cfb_mjx.deploy.check import check_export

            check, results = check_export(exported), exported.folder / RESULTS
            write_json(results, check.numbers | {"environment": environment()})
        hashes = {name: policy.weights_sha256 for name, policy in deployment.policies.items()}
        step_s = deployment.holder.controller.control_dt_s
        return Exported(deployment.name, step_s, hashes, exported.folder, check, results, self.onnx)
