"""``cfb demo``: what the library does, on one page, in about a minute."""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from cfb_mjx.errors import CfbError
from cfb_mjx.files import shipped, together, write_json, write_text
from cfb_mjx.logs import FlightLog, read_log
from cfb_mjx.parameters import ModelFile, load_model_file, load_randomisation, sample_parameters
from cfb_mjx.runtime import environment
from cfb_mjx.view import Section, html_page, prediction_figure, spread_figure
from cfb_mjx.view.spread import tilt_deg

MODEL = "cfb-guards"
LOG = "figure8"
REAL_MASS = 0.045
"""The vehicle of the IDSIA flights carries two decks, kg."""
SECONDS = 0.5
"""How long a randomised rollout lasts, s."""
KEPT = 5
"""Every so many steps a state is kept for the figure."""
_CHECKOUT = Path(__file__).resolve().parents[3]
_VARIANTS = {"commands_in": "model, commands in", "rotor_speed_in": "model, rotor speed in", "hold": "hold"}
_ROWS = (("position", "m", "m"), ("velocity", "mps", "m/s"), ("attitude", "deg", "deg"), ("rate", "radps", "rad/s"))


@together()
def run_demo(output: Path, real: Path | None = None, *, rollouts: int = 4096) -> None:
    """Evaluate a flight, fly randomised drones, evaluate a real flight if there is one, and write a page.

    Writes ``index.html``, ``demo.json`` and the figures into ``output``. Call it with x64 enabled.

    Args:
        output: folder, made if missing.
        real: folder with ``validation/*.parquet``; by default ``shared/real`` beside the checkout.
        rollouts: number of randomised drones.

    Raises:
        CfbError: the output cannot be written or a flight cannot be read.
    """
    try:
        output.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise CfbError(f"{output}: the folder cannot be made ({error.strerror}); choose another place.") from None
    begin = time.perf_counter()
    model = load_model_file(MODEL)
    result: dict = {"model": MODEL}

    with ThreadPoolExecutor(1) as thread:
        # The evaluation leaves a core free.
        program = thread.submit(_compile_rollouts, model, rollouts)
        print(f"1/4 evaluating {MODEL} on a flight", flush=True)
        log, origin = _demo_log()
        result["flight"] = _evaluated(model, log, output / "prediction.png") | {"origin": origin}
        _print_errors(result["flight"])

        print(f"2/4 flying {rollouts} randomised drones", flush=True)
        result["rollouts"] = _fly_randomised(model, log, rollouts, output / "spread.png", program.result())
    _print_rollouts(result["rollouts"])

    print("3/4 evaluating a real flight", flush=True)
    result["real"] = _evaluate_real(model, real, output / "real.png")
    if "skipped" in result["real"]:
        print(f"    skipped: {result['real']['skipped']}", flush=True)
    else:
        _print_errors(result["real"])
        print(f"    {result['real']['verdict']}", flush=True)

    print("4/4 writing the page", flush=True)
    result["environment"] = environment()
    result["wall_s"] = time.perf_counter() - begin
    write_json(output / "demo.json", result)
    write_text(output / "index.html", _page(result, output))
    print(f"\ndone in {result['wall_s']:.0f} s. Open {output / 'index.html'}")
    figures = [output / name for name in ("prediction.png", "spread.png", "real.png")]
    print(f"figures: {', '.join(str(path) for path in figures if path.name != 'real.png' or _has_real(result))}")
    print(f"numbers: {output / 'demo.json'}")


def _has_real(result: dict) -> bool:
    return "skipped" not in result["real"]


# ------------------------------------------------------------------------------------------------- evaluations


def _demo_log() -> tuple[FlightLog, str]:
    return read_log(shipped("data", "flight_logs", f"{LOG}.mcap")), (
        "A simulated flight that comes with the project: another program integrated the same equations of motion "
        "and added sensor noise (data/flight_logs). What the model misses here is mostly that noise."
    )


