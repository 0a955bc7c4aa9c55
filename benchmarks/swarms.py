"""Measure swarms: their speed, and what a search recovers of a downwash between two simulated drones.

    python benchmarks/swarms.py [--seeds 7 8 9]

Writes ``docs/swarms.md`` and ``benchmarks/swarms.json``. Takes ten minutes.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from dataclasses import replace
from pathlib import Path

import jax

from cfb_mjx.files import write_text
from cfb_mjx.runtime import configure_jax, environment

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT / "scripts")]
SIZES = (1, 2, 4, 8, 64, 256)
DRONES, STEPS, REPEATS = 4096, 250, 7


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs="+", default=[7, 8, 9])
    parser.add_argument("--parts", nargs="*", default=["speed", "crossing"], help="the others are taken from the file")
    arguments = parser.parse_args()
    file = ROOT / "benchmarks" / "swarms.json"
    results = json.loads(file.read_text()) if file.exists() else {}
    configure_jax(x64=False)
    results["environment"] = environment()
    if "speed" in arguments.parts:
        results["speed"] = speeds()
    jax.config.update("jax_enable_x64", True)
    jax.clear_caches()
    if "crossing" in arguments.parts:
        results["crossing"] = [crossing(seed) for seed in arguments.seeds]
    write_text(file, json.dumps(results, indent=1, default=float) + "\n")
    import page_outputs

    path = ROOT / "docs" / "swarms.md"
    write_text(path, page(results))
    write_text(path, page_outputs.written(path.read_text(), page_outputs.run(path)))


def speeds() -> list[dict]:
    """Steps of a drone per second in swarms of several sizes, in turn with as many drones that fly alone."""
    import jax.numpy as jnp

    from cfb_mjx.model import Quadrotor, rollout
    from cfb_mjx.model.effects import Downwash
    from cfb_mjx.model.swarm import rollout_swarm

    alone = Quadrotor.from_file("cfb-guards")
    model = replace(alone, effects=(Downwash(coefficient=0.004),))
    found = []
    for size in SIZES:
        count, side = DRONES // size, max(1.0, (size / 4) ** 0.5)
        swarm = jax.tree.map(lambda x, n=size: jnp.stack([x] * n), model)
        hover = replace(model.hover_state(), memory=())
        spread = jnp.array([side, side, 1.0])
        places = jax.random.uniform(jax.random.key(0), (count, size, 3)) * spread + jnp.array([0.0, 0.0, 1.0])
        states = jax.vmap(jax.vmap(lambda place, h=hover: replace(h, position=place)))(places)
        noise = 0.01 * jax.random.normal(jax.random.key(1), (STEPS, size, 4, count))
        commands = jnp.clip(model.hover_command()[:, None] + noise, 0.0, 1.0)

        def together(state, commands, swarm=swarm):
            flown = rollout_swarm(swarm, state, commands, every=STEPS)
            return flown.state.position, flown.neglected

        def apart(state, commands):
            return rollout(alone, state, commands, every=STEPS).position

        single = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), states)
        own = jnp.transpose(commands, (0, 2, 3, 1)).reshape(STEPS, 4, -1)
        runs = [
            (jax.jit(jax.vmap(together, in_axes=(0, 3))), (states, commands)),
            (jax.jit(jax.vmap(apart, in_axes=(0, 2))), (single, own)),
        ]
        found_now = [jax.block_until_ready(run(*arguments)) for run, arguments in runs]
        neglected = float(found_now[0][1].max())
        best = [float("inf")] * 2
        for _ in range(REPEATS):
            for i, (run, arguments) in enumerate(runs):
                began = time.perf_counter()
                jax.block_until_ready(run(*arguments))
                best[i] = min(best[i], time.perf_counter() - began)
        rate, free = (count * size * STEPS / seconds for seconds in best)
        found.append({"size": size, "swarms": count, "rate": rate, "alone": free, "neglected": neglected})
        print(found[-1], flush=True)
    return found


def crossing(seed: int) -> dict:
    """Let a search find the wake of a second drone of the reference simulator, with both drones' logs."""
    from tracing_sweep import ERRORS, recovered

    from cfb_mjx.logs import with_other
    from cfb_mjx.model import Quadrotor
    from cfb_mjx.parameters import load_model_file
    from cfb_mjx.reference_simulator import Case, fly_campaigns
    from cfb_mjx.sysid.evaluation import evaluate
    from cfb_mjx.sysid.tracing.closing import close_loop

    base = load_model_file("cfb-guards")
    flown, twin = fly_campaigns([Case("pair", seed, (("downwash", 1.0),)), Case("alone", seed)])
    fit, held_out = (
        [with_other(log, other) for log, other in zip(logs, others, strict=True)]
        for logs, others in ((flown.fit, flown.fit_others), (flown.held_out, flown.held_out_others))
    )
    outcome = close_loop(fit, held_out, base)
    errors = {name: getattr(outcome, name).metrics("commands_in") for name in ("before", "after")}
    errors["perfect"] = evaluate(Quadrotor.from_file(base), twin.held_out).metrics("commands_in")
    line = {name: {key: float(metrics[key]) for key in ERRORS} for name, metrics in errors.items()}
    found = {item.name: item.to_json() for item in outcome.reported}
    print(seed, list(found), recovered(line), flush=True)
    return {"seed": seed, "truth": flown.truth["effects"]["downwash"], "found": found, **line}


