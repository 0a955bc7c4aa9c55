"""Correct the model on real flights in the IDSIA layout.

    python scripts/close_real_flights.py FOLDER [--work out/real]

Writes docs/closing-real-flights.md with its figure, the summary in docs/closing-the-loop.md, and the plant and the
predictor as the presets cfb-idsia and cfb-idsia-predictor. FOLDER holds fit/*.parquet and validation/*.parquet. Nothing
is fitted to validation/. Only aggregate numbers are written; the flights do not become part of the project. Steps whose
results are already in the work folder are not repeated.
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
from typing import Any

import numpy as np
from marked_block import write_block
from real_flights_page import GROUPS, figure, page, summary
from scipy.signal import butter, sosfiltfilt

from cfb_mjx.files import write_json, write_text
from cfb_mjx.logs import FlightLog, read_log
from cfb_mjx.logs.resample import interpolate
from cfb_mjx.logs.rotation import to_body, to_world
from cfb_mjx.model import Quadrotor
from cfb_mjx.parameters import ModelFile, load_model_file, save_model_file
from cfb_mjx.runtime import configure_jax, environment
from cfb_mjx.sysid import evaluate
from cfb_mjx.sysid.flight import usual_delay
from cfb_mjx.sysid.flow_estimator import fit_flow_estimator
from cfb_mjx.sysid.nanodrone import QUANTITIES, Contestant, benchmark, benchmark_score, score, tune_observer
from cfb_mjx.sysid.observer import Observer
from cfb_mjx.sysid.refinement.model_files import by_predictions
from cfb_mjx.sysid.repeatability import repeated
from cfb_mjx.sysid.sensor_faults import SensorFaults
from cfb_mjx.sysid.tracing.sensors import check_sensors
from cfb_mjx.sysid.velocity_band import explained

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "closing-real-flights.md"
GUIDE = ROOT / "docs" / "closing-the-loop.md"
PRESETS = {
    "plant": ("cfb-idsia", "a plant"),
    "predictor": ("cfb-idsia-predictor", "a predictor, with inertia left free, no plant"),
}
MASS = 0.045
MOTORS = ("battery_sag", "motor_asymmetry")
BESIDE = ("blade_flapping", "thrust_scale", "inertia")
"""Effects fitted together with the motors, so that motor parameters do not absorb them."""
BODY = (
    *("blade_flapping", "inflow_thrust", "rotor_drag", "thrust_scale"),
    *("inertia", "cog_offset", "torque_scale", "thrust_tilt", "position_moment"),
)
FORECAST = (*BODY, "regression_dilution")
"""Effects of the predictor."""
GENTLE = 7
"""Weight of the square flight: the number of gentle fit flights, because the page reports both groups separately."""
PREDICTOR_SQUARE = 3
"""Weight of the square flight for the predictor: of 1, 3 and `GENTLE` the one with the smallest `benchmark_score` on
the fit flights, with the observer."""
JUDGES = {"plant": score, "predictor": benchmark_score}
"""Scores on the fit flights that the observer's levels are chosen by."""
SLOW = 2.0
"""Cut-off frequency, Hz, of the signals that `by_place` searches for a dependence on the position."""
STEP = 0.01
"""Time step of the uniform grid on which signals are filtered, s."""
INNER = slice(150, -150)
"""Rows that the transients at the ends of a filtered signal do not reach."""
PARTS = {"fit": "fitted to", "validation": "judged on"}
BANDS = ((0.1, 0.3), (0.2, 0.5), (0.5, 1.0))
"""Frequency bands, Hz; the derivative of the position does not resolve faster motion in the gentle flights."""


