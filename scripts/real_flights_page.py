"""The page docs/closing-real-flights.md and its figure, from the results of `close_real_flights`."""

from pathlib import Path
from statistics import mean, stdev

from real_flights_benchmark import benchmark_section

from cfb_mjx.parameters import ModelFile
from cfb_mjx.runtime import environment
from cfb_mjx.sysid.flow_estimator import SPAN

GROUPS = {"gentle": ("random1", "random2", "multisine"), "square": ("square",)}
TARGETS = {
    ("commands_in", "gentle"): (0.40, 0.80),
    ("commands_in", "square"): (0.45, None),
    ("rotor_speed_in", "gentle"): (0.31, 0.64),
    ("rotor_speed_in", "square"): (0.26, None),
    ("commands_in_observer", "gentle"): (0.32, 0.60),
    ("commands_in_observer", "square"): (0.42, None),
    ("rotor_speed_in_observer", "gentle"): (0.22, 0.39),
    ("rotor_speed_in_observer", "square"): (0.24, None),
}
"""Goals of the project: mean errors after 0.5 s, attitude rad and velocity m/s."""
TITLES = {
    "commands_in": "commands in",
    "rotor_speed_in": "rotor speeds in",
    "commands_in_observer": "commands in, observer",
    "rotor_speed_in_observer": "rotor speeds in, observer",
}


def page(models: dict[str, ModelFile], results: dict, commands: dict[str, list[str]]) -> str:
    """Return the page as Markdown."""
    facts = ", ".join(f"{name} {value}" for name, value in environment().items())
    rows = []
    for variant, title in TITLES.items():
        for group in GROUPS:
            cells = [_pair(results["errors"][name][f"{variant} {group} 0.5"]) for name in models]
            hold = _pair(results["errors"]["declared"][f"hold {group} 0.5"])
            target = _pair(TARGETS[variant, group])
            rows.append(f"| {title} | {group} | {hold} | " + " | ".join(cells) + f" | {target} |")
    return "\n".join(
        [
            "# Model correction on real flights",
            "",
            f"Written by `python scripts/close_real_flights.py FOLDER`; do not edit. {facts}",
            "",
            "This page shows the correction of a model on flights of a real drone: the corrected models, their errors",
            "on held-out flights, and the commands that made them. Both models are presets that you can use:",
            "",
            "```sh",
            "cfb evaluate LOG --model cfb-idsia --observer",
            "cfb benchmark-nanodrone FOLDER",
            "```",
            "",
            "`cfb-idsia` is the *plant* below, `cfb-idsia-predictor` the *predictor*.",
            "",
            "The flights are the public IDSIA nano-drone system-identification benchmark (Busetto et al., Control",
            "Engineering Practice 172, 2026): a Crazyflie 2.1 Brushless with AI-deck and flow deck, logged at 100 Hz.",
            "The drone weighs",
            f"{results['mass']} kg.",
            "",
            f"- Fitted to: {', '.join(results['fit'])}.",
            f"- Judged on (held out): {', '.join(results['validation'])}.",
            "",
            "## Prediction after 0.5 s",
            "",
            "The table gives the mean error of attitude, rad, / velocity, m/s, of open-loop predictions of the",
            "held-out flights ([protocol](evaluation.md)).",
            "",
            "- *commands in*, *rotor speeds in*: what drives the prediction. *Observer*: with disturbances estimated",
            "  from the data before each window.",
            "- *gentle*: the random and multisine references. *square*: an aggressive reference.",
            "- *hold*: constant velocity and constant body rate.",
            "- *goal*: what the project set itself.",
            "",
            "| prediction | flights | hold | " + " | ".join(models) + " | goal |",
            "|---|---|---" + "|---" * len(models) + "|---|",
            *rows,
            "",
            "![Errors over the horizon](closing-real-flights.png)",
            "",
            "The models:",
            "",
            "- *declared*: preset `cfb-guards` at the drone's mass.",
            "- *innovations*: motors fitted to measured rotor speeds, and effects fitted to one-step innovations,",
            "  which feedback does not bias.",
            "- *plant*: the same effects and a few more, fitted to predictions; inertia within 25 %, damping within 2",
            "  per second.",
            "- *predictor*: fitted again with free inertia and `regression_dilution`, which is no physics: the model",
            "  responds to small torques of gentle flights with less than their size, and expects the body rate to",
            "  decay.",
            *_over_plant(results["errors"]),
            "  The predictor is a wrong plant, and `cfb refine` marks it as such.",
            *_dilution(models["predictor"]),
            "",
            *_story(results),
            "",
            "## The plant, effect by effect",
            "",
            "*Error without it* is the growth of the worst of four errors above (attitude after 0.5 s without",
            "observer, commands in and rotor speeds in, both groups) when the effect is removed and everything else is",
            "fitted again.",
            "",
            "| effect | numbers | error without it | explanation |",
            "|---|---|---:|---|",
            *_effects(models["plant"], results),
            "",
            "## The position",
            "",
            *_position(models["plant"], results["place"], results["slow"]),
            "",
            "## The velocity column",
            "",
            *_columns(results["columns"], results["tilt"]),
            "",
            "## The observer",
            "",
            "The observer estimates a torque, a force and, where rotor speed was measured, motor errors from the data",
            "before each window's start. Its noise levels were chosen by predictions of the flights fitted to, with",
            "equal weight for gentle and square flights (`cfb_mjx.sysid.nanodrone`): for the plant by the errors",
            "after 0.5 s, for the predictor by the sums of the benchmark below.",
            "",
            *_levels(results["observer"]),
            "",
            "## Residuals common to two flights",
            "",
            "A residual that two flights of one reference have in common is a model error, not noise. The table gives",
            "the measured minus the modelled angular acceleration below 6 Hz, roll / pitch / yaw: its rms, rad/s^2;",
            "and its correlation between the two flights. *Explained* is the share of the declared model's common",
            "residual (covariance, roll and pitch together) that the plant removes.",
            "",
            "| flights | declared | plant | explained |",
            "|---|---|---|---:|",
            *_repeats(results),
            "",
            *benchmark_section(results),
            "",
            "## Commands",
            "",
            "```sh",
            *(" ".join(["cfb", *_short(command)]) for command in commands.values()),
            "```",
            "",
        ]
    )


