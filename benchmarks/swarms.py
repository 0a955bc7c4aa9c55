"""Measure swarms: their speed, and what a search recovers of a downwash between two simulated drones.

    python benchmarks/swarms.py [--seeds 7 8 9]

Writes ``docs/swarms.md``, ``docs/swarms.png`` and ``benchmarks/swarms.json``. Takes a quarter of an hour.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import sys
import time
from dataclasses import replace
from pathlib import Path

import jax

from cfb_mjx.files import scratch, write_text
from cfb_mjx.runtime import configure_jax, environment

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT / "scripts")]
SIZES = (1, 2, 4, 8, 64, 256)
DRONES, STEPS, REPEATS, FLIGHTS = 4096, 250, 7, 16
IN_SCENE = STEPS // 5
TIMES = (0, 0.5, 1)
"""Strengths of the wake that controllers fly in, over the default."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs="+", default=[7, 8, 9])
    parser.add_argument(
        "--parts", nargs="*", default=["speed", "flights", "crossing"], help="the others are taken from the file"
    )
    arguments = parser.parse_args()
    file = ROOT / "benchmarks" / "swarms.json"
    results = json.loads(file.read_text()) if file.exists() else {}
    configure_jax(x64=False)
    results["environments"] = results.get("environments", {}) | dict.fromkeys(arguments.parts, environment())
    if "speed" in arguments.parts:
        results["speed"] = speeds()
    if "flights" in arguments.parts:
        results["flights"] = flights()
    jax.config.update("jax_enable_x64", True)
    jax.clear_caches()
    if "crossing" in arguments.parts:
        results["crossing"] = [crossing(seed) for seed in arguments.seeds]
    write_text(file, json.dumps(results, indent=1, default=float) + "\n")
    import page_outputs

    path = ROOT / "docs" / "swarms.md"
    write_text(path, page(results))
    with scratch("cfb-swarms-") as folder, contextlib.chdir(folder):
        printed = page_outputs.run(path)
    write_text(path, page_outputs.written(path.read_text(), printed))


def speeds() -> list[dict]:
    """Steps of a drone per second in swarms of several sizes, in turn with as many drones that fly alone."""
    import jax.numpy as jnp

    from cfb_mjx.files import shipped
    from cfb_mjx.model import Quadrotor, Scene, rollout
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

        # A scene hands every step to MuJoCo: fewer swarms and steps.
        scene, some = Scene(shipped("assets", "cfb.xml"), "c", drones=size), max(1, count // 4)

        def in_scene(state, commands, swarm=swarm, scene=scene):
            return scene.rollout(swarm, scene.begin(swarm, state), commands, every=IN_SCENE).drone.position

        single = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), states)
        own = jnp.transpose(commands, (0, 2, 3, 1)).reshape(STEPS, 4, -1)
        runs = [
            (jax.jit(jax.vmap(together, in_axes=(0, 3))), (states, commands)),
            (jax.jit(jax.vmap(apart, in_axes=(0, 2))), (single, own)),
            (
                jax.jit(jax.vmap(in_scene, in_axes=(0, 3))),
                (jax.tree.map(lambda x, n=some: x[:n], states), commands[:IN_SCENE, ..., :some]),
            ),
        ]
        found_now = [jax.block_until_ready(run(*arguments)) for run, arguments in runs]
        neglected = float(found_now[0][1].max())
        best = [float("inf")] * len(runs)
        for _ in range(REPEATS):
            for i, (run, arguments) in enumerate(runs):
                began = time.perf_counter()
                jax.block_until_ready(run(*arguments))
                best[i] = min(best[i], time.perf_counter() - began)
        steps = (count * size * STEPS, count * size * STEPS, some * size * IN_SCENE)
        rate, free, touching = (number / seconds for number, seconds in zip(steps, best, strict=True))
        one = {"size": size, "swarms": count, "rate": rate, "alone": free, "neglected": neglected}
        found.append(one | {"scene": touching})
        print(found[-1], flush=True)
    return found


