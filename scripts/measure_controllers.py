"""Fly every controller through every test, and write docs/controllers.md with its figures.

    python scripts/measure_controllers.py [--plants 4096] [--controllers NAME ...]

A minute each; with no names it writes the page alone. What is not measured anew stays as it is in
benchmarks/controllers.json. The paper's own numbers are of the real drone and stand beside. `raptor` is RAPTOR's
published policy (`pip install foundation-policy`).
"""

import argparse
import json
from dataclasses import replace

from campaign import ROOT, facts_line

from cfb_mjx.reproduce.paper import PAPER_FIRMWARE, PAPER_HOVER
from cfb_mjx.runtime import configure_jax, environment, say

QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)
RAPTOR = [
    "`raptor`: the published policy of RAPTOR (Eschmann, Albani, Loianno 2025; `pip install foundation-policy`), 100 "
    "commands/s, with errors of position and velocity limited to 0.5 m and 1 m/s as its authors' adapter for PX4 does. "
    "It was trained on quadrotors of every size, without delay, and finds out in flight what it flies; the shipped "
    "policies were trained on this type and its delay.",
    "",
]
IDSIA = "cfb-idsia"
CONTROLLERS = ["target", "target-analytic", "target-adaptive", "pid", "mellinger", "raptor"]
RESULTS = ROOT / "benchmarks" / "controllers.json"
PAPER_OF = {"target": PAPER_HOVER[1.0], **PAPER_FIRMWARE}


def main() -> None:
    """Measure, then write."""
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
    results = {name: r for name, r in results.items() if name in CONTROLLERS and r["drones"] == arguments.plants}
    for name in arguments.controllers:
        say(name)
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
            "recovered": float(np.mean(thrown_nominal.recovered)),
            "sensors": judge.with_sensors(controller, lumped),
            IDSIA: summary(hover(controller, wild, Quadrotor.from_file(IDSIA), many)[0], np.median),
            "factors": _factors(drones, nominal.parameters, distance, well),
            "plants": {},
        }
        for plant, drone in plants.items():
            # A drone that was meant to be the paper's: the firmware's controllers are scaled for that one.
            results[name]["plants"][plant] = summary(hover(controller, calm, drone, few)[0], np.mean)
        write_json(RESULTS, results)
        # Six controllers' compiled programs are more than LLVM may map.
        jax.clear_caches()
    results = {name: results[name] for name in CONTROLLERS if name in results}
    write_text(ROOT / "docs" / "controllers.md", page(results, arguments.plants, described))
    print("docs/controllers.md")


def _cell(there: dict) -> str:
    if there["hover_mm"] is None:
        return "all lost"
    lost = f", {there['failed']:.2%} failed" if there["failed"] else ""
    return f"{there['hover_mm']:.0f} ({there['command_std']:.3f}){lost}"


def _factors(drones, nominal, distance, well) -> dict[str, dict[str, float]]:
    """Of each factor: Spearman's rank correlation of the hover error with the size of its departure, and the median
    error of the third of the drones that depart least and of the third that departs most."""
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
    names = list(results)
    lines = [
        "# Controllers, measured",
        "",
        f"{facts_line('python scripts/measure_controllers.py', list(results.values()), 'measured')} In simulation: "
        f"model `{described.name}`, estimates 8 ms late and noisy, the gyro too "
        "but for the firmware's controllers and RAPTOR, which read it on the drone; noise of the state as in the "
        "paper. The paper's numbers are of its real drone.",
        "",
        *(RAPTOR if "raptor" in names else []),
        "## On the nominal drone",
        "",
        "Hover: 6 s, all but the first second counted, mean of 64 flights. Step: 6 m to one side, arrival "
        "within 10 cm, median of 64.",
        "",
        "| controller | hover, mm | command std | paper, mm | paper, std | arrival, s | peak, m/s | overshoot, m |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for name in names:
        r = results[name]
        paper = [f"{x:g}" for x in PAPER_OF.get(name, ())] or ["", ""]
        # A file has null for what never is.
        arrival = "not within 4" if r["arrival_s"] in (None, float("inf")) else f"{r['arrival_s']:.2f}"
        cells = [name, f"{r['hover_mm']:.1f}", f"{r['command_std']:.4f}", *paper, arrival]
        cells += [f"{r['peak_speed_mps']:.2f}", f"{r['overshoot_m']:.2f}"]
        lines.append("| " + " | ".join(cells) + " |")
    lines += [
        "",
        f"## On {plants} drones with the paper's full randomisation",
        "",
        "Quantiles of the hover error of those that did not fail. Failed: faster than 10 m/s or 30 rad/s. Recovered: "
        "thrown at 3 m/s any way with 60 deg of tilt, and after 6 s slower than 0.5 m/s, tilted less than 30 deg and "
        "within 0.75 m.",
        "",
        "| controller | 5 % | 25 % | median, mm | 75 % | 95 % | std | failed | recovered | nominal recovered |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for name in names:
        r = results[name]
        cells = [name, *(f"{v:.0f}" for v in r["random_hover_mm"].values()), f"{r['random_command_std']:.4f}"]
        cells += [f"{r['random_failed']:.2%}", f"{r['random_recovered']:.2%}", f"{r['recovered']:.2%}"]
        lines.append("| " + " | ".join(cells) + " |")
    factors = list(results[names[0]]["factors"])
    lines += [
        "",
        "Which factor sets the error: median of the third of the drones that depart least by it and of the third that "
        "departs most, mm; in brackets Spearman's rank correlation of the error with the size of the departure.",
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
        "Hover error in mm and the command std. The nominal drone with later and noisier estimates, mean of 64 "
        f"flights; then {plants} drones drawn with the paper's randomisation about `{IDSIA}`, a real drone as "
        "identified, median.",
        "",
        "| sensors | " + " | ".join(names) + " |",
        "|---|" + "---|" * len(names),
    ]
    for what in results[names[0]]["sensors"]:
        lines.append(f"| {what} | " + " | ".join(_cell(results[name]["sensors"][what]) for name in names) + " |")
    lines.append(f"| `{IDSIA}`, randomised | " + " | ".join(_cell(results[name][IDSIA]) for name in names) + " |")
    lines += [
        "",
        "## On drones that nothing was trained on",
        "",
        "Effects of the catalogue on the nominal drone (`configs/plants/off-nominal.yaml` says which and why): hover "
        "error in mm, mean of 64 flights, and the command std.",
        "",
        "| plant | " + " | ".join(names) + " |",
        "|---|" + "---|" * len(names),
    ]
    for plant in results[names[0]]["plants"]:
        cells = [_cell(results[name]["plants"][plant]) for name in names]
        lines.append(f"| {plant} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
