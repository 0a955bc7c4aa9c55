"""Steps of a cell. Each step writes files to a folder, resumes after an interruption, and skips work already done.

The folder ``policies`` holds the policies shared by the cells of one seed, and ``own`` the files of one cell.
"""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

import jax

from cfb_mjx.commands.close_loop import CloseLoop
from cfb_mjx.control.policy_file import load_policy
from cfb_mjx.files import write_json
from cfb_mjx.logs import write_mcap
from cfb_mjx.loop import flights, trials
from cfb_mjx.loop.cells import Cell
from cfb_mjx.loop.flights import fly_campaign
from cfb_mjx.loop.policies import BOTH, CONFIG, FURTHER, RANDOMISED, policy_file, train_policy
from cfb_mjx.loop.trials import fly_trials
from cfb_mjx.runtime import environment, say
from cfb_mjx.train.config import load_config

FLOWN, CLOSED, LEARNT, LEARNT_BOTH = "flown.json", "closed", "corrected", "both"
KEPT = ("effects", "unexplained", "unexplained_because", "unconfirmed")
HELD_OUT = ("position_rmse_m@0.5s", "velocity_rmse_mps@0.5s", "attitude_rmse_deg@0.5s", "rate_rmse_radps@0.5s")


def settings() -> dict[str, Any]:
    """Settings on which the results depend, other than effects and seeds."""
    names = ("FIT", "HELD_OUT", "SECONDS", "USUAL_SECONDS", "RAISE", "DITHER_OF_JUMPS", "GENTLER")
    tests = ("HEIGHT", "HOVERS", "HOVER_S", "SETTLING_S", "TRACKS", "TRACK_S", "ENTRY_S")
    eight = ("PERIOD_S", "WIDTH_M", "DEPTH_M", "RAMP_S")
    return {
        "config": load_config(CONFIG).to_mapping(),
        "randomised": RANDOMISED,
        "further": FURTHER,
        "both": BOTH,
        "flights": {name: getattr(flights, name) for name in names},
        "trials": {name: getattr(trials, name) for name in (*tests, *eight)},
    }


def train_common(seed: int, folder: Path) -> dict[str, Any]:
    """Train the policies shared by the cells of one seed.

    Returns:
        Policy name to the last row of its learning curve.
    """
    nominal = train_policy("on the declared model", folder / "nominal", seed)
    start = policy_file(folder / "nominal")
    return {
        "nominal": nominal,
        "randomised": train_policy("on randomised drones", folder / "randomised", seed, changes=RANDOMISED),
        "longer": train_policy("longer on the declared model", folder / "longer", seed, changes=FURTHER, start=start),
    }


def fly(cell: Cell, policies: Path, own: Path) -> dict[str, Any]:
    """Fly the campaign and write its logs. `FLOWN` is written last and marks the step as complete."""
    if (own / FLOWN).exists():
        return json.loads((own / FLOWN).read_text(encoding="utf-8"))
    with jax.enable_x64(False):
        campaign = fly_campaign(cell.case, load_policy(policy_file(policies / "nominal")).controller, progress=say)
    for side, logs in (("fit", campaign.fit), ("held-out", campaign.held_out)):
        folder = own / "flights" / side
        folder.mkdir(parents=True, exist_ok=True)
        for log in logs:
            write_mcap(log, folder / f"{log.name}.mcap")
    found = {
        "truth": campaign.truth,
        "manoeuvres": campaign.manoeuvres,
        "tries": campaign.tries,
        "seconds_of_flight": sum(log.duration for log in campaign.fit + campaign.held_out),
    }
    write_json(own / FLOWN, found)
    return found


def close(own: Path) -> dict[str, Any]:
    """Correct the model from the logs and the declared model, as ``cfb close-loop`` does.

    Returns:
        The entries `KEPT` of its report, the held-out errors, and the time in s.
    """
    report, began = own / CLOSED / "report.json", time.perf_counter()
    if not report.exists():
        fit, held_out = (tuple(sorted((own / "flights" / side).glob("*.mcap"))) for side in ("fit", "held-out"))
        declared = load_config(CONFIG).model
        closed = CloseLoop(own / CLOSED, fit=fit, held_out=held_out, model=declared).run()
        say(f"close-loop names {', '.join(effect['name'] for effect in closed.numbers['effects']) or 'no effect'}")
        # Compiled programs of every shape would accumulate until the process runs out of memory mappings.
        jax.clear_caches()
    found = json.loads(report.read_text(encoding="utf-8"))
    errors = {when: {key: found["held_out"][when][key] for key in HELD_OUT} for when in ("before", "after")}
    return {key: found[key] for key in KEPT} | {"held_out": errors, "seconds": time.perf_counter() - began}


def learn(cell: Cell, policies: Path, own: Path) -> dict[str, Any]:
    """Train the nominal and the randomised policy further on the corrected model.

    Returns:
        Policy name to the last row of its learning curve.
    """
    model, seed = own / CLOSED / "model.yaml", cell.seed
    start, wide = (policy_file(policies / name) for name in ("nominal", "randomised"))
    what = "on the corrected model"
    row = train_policy(what, own / LEARNT, seed, changes=FURTHER, model=model, start=start)
    both = train_policy(f"{what}, randomised", own / LEARNT_BOTH, seed, changes=BOTH, model=model, start=wide)
    return {"corrected": row, "both": both}


def judge(cell: Cell, policies: Path, own: Path) -> dict[str, Any]:
    """Fly the same drone again with every policy.

    Returns:
        Policy name to `Trial.to_json`, and ``environment``.
    """
    say("flying the same drone again")
    files = {name: policies / name for name in ("nominal", "longer", "randomised")}
    files |= {"corrected": own / LEARNT, "both": own / LEARNT_BOTH}
    with jax.enable_x64(False):
        controllers = {name: load_policy(policy_file(folder)).controller for name, folder in files.items()}
        judged = fly_trials(cell.case, controllers, "nominal")
    jax.clear_caches()
    return {name: trial.to_json() for name, trial in judged.items()} | {"environment": environment()}
