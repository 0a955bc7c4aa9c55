"""Measure scenes: their speed in MJX and in MuJoCo's C beside `mujoco.batch` alone, and a race through gates.

    python benchmarks/scenes.py [--parts speed race]

Writes ``docs/scenes.md``, ``docs/scenes.png`` and ``benchmarks/scenes.json``. Takes eight minutes.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from cfb_mjx.files import scratch, write_text
from cfb_mjx.runtime import cores, environment, say

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT / "scripts"), str(ROOT / "examples")]
REPEATS, STEPS, COUNT = 5, 50, 1024
SHARES = (0.0, 0.01, 0.1, 1.0)
"""Shares of the drones that stand on the floor."""
STANDING_M = 0.0138
"""Height of the rotors' centre of a drone that stands on its feet."""
WORLDS = {
    "floor": '<geom name="floor" type="plane" size="0 0 1"/>',
    "floor and a gate": (
        '<geom name="floor" type="plane" size="0 0 1"/>'
        '<geom type="box" pos="1 0.32 1" size="0.02 0.02 0.34"/>'
        '<geom type="box" pos="1 -0.32 1" size="0.02 0.02 0.34"/>'
        '<geom type="box" pos="1 0 1.32" size="0.02 0.34 0.02"/><geom type="box" pos="1 0 0.68" size="0.02 0.34 0.02"/>'
    ),
    "a ball and a moving platform": (
        '<body pos="3 0 1"><freejoint/><geom type="sphere" size="0.05" mass="0.02"/></body>'
        '<body mocap="true" pos="-2 0 0.2"><geom type="box" size="0.3 0.3 0.02"/></body>'
    ),
    "a load on a cable": (
        '<body name="cfb" pos="0 0 1"><site name="hook" pos="0 0 -0.01"/></body><body pos="0 0 0.79"><freejoint/>'
        '<geom size="0.01" mass="0.006" contype="0" conaffinity="0" group="3"/><site name="eye"/></body>'
    ),
}
SWARMS = {"two drones and a floor": 2, "eight drones and a floor": 8}
CABLE = '<tendon><spatial limited="true" range="0 0.2"><site site="hook"/><site site="eye"/></spatial></tendon>'