def _pair(pair) -> str:
    return " / ".join(f"{x:.3f}" if i == 0 else f"{x:.2f}" for i, x in enumerate(pair) if x is not None)


def _short(command: list[str]) -> list[str]:
    texts = ["fit/*.parquet" if "/fit/" in text and text.endswith(".parquet") else text for text in command]
    return [Path(t).name if t.endswith((".yaml", ".json")) else t for i, t in enumerate(texts) if t not in texts[:i]]


def _story(results: dict) -> list[str]:
    plant, declared = results["errors"]["plant"], results["errors"]["declared"]
    missed = []
    for (variant, group), (attitude, velocity) in TARGETS.items():
        seen = plant[f"{variant} {group} 0.5"]
        for what, value, goal in (("attitude", seen[0], attitude), ("velocity", seen[1], velocity)):
            if goal is not None and value > goal:
                missed.append(f"{TITLES[variant]}, {group}, {what}: {value:.4f}, goal {goal:.2f}")
    hold = declared["hold gentle 0.5"][0]
    told = {variant: plant[f"{variant} gentle 0.5"][0] for variant in ("commands_in", "rotor_speed_in_observer")}
    compared = (f"{TITLES[v]}, {_beside(error / hold)} hold ({error:.3f} rad)" for v, error in told.items())
    text = [f"Attitude error of the plant on gentle flights (hold: {hold:.3f} rad): {'; '.join(compared)}."]
    if missed:
        text += ["", "**Goals not reached**:", "", *(f"- {line}" for line in missed)]
    return text


def _over_plant(errors: dict[str, dict]) -> list[str]:
    shares = [
        f"{group} " + " / ".join(f"{errors['predictor'][key][0] / errors['plant'][key][0]:.2f}" for key in keys)
        for group in GROUPS
        for keys in [[f"{variant} {group} 0.5" for variant in TITLES]]
    ]
    return ["  Its attitude errors above, over those of the plant, row by row: " + "; ".join(shares) + "."]


def _dilution(predictor: ModelFile) -> list[str]:
    numbers = {e["name"]: e["parameters"] for e in predictor.effects}
    diluted, inertia = numbers["regression_dilution"], numbers["inertia"]["relative"]
    return [
        f"  Of a torque far below {1e3 * diluted['knee']:.2g} mN m only "
        f"{100 * (1 - diluted['dilution']):.0f} % acts while the body rate is far below {diluted['turning']:.2g} rad/s",
        f"  (rms, the last {diluted['time_constant']:.2g} s), and the body rate then decays at "
        f"{diluted['dilution'] * diluted['reversion']:.2g} per second. The free inertia",
        f"  differs from the declared one by {', '.join(f'{100 * x:+.0f}' for x in inertia[:2])} % (roll, pitch).",
    ]