def steps(folder: Path, work: Path) -> dict[str, list[str]]:
    """Return the commands, by the name of the model file that each writes to the work folder."""
    fit = sorted(str(path) for path in (folder / "fit").glob("*.parquet"))
    made = {name: str(work / f"{name}.yaml") for name in ("rotors", "motors", "repaired", "plant", "predictor")}
    refine = ["refine", *fit, "--weight", f"square={GENTLE}"]
    body = ["--effects", ",".join(BODY)]
    forecast = ["--weight", f"square={PREDICTOR_SQUARE}", "--effects", ",".join(FORECAST)]
    kept_numbers = {name: ["--json", str(work / f"{name}.json")] for name in ("plant", "predictor")}
    together = ",".join(MOTORS + BESIDE)
    options = {
        "rotors": ["fit-rotors", *fit, "--offset", "--per-motor", "--set", f"mass={MASS}"],
        "motors": ["refine", *fit, "--model", made["rotors"], "--estimator", "innovations", "--effects", together],
        "repaired": [*refine, "--model", made["motors"], *body],
        "plant": [*refine, "--model", made["motors"], *body, "--as-logged", *kept_numbers["plant"]],
        "predictor": [
            *("refine", *fit, "--model", made["plant"], *forecast),
            *("--as-logged", "--predictor", *kept_numbers["predictor"]),
        ],
    }
    return {name: [*command, "-o", made[name]] for name, command in options.items()}


def kept(path: Path, make: Callable[[], dict]) -> dict:
    """Return the result of an earlier run from ``path``, or compute and store it with ``make``."""
    if not path.exists():
        write_json(path, make())
    return json.loads(path.read_text())


def group_of(name: str) -> str:
    """Return the group of the flight ``name``."""
    return next(group for group, prefixes in GROUPS.items() if name.startswith(prefixes))


def errors(described: ModelFile, logs: list[FlightLog], observer: Observer | None = None) -> dict:
    """Return the mean attitude error, rad, and velocity error, m/s, by kind of prediction, group and horizon."""
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


def columns(made: dict[str, ModelFile], logs: dict[str, list[FlightLog]]) -> dict:
    """Measure the fault of the logged velocity, as one stretch for all frequencies and as a band of frequencies.

    Also the errors on the fit flights with the sensor faults removed and as logged.
    """
    fit = logs["fit"]
    parameters = made["repaired"].parameters()
    even = check_sensors(fit, usual_delay(fit, parameters), float(parameters.gyro_delay)).faults
    band = SensorFaults.from_mappings(made["repaired"].effects, "repaired")

    def explains(some: list[FlightLog]) -> list[float]:
        return [float(np.mean([explained(faults, log) for log in some])) for faults in (even, band)]

    return {
        "stretch": even.stretch.scale.tolist(),
        "band": [band.velocity_scale, band.velocity_rise, band.velocity_fade],
        "explained": by_kind(logs, explains),
        "bands": {f"{low:g} to {high:g} Hz": stretched(fit, low, high) for low, high in BANDS},
        "errors": {name: errors(made[name], fit) for name in ("repaired", "plant")},
    }


def by_kind(logs: dict[str, list[FlightLog]], measure: Callable[[list[FlightLog]], Any]) -> dict[str, Any]:
    """Apply ``measure`` to every group of the fit flights and of the held-out flights."""
    return {
        f"{PARTS[part]}, {group}": measure([log for log in some if group_of(log.name) == group])
        for part, some in logs.items()
        for group in GROUPS
    }


def tilted(logs: list[FlightLog], scale: float) -> dict[str, dict]:
    """Fit two models of the on-board estimator to the logged tilt: one ignores drag, one has stretched optical flow."""
    made = {"ignoring": fit_flow_estimator(logs), "stretched": fit_flow_estimator(logs, scale, 0.0)}
    return {name: asdict(estimator) for name, estimator in made.items()}


def stretched(logs: list[FlightLog], low: float, high: float) -> dict[str, list[float]]:
    """Return ratios of the logged velocity and acceleration to the derivatives of the position.

    For motion between ``low`` and ``high`` Hz, over all flights, horizontally and vertically. The acceleration is the
    specific force, rotated by the logged attitude.
    """
    sos = butter(2, [low, high], "band", fs=1 / STEP, output="sos")
    found: dict[str, list[tuple]] = {"horizontal": [], "vertical": []}
    for log in logs:
        force = to_world(log.quaternion, log.specific_force)
        place, speed, force = _filtered(log, sos, log.position, log.velocity, force)
        slope = np.gradient(place, STEP, axis=0)
        for name, axes in (("horizontal", slice(0, 2)), ("vertical", slice(2, 3))):
            pairs = (slope, speed), (np.gradient(slope, STEP, axis=0), force)
            found[name].append([(x[INNER, axes], y[INNER, axes]) for x, y in pairs])
    return {name: [_in_step([row[i] for row in rows]) for i in range(2)] for name, rows in found.items()}


