"""Steps of a cell. Each step writes files to a folder, resumes after an interruption, and skips work already done.

The folder ``policies`` holds the policies shared by the cells of one seed, and ``own`` the files of one cell.

A cell is one drone, with one effect and one seed. Its policies are trained on the declared model, on randomised drones,
and further on the corrected model.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax

from cfb_mjx.commands.close_loop import CloseLoop
from cfb_mjx.control.policy_file import load_policy
from cfb_mjx.errors import CfbError
from cfb_mjx.files import write_json
from cfb_mjx.logs import write_mcap
from cfb_mjx.loop import flights, trials
from cfb_mjx.loop.flights import fly_campaign
from cfb_mjx.loop.trials import fly_trials
from cfb_mjx.reference_simulator import EFFECTS, PAIRED, Case
from cfb_mjx.runtime import Progress, environment, say
from cfb_mjx.train.config import load_config, with_changes
from cfb_mjx.train.run import POLICY, Training, train

FIRST_SEED, BETWEEN_SEEDS = 61_000, 100


@dataclass(frozen=True)
class Cell:
    """One drone.

    Attributes:
        effect: the effect that the declared model lacks.
        seed: seed of the policies; together with the position of the effect in the list, of all other random draws.
    """

    effect: str
    seed: int

    @property
    def name(self) -> str:
        """Name of the cell and of its folder."""
        return f"{self.effect}-{self.seed}"

    @property
    def case(self) -> Case:
        """The drone in the reference simulator."""
        return Case(self.name, self.seed + 1 + list(EFFECTS).index(self.effect), ((self.effect, 1.0),))


def cells_of(effects: Iterable[str], seeds: int, first: int = FIRST_SEED) -> list[Cell]:
    """Cells of all effects and seeds, ordered by seed, so that an unfinished study contains every effect.

    Args:
        effects: names of the effects; duplicates are dropped.
        seeds: number of seeds.
        first: the first seed.

    Raises:
        CfbError: an unknown effect, or no effect.
    """
    effects = list(dict.fromkeys(effects))
    # The policies fly alone.
    known = [name for name in EFFECTS if not name.startswith(("outside", "sensor", PAIRED))]
    if unknown := [name for name in effects if name not in known]:
        raise CfbError(f"--effects {unknown[0]}: there is no such effect; choose from {', '.join(known)}.")
    if not effects:
        raise CfbError(f"--effects: name at least one of {', '.join(known)}.")
    return [Cell(effect, first + BETWEEN_SEEDS * k) for k in range(seeds) for effect in effects]


CONFIG = "loop"
"""Name of the shipped configuration ``configs/loop.yaml``."""
FURTHER = ("analytic.updates=200", "analytic.learning_rate=1.0e-3")
"""Changes for further training on the corrected model and, for a fair comparison, on the declared model."""
RANDOMISED = ("randomisation.magnitude=1.0", "analytic.updates=700")
"""Changes for the randomised policy: the paper's spread, and as many updates as `CONFIG` and `FURTHER` together."""
BOTH = (*FURTHER, RANDOMISED[0])
"""Changes for further training of the randomised policy on the corrected model."""
DONE = "training.json"


def train_policy(
    what: str,
    folder: Path,
    seed: int,
    changes: tuple[str, ...] = (),
    model: Path | None = None,
    start: Path | None = None,
) -> dict[str, Any]:
    """Train a policy, or resume an interrupted training. A finished training is not repeated.

    Args:
        what: description of the training, for the terminal.
        folder: folder of this policy.
        seed: seed of all random draws.
        changes: changes to the configuration `CONFIG`.
        model: model file that replaces the declared model.
        start: policy file from which the training starts; None starts from random weights.

    Returns:
        The last row of the learning curve.
    """
    if (folder / DONE).exists():
        return json.loads((folder / DONE).read_text(encoding="utf-8"))
    say(f"training {what}")
    bar, facts = Progress(what), environment()
    versions = {name: facts[name] for name in ("cfb_mjx", "jax", "jaxlib", "python")}
    choices = {"seed": seed, "model": None if model is None else str(model)}
    training = Training.prepare(with_changes(load_config(CONFIG, changes), **choices), versions, start)
    with jax.enable_x64(False):
        rows = train(
            training,
            folder,
            resume=True,
            progress=lambda done, total, rate, left: bar(done, total, f"{left:.0f} s left"),
        )
    write_json(folder / DONE, rows[-1])
    return rows[-1]


def policy_file(folder: Path) -> Path:
    """File in which `train_policy` stores the policy."""
    return folder / POLICY


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
