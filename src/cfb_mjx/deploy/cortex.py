"""Cost of an exported policy on the drone's STM32F405: flash, memory, stack, instructions per step.

Sizes are those of arm-none-eabi-gcc. Instructions are counted by running the same program on QEMU's model of an
STM32F405 (machine netduinoplus2), whose commands are also compared. Without these two programs the instructions are
estimated from the number of multiply-accumulates.
"""

from __future__ import annotations

import re
import shutil
import subprocess
from importlib.resources import files
from pathlib import Path
from typing import NamedTuple

import numpy as np

from cfb_mjx.deploy.compiled import FLAGS, run_compiler
from cfb_mjx.deploy.deployment import Deployment
from cfb_mjx.deploy.export import Exported, literal
from cfb_mjx.errors import CfbError
from cfb_mjx.files import scratch
from cfb_mjx.optional import not_none

CLOCK_HZ = 168e6
CYCLES_PER_INSTRUCTION = 2.0
"""More than the Cortex-M4 needs for such code: most instructions take one cycle, consecutive loads fewer than two each,
a division 14, a taken branch up to 4, and the STM32's cache hides most of the waiting for flash."""
INSTRUCTIONS_PER_MAC, INSTRUCTIONS_PER_ACTIVATION, INSTRUCTIONS_PER_STEP = 8.0, 80.0, 500.0
"""For the estimate: slightly more than QEMU counts for the shipped policies."""
_TARGET = ("-mcpu=cortex-m4", "-mthumb", "-mfpu=fpv4-sp-d16", "-mfloat-abi=hard")
_GCC, _SIZE, _QEMU = "arm-none-eabi-gcc", "arm-none-eabi-size", "qemu-system-arm"
_KNOWN = 1_000_000
"""Instructions of the loop that calibrates the emulated clock; see emulated/main.c."""


class Size(NamedTuple):
    """Sizes of the plain library, in bytes."""

    flash: int
    ram: int
    stack: int
    """Stack of all its functions together: more than any chain of calls needs."""


class Emulated(NamedTuple):
    """A run on the emulated STM32F405."""

    commands: np.ndarray
    """(steps, 4), float32."""
    instructions: np.ndarray
    """(steps,), instructions of every step."""


def has_compiler() -> bool:
    """Whether sizes can be measured on this machine."""
    return all(map(shutil.which, (_GCC, _SIZE)))


def has_emulator() -> bool:
    """Whether instructions can be counted on this machine."""
    return has_compiler() and shutil.which(_QEMU) is not None


def multiply_accumulates(deployment: Deployment) -> int:
    """Multiply-accumulates per step: those of the larger network, because a step evaluates one of them."""
    return max(p.controller.network.multiply_accumulates for p in deployment.policies.values())


def estimated_instructions(deployment: Deployment) -> float:
    """Instructions per step, estimated without running it."""
    activations = max(p.controller.network.activations for p in deployment.policies.values())
    network = INSTRUCTIONS_PER_MAC * multiply_accumulates(deployment) + INSTRUCTIONS_PER_ACTIVATION * activations
    return network + INSTRUCTIONS_PER_STEP


def size(exported: Exported) -> Size:
    """Compile the plain library for the Cortex-M4, as strictly as for the host, and measure its size.

    Args:
        exported: the exported policy.

    Raises:
        CfbError: the compiler is not installed, or reports an error.
    """
    with scratch("cfb-cortex-") as folder:
        objects = []
        for source in exported.sources:
            objects.append(str(Path(folder) / f"{source.stem}.o"))
            run_compiler([_GCC, *_TARGET, *FLAGS, "-fstack-usage", "-c", str(source), "-o", objects[-1]])
        rows = run_compiler([_SIZE, *objects]).splitlines()[1:]
        text, data, bss = (sum(int(row.split()[i]) for row in rows) for i in range(3))
        usage = [line.split("\t")[1] for path in Path(folder).glob("*.su") for line in path.read_text().splitlines()]
        return Size(text + data, data + bss, sum(map(int, usage)))


def emulate(exported: Exported, inputs: np.ndarray) -> Emulated:
    """Run estimates through the policy on the emulated STM32F405; a flip begins with the first.

    Args:
        exported: the exported policy.
        inputs: (steps, 16): position, velocity, quaternion, body rate, target; then the previews of a path, if any.

    Raises:
        CfbError: compiler or emulator is not installed, or the program does not end.
    """
    if not has_emulator():
        raise CfbError(
            f"counting instructions needs {_GCC} and {_QEMU}; Debian: apt install gcc-arm-none-eabi "
            "libnewlib-arm-none-eabi qemu-system-arm."
        )
    here = files("cfb_mjx.deploy").joinpath("emulated")
    with scratch("cfb-cortex-") as name:
        folder = Path(name)
        for file in ("main.c", "stm32f405.ld"):
            (folder / file).write_text(here.joinpath(file).read_text(encoding="utf-8"), encoding="utf-8")
        (folder / "inputs.h").write_text(_inputs(exported.deployment, inputs), encoding="utf-8")
        program = str(folder / "policy.elf")
        run_compiler(
            [
                _GCC,
                *_TARGET,
                *FLAGS,
                "-nostartfiles",
                f"-T{folder / 'stm32f405.ld'}",
                f"-I{exported.folder}",
                str(folder / "main.c"),
                *map(str, exported.sources),
                "-o",
                program,
                "-lm",
            ]
        )
        command = [_QEMU, "-machine", "netduinoplus2", "-display", "none", "-monitor", "none", "-serial", "none"]
        command += ["-semihosting-config", "enable=on,target=native", "-icount", "shift=3", "-kernel", program]
        try:
            done = subprocess.run(command, capture_output=True, text=True, timeout=120)
        except subprocess.TimeoutExpired:
            raise CfbError("the policy did not finish on the emulated STM32F405 within 120 s.") from None
        return _read(done.stdout + done.stderr, len(inputs))


def _read(said: str, steps: int) -> Emulated:
    """Parse the output of the program, hexadecimal numbers."""
    words = re.findall(r"^(\w+) ([0-9a-f]{8})$", said, re.MULTILINE)
    found = {what: np.array([int(v, 16) for w, v in words if w == what], np.uint32) for what in ("known", "u", "ticks")}
    if len(found["known"]) != 1 or len(found["u"]) != 4 * steps or len(found["ticks"]) != steps:
        raise CfbError(f"the policy does not run on the emulated STM32F405: {' '.join(said.split())[:200]}")
    scale = _KNOWN / float(found["known"][0])
    return Emulated(found["u"].view(np.float32).reshape(steps, 4), found["ticks"] * scale)


def _inputs(deployment: Deployment, inputs: np.ndarray) -> str:
    rows = ",\n".join("  {" + ", ".join(literal(x) for x in row) + "}" for row in np.asarray(inputs, np.float32))
    knobs = not_none(deployment.manoeuvre).knobs if deployment.flips else None
    return (
        f"#define STEPS {len(inputs)}\n#define FLIPS {int(deployment.flips)}\n#define INPUTS {inputs.shape[1]}\n"
        f"#define FLIP_SPEED {literal(knobs.speed_mps if knobs else 0)}\n"
        f"#define FLIP_RATE {literal(knobs.rate_radps if knobs else 0)}\n"
        f"static const float inputs[STEPS][INPUTS] = {{\n{rows}\n}};\n"
    )
