"""Measure model-predictive control for docs/controllers.md, and write what the page says about it."""

from __future__ import annotations

import sys

from campaign import ROOT, facts_line

from cfb_mjx.runtime import say

IDSIA = "cfb-idsia"
FLIGHTS, PLANT_FLIGHTS = 8, 4
"""Flights of `mpc` on the nominal drone, and on every other: a plan takes as long as thousands of commands of a
network."""
sys.path.append(str(ROOT / "examples"))


def planned(judge) -> dict:
    """Measurements of `mpc`, for JSON: with the nominal model everywhere, and with the drone's own where that is wrong.

    The model is wrong if the hover error is more than twice that on the nominal drone.

    Args:
        judge: holds the drones, the tasks and the keys (`cfb_mjx.train.judge.Judge`).
    """
    import jax
    import numpy as np
    from mpc import Mpc

    from cfb_mjx.model import Quadrotor
    from cfb_mjx.train.flying import hover, recovery, six_metres
    from cfb_mjx.train.judge import summary

    controller, nominal, keys = Mpc.of(judge.nominal), judge.nominal, judge.few[:FLIGHTS]
    one, _ = hover(controller, judge.calm, nominal, keys)
    step, _ = six_metres(controller, judge.calm, nominal, keys)
    thrown, _ = recovery(controller, judge.calm, nominal, keys)

    def held(controller, drone) -> dict:
        # LLVM cannot map the compiled programs of all drones at once.
        jax.clear_caches()
        return summary(hover(controller, judge.calm, drone, keys[:PLANT_FLIGHTS])[0], np.mean)

    found = {
        "hover_mm": 1e3 * float(np.mean(one.mean_distance_m)),
        "command_std": float(np.mean(one.command_std)),
        "arrival_s": float(np.median(step.arrival_s)),
        "peak_speed_mps": float(np.median(step.peak_speed_mps)),
        "overshoot_m": float(np.median(step.overshoot_m)),
        "recovered": float(np.mean(thrown.recovered)),
        "plants": {},
        "own_model": {},
    }
    drones = {**judge.plants, IDSIA: Quadrotor.from_file(IDSIA)}
    for name, drone in drones.items():
        say(f"mpc, {name}")
        there = found["plants"][name] = held(controller, drone)
        if there["failed"] or there["hover_mm"] > 2 * found["hover_mm"]:
            found["own_model"][name] = held(Mpc.of(drone), drone)
    return found


def cell(there: dict, digits: int = 0) -> str:
    """Hover error, command std and failures, for a table."""
    if there["hover_mm"] is None:
        return "all failed"
    lost = f", {there['failed']:.2%} failed" if there["failed"] else ""
    return f"{there['hover_mm']:.{digits}f} ({there['command_std']:.3f}){lost}"


def about_mpc(mpc: dict) -> list[str]:
    """The paragraph on model-predictive control."""
    return [
        "`mpc` is `examples/mpc.py`: nonlinear model-predictive control that plans with the simulator, differentiated. "
        "It sees the same estimates as the policies. Its model is the nominal drone, and in the last table also the "
        "drone that flies. It needs a computer on the ground. It is slow to simulate, so its numbers are of "
        f"{FLIGHTS} flights on the nominal drone and {PLANT_FLIGHTS} on every other; it flew no randomised drones. "
        + facts_line("python scripts/measure_controllers.py --controllers mpc", [mpc], "measured"),
        "",
    ]


def own_model(mpc: dict) -> list[str]:
    """The section on MPC with another model."""
    lines = [
        "",
        "## What the right model gives to model-predictive control",
        "",
        "Hover error of `mpc`, mm, and the command std in brackets, if it plans with the nominal model and if it plans "
        f"with the model of the drone that it flies. For `{IDSIA}` the latter is the model identified from flights of "
        "the real drone. The other drones are those above on which the error is more than twice that on the nominal "
        f"drone, {mpc['hover_mm']:.1f} mm. Mean of {PLANT_FLIGHTS} flights.",
        "",
        "| drone | nominal model | the drone's model |",
        "|---|---|---|",
    ]
    for name, own in mpc["own_model"].items():
        lines.append(f"| {name} | {cell(mpc['plants'][name], 1)} | {cell(own, 1)} |")
    return lines
