"""What each choice in the training is worth: learning curves of variants, three seeds each.

    python scripts/learning_curves.py [--seeds 3] [--only VARIANT ...] [--page-only]

Judged on the nominal drone, and but for `ppo-random` trained on it alone: there the time to a hover error says most.
What is done is kept in benchmarks/learning-curves.json, and a run begun anew goes on. Writes docs/learning-curves.md
and its figure.
"""

import json
import statistics

from campaign import ROOT, Run, carry_out, facts_line, study_arguments

NOMINAL = ("randomisation.magnitude=0", "randomisation.graded=0.0")
PPO = (*NOMINAL, "ppo.steps=16000000", "checkpoints=16")
QUICK = (*NOMINAL, "checkpoints=16")
RANDOM = ("ppo.steps=16000000", "checkpoints=16")
UNLIMITED = (*PPO, "ppo.advantage_limit=1e9")
VARIANTS = {
    "analytic": ("quick-analytic", QUICK, "back-propagation, horizon 1 s"),
    "ppo": ("target", PPO, "PPO as in `target`"),
    "ppo-unlimited": ("target", UNLIMITED, "advantages not limited"),
    "ppo-lambda": ("target", (*UNLIMITED, "ppo.gae_lambda=0.95"), "not limited, gae_lambda 0.95"),
    "ppo-random": ("target", RANDOM, "the paper's randomisation"),
    "ppo-random-unlimited": ("target", (*RANDOM, "ppo.advantage_limit=1e9"), "the same, not limited"),
    "ppo-random-detrended": (
        "target",
        (*RANDOM, "ppo.detrended=true", "ppo.gae_lambda=0.97"),
        "the paper's randomisation, `detrended`, gae_lambda 0.97",
    ),
    "ppo-rare": (
        "target",
        (*UNLIMITED, "ppo.drones=2048"),
        "not limited, drones x 4, updates / 4",
    ),
}
MARKS_MM = (100, 50, 25)


def main() -> None:
    """Train what is missing, write."""
    arguments = study_arguments(__doc__, "--only", VARIANTS)
    from cfb_mjx.files import write_text

    results = ROOT / "benchmarks" / "learning-curves.json"
    if not arguments.page_only:
        runs = [
            Run(f"{name}-{seed}", *VARIANTS[name][:2], seed)
            for seed in range(arguments.seeds)
            for name in arguments.chosen
        ]
        from cfb_mjx.train.judge import Judge

        carry_out(runs, results, ROOT / "out" / "learning-curves", Judge(plants=None, random_drones=0))
    found = {}
    for key, run in json.loads(results.read_text()).items():
        found.setdefault(key.rpartition("-")[0], []).append(run)
    found = {name: found[name] for name in VARIANTS if name in found}
    figure(found, ROOT / "docs" / "learning-curves.png")
    write_text(ROOT / "docs" / "learning-curves.md", page(found))
    print("docs/learning-curves.md, docs/learning-curves.png")


def _reached(run: dict, mark: float) -> tuple[float, float] | None:
    """Seconds and millions of commands at the first point of the curve from which it stays below ``mark``."""
    stays = None
    for row in run["curve"]:
        if row["hover_mm"] > mark:
            stays = None
        elif stays is None:
            stays = row["seconds"], row["commands"] / 1e6
    return stays


def _cell(runs: list[dict], mark: float) -> str:
    there = [reached for reached in (_reached(run, mark) for run in runs) if reached is not None]
    if not there:
        return "not"
    seconds, commands = (statistics.median(x) for x in zip(*there, strict=True))
    lost = f" ({len(there)} of {len(runs)})" if len(there) < len(runs) else ""
    return f"{seconds:.0f} s, {commands:.1f} M{lost}"


def page(found: dict[str, list[dict]]) -> str:
    """The Markdown page."""
    lines = [
        "# Learning curves",
        "",
        facts_line("python scripts/learning_curves.py", [run for runs in found.values() for run in runs]),
        "",
        "From random weights, on the nominal drone but for `ppo-random`; hover error there by the paper's test (mean "
        "of 64 flights with noise). "
        "Time is that of the updates, compiling the first included, judging not, on a machine that did other things "
        "beside. Reached: the first point of the curve from which it stays below the mark, median over the seeds; "
        "where not all got there it says how many did.",
        "",
        "![learning curves](learning-curves.png)",
        "",
        "| variant | what it changes | seeds | "
        + " | ".join(f"below {m} mm" for m in MARKS_MM)
        + " | at the end, mm | s |",
        "|---|---|---|" + "---|" * len(MARKS_MM) + "---|---|",
    ]
    for name, runs in found.items():
        last = [run["curve"][-1]["hover_mm"] for run in runs]
        cells = [name, VARIANTS[name][2], str(len(runs)), *(_cell(runs, mark) for mark in MARKS_MM)]
        cells.append(f"{statistics.median(last):.1f} [{min(last):.1f}, {max(last):.1f}]")
        cells.append(f"{statistics.median(run['curve'][-1]['seconds'] for run in runs):.0f}")
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def figure(found: dict[str, list[dict]], path) -> None:
    """Hover error over seconds and over commands: the seeds' median, and their span."""
    import numpy as np
    from matplotlib.ticker import FormatStrFormatter

    from cfb_mjx.view.style import context, new_figure, save

    colours = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#8C8C8C", "#000000")
    with context():
        plot = new_figure(9.2, 3.4)
        axes = plot.subplots(1, 2, sharey=True)
        for (name, runs), colour in zip(found.items(), colours[: len(found)], strict=True):
            error = np.array([[row["hover_mm"] for row in run["curve"]] for run in runs])
            for axis, key, scale in zip(axes, ("seconds", "commands"), (1, 1e-6), strict=True):
                at = scale * np.median([[row[key] for row in run["curve"]] for run in runs], axis=0)
                axis.plot(at, np.median(error, axis=0), color=colour, label=name)
                axis.fill_between(at, error.min(axis=0), error.max(axis=0), color=colour, alpha=0.15, linewidth=0)
        axes[0].set_xlabel("training, s")
        axes[1].set_xlabel("commands flown, millions")
        axes[0].set_ylabel("mean hover error, mm")
        axes[0].set_yscale("log")
        axes[0].set_ylim(2, 5000)
        axes[0].yaxis.set_major_formatter(FormatStrFormatter("%g"))
        axes[1].legend(frameon=False, fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5))
        plot.subplots_adjust(left=0.08, right=0.79, bottom=0.15, top=0.96, wspace=0.08)
        save(plot, path)


if __name__ == "__main__":
    main()
