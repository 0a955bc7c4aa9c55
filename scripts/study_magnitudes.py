"""How much randomisation? The paper's study, in simulation, with PPO and with back-propagation.

    python scripts/study_magnitudes.py [--algorithms analytic ppo] [--seeds 3] [--page-only]

Hours for all of it; what is done is kept in benchmarks/magnitudes-ALGORITHM.json, and a run begun anew goes on. Writes
docs/magnitudes.md and its figure.
"""

import json
import math

from campaign import ROOT, Run, carry_out, facts_line, study_arguments

from cfb_mjx.reproduce.paper import PAPER_FIRMWARE, PAPER_HOVER

MAGNITUDES = (0.0, 0.5, 1.0, 1.5)
CONFIGS = {"analytic": "study-analytic", "ppo": "study-ppo"}
TITLES = {"analytic": "back-propagation", "ppo": "PPO"}


def main() -> None:
    """Train what is missing, judge, write."""
    arguments = study_arguments(__doc__, "--algorithms", CONFIGS)
    from cfb_mjx.files import write_json, write_text

    firmware = ROOT / "benchmarks" / "magnitudes-firmware.json"
    if not arguments.page_only:
        from cfb_mjx.train.judge import Judge

        judge = Judge()
        if not firmware.exists():
            from cfb_mjx.control.pilot import find_pilot

            write_json(firmware, {name: judge(find_pilot(name, judge.nominal)) for name in PAPER_FIRMWARE})
        for algorithm in arguments.chosen:
            # By seed, so that an unfinished study has every magnitude.
            runs = [
                Run(f"{m:g}-{seed}", CONFIGS[algorithm], (f"randomisation.magnitude={m}",), seed)
                for seed in range(arguments.seeds)
                for m in MAGNITUDES
            ]
            carry_out(runs, _results(algorithm), ROOT / "out" / "magnitudes" / algorithm, judge)
    found = {a: json.loads(_results(a).read_text()) for a in CONFIGS if _results(a).exists()}
    from cfb_mjx.view.magnitudes import magnitudes_figure

    runs = {TITLES[a]: {m: _of(_scores(of, m)) for m in MAGNITUDES} for a, of in found.items()}
    magnitudes_figure(runs, PAPER_HOVER, ROOT / "docs" / "magnitudes.png")
    write_text(ROOT / "docs" / "magnitudes.md", page(found, json.loads(firmware.read_text())))
    print("docs/magnitudes.md, docs/magnitudes.png")


def _results(algorithm: str):
    return ROOT / "benchmarks" / f"magnitudes-{algorithm}.json"


def _scores(runs: dict, magnitude: float) -> list[dict]:
    return [run["score"] for name, run in runs.items() if name.rpartition("-")[0] == f"{magnitude:g}"]


def _of(scores: list[dict]) -> dict[str, list]:
    from cfb_mjx.train.judge import away

    return {
        "nominal": [s["nominal"]["hover_mm"] for s in scores],
        "nominal_std": [s["nominal"]["command_std"] for s in scores],
        "away": [away(s, "hover_mm") for s in scores],
        "away_std": [away(s, "command_std") for s in scores],
        "random": [s["random"]["hover_mm"] for s in scores],
        "random_failed": [s["random"]["failed"] for s in scores],
    }


def _span(values: list, digits: str) -> str:
    """Mean of the seeds, and the least and greatest of them."""
    there = [v for v in values if v is not None]
    lost = f", {len(values) - len(there)} lost" if len(there) < len(values) else ""
    if not there:
        return "lost"
    if len(there) == 1:
        return format(there[0], digits) + lost
    mean = format(sum(there) / len(there), digits)
    return f"{mean} [{format(min(there), digits)}, {format(max(there), digits)}]{lost}"


def _best(runs: dict) -> list[str]:
    """Which magnitude holds the off-nominal drones best: on the mean of the seeds, and seed by seed."""
    away = {m: _of(_scores(runs, m))["away"] for m in MAGNITUDES if _scores(runs, m)}
    # Who loses a drone is worse than who keeps it badly.
    away = {m: [math.inf if v is None else v for v in values] for m, values in away.items()}
    best = min(away, key=lambda m: sum(away[m]) / len(away[m]))
    each = zip(*(away[m] for m in away), strict=False)
    seeds = ", ".join(f"{list(away)[values.index(min(values))]:g}" for values in each)
    return [
        f"Off-nominal drones are held best with magnitude {best:g} (seed by seed: {seeds}; the paper's real one: 1)."
    ]


def page(found: dict, firmware: dict) -> str:
    """The Markdown page."""
    runs = [run for algorithm in found.values() for run in algorithm.values()]
    lines = [
        "# How much randomisation",
        "",
        facts_line("python scripts/study_magnitudes.py", runs),
        "",
        "The paper trains its position controller with its randomisation scaled by 0, 0.5, 1 and 1.5, flies each on "
        "the real drone, and finds 1 best. Here the same networks fly in simulation: on the nominal drone, on ten "
        "drones with effects of the catalogue that no randomisation contains (`configs/plants/off-nominal.yaml`; they "
        "stand in for the real one), and on 512 drones of the paper's full randomisation. Hover test of the paper: "
        "mean distance over the last 5 of 6 s, std of the commands. Mean of the seeds with the least and the greatest; "
        "over randomised drones the median of those that did not fail. The paper's columns are its real flights.",
        "",
        "![hover error over magnitude](magnitudes.png)",
    ]
    for algorithm, of in found.items():
        any_run = next(iter(of.values()))
        last = any_run["curve"][-1]
        lines += [
            "",
            f"## {TITLES[algorithm]}",
            "",
            f"Configuration `{CONFIGS[algorithm]}`: {last['commands'] / 1e6:.0f} M commands per policy, "
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
        lines += ["", *_best(of)]
        if "reward" in last:
            curves = [[row["reward"] for row in run["curve"]] for run in of.values()]
            gain = [curve[-1] - curve[len(curve) // 2] for curve in curves]
            lines += [
                "",
                f"From the middle of the trainings to their ends rewards changed by {min(gain):+.3f} to "
                f"{max(gain):+.3f} per command: where they still rise, errors tell how far learning has come as much "
                "as what the randomisation is worth.",
            ]
    lines += [
        "",
        "## The firmware's controllers, same tests",
        "",
        "| controller | nominal, mm | std | off-nominal, mm | std | randomised, mm | failed | paper, mm | paper, std |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for name, paper in PAPER_FIRMWARE.items():
        s = _of([firmware[name]])
        cells = [name, _span(s["nominal"], ".1f"), _span(s["nominal_std"], ".4f"), _span(s["away"], ".1f")]
        cells += [_span(s["away_std"], ".4f"), _span(s["random"], ".0f"), _span(s["random_failed"], ".2%")]
        lines.append("| " + " | ".join([*cells, *(f"{x:g}" for x in paper)]) + " |")
    for algorithm, of in found.items():
        plants = list(next(iter(of.values()))["score"]["plants"])
        lines += [
            "",
            f"## {TITLES[algorithm]}, drone by drone",
            "",
            "Hover error in mm, mean of the seeds with the least and the greatest.",
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
