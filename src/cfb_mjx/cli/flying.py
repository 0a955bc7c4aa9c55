"""``cfb fly``."""

from __future__ import annotations

from pathlib import Path

from cfb_mjx.cli.runtime import configure_jax, environment
from cfb_mjx.errors import CfbError
from cfb_mjx.files import require_folder, write_json

QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)


def run_fly(
    controller: str,
    task: str,
    model: str,
    plants: int,
    magnitude: float,
    randomisation: str,
    on: str | None,
    noise: bool,
    seed: int,
    json: Path | None,
    figure: Path | None,
) -> None:
    """Fly, print what was measured, write what was asked for.

    Raises:
        CfbError: an unknown controller, model or randomisation, impossible numbers, or outputs without a folder.
    """
    require_folder(json, figure)
    if on is not None and figure is not None:
        raise CfbError("--figure shows the flights of one model; leave out --on, or give the drone with --model.")
    if plants < 1:
        raise CfbError(f"--plants {plants}: at least one drone must fly.")
    if magnitude < 0:
        raise CfbError(f"--magnitude {magnitude}: must be zero or positive.")
    configure_jax(x64=False)
    import jax
    import numpy as np

    from cfb_mjx.control.pilot import find_pilot
    from cfb_mjx.envs import Noise, TargetTask
    from cfb_mjx.envs.episode import QUIET, longest_delay_s
    from cfb_mjx.model import Quadrotor
    from cfb_mjx.parameters import load_model_file, load_randomisation
    from cfb_mjx.train import flying

    described = load_model_file(model)
    nominal = Quadrotor.from_file(described)
    spread = load_randomisation(randomisation)
    course = TargetTask(
        noise=Noise() if noise else QUIET,
        randomisation=spread if magnitude else None,
        magnitude=magnitude,
        longest_delay_s=longest_delay_s(nominal),
    )
    # Scaled for the model that was named, whatever it is flown on.
    pilot = find_pilot(controller, nominal)
    keys = jax.random.split(jax.random.PRNGKey(seed), plants)

    def fly(drone):
        measured, flown = flying.TESTS[task](pilot, course, drone, keys)
        return summary(task, {k: np.asarray(v) for k, v in measured._asdict().items()}), flown

    result = {"controller": controller, "task": task, "model": model, "plants": plants, "magnitude": magnitude}
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
    if json is not None:
        write_json(json, result | {"environment": environment()})
        print(f"results: {json}")
    if figure is not None:
        from cfb_mjx.view.flight import flight_figure

        flight_figure(flown, pilot.control_dt_s, figure, f"{controller}, {task}, {model}")
        print(f"figure: {figure}")


def summary(task: str, measured: dict) -> dict:
    """JSON of a test: means over the flights, and over many also quantiles and the rate of success."""
    import numpy as np

    failed = measured["failed"]
    if task == "hover":
        values = {"mean_distance_mm": 1e3 * measured["mean_distance_m"], "command_std": measured["command_std"]}
        good = ~failed
    elif task == "step":
        values = {key: measured[key] for key in ("arrival_s", "peak_speed_mps", "overshoot_m")}
        good = ~failed & np.isfinite(measured["arrival_s"])
    else:
        values = {key: measured[key] for key in ("lost_height_m", "final_distance_m")}
        good = measured["recovered"]
    result = {key: float(np.mean(value)) for key, value in values.items()} | {"failed": bool(failed.any())}
    if len(failed) > 1:
        result |= {"failure_rate": float(failed.mean()), "success_rate": float(good.mean())}
        result["quantiles"] = {
            key: {f"{q:g}": float(np.quantile(value[good], q)) if good.any() else None for q in QUANTILES}
            for key, value in values.items()
        }
    elif task == "recover":
        result["recovered"] = bool(good[0])
    return result


_UNITS = {"mm": "mm", "s": "s", "mps": "m/s", "m": "m"}


def _label(key: str) -> str:
    name, _, unit = key.rpartition("_")
    return (f"{name} [{_UNITS[unit]}]" if unit in _UNITS else key).replace("_", " ")


def _print(result: dict) -> None:
    drones = "drone" if result["plants"] == 1 else "drones"
    print(f"{result['controller']}, {result['task']}: {result['plants']} {drones}, {result['model']}")
    quantiles = result.get("quantiles", {})
    for key, value in result.items():
        if key in ("controller", "task", "model", "plants", "magnitude", "quantiles"):
            continue
        shown = value if isinstance(value, bool) else f"{value:.4g}"
        spread = quantiles.get(key)
        more = (
            "" if not spread or spread["0.5"] is None else f"   median {spread['0.5']:.4g}, 95 % {spread['0.95']:.4g}"
        )
        print(f"  {_label(key):<24}{shown}{more}")


def _print_row(name: str, measured: dict, width: int) -> None:
    shown = [
        f"{_label(key)} {value:.4g}"
        for key, value in measured.items()
        if isinstance(value, float) and key not in ("failure_rate", "success_rate")
    ]
    lost = "   failed" if measured["failed"] and "failure_rate" not in measured else ""
    if measured.get("failure_rate"):
        lost = f"   {measured['failure_rate']:.0%} failed"
    print(f"  {name:<{width}}  {'   '.join(shown)}{lost}", flush=True)
