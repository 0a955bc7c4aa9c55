"""Export and check the shipped policies, and write their cost on the drone into docs/deploying.md.

python scripts/deploying.py             check all of them: benchmarks/deploying.json and the page (a minute)
python scripts/deploying.py --page-only write the page from the stored results
"""

import argparse
import json
import tempfile
from pathlib import Path

from campaign import ROOT, facts_line

from cfb_mjx.commands import Export
from cfb_mjx.deploy.check import FREE_RAM
from cfb_mjx.deploy.deployment import find_deployment
from cfb_mjx.deploy.weights import weight_set
from cfb_mjx.errors import CfbError
from cfb_mjx.files import write_json, write_text
from cfb_mjx.runtime import environment, set_up_xla

POLICIES = (
    "target",
    "target-analytic",
    "target-adaptive",
    "track",
    "track-rates",
    "flip",
    "double-flip",
    "triple-flip",
    "double-flip-ppo",
    "target --loadable",
)
NUMBERS, PAGE = ROOT / "benchmarks" / "deploying.json", ROOT / "docs" / "deploying.md"


def measure() -> dict:
    """Run `cfb export --check` on every policy and collect its numbers."""
    found = {}
    for name in POLICIES:
        policy, *options = name.split()
        with tempfile.TemporaryDirectory() as folder:
            exported = Export(policy, Path(folder) / policy, check=True, loadable="--loadable" in options).run()
        print(exported)
        if exported.complaint is not None:
            raise CfbError(exported.complaint)
        found[name] = {**exported.check.numbers, "environment": environment()}
    return {"policies": found, "environment": environment()}


