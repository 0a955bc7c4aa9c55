"""Measure every controller in every test, and write docs/controllers.md.

    python scripts/measure_controllers.py [--plants 4096] [--controllers NAME ...]

A controller takes about a minute. `--controllers` without a name only writes the page. Results of controllers that are
not measured again stay as they are in benchmarks/controllers.json. The page also lists the paper's numbers, which were
measured on the real drone. `raptor` is RAPTOR's published policy (`pip install foundation-policy`). `mpc` is
examples/mpc.py; it takes five minutes, although it flies fewer flights and no randomised drones.
"""

import argparse
import json
from dataclasses import replace
from itertools import pairwise

from campaign import ROOT, facts_line
from mpc_baseline import IDSIA, about_mpc, cell, own_model, planned

from cfb_mjx.reproduce.controllers import PAPER_FIRMWARE, PAPER_HOVER
from cfb_mjx.runtime import configure_jax, environment, say

QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)
RAPTOR = [
    "`raptor` is the published policy of RAPTOR (Eschmann, Albani, Loianno 2025; `pip install foundation-policy`). It "
    "gives 100 commands/s. Its errors of position and velocity are limited to 0.5 m and 1 m/s, as in its authors' "
    "adapter for PX4. It was trained on quadrotors of every size, without delay, and adapts to the drone in flight. "
    "The shipped policies were trained on this type of drone and its delay.",
    "",
]
STRENGTHS = (1.2, 1.4, 1.6)
CONTROLLERS = ["target", "target-analytic", "target-adaptive", "pid", "mellinger", "raptor", "mpc"]
RESULTS = ROOT / "benchmarks" / "controllers.json"
PAPER_OF = {"target": PAPER_HOVER[1.0], **PAPER_FIRMWARE}