def flights() -> list[dict]:
    """Errors of the lower of two drones that cross, or of which one follows the other; draws some of the flights."""
    import numpy as np

    from cfb_mjx.control import find_controller
    from cfb_mjx.envs import TargetTask
    from cfb_mjx.model import Quadrotor
    from cfb_mjx.model.effects import Downwash
    from cfb_mjx.train.together import WAKE, cross, follow

    drone, keys, found, shown = Quadrotor.from_file("cfb-guards"), jax.random.split(jax.random.key(0), FLIGHTS), [], {}
    for name in ("track", "track-rates", "target", "pid", "mellinger"):
        controller, line = find_controller(name, drone), {"controller": name}
        for task, test in (("cross", cross), ("follow", follow)):
            for times in TIMES:
                model = replace(drone, effects=(Downwash(coefficient=times * WAKE),))
                numbers, flown = test(controller, TargetTask(), model, keys)
                values = {f"{key}m": 1e3 * float(np.mean(x)) for key, x in numbers._asdict().items() if key != "failed"}
                line[f"{task} {times}"] = values | {"failed": float(np.mean(numbers.failed))}
                if name == "track":
                    shown[task, times] = flown, controller.control_dt_s
        found.append(line)
        print(line, flush=True)
    draw(shown)
    return found