def _filtered(log: FlightLog, sos: np.ndarray, *signals: np.ndarray) -> list[np.ndarray]:
    """Resample signals of a log to a uniform grid of `STEP`, and filter them forwards and backwards."""
    grid = np.arange(log.time[0], log.time[-1], STEP)
    return [sosfiltfilt(sos, interpolate(log.time, x, grid), axis=0) for x in signals]


def _in_step(parts: list[tuple[np.ndarray, np.ndarray]]) -> float:
    """Return the gain of the in-phase part of the second signal over the first; a part in quadrature is removed."""
    one, other = (np.concatenate([x.ravel() for x in side]) for side in zip(*parts, strict=True))
    beside = np.concatenate([np.gradient(x, STEP, axis=0).ravel() for x, _ in parts])
    return float(np.linalg.lstsq(np.stack([one, beside], axis=1), other)[0][0])


def by_place(logs: list[FlightLog]) -> dict[str, dict[str, list[float]]]:
    """Return velocities per distance from the middle of the room, 1/s, along x and y, by flight.

    ``column`` is what the logged velocity lacks, apart from a scale and a delay. ``drag`` is the speed of the air, from
    the drag that the accelerometer measures in addition to the drag of the motion, apart from tilted thrust and a lag
    of the drag.
    """
    sos = butter(2, SLOW, fs=1 / STEP, output="sos")
    found = {}
    for log in logs:
        in_body = [to_body(log.quaternion, x) for x in (log.velocity, log.position * [1.0, 1.0, 0.0])]
        raw = (log.position, log.velocity, log.specific_force, *in_body)
        place, speed, force, own_speed, own_place = _filtered(log, sos, *raw)
        slope = np.gradient(place, STEP, axis=0)
        bend, turn = (np.gradient(x, STEP, axis=0) for x in (slope, own_speed))
        one = np.ones(len(place))
        column, drag = [], []
        for i in range(2):
            beside = np.stack([place[:, i], slope[:, i], bend[:, i], one], axis=1)
            column.append(float(-np.linalg.lstsq(beside[INNER], speed[INNER, i])[0][0]))
            felt = np.stack([own_place[:, i], own_speed[:, i], turn[:, i], force[:, 2], one], axis=1)
            pull, per_speed = np.linalg.lstsq(felt[INNER], force[INNER, i])[0][:2]
            drag.append(float(pull / per_speed))
        found[log.name] = {"column": column, "drag": drag}
    return found


def weighing(square: float, fit: list[FlightLog]) -> dict[str, float]:
    """Return the weights of the fit flights that count square flights ``square`` times."""
    return {log.name: float(square) for log in fit if group_of(log.name) == "square"}


def without_each(plant: ModelFile, fit: list[FlightLog], judged: list[FlightLog]) -> dict:
    """Return the errors with each effect removed and the others fitted again."""
    weights = weighing(GENTLE, fit)
    found = {}
    for name in (*BODY, *MOTORS):
        less = replace(plant, effects=tuple(e for e in plant.effects if e["name"] != name))
        print(f"without {name}", flush=True)
        refitted = by_predictions(less, fit, [n for n in BODY if n != name], weights=weights).model_file(less)
        found[name] = errors(refitted, judged)
    return found


def tuned(plant: ModelFile, fit: list[FlightLog], judge: Callable[..., float]) -> dict:
    """Return the levels of the observer with the best score of ``judge`` on the fit flights."""
    groups = {group: [log for log in fit if group_of(log.name) == group] for group in GROUPS}
    faults = SensorFaults.from_mappings(plant.effects, plant.name)
    say = partial(print, flush=True)
    return asdict(tune_observer(Quadrotor.from_file(plant), groups, faults=faults, progress=say, judge=judge))


def sums(models: dict[str, ModelFile], judged: list[FlightLog], observers: dict[str, Observer]) -> dict:
    """Return the sums of the IDSIA benchmark on the validation flights, together and flight by flight."""
    built = {name: Contestant.of(described) for name, described in models.items()}
    for name, described in models.items():
        built[f"{name}, observer"] = Contestant.of(described, observers.get(name, observers["plant"]))
    found = benchmark(judged, built, 1, lambda *_: None)
    return {"together": summed(found["rows"])} | {n: summed(flight["rows"]) for n, flight in found["flights"].items()}


