"""Measure controllers on paths, and write docs/tracking.md.

    python scripts/tracking.py [--drones 512]

It takes about seven minutes.
"""

import argparse
import json
import sys
from dataclasses import replace

from campaign import ROOT, facts_line

from cfb_mjx.runtime import configure_jax, environment, say

RESULTS, PAGE, FIGURE = (
    ROOT / "benchmarks" / "tracking.json",
    ROOT / "docs" / "tracking.md",
    ROOT / "docs" / "tracking.png",
)
CONTROLLERS = ("track", "track-rates", "mpc", "target", "target-adaptive", "pid", "mellinger")
sys.path.append(str(ROOT / "examples"))
AHEAD = ("track", "track-rates")
LANDING = ("track", "track-rates", "target", "pid", "mellinger")
LANDED = 128
LAPS = (6.0, 4.0, 3.0, 2.5, 2.0)
SEEDS = range(8)
FEW = 16
LATE = {
    "pose 16 ms late, the gyro as late": ({"pose_delay": 0.016}, True),
    "pose 24 ms late, the gyro read on the drone": ({"pose_delay": 0.024}, False),
}


def main() -> None:
    """Measure and write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--drones", type=int, default=512)
    parser.add_argument("--page-only", action="store_true", help="write the page from the stored results")
    arguments = parser.parse_args()
    configure_jax(x64=False)
    from cfb_mjx.files import write_json, write_text

    if not arguments.page_only:
        write_json(RESULTS, measured(arguments.drones))
    write_text(PAGE, page(json.loads(RESULTS.read_text())))
    print(PAGE.relative_to(ROOT))


def measured(drones: int) -> dict:
    """All measurements, for JSON."""
    import jax
    import jax.numpy as jnp
    import numpy as np
    from mpc import Mpc

    from cfb_mjx.control.controllers import find_controller, has_lumped_delay
    from cfb_mjx.deploy import compare, compile_policy, export_policy
    from cfb_mjx.deploy.deployment import find_deployment
    from cfb_mjx.envs import TargetTask, figure_eight
    from cfb_mjx.files import scratch
    from cfb_mjx.model import Quadrotor
    from cfb_mjx.parameters import load_randomisation
    from cfb_mjx.train.flying import load_plants
    from cfb_mjx.train.judge import Judge
    from cfb_mjx.train.tracking import Course, demanded, find_course, track
    from cfb_mjx.view.flight_figures import track_figure

    judge = Judge(random_drones=0)
    nominal, keys = judge.nominal, jax.random.split(jax.random.PRNGKey(0), FEW)
    many = jax.random.split(jax.random.PRNGKey(1), drones)
    fast = figure_eight()

    def told(numbers) -> dict:
        well = ~np.asarray(numbers.failed)
        distance = 1e3 * np.asarray(numbers.mean_distance_m)
        return {
            "mean_mm": float(distance[well].mean()) if well.any() else None,
            "median_mm": float(np.median(distance[well])) if well.any() else None,
            "q95_mm": float(np.quantile(distance[well], 0.95)) if well.any() else None,
            "largest_mm": 1e3 * float(np.asarray(numbers.largest_distance_m)[well].max()) if well.any() else None,
            "failed": float(1 - well.mean()),
        }

    found = {
        "environment": environment(),
        "drones": drones,
        "eights": {f"{lap:g}": demanded(Course(figure_eight(2.0, lap))) for lap in LAPS},
        "splines": {f"{seed}": demanded(find_course("random", seed)) for seed in SEEDS},
        "controllers": {},
    }
    for name in CONTROLLERS:
        say(name)
        controller = Mpc.of(nominal) if name == "mpc" else find_controller(name, nominal)
        calm = TargetTask(lumped_delay=name == "mpc" or has_lumped_delay(name))
        # A plan takes as long as thousands of commands of a network.
        own, few = (keys[:2], keys[:1]) if name == "mpc" else (keys, keys[:4])
        one = {"eights": {}, "splines": {}}
        for lap in LAPS:
            one["eights"][f"{lap:g}"] = told(track(controller, calm, nominal, own, figure_eight(2.0, lap))[0])
        for seed in SEEDS:
            course = find_course("random", seed)
            flown = track(controller, calm, nominal, few, course.path, course.seconds, course.settled_s)
            one["splines"][f"{seed}"] = told(flown[0])
        if name in AHEAD:
            for magnitude in (0.25, 0.5, 1.0):
                wild = replace(calm, randomisation=load_randomisation("paper"), magnitude=magnitude)
                for lap in (4.0, 2.5):
                    numbers, _ = track(controller, wild, nominal, many, figure_eight(2.0, lap))
                    one.setdefault("random", {})[f"{magnitude:g} {lap:g}"] = told(numbers)
            for what, (changes, lumped) in LATE.items():
                changed = {key: jnp.asarray(x, jnp.float32) for key, x in changes.items()}
                late = replace(nominal, parameters=replace(nominal.parameters, **changed))
                task = replace(calm, lumped_delay=lumped)
                one.setdefault("late", {})[what] = told(track(controller, task, late, keys, fast)[0])
            for plant, drone in load_plants(judge.described).items():
                slow = figure_eight(2.0, 3.0)
                one.setdefault("plants", {})[plant] = told(track(controller, calm, drone, keys, slow)[0])
            idsia = Quadrotor.from_file("cfb-idsia")
            one["cfb-idsia"] = told(track(controller, calm, idsia, keys, figure_eight(2.0, 3.0))[0])
            with scratch("cfb-tracking-") as folder:
                deployment = find_deployment(name)
                one["c"] = compare(deployment, compile_policy(export_policy(deployment, folder)))._asdict()
            if name == AHEAD[-1]:
                flown = track(controller, calm, nominal, keys[:4], fast)[1]
                track_figure(flown, controller.control_dt_s, FIGURE, f"{name}: 2 m by 1 m in 2 s")
        found["controllers"][name] = one
        jax.clear_caches()
    return found | {"landings": landings(nominal, keys, many[:LANDED]), "platform": on_a_platform(nominal, keys)}


def landings(nominal, keys, many) -> dict:
    """Landings of every controller on the nominal drone, and of those that see ahead on random drones, for JSON."""
    from cfb_mjx.control.controllers import find_controller, has_lumped_delay
    from cfb_mjx.devices import Devices
    from cfb_mjx.envs import TargetTask
    from cfb_mjx.parameters import load_randomisation
    from cfb_mjx.train.measuring import measured

    found = {}
    for name in LANDING:
        say(f"{name} lands")
        controller, calm = find_controller(name, nominal), TargetTask(lumped_delay=has_lumped_delay(name))
        found[name] = measured("land", controller, calm, keys, Devices.take(1))(nominal)[0]
        if name in AHEAD:
            wild = replace(calm, randomisation=load_randomisation("paper"), magnitude=1.0)
            found[f"{name}, magnitude 1"] = measured("land", controller, wild, many, Devices.take(1))(nominal)[0]
    return found


def on_a_platform(nominal, keys) -> dict:
    """Landings of `track` on the platform of ``examples/landing.py`` that turns and heaves, for JSON."""
    import jax
    from landing import CIRCLE_M, HEAVE_M, PLATFORM, RATE_RADPS, RIDES, landed, summary

    from cfb_mjx.control.controllers import find_controller
    from cfb_mjx.model import Scene
    from cfb_mjx.train.landing import touch_down

    say("a platform that moves")
    controller, scene = find_controller("track", nominal), Scene(PLATFORM, engine="c")
    flown = jax.jit(jax.vmap(lambda key: landed(RIDES["both"], scene, controller, nominal, key)))(keys)
    ride = {"circle_m": CIRCLE_M, "speed_mps": CIRCLE_M * RATE_RADPS, "heave_m": HEAVE_M}
    return ride | summary(touch_down(flown, controller.control_dt_s))


def page(found: dict) -> str:
    """Return the page."""
    rows = found["controllers"]
    eights = "| controller | " + " | ".join(f"{lap:g} s" for lap in LAPS) + " | largest error at 2 s |"
    lines = [
        "# Tracking a path",
        "",
        "Two shipped policies follow a target that moves: `track` commands the motors, `track-rates` commands "
        "collective thrust and body rates (CTBR), which the firmware's rate loop follows. Both see where the target "
        "will be in 50, 100, 200 and 400 ms.",
        "",
        "```sh",
        "cfb fly track                                   # a figure eight, 2 m by 1 m in 2 s",
        "cfb fly track-rates --path random --timescale 1.5 --figure flight.png",
        "cfb fly track --path figure8.csv                # a trajectory of uav_trajectories or Crazyswarm",
        "cfb train track -o out/track                    # seven minutes on one core",
        "cfb export track-rates -o out/c --check",
        "```",
        "",
        f"{facts_line('python scripts/tracking.py', [found], 'measured')} All results are simulated with the model "
        "`cfb-guards`, estimates 8 ms late and noisy.",
        "",
        "![A figure eight, flown](tracking.png)",
        "",
        "## Figure eights on the nominal drone",
        "",
        "Mean distance to the target, mm, on Gerono's figure eight of 2 m by 1 m, flown from hover; the first 4 s are "
        f"not counted. Mean of {FEW} flights (`mpc`: 2). `mpc` (`examples/mpc.py`) plans with the simulator itself, "
        "differentiated: what is possible with the right model and a computer on the ground. "
        "`target`, `target-adaptive` and the firmware's controllers do not see "
        "ahead: they follow the target's position alone, and lag.",
        "",
        eights,
        "|---|" + "---|" * (len(LAPS) + 1),
    ]
    for name, of in rows.items():
        cells = [_mm(of["eights"][f"{lap:g}"]["mean_mm"]) for lap in LAPS]
        lines.append(f"| {name} | " + " | ".join([*cells, _mm(of["eights"]["2"]["largest_mm"])]) + " |")
    lines.append(
        "| *the path asks for* | "
        + " | ".join(
            f"{x['speed_mps']:.1f} m/s, {x['thrust_to_weight']:.2f} g, {x['rate_radps']:.0f} rad/s"
            for x in found["eights"].values()
        )
        + " | |"
    )
    lines += [
        "",
        "The nominal drone lifts 2.68 times its weight.",
        "",
        "## Random paths",
        "",
        "Smooth paths through eight random points in a box of 2 m by 2 m by 1 m, a leg every 0.8 s, from rest to rest "
        "(`--path random --seed N`). Mean error, mm, of four flights.",
        "",
        "| controller | " + " | ".join(f"seed {seed}" for seed in found["splines"]) + " |",
        "|---|" + "---|" * len(found["splines"]),
    ]
    for name, of in rows.items():
        lines.append(f"| {name} | " + " | ".join(_mm(x["mean_mm"]) for x in of["splines"].values()) + " |")
    asked = " | ".join(f"{x['thrust_to_weight']:.2f} g" for x in found["splines"].values())
    lines += [
        f"| *the path asks for* | {asked} |",
        "",
        "## Other drones, late sensors, and C",
        "",
        f"Median error, mm, of {found['drones']} drones from the paper's randomisation with its ranges multiplied by "
        "the magnitude, with the share that failed; the mean error on the figure eight of 2 s with later sensors; on "
        "drones with effects outside the training and on `cfb-idsia` (3 s); and the largest difference between a "
        "command of the exported C and of JAX.",
        "",
        "| | " + " | ".join(AHEAD) + " |",
        "|---|---|---|",
    ]
    for key in rows[AHEAD[0]]["random"]:
        magnitude, lap = key.split()
        cells = [f"{_mm(rows[n]['random'][key]['median_mm'])}{_lost(rows[n]['random'][key])}" for n in AHEAD]
        lines.append(f"| magnitude {magnitude}, a lap in {lap} s | " + " | ".join(cells) + " |")
    for what in LATE:
        cells = [f"{_mm(rows[n]['late'][what]['mean_mm'])}{_lost(rows[n]['late'][what])}" for n in AHEAD]
        lines.append(f"| {what} | " + " | ".join(cells) + " |")
    for plant in rows[AHEAD[0]]["plants"]:
        cells = [f"{_mm(rows[n]['plants'][plant]['mean_mm'])}{_lost(rows[n]['plants'][plant])}" for n in AHEAD]
        lines.append(f"| `{plant}` | " + " | ".join(cells) + " |")
    cells = [f"{_mm(rows[n]['cfb-idsia']['mean_mm'])}{_lost(rows[n]['cfb-idsia'])}" for n in AHEAD]
    lines.append("| `cfb-idsia` | " + " | ".join(cells) + " |")
    lines.append(
        "| largest difference of a command in C | " + " | ".join(f"{rows[n]['c']['largest']:.1e}" for n in AHEAD) + " |"
    )
    return "\n".join([*lines, "", *_landing(found), "", *HOW]) + "\n"


def _landing(found: dict) -> list[str]:
    """The section about landings."""
    from cfb_mjx.train.landing import CONTACT_MPS, CRAWL_M, CRAWL_MPS, DESCENT_MPS, ON_PAD_M

    platform = found["platform"]
    lines = [
        "## Landing",
        "",
        "```sh",
        "cfb fly track --task land --plants 64 --magnitude 1 --figure landings.png",
        "python examples/landing.py                      # on a platform that turns and heaves",
        "```",
        "",
        "The drone begins in hover about 1 m above the pad and up to 1 m beside it. The target goes to above the pad "
        f"and comes down at {DESCENT_MPS:g} m/s, the last {100 * CRAWL_M:g} cm at {CRAWL_MPS:g} m/s. The floor is "
        "MuJoCo's, with the cushion of air of `ground_effect`. The motors stop once the estimate is near the pad and "
        f"does not sink. A landing succeeds if the first contact is slower than {CONTACT_MPS:g} m/s, at which PX4 "
        "lets multirotors touch the ground (`MPC_LAND_CRWL`), and the drone rests on its feet, its motors stopped, "
        f"within {100 * ON_PAD_M:g} cm of the middle. Medians of the successful landings: {FEW} on the nominal drone, "
        f"{LANDED} on drones from the paper's randomisation.",
        "",
        "| controller | landed | vertical speed, m/s | horizontal, m/s | tilt, deg | from the middle, mm |",
        "|---|---|---|---|---|---|",
    ]
    keys = ("vertical_speed_mps", "horizontal_speed_mps", "tilt_deg", "distance_mm")
    for name, of in found["landings"].items():
        medians = [of["quantiles"][key]["0.5"] for key in keys]
        cells = ["-"] * 4 if medians[0] is None else [f"{x:.{n}f}" for x, n in zip(medians, (2, 2, 1, 0), strict=True)]
        lines.append(f"| {name} | {of['success_rate']:.0%} | " + " | ".join(cells) + " |")
    return [
        *lines,
        "",
        f"On a platform that turns in a circle of {platform['circle_m']:g} m at {platform['speed_mps']:g} m/s and "
        f"heaves by +-{100 * platform['heave_m']:g} cm, `track` sees ahead along the platform's path: "
        f"{platform['landed']:.0%} of {FEW} landings succeed, at {platform['vertical_speed_mps']:.2f} m/s "
        f"relative to it and {platform['distance_mm']:.0f} mm from its middle (medians of all; without "
        "noise, and without a cushion above the platform). The platform is on slide joints whose positions and "
        "velocities are set. A mocap body has no velocity in contacts, so friction would hold the drone back.",
    ]


HOW = """\
## Paths of one's own

