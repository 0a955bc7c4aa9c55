"""Measure the learning curves of variants of the training, each with several seeds.

    python scripts/learning_curves.py [--seeds 3] [--only VARIANT ...] [--page-only]

Variants with `random` in the name train on randomised drones, the others on the nominal drone only. All are evaluated
on the nominal drone, where the time to a given hover error is most informative. `brax` is Brax's own trainer. Finished
trainings are kept in benchmarks/learning-curves.json, so an interrupted run continues. Writes docs/learning-curves.md
and its figure.
"""

import csv
import json
import statistics
import time

from campaign import ROOT, Run, carry_out, facts_line, report, study_arguments

from cfb_mjx.runtime import environment, say

NOMINAL = ("randomisation.magnitude=0", "randomisation.graded=0.0")
PPO = (*NOMINAL, "ppo.steps=16000000", "checkpoints=16")
QUICK = (*NOMINAL, "checkpoints=16")
RANDOM = ("ppo.steps=16000000", "checkpoints=16")
NO_BELL = ("reward.near=0",)
ROUGH = ("ppo.smoothness=0",)
WIDE = ("reward.near_speed_mps=1",)
STRAIGHT = ("observation.position_scale_m=1", "observation.position_bend_m=0", "observation.velocity_bend_mps=0")
ALONE = ("ppo.copies=1",)
VARIANTS = {
    "analytic": ("quick-analytic", QUICK, "back-propagation, horizon 1 s"),
    "quick": ("quick", ("checkpoints=8",), "`cfb train target --config quick`: randomisation x 0.25"),
    "ppo": ("target", PPO, "PPO as in `target`"),
    "ppo-paper": ("target-paper", PPO, "the paper's reward as printed"),
    "ppo-straight": ("target", (*PPO, *STRAIGHT), "positions and velocities observed on a linear scale"),
    "ppo-alone": ("target", (*PPO, *ALONE), "no copies (every drone flies its own episode)"),
    "ppo-random": ("target", RANDOM, "PPO as in `target`, with the paper's randomisation"),
    "ppo-random-paper": ("target-paper", RANDOM, "the paper's reward as printed"),
    "ppo-random-no-bell": ("target", (*RANDOM, *NO_BELL), "no bell-shaped reward at the target, other weights kept"),
    "ppo-random-wide": ("target", (*RANDOM, *WIDE), "a bell that is wider in speed: 1 m/s instead of 0.4"),
    "ppo-random-rough": ("target", (*RANDOM, *ROUGH), "no penalty on changes of the command"),
    "ppo-random-straight": ("target", (*RANDOM, *STRAIGHT), "positions and velocities observed on a linear scale"),
    "ppo-random-adaptive": (
        "target-adaptive-ppo",
        (),
        "the observation of `target-adaptive`, a narrower bell, a longer training: `--config target-adaptive-ppo`",
    ),
    "ppo-random-recover": (
        "target-recover",
        (),
        "a position reward that reaches 20 m, no milder drones, a longer training: `--config target-recover`",
    ),
    "ppo-random-alone": ("target", (*RANDOM, *ALONE), "no copies (every drone flies its own episode)"),
}
LONG = ("ppo-random-adaptive", "ppo-random-recover")
"""Variants left out of the figure, whose time axis they would stretch."""
THROWN = 1024
"""Randomised drones that are thrown."""
MARKS_MM = (100, 50, 25)
BRAX = {
    "brax": (PPO, "Brax's own trainer, the settings of `ppo-alone`, observations normalised"),
    "brax-random": (RANDOM, "the same with the paper's randomisation"),
}
"""Changes of configuration and description of each variant that Brax's trainer runs."""
SB3 = ROOT / "benchmarks" / "sb3.json"
WHAT = {name: text for name, (*_, text) in {**VARIANTS, **BRAX}.items()}