def _evaluated(model: ModelFile, log: FlightLog, figure: Path, title: str | None = None) -> dict:
    from cfb_mjx.model import Quadrotor
    from cfb_mjx.sysid import evaluate

    begin = time.perf_counter()
    evaluation = evaluate(Quadrotor.from_file(model), [log])
    result = evaluation.to_json()
    del result["logs"]
    result |= {"log": log.name, "duration_s": log.duration, "wall_s": time.perf_counter() - begin}
    prediction_figure(evaluation, figure, title=title)
    return result


def _evaluate_real(model: ModelFile, folder: Path | None, figure: Path) -> dict:
    asked = folder is not None
    folder = folder if asked else _CHECKOUT.parent / "shared" / "real"
    paths = sorted((folder / "validation").glob("*.parquet"))
    if not paths:
        where = f"{folder} has no validation/*.parquet" if asked else "no folder with real flights was given"
        return {"skipped": f"{where}; name one with --real FOLDER (the IDSIA nano-drone benchmark fits)."}
    path = next((path for path in paths if path.stem.startswith("random1")), paths[0])
    heavier = model.with_values("weighed, with two decks", mass=REAL_MASS)
    result = _evaluated(heavier, read_log(path), figure, title=f"real flight {path.stem}")
    return result | {"mass_kg": REAL_MASS, "verdict": _verdict(result)}


def _verdict(result: dict) -> str:
    """Whether the model is better than knowing no physics, from the numbers."""
    parts, worse = [], 0
    for quantity, unit, label in _ROWS:
        key = f"{quantity}_rmse_{unit}@0.5s"
        model, hold = result["commands_in"][key], result["hold"][key]
        worse += model > hold
        parts.append(f"{quantity} {model:.3g} against {hold:.3g} {label}")
    numbers = f"After 0.5 s its RMS errors against those of hold are: {', '.join(parts)}."
    if worse == len(_ROWS):
        return f"The declared model is worse than hold on this real flight. {numbers}"
    if worse:
        return f"The declared model is worse than hold in {worse} of {len(_ROWS)} quantities on this flight. {numbers}"
    return f"The declared model is better than hold on this flight. {numbers}"


# ---------------------------------------------------------------------------------------------------- rollouts


def _steps(dt: float) -> int:
    """Of a randomised rollout: as many as are kept, times `KEPT`."""
    return KEPT * round(SECONDS / dt / KEPT)


def _compile_rollouts(model: ModelFile, count: int) -> tuple[Callable, float]:
    """The program that flies ``count`` drones, and how long it took to compile [s]; float32."""
    import equinox as eqx
    import jax
    import jax.numpy as jnp

    from cfb_mjx.model import Quadrotor, rollout

    def shaped(tree, *lead: int):
        return jax.tree.map(lambda x: jax.ShapeDtypeStruct((*lead, *x.shape), jnp.float32), tree)

    def fly(single, state, commands, parameters):
        drone = eqx.tree_at(lambda m: m.parameters, single, parameters)
        return rollout(drone, state, commands, every=KEPT)

    nominal = Quadrotor.from_file(model)
    commands = jax.ShapeDtypeStruct((_steps(nominal.dt), 4), jnp.float32)
    shapes = shaped(nominal), shaped(nominal.hover_state()), commands, shaped(nominal.parameters, count)
    begin = time.perf_counter()
    compiled = jax.jit(jax.vmap(fly, in_axes=(None, None, None, 0))).lower(*shapes).compile()
    return compiled, time.perf_counter() - begin