def _beside(ratio: float) -> str:
    return "better than" if ratio < 0.95 else "worse than" if ratio > 1.05 else "about as good as"


def _position(plant: ModelFile, told: dict[str, dict], slow: float) -> list[str]:
    effects = {e["name"]: e for e in plant.effects}
    moment, flapping = effects["position_moment"], effects["blade_flapping"]["parameters"]
    kinds: dict[str, list[dict]] = {}
    for name, one in told.items():
        kinds.setdefault(name.split("_")[0].rstrip("12"), []).append(one)
    rows = []
    for i, (axis, share) in enumerate((("x", 1 + flapping["anisotropy"]), ("y", 1 - flapping["anisotropy"]))):
        gradient, std = (moment[kind]["gradient"][i] for kind in ("parameters", "uncertainty"))
        per_speed = flapping["coefficient"] * share
        cells = [f"{gradient / per_speed:.3f} +- {abs(std / per_speed):.3f}"]
        cells += [_mean([one["drag"][i] for one in some]) for some in kinds.values()]
        cells += [_mean([one["column"][i] for one in told.values()])]
        rows.append(f"| {axis} | " + " | ".join(cells) + " |")
    return [
        "`position_moment` is a torque that depends on the position, as in air that moves towards the middle of the",
        "room, faster the farther out. The table gives the speed of that air per distance from the middle, 1/s, in",
        "the flights fitted to:",
        "",
        "- *by moments*: the numbers of `position_moment` over those of `blade_flapping`.",
        "- *by drag*: the drag that the accelerometer measures in addition to the drag of the motion (below",
        f"  {slow:g} Hz), for each reference.",
        "- *velocity column*: the part of both that is not air. The model computes the airspeed from the logged",
        "  velocity, which differs from the slope of the position by this much.",
        "",
        "| axis | by moments |" + "".join(f" by drag, {kind} |" for kind in kinds) + " velocity column |",
        "|---|---:|" + "---:|" * len(kinds) + "---:|",
        *rows,
        "",
        "The dependence on the position is certain: it improves predictions of held-out flights. Moving air is not",
        "certain. The velocity column accounts for a third to a half of the estimate from moments, and the drag shows",
        "more than that in one kind of flight along one axis only. Multisine references move all axes in one rhythm,",
        "in which position and acceleration are hard to separate.",
    ]


def _mean(values: list[float]) -> str:
    if len(values) == 1:
        return f"{values[0]:.3f}"
    return f"{mean(values):.3f} +- {stdev(values) / len(values) ** 0.5:.3f}"