def main() -> None:
    """Train the missing variants and write the page."""
    arguments = study_arguments(__doc__, "--only", WHAT)
    from cfb_mjx.files import write_text

    results = ROOT / "benchmarks" / "learning-curves.json"
    if not arguments.page_only:
        runs = [
            Run(f"{name}-{seed}", *VARIANTS[name][:2], seed)
            for seed in range(arguments.seeds)
            for name in arguments.chosen
            if name in VARIANTS
        ]
        from cfb_mjx.train.judge import Judge

        carry_out(runs, results, ROOT / "out" / "learning-curves", judged(Judge(plants=None, random_drones=0)))
        for seed in range(arguments.seeds):
            for name in arguments.chosen:
                if name in BRAX:
                    by_brax(name, seed, results)
    found = {}
    for key, run in json.loads(results.read_text()).items():
        for row in run["curve"]:
            # JSON has no infinity: null means that every flight failed.
            row |= {key: float("inf") for key in ("hover_mm", "random_mm") if key in row and row[key] is None}
        found.setdefault(key.rpartition("-")[0], []).append(run)
    found = {name: found[name] for name in WHAT if name in found}
    figure({name: runs for name, runs in found.items() if name not in LONG}, ROOT / "docs" / "learning-curves.png")
    write_text(ROOT / "docs" / "learning-curves.md", page(found))
    print("docs/learning-curves.md, docs/learning-curves.png")


def judged(judge):
    """Return a function from controller to score that includes late and noisy sensors, and throws."""
    import jax
    import numpy as np

    from cfb_mjx.train.flying import recovery

    def score(controller) -> dict:
        thrown, _ = recovery(controller, judge.wild, judge.nominal, jax.random.split(jax.random.PRNGKey(1), THROWN))
        sensors = judge.with_sensors(controller)
        return judge(controller) | {"sensors": sensors, "recovered": float(np.mean(thrown.recovered))}

    return score


def by_brax(name: str, seed: int, results) -> None:
    """Train with `brax.training.agents.ppo` for as many commands, unless ``results`` has this run already."""
    import functools

    import jax.numpy as jnp
    from brax.training.agents.ppo import networks

    from cfb_mjx.control import brax_controller
    from cfb_mjx.envs.brax_env import BraxEnv, wrap
    from cfb_mjx.files import write_json
    from cfb_mjx.train.brax_compat import brax_ppo
    from cfb_mjx.train.config import load_config
    from cfb_mjx.train.judge import Judge

    found = json.loads(results.read_text())
    if f"{name}-{seed}" in found:
        return
    say(f"{name}-{seed}")
    config = load_config("target", (*BRAX[name][0], *ALONE))
    ours, task = config.ppo, config.build_task()
    judge = Judge(plants=None, random_drones=0 if task.randomisation is None else 256)
    rows, began, judging = [], time.perf_counter(), 0.0
    settings = {
        "num_timesteps": ours.steps,
        "num_envs": ours.drones,
        "unroll_length": ours.unroll,
        "batch_size": ours.drones // ours.minibatches,
        "num_minibatches": ours.minibatches,
        "num_updates_per_batch": ours.epochs,
        "discounting": ours.discount,
        "gae_lambda": ours.gae_lambda,
        "learning_rate": ours.learning_rate,
        "reward_scaling": ours.reward_scaling,
        "entropy_cost": ours.entropy_cost,
        "normalize_observations": True,
        "bootstrap_on_timeout": True,
        "episode_length": task.episode_steps,
    }

    def at_checkpoint(commands, make_policy, params):
        nonlocal judging
        paused = time.perf_counter()
        seconds = paused - began - judging
        score = judge(brax_controller(params, task.layout, normalized=True))
        nominal, random = score["nominal"], score.get("random")
        lost = nominal["hover_mm"] is None
        judging += time.perf_counter() - paused
        rows.append(
            {
                "commands": int(commands),
                "seconds": seconds,
                "hover_mm": float("inf") if lost else nominal["hover_mm"],
                "command_std": nominal["command_std"],
                "hover_failed": nominal["failed"],
            }
            | ({"random_mm": random["hover_mm"], "random_failed": random["failed"]} if random else {})
        )
        report(rows[-1])

    with brax_ppo() as train:
        *_, params, _ = train(
            BraxEnv(task),
            **settings,
            seed=seed,
            num_evals=17,
            num_eval_envs=64,
            policy_params_fn=at_checkpoint,
            network_factory=functools.partial(
                networks.make_ppo_networks,
                policy_hidden_layer_sizes=load_config("target").network.hidden,
                value_hidden_layer_sizes=ours.value_hidden,
                activation=jnp.tanh,
                policy_obs_key="state",
                value_obs_key="privileged_state",
            ),
            wrap_env_fn=wrap,
        )
    score = judged(judge)(brax_controller(params, task.layout, normalized=True))
    found[f"{name}-{seed}"] = {
        "seed": seed,
        "score": score,
        # Brax also evaluates before the first command; that is no point of the curve.
        "curve": [row for row in rows if row["commands"]],
        "config": {"trainer": "brax", "magnitude": config.randomisation.magnitude, **settings},
        "environment": environment(),
    }
    write_json(results, found)


