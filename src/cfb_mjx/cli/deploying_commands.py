"""What ``cfb export`` takes; see `cfb_mjx.cli.commands`."""

from __future__ import annotations

from typing import Annotated

import tyro

from cfb_mjx.cli.argument_types import Output


def export(
    policy: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="POLICY")],
    output: Output,
    knobs: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None,
    holder: Annotated[str | None, tyro.conf.arg(metavar="POLICY")] = None,
    check: bool = False,
) -> None:
    """Write a policy as C for the drone: a plain library, an app for the Crazyflie's firmware, and its contract.

    C11, single precision, static memory. contract.json says what every number means; README.md how to fly it, and what
    it does when an estimate cannot be.

    Args:
        policy: a shipped policy (target, target-analytic, target-adaptive, flip), a policy file of `cfb train`, or
            the name of a flip (double-flip, triple-flip ...).
        output: folder to write to.
        knobs: of a flip policy: a shipped manoeuvre or a YAML file (`cfb fly --keep`); flip by default.
        holder: the target policy that climbs and catches in a flip; by default the one its knobs were found with.
        check: compile it, compare it with JAX on 10 000 random sequences and in closed loop, and measure what it costs
            on the drone's processor (sizes need arm-none-eabi-gcc, instruction counts also qemu-system-arm).
    """
    from cfb_mjx.cli.exporting import run_export

    run_export(policy, output, knobs, holder, check)
