"""Close the loop on real flights in the IDSIA layout, and write docs/closing-real-flights.md with its figure.

    python scripts/close_real_flights.py FOLDER [--work out/real]

FOLDER holds fit/*.parquet and validation/*.parquet. Nothing is fitted to validation/. Only aggregate numbers are
written; the flights themselves never enter the project. What a step leaves in the work folder is used again.
"""

import argparse
import json
import subprocess
import sys
from collections.abc import Callable
from dataclasses import asdict, replace
from functools import partial
from itertools import combinations
from pathlib import Path

import numpy as np
from scipy.signal import butter, sosfiltfilt

from cfb_mjx.cli.refining import by_predictions
from cfb_mjx.cli.runtime import configure_jax, environment
from cfb_mjx.files import write_json, write_text
from cfb_mjx.logs import FlightLog, read_log
from cfb_mjx.logs.resample import interpolate
from cfb_mjx.logs.rotation import to_world
from cfb_mjx.model import Quadrotor
from cfb_mjx.parameters import ModelFile, load_model_file
from cfb_mjx.sysid import evaluate
from cfb_mjx.sysid.flow_estimator import SPAN, fit_flow_estimator
from cfb_mjx.sysid.nanodrone import PUBLISHED, QUANTITIES, Contestant, benchmark
from cfb_mjx.sysid.observer import Observer
from cfb_mjx.sysid.observer_tuning import tune_observer
from cfb_mjx.sysid.repeatability import repeated
from cfb_mjx.sysid.sensor_faults import SensorFaults

PAGE = Path(__file__).resolve().parents[1] / "docs" / "closing-real-flights.md"
MASS = 0.045
MOTORS = ("battery_sag", "motor_asymmetry")
BESIDE = ("blade_flapping", "thrust_scale", "inertia")
"""Fitted with the motors, so that these do not have to stand in for them."""
BODY = (
    *("blade_flapping", "inflow_thrust", "rotor_drag", "thrust_scale"),
    *("inertia", "cog_offset", "torque_scale", "thrust_tilt", "room_circulation"),
)
GENTLE = 7
"""Gentle flights among those fitted: the square counts as much as all of them, for the two are judged side by side."""
GROUPS = {"gentle": ("random1", "random2", "multisine"), "square": ("square",)}
SLOW = 2.0
"""Hz; below it what leans on the place is looked for in the velocity column."""
BANDS = ((0.1, 0.3), (0.2, 0.5), (0.5, 1.0))
"""Hz; faster motion is too small in the gentle flights for the slope of a position to show it."""
VARIANTS = ("commands_in", "rotor_speed_in", "commands_in_observer", "rotor_speed_in_observer", "hold")
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
SUMS_GOAL = (1.91, 8.86, 3.94, 20.8)
"""The same on the benchmark's test flights, as the sums of `PUBLISHED`."""
TITLES = {
    "commands_in": "commands in",
    "rotor_speed_in": "rotor speeds in",
    "commands_in_observer": "commands in, observer",
    "rotor_speed_in_observer": "rotor speeds in, observer",
}


def steps(folder: Path, work: Path) -> dict[str, list[str]]:
    """The commands, by the model file they leave in the work folder."""
    fit = sorted(str(path) for path in (folder / "fit").glob("*.parquet"))
    made = {name: str(work / f"{name}.yaml") for name in ("rotors", "motors", "repaired", "plant", "predictor")}
    refine = ["refine", *fit, "--weight", f"square={GENTLE}"]
    body = ["--effects", ",".join(BODY)]
    kept_numbers = {name: ["--json", str(work / f"{name}.json")] for name in ("plant", "predictor")}
    together = ",".join(MOTORS + BESIDE)
    options = {
        "rotors": ["fit-rotors", *fit, "--offset", "--per-motor", "--set", f"mass={MASS}"],
        "motors": ["refine", *fit, "--model", made["rotors"], "--estimator", "innovations", "--effects", together],
        "repaired": [*refine, "--model", made["motors"], *body],
        "plant": [*refine, "--model", made["motors"], *body, "--as-logged", *kept_numbers["plant"]],
        "predictor": [*refine, "--model", made["repaired"], *body, "--predictor", *kept_numbers["predictor"]],
    }
    return {name: [*command, "-o", made[name]] for name, command in options.items()}


