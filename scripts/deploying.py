"""Export and check the shipped policies, and write docs/deploying.md with what they cost on the drone.

python scripts/deploying.py             check them all: benchmarks/deploying.json and the page (a minute)
python scripts/deploying.py --page-only write the page from the numbers that are there
"""

import argparse
import json
import tempfile
from pathlib import Path

from campaign import ROOT, facts_line

from cfb_mjx.commands import Export
from cfb_mjx.errors import CfbError
from cfb_mjx.files import write_json, write_text
from cfb_mjx.runtime import environment, set_up_xla

POLICIES = ("target", "target-analytic", "target-adaptive", "flip", "double-flip", "triple-flip", "double-flip-ppo")
NUMBERS, PAGE = ROOT / "benchmarks" / "deploying.json", ROOT / "docs" / "deploying.md"


def measure() -> dict:
    """What `cfb export --check` says of each."""
    found = {}
    for name in POLICIES:
        with tempfile.TemporaryDirectory() as folder:
            exported = Export(name, Path(folder) / name, check=True).run()
        print(exported)
        if exported.complaint is not None:
            raise CfbError(exported.complaint)
        found[name] = {**exported.check.numbers, "environment": environment()}
    return {"policies": found, "environment": environment()}


def row(name: str, found: dict) -> str:
    """Of the table."""
    costs, loop = found["cortex_m4"], found["closed_loop"]
    far = next(value for key, value in loop.items() if key.endswith("_m@6s"))
    cells = [
        name,
        f"{found['parity']['largest']:.1e}",
        f"{loop['command_difference@1s']:.1e}",
        f"{1e3 * far:.1e}",
        f"{costs['flash_bytes'] / 1024:.1f}" if "flash_bytes" in costs else "not measured",
        f"{costs['ram_bytes']} + {costs['stack_bytes']}" if "ram_bytes" in costs else "not measured",
        f"{costs['multiply_accumulates']}",
        f"{costs['instructions']:.0f}{'' if 'counted' in costs['instructions_from'] else ' (estimated)'}",
        f"{1e3 * costs['step_s']:.2f}",
    ]
    return f"| {' | '.join(cells)} |"


def page(found: dict) -> str:
    """docs/deploying.md."""
    rows = "\n".join(row(name, one) for name, one in found["policies"].items())
    costs = next(iter(found["policies"].values()))["cortex_m4"]
    return f"""# Onto the drone

`cfb export` turns a policy into C for the Crazyflie's STM32F405: C11, single precision, static memory, nothing beyond
the C library's `sqrtf` (and `atan2f` in flips).

```sh
cfb export target -o target-c --check              # a shipped policy; or policy.npz of cfb train
cfb export double-flip -o flip-c --check           # holds a target, flips on demand
```

The folder holds the sources, an app for the firmware with its `Makefile`, `contract.json` (units, frames, rates,
history and scale of every number, the hash of the weights, the model and randomisation of the training), and a
`README.md` on building, flashing and first flights.

## What it costs, and how near to JAX it is

{facts_line("python scripts/deploying.py", [found], "measured")}

| policy | random sequences | 1 s closed loop | 6 s apart, mm | flash, kB | memory + stack, B | multiply-accumulates | \
instructions | ms per step |
|---|---|---|---|---|---|---|---|---|
{rows}

The first two columns are the largest difference of a command (of 1) between C and JAX in single precision: on
10 000 sequences of random estimates, near and far, slow and fast, each from a reset; and over a second in closed loop
with the simulated drone, from half a metre off or in a flip. The third is the largest distance between a drone flown by
the C and one flown by JAX over 6 s of hover, or of a flip, both with the same noise. Sizes are those of
`arm-none-eabi-gcc -mcpu=cortex-m4 -mfpu=fpv4-sp-d16 -O2`; the stack is the sum over all functions, more than any chain
of calls needs. Instructions are counted, the most of any step, by running the program on QEMU's model of an STM32F405,
where the commands were the same as here; the time follows with {costs["cycles_per_instruction"]:g} cycles for each at
{costs["clock_hz"] / 1e6:.0f} MHz, which is more than a Cortex-M4 needs on such code. None of it has been measured on a
drone. A step is due every 8 ms; the firmware's other tasks run beside it.

## The interface

```c
void cfb_policy_reset(void);
void cfb_policy_step(const float position[3], const float velocity[3], const float quaternion_wxyz[4],
                     const float body_rate[3], const float target[3], float motor_command[4]);
float cfb_policy_dt(void);
cfb_fault_t cfb_policy_fault(void);                             /* fine, blind, stopped */

void cfb_policy_set_flip(float v_target, float rate_target);    /* flips only: begin one */
cfb_phase_t cfb_policy_phase(void);                             /* hold, climb, turn, catch */
```

The history is inside. A flip begins with the step after `cfb_policy_set_flip`; until then, and after the catch, the
target is held. What happens when an estimate is not finite, when steps are missed or the set-point goes away is in the
exported `README.md`, and tested (`tests/deploy`).

## What the firmware does between the policy and the motors

- The app commands `controlModeForce` with `normalizedForces`, which the firmware passes to the motors as shares of
  65535. That share is the `u` of the model (docs/conventions.md): proportional to the voltage, not to the thrust.
- Firmware since October 2025 compensates for the battery's voltage on this drone by default, and caps the thrust of a
  motor at 0.2 N. Both change what a policy's command does; the exported `app-config` turns that off. Policies trained
  on a model with `battery_sag` fitted to your flights need it off as well.
- The estimate the policy sees is the firmware's Kalman filter's, position and velocity in the world, the gyro after its
  80 Hz low-pass. Training assumed 8 ms of delay for all of it (`pose_delay`, and the gyro as late); `cfb fit
  --parameters pose_delay` measures yours.
"""


def main() -> None:
    """Measure, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--page-only", action="store_true")
    if not parser.parse_args().page_only:
        set_up_xla()
        write_json(NUMBERS, measure())
    write_text(PAGE, page(json.loads(NUMBERS.read_text())))
    print(PAGE.relative_to(ROOT))


if __name__ == "__main__":
    main()
