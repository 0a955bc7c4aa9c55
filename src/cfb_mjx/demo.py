"""The demo: predictions of a flight, a batch of randomised drones, and predictions of a real flight."""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from cfb_mjx.files import shipped
from cfb_mjx.logs import FlightLog, read_log
from cfb_mjx.model import Quadrotor, State, rollout
from cfb_mjx.optional import not_none
from cfb_mjx.parameters import ModelFile, load_model_file, load_randomisation, sample_parameters
from cfb_mjx.sysid import evaluate
from cfb_mjx.sysid.evaluation import HORIZONS
from cfb_mjx.sysid.prediction import start_of_windows
from cfb_mjx.sysid.windows import find_windows
from cfb_mjx.view import prediction_figure, spread_figure
from cfb_mjx.view.demo import QUANTITIES
from cfb_mjx.view.spread import tilt_deg

MODEL = "cfb-guards"
LOG = "figure8"
ORIGIN = (
    "A simulated flight that is part of the project: an independent program integrated the same equations of motion "
    "and added sensor noise (data/flight_logs). The prediction errors here are mostly this noise."
)
REAL_MASS = 0.045
"""Mass of the drone of the IDSIA flights, which carries two decks, kg."""
DRONES = 4096
SECONDS = 0.5
"""Duration of a randomised rollout, s."""
KEPT = 5
"""Steps between states that are kept for the figure."""


def demonstrate(folder: Path, real: Path | None, progress: Callable[[str], None] = lambda _: None) -> dict[str, Any]:
    """Evaluate a flight, fly randomised drones, and evaluate a real flight if there is one. Needs 64-bit jax.

    Args:
        folder: folder for prediction.png, spread.png and real.png.
        real: folder with ``validation/*.parquet``; None skips the real flight.
        progress: called with a line of progress.

    Returns:
        JSON values under ``model``, ``flight``, ``rollouts`` and ``real``.

    Raises:
        CfbError: a flight cannot be read.
    """
    model = load_model_file(MODEL)
    with ThreadPoolExecutor(1) as thread:
        # Compile while the evaluation leaves a core free.
        program = thread.submit(_compile_rollouts, model)
        progress(f"1/3 evaluating {MODEL} on a flight")
        log = read_log(shipped("data", "flight_logs", f"{LOG}.mcap"))
        flight = _evaluated(model, log, folder / "prediction.png") | {"origin": ORIGIN}
        progress(f"2/3 flying {DRONES} randomised drones")
        rollouts = _fly_randomised(model, log, program.result(), folder / "spread.png")
    progress("3/3 evaluating a real flight")
    told = evaluate_real(model, real, folder / "real.png")
    return {"model": MODEL, "flight": flight, "rollouts": rollouts, "real": told}


def _evaluated(model: ModelFile, log: FlightLog, figure: Path, title: str | None = None) -> dict[str, Any]:
    begin = time.perf_counter()
    evaluation = evaluate(Quadrotor.from_file(model), [log])
    result = evaluation.to_json()
    del result["logs"]
    result |= {"log": log.name, "duration_s": log.duration, "wall_s": time.perf_counter() - begin}
    prediction_figure(evaluation, figure, title=title)
    return result


def evaluate_real(model: ModelFile, folder: Path | None, figure: Path) -> dict[str, Any]:
    """Evaluate a model on one of the real flights in a folder, or return the reason why it is skipped."""
    paths = [] if folder is None else sorted((folder / "validation").glob("*.parquet"))
    if not paths:
        lack = "" if folder is None else f"{folder} has no validation/*.parquet; "
        return {"skipped": f"{lack}give --real FOLDER with real flights, for instance the IDSIA nano-drone benchmark."}
    path = next((path for path in paths if path.stem.startswith("random1")), paths[0])
    heavier = model.with_values("weighed, with two decks", mass=REAL_MASS)
    result = _evaluated(heavier, read_log(path), figure, title=f"real flight {path.stem}")
    return result | {"mass_kg": REAL_MASS, "verdict": verdict_of(result)}