def row(name: str, found: dict) -> str:
    """Format one row of the table."""
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
    """Write the text of docs/deploying.md."""
    rows = "\n".join(row(name, one) for name, one in found["policies"].items())
    costs, free_kb = next(iter(found["policies"].values()))["cortex_m4"], FREE_RAM / 1024
    holders = {name: find_deployment(name) for name in POLICIES if "--" not in name}
    large = [f"`{name}`" for name, one in holders.items() if not one.flips and len(weight_set(one)) > FREE_RAM]
    return f"""# Onto the drone

This page is for users who want to run a policy on a Crazyflie. `cfb export` turns the policy into C for the drone's
STM32F405: C11, single precision, static memory, and no function of the C library but `sqrtf` (and `atan2f` in flips).

```sh
cfb export target -o target-c --check              # a shipped policy; or policy.npz of cfb train
cfb export double-flip -o flip-c --check           # holds a target, flips on demand
cfb export target -o target-c --onnx target.onnx   # also for runtimes of ONNX
cfb export target -o target-c --loadable           # takes new weights over the radio
```

The output folder holds

- the C sources,
- an app for the firmware with its `Makefile`,
- `contract.json`: units, frames, rates, history and scale of every number, the hash of the weights, and the model and
  randomisation of the training,
- `card.md`, if the policy has a card: how it was trained and what it scores,
- a `README.md` on building, flashing and first flights.

## What it costs, and how near to JAX it is

{facts_line("python scripts/deploying.py", [found], "measured")}

| policy | random sequences | 1 s closed loop | 6 s apart, mm | flash, kB | memory + stack, B | multiply-accumulates | \
instructions | ms per step |
|---|---|---|---|---|---|---|---|---|
{rows}

| column | meaning |
|---|---|
| random sequences | largest difference of a command (range 0 to 1) between C and JAX in single precision, on 10 000 \
sequences of random estimates, near and far, slow and fast, each after a reset |
| 1 s closed loop | the same over one second in closed loop with the simulated drone, starting half a metre from the \
target, or in a flip |
| 6 s apart | largest distance between a drone flown by the C and one flown by JAX, over 6 s of hover or of a flip, \
with the same noise |
| flash, memory, stack | sizes with `arm-none-eabi-gcc -mcpu=cortex-m4 -mfpu=fpv4-sp-d16 -O2`; the stack is the sum \
over all functions, an upper bound for any chain of calls |
| instructions | largest number in one step, counted on QEMU's model of an STM32F405; the commands there were the same \
as on this machine |
| ms per step | the instructions at {costs["cycles_per_instruction"]:g} cycles each and \
{costs["clock_hz"] / 1e6:.0f} MHz; a Cortex-M4 needs fewer cycles on such code |

Nothing here has been measured on a drone. A step is due every 8 ms, and the firmware's other tasks need processor time
too.

## New weights without flashing

With `--loadable` the drone keeps a second set of weights in memory. Later policies are loaded over the radio, with
`cflib`:

```sh
cfb export target -o target-c --loadable --check   # flash this once
cfb export again.npz -o new-c --loadable           # trained again: the same network and observation
python new-c/load_weights.py radio://0/80/2M/E7E7E7E7E7 new-c/weights.bin
```

- `weights.bin` holds the weights, the outputs of a hover with which the history begins, a hash of the architecture and
  a CRC-32. The C takes only a complete set with the right CRC, of its own architecture, whose numbers are finite; each
  refusal has a status of its own. The architecture is everything else that the C computes with: layers, activation,
  observation, scales, ranges of the outputs.
- The weights in flash fly until a set is complete and checked, and after a refusal. No set is written or taken in
  flight.
- The loaded set is lost when the drone is switched off.
- The log variables `cfb.loaded`, `cfb.crc` and `cfb.weights` say which weights fly, and what became of the last set.
- It costs memory: the row `target --loadable` of the table. `--check` compares it with the {free_kb:.0f} kB
  that [the firmware's default build](https://github.com/bitcraze/crazyflie-firmware/pull/1700) for the Crazyflie 2
  leaves free; the sets of {", ".join(large)} alone are larger, and their check fails.
- It needs firmware since December 2025. Flips are exported without it.
- It was never run on a drone, nor linked with the whole firmware. Tested are the C on this machine, with the weights in
  flash also on an emulated processor, and app and script with stand-ins for the firmware and `cflib`.

## The interface

```c
void cfb_policy_reset(void);
void cfb_policy_step(const float position[3], const float velocity[3], const float quaternion_wxyz[4],
                     const float body_rate[3], const float target[3], float command[4]);
float cfb_policy_dt(void);
cfb_fault_t cfb_policy_fault(void);                             /* fine, blind, stopped */

void cfb_policy_set_preview(const float ahead[]);               /* tracking only: where the target will be */
void cfb_policy_set_flip(float v_target, float rate_target);    /* flips only: begin one */
cfb_phase_t cfb_policy_phase(void);                             /* hold, climb, turn, catch */
```

The policy keeps its own history of estimates and commands. A flip begins with the step after `cfb_policy_set_flip`;
until then, and after the catch, the policy holds the target. The exported `README.md` describes the behaviour if an
estimate is not finite, if steps are missed or if the set-point disappears; `tests/deploy` tests it.

## What the firmware does between the policy and the motors

- A policy that commands set-points (`track-rates`: thrust and body rates) leaves the motors to the firmware's own
  loops: the app hands thrust and rates to its rate loop, attitudes, velocities and positions to its PID, in the
  firmware's units and signs. The rest of this section is about policies that command the motors.
- The app uses `controlModeForce` with `normalizedForces`, which the firmware passes to the motors as fractions of
  65535. This fraction is the `u` of the model ([conventions](conventions.md)). It is proportional to the voltage, not
  to the thrust.
- Firmware since October 2025 compensates for the battery voltage on this drone by default, and limits the thrust of a
  motor to 0.2 N. Both change the effect of a command; the exported `app-config` turns them off. Policies trained on a
  model with `battery_sag` fitted to your flights also need them off.
- The policy reads the estimate of the firmware's Kalman filter (position and velocity in the world) and the gyro after
  its 80 Hz low-pass filter. Training assumed a delay of 8 ms for both (`pose_delay`). Measure the delay of your drone
  with `cfb fit --parameters pose_delay`.
"""


def main() -> None:
    """Measure the policies and write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--page-only", action="store_true")
    if not parser.parse_args().page_only:
        set_up_xla()
        write_json(NUMBERS, measure())
    write_text(PAGE, page(json.loads(NUMBERS.read_text())))
    print(PAGE.relative_to(ROOT))


if __name__ == "__main__":
    main()