def _fly_randomised(
    model: ModelFile, log: FlightLog, count: int, figure: Path, program: tuple[Callable, float]
) -> dict:
    """Replay half a second of the log's commands on drones drawn from the paper's randomisation, in float32."""
    import jax
    import jax.numpy as jnp

    from cfb_mjx.model import Quadrotor
    from cfb_mjx.sysid.evaluation import HORIZONS
    from cfb_mjx.sysid.prediction import start_of_windows
    from cfb_mjx.sysid.windows import find_windows

    nominal = Quadrotor.from_file(model)
    delay = log.observation_delay
    delay = float(nominal.parameters.pose_delay) if delay is None else delay
    windows = find_windows(log, HORIZONS, delay, float(nominal.parameters.gyro_delay))
    speeds = start_of_windows(nominal, log, windows, delay)[0]
    window = len(windows) // 2
    start = windows.start[window]
    steps = _steps(nominal.dt)
    instants = start + nominal.dt * np.arange(steps)
    held = np.searchsorted(log.time, instants + 1e-9, side="right") - 1

    single = jax.tree.map(lambda x: x.astype(jnp.float32), nominal)
    state = _state_at(windows, window, speeds)
    commands = jnp.asarray(log.command[held], jnp.float32)
    ranges = load_randomisation("paper")
    keys = jax.random.split(jax.random.key(0), count)
    drones = jax.jit(jax.vmap(lambda key: sample_parameters(key, single.parameters, ranges)))(keys)

    compiled, compile_s = program
    seconds = []
    for _ in range(4):  # The first run also touches memory for the first time.
        begin = time.perf_counter()
        flown = jax.block_until_ready(compiled(single, state, commands, drones))
        seconds.append(time.perf_counter() - begin)

    position, tilt = np.asarray(flown.position), tilt_deg(np.asarray(flown.quaternion))
    _draw_spread(log, delay, start, windows, window, position, tilt, nominal.dt, figure)
    off = np.linalg.norm(position[:, -1] - windows.true_position[window, -1], axis=-1)
    best = min(seconds[1:])
    return {
        "drones": count,
        "steps": steps,
        "step_s": nominal.dt,
        "precision": str(flown.position.dtype),
        "randomisation": ranges.name,
        "compile_s": compile_s,
        "run_s": best,
        "steps_per_s": count * steps / best,
        "distance_m@0.5s": dict(zip(("5%", "50%", "95%"), np.percentile(off, [5, 50, 95]).tolist(), strict=True)),
        "tilt_deg@0.5s": dict(zip(("5%", "50%", "95%"), np.percentile(tilt[:, -1], [5, 50, 95]).tolist(), strict=True)),
    }


def _state_at(windows, index: int, speeds: np.ndarray):
    import jax.numpy as jnp

    from cfb_mjx.model import State

    measured = (windows.position, windows.velocity, windows.quaternion, windows.body_rate, speeds)
    return State(*(jnp.asarray(values[index], jnp.float32) for values in measured))


def _draw_spread(log, delay, start, windows, index, position, tilt, dt, figure: Path) -> None:
    kept = dt * KEPT * np.arange(1, position.shape[1] + 1)
    first = np.broadcast_to(windows.position[index], (len(position), 1, 3))
    first_tilt = np.full((len(position), 1), tilt_deg(windows.quaternion[index]))
    at = log.time - delay - start
    inside = (at >= 0) & (at <= kept[-1] + 1e-9)
    spread_figure(
        np.concatenate([[0.0], kept]),
        np.concatenate([first, position], axis=1),
        np.concatenate([first_tilt, tilt], axis=1),
        figure,
        reference=(at[inside], log.position[inside], tilt_deg(log.quaternion[inside])),
        reference_label=f"flight {log.name}",
        title=f"{len(position)} randomised drones, the same state and commands for all",
    )


# --------------------------------------------------------------------------------------------- output as text


def _error_rows(result: dict) -> list[list[str]]:
    """One row per quantity and variant: RMS error at every horizon, with its interval."""
    rows = []
    for quantity, unit, label in _ROWS:
        for variant, name in _VARIANTS.items():
            if result[variant] is None:
                continue
            cells = []
            for key in _keys(result, quantity, unit):
                low, high = result["intervals"][variant][key]
                cells.append(f"{result[variant][key]:.3g} [{low:.3g}, {high:.3g}]")
            rows.append([f"{quantity}, {label}", name, *cells])
    return rows


def _keys(result: dict, quantity: str, unit: str) -> list[str]:
    return [key for key in result["hold"] if key.startswith(f"{quantity}_rmse_{unit}@")]


def _horizons(result: dict) -> list[str]:
    return [f"{float(key.partition('@')[2][:-1]) * 1e3:.0f} ms" for key in _keys(result, "position", "m")]


