"""Repeat the paper's study of the magnitude of randomisation in simulation, with PPO and with back-propagation.

    python scripts/study_magnitudes.py [--algorithms analytic ppo ppo-long] [--seeds 3] [--judge-anew | --page-only]

The whole study takes hours. Finished trainings are kept in benchmarks/magnitudes-ALGORITHM.json and data/study, so an
interrupted run continues. Writes docs/magnitudes.md and its figure.
"""

import json
import math
from dataclasses import dataclass
from pathlib import Path

from campaign import ROOT, Run, carry_out, facts_line, study_arguments

from cfb_mjx.reproduce.controllers import PAPER_FIRMWARE, PAPER_HOVER
from cfb_mjx.train.judge import away

MAGNITUDES = (0.0, 0.5, 1.0, 1.5)


@dataclass(frozen=True)
class Trained:
    """An algorithm of the study, with the configuration that all magnitudes share."""

    title: str
    config: str
    changes: tuple[str, ...] = ()
    most_seeds: int | None = None


ALGORITHMS = {
    "analytic": Trained("back-propagation", "study-analytic"),
    "ppo": Trained("PPO", "study-ppo"),
    "ppo-long": Trained("PPO, as long as `target`", "study-ppo", ("ppo.steps=200000000", "checkpoints=20"), 1),
}
ELSEWHERE = "cfb-idsia"
OTHERS = (*PAPER_FIRMWARE, "target", "target-analytic")
"""Controllers that the same tests compare: the firmware's, and shipped policies trained longer."""


def main() -> None:
    """Train the missing policies, evaluate them and write the page."""
    arguments = study_arguments(
        __doc__, "--algorithms", ALGORITHMS, judge_anew="evaluate the stored policies again, without training"
    )
    from cfb_mjx.files import write_json, write_text

    others = ROOT / "benchmarks" / "magnitudes-others.json"
    if not arguments.page_only:
        judged = judge()
        if arguments.judge_anew or not others.exists():
            write_json(others, {name: judged(name) for name in OTHERS})
        for algorithm in arguments.chosen:
            kept, results, by = ROOT / "data" / "study" / algorithm, _results(algorithm), ALGORITHMS[algorithm]
            if arguments.judge_anew:
                if not results.exists():
                    continue
                found = json.loads(results.read_text())
                write_json(results, {n: run | {"score": judged(kept / f"{n}.npz")} for n, run in found.items()})
                continue
            # Seed by seed, so that an unfinished study covers every magnitude.
            runs = [
                Run(f"{m:g}-{seed}", by.config, (f"randomisation.magnitude={m}", *by.changes), seed)
                for seed in range(min(arguments.seeds, by.most_seeds or arguments.seeds))
                for m in MAGNITUDES
            ]
            trained = ROOT / "out" / "magnitudes" / algorithm
            carry_out(runs, results, trained, judged, kept)
    found = {a: json.loads(_results(a).read_text()) for a in ALGORITHMS if _results(a).exists()}
    from cfb_mjx.view.magnitudes import magnitudes_figure

    runs = {ALGORITHMS[a].title: {m: _of(_scores(of, m)) for m in MAGNITUDES} for a, of in found.items()}
    magnitudes_figure(runs, PAPER_HOVER, ROOT / "docs" / "magnitudes.png")
    write_text(ROOT / "docs" / "magnitudes.md", page(found, json.loads(others.read_text())))
    print("docs/magnitudes.md, docs/magnitudes.png")


def judge():
    """Return the function that scores a controller, or the file or name of one.

    It scores on the nominal, randomised and off-nominal drones, and on the drone of `ELSEWHERE`.
    """
    import numpy as np

    from cfb_mjx.control.controllers import find_controller
    from cfb_mjx.model import Quadrotor
    from cfb_mjx.train.flying import hover
    from cfb_mjx.train.judge import Judge, summary

    drones = Judge()
    elsewhere = Quadrotor.from_file(ELSEWHERE)

    def score(of) -> dict:
        controller = find_controller(of, drones.nominal) if isinstance(of, str | Path) else of
        there = summary(hover(controller, drones.calm, elsewhere, drones.few)[0], np.mean)
        return drones(controller) | {ELSEWHERE: there}

    return score


def _results(algorithm: str):
    return ROOT / "benchmarks" / f"magnitudes-{algorithm}.json"


def _scores(runs: dict, magnitude: float) -> list[dict]:
    return [run["score"] for name, run in runs.items() if name.rpartition("-")[0] == f"{magnitude:g}"]


APART = {
    "nominal": lambda score, key: score["nominal"][key],
    "off-nominal": lambda score, key: away(score, key),
    ELSEWHERE: lambda score, key: None if score[ELSEWHERE]["failed"] else score[ELSEWHERE][key],
    "randomised": lambda score, key: score["random"][key],
}