def _columns(seen: dict, tilted_by: dict) -> list[str]:
    rows, bands = [], []
    for band, by_axis in seen["bands"].items():
        cells = [f"{by_axis[axis][i]:.2f}" for axis in ("horizontal", "vertical") for i in range(2)]
        bands.append(f"| {band} | " + " | ".join(cells) + " |")
    for variant in ("commands_in", "rotor_speed_in"):
        for group in GROUPS:
            cells = [_pair(seen["errors"][name][f"{variant} {group} 0.5"]) for name in ("repaired", "plant")]
            rows.append(f"| {TITLES[variant]} | {group} | " + " | ".join(cells) + " |")
    tilt = [_tilt(flights, by_reason) for flights, by_reason in tilted_by.items()]
    across, _, up = seen["stretch"]
    largest, rise, fade = seen["band"]
    return [
        "A comparison of the sensors shows that the logged velocity is stretched (`sensor_velocity_scale`): it is",
        f"{across:.3f} times the true one horizontally and {up:.3f} times vertically. The drone carried a flow deck,",
        "which measures horizontal velocity by optical flow and height by a ranger. The stretch is not the same at",
        f"all frequencies. A band explains more: {1 - 1 / largest:.2f} of the velocity with a lag of",
        f"{rise:.2f} s, minus the same with another lag of {fade:.2f} s (`rise`, `fade`;",
        "`cfb_mjx.sysid.velocity_band`). The table gives the share of the variance of horizontal velocity minus slope",
        "of the position, below 4 Hz, that each explains:",
        "",
        "| flights | one stretch | a band |",
        "|---|---:|---:|",
        *(f"| {part} | {100 * even:.0f}% | {100 * band:.0f}% |" for part, (even, band) in seen["explained"].items()),
        "",
        "The logged tilt is too large as well. In the flights fitted to, the table compares the logged velocity with",
        "the slope of the position, and the accelerometer, rotated by the logged attitude, with the second",
        "derivative of the position. A ratio of 1 is agreement:",
        "",
        "| frequency | velocity, horizontal | acceleration, horizontal | velocity, vertical | acceleration, vertical |",
        "|---|---:|---:|---:|---:|",
        *bands,
        "",
        f"The gyro confirms this: within {SPAN:g} s the on-board estimator adds tilt that the gyro did not measure.",
        "Two explanations are compared (`cfb_mjx.sysid.flow_estimator`; the two gains of the estimator are fitted in",
        "each cell):",
        "",
        "- *drag ignored*: the estimator predicts the velocity from thrust alone, as the Crazyflie's filter does in",
        "  flight, and ignores the drag that the accelerometer measures. The share ignored is fitted too (1 is all",
        "  of it).",
        "- *flow stretched*: the optical flow is as stretched as the velocity column, and no drag is ignored.",
        "",
        "The table gives the rms tilt added, rad, and the share of its variance that each explains:",
        "",
        "| flights | tilt added | drag ignored | share ignored | flow stretched |",
        "|---|---:|---:|---:|---:|",
        *tilt,
        "",
        "In gentle flights the logged tilt is too large because the estimator ignores drag. In square flights the",
        "estimator corrects the tilt by more than either explanation covers. If the stretch is taken out of the",
        "velocity alone, the tilt that moves the drone stays too large: positions are predicted better, but square",
        "flights mostly worse in attitude and velocity (table). Plant and predictor therefore use both as logged",
        "(`--as-logged`): these two agree with each other, and drag and thrust are fitted to this velocity. Only the",
        "predicted position is corrected, because it moves less than that velocity says (`with_attitude`).",
        "",
        "Mean errors on the flights fitted to after 0.5 s, attitude, rad, / velocity as logged, m/s:",
        "",
        "| prediction | flights | stretch taken out | as logged |",
        "|---|---|---|---|",
        *rows,
    ]


def _tilt(flights: str, by_reason: dict[str, dict]) -> str:
    ignoring, stretched = by_reason["ignoring"], by_reason["stretched"]
    share = f"{ignoring['ignored']:.2f} +- {ignoring['ignored_std']:.2f}"
    explained = (f"{100 * one['explained']:.0f}%" for one in (ignoring, stretched))
    return f"| {flights} | {ignoring['corrected']:.3f} | " + f" | {share} | ".join(explained) + " |"


ARGUMENTS = {
    "blade_flapping": "hub moments that oppose the motion; larger along body x than along body y, smaller in climb",
    "inflow_thrust": "a climbing blade has a smaller angle of attack: damps heave, roll, pitch; at its bound of 2 / s",
    "rotor_drag": "induced drag of the rotor discs, linear in velocity",
    "thrust_scale": "the paper's curve gives too much thrust at the rotor speed of hover: decks are in the flow",
    "inertia": "decks and another battery; predictions give more than innovations, as the bias of feedback does",
    "cog_offset": "mean position of the batteries; each flight has its own offset in addition",
    "torque_scale": "less reactive torque; acts on yaw only",
    "thrust_tilt": "rotor axes a few milliradians off the vertical",
    "position_moment": "a logged velocity biased towards the middle of the room, and perhaps air that moves there",
    "battery_sag": "rotor speed follows the charge of the battery but hardly its dips under load (hence the lag)",
    "motor_asymmetry": "motors are driven to spin up but coast to slow down",
}


def summary(plant: ModelFile, results: dict) -> str:
    """Return the summary for closing-the-loop.md: effects of the plant, sorted by their gain, and its errors."""
    errors = results["errors"]

    def at(name: str, group: str) -> str:
        return f"{errors[name][f'rotor_speed_in_observer {group} 0.5'][0]:.2f}"

    told = (f"{group} flights {at('declared', group)} -> {at('plant', group)} rad" for group in GROUPS)
    return "\n".join(
        [
            "| effect | error without it | explanation |",
            "|---|---:|---|",
            *(f"| `{name}` | {growth:+.0%} | {ARGUMENTS[name]} |" for growth, name, _ in _ordered(plant, results)),
            "",
            "Mean attitude error 0.5 s ahead (rotor speeds in, with observer), declared model -> corrected model:",
            f"{'; '.join(told)}. Errors over the horizon:",
            "",
            "![Errors over the horizon](closing-real-flights.png)",
        ]
    )