def kept(path: Path, make: Callable[[], dict]) -> dict:
    """What an earlier run left, else what ``make`` gives."""
    if not path.exists():
        write_json(path, make())
    return json.loads(path.read_text())


def group_of(name: str) -> str:
    """The group of a flight."""
    return next(group for group, prefixes in GROUPS.items() if name.startswith(prefixes))


def errors(described: ModelFile, logs: list[FlightLog], observer: Observer | None = None) -> dict:
    """Mean attitude, rad, and velocity error, m/s, by group, horizon and kind of prediction."""
    faults = SensorFaults.from_mappings(described.effects, described.name)
    found = {}
    for group in GROUPS:
        chosen = [log for log in logs if group_of(log.name) == group]
        result = evaluate(Quadrotor.from_file(described), chosen, observer=observer, faults=faults)
        for variant in result.variants:
            seen = result.metrics(variant)
            for horizon in ("0.05", "0.1", "0.2", "0.5"):
                attitude = float(np.radians(seen[f"attitude_mean_deg@{horizon}s"]))
                found[f"{variant} {group} {horizon}"] = attitude, seen[f"velocity_mean_mps@{horizon}s"]
    return found


def columns(made: dict[str, ModelFile], fit: list[FlightLog]) -> dict:
    """The fit flights, predicted with the sensor faults taken out and as they were logged."""
    faults = SensorFaults.from_mappings(made["repaired"].effects, "repaired")
    found = {name: errors(made[name], fit) for name in ("repaired", "plant")}
    bands = {f"{low:g} to {high:g} Hz": stretched(fit, low, high) for low, high in BANDS}
    return {"stretch": faults.stretch.tolist(), "bands": bands, "errors": found}


def tilts(logs: dict[str, list[FlightLog]], scale: float) -> dict[str, dict]:
    """`tilted` of every group of the flights fitted to and judged on."""
    titles = {"fit": "fitted to", "validation": "judged on"}
    return {
        f"{titles[part]}, {group}": tilted([log for log in some if group_of(log.name) == group], scale)
        for part, some in logs.items()
        for group in GROUPS
    }


def tilted(logs: list[FlightLog], scale: float) -> dict[str, dict]:
    """What estimators would have done to the tilt: one that ignores drag, one whose flow is stretched."""
    made = {"ignoring": fit_flow_estimator(logs), "stretched": fit_flow_estimator(logs, scale, 0.0)}
    return {name: asdict(estimator) for name, estimator in made.items()}


def stretched(logs: list[FlightLog], low: float, high: float) -> dict[str, list[float]]:
    """Velocity, and specific force turned by the attitude, over what position says, of motion between ``low`` and
    ``high`` Hz; horizontally and vertically, over all flights."""
    step, edge = 0.01, 150
    sos = butter(2, [low, high], "band", fs=1 / step, output="sos")
    found: dict[str, list[tuple]] = {"horizontal": [], "vertical": []}
    for log in logs:
        grid = np.arange(log.time[0], log.time[-1], step)
        force = to_world(log.quaternion, log.specific_force)
        place, speed, force = (
            sosfiltfilt(sos, interpolate(log.time, x, grid), axis=0) for x in (log.position, log.velocity, force)
        )
        slope = np.gradient(place, step, axis=0)
        for name, axes in (("horizontal", slice(0, 2)), ("vertical", slice(2, 3))):
            pairs = (slope, speed), (np.gradient(slope, step, axis=0), force)
            found[name].append([(x[edge:-edge, axes], y[edge:-edge, axes]) for x, y in pairs])
    return {name: [_in_step([row[i] for row in rows], step) for i in range(2)] for name, rows in found.items()}


def _in_step(parts: list[tuple[np.ndarray, np.ndarray]], step: float) -> float:
    """How many times larger the second is than the first; what is a quarter turn ahead or behind does not count."""
    one, other = (np.concatenate([x.ravel() for x in side]) for side in zip(*parts, strict=True))
    beside = np.concatenate([np.gradient(x, step, axis=0).ravel() for x, _ in parts])
    return float(np.linalg.lstsq(np.stack([one, beside], axis=1), other)[0][0])


