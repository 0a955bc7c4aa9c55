"""Trainings of a study, one after the other: what is done is kept, so that an interrupted study goes on."""

import argparse
import json
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from cfb_mjx.cli.runtime import configure_jax, environment, say

ROOT = Path(__file__).resolve().parents[1]
FLIGHTS, RANDOM_DRONES = 64, 512
PAPER = {0.0: (284.76, 0.0203), 0.5: (100.07, 0.0245), 1.0: (43.16, 0.0197), 1.5: (71.39, 0.0548)}
PAPER_FIRMWARE = {"pid": (27.81, 0.0226), "mellinger": (54.68, 0.0394)}
"""The paper's hover tests on its real drone, networks by magnitude: mean distance in mm, command std."""


@dataclass(frozen=True)
class Run:
    """One training: ``name`` is unique in its study; ``changes`` as for ``cfb train --set``."""

    name: str
    config: str
    changes: tuple[str, ...]
    seed: int


def study_arguments(description: str, option: str, choices: Iterable[str]) -> argparse.Namespace:
    """Read a study's command line: which of ``choices`` to run, how many seeds, or only the page; set jax up for it."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(option, nargs="+", choices=list(choices), default=list(choices), dest="chosen")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--page-only", action="store_true", help="write the page from the results that are there")
    arguments = parser.parse_args()
    configure_jax(x64=False)
    return arguments


def carry_out(runs: list[Run], results: Path, folder: Path, judge) -> None:
    """Train what ``results`` does not hold yet, and judge it.

    Args:
        runs: of the study, in order.
        results: JSON file that grows with every run: name to seed, score, curve, config and environment.
        folder: for checkpoints and policies.
        judge: controller to numbers.
    """
    from cfb_mjx.control.policy_file import load_policy
    from cfb_mjx.files import write_json
    from cfb_mjx.train.config import load_config, with_changes
    from cfb_mjx.train.run import POLICY, Training, train

    found = json.loads(results.read_text()) if results.exists() else {}
    facts = environment()
    for run in runs:
        config = with_changes(load_config(run.config, run.changes), seed=run.seed)
        described = config.to_mapping()
        if run.name in found and _what_counts(found[run.name]["config"]) == _what_counts(described):
            continue
        say(f"{run.name} ({len(found)} of {len(runs)} done)")
        training = Training.prepare(config, facts)
        rows = train(training, folder / run.name, resume=True, report=_report)
        score = judge(load_policy(folder / run.name / POLICY).controller)
        found[run.name] = {
            "seed": run.seed,
            "score": score,
            "curve": rows,
            "config": described,
            "environment": facts,
        }
        write_json(results, found)


def _what_counts(config: dict) -> dict:
    """Without the settings of the algorithm that is not used; what did not exist yet then is as it is by default."""
    from cfb_mjx.train.config import config_from

    whole = config_from(config, "a stored result").to_mapping()
    other = {"ppo": "analytic", "analytic": "ppo"}[config["algorithm"]]
    return json.loads(json.dumps({k: v for k, v in whole.items() if k not in (other, "description")}))


def _report(row: dict) -> None:
    say(f"  {row['commands'] / 1e6:.3g} M commands, {row['seconds']:.0f} s, hover {row['hover_mm']:.4g} mm")


class Judge:
    """Flies a controller on the nominal drone, on randomised ones and on a set of others."""

    def __init__(self, plants: str | None = "off-nominal", random_drones: int = RANDOM_DRONES):
        import jax

        from cfb_mjx.envs import TargetTask
        from cfb_mjx.model import Quadrotor
        from cfb_mjx.parameters import load_model_file, load_randomisation
        from cfb_mjx.train.plants import load_plants

        self.described = load_model_file("cfb-guards")
        self.nominal = Quadrotor.from_file(self.described)
        self.plants = {} if plants is None else load_plants(self.described, plants)
        self.calm, self.wild = TargetTask(), TargetTask(randomisation=load_randomisation("paper"))
        self.few = jax.random.split(jax.random.PRNGKey(0), FLIGHTS)
        self.many = jax.random.split(jax.random.PRNGKey(1), random_drones)

    def __call__(self, pilot) -> dict:
        """Hover error and command std of any pilot."""
        import numpy as np

        from cfb_mjx.train.flying import hover

        def measure(task, drone, keys, kind):
            measured = hover(pilot, task, drone, keys)[0]
            well = ~np.asarray(measured.failed)
            distance, std = np.asarray(measured.mean_distance_m)[well], np.asarray(measured.command_std)[well]
            return {
                "hover_mm": float(1e3 * kind(distance)) if well.any() else None,
                "command_std": float(kind(std)) if well.any() else None,
                "failed": float(1 - well.mean()),
            }

        score = {"nominal": measure(self.calm, self.nominal, self.few, np.mean)}
        if len(self.many):
            score["random"] = measure(self.wild, self.nominal, self.many, np.median)
        return score | {
            "plants": {name: measure(self.calm, drone, self.few, np.mean) for name, drone in self.plants.items()}
        }


def facts_line(command: str, results: list[dict]) -> str:
    """Which command wrote a page, when and on what."""
    facts = [result["environment"] for result in results]
    first, last = min(f["date"] for f in facts), max(f["date"] for f in facts)
    when = first if first == last else f"{first} to {last}"
    of = facts[-1]
    return (
        f"Written by `{command}`; trained {when}, {of['processor']}, Python {of['python']}, "
        f"jax {of['jax']}, cfb_mjx {of['cfb_mjx']}."
    )
