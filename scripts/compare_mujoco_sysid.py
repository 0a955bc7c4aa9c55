"""Fit the same flights with `mujoco.sysid` and with the library, and write docs/sysid-comparison.md.

    pip install 'mujoco[sysid]'
    python scripts/compare_mujoco_sysid.py [--drones 4] [--repeats 2]

The flights come from the independent plant of the tests (``tests/sysid/plant.py``, ``open_loop.py``). The fit with
`mujoco.sysid` is in ``tests/sysid/mujoco_fit.py``.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from importlib.metadata import version
from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)

import numpy as np  # noqa: E402

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT / "tests" / "sysid"), str(ROOT / "benchmarks")]
from mujoco import sysid  # noqa: E402

if not hasattr(sysid, "ModelSequences"):
    # Without its optional dependencies the module imports, but it is empty.
    sys.exit(
        "This comparison needs the optional dependencies of mujoco.sysid; install them: pip install 'mujoco[sysid]'"
    )

import mujoco_fit  # noqa: E402
import open_loop  # noqa: E402
from same_residual import by_scipy, of_shooting, timed  # noqa: E402

from cfb_mjx.files import write_text  # noqa: E402
from cfb_mjx.parameters import load_model_file  # noqa: E402
from cfb_mjx.runtime import environment  # noqa: E402
from cfb_mjx.sysid.identification.fitting import fit  # noqa: E402
from cfb_mjx.sysid.identification.shooting import shoot  # noqa: E402

NOMINAL = load_model_file("cfb-guards").parameters()
SHOWN = {
    "inertia_xx": ("J_xx", 1e5, "1e-5 kg m^2"),
    "inertia_yy": ("J_yy", 1e5, "1e-5 kg m^2"),
    "inertia_zz": ("J_zz", 1e5, "1e-5 kg m^2"),
    "rotor_inertia": ("J_m", 1e8, "1e-8 kg m^2"),
    "motor_time_constant": ("T", 1e3, "ms"),
}
SAME = ("mujoco_windows", "shooting_measured_start")
"""Two solvers of the same least-squares problem."""
BEST = ("mujoco_manoeuvres", "shooting", "innovation")
"""The methods as their users would run them."""
TITLES = {
    "mujoco_windows": "mujoco.sysid, same windows",
    "shooting_measured_start": "`shoot(free_start=False)`",
    "mujoco_manoeuvres": "mujoco.sysid",
    "shooting": "`shoot` (free starts)",
    "innovation": "`fit` (innovations)",
    "scipy": "SciPy `least_squares`, 2-point differences, our compiled residual",
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--drones", type=int, default=4)
    parser.add_argument("--repeats", type=int, default=2, help="of the seven manoeuvres, per drone")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("-o", "--output", type=Path, default=ROOT / "docs" / "sysid-comparison.md")
    parser.add_argument("--json", type=Path, default=ROOT / "benchmarks" / "sysid_comparison.json")
    arguments = parser.parse_args()
    drones = []
    for index in range(arguments.drones):
        drones.append(one_drone(np.random.default_rng([arguments.seed, index]), arguments.repeats, first=not index))
        print(f"drone {index + 1} of {arguments.drones} done", flush=True)
    results = {
        "environment": environment() | {"scipy": version("scipy"), "load_average": f"{os.getloadavg()[0]:.1f}"},
        "flights_per_drone": open_loop.KINDS * arguments.repeats,
        "drones": drones,
    }
    write_text(arguments.json, json.dumps(results, indent=1) + "\n")
    write_text(arguments.output, page(results))
    print(f"wrote {arguments.output} and {arguments.json}")


def one_drone(rng: np.random.Generator, repeats: int, first: bool) -> dict:
    """Fly a random drone and fit its flights with every method; with ``first``, also measure the compilation time."""
    plant = open_loop.draw_drone(rng)
    logs = open_loop.fly(plant, repeats, rng)
    found, seconds, compile_seconds = {}, {}, {}

    def ours(name, method):
        if first:
            _, once = timed(method)
        result, seconds[name] = timed(method)
        if first:
            compile_seconds[name] = once - seconds[name]
        found[name] = {key: {"value": e.value, "std": e.std} for key, e in result.estimates.items()}

    names = mujoco_fit.NAMES
    for name, pieces in (
        ("mujoco_windows", mujoco_fit.windows(logs)),
        ("mujoco_manoeuvres", mujoco_fit.whole_manoeuvres(logs)),
    ):
        result, seconds[name] = timed(lambda p=pieces: mujoco_fit.fit(p))
        found[name] = mujoco_fit.in_si(result)
    ours("shooting_measured_start", lambda: shoot(logs, NOMINAL, names, free_start=False))
    ours("shooting", lambda: shoot(logs, NOMINAL, names))
    ours("innovation", lambda: fit(logs, NOMINAL, names))
    problem = of_shooting(logs, NOMINAL, names)
    problem.residual(problem.unknowns.start)  # compile
    scipy = by_scipy(problem.residual, problem.unknowns.start)
    seconds["scipy"] = scipy["seconds"]
    values = np.asarray(problem.unknowns.values(scipy["x"]))
    found["scipy"] = {name: {"value": float(v)} for name, v in zip(problem.unknowns.names, values, strict=True)}
    return {
        "truth": open_loop.truth(plant),
        "estimates": found,
        "seconds": seconds,
        "compile_seconds": compile_seconds,
        "scipy_evaluations": scipy["evaluations"],
    }


def difference(a: dict, b: dict) -> float:
    """Return the difference of two estimates in combined standard deviations."""
    return (b["value"] - a["value"]) / np.hypot(a["std"], b["std"])


def page(results: dict) -> str:
    """Return the page as Markdown."""
    env = results["environment"]
    packages = ", ".join(f"{name} {env[name]}" for name in ("cfb_mjx", "jax", "mujoco", "numpy", "scipy"))
    lines = [
        "# Comparison with an independent implementation: mujoco.sysid",
        "",
        "This page compares the estimates, the standard deviations and the speed of this library's fits with those of",
        "`mujoco.sysid` on the same simulated flights. Read it to decide whether to trust these fits.",
        "",
        f"Measured {env['date']} on {env['processor']}, {env['device']}, Python {env['python']},",
        f"{packages}, float64, by",
        "",
        "    pip install 'mujoco[sysid]'",
        "    python scripts/compare_mujoco_sysid.py",
        "",
        "which writes this page and `benchmarks/sysid_comparison.json`.",
        "",
        "## What is compared",
        "",
        f"{len(results['drones'])} drones are drawn at random around the paper's (each moment of inertia within 20 %,",
        f"J_m within 30 %, T within 20 %). Each flies {results['flights_per_drone']} open-loop manoeuvres from hover:",
        "roll, pitch and yaw doublets and single-motor steps of half a second. The paper's equations are simulated in",
        "plain NumPy (RK4 at 1 ms) and logged at 250 Hz with white noise: gyro 0.02 rad/s, attitude 1 mrad, velocity",
        "0.01 m/s, position 0.5 mm. Pose and velocity are 8 ms late. There are no rotor speeds. Mass, thrust and",
        "torque curves and K are known; J_xx, J_yy, J_zz, J_m and T are fitted, all starting from the preset.",
        "",
        "`mujoco.sysid` (part of MuJoCo) simulates `assets/cfb.xml` without its floor in MuJoCo C (RK4, 2 ms) and",
        "differentiates by finite differences. It shares no code with the model or the fits of this library",
        "(`tests/sysid/mujoco_fit.py`).",
        "",
        "A MuJoCo actuator is affine in its activation and cannot represent a cubic thrust curve. The motor model is",
        "therefore evaluated in NumPy from the logged commands and the candidate value of T (`custom_rollout` of",
        "`mujoco.sysid`). Three actuators per rotor receive thrust, aerodynamic torque and rotor acceleration as means",
        "over each step. J_m is the gain of the last one; MuJoCo's own geometry turns thrust into moments. The",
        "optimiser stops at changes of 1e-6: at its default of 1e-8 it searches in the noise of its finite",
        "differences.",
        "",
        "## The same least-squares problem",
        "",
        "Windows of 0.2 s start from the *measured* (noisy) state at 0.6, 0.8 and 1.0 s of each flight. Predictions",
        "are compared every 20 ms, weighted by the noise that third differences show. Both tools get the same states,",
        "rows and weights, so the minimum must be the same.",
        "",
        "The standard deviations differ, and ours are the realistic ones here. All rows of a window share the error of",
        "its initial state. The intervals of `mujoco.sysid` assume white residuals and leave this out; our bootstrap",
        "over windows includes it. The last column is the difference in units of the *smaller* standard deviation.",
        "",
        *table(results, SAME, strict=True),
        "",
        "## Each tool as its users would run it",
        "",
        "`mujoco.sysid` gets every row of 0.6 s from the start of each manoeuvre, predicted in one piece from the",
        "known initial state (hover at rest, free of noise). `shoot` and `fit` get the noisy logs as they are and do",
        "not know that the drone was at rest. They also estimate initial states and rotor speeds (`shoot`) or",
        "disturbances (`fit`), so their standard deviations are larger.",
        "",
        "In brackets: distance from the truth in standard deviations. Last columns: difference from `mujoco.sysid` in",
        "combined standard deviations.",
        "",
        *table(results, BEST),
        "",
        *summary(results),
        "",
        "## Time",
        "",
        *times(results),
        "",
    ]
    return "\n".join(lines)


def table(results: dict, methods: tuple[str, ...], strict: bool = False) -> list[str]:
    """Return a table with one row per drone and parameter."""
    first, *others = methods
    if strict:
        heads = ["difference / smaller std"]
    else:
        heads = [f"{TITLES[name]} - {TITLES[first]}" for name in others]
    lines = [
        "| drone | parameter | truth | " + " | ".join(TITLES[m] for m in methods) + " | " + " | ".join(heads) + " |",
        "|---" * (3 + len(methods) + len(heads)) + "|",
    ]
    for index, drone in enumerate(results["drones"], 1):
        for name, (symbol, factor, unit) in SHOWN.items():
            value = drone["truth"][name]
            cells = [f"{index}", f"{symbol} [{unit}]", f"{factor * value:.4f}"]
            found = [drone["estimates"][m].get(name) for m in methods]
            for e in found:
                z = "" if strict or e is None else f" ({(e['value'] - value) / e['std']:+.1f})"
                cells.append(
                    "not identified" if e is None else f"{factor * e['value']:.4f} ± {factor * e['std']:.4f}{z}"
                )
            for e in found[1:]:
                if e is None:
                    cells.append("")
                elif strict:
                    apart = (e["value"] - found[0]["value"]) / min(e["std"], found[0]["std"])
                    cells.append(f"{apart:+.3f}")
                else:
                    cells.append(f"{difference(found[0], e):+.2f}")
            lines.append("| " + " | ".join(cells) + " |")
    return lines


def summary(results: dict) -> list[str]:
    """Return a table with the errors of each method over all drones and parameters."""
    pairs = [(d, name) for d in results["drones"] for name in SHOWN]

    def estimates(method):
        return [(d["estimates"][method][n], d["truth"][n]) for d, n in pairs if n in d["estimates"][method]]

    lines = [
        "| method | values | rms distance from truth / std | largest | median relative std | relative error, rms |",
        "|---|---|---|---|---|---|",
    ]
    for method in (*SAME, *BEST):
        found = estimates(method)
        z = np.array([(e["value"] - t) / e["std"] for e, t in found])
        spread = np.median([e["std"] / t for e, t in found])
        error = np.sqrt(np.mean([(e["value"] / t - 1) ** 2 for e, t in found]))
        lines.append(
            f"| {TITLES[method]} | {len(z)} | {np.sqrt(np.mean(z**2)):.2f} | {np.abs(z).max():.1f} "
            f"| {100 * spread:.3f} % | {100 * error:.3f} % |"
        )
    return lines


def times(results: dict) -> list[str]:
    """Return a table with the seconds per fit, median over the drones."""
    drones = results["drones"]
    lines = [
        f"Wall time of one fit of {results['flights_per_drone']} flights, median over the drones, on a shared machine",
        f"(load average {results['environment']['load_average']} at the end). Compilation is needed once per process;",
        "its time is without a compile cache.",
        "",
        "| method | fit [s] | compilation [s] |",
        "|---|---|---|",
    ]
    for method in ("mujoco_windows", "mujoco_manoeuvres", "scipy", "shooting_measured_start", "shooting", "innovation"):
        once = drones[0]["compile_seconds"].get(method)
        cell = "" if once is None else f"{once:.0f}"
        lines.append(f"| {TITLES[method]} | {np.median([d['seconds'][method] for d in drones]):.2f} | {cell} |")
    lines += [
        "",
        "SciPy minimises the residual of `shoot(free_start=False)`, compiled by this library. The times of `shoot` and",
        "`fit` include their iterations over weights or noise levels and the bootstrap of the uncertainty.",
        "`mujoco.sysid` compiles a MuJoCo model for every candidate and window. `benchmarks/fit_speed.py` compares the",
        "speed on a minute of flight.",
    ]
    return lines


if __name__ == "__main__":
    main()
