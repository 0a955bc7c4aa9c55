"""The steps of a cell as they are, with what each leaves in its folder."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax

from cfb_mjx.control.policy_file import load_policy
from cfb_mjx.files import write_json
from cfb_mjx.logs import write_mcap
from cfb_mjx.loop import flights, policies, trials
from cfb_mjx.loop.flights import fly_campaign
from cfb_mjx.loop.policies import BOTH, FURTHER, RANDOMISED, policy_file, train_policy
from cfb_mjx.loop.study import Cell, Steps
from cfb_mjx.loop.trials import fly_trials
from cfb_mjx.train.config import load_config

FLOWN, CLOSED, LEARNT, LEARNT_BOTH = "flown.json", "closed", "corrected", "both"
KEPT = ("effects", "unexplained", "unexplained_because", "unconfirmed")
HELD_OUT = ("position_rmse_m@0.5s", "velocity_rmse_mps@0.5s", "attitude_rmse_deg@0.5s", "rate_rmse_radps@0.5s")

Close = Callable[[list[Path], list[Path], Path], None]
Watch = Callable[[str], policies.Progress]


def settings() -> dict[str, Any]:
    """What the results depend on beside effects and seeds."""
    names = ("FIT", "HELD_OUT", "SECONDS", "USUAL_SECONDS", "RAISE", "DITHER_OF_JUMPS", "GENTLER")
    tests = ("HEIGHT", "HOVERS", "HOVER_S", "SETTLING_S", "TRACKS", "TRACK_S", "ENTRY_S")
    eight = ("PERIOD_S", "WIDTH_M", "DEPTH_M", "RAMP_S")
    return {
        "config": load_config(policies.CONFIG).to_mapping(),
        "randomised": RANDOMISED,
        "further": FURTHER,
        "both": BOTH,
        "flights": {name: getattr(flights, name) for name in names},
        "trials": {name: getattr(trials, name) for name in (*tests, *eight)},
    }


def real_steps(facts: dict[str, str], close: Close, say: Callable[[str], None], watch: Watch) -> Steps:
    """The whole work.

    Args:
        facts: date, machine and versions.
        close: fit logs, held-out logs and folder: what ``cfb close-loop`` does with them.
        say: told what happens.
        watch: gives a training of a name its progress.
    """
    versions = {name: facts[name] for name in ("cfb_mjx", "jax", "jaxlib", "python")}

    def trained(what: str, folder: Path, seed: int, **options) -> dict[str, Any]:
        def begin():
            say(f"training {what}")
            return watch(what)

        return train_policy(folder, seed, versions, begin=begin, **options)

    def common(seed: int, folder: Path) -> dict[str, Any]:
        nominal = trained("on the declared model", folder / "nominal", seed)
        start = policy_file(folder / "nominal")
        rows = {"nominal": nominal}
        rows["randomised"] = trained("on randomised drones", folder / "randomised", seed, changes=RANDOMISED)
        rows["longer"] = trained("longer on the declared model", folder / "longer", seed, changes=FURTHER, start=start)
        return rows

    def fly(cell: Cell, shared: Path, own: Path) -> dict[str, Any]:
        return _flown(cell, shared, own, say)

    def closed(own: Path) -> dict[str, Any]:
        report, began = own / CLOSED / "report.json", time.perf_counter()
        if not report.exists():
            close(*(sorted((own / "flights" / side).glob("*.mcap")) for side in ("fit", "held-out")), own / CLOSED)
            # Programs of every shape met would pile up until the process may map no more memory.
            jax.clear_caches()
        found = json.loads(report.read_text(encoding="utf-8"))
        errors = {when: {key: found["held_out"][when][key] for key in HELD_OUT} for when in ("before", "after")}
        return {key: found[key] for key in KEPT} | {"held_out": errors, "seconds": time.perf_counter() - began}

    def learn(cell: Cell, shared: Path, own: Path) -> dict[str, Any]:
        model, seed = own / CLOSED / "model.yaml", cell.seed
        start, wide = (policy_file(shared / name) for name in ("nominal", "randomised"))
        what = "on the corrected model"
        row = trained(what, own / LEARNT, seed, changes=FURTHER, model=model, start=start)
        both = trained(f"{what}, randomised", own / LEARNT_BOTH, seed, changes=BOTH, model=model, start=wide)
        return {"corrected": row, "both": both}

    def judge(cell: Cell, shared: Path, own: Path) -> dict[str, Any]:
        say("flying the same drone again")
        files = {name: shared / name for name in ("nominal", "longer", "randomised")}
        files |= {"corrected": own / LEARNT, "both": own / LEARNT_BOTH}
        with jax.enable_x64(False):
            controllers = {name: load_policy(policy_file(folder)).controller for name, folder in files.items()}
            judged = fly_trials(cell.case, controllers, "nominal")
        jax.clear_caches()
        return {name: trial.to_json() for name, trial in judged.items()} | {"environment": facts}

    return Steps(common, fly, closed, learn, judge)


def _flown(cell: Cell, shared: Path, own: Path, say: Callable[[str], None]) -> dict[str, Any]:
    """Fly and write the logs; `FLOWN`, written last, says that all are there."""
    if (own / FLOWN).exists():
        return json.loads((own / FLOWN).read_text(encoding="utf-8"))
    with jax.enable_x64(False):
        campaign = fly_campaign(cell.case, load_policy(policy_file(shared / "nominal")).controller, progress=say)
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