def _print_errors(result: dict) -> None:
    print(f"    {result['log']}: {result['windows']} windows, RMS error after 0.5 s [95 % interval]")
    for what, name, *cells in _error_rows(result):
        print(f"    {what:<16}{name:<24}{cells[-1]}", flush=True)


def _print_rollouts(result: dict) -> None:
    print(
        f"    {result['steps_per_s'] / 1e6:.1f} million steps/s ({result['precision']}, best of 3); "
        f"compiled in {result['compile_s']:.1f} s, one run takes {result['run_s'] * 1e3:.0f} ms",
        flush=True,
    )


def _page(result: dict, folder: Path) -> str:
    flight, flown, real = result["flight"], result["rollouts"], result["real"]
    distance, tilt = flown["distance_m@0.5s"], flown["tilt_deg@0.5s"]

    def errors(block: dict) -> tuple:
        caption = f"RMS error over {block['windows']} windows [95 % bootstrap interval]"
        return caption, ["quantity", "predicted by", *_horizons(block)], _error_rows(block)

    sections = [
        Section(
            f"One flight, predicted by {result['model']}",
            [
                flight["origin"],
                f"Every 0.2 s of {flight['duration_s']:.1f} s of flight the model starts from the measured state and "
                "predicts half a second without looking again. Commands in: it receives what the motors were told. "
                "Rotor speed in: it receives the measured rotor speeds, so the motor model plays no part. Hold: "
                "constant velocity and constant body rate, the baseline that knows no physics. In the figure a "
                "prediction starts at an open circle; one that diverges leaves its panel.",
            ],
            [errors(flight)],
            [(folder / "prediction.png", "Measured flight with open-loop predictions; error against horizon")],
        ),
        Section(
            f"{flown['drones']} randomised drones",
            [
                "All start from the same measured state and receive the same commands of the flight, half a second "
                "without feedback. Mass, inertia, motors, thrust, torque and centre of gravity are drawn from the "
                "paper's ranges. A centre of gravity a few millimetres off is enough to tip a drone over that nobody "
                "steers; a controller trained on such drones has to hold all of them.",
                f"Each flies {flown['steps']} steps of {flown['step_s'] * 1e3:g} ms; every {KEPT}th state is kept for "
                "the figure. Keeping the last state only is faster: see cfb bench.",
            ],
            [
                (
                    "Throughput, and where the drones are after 0.5 s",
                    ["", "value"],
                    [
                        ["steps per second (best of 3 runs)", f"{flown['steps_per_s'] / 1e6:.1f} million"],
                        ["run", f"{flown['run_s'] * 1e3:.1f} ms"],
                        ["compilation (or loading a cached program)", f"{flown['compile_s']:.1f} s"],
                        ["precision", flown["precision"]],
                        ["distance from the flight: 5, 50, 95 %", _spread_text(distance, "m")],
                        ["tilt: 5, 50, 95 %", _spread_text(tilt, "deg")],
                    ],
                )
            ],
            [(folder / "spread.png", "Quantile bands of position and tilt over half a second")],
        ),
    ]
    if _has_real(result):
        sections.append(
            Section(
                f"A real flight: {real['log']}",
                [
                    real["verdict"],
                    f"The vehicle weighs {real['mass_kg'] * 1e3:g} g and the mass is set to that; every other constant "
                    "is the declared one. The attitude is open-loop unstable, so a small error of torque grows "
                    "quickly. Errors like these are what refitting the model to logs is for.",
                ],
                [errors(real)],
                [(folder / "real.png", "Real flight with open-loop predictions; error against horizon")],
            )
        )
    else:
        sections.append(Section("A real flight", [f"Skipped: {real['skipped']}"]))
    lead = f"What the declared model predicts, how fast it runs, and where it fails. Made in {result['wall_s']:.0f} s."
    return html_page("cfb_mjx demo", lead, sections, result["environment"])


def _spread_text(quantiles: dict[str, float], unit: str) -> str:
    return ", ".join(f"{value:.3g}" for value in quantiles.values()) + f" {unit}"
