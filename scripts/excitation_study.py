"""Compare the scatter of `cfb fit` on simulated flights with the prediction of `cfb excite`.

Several flights of each manoeuvre are simulated and fitted one by one. Every flight has its own noise and disturbances,
and five repetitions of the manoeuvre. The true parameters are the preset's; every fit starts with errors of 20 % in
inertia and J_m.

    python scripts/excitation_study.py [--flights 8] [--json PATH]
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import jax
import numpy as np

from cfb_mjx.control import FirmwarePid, PositionHold
from cfb_mjx.files import write_json
from cfb_mjx.model import Quadrotor
from cfb_mjx.parameters import load_model_file
from cfb_mjx.sysid.excitation.design import Problem, optimise
from cfb_mjx.sysid.excitation.experiment import Conditions, fly
from cfb_mjx.sysid.excitation.information import predict
from cfb_mjx.sysid.excitation.manoeuvres import Limits, roll_pitch, scaled, single_motor
from cfb_mjx.sysid.identification.fitting import default_parameters, fit
from cfb_mjx.sysid.identification.unknowns import choose

REPETITIONS = 5


def main() -> None:
    """Print the predicted and the actual scatter of each parameter."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--flights", type=int, default=8)
    parser.add_argument("--measured-rotors", action="store_true")
    parser.add_argument("--row", type=float, default=Conditions.row, help="time between rows of the log, s")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    jax.config.update("jax_enable_x64", True)

    described = load_model_file("cfb-guards")
    truth = described.parameters()
    start = described.with_values(
        "wrong on purpose", inertia=1.2 * np.asarray(truth.inertia), rotor_inertia=0.8 * float(truth.rotor_inertia)
    ).parameters()
    model, stabiliser = Quadrotor(truth), PositionHold(FirmwarePid.hovering(truth))
    conditions = Conditions(measured_rotors=arguments.measured_rotors, row=arguments.row)
    commands = {
        "roll-pitch": scaled(model, roll_pitch(), Limits()),
        "single-motor": scaled(model, single_motor(), Limits()),
    }
    log = fly(model, stabiliser, commands["roll-pitch"], REPETITIONS, conditions).log
    unknowns = choose(default_parameters([log]), truth)
    noise = predict([log], unknowns, conditions.measured_rotors).noise
    commands["optimised"] = optimise(Problem.of(model, unknowns, noise, Limits(), conditions.measured_rotors)).commands
    result = {}
    for name, sequence in commands.items():
        result[name] = _study(model, stabiliser, sequence, conditions, unknowns, start, arguments.flights)
        _print(name, result[name])
    if arguments.json is not None:
        write_json(arguments.json, result)


def _study(model, stabiliser, sequence, conditions, unknowns, start, flights: int) -> dict:
    predicted, found, claimed = [], [], []
    for seed in range(flights):
        log = fly(model, stabiliser, sequence, REPETITIONS, conditions, seed=100 + seed).log
        expected = predict([log], unknowns, conditions.measured_rotors).parameters
        estimates = fit([log], start, unknowns.names, conditions.measured_rotors).estimates
        predicted.append([expected[n].std if n in expected else np.nan for n in unknowns.names])
        found.append([estimates[n].value if n in estimates else np.nan for n in unknowns.names])
        claimed.append([estimates[n].std if n in estimates else np.nan for n in unknowns.names])
        print(".", end="", file=sys.stderr, flush=True)
    truth = np.asarray(unknowns.values(unknowns.start))
    error = np.array(found) / truth - 1
    return {
        name: {
            "predicted_std": float(np.nanmedian(np.array(predicted)[:, i]) / truth[i]),
            "scatter": float(np.sqrt(np.nanmean(error[:, i] ** 2))),
            "bias": float(np.nanmean(error[:, i])),
            "fit_std": float(np.nanmedian(np.array(claimed)[:, i]) / truth[i]),
            "told": int(np.isfinite(error[:, i]).sum()),
        }
        for i, name in enumerate(unknowns.names)
    }


def _print(name: str, rows: dict) -> None:
    print(f"\n{name:<22}{'predicted, %':>14}{'scatter, %':>12}{'bias, %':>10}{'fit says, %':>13}{'told':>6}")
    for parameter, row in rows.items():
        cells = [100 * row[key] for key in ("predicted_std", "scatter", "bias", "fit_std")]
        print(f"{parameter:<22}{cells[0]:>14.2f}{cells[1]:>12.2f}{cells[2]:>10.2f}{cells[3]:>13.2f}{row['told']:>6}")


if __name__ == "__main__":
    main()
