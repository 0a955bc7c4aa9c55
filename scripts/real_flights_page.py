"""The page docs/closing-real-flights.md and its figure, from the numbers `close_real_flights` measured."""

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
"""What the project set itself: mean errors after 0.5 s, attitude rad and velocity m/s."""
TITLES = {
    "commands_in": "commands in",
    "rotor_speed_in": "rotor speeds in",
    "commands_in_observer": "commands in, observer",
    "rotor_speed_in_observer": "rotor speeds in, observer",
}


def page(models: dict[str, ModelFile], results: dict, commands: dict[str, list[str]]) -> str:
    """The page as Markdown."""
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
            "# Closing the loop on real flights",
            "",
            f"Written by `python scripts/close_real_flights.py FOLDER`; do not edit. {facts}",
            "",
            "Flights: the public IDSIA nano-drone system-identification benchmark (Busetto et al., Control Engineering",
            "Practice 172, 2026), a Crazyflie 2.1 Brushless with AI-deck and flow deck, logged at 100 Hz; weighed mass",
            f"{results['mass']} kg. Fitted to: {', '.join(results['fit'])}.",
            f"Judged on: {', '.join(results['validation'])}.",
            "",
            "## Prediction after 0.5 s",
            "",
            "Mean error of attitude, rad, / velocity, m/s, of open-loop predictions of the flights nothing was fitted",
            "to ([protocol](evaluation.md)). *Gentle* are the random and multisine references, *square* is aggressive.",
            "*Hold* assumes constant velocity and constant body rate.",
            "",
            "| prediction | flights | hold | " + " | ".join(models) + " | goal |",
            "|---|---|---" + "|---" * len(models) + "|---|",
            *rows,
            "",
            "![Errors over the horizon](closing-real-flights.png)",
            "",
            "- *declared*: preset `cfb-guards` at the drone's mass.",
            "- *innovations*: motors from rotor speeds, and the effects fitted to one-step innovations, which feedback",
            "  does not bias.",
            "- *plant*: the same effects and a few more fitted to predictions; inertia within 25 %, damping within",
            "  2 per second.",
            "- *predictor*: inertia left free, and small torques of gentle flights answered by less than their size,",
            "  the body rate expected to return instead (`regression_dilution`, no physics).",
            *_over_plant(results["errors"]),
            "  It is a wrong plant: `cfb refine` marks it so.",
            *_dilution(models["predictor"]),
            "",
            "Plant and predictor are shipped as the presets `cfb-idsia` and `cfb-idsia-predictor`:",
            "`cfb evaluate LOG --model cfb-idsia --observer`, `cfb benchmark-nanodrone FOLDER`.",
            "",
            *_story(results),
            "",
            "## The plant, and what each effect buys",
            "",
            "Without an effect, everything else fitted again: by how much the worst of the four errors above (without",
            "observer, attitude after 0.5 s, both groups) grows.",
            "",
            "| effect | numbers | error without it | argument |",
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
            "A torque, a force and, where rotor speed was measured, motor errors, estimated from data before each",
            "window's start; how much they may wander was chosen by predictions of the flights fitted to, gentle and",
            "square alike (`cfb_mjx.sysid.observer_tuning`): with the plant after half a second, with the predictor by",
            "the sums of the benchmark below:",
            "",
            *_levels(results["observer"]),
            "",
            "## What is missed twice",
            "",
            "Measured minus modelled angular acceleration below 6 Hz, in flights of one reference: rms, rad/s^2, and",
            "correlation between the two flights, roll / pitch / yaw. *Explained* is the share of the declared model's",
            "common residual (covariance, roll and pitch together) that the plant no longer misses.",
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
                missed.append(f"{TITLES[variant]}, {group}, {what}: {value:.4f} where {goal:.2f} was the goal")
    hold = declared["hold gentle 0.5"][0]
    told = {variant: plant[f"{variant} gentle 0.5"][0] for variant in ("commands_in", "rotor_speed_in_observer")}
    compared = (f"{TITLES[v]}, {_beside(error / hold)} hold ({error:.3f} rad)" for v, error in told.items())
    text = [f"Attitude on gentle flights, where hold errs by {hold:.3f} rad: the plant, {'; '.join(compared)}."]
    if missed:
        text += ["", "**Goals not reached**:", "", *(f"- {line}" for line in missed)]
    return text


def _over_plant(errors: dict[str, dict]) -> list[str]:
    shares = [
        f"{group} " + " / ".join(f"{errors['predictor'][key][0] / errors['plant'][key][0]:.2f}" for key in keys)
        for group in GROUPS
        for keys in [[f"{variant} {group} 0.5" for variant in TITLES]]
    ]
    return ["  Its errors of attitude above are of the plant's, row by row: " + "; ".join(shares) + "."]