def _of(scores: list[dict]) -> dict[str, list]:
    return {
        "nominal": [s["nominal"]["hover_mm"] for s in scores],
        "nominal_std": [s["nominal"]["command_std"] for s in scores],
        "away": [away(s, "hover_mm") for s in scores],
        "away_std": [away(s, "command_std") for s in scores],
        "random": [s["random"]["hover_mm"] for s in scores],
        **{
            f"{where} {axes}": [pick(s, f"{axes}_mm") for s in scores]
            for where, pick in APART.items()
            for axes in ("horizontal", "vertical")
        },
        "random_failed": [s["random"]["failed"] for s in scores],
    }


def _span(values: list, digits: str) -> str:
    """Format the mean, least and greatest value of the seeds."""
    there = [v for v in values if v is not None]
    lost = f", {len(values) - len(there)} failed" if len(there) < len(values) else ""
    if not there:
        return "failed"
    if len(there) == 1:
        return format(there[0], digits) + lost
    mean = format(sum(there) / len(there), digits)
    return f"{mean} [{format(min(there), digits)}, {format(max(there), digits)}]{lost}"


def _best(runs: dict, key: str) -> str:
    """Format the magnitude with the least error: for the mean of the seeds, and in brackets for each seed."""
    best, each = _ranked(runs, key)
    return f"{best:g} ({', '.join(f'{m:g}' for m in each)})"


def _ranked(runs: dict, key: str) -> tuple[float, list[float]]:
    errors = {m: _of(_scores(runs, m))[key] for m in MAGNITUDES if _scores(runs, m)}
    # A failure ranks behind any error.
    errors = {m: [math.inf if v is None else v for v in values] for m, values in errors.items()}
    best = min(errors, key=lambda m: sum(errors[m]) / len(errors[m]))
    each = zip(*errors.values(), strict=False)
    return best, [list(errors)[values.index(min(values))] for values in each]


def _agreement(runs: dict) -> str:
    """Say whether magnitude 1 is best on off-nominal drones, as on the paper's real drone."""
    said = []
    for words, key in (
        ("mean distance", "away"),
        ("horizontal error", "off-nominal horizontal"),
        ("vertical error", "off-nominal vertical"),
    ):
        best, each = _ranked(runs, key)
        said.append(f"{words} {best:g} ({', '.join(f'{m:g}' for m in each)} by seed)")
    agrees = [_ranked(runs, key)[0] == 1.0 for key in ("away", "off-nominal horizontal", "off-nominal vertical")]
    verdict = "agrees with" if all(agrees) else "does not agree with" if not any(agrees) else "agrees in part with"
    best = f"Best magnitude on off-nominal drones: {'; '.join(said)}."
    return f"{best} On the paper's real drone it is 1: the simulation {verdict} it."


def _apart(runs: dict) -> list[str]:
    """Table of the horizontal and vertical error by magnitude, and of the best magnitude for each."""
    columns = [f"{where} {axes}" for where in APART for axes in ("horizontal", "vertical")]
    lines = [
        "",
        "Horizontal error (distance from the vertical through the target, xy) and vertical error (z), mm:",
        "",
        "| magnitude | "
        + " | ".join(f"{column.replace('horizontal', 'xy').replace('vertical', 'z')}" for column in columns)
        + " |",
        "|---|" + "---|" * len(columns),
    ]
    for magnitude in MAGNITUDES:
        if scores := _scores(runs, magnitude):
            of = _of(scores)
            lines.append(f"| {magnitude:g} | " + " | ".join(_span(of[column], ".1f") for column in columns) + " |")
    best = [_best(runs, column) for column in columns]
    return [*lines, "| **best** (by seed) | " + " | ".join(best) + " |"]