def summed(rows: dict) -> dict[str, list[float]]:
    """Return the four sums of every row of the benchmark."""
    return {name: [row[f"{q}_sum_{u}"] for q, u in QUANTITIES.items()] for name, row in rows.items()}


def unseen(plant: ModelFile, logs: dict[str, list[FlightLog]], observer: Observer) -> dict[str, dict]:
    """Return the sums of the benchmark on kinds of reference that the predictor was not fitted to."""
    found = {}
    for kind in ("multisine", "random"):
        others = [log for log in logs["fit"] if not log.name.startswith(kind)]
        own = [log for log in logs["validation"] if log.name.startswith(kind)]
        print(f"predictor without {kind}", flush=True)
        found = by_predictions(plant, others, [*FORECAST], True, weighing(PREDICTOR_SQUARE, others))
        model = found.model_file(plant)
        built = {"predictor": Contestant.of(model), "predictor, observer": Contestant.of(model, observer)}
        found[kind] = summed(benchmark(own, built, 1, lambda *_: None)["rows"])
    return found


def published(name: str, described: ModelFile, what: str, fit: list[FlightLog]) -> ModelFile:
    """Return a fitted model as a preset, with its origin and without file names of this machine."""
    description = (
        "A Crazyflie 2.1 Brushless with AI-deck and flow deck, the drone of the IDSIA nano-drone benchmark (Busetto "
        f"et al., Control Engineering Practice 172, 2026): {what}. Velocities are those of its on-board estimator, and "
        "position_moment belongs to the room it flew in; docs/closing-real-flights.md says what each number is worth."
    )
    origin = {
        "made_by": "scripts/close_real_flights.py",
        "fitted_to": [log.name for log in fit],
        "environment": environment(),
    }
    weighed = described.with_values("weighed with its decks, the benchmark's description", mass=MASS)
    return replace(weighed, name=name, description=description, provenance=origin)


def repeats(models: dict[str, ModelFile], logs: list[FlightLog]) -> dict:
    """Return the residuals that two flights of one reference have in common, for each model."""
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


def main() -> None:
    """Run the missing steps, then write the page."""
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
        sys.exit(f"{arguments.folder}: has no fit/*.parquet or no validation/*.parquet")
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
    results = {part: [log.name for log in some] for part, some in logs.items()} | {"mass": MASS, "slow": SLOW}
    results["columns"] = kept(work / "columns.json", lambda: columns(made, logs))
    scale = results["columns"]["stretch"][0]
    results["tilt"] = kept(work / "tilt.json", lambda: by_kind(logs, partial(tilted, scale=scale)))
    results["place"] = kept(work / "place.json", lambda: by_place(logs["fit"]))
    results["observer"] = {
        name: kept(work / f"observer-{name}.json", partial(tuned, made[name], logs["fit"], judge))
        for name, judge in JUDGES.items()
    }
    observers = {name: Observer(**levels) for name, levels in results["observer"].items()}
    results["errors"] = kept(
        work / "errors.json",
        lambda: {n: errors(model, judged, observers.get(n, observers["plant"])) for n, model in models.items()},
    )
    results["without"] = kept(work / "without.json", lambda: without_each(made["plant"], logs["fit"], judged))
    both = {name: models[name] for name in ("declared", "plant")}
    results["repeats"] = kept(work / "repeats.json", lambda: repeats(both, logs["fit"] + judged))
    chosen = {"plant": made["plant"], "plant, stretch taken out": made["repaired"], "predictor": made["predictor"]}
    results["sums"] = kept(work / "sums.json", lambda: sums(chosen, judged, observers))
    results["unseen"] = kept(work / "unseen.json", lambda: unseen(made["plant"], logs, observers["predictor"]))
    for name, (preset, what) in PRESETS.items():
        path = ROOT / "configs" / "parameters" / f"{preset}.yaml"
        save_model_file(published(preset, made[name], what, logs["fit"]), path)
    figure(results, PAGE.with_suffix(".png"))
    write_text(PAGE, page(models, results, commands))
    write_block(GUIDE, "real flights", summary(made["plant"], results))
    print(PAGE)


if __name__ == "__main__":
    main()