def main() -> None:
    """Measure, and write the page."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--parts", nargs="*", default=["speed", "race"], help="the others are taken from the file")
    parser.add_argument("--bodies", type=Path, help="only write the speed of bodies")
    parser.add_argument("--on", nargs="*", type=int, help="with --bodies: the cores to use; otherwise all")
    arguments = parser.parse_args()
    if arguments.bodies:
        if arguments.on:
            os.sched_setaffinity(0, arguments.on)
        write_text(arguments.bodies, json.dumps(rates_of_bodies()))
        return
    file = ROOT / "benchmarks" / "scenes.json"
    results = json.loads(file.read_text()) if file.exists() else {}
    # Without the options of `configure_jax`: jaxlib 0.10 aborts while it compiles contacts with them.
    results["environments"] = results.get("environments", {}) | dict.fromkeys(arguments.parts, environment())
    if "speed" in arguments.parts:
        results["bodies"], results["worlds"], results["rays"] = bodies(), worlds(), rays()
    if "race" in arguments.parts:
        results["race"] = race()
    write_text(file, json.dumps(results, indent=1, default=float) + "\n")
    import page_outputs

    path = ROOT / "docs" / "scenes.md"
    write_text(path, page(results))
    with scratch("cfb-scenes-") as folder, contextlib.chdir(folder):
        printed = page_outputs.run(path)
    write_text(path, page_outputs.written(path.read_text(), printed))


def _rates(functions: dict, amount: dict) -> dict[str, float]:
    """Steps per second of functions that take turns, in one run: the best of several calls each."""
    best = dict.fromkeys(functions, float("inf"))
    for call in functions.values():
        call()
    for _ in range(REPEATS):
        for name, call in functions.items():
            begun = time.perf_counter()
            call()
            best[name] = min(best[name], time.perf_counter() - begun)
    return {name: amount[name] / best[name] for name in functions}


def _rollouts(drone, count: int) -> list:
    """Rollouts of so many drones, of which each of `SHARES` stands on the floor; the others hover 1 m above it."""
    from cfb_mjx.model import rollout_final

    fly = jax.jit(jax.vmap(lambda state, commands: rollout_final(drone, state, commands)))
    hover = jax.tree.map(lambda x: jnp.broadcast_to(x, (count, *x.shape)), drone.hover_state())

    def rollout(share: float):
        stands = _standing(count, share)[:, None]
        standing = {"position": jnp.array([0.0, 0.0, STANDING_M]), "rotor_speed": 0.0}
        states = replace(hover, **{key: jnp.where(stands, x, getattr(hover, key)) for key, x in standing.items()})
        commands = jnp.where(stands[:, None], 0.0, jnp.tile(drone.hover_command(), (count, STEPS, 1)))
        return lambda: jax.block_until_ready(fly(states, commands))

    return [rollout(share) for share in SHARES]


def _standing(count: int, share: float) -> np.ndarray:
    """Which of so many drones stand on the floor: any, for neighbours are computed together."""
    return np.random.default_rng(0).permutation(count) < round(share * count)


def _flown(scene, drone, count: int):
    """Hover of so many drones in all."""
    commands, start = jnp.tile(drone.hover_command(), (STEPS, 1)), drone.hover_state()
    if scene.drones:
        count //= scene.drones
        commands = jnp.repeat(commands[:, None], scene.drones, axis=1)
        places = jnp.stack([jnp.array([0.5 * i, 0.0, 1.0]) for i in range(scene.drones)])
        start = jax.vmap(drone.hover_state)(places)
        drone = jax.tree.map(lambda x: jnp.stack([x] * scene.drones), drone)
    state = scene.begin(drone, start)
    states = jax.tree.map(lambda x: jnp.broadcast_to(x, (count, *x.shape)), state)
    fly = jax.jit(jax.vmap(lambda state: scene.rollout(drone, state, commands, every=STEPS)))
    return lambda: jax.block_until_ready(fly(states))


def _alone(model, count: int, bodies: Sequence[str] = ("cfb",), share: float = 0.0):
    """`mujoco.batch` alone: hover of so many drones in all under a constant force, all steps in one call.

    A ``share`` of them stands on the floor instead.
    """
    from mujoco.batch import Batch

    batch = Batch(model, count // len(bodies))
    stands = _standing(count // len(bodies), share)
    for i, body in enumerate(bodies):
        joint = int(model.body(body).jntadr[0])
        first = model.jnt_qposadr[joint]
        batch.bind("qpos")[:, first : first + 3] = (0.5 * i, 0.0, 1.0)
        batch.bind("qpos")[stands, first + 2] = STANDING_M
        batch.bind("qfrc_applied")[~stands, model.jnt_dofadr[joint] + 2] = 9.81 * model.body(body).mass[0]
    return lambda: batch.step(nstep=STEPS)


def bodies() -> dict:
    """Bodies of one drone with a floor, beside `mujoco.batch` alone, on one core and on all."""
    say("bodies")
    rates = {}
    with scratch("cfb-scenes-") as folder:
        every = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []
        for cpus in [every[:1], every] if len(every) > 1 else [every]:
            # In a process of its own, because jax counts cores as it begins.
            written = Path(folder) / "rates.json"
            command = [sys.executable, __file__, "--bodies", str(written), "--on", *map(str, cpus)]
            subprocess.run(command, check=True)
            rates[str(len(cpus) or cores())] = json.loads(written.read_text())
    return {"drones": COUNT, "shares": SHARES, "rates": rates}


def rates_of_bodies() -> dict[str, list[float]]:
    """Steps per second of every body, one for each of `SHARES`."""
    from cfb_mjx.model import MjxBody, MujocoBody, Quadrotor, RigidBody

    drones = {
        "RigidBody()": RigidBody(),
        "MjxBody(floor=False)": MjxBody(floor=False),
        "MjxBody()": MjxBody(),
        "MujocoBody()": MujocoBody(),
    }
    functions = {}
    for name, body in drones.items():
        flights = _rollouts(Quadrotor.from_file("cfb-guards", body=body), COUNT)
        has_floor = body in (MjxBody(), MujocoBody())
        functions |= {(name, i): fly for i, fly in enumerate(flights) if has_floor or not i}
    model = MujocoBody().mujoco_model
    functions |= {("mujoco.batch alone", i): _alone(model, COUNT, share=share) for i, share in enumerate(SHARES)}
    found: dict[str, list[float]] = {}
    for (name, _), rate in _rates(functions, dict.fromkeys(functions, COUNT * STEPS)).items():
        found.setdefault(name, []).append(rate)
    return found


def worlds() -> dict:
    """Scenes in both engines, beside `mujoco.batch` alone."""
    from cfb_mjx.model import Quadrotor, Scene

    found, counts = {}, {"mjx": 128, "c": 1024, "mujoco.batch alone": 1024}
    drone = Quadrotor.from_file("cfb-guards")
    with scratch("cfb-scenes-") as folder:
        for name, inside in (WORLDS | dict.fromkeys(SWARMS, WORLDS["floor"])).items():
            say(name)
            path = Path(folder) / f"{name.replace(' ', '-')}.xml"
            cable = CABLE if "cable" in name else ""
            path.write_text(f"<mujoco><worldbody>{inside}</worldbody>{cable}</mujoco>")
            scenes = {engine: Scene(path, engine, drones=SWARMS.get(name)) for engine in ("mjx", "c")}
            functions = {engine: _flown(scene, drone, counts[engine]) for engine, scene in scenes.items()}
            alone = counts["mujoco.batch alone"]
            functions["mujoco.batch alone"] = _alone(scenes["c"].mujoco_model, alone, scenes["c"].world.bodies)
            found[name] = _rates(functions, {key: counts[key] * STEPS for key in functions})
    return {"counts": counts, "rates": found}


def rays() -> dict:
    """Rays per second of a depth camera at the race track."""
    from cfb_mjx.model import Quadrotor, Scene
    from cfb_mjx.model.scene_camera import look

    say("rays")
    drone, count, size = Quadrotor.from_file("cfb-guards"), 64, (32, 24)
    functions = {}
    with scratch("cfb-scenes-") as folder:
        path = Path(folder) / "track.xml"
        path.write_text(with_camera())
        for engine in ("mjx", "c"):
            scene = Scene(path, engine)
            state = scene.begin(drone, drone.hover_state((0.5, 0.0, 1.0)))
            states = jax.tree.map(lambda x: jnp.broadcast_to(x, (count, *x.shape)), state)
            see = jax.jit(jax.vmap(lambda state, s=scene: look(s, drone, state, "front", *size)))
            functions[engine] = lambda see=see, states=states: jax.block_until_ready(see(states))
    amount = count * size[0] * size[1]
    geoms = scene.mujoco_model.ngeom
    return {"drones": count, "geoms": geoms, "rates": _rates(functions, dict.fromkeys(functions, amount))}


def with_camera() -> str:
    """The race track with a camera on the drone."""
    import gate_race

    body = '<body name="cfb"><camera name="front" pos="0.03 0 0" xyaxes="0 -1 0 0 0 1" fovy="60"/></body>'
    return gate_race.TRACK.read_text().replace('<geom name="floor"', f'{body}\n    <geom name="floor"')


def race() -> dict:
    """Run the example as a user does, and draw the race of its policy."""
    import gate_race

    from cfb_mjx.control import load_policy
    from cfb_mjx.model import Quadrotor

    with scratch("cfb-scenes-") as folder:
        written, policy, path = (Path(folder) / name for name in ("race.json", "race.npz", "track.xml"))
        command = [sys.executable, gate_race.__file__, "--write", str(written), "--policy", str(policy)]
        subprocess.run(command, check=True)
        task = gate_race.RaceTask(gates=gate_race.gates_of(gate_race.TRACK))
        fly = partial(gate_race.raced, task, load_policy(policy).controller, Quadrotor.from_file("cfb-guards"))
        _, _, way = jax.jit(jax.vmap(fly))(jax.random.split(jax.random.PRNGKey(1), 20))
        path.write_text(with_camera())
        draw(path, task.gates, np.asarray(way))
        return json.loads(written.read_text())


def draw(path: Path, gates, way: np.ndarray) -> None:
    """Draw the race from above, and what the drone sees before the first gate."""
    from cfb_mjx.model import Quadrotor, Scene
    from cfb_mjx.model.scene_camera import look
    from cfb_mjx.view.style import context, new_figure, save

    drone, scene = Quadrotor.from_file("cfb-guards"), Scene(path, "c")
    seen = look(scene, drone, scene.begin(drone, drone.hover_state((0.5, 0.0, 1.0))), "front", 160, 120)
    with context():
        figure = new_figure(9.0, 3.6)
        above, depth = figure.subplots(1, 2, width_ratios=(1.25, 1))
        for one in way[:20]:
            above.plot(one[:, 0], one[:, 1], color="#0072B2", linewidth=0.5, alpha=0.4)
        for x, y, _, yaw in gates:
            across = 0.34 * np.array([-np.sin(yaw), np.cos(yaw)])
            above.plot([x - across[0], x + across[0]], [y - across[1], y + across[1]], color="#D55E00", linewidth=3)
        above.plot(1, 1.5, "o", color="#666666", markersize=4)
        above.set_aspect("equal")
        above.set_xlabel("x, m")
        above.set_ylabel("y, m")
        above.set_title("20 races of 10 s, gates and a pole", fontsize=9)
        shown = depth.imshow(np.where(np.isfinite(seen.depth), seen.depth, np.nan), cmap="viridis_r", vmax=6)
        depth.set_title("depth before the first gate, m", fontsize=9)
        depth.set_axis_off()
        figure.colorbar(shown, ax=depth, shrink=0.8)
        figure.subplots_adjust(left=0.07, right=0.98, bottom=0.14, top=0.9, wspace=0.1)
        save(figure, ROOT / "docs" / "scenes.png")


def page(results: dict) -> str:
    """Return the page."""
    from campaign import measured_on

    facts = measured_on(results["environments"])
    measured = results["bodies"]
    of_bodies = []
    for many, rates in measured["rates"].items():
        on = f"{many} core{'s' if many != '1' else ''}"
        for name, row in rates.items():
            numbers = [f"{rate / 1e6:.2f} M" for rate in row] + ["" for _ in measured["shares"][len(row) :]]
            of_bodies.append(f"| {on} | `{name}` | {' | '.join(numbers)} |")
    shares = " | ".join({0: "none", 1: "all"}.get(share, f"{share:.0%}") for share in measured["shares"])
    of_worlds = []
    for name, rates in results["worlds"]["rates"].items():
        whole = rates["mujoco.batch alone"]
        of_worlds.append(
            f"| {name} | {rates['mjx'] / 1e6:.3f} M | {rates['c'] / 1e6:.2f} M | {whole / 1e6:.2f} M | "
            f"{rates['c'] / whole:.2f} | {rates['c'] / rates['mjx']:.0f} |"
        )
    rays = results["rays"]["rates"]
    return PAGE.format(
        facts=facts,
        quotes='"""',
        cores=cores(),
        bodies="\n".join(of_bodies),
        drones=measured["drones"],
        shares=shares,
        lines="---|" * len(measured["shares"]),
        worlds="\n".join(of_worlds),
        geoms=results["rays"]["geoms"],
        mjx_rays=rays["mjx"] / 1e6,
        c_rays=rays["c"] / 1e6,
        counts=results["worlds"]["counts"],
        race_millions=results["race"]["commands"] / 1e6,
        **{f"race_{key}": value for key, value in results["race"].items()},
    )