def _reached(run: dict, mark: float) -> tuple[float, float] | None:
    """Seconds and millions of commands from which on the curve stays below ``mark``; None if never."""
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
        return "never"
    seconds, commands = (statistics.median(x) for x in zip(*there, strict=True))
    lost = f" ({len(there)} of {len(runs)})" if len(there) < len(runs) else ""
    return f"{seconds:.0f} s, {commands:.1f} M{lost}"


def page(found: dict[str, list[dict]]) -> str:
    """The Markdown page."""
    lines = [
        "# Learning curves",
        "",
        "This page is for users who change the configuration of a training: it shows what each choice gains or costs. "
        "A variant is an ordinary training with other settings, such as",
        "",
        "```sh",
        "cfb train target --set ppo.smoothness=0 -o out/rough",
        "```",
        "",
        facts_line("python scripts/learning_curves.py", [run for runs in found.values() for run in runs]),
        "",
        "Every training begins with random weights. Variants with `random` in their name train on randomised drones, "
        "the others on the nominal drone only. The columns of the table:",
        "",
        "- below N mm: time and number of commands from which on the hover error on the nominal drone (the paper's "
        "test, mean of 64 flights with noise) stays below N mm. Median over the seeds; if some seeds do not get there, "
        "the cell says how many do.",
        "- at the end: hover error at the last checkpoint, median [least, greatest] of the seeds.",
        "- time: the duration of the updates, with the compilation of the first and without evaluation, on a machine "
        "that also ran other programs.",
        "- on randomised drones: hover error, median of 256 drones drawn with the training's own magnitude. Empty "
        "where the training did not measure it.",
        "- std: command std of the last policy on the nominal drone, with the pose 24 ms late and the gyro read on the "
        "drone, and with both 16 ms late (8 ms in the model). Above 0.04 the drone oscillates.",
        f"- recovered: share of {THROWN} drones with the paper's full randomisation that come back after a throw "
        "([the test](controllers.md)). Empty where it was not measured.",
        "",
        "![learning curves](learning-curves.png)",
        "",
        "| variant | change | seeds | "
        + " | ".join(f"below {m} mm" for m in MARKS_MM)
        + " | at the end, mm | on randomised drones, mm | std, 24 ms | std, 16 ms | recovered | time, s |",
        "|---|---|---|" + "---|" * len(MARKS_MM) + "---|---|---|---|---|---|",
    ]
    for name, runs in found.items():
        last = [run["curve"][-1]["hover_mm"] for run in runs]
        cells = [name, WHAT[name], str(len(runs)), *(_cell(runs, mark) for mark in MARKS_MM)]
        cells.append(f"{statistics.median(last):.1f} [{min(last):.1f}, {max(last):.1f}]")
        random = [run["curve"][-1]["random_mm"] for run in runs if "random_mm" in run["curve"][-1]]
        cells.append(f"{statistics.median(random):.0f} [{min(random):.0f}, {max(random):.0f}]" if random else "")
        for late in (0, 1):
            stds = [list(run["score"]["sensors"].values())[late]["command_std"] for run in runs]
            # None where every flight failed.
            cells.append("all failed" if None in stds else f"{statistics.median(stds):.3f}")
        recovered = [run["score"]["recovered"] for run in runs if "recovered" in run["score"]]
        cells.append(f"{statistics.median(recovered):.1%}" if recovered else "")
        cells.append(f"{statistics.median(run['curve'][-1]['seconds'] for run in runs):.0f}")
        lines.append("| " + " | ".join(cells) + " |")
    lines += ["", "## The shipped `target`", *of_shipped("cfb train target", "-1")]
    return "\n".join([*lines, *of_shipped("cfb train target --config target-2", ""), *of_sb3()]) + "\n"


