"""Check an exported policy: does it compute what it computes in JAX, and what does a step cost on the drone."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from cfb_mjx.deploy import cortex
from cfb_mjx.deploy.compiled import FLAGS, CompiledPolicy, compile_policy
from cfb_mjx.deploy.export import Exported
from cfb_mjx.deploy.flights import fly_beside
from cfb_mjx.deploy.parity import TOLERANCE, begin, compare, random_inputs

NEAR_M = 1e-3
"""Largest distance between the flights of C and JAX."""
FLASH, RAM, STEP_S = 64 * 1024, 8 * 1024, 1e-3
"""Limits of flash [bytes], memory [bytes] and time [s] of a step on the drone."""
_EMULATED_TOLERANCE = 1e-6


class Finding(NamedTuple):
    """Result of one check."""

    text: str
    good: bool = True


class Check(NamedTuple):
    """Results of all checks."""

    numbers: dict[str, Any]
    findings: list[Finding]

    @property
    def faults(self) -> list[str]:
        """Texts of the failed checks."""
        return [finding.text for finding in self.findings if not finding.good]


def check_export(exported: Exported) -> Check:
    """Compile the C, compare it with JAX on random sequences and in closed loop, and measure its costs.

    Args:
        exported: the exported policy.

    Raises:
        CfbError: there is no compiler, or it reports an error.
    """
    deployment, compiled = exported.deployment, compile_policy(exported)
    parity = compare(deployment, compiled)
    six = fly_beside(deployment, compiled, 6.0)
    # A flip is demanding from its start; holding a target is demanding from a distance.
    second = six if deployment.flips else fly_beside(deployment, compiled, 1.0, (0.5, -0.5, 0.3))
    largest, what = second.command_difference(1.0), "flip" if deployment.flips else "hover"
    costs, about_costs = _costs(exported, compiled)
    findings = [
        Finding(f"compiles with {' '.join(FLAGS)}"),
        Finding(
            f"commands on {parity.sequences} random sequences of {parity.steps} estimates: within {parity.largest:.1e} "
            "of JAX's",
            parity.largest <= TOLERANCE,
        ),
        Finding(f"commands of a second in closed loop: within {largest:.1e}", largest <= TOLERANCE),
        Finding(f"6 s of {what} in closed loop: within {1e3 * six.distance_m:.1e} mm of JAX", six.distance_m <= NEAR_M),
        *about_costs,
    ]
    numbers = {
        "policy": deployment.name,
        "weights_sha256": {name: p.weights_sha256 for name, p in deployment.policies.items()},
        "parity": parity._asdict(),
        "closed_loop": {"command_difference@1s": largest, f"{what}_distance_m@6s": six.distance_m},
        "cortex_m4": costs,
        "passed": all(finding.good for finding in findings),
    }
    return Check(numbers, findings)


def _costs(exported: Exported, compiled: CompiledPolicy) -> tuple[dict[str, Any], list[Finding]]:
    """Cost of a step on the drone's processor: numbers and findings."""
    deployment, findings = exported.deployment, []
    macs, cycles, clock = cortex.multiply_accumulates(deployment), cortex.CYCLES_PER_INSTRUCTION, cortex.CLOCK_HZ
    found: dict[str, Any] = {"multiply_accumulates": macs, "clock_hz": clock}
    if cortex.has_compiler():
        size = cortex.size(exported)
        found |= {"flash_bytes": size.flash, "ram_bytes": size.ram, "stack_bytes": size.stack}
        said = f"{size.flash / 1024:.1f} kB of flash, {size.ram} B of memory, at most {size.stack} B of stack"
        findings.append(Finding(f"Cortex-M4: {said}", size.flash <= FLASH and size.ram + size.stack <= RAM))
    else:
        findings.append(Finding("Cortex-M4 sizes: not measured, arm-none-eabi-gcc is not installed"))
    if cortex.has_emulator():
        rows = random_inputs(np.random.default_rng(1), 16, 12).reshape(-1, 16)
        run = cortex.emulate(exported, rows)
        begin(deployment, compiled)
        apart = float(np.abs(compiled.steps(rows) - run.commands).max())
        said = f"commands on an emulated STM32F405: within {apart:.1e} of this machine's C"
        findings.append(Finding(said, apart <= _EMULATED_TOLERANCE))
        instructions, how = float(run.instructions.max()), "counted on an emulated STM32F405"
        found["emulated_command_difference"] = apart
    else:
        instructions, how = cortex.estimated_instructions(deployment), "estimated from the multiply-accumulates"
    seconds, step = instructions * cycles / clock, deployment.holder.controller.control_dt_s
    said = (
        f"a step: {macs} multiply-accumulates, {instructions:.0f} instructions ({how}); at {clock / 1e6:.0f} MHz and "
        f"{cycles:g} cycles each {1e3 * seconds:.2f} ms of {1e3 * step:g} ms"
    )
    findings.append(Finding(said, seconds <= min(STEP_S, step)))
    return found | {
        "instructions": instructions,
        "instructions_from": how,
        "step_s": seconds,
        "cycles_per_instruction": cycles,
    }, findings