def leaning(logs: list[FlightLog]) -> list[tuple[float, float]]:
    """What the velocity column takes off per distance from the middle, 1/s, beside a scale and an age of its own: along
    x and y, the mean of the flights and its standard deviation."""
    step, edge = 0.01, 150
    sos = butter(2, SLOW, fs=1 / step, output="sos")
    found = []
    for log in logs:
        grid = np.arange(log.time[0], log.time[-1], step)
        place, speed = (
            sosfiltfilt(sos, interpolate(log.time, x, grid), axis=0)[:, :2] for x in (log.position, log.velocity)
        )
        slope = np.gradient(place, step, axis=0)
        signals = np.stack([slope, np.gradient(slope, step, axis=0), place, np.ones_like(place)])[:, edge:-edge]
        fits = [np.linalg.lstsq(signals[..., axis].T, speed[edge:-edge, axis])[0] for axis in range(2)]
        found.append([-fit[2] for fit in fits])
    deviation = np.std(found, axis=0, ddof=1) / np.sqrt(len(found))
    return [(float(m), float(s)) for m, s in zip(np.mean(found, axis=0), deviation, strict=True)]


def without_each(plant: ModelFile, fit: list[FlightLog], judged: list[FlightLog]) -> dict:
    """Errors with one effect taken out and the others fitted again."""
    weights = {log.name: float(GENTLE) for log in fit if group_of(log.name) == "square"}
    found = {}
    for name in (*BODY, *MOTORS):
        less = replace(plant, effects=tuple(e for e in plant.effects if e["name"] != name))
        print(f"without {name}", flush=True)
        refitted, _ = by_predictions(less, fit, [n for n in BODY if n != name], weights=weights)
        found[name] = errors(refitted, judged)
    return found


def tuned(plant: ModelFile, fit: list[FlightLog]) -> dict:
    """Levels of the observer that predict the fit flights best."""
    groups = {group: [log for log in fit if group_of(log.name) == group] for group in GROUPS}
    faults = SensorFaults.from_mappings(plant.effects, plant.name)
    say = partial(print, flush=True)
    return asdict(tune_observer(Quadrotor.from_file(plant), groups, faults=faults, progress=say))


def sums(models: dict[str, ModelFile], judged: list[FlightLog], observer: Observer) -> dict:
    """The IDSIA benchmark's sums on the validation flights."""
    built = {}
    for suffix, beside in (("", None), (", observer", observer)):
        built |= {name + suffix: Contestant.of(described, beside) for name, described in models.items()}
    rows = benchmark(judged, built, 1, lambda *_: None)["rows"]
    return {name: [row[f"{q}_sum_{u}"] for q, u in QUANTITIES.items()] for name, row in rows.items()}


def repeats(models: dict[str, ModelFile], logs: list[FlightLog]) -> dict:
    """Pairs of flights of one reference: what each model misses in both."""
    found = {}
    for one, other in combinations(sorted(logs, key=lambda log: log.name), 2):
        if one.name.split("_")[0] != other.name.split("_")[0]:
            continue
        seen = {}
        for name, described in models.items():
            faults = SensorFaults.from_mappings(described.effects, described.name)
            pair = (faults.repaired(one), faults.repaired(other))
            result = repeated(Quadrotor.from_file(described), *pair)
            seen[name] = {"correlation": result.correlation.tolist(), "rms": result.rms.tolist()}
            seen[name] |= {"shared": result.shared.tolist(), "distance": result.distance}
        found[f"{one.name} {other.name}"] = seen
    return found


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
            f"{MASS} kg. Fitted to: {', '.join(results['fit'])}. Judged on: {', '.join(results['validation'])}.",
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
            "- *predictor*: inertia left free. It predicts gentle flights best and is a wrong plant: `cfb refine`",
            "  marks it so.",
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
            "## The room",
            "",
            *_room(models["plant"], results["leaning"]),
            "",
            "## The velocity column",
            "",
            *_columns(results["columns"], results["tilt"]),
            "",
            "## The observer",
            "",
            "A torque, a force and, where rotor speed was measured, motor errors, estimated from data before each",
            "window's start; how much they may wander was chosen by predictions of the flights fitted to, gentle and",
            "square alike (`cfb_mjx.sysid.observer_tuning`):",
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
            "## The nano-drone benchmark on these flights",
            "",
            "Sums of mean errors over 50 steps of 10 ms, rotor speeds in ([rules](nanodrone.md)): position m, velocity",
            "m/s, attitude rad, body rate rad/s, and beside each its share of the rows *naive* and *physics*.",
            "Published rows are on the benchmark's own test flights, which are easier to predict from how the drone",
            "moves: *physics*, one and the same rule, errs a smaller share of *naive* there. Compare shares of both.",
            "",
            "| | position | velocity | attitude | body rate |",
            "|---|---|---|---|---|",
            *_sums(results["sums"]),
            *_sums(PUBLISHED | {"goal": SUMS_GOAL}, "on those: "),
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
                missed.append(f"{TITLES[variant]}, {group}, {what}: {value:.3f} where {goal:.2f} was the goal")
    gentle = plant["commands_in gentle 0.5"][0], declared["hold gentle 0.5"][0]
    hold = "better" if gentle[0] < gentle[1] else "still worse"
    text = [
        f"On gentle flights the plant, commands in, is {hold} than hold in attitude ({gentle[0]:.3f} against "
        f"{gentle[1]:.3f} rad).",
    ]
    if missed:
        text += ["", "**Goals not reached**:", "", *(f"- {line}" for line in missed)]
    return text