A path is any function from a time in seconds to a position in metres that JAX can differentiate. `demand` says what it
asks of a drone without drag; `through`, `random_spline`, `figure_eight` and `read_path` make paths.

```python
import jax
import jax.numpy as jnp

from cfb_mjx.control import find_controller
from cfb_mjx.envs import TargetTask, demand, through
from cfb_mjx.model import Quadrotor, balanced_thrust_to_weight
from cfb_mjx.train.tracking import track

drone = Quadrotor.from_file("cfb-guards")
path = through(jnp.array([[0, 0, 0], [1, 0, 0.3], [1, 1, 0], [0, 0, 0.0]]), jnp.array([0.0, 0.8, 1.6, 2.6]))
asked = float(demand(path, jnp.arange(0, 2.6, 0.01)).thrust_to_weight.max())
assert asked < balanced_thrust_to_weight(drone.parameters)

keys = jax.random.split(jax.random.PRNGKey(0), 16)
measured, flights = track(find_controller("track", drone), TargetTask(), drone, keys, path, 3.0, 0.0)
assert measured.mean_distance_m.max() < 0.02
```

## Actions

`observation.action` of a training says what the four outputs of a policy mean: `motors`, `body_rates` (thrust and body
rates, CTBR), `attitude` (thrust, roll, pitch, yaw), `velocity` and `position` (set-points, and yaw). All but the first
go through the firmware's own loops, in simulation at 500 Hz (`cfb_mjx.firmware`), on the drone in the firmware itself.

```sh
cfb train target --set observation.action=body_rates -o out/target-rates
```

On the drone the app takes what it sees ahead from the set-point's velocity and acceleration, which the firmware's
high-level commander gives: exact for slow paths, and short by the jerk for fast ones. A program of one's own calls
`cfb_policy_set_preview` with the path itself.
""".splitlines()


def _mm(x: float | None) -> str:
    return "all failed" if x is None else f"{x:.1f}" if x < 100 else f"{x:.0f}"


def _lost(there: dict) -> str:
    return f" ({there['failed']:.1%} failed)" if there["failed"] else ""


if __name__ == "__main__":
    main()
