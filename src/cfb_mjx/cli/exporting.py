"""``cfb export``."""

from __future__ import annotations

import sys
from pathlib import Path

from cfb_mjx.errors import CfbError
from cfb_mjx.files import require_no_file, write_json
from cfb_mjx.runtime import configure_jax, environment

NEAR_M = 1e-3
"""How near each other the C and JAX have to hover."""
FLASH, RAM, STEP_S = 64 * 1024, 8 * 1024, 1e-3
"""What a step may take on the drone."""


def run_export(policy: str, output: Path, knobs: str | None, holder: str | None, check: bool) -> None:
    """Write the export, check it if that is asked for.

    Raises:
        CfbError: no such policy, a folder that cannot be written, no compiler, or an export that is not what it should.
    """
    require_no_file(output)
    configure_jax(x64=False)
    from cfb_mjx.deploy.deployment import find_deployment
    from cfb_mjx.deploy.export import export_policy

    deployment = find_deployment(policy, knobs, holder)
    exported = export_policy(deployment, output)
    hashes = ", ".join(f"{name} {p.weights_sha256[:12]}" for name, p in deployment.policies.items())
    print(f"{deployment.name}: a step every {1e3 * deployment.holder.controller.control_dt_s:g} ms; weights {hashes}")
    print(f"C sources, firmware app and contract: {exported.folder}")
    if check:
        _check(exported)


def _check(exported) -> None:
    from cfb_mjx.deploy.compiled import FLAGS, compile_policy
    from cfb_mjx.deploy.export import RESULTS
    from cfb_mjx.deploy.flights import fly_beside
    from cfb_mjx.deploy.parity import TOLERANCE, compare

    deployment, faults = exported.deployment, []

    def judge(good: bool, line: str) -> None:
        print(f"  {line}" if good else f"  {line}   <- too much")
        if not good:
            faults.append(line)

    compiled = compile_policy(exported)
    print(f"  compiles with {' '.join(FLAGS)}")
    parity = compare(deployment, compiled)
    judge(
        parity.largest <= TOLERANCE,
        f"commands on {parity.sequences} random sequences of {parity.steps} estimates: within {parity.largest:.1e} of "
        "JAX's",
    )
    six = fly_beside(deployment, compiled, 6.0)
    # A flip is demanding from where it begins; holding is from some way off.
    second = six if deployment.flips else fly_beside(deployment, compiled, 1.0, (0.5, -0.5, 0.3))
    largest = second.command_difference(1.0)
    judge(largest <= TOLERANCE, f"commands of a second in closed loop: within {largest:.1e}")
    what = "flip" if deployment.flips else "hover"
    judge(six.distance_m <= NEAR_M, f"6 s of {what} in closed loop: within {1e3 * six.distance_m:.1e} mm of JAX")
    result = {
        "policy": deployment.name,
        "weights_sha256": {name: p.weights_sha256 for name, p in deployment.policies.items()},
        "parity": parity._asdict(),
        "closed_loop": {
            "command_difference@1s": largest,
            f"{what}_distance_m@6s": six.distance_m,
        },
    }
    result["cortex_m4"] = _costs(exported, compiled, judge)
    write_json(exported.folder / RESULTS, result | {"passed": not faults, "environment": environment()})
    print(f"results: {exported.folder / RESULTS}")
    if faults:
        raise CfbError(f"{exported.folder}: do not fly this; {faults[0]}.")


def _costs(exported, compiled, judge) -> dict:
    """On the drone's processor."""
    import numpy as np

    from cfb_mjx.deploy import cortex
    from cfb_mjx.deploy.parity import begin, random_inputs

    deployment = exported.deployment
    macs = cortex.multiply_accumulates(deployment)
    found: dict = {"multiply_accumulates": macs, "clock_hz": cortex.CLOCK_HZ}
    if cortex.has_compiler():
        size = cortex.size(exported)
        found |= {"flash_bytes": size.flash, "ram_bytes": size.ram, "stack_bytes": size.stack}
        judge(
            size.flash <= FLASH and size.ram + size.stack <= RAM,
            f"Cortex-M4: {size.flash / 1024:.1f} kB of flash, {size.ram} B of memory, at most {size.stack} B of stack",
        )
    else:
        print("  Cortex-M4 sizes: not measured, arm-none-eabi-gcc is not installed", file=sys.stderr)
    if cortex.has_emulator():
        rows = random_inputs(np.random.default_rng(1), 16, 12).reshape(-1, 16)
        run = cortex.emulate(exported, rows)
        begin(deployment, compiled)
        apart = float(np.abs(compiled.steps(rows) - run.commands).max())
        judge(apart <= 1e-6, f"commands on an emulated STM32F405: within {apart:.1e} of this machine's C")
        instructions, how = float(run.instructions.max()), "counted on an emulated STM32F405"
        found["emulated_command_difference"] = apart
    else:
        instructions, how = cortex.estimated_instructions(deployment), "estimated from the multiply-accumulates"
    cycles, clock = cortex.CYCLES_PER_INSTRUCTION, cortex.CLOCK_HZ
    seconds, step = instructions * cycles / clock, deployment.holder.controller.control_dt_s
    found |= {
        "instructions": instructions,
        "instructions_from": how,
        "step_s": seconds,
        "cycles_per_instruction": cycles,
    }
    judge(
        seconds <= min(STEP_S, step),
        f"a step: {macs} multiply-accumulates, {instructions:.0f} instructions ({how}); at {clock / 1e6:.0f} MHz and "
        f"{cycles:g} cycles each {1e3 * seconds:.2f} ms of {1e3 * step:g} ms",
    )
    return found