def _room(plant: ModelFile, leaning_by: list) -> list[str]:
    effects = {e["name"]: e for e in plant.effects}
    room, flapping, drag = (effects[name] for name in ("room_circulation", "blade_flapping", "rotor_drag"))
    uneven = flapping["parameters"]["anisotropy"]
    rows = []
    for i, (axis, lean) in enumerate(zip("xy", leaning_by, strict=True)):
        told = []
        per_speed = flapping["parameters"]["coefficient"] * (1 + uneven if axis == "x" else 1 - uneven)
        for field, by in (("moment_gradient", per_speed), ("drag_gradient", drag["parameters"]["coefficient"])):
            value, std = (room[kind][field][i] for kind in ("parameters", "uncertainty"))
            told.append(f"{value / by:.3f} +- {abs(std / by):.3f}")
        rows.append(f"| {axis} | " + " | ".join(told) + f" | {lean[0]:.3f} +- {lean[1]:.3f} |")
    return [
        "`room_circulation` lets moment and drag hang on the place as they would in air that moves towards the middle",
        "of the room, the faster the farther out. By which share of the distance a second it does, told by the moments",
        "(over `blade_flapping`) and by the drag (over `rotor_drag`), and what of that is the velocity column's own:",
        f"its part below {SLOW:g} Hz regressed on the slope of the position, its slope and the position.",
        "",
        "| axis | by moments, 1/s | by drag, 1/s | missing from the velocity column, 1/s |",
        "|---|---:|---:|---:|",
        *rows,
    ]


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
    return [
        f"The sensors, compared with each other, say that the logged velocity is {across:.3f} times too large",
        f"horizontally and {up:.3f} times vertically (`sensor_velocity_scale`). The drone carried a flow deck, which",
        "measures horizontal velocity by optical flow and height by a ranger. The tilt is too large as well, says the",
        "accelerometer, turned by the logged attitude and set beside the position; in the flights fitted to:",
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
        "corrected by more than either explains. Taking the scale out of the velocity alone leaves the tilt that moves",
        "the drone too large: positions are predicted better, the velocity column worse. The plant therefore takes",
        "columns as they were logged (`--as-logged`): they agree with each other, and its drag and thrust are those",
        "of this velocity; the predictor takes the scale out.",
        "Mean errors on the flights fitted to after 0.5 s, attitude, rad, / velocity as logged, m/s:",
        "",
        "| prediction | flights | scale taken out | as logged |",
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
    "room_circulation": "the air of the room, drawn inwards by the drone's own jet; see below",
    "battery_sag": "rotor speed follows the charge of the battery, little its dips under load (hence the lag)",
    "motor_asymmetry": "motors are driven up and coast down",
}