def verdict_of(result: dict) -> str:
    """Say whether the model predicts better than `hold`, with the numbers."""
    parts, worse = [], 0
    for quantity, unit, label in QUANTITIES:
        key = f"{quantity}_rmse_{unit}@0.5s"
        model, hold = result["commands_in"][key], result["hold"][key]
        worse += model > hold
        parts.append(f"{quantity} {model:.3g} against {hold:.3g} {label}")
    numbers = f"RMS errors after 0.5 s, model against hold: {', '.join(parts)}."
    if worse == len(QUANTITIES):
        return f"The declared model is worse than hold on this real flight. {numbers}"
    if worse:
        share = f"{worse} of {len(QUANTITIES)} quantities"
        return f"The declared model is worse than hold in {share} on this flight. {numbers}"
    return f"The declared model is better than hold on this flight. {numbers}"


def _steps(dt: float) -> int:
    """Number of steps of a randomised rollout, a multiple of `KEPT`."""
    return KEPT * round(SECONDS / dt / KEPT)


def _compile_rollouts(model: ModelFile) -> tuple[Callable, float]:
    """Compile the rollout of `DRONES` drones in float32; return it with the compile time, s."""

    def shaped(tree, *lead: int):
        return jax.tree.map(lambda x: jax.ShapeDtypeStruct((*lead, *x.shape), jnp.float32), tree)

    def fly(single, state, commands, parameters):
        drone = eqx.tree_at(lambda m: m.parameters, single, parameters)
        return rollout(drone, state, commands, every=KEPT)

    nominal = Quadrotor.from_file(model)
    commands = jax.ShapeDtypeStruct((_steps(nominal.dt), 4), jnp.float32)
    shapes = shaped(nominal), shaped(nominal.hover_state()), commands, shaped(nominal.parameters, DRONES)
    begin = time.perf_counter()
    compiled = jax.jit(jax.vmap(fly, in_axes=(None, None, None, 0))).lower(*shapes).compile()
    return compiled, time.perf_counter() - begin


def _fly_randomised(model: ModelFile, log: FlightLog, program: tuple[Callable, float], figure: Path) -> dict[str, Any]:
    """Replay half a second of the log's commands on drones drawn from the paper's randomisation, in float32."""
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
    keys = jax.random.split(jax.random.key(0), DRONES)
    drones = jax.jit(jax.vmap(lambda key: sample_parameters(key, single.parameters, ranges)))(keys)

    compiled, compile_s = program
    seconds, last = [], None
    for _ in range(4):  # The first run also allocates memory.
        begin = time.perf_counter()
        last = jax.block_until_ready(compiled(single, state, commands, drones))
        seconds.append(time.perf_counter() - begin)
    flown = not_none(last)

    position, tilt = np.asarray(flown.position), tilt_deg(np.asarray(flown.quaternion))
    _draw_spread(log, delay, start, windows, window, position, tilt, nominal.dt, figure)
    off = np.linalg.norm(position[:, -1] - windows.true_position[window, -1], axis=-1)
    best = min(seconds[1:])
    return {
        "drones": DRONES,
        "steps": steps,
        "step_s": nominal.dt,
        "kept_every": KEPT,
        "precision": str(flown.position.dtype),
        "randomisation": ranges.name,
        "compile_s": compile_s,
        "run_s": best,
        "steps_per_s": DRONES * steps / best,
        "distance_m@0.5s": dict(zip(("5%", "50%", "95%"), np.percentile(off, [5, 50, 95]).tolist(), strict=True)),
        "tilt_deg@0.5s": dict(zip(("5%", "50%", "95%"), np.percentile(tilt[:, -1], [5, 50, 95]).tolist(), strict=True)),
    }


def _state_at(windows, index: int, speeds: np.ndarray):
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