def _settled(runs: dict) -> list[str]:
    """Say how much the hover error still fell in the second half of each training."""
    changes = {}
    for name, run in runs.items():
        on, key = "randomised drones", "random_mm"
        if key not in run["curve"][-1]:
            on, key = "the nominal drone", "hover_mm"
        half, end = run["curve"][len(run["curve"]) // 2 - 1][key], run["curve"][-1][key]
        changes.setdefault(f"magnitude {name.rpartition('-')[0]} (on {on})", []).append(f"{half:.0f} to {end:.0f}")
    told = "; ".join(f"{which}: {', '.join(texts)}" for which, texts in sorted(changes.items()))
    text = "Convergence: hover error in the middle and at the end of each training, mm (randomised drones have the "
    return ["", f"{text}training's own magnitude). {told[0].upper()}{told[1:]}."]


def page(found: dict, others: dict) -> str:
    """The Markdown page."""
    runs = [run for algorithm in found.values() for run in algorithm.values()]
    lines = [
        "# How much randomisation to use",
        "",
        "This page is for users who choose the magnitude of the randomisation for their own training:",
        "",
        "```sh",
        "cfb train target --set randomisation.magnitude=0.5 -o out/half",
        "```",
        "",
        facts_line("python scripts/study_magnitudes.py", runs),
        "",
        "The paper trains its position controller with its randomisation scaled by 0, 0.5, 1 and 1.5, flies each on "
        "the real drone, and finds 1 best. Here networks of the same shape are trained and tested in simulation:",
        "",
        "- on the nominal drone;",
        "- on ten off-nominal drones with effects that no randomisation contains (`configs/plants/off-nominal.yaml`); "
        "they take the place of the real drone;",
        "- on 512 drones of the paper's full randomisation;",
        f"- on a drone that another laboratory identified (`{ELSEWHERE}`).",
        "",
        "The test is the paper's hover test: mean distance over the last 5 of 6 s, and the standard deviation of the "
        "commands (std). Cells give the mean of the seeds [least, greatest]. Values on randomised drones are medians "
        "over those that did not fail. The paper's columns are its real flights.",
        "",
        "![hover error over magnitude](magnitudes.png)",
    ]
    for algorithm, of in found.items():
        any_run = next(iter(of.values()))
        last = any_run["curve"][-1]
        lines += [
            "",
            f"## {ALGORITHMS[algorithm].title}",
            "",
            f"Configuration `{' '.join((ALGORITHMS[algorithm].config, *ALGORITHMS[algorithm].changes))}`: "
            f"{last['commands'] / 1e6:.0f} M commands per policy, training time "
            f"{min(r['curve'][-1]['seconds'] for r in of.values()):.0f} to "
            f"{max(r['curve'][-1]['seconds'] for r in of.values()):.0f} s.",
            "",
            "| magnitude | seeds | nominal, mm | std | off-nominal, mm | std | randomised, mm | failed | paper, mm "
            "| paper, std |",
            "|---|---|---|---|---|---|---|---|---|---|",
        ]
        for magnitude in MAGNITUDES:
            scores = _scores(of, magnitude)
            if not scores:
                continue
            s = _of(scores)
            cells = [f"{magnitude:g}", str(len(scores)), _span(s["nominal"], ".1f"), _span(s["nominal_std"], ".4f")]
            cells += [_span(s["away"], ".1f"), _span(s["away_std"], ".4f"), _span(s["random"], ".0f")]
            cells += [_span(s["random_failed"], ".2%"), *(f"{x:g}" for x in PAPER_HOVER[magnitude])]
            lines.append("| " + " | ".join(cells) + " |")
        lines += [
            "",
            _agreement(of),
            *_apart(of),
            *_settled(of),
        ]
    lines += [
        "",
        "## Other controllers, same tests",
        "",
        "The firmware's controllers and two shipped policies: `target`, trained by PPO at magnitude 1, longer and in "
        "two parts, and `target-analytic`, trained by back-propagation ([controllers](controllers.md)).",
        "",
        "| controller | nominal, mm | std | off-nominal, mm | xy | z | std | randomised, mm | failed | paper, mm "
        "| paper, std |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for name, score in others.items():
        s = _of([score])
        cells = [name, _span(s["nominal"], ".1f"), _span(s["nominal_std"], ".4f"), _span(s["away"], ".1f")]
        cells += [_span(s[f"off-nominal {axes}"], ".1f") for axes in ("horizontal", "vertical")]
        cells += [_span(s["away_std"], ".4f"), _span(s["random"], ".0f"), _span(s["random_failed"], ".2%")]
        paper = [f"{x:g}" for x in PAPER_FIRMWARE.get(name, ())] or ["", ""]
        lines.append("| " + " | ".join([*cells, *paper]) + " |")
    for algorithm, of in found.items():
        plants = list(next(iter(of.values()))["score"]["plants"])
        lines += [
            "",
            f"## {ALGORITHMS[algorithm].title}, drone by drone",
            "",
            "Hover error, mm: mean of the seeds [least, greatest].",
            "",
            "| drone | " + " | ".join(f"x {m:g}" for m in MAGNITUDES if _scores(of, m)) + " |",
            "|---|" + "---|" * sum(bool(_scores(of, m)) for m in MAGNITUDES),
        ]
        for plant in plants:
            cells = [
                _span([None if s["plants"][plant]["failed"] else s["plants"][plant]["hover_mm"] for s in scores], ".0f")
                for scores in (_scores(of, m) for m in MAGNITUDES)
                if scores
            ]
            lines.append(f"| {plant} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
