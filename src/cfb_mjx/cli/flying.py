"""``cfb fly``."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from cfb_mjx.documents import require_seed
from cfb_mjx.errors import CfbError
from cfb_mjx.files import require_folder, together, write_json
from cfb_mjx.runtime import configure_jax, environment
from cfb_mjx.terminal import print_paths

QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)
DEFAULT_TASK = "hover"


@dataclass(frozen=True)
class Outputs:
    """Files to write."""

    json: Path | None = None
    figure: Path | None = None
    recording: Path | None = None
    video: Path | None = None
    log: Path | None = None

    @property
    def of_one_model(self) -> bool:
        """Whether some show the flights of one model."""
        return any((self.figure, self.recording, self.video, self.log))


@dataclass(frozen=True)
class Turn:
    """What only flips take: see ``cfb fly --help``."""

    knobs: str | None = None
    changes: tuple[str, ...] = ()
    holder: str | None = None
    search: Literal["height", "margin"] | None = None
    keep: Path | None = None


def run_fly(
    controller: str,
    task: str | None,
    model: str,
    plants: int,
    magnitude: float,
    randomisation: str,
    on: str | None,
    noise: bool,
    seed: int,
    outputs: Outputs,
    turn: Turn,
    devices: int = 1,
    gyro: Literal["late", "local"] | None = None,
) -> None:
    """Fly, print what was measured, write what was asked for.

    Raises:
        CfbError: an unknown controller, model or randomisation, impossible numbers, options that do nothing, or outputs
            without a folder.
    """
    require_folder(*vars(outputs).values(), turn.keep)
    if on is not None and outputs.of_one_model:
        raise CfbError(
            "--figure, --recording, --video and --log show the flights of one model; leave out --on, or give the drone "
            "with --model."
        )
    if outputs.video is not None:
        from cfb_mjx.view.film import check_film

        check_film(outputs.video)
    if plants < 1:
        raise CfbError(f"--plants {plants}: at least one drone must fly.")
    if magnitude < 0:
        raise CfbError(f"--magnitude {magnitude}: must be zero or positive.")
    require_seed(seed, "--seed")
    configure_jax(x64=False, devices=devices)
    import equinox as eqx
    import jax
    import numpy as np

    from cfb_mjx.control.pilot import find_pilot, has_lumped_delay
    from cfb_mjx.devices import Devices
    from cfb_mjx.envs import Noise, TargetTask
    from cfb_mjx.envs.episode import QUIET, with_room
    from cfb_mjx.model import Quadrotor, require_possible
    from cfb_mjx.parameters import load_model_file, load_randomisation
    from cfb_mjx.train import flying
    from cfb_mjx.train.flips import FLIPS, flips

    if task is None and controller in FLIPS:
        controller, task = "flip", controller
    described = load_model_file(model)
    nominal = Quadrotor.from_file(described)
    spread = load_randomisation(randomisation)
    require_possible(nominal, spread, magnitude, "--magnitude")
    # Scaled for the model that was named, whatever it is flown on.
    pilot = find_pilot(controller, nominal)
    course = TargetTask(
        noise=Noise() if noise else QUIET,
        randomisation=spread if magnitude else None,
        magnitude=magnitude,
        lumped_delay=has_lumped_delay(controller) if gyro is None else gyro == "late",
    )
    if task is None:
        task = "flip" if asks_for_setpoints(pilot) else DEFAULT_TASK
    rotations = None
    if task in FLIPS:
        from cfb_mjx.cli.flipping import prepared

        wild = replace(course, randomisation=spread, magnitude=magnitude or 1.0)
        pilot, rotations = prepared(pilot, controller, task, turn, wild, nominal, seed)
    else:
        if asks_for_setpoints(pilot):
            raise CfbError(f"{controller}: is a flip policy and cannot fly --task {task}; fly flip or double-flip.")
        if turn != Turn():
            raise CfbError(f"--knobs, --set, --holder, --search and --keep are for flips, not for --task {task}.")
    test, course = flips if task in FLIPS else flying.TESTS[task], with_room(course, nominal)
    keys = jax.random.split(jax.random.PRNGKey(seed), plants)
    over = Devices.take(devices)
    divided = over.divided(lambda pilot, drone, keys: test(pilot, course, drone, keys), (None, None, 0), 0)

    def fly(drone):
        if over.several:
            found = over.here(eqx.filter_jit(divided)(pilot, drone, over.along(over.padded(keys))))
            measured, flown = jax.tree.map(lambda x: x[:plants], found)
        else:
            measured, flown = test(pilot, course, drone, keys)
        good = None if rotations is None else np.asarray(measured.completed(rotations))
        diverged = ~np.isfinite(np.asarray(flown.position)).all(axis=(1, 2))
        return summary(task, {k: np.asarray(v) for k, v in measured._asdict().items()}, good, diverged), flown

    result = {"controller": controller, "task": task, "model": model, "plants": plants, "magnitude": magnitude}
    result["gyro"] = "late" if course.lumped_delay else "local"
    if rotations is not None:
        result["knobs"] = {name: float(x) for name, x in pilot.knobs._asdict().items() if np.isfinite(x)}
    if on is None:
        measured, flown = fly(nominal)
        result |= measured
        _print(result)
    else:
        from cfb_mjx.train.plants import load_plants

        result |= {"set": on, "on": {}}
        drones = load_plants(described, on)
        for name, drone in drones.items():
            result["on"][name], _ = fly(drone)
            _print_row(name, result["on"][name], max(map(len, drones)))
    with together():
        if outputs.json is not None:
            write_json(outputs.json, result | {"environment": environment()})
        if outputs.of_one_model:
            from cfb_mjx.cli.flight_outputs import write_flights

            title = f"{controller}, {task}, {model}"
            write_flights(outputs, flown, pilot.control_dt_s, nominal, title, turning=rotations is not None)
    written = {"results": outputs.json, "figure": outputs.figure, "recording": outputs.recording}
    print_paths(**written, video=outputs.video, log=outputs.log)


def asks_for_setpoints(pilot) -> bool:
    """Whether this is a flip policy."""
    return bool(getattr(getattr(pilot, "layout", None), "setpoint_scales", ()))


def summary(task: str, measured: dict, completed=None, diverged=None) -> dict:
    """JSON of a test: means over the flights, and over many also quantiles and the rate of success.

    Flights that diverged failed; they are counted, and no mean is taken of them.

    Args:
        task: what was flown.
        measured: arrays, one number per flight.
        completed: for flips, who completed them.
        diverged: whose state is no number at the end; nobody's by default.
    """
    import numpy as np

    diverged = np.zeros_like(measured["failed"]) if diverged is None else diverged
    failed = measured["failed"] | diverged
    if task == "hover":
        values = {"mean_distance_mm": 1e3 * measured["mean_distance_m"], "command_std": measured["command_std"]}
        good = ~failed
    elif task == "step":
        values = {key: measured[key] for key in ("arrival_s", "peak_speed_mps", "overshoot_m")}
        good = ~failed & np.isfinite(measured["arrival_s"])
    elif task == "recover":
        values = {key: measured[key] for key in ("lost_height_m", "final_distance_m")}
        good = measured["recovered"] & ~diverged
    else:
        values = {key: value for key, value in measured.items() if key != "failed"}
        good = completed & ~diverged
    # A lost flip's numbers say nothing, and some are infinite.
    counted = good if completed is not None and good.any() else ~diverged
    result = {key: _finite(np.mean(value[counted])) if counted.any() else None for key, value in values.items()}
    result["failed"] = bool(failed.any())
    if diverged.any():
        result["diverged"] = int(diverged.sum())
    if len(failed) > 1:
        result |= {"failure_rate": float(failed.mean()), "success_rate": float(good.mean())}
        result["quantiles"] = {
            key: {f"{q:g}": _finite(np.quantile(value[good], q)) if good.any() else None for q in QUANTILES}
            for key, value in values.items()
        }
    elif task == "recover":
        result["recovered"] = bool(good[0])
    elif completed is not None:
        result["completed"] = bool(good[0])
    return result


def _finite(number) -> float | None:
    return float(number) if math.isfinite(number) else None


_UNITS = {"mm": "mm", "s": "s", "mps": "m/s", "m": "m", "radps": "rad/s"}


def _label(key: str) -> str:
    name, _, unit = key.rpartition("_")
    return (f"{name} [{_UNITS[unit]}]" if unit in _UNITS else key).replace("_", " ")


def _print(result: dict) -> None:
    drones = "drone" if result["plants"] == 1 else "drones"
    gyro = "the gyro as late as the pose" if result["gyro"] == "late" else "the gyro on the drone"
    print(f"{result['controller']}, {result['task']}: {result['plants']} {drones}, {result['model']}, {gyro}")
    quantiles = result.get("quantiles", {})
    for key, value in result.items():
        if key in ("controller", "task", "model", "plants", "magnitude", "gyro", "quantiles", "knobs", "diverged"):
            continue
        shown = value if isinstance(value, bool) else "never" if value is None else f"{value:.4g}"
        spread = quantiles.get(key)
        more = (
            "" if not spread or spread["0.5"] is None else f"   median {spread['0.5']:.4g}, 95 % {spread['0.95']:.4g}"
        )
        print(f"  {_label(key):<24}{shown}{more}")
    if "diverged" in result:
        print(f"  {_diverged(result)}")


def _diverged(measured: dict) -> str:
    return f"{measured['diverged']} diverged: their states are no numbers, they failed and are in no mean"


def _print_row(name: str, measured: dict, width: int) -> None:
    shown = [
        f"{_label(key)} {value:.4g}"
        for key, value in measured.items()
        if isinstance(value, float) and key not in ("failure_rate", "success_rate")
    ]
    lost = "   failed" if measured["failed"] and "failure_rate" not in measured else ""
    if measured.get("failure_rate"):
        lost = f"   {measured['failure_rate']:.0%} failed"
    lost += f"   {_diverged(measured)}" if "diverged" in measured else ""
    print(f"  {name:<{width}}  {'   '.join(shown)}{lost}", flush=True)