def draw(shown: dict) -> None:
    """Draw the height of the lower drone over its target, for several strengths of the wake."""
    import numpy as np

    from cfb_mjx.train.together import WAKE
    from cfb_mjx.view.style import context, new_figure, save

    titles = {"cross": "crossing, 0.3 m below", "follow": "following, 0.3 m below"}
    with context():
        figure = new_figure(9.0, 2.8)
        for axes, (task, title) in zip(figure.subplots(1, 2), titles.items(), strict=True):
            for times, colour in zip(TIMES, ("#666666", "#0072B2", "#D55E00"), strict=True):
                flown, dt = shown[task, times]
                over = 1e3 * np.asarray(flown.position - flown.watched)[..., 2]
                label = f"{times * WAKE:g} N s²/m²" if times else "no wake"
                axes.plot(dt * np.arange(over.shape[1]), over.mean(axis=0), color=colour, linewidth=1.0, label=label)
            axes.set(title=title, xlabel="time, s")
        figure.axes[0].set_ylabel("height over the target, mm")
        figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="upper center", ncols=3, fontsize=8)
        figure.subplots_adjust(left=0.08, right=0.98, bottom=0.17, top=0.8, wspace=0.15)
        save(figure, ROOT / "docs" / "swarms.png")


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
    from campaign import measured_on
    from tracing_sweep import recovered

    from cfb_mjx.train.together import WAKE

    facts = measured_on(results["environments"])
    slowest = min(line["rate"] / line["alone"] for line in results["speed"] if line["size"] == 2)
    rows = [
        f"| {line['size']} | {line['swarms']} | {line['rate'] / 1e6:.1f} M | {line['alone'] / 1e6:.1f} M | "
        f"{line['rate'] / line['alone']:.2f} | {line['neglected']:.2f} | {line['scene'] / 1e6:.2f} M |"
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
    together = []
    for line in results["flights"]:
        cells = [f"{line[f'{task} {times}']['mean_distance_mm']:.1f}" for task in _TASKS for times in TIMES]
        together.append(f"| {line['controller']} | {' | '.join(cells)} |")
    least = min(line[f"{task} 1"]["closest_mm"] for line in results["flights"] for task in _TASKS)
    return PAGE.format(
        facts=facts,
        ratio=slowest,
        rows="\n".join(rows),
        cases="\n".join(cases),
        together="\n".join(together),
        least=least / 10,
        wake=WAKE,
        few=IN_SCENE,
        flights=FLIGHTS,
        mujoco=min(line["scene"] for line in results["speed"]) / 1e6,
    )


_TASKS = ("cross", "follow")


PAGE = """# Swarms and downwash

Written by `python benchmarks/swarms.py`; do not edit. {facts}

This page is for users who fly several drones in one room. It shows how to simulate drones in each other's wakes, how to
find the downwash in logs of two drones, and what both cost.

## Simulate

A swarm is a model with a leading axis of drones. The drones act on each other by the effect
[`downwash`](effects.md#forces-and-torques), a turbulent jet below every drone:

```python
from dataclasses import replace
from pathlib import Path
import jax, jax.numpy as jnp
from cfb_mjx.model import Quadrotor
from cfb_mjx.model.effects import Downwash
from cfb_mjx.model.swarm import rollout_swarm

drone = replace(Quadrotor.from_file("cfb-guards"), effects=(Downwash(coefficient=0.008),))
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
air in a wake that was left out.

These drones do not collide. In a [`Scene`](scenes.md) with `drones=N` they do, with the same wakes, among whatever the
MJCF has:

```python
from cfb_mjx.model import Scene

Path("room.xml").write_text('<mujoco><worldbody><geom type="plane" size="0 0 1"/></worldbody></mujoco>')
scene = Scene("room.xml", engine="c", drones=2)
places = jnp.array([[0.0, 0.0, 1.0], [0.25, 0.0, 1.0]])
states = replace(jax.vmap(drone.hover_state)(places), memory=(), velocity=jnp.array([[0.5, 0, 0], [-0.5, 0, 0]]))
state = scene.begin(pair, states)
flown = jax.jit(scene.rollout)(pair, state, commands)  # 0.4 s
apart = jnp.linalg.norm(flown.drone.position[:, 1] - flown.drone.position[:, 0], axis=1)
print(f"as near as {{apart.min():.2f}} m, then {{apart[-1]:.2f}} m apart")
```

A load between two drones is a body with a cable to a site in each of the bodies `cfb` and `cfb1`.

Drone steps per second ({steps} steps of 4 ms, {drones} drones with their own commands, float32), in turn with as many
drones that fly alone without effects, and with a quarter as many swarms in a scene (engine `c`, {few} steps). A pair
flies at {ratio:.2f} times the speed of two drones alone; a scene at {mujoco:.2f} M drone steps/s or more in any size.
The engine `mjx` is for few drones: its cost grows faster than their number ([measured](scenes.md#speed)).

| drones per swarm | swarms | in swarms | alone | ratio | neglected, m/s | in a scene |
|---|---|---|---|---|---|---|
{rows}

## Fly controllers in it

```sh
cfb fly track --task cross                  # two drones exchange places, one 0.3 m below the other
cfb fly track --task follow --path random   # one follows another, 0.3 m below it
```

`cfb_mjx.train.together.fly_together` flies any number of drones, each along a path of its own or beside a leader that
sends its position, velocity and acceleration. A policy that sees ahead continues the leader's motion with these.

Mean distance of the lower drone from its target, mm, mean of {flights} flights, with no wake, with one of half the
commands' default of {wake:g} N s²/m², and with the default. The controllers that do not see ahead lag behind a target
that moves. In all flights the two stayed at least {least:.1f} cm apart.

| controller | cross: no wake | half | whole | follow: no wake | half | whole |
|---|---|---|---|---|---|---|
{together}

![Height of the lower drone over its target](swarms.png)

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

- Wakes older than 1 s, more than about one and a half metres below, are taken to be of that age.
- A drone that sinks as fast as its own wake flies in it, which the model leaves out.
- Within 2.5 motor distances (25 cm) the four jets have not merged.
- Beside four crossings of two Crazyflies 2.1, in the flights published with Neural-Swarm (2020): the force has the
  model's height and width, but is shifted along the way by one or two centimetres (perhaps by the clocks). Before the
  axis the torque is two to three times that of the model with `lever=1`, more than downward forces at the hubs can
  give; behind it the flights cannot tell, because their motors saturate. Fit both numbers to your drones.
- The downwash of gym-pybullet-drones (2021) is several times larger.
""".replace("{steps}", str(STEPS)).replace("{drones}", str(DRONES))


if __name__ == "__main__":
    main()
