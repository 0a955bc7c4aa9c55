"""Run the trainings of a study one after the other, and keep finished ones, so that an interrupted study continues."""

import argparse
import json
import math
import shutil
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

from cfb_mjx.runtime import configure_jax, environment, say

ROOT = Path(__file__).resolve().parents[1]


@dataclass(frozen=True)
class Run:
    """One training: ``name`` is unique in its study; ``changes`` as for ``cfb train --set``."""

    name: str
    config: str
    changes: tuple[str, ...]
    seed: int


def study_arguments(description: str, option: str, choices: Iterable[str], **flags: str) -> argparse.Namespace:
    """Parse the command line of a study, and configure jax for it.

    Args:
        description: help text of the study.
        option: name of the option that selects from ``choices``.
        choices: variants that the study compares.
        flags: further switches of this study, name to help text.
    """
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(option, nargs="+", choices=list(choices), default=list(choices), dest="chosen")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--page-only", action="store_true", help="write the page from the stored results")
    for name, text in flags.items():
        parser.add_argument(f"--{name.replace('_', '-')}", action="store_true", help=text)
    arguments = parser.parse_args()
    configure_jax(x64=False)
    return arguments


def carry_out(runs: list[Run], results: Path, folder: Path, judge, kept: Path | None = None) -> None:
    """Train and score the runs that ``results`` does not have yet.

    Args:
        runs: runs of the study, in order.
        results: JSON file, written after every run: name to seed, score, curve, config and environment.
        folder: folder for checkpoints and policies.
        judge: function from a controller to its score.
        kept: folder that the policies are copied to, under the names of their runs.
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
        say(f"{run.name} ({sum(r.name in found for r in runs)} of {len(runs)} done)")
        training = Training.prepare(config, facts)
        rows = train(training, folder / run.name, resume=True, report=report)
        score = judge(load_policy(folder / run.name / POLICY).controller)
        if kept:
            kept.mkdir(parents=True, exist_ok=True)
            shutil.copy(folder / run.name / POLICY, kept / f"{run.name}.npz")
        found[run.name] = {
            "seed": run.seed,
            "score": score,
            "curve": rows,
            "config": described,
            "environment": facts,
        }
        write_json(results, found)


def _what_counts(config: dict) -> dict:
    """Return a configuration without its description and the settings of the unused algorithm.

    Settings that did not exist when the result was stored get their defaults.
    """
    from cfb_mjx.train.config import config_from

    whole = config_from(config, "a stored result").to_mapping()
    other = {"ppo": "analytic", "analytic": "ppo"}[config["algorithm"]]
    return json.loads(json.dumps({k: v for k, v in whole.items() if k not in (other, "description")}))


def report(row: dict) -> None:
    """Print one row of a learning curve."""
    say(f"  {row['commands'] / 1e6:.3g} M commands, {row['seconds']:.0f} s, hover {row['hover_mm']:.4g} mm")


def facts_line(command: str, results: list[dict], did: str = "trained") -> str:
    """Say which command wrote a page, and when and on which machine and versions it ``did`` its work."""
    facts = [result["environment"] for result in results]
    first, last = min(f["date"] for f in facts), max(f["date"] for f in facts)
    when = first if first == last else f"{first} to {last}"
    of = {name: " and ".join(dict.fromkeys(f[name] for f in facts)) for name in facts[0]}
    return (
        f"Written by `{command}`; {did} {when}, {of['processor']}, Python {of['python']}, "
        f"jax {of['jax']}, cfb_mjx {of['cfb_mjx']}."
    )


def measured_on(parts: Mapping[str, dict[str, str]]) -> str:
    """Say when, on which machine and with which versions the parts of a page were measured.

    Args:
        parts: environment (`cfb_mjx.runtime.environment`) of each part, by its name.

    Returns:
        What all parts have in common; then, if they differ, what is special of each.
    """
    common = dict.fromkeys(item for facts in parts.values() for item in facts.items())
    common = [item for item in common if all(item in facts.items() for facts in parts.values())]
    groups: dict[str, list[str]] = {}
    for name, facts in parts.items():
        own = ", ".join(f"{key} {value}" for key, value in facts.items() if (key, value) not in common)
        groups.setdefault(own, []).append(name)
    text = [", ".join(f"{key} {value}" for key, value in common)] if common else []
    return "; ".join(text + [f"{', '.join(names)}: {own}" for own, names in groups.items() if own])


def moved(before: dict, now: dict, pick: Callable[[dict], dict[str, float]], share: float = 0.05) -> list[str]:
    """Return a page's section on the numbers that differ from those of an earlier run, as Markdown lines.

    Args:
        before: results of the earlier run, with their ``environment``.
        now: results of this run.
        pick: function from results to the numbers to compare, by name.
        share: least relative difference that is listed.
    """
    # A number that is not finite is null in the file.
    old, new = ({k: math.inf if x is None else x for k, x in pick(which).items()} for which in (before, now))
    rows = [
        f"| {name} | {old[name]:.4g} | {value:.4g} |"
        for name, value in new.items()
        if name in old and not math.isclose(value, old[name], rel_tol=share, abs_tol=1e-9)
    ]
    alike = sum(name in old for name in new) - len(rows)
    date = before["environment"]["date"]
    text = f"Compared with {date}, {len(rows)} of {alike + len(rows)} numbers differ by more than {share:.0%}."
    head = ["", f"| number | {date} | now |", "|---|---:|---:|"]
    return ["", "## What changed", "", text, *(head + rows if rows else [])]