PAGE = """# Worlds of one's own

Written by `python benchmarks/scenes.py`; do not edit. {facts}

This page is for users who fly the drone through gates, past poles, onto platforms, or with something on a cable. A
`Scene` is any MJCF with the drone in it. MuJoCo moves everything and computes contacts and cables; the rotors,
effects and randomisation are the library's, as without a scene.

```python
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp

from cfb_mjx.model import Quadrotor, Scene

Path("world.xml").write_text({quotes}
<mujoco>
  <worldbody>
    <geom name="floor" type="plane" size="0 0 1"/>
    <geom name="bar" type="box" pos="0.5 0 1" size="0.02 0.3 0.02"/>
    <body name="platform" mocap="true" pos="-2 0 0.2"><geom type="box" size="0.3 0.3 0.02"/></body>
    <body name="ball" pos="3 0 1"><freejoint/><geom type="sphere" size="0.05" mass="0.02"/></body>
  </worldbody>
</mujoco>
{quotes})
scene = Scene("world.xml", engine="c")  # without a drone: it is added
drone = Quadrotor.from_file("cfb-guards", dt=0.002)

thrown = replace(drone.hover_state((0.2, 0.0, 1.0)), velocity=jnp.array([1.0, 0.0, 0.0]))
state = scene.begin(drone, thrown)
state = replace(state, mocap_positions=jnp.array([[-2.0, 0.0, 0.3]]))  # moves the platform
flown = jax.jit(scene.rollout)(drone, state, jnp.tile(drone.hover_command(), (300, 1)))
farthest, ball = float(flown.drone.position[:, 0].max()), float(flown.positions[-1, 2])
print(f"stopped at {{farthest:.2f}} m; the ball has fallen to {{ball:.2f}} m")
```

- **The drone**: a body `cfb` with a free joint, or none, or one that holds only sites and cameras and becomes the
  drone. Geoms of one's own need nothing: MuJoCo's defaults touch the drone's outline and feet. Geoms that the drone
  cannot touch give a warning.
- **State**: `SceneState` has the drone's `State`, the positions and velocities of all other joints, the controls of
  the scene's own actuators, and the poses of mocap bodies; replace these to move them. `constraint` is the force of
  contacts and cables on the drone: zero if nothing was touched.
- **Several drones**: `Scene(mjcf, engine, drones=N)` has N, which collide; models, states and commands have an axis
  of drones ([an example, and their wakes](swarms.md)).
- **Cables** are spatial tendons with a limit, between a site on the drone and one on the load.
- **Engines**: `mjx` runs on any device and has forward-mode derivatives; `c` is `mujoco.batch`, on the CPU alone,
  without derivatives. Both fly randomised drones under `vmap`.
- **MJX lacks** some pairs of shapes; it says so, and names the pair. The drone's outline is made of capsules, which
  it lets collide with everything. `<custom><numeric name="max_geom_pairs" data="8"/></custom>` makes it faster where
  few geoms are near.
- **Memory of contacts**: none. A step depends on the state alone (no warm start), so that rollouts are pure
  functions.
- On jaxlib 0.10, do not call `cfb_mjx.runtime.configure_jax` in a process that uses the engine `mjx`: that version
  aborts while it compiles contacts with the option which the commands set.

## Seen by a camera

`look` casts a ray through every pixel of a camera of the MJCF and returns depth and the number of the geom.

```py
from cfb_mjx.model.scene_camera import geom_names, look

image = look(scene, drone, state, "front", width=32, height=24)  # image.depth, image.geom
```

On the race track below, with {geoms} geoms, the engine `mjx` casts {mjx_rays:.1f} M rays a second here, `c`
{c_rays:.1f} M.

## A race through gates

`python examples/gate_race.py` defines a task of its own on `examples/gates.xml`, trains a policy for it by
back-propagation ({race_millions:.0f} M commands in {race_seconds:.0f} s), and flies it in the scene, where the bars
can be hit: {race_gates_in_10_s:.1f} gates in 10 s, a lap of five gates in {race_lap_s:.2f} s, at most
{race_speed_mps:.1f} m/s;
{race_touched:.1%} of {race_drones} drones touched something.

![Races, and what the drone sees](scenes.png)

## Speed

Steps of 4 ms per second, the best of five calls that take turns. `mujoco.batch alone` takes the same MJCF through as
many steps under a constant force, in one call, without rotors or effects: it is the limit for the engine `c`, which
hands over the state after every step.

One drone and a floor, {drones} at once, of which so many stand on the floor; the others hover 1 m above it:

| on | body | {shares} |
|---|---|{lines}
{bodies}

`MjxBody` and `MujocoBody` fly drones that are near nothing in closed form, as `RigidBody` does, and ask MuJoCo for the
others alone: the speed depends on how many are near something. Both have the same interface, so that every rollout,
task and training can use them. Scenes ask MuJoCo for everything in every step; on {cores} cores:

| world | `mjx`, {counts[mjx]} drones | `c`, {counts[c]} drones | `mujoco.batch` alone | `c` of it | `c` over `mjx` |
|---|---|---|---|---|---|
{worlds}
"""


if __name__ == "__main__":
    main()
