"""Comparison of the brushless drone with the brushed one of earlier simulators."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from cfb_mjx.optional import not_none
from cfb_mjx.reproduce.flights import GENERATED, REAL_MASS_KG, SKIPPED, SOURCE, Given, generated, real_flights
from cfb_mjx.reproduce.item import Result, Row, write_csv

DRONES = {"brushless": "cfb-guards", "brushed": "cf2x"}
ABILITIES = {
    "to_weight": "thrust to weight",
    "roll_radps2": "roll acceleration, rad/s^2",
    "lag_s": "motor time constant, s",
}
QUANTITIES = (("velocity", "mps", "m/s"), ("attitude", "deg", "deg"), ("rate", "radps", "rad/s"))


def brushed(folder: Path, real: Path | None, given: Given | None = None) -> Result:
    """Compare thrust and agility of both, and their predictions of brushless and, if given, brushed flights."""
    from cfb_mjx.model import Quadrotor
    from cfb_mjx.parameters import load_model_file
    from cfb_mjx.sysid import evaluate

    files = {name: load_model_file(preset) for name, preset in DRONES.items()}
    able = {name: _abilities(file.parameters()) for name, file in files.items()}
    flights = {"generated": ([generated("figure8")], files)}
    text = [
        "The brushed Crazyflie 2.x with the constants of gym-pybullet-drones (`configs/parameters/cf2x.yaml` has the "
        "sources), and flights of a brushless Crazyflie predicted by both models from the same commands.",
        f"Generated: {GENERATED}.",
    ]
    real_logs = real_flights(real)
    if real_logs:
        heavy = files | {"brushless": files["brushless"].with_values("weighed, with two decks", mass=REAL_MASS_KG)}
        flights["real"] = (real_logs, heavy)
        text.append(f"Real: {len(real_logs)} flights, {SOURCE}; the brushless model has the weighed mass.")
    else:
        text.append(SKIPPED)
    if given is not None:
        flights["brushed flights"] = (list(given.logs), {"brushed": given.drone(DRONES["brushed"])})
        text.append(
            f"Brushed: {given.said()}. This is the paper's comparison: the brushed model on flights of a brushed drone."
        )
    else:
        text.append(
            "The paper compares a brushed model on brushed flights. No brushed flights are shipped: give a folder of "
            "them with --flights, and the drone's mass with --mass. Shown here is a brushed model on brushless flights."
        )
    errors: dict[tuple[str, str], dict] = {}
    for where, (logs, models) in flights.items():
        for name, file in models.items():
            found = evaluate(Quadrotor.from_file(file), logs)
            errors[where, name] = not_none(found.metrics("commands_in"))
            errors[where, "hold"] = not_none(found.metrics("hold"))
    less, more = able["brushed"]["thrust_n"], able["brushless"]["thrust_n"]
    limits = (
        "at full command of both; the brushed drone's limit is from gym-pybullet-drones, the brushless drone's from "
        "the paper's curve at 2900 rad/s"
    )
    rows = [Row("more thrust than the brushed one", "around 50 %", f"{100 * (more / less - 1):.0f} %", limits)]
    for key, what in ABILITIES.items():
        ours = f"{able['brushless'][key]:.3g} and {able['brushed'][key]:.3g}"
        rows.append(Row(f"{what}, brushless and brushed", "", ours))
    for where, (_, models) in flights.items():
        for quantity, unit, label in QUANTITIES:
            names = (*models, "hold")
            of = [errors[where, name][f"{quantity}_rmse_{unit}@0.2s"] for name in names]
            what = f"{quantity} error after 200 ms, {label} ({where}): {', '.join(names)}"
            rows.append(Row(what, "", ", ".join(f"{x:.3g}" for x in of)))
    write_csv(
        folder / "brushed.csv",
        ("flights", "model", "metric", "value"),
        [(*which, key, float(x)) for which, of in errors.items() for key, x in of.items()],
    )
    _draw(files, errors, {where: (*models, "hold") for where, (_, models) in flights.items()}, folder / "brushed.png")
    return Result("The brushed Crazyflie", text, rows, [(folder / "brushed.png", "thrust and prediction errors")])


def _abilities(p) -> dict[str, float]:
    from cfb_mjx.model.rotors import thrust

    full = np.asarray(thrust(p, p.motor_gain + p.motor_speed_offset))
    inertia = np.asarray(p.inertia)
    return {
        "thrust_n": float(full.sum()),
        "to_weight": float(full.sum() / (p.mass * p.gravity)),
        # Two rotors at full thrust, two at zero thrust.
        "roll_radps2": float(full[0] * p.rotor_spacing / inertia[0]),
        "lag_s": float(np.max(p.motor_time_constant)),
    }


def _draw(files: dict, errors: dict, places: dict[str, tuple[str, ...]], path: Path) -> None:
    from cfb_mjx.model.rotors import thrust
    from cfb_mjx.view.style import COLOURS, context, new_figure, save

    colours = {"brushless": COLOURS["commands_in"], "brushed": COLOURS["rotor_speed_in"], "hold": COLOURS["hold"]}
    horizons = (0.05, 0.1, 0.2, 0.5)
    with context():
        figure = new_figure(3.2 * 4, 3.0 * len(places))
        axes = figure.subplots(len(places), 4, squeeze=False)
        for row, where in zip(axes, places, strict=True):
            for axis, (quantity, unit, label) in zip(row[1:], QUANTITIES, strict=True):
                for name in places[where]:
                    colour = colours[name]
                    values = [errors[where, name][f"{quantity}_rmse_{unit}@{h:g}s"] for h in horizons]
                    axis.plot([1e3 * h for h in horizons], values, "o-", markersize=3, color=colour, label=name)
                axis.set_title(f"{where.removesuffix(' flights')} flights: {quantity}")
                axis.set_ylabel(f"RMS error, {label}")
                axis.set_xlabel("horizon, ms")
                axis.set_yscale("log")
        command = np.linspace(0.0, 1.0, 60)
        for name, file in files.items():
            p = file.parameters()
            force = [4 * float(thrust(p, p.motor_gain * u + p.motor_speed_offset)[0]) for u in command]
            axes[0][0].plot(command, force, color=colours[name], label=name)
            axes[0][0].axhline(float(p.mass * p.gravity), color=colours[name], linewidth=0.7, linestyle=":")
        axes[0][0].set_xlabel("command")
        axes[0][0].set_ylabel("thrust, N (dotted: weight)")
        axes[0][0].plot([], [], color=colours["hold"], label="hold")
        axes[0][0].legend(loc="upper left")
        for row in axes[1:]:
            row[0].set_visible(False)
        inches = figure.get_figheight()
        figure.subplots_adjust(
            left=0.05, right=0.995, bottom=0.45 / inches, top=1 - 0.28 / inches, wspace=0.3, hspace=0.4
        )
        save(figure, path)