def page(results: dict) -> str:
    """Return the page."""
    from tracing_sweep import recovered

    facts = ", ".join(f"{name} {value}" for name, value in results["environment"].items())
    slowest = min(line["rate"] / line["alone"] for line in results["speed"] if line["size"] == 2)
    rows = [
        f"| {line['size']} | {line['swarms']} | {line['rate'] / 1e6:.1f} M | {line['alone'] / 1e6:.1f} M | "
        f"{line['rate'] / line['alone']:.2f} | {line['neglected']:.2f} |"
        for line in results["speed"]
    ]
    cases = []
    for line in results["crossing"]:
        wake = line["found"].get("downwash")
        strength = f"{wake['parameters']['coefficient']:.4f}" if wake else "not found"
        names = ", ".join(line["found"]) or "nothing"
        cases.append(
            f"| {line['seed']} | {names} | {line['truth']['wake']:.4f} | {strength} | "
            f"{line['before']['attitude_rmse_deg@0.5s']:.1f} | {line['after']['attitude_rmse_deg@0.5s']:.1f} | "
            f"{line['perfect']['attitude_rmse_deg@0.5s']:.1f} | {recovered(line):.0%} |"
        )
    return PAGE.format(facts=facts, ratio=slowest, rows="\n".join(rows), cases="\n".join(cases))


PAGE = """# Swarms and downwash

Written by `python benchmarks/swarms.py`; do not edit. {facts}

This page is for users who fly several drones in one room. It shows how to simulate drones in each other's wakes, how to
find the downwash in logs of two drones, and what both cost.

## Simulate

A swarm is a model with a leading axis of drones. The drones act on each other by the effect
[`downwash`](effects.md#forces-and-torques), a turbulent jet below every drone:

```python
from dataclasses import replace
import jax, jax.numpy as jnp
from cfb_mjx.model import Quadrotor
from cfb_mjx.model.effects import Downwash
from cfb_mjx.model.swarm import rollout_swarm

drone = replace(Quadrotor.from_file("cfb-guards"), effects=(Downwash(coefficient=0.004),))
pair = jax.tree.map(lambda x: jnp.stack([x, x]), drone)
places = jnp.array([[0.0, 0.0, 1.5], [0.05, 0.0, 1.0]])  # the second half a metre below the first
states = jax.vmap(drone.hover_state)(places)
commands = jnp.tile(drone.hover_command(), (100, 2, 1))  # 0.4 s; (steps, drones, 4)
flown = rollout_swarm(pair, states, commands)
print(flown.state.position[-1].round(2))  # the lower one sinks and drifts below the other
```

Use `jax.vmap` over swarms, and `jax.grad` as with `rollout`. Up to four drones are computed exactly: at every step each
sees all others. In a larger swarm each drone sees the four strongest wakes near it, chosen every 0.1 s, and
extrapolates the motion of their drones between exchanges every 20 ms. `flown.neglected` is the greatest speed of the
air in a wake that was left out. There are no collisions.

Drone steps per second ({steps} steps of 4 ms, {drones} drones with their own commands, float32), in turn with as many
drones that fly alone without effects. A pair flies at {ratio:.2f} times their speed.

| drones per swarm | swarms | in swarms | alone | ratio | neglected, m/s |
|---|---|---|---|---|---|
{rows}

## Find it in logs

```sh
cfb close-loop --fit a1.mcap a2.mcap --held-out a3.mcap --with b1.mcap b2.mcap b3.mcap -o closed
cfb evaluate a3.mcap --with b3.mcap --model closed/model.yaml
```

`--with` takes the logs of the second drone, one for each log of the first, in the same order, on the same clock and in
the same frame. `downwash` is then one of the effects that are searched. The second drone's path is an input, like the
commands, also while a prediction looks ahead.

The table shows two drones of the [reference simulator](tracing.md), of which the second crosses over the first. The
profile of its jet is the measured one, as in the model; the rest is the simulator's own. The columns: the coefficient
in N s^2/m^2, the error of the attitude after 0.5 s on held-out flights, in degrees, without and with the correction and
of a perfect model, and the share of the achievable improvement that is reached (mean over the errors, as in
[tracing.md](tracing.md)).

| seed | found | true | fitted | before | after | perfect | recovered |
|---|---|---|---|---|---|---|---|
{cases}

## Limits

- Wakes older than 0.6 s, more than about a metre below, are taken to be of that age.
- A drone that sinks as fast as its own wake flies in it, which the model leaves out.
- Within 2.5 motor distances (25 cm) the four jets have not merged.
- The force on a Crazyflie 2.1 agrees with what was measured (Neural-Swarm, 2020) within a factor of two; the fit of
  gym-pybullet-drones (2021) is several times larger. Fit the coefficient to your drones.
""".replace("{steps}", str(STEPS)).replace("{drones}", str(DRONES))


if __name__ == "__main__":
    main()