def _dilution(predictor: ModelFile) -> list[str]:
    numbers = {e["name"]: e["parameters"] for e in predictor.effects}
    diluted, inertia = numbers["regression_dilution"], numbers["inertia"]["relative"]
    return [
        f"  Of a torque far below {1e3 * diluted['knee']:.2g} mN m it answers "
        f"{100 * (1 - diluted['dilution']):.0f} % while the drone turns far less than {diluted['turning']:.2g} rad/s",
        f"  (rms, the last {diluted['time_constant']:.2g} s), and expects the body rate to fade at "
        f"{diluted['dilution'] * diluted['reversion']:.2g} per second. Inertia left free",
        f"  comes out {', '.join(f'{100 * x:+.0f}' for x in inertia[:2])} % from the declared one.",
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
        "`position_moment` lets a torque hang on the position as it would in air that moves towards the middle of the",
        "room, the faster the farther out. By which share of the distance a second, 1/s, in the flights fitted to:",
        "told by the moments (over `blade_flapping`); by the accelerometer, which feels the drag of that air beside",
        f"the drag of the motion (below {slow:g} Hz), reference by reference; and what of both is no air: what the",
        "velocity column, from which the model takes its airspeed, lacks against the slope of the position.",
        "",
        "| axis | by moments |" + "".join(f" by drag, {kind} |" for kind in kinds) + " velocity column |",
        "|---|---:|" + "---:|" * len(kinds) + "---:|",
        *rows,
        "",
        "What is certain is the position: with it flights nothing was fitted to are predicted better. Air is not: a",
        "third to a half of what the moments tell is the velocity column, and the drag tells of more than that in one",
        "kind of flight along one axis only. Multisine references move all axes in one rhythm, in which position",
        "and acceleration are hard to tell apart.",
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
        f"The sensors, compared with each other, say that the logged velocity is {across:.3f} times too large",
        f"horizontally and {up:.3f} times vertically (`sensor_velocity_scale`). The drone carried a flow deck, which",
        "measures horizontal velocity by optical flow and height by a ranger. It is not so at all",
        f"frequencies: {1 - 1 / largest:.2f} of the velocity,",
        f"{rise:.2f} s late, less the same another {fade:.2f} s late (`rise`, `fade`; `cfb_mjx.sysid.velocity_band`),",
        "accounts for more of what the horizontal velocity has over the slope of the position, below 4 Hz:",
        "",
        "| flights | stretched alike | in a band |",
        "|---|---:|---:|",
        *(f"| {part} | {100 * even:.0f}% | {100 * band:.0f}% |" for part, (even, band) in seen["explained"].items()),
        "",
        "The tilt is too large as well, says the accelerometer,",
        "turned by the logged attitude and set beside the position; in the flights fitted to:",
        "",
        "| motion | velocity / position, horizontally | acceleration / position | velocity / position, vertically | "
        "acceleration / position |",
        "|---|---:|---:|---:|---:|",
        *bands,
        "",
        f"The gyro agrees: within {SPAN:g} s the on-board estimator adds tilt that no gyro saw. Two reasons for it are",
        "set beside each other (`cfb_mjx.sysid.flow_estimator`, the estimator's two gains fitted in each cell): a",
        "prediction of velocity from thrust alone, which the Crazyflie's filter makes in flight and which ignores the",
        "drag that the accelerometer feels (the share ignored is fitted too, 1 is all of it); and a flow as stretched",
        "as the velocity column, without that. Rms tilt added, rad, and how much of its variance each explains:",
        "",
        "| flights | tilt added | drag ignored | share ignored | flow stretched |",
        "|---|---:|---:|---:|---:|",
        *tilt,
        "",
        "In gentle flights the logged tilt is too large because its estimator knows no drag. In square flights it is",
        "corrected by more than either explains. Taking the stretch out of the velocity alone leaves the tilt that",
        "moves the drone too large: positions are predicted better, attitude and velocity of square flights worse.",
        "Plant and predictor therefore take attitude and velocity as they were logged (`--as-logged`): they agree with",
        "each other, and drag and thrust are those of this velocity. Only the position they predict is put right: it",
        "moves less than that velocity says (`with_attitude`).",
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
    "blade_flapping": "hub moments against the motion; stronger along the body than across, weaker while climbing",
    "inflow_thrust": "a climbing blade meets the air at a smaller angle: damps heave, roll, pitch; held at 2 / s",
    "rotor_drag": "induced drag of the discs, linear in speed",
    "thrust_scale": "hover at a rotor speed at which the paper's curve gives more thrust: decks stand in the flow",
    "inertia": "decks and another battery; predictions ask for more than innovations do, which is what feedback does",
    "cog_offset": "the mean place of the batteries; every flight has its own besides",
    "torque_scale": "less reactive torque; yaw only",
    "thrust_tilt": "rotors a few milliradians off the vertical",
    "position_moment": "a velocity column that leans towards the middle, and perhaps air that moves there",
    "battery_sag": "rotor speed follows the charge of the battery, little its dips under load (hence the lag)",
    "motor_asymmetry": "motors are driven up and coast down",
}


def summary(plant: ModelFile, results: dict) -> str:
    """The effects of the plant in the order of what they buy, and what it predicts: for closing-the-loop.md."""
    errors = results["errors"]

    def at(name: str, group: str) -> str:
        return f"{errors[name][f'rotor_speed_in_observer {group} 0.5'][0]:.2f}"

    told = (f"{group} flights {at('declared', group)} -> {at('plant', group)} rad" for group in GROUPS)
    return "\n".join(
        [
            "| effect | error without it | argument |",
            "|---|---:|---|",
            *(f"| `{name}` | {growth:+.0%} | {ARGUMENTS[name]} |" for growth, name, _ in _ordered(plant, results)),
            "",
            "Attitude half a second ahead, rotor speeds in, with observer, declared model -> corrected one:",
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
    """How much an error grows without each effect, its name and numbers; what buys most first."""
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
    """Attitude error over the horizon, by group and kind of prediction."""
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