def main() -> None:
    """Measure the chosen controllers and write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--plants", type=int, default=4096)
    parser.add_argument("--controllers", nargs="*", choices=CONTROLLERS, default=CONTROLLERS)
    arguments = parser.parse_args()
    configure_jax(x64=False)
    import jax
    import numpy as np
    from raptor import RaptorController

    from cfb_mjx.control.controllers import find_controller, has_lumped_delay
    from cfb_mjx.envs import reset
    from cfb_mjx.files import write_json, write_text
    from cfb_mjx.model import Quadrotor
    from cfb_mjx.train.flying import hover, recovery, six_metres
    from cfb_mjx.train.judge import Judge, summary

    judge = Judge(random_drones=arguments.plants)
    described, nominal, plants = judge.described, judge.nominal, judge.plants
    few, many = judge.few, judge.many
    drones = jax.jit(jax.vmap(lambda key: reset(judge.wild, nominal, key).model.parameters))(many)
    results = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
    results = {
        name: r
        for name, r in results.items()
        if name in CONTROLLERS and r.get("drones", arguments.plants) == arguments.plants
    }
    for name in arguments.controllers:
        say(name)
        if name == "mpc":
            results[name] = {"environment": environment(), **planned(judge)}
            write_json(RESULTS, results)
            continue
        controller = RaptorController.published() if name == "raptor" else find_controller(name, nominal)
        # RAPTOR reads the gyro on the drone, as the firmware's controllers do.
        lumped = name != "raptor" and has_lumped_delay(name)
        calm, wild = (replace(task, lumped_delay=lumped) for task in (judge.calm, judge.wild))
        one, _ = hover(controller, calm, nominal, few)
        step, _ = six_metres(controller, calm, nominal, few)
        all_of_them, _ = hover(controller, wild, nominal, many)
        thrown, _ = recovery(controller, wild, nominal, many)
        thrown_nominal, _ = recovery(controller, calm, nominal, many)
        distance = 1e3 * np.asarray(all_of_them.mean_distance_m)
        well = ~np.asarray(all_of_them.failed)
        results[name] = {
            "environment": environment(),
            "drones": arguments.plants,
            "hover_mm": 1e3 * float(np.mean(one.mean_distance_m)),
            "command_std": float(np.mean(one.command_std)),
            "arrival_s": float(np.median(step.arrival_s)),
            "peak_speed_mps": float(np.median(step.peak_speed_mps)),
            "overshoot_m": float(np.median(step.overshoot_m)),
            "random_hover_mm": {f"{q:g}": float(np.quantile(distance[well], q)) for q in QUANTILES},
            "random_command_std": float(np.median(np.asarray(all_of_them.command_std)[well])),
            "random_failed": float(1 - well.mean()),
            "random_recovered": float(np.mean(thrown.recovered)),
            "recovered_by_strength": _by_strength(thrown),
            "recovered": float(np.mean(thrown_nominal.recovered)),
            "sensors": judge.with_sensors(controller, lumped),
            IDSIA: summary(hover(controller, wild, Quadrotor.from_file(IDSIA), many)[0], np.median),
            "factors": _factors(drones, nominal.parameters, distance, well),
            "plants": {},
        }
        for plant, drone in plants.items():
            # The firmware's controllers stay scaled for the nominal drone: they do not know the effects.
            results[name]["plants"][plant] = summary(hover(controller, calm, drone, few)[0], np.mean)
        write_json(RESULTS, results)
        # LLVM cannot map the compiled programs of all six controllers at once.
        jax.clear_caches()
    results = {name: results[name] for name in CONTROLLERS if name in results}
    write_text(ROOT / "docs" / "controllers.md", page(results, arguments.plants, described))
    print("docs/controllers.md")


def _by_strength(thrown) -> dict[str, list]:
    """Drones with a balanced thrust-to-weight below each limit and above the one before, and the recovered share."""
    import numpy as np

    band = np.digitize(np.asarray(thrown.thrust_to_weight), STRENGTHS)
    well = np.asarray(thrown.recovered)
    between = (f"{a:g} to {b:g}" for a, b in pairwise(STRENGTHS))
    names = [f"below {STRENGTHS[0]:g}", *between, f"above {STRENGTHS[-1]:g}"]
    return {name: [int((band == i).sum()), float(well[band == i].mean())] for i, name in enumerate(names)}


def _factors(drones, nominal, distance, well) -> dict[str, dict[str, float]]:
    """Dependence of the hover error on each factor of the randomisation.

    Per factor: Spearman's rank correlation of the error with the size of the deviation from the nominal drone, and the
    median error of the third of the drones with the smallest deviation and of the third with the largest.
    """
    import numpy as np
    from scipy.stats import spearmanr

    def departure(name):
        values = np.asarray(getattr(drones, name))
        return values - np.asarray(getattr(nominal, name))

    size = {
        "attitude offset, roll and pitch": np.linalg.norm(departure("attitude_offset")[:, :2], axis=1),
        "attitude offset, yaw": np.abs(departure("attitude_offset")[:, 2]),
        "weight over thrust": np.abs(_hover_squared(drones) / _hover_squared(nominal) - 1),
        "centre of gravity": np.linalg.norm(departure("center_of_gravity")[:, :2], axis=1),
        "thrust, between motors": np.std(np.asarray(drones.thrust_scale), axis=1),
        "torque, between motors": np.std(np.asarray(drones.torque_scale), axis=1),
        "motor time constant": np.abs(departure("motor_time_constant")[:, 0]),
        "inertia, roll and pitch": np.abs(departure("inertia")[:, :2]).sum(axis=1),
    }
    found = {}
    for name, value in size.items():
        value, error = value[well], distance[well]
        low, high = np.quantile(value, (1 / 3, 2 / 3))
        found[name] = {
            "rank_correlation": float(spearmanr(value, error).statistic),
            "least_third_mm": float(np.median(error[value <= low])),
            "most_third_mm": float(np.median(error[value >= high])),
        }
    return found


def _hover_squared(parameters):
    import numpy as np

    thrust = np.asarray(parameters.thrust_scale).mean(axis=-1)
    return np.asarray(parameters.mass) / (thrust * np.asarray(parameters.motor_gain)[..., 0] ** 2)


def page(results: dict, plants: int, described) -> str:
    """The Markdown page."""
    from cfb_mjx.model import balanced_thrust_to_weight

    names = [name for name in results if name != "mpc"]
    nominal = float(balanced_thrust_to_weight(described.parameters()))
    mpc = results.get("mpc")
    here = [*names, "mpc"] if mpc else names
    lines = [
        "# Controllers, measured",
        "",
        "This page compares the shipped policies, the firmware's PID and Mellinger controllers, RAPTOR and "
        "model-predictive control in the same tests. Use it to choose a controller. `cfb fly` runs the tests with any "
        "policy:",
        "",
        "```sh",
        "cfb fly target-adaptive --plants 4096 --magnitude 1        # hover on randomised drones",
        "```",
        "",
        facts_line("python scripts/measure_controllers.py", [results[name] for name in names], "measured")
        + " All results are "
        f"simulated with the model `{described.name}`. Estimates are 8 ms late and noisy. The gyro is equally late, "
        "except for the firmware's controllers and RAPTOR, which read it on the drone. The noise of the state is that "
        "of the paper. The paper's numbers were measured on its real drone.",
        "",
        *(RAPTOR if "raptor" in names else []),
        *(about_mpc(mpc) if mpc else []),
        "## On the nominal drone",
        "",
        "Hover: mean distance to the target over 6 s without the first second, mean of 64 flights. Command std: "
        "standard deviation of the commands over time, mean of the motors. Step: a flight to a target 6 m away; "
        "arrival is the first time within 10 cm; median of 64 flights.",
        "",
        "| controller | hover, mm | command std | paper, mm | paper, std | arrival, s | peak, m/s | overshoot, m |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for name in here:
        r = results[name]
        paper = [f"{x:g}" for x in PAPER_OF.get(name, ())] or ["", ""]
        # An infinite time is null in the file.
        arrival = "not within 4" if r["arrival_s"] in (None, float("inf")) else f"{r['arrival_s']:.2f}"
        cells = [name, f"{r['hover_mm']:.1f}", f"{r['command_std']:.4f}", *paper, arrival]
        cells += [f"{r['peak_speed_mps']:.2f}", f"{r['overshoot_m']:.2f}"]
        lines.append("| " + " | ".join(cells) + " |")
    lines += [
        "",
        f"## On {plants} drones with the paper's full randomisation",
        "",
        "Quantiles of the hover error, and the median command std, of the drones that did not fail. Failed: faster "
        "than 10 m/s or 30 rad/s. Recovered: thrown at 3 m/s in a random direction with 60 deg of tilt, the drone did "
        "not fail and after 6 s is slower than 0.5 m/s, tilted less than 30 deg and within 0.75 m of the target.",
        "",
        "| controller | 5 % | 25 % | median, mm | 75 % | 95 % | std | failed | recovered | recovered, nominal drone |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for name in names:
        r = results[name]
        cells = [name, *(f"{v:.0f}" for v in r["random_hover_mm"].values()), f"{r['random_command_std']:.4f}"]
        cells += [f"{r['random_failed']:.2%}", f"{r['random_recovered']:.2%}", f"{r['recovered']:.2%}"]
        lines.append("| " + " | ".join(cells) + " |")
    if mpc:
        lines.append("| mpc |" + " |" * 7 + f" {mpc['recovered']:.2%} |")
    bands = list(results[names[0]]["recovered_by_strength"])
    lines += [
        "",
        "The next table divides the thrown drones by the largest thrust that they have with balanced "
        "roll, pitch and yaw torques, over their weight (`balanced_thrust_to_weight`; nominal: "
        f"{nominal:.2f}). Each cell is the share that recovers; the number of drones is in the heading.",
        "",
        "| controller | "
        + " | ".join(f"{band} ({results[names[0]]['recovered_by_strength'][band][0]} drones)" for band in bands)
        + " |",
        "|---|" + "---|" * len(bands),
    ]
    for name in names:
        shares = results[name]["recovered_by_strength"]
        lines.append(f"| {name} | " + " | ".join(f"{shares[band][1]:.1%}" for band in bands) + " |")
    factors = list(results[names[0]]["factors"])
    lines += [
        "",
        "The next table shows which factor of the randomisation determines the error. Each cell has the median error, "
        "mm, of the third of the drones with the smallest deviation from nominal in this factor, and of the third with "
        "the largest. In brackets: Spearman's rank correlation of the error with the size of the deviation.",
        "",
        "| factor | " + " | ".join(names) + " |",
        "|---|" + "---|" * len(names),
    ]
    for factor in factors:
        of = [results[name]["factors"][factor] for name in names]
        cells = [f"{x['least_third_mm']:.0f} to {x['most_third_mm']:.0f} ({x['rank_correlation']:+.2f})" for x in of]
        lines.append(f"| {factor} | " + " | ".join(cells) + " |")
    lines += [
        "",
        "## With other sensors, and on another laboratory's drone",
        "",
        "Hover error, mm, and the command std in brackets. The first rows are for the nominal drone with later or "
        f"noisier estimates, mean of 64 flights. The last row is for {plants} drones, drawn with the paper's "
        f"randomisation around `{IDSIA}`, the identified model of a real drone; median.",
        "",
        "| sensors | " + " | ".join(names) + " |",
        "|---|" + "---|" * len(names),
    ]
    for what in results[names[0]]["sensors"]:
        lines.append(f"| {what} | " + " | ".join(cell(results[name]["sensors"][what]) for name in names) + " |")
    lines.append(f"| `{IDSIA}`, randomised | " + " | ".join(cell(results[name][IDSIA]) for name in names) + " |")
    lines += [
        "",
        "## On drones with effects outside every training",
        "",
        "Each row adds effects of the catalogue to the nominal drone; `configs/plants/off-nominal.yaml` gives their "
        "constants and the reason for each. Hover error, mm, and the command std in brackets, mean of 64 flights.",
        "",
        "| plant | " + " | ".join(here) + " |",
        "|---|" + "---|" * len(here),
    ]
    for plant in results[names[0]]["plants"]:
        cells = [cell(results[name]["plants"][plant]) for name in here]
        lines.append(f"| {plant} | " + " | ".join(cells) + " |")
    return "\n".join([*lines, *(own_model(mpc) if mpc else [])]) + "\n"


if __name__ == "__main__":
    main()