def _effects(plant: ModelFile, results: dict) -> list[str]:
    keys = [f"{variant} {group} 0.5" for variant in ("commands_in", "rotor_speed_in") for group in GROUPS]
    own, rows = results["errors"]["plant"], []
    for name, less in results["without"].items():
        growth = max(less[key][0] / own[key][0] - 1 for key in keys)
        effect = next((e for e in plant.effects if e["name"] == name), None)
        numbers = "; ".join(
            _number(k, v, (effect.get("uncertainty") or {}).get(k)) for k, v in effect["parameters"].items()
        )
        rows.append((growth, f"| {name} | {numbers} | {growth:+.0%} | {ARGUMENTS[name]} |"))
    return [row for _, row in sorted(rows, key=lambda pair: -pair[0])]


def _number(name: str, value, std) -> str:
    values, stds = (x if isinstance(x, list) else [x] for x in (value, std))
    stds = stds if len(stds) == len(values) else [None] * len(values)
    return f"{name} " + ", ".join(
        f"{v:.3g}" + (f" +- {s:.1g}" if s is not None else "") for v, s in zip(values, stds, strict=True)
    )


def _levels(observer: dict) -> list[str]:
    def text(value) -> str:
        return " / ".join(f"{x:.3g}" for x in value) if isinstance(value, list | tuple) else f"{value:.3g}"

    return ["| level | value |", "|---|---|", *(f"| `{name}` | {text(value)} |" for name, value in observer.items())]


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


def _sums(rows: dict, prefix: str = "") -> list[str]:
    shares = list(zip(rows["naive"], rows["physics"], strict=True))
    return [
        f"| {prefix}{name} | "
        + " | ".join(f"{x:.3g} ({x / n:.2f} / {x / p:.2f})" for x, (n, p) in zip(row, shares, strict=True))
        + " |"
        for name, row in rows.items()
    ]


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


def main() -> None:
    """Run what is missing, then write the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--work", type=Path, default=Path("out/real"))
    arguments = parser.parse_args()
    work = arguments.work
    work.mkdir(parents=True, exist_ok=True)
    configure_jax(x64=True)
    logs = {
        part: [read_log(p) for p in sorted((arguments.folder / part).glob("*.parquet"))]
        for part in ("fit", "validation")
    }
    if not all(logs.values()):
        sys.exit(f"{arguments.folder}: holds no fit/*.parquet or no validation/*.parquet")
    commands = steps(arguments.folder, work)
    for name, command in commands.items():
        if not (work / f"{name}.yaml").exists():
            print(f"cfb {command[0]} -> {name}.yaml", flush=True)
            subprocess.run([sys.executable, "-m", "cfb_mjx.cli", *command], check=True)
    declared = load_model_file("cfb-guards").with_values("weighed with its decks", mass=MASS)
    made = {name: load_model_file(work / f"{name}.yaml") for name in ("motors", "repaired", "plant", "predictor")}
    models = {
        "declared": declared,
        "innovations": made["motors"],
        "plant": made["plant"],
        "predictor": made["predictor"],
    }
    judged = logs["validation"]
    results = {part: [log.name for log in some] for part, some in logs.items()}
    results["columns"] = kept(work / "columns.json", lambda: columns(made, logs["fit"]))
    scale = results["columns"]["stretch"][0]
    results["tilt"] = kept(work / "tilt.json", lambda: tilts(logs, scale))
    results["leaning"] = kept(work / "leaning.json", lambda: {"by_axis": leaning(logs["fit"])})["by_axis"]
    results["observer"] = kept(work / "observer.json", lambda: tuned(made["plant"], logs["fit"]))
    observer = Observer(**results["observer"])
    results["errors"] = kept(
        work / "errors.json", lambda: {name: errors(model, judged, observer) for name, model in models.items()}
    )
    results["without"] = kept(work / "without.json", lambda: without_each(made["plant"], logs["fit"], judged))
    both = {name: models[name] for name in ("declared", "plant")}
    results["repeats"] = kept(work / "repeats.json", lambda: repeats(both, logs["fit"] + judged))
    chosen = {"plant": made["plant"], "plant, scale taken out": made["repaired"], "predictor": made["predictor"]}
    results["sums"] = kept(work / "sums.json", lambda: sums(chosen, judged, observer))
    figure(results, PAGE.with_suffix(".png"))
    write_text(PAGE, page(models, results, commands))
    print(PAGE)


if __name__ == "__main__":
    main()