def _effects(plant: ModelFile, results: dict) -> list[str]:
    return [
        f"| {name} | {numbers} | {growth:+.0%} | {ARGUMENTS[name]} |"
        for growth, name, numbers in _ordered(plant, results)
    ]


def _ordered(plant: ModelFile, results: dict) -> list[tuple[float, str, str]]:
    """Return the growth of the error without each effect, its name and its numbers, largest first."""
    keys = [f"{variant} {group} 0.5" for variant in ("commands_in", "rotor_speed_in") for group in GROUPS]
    own, rows = results["errors"]["plant"], []
    for name, less in results["without"].items():
        growth = max(less[key][0] / own[key][0] - 1 for key in keys)
        effect = next((e for e in plant.effects if e["name"] == name), None)
        numbers = "; ".join(
            _number(k, v, (effect.get("uncertainty") or {}).get(k)) for k, v in effect["parameters"].items()
        )
        rows.append((growth, name, numbers))
    return sorted(rows, reverse=True)


def _number(name: str, value, std) -> str:
    values, stds = (x if isinstance(x, list) else [x] for x in (value, std))
    stds = stds if len(stds) == len(values) else [None] * len(values)
    return f"{name} " + ", ".join(
        f"{v:.3g}" + (f" +- {s:.1g}" if s is not None else "") for v, s in zip(values, stds, strict=True)
    )


def _levels(observers: dict[str, dict]) -> list[str]:
    def text(value) -> str:
        return " / ".join(f"{x:.3g}" for x in value) if isinstance(value, list | tuple) else f"{value:.3g}"

    rows = [
        f"| `{level}` | " + " | ".join(text(o[level]) for o in observers.values()) + " |"
        for level in observers["plant"]
    ]
    return [f"| level | {' | '.join(observers)} |", "|---|" + "---|" * len(observers), *rows]


def _repeats(results: dict) -> list[str]:
    rows = []
    for pair, seen in results["repeats"].items():
        cells = []
        for name in ("declared", "plant"):
            rms = " / ".join(f"{x:.1f}" for x in seen[name]["rms"])
            cells.append(f"{rms}; " + " / ".join(f"{x:.2f}" for x in seen[name]["correlation"]))
        before, after = (sum(seen[name]["shared"][:2]) for name in ("declared", "plant"))
        names = " and ".join(f"{n.split('_')[0]} {n[-1]}" for n in pair.split())
        rows.append(f"| {names} | {cells[0]} | {cells[1]} | {1 - after / before:.0%} |")
    return rows


def figure(results: dict, path: Path) -> None:
    """Plot the attitude error over the horizon, by group and kind of prediction."""
    from matplotlib.figure import Figure

    horizons = ("0.05", "0.1", "0.2", "0.5")
    drawing = Figure(figsize=(9, 6), layout="constrained")
    axes = drawing.subplots(2, 2, sharex=True, sharey="col")
    for row, variant in enumerate(("commands_in", "rotor_speed_in")):
        for column, group in enumerate(GROUPS):
            ax = axes[row][column]
            for name, seen in {"hold": results["errors"]["declared"], **results["errors"]}.items():
                key = "hold" if name == "hold" else variant
                line = [seen[f"{key} {group} {h}"][0] for h in horizons]
                ax.plot([1e3 * float(h) for h in horizons], line, "k--" if name == "hold" else "-o", label=name, ms=3)
            ax.set(title=f"{group}, {TITLES[variant]}", xscale="log", yscale="log")
            ax.set_xticks([1e3 * float(h) for h in horizons], [f"{1e3 * float(h):g}" for h in horizons], minor=False)
            ax.minorticks_off()
            ax.grid(alpha=0.3)
    for ax in axes[1]:
        ax.set_xlabel("horizon, ms")
    for ax in axes[:, 0]:
        ax.set_ylabel("mean attitude error, rad")
    axes[0][0].legend(fontsize=8)
    drawing.savefig(path, dpi=110)