def of_sb3() -> list[str]:
    """Section with the result of the example with Stable-Baselines3."""
    run = json.loads(SB3.read_text())
    return [
        "",
        "## Stable-Baselines3",
        "",
        facts_line(f"python examples/train_with_sb3.py --write {SB3.relative_to(ROOT)}", [run]),
        "",
        f"stable_baselines3 {run['environment']['stable_baselines3']} trained on the nominal drone only: "
        f"{run['commands'] / 1e6:.1f} M commands in {run['seconds']:.0f} s, on a machine that also ran other programs. "
        "The policy then flew 64 times for 6 s from within 0.7 m of the target. Without the first second, its mean "
        f"distance to the target is {run['mean_mm']:.0f} mm, in the worst flight {run['worst_mm']:.0f} mm.",
    ]


def of_shipped(command: str, part: str) -> list[str]:
    """Learning curve stored with the shipped `target`, for the part of its training that ``command`` ran."""
    folder = ROOT / "src" / "cfb_mjx" / "policies" / "target"
    facts = json.loads((folder / f"training{part}.json").read_text())["environment"]
    rows = list(csv.DictReader((folder / f"curve{part}.csv").read_text().splitlines()))
    lines = [
        "",
        f"`{command}`, {facts['date']}, {facts['processor']}, Python {facts['python']}, jax {facts['jax']}. "
        "Evaluated with the delays of the training. On randomised drones: median of 256 drones drawn at the paper's "
        "magnitude.",
        "",
        "| commands | time | hover, nominal, mm | command std | on randomised drones, mm | failed |",
        "|---|---|---|---|---|---|",
    ]
    for row in rows:
        number = {key: float(value) for key, value in row.items()}
        cells = [f"{number['commands'] / 1e6:.0f} M", f"{number['seconds'] / 60:.1f} min", f"{number['hover_mm']:.1f}"]
        cells += [f"{number['command_std']:.4f}", f"{number['random_mm']:.0f}", f"{number['random_failed']:.1%}"]
        lines.append("| " + " | ".join(cells) + " |")
    return lines


def figure(found: dict[str, list[dict]], path) -> None:
    """Plot the hover error over time and over commands: median and range of the seeds."""
    import numpy as np
    from matplotlib.ticker import FormatStrFormatter

    from cfb_mjx.view.style import context, new_figure, save

    colours = (
        "#0072B2",
        "#D55E00",
        "#009E73",
        "#CC79A7",
        "#56B4E9",
        "#E69F00",
        "#8C8C8C",
        "#000000",
        "#882255",
        "#44AA99",
    )
    # A variant on randomised drones has the colour of its twin on the nominal drone, dashed.
    plain = list(dict.fromkeys(name.replace("-random", "") for name in found))
    colour_of = dict(zip(plain, colours[: len(plain)], strict=True))
    with context():
        plot = new_figure(9.2, 3.4)
        axes = plot.subplots(1, 2, sharey=True)
        for name, runs in found.items():
            colour, line = colour_of[name.replace("-random", "")], "--" if "-random" in name else "-"
            error = np.array([[row["hover_mm"] for row in run["curve"]] for run in runs])
            for axis, key, scale in zip(axes, ("seconds", "commands"), (1, 1e-6), strict=True):
                at = scale * np.median([[row[key] for row in run["curve"]] for run in runs], axis=0)
                axis.plot(at, np.median(error, axis=0), line, color=colour, label=name)
                axis.fill_between(at, error.min(axis=0), error.max(axis=0), color=colour, alpha=0.15, linewidth=0)
        axes[0].set_xlabel("training time, s")
        axes[1].set_xlabel("commands, millions")
        axes[0].set_ylabel("mean hover error, mm")
        axes[0].set_yscale("log")
        axes[0].set_ylim(2, 5000)
        axes[0].yaxis.set_major_formatter(FormatStrFormatter("%g"))
        axes[1].legend(frameon=False, fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5))
        plot.subplots_adjust(left=0.08, right=0.79, bottom=0.15, top=0.96, wspace=0.08)
        save(plot, path)


if __name__ == "__main__":
    main()
