"""``cfb excite``."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from cfb_mjx.errors import CfbError
from cfb_mjx.files import output_folder, require_folder, require_no_file, together, write_json, write_text
from cfb_mjx.parameters import load_model_file
from cfb_mjx.runtime import Progress, configure_jax, environment
from cfb_mjx.terminal import print_paths

if TYPE_CHECKING:
    import numpy as np

    from cfb_mjx.sysid.excitation.experiment import Experiment
    from cfb_mjx.sysid.excitation.information import Prediction
    from cfb_mjx.sysid.excitation.safety import Attained

Manoeuvre = Literal["roll-pitch", "single-motor", "optimised"]
PAPER = ("roll-pitch", "single-motor")
ITERATIONS = 1000
MOST_REPETITIONS = 50
FLIGHTS = 3
"""Each with its own noise and disturbances; the middle one's uncertainty is printed, the first is written."""


@dataclass(frozen=True)
class Trial:
    """A manoeuvre flown in simulation."""

    commands: np.ndarray
    calm: Experiment
    flown: Experiment
    prediction: Prediction
    log_det: float
    undisturbed: Attained
    worst: dict


def refuse_unused(manoeuvre: str, between: str | None, told: list[str]) -> None:
    """Refuse options that would be ignored.

    Args:
        manoeuvre: as on the command line.
        between: effects to tell apart, which only ``separate`` does.
        told: options given that only the other manoeuvres have.

    Raises:
        CfbError: an option the manoeuvre has no use for, named.
    """
    if manoeuvre == "separate" and told:
        names = ", ".join("--" + name.replace("_", "-") for name in told)
        raise CfbError(f"cfb excite separate flies paths of its own: leave out {names}.")
    if manoeuvre != "separate" and between is not None:
        raise CfbError(f"cfb excite {manoeuvre} tells no effects apart: leave out --between, or say separate.")


def run_excite(
    manoeuvre: Manoeuvre,
    output: Path,
    parameters: str | None,
    model: str,
    changes: list[str],
    repetitions: int,
    duration: float,
    rate_limit: float,
    altitude_loss: float,
    measured_rotors: bool,
    disturbance: float,
    json: Path | None,
) -> None:
    """Design or choose the manoeuvre, fly it in simulation, print what a fit will know, write the files.

    Raises:
        CfbError: impossible limits, parameters or outputs.
    """
    require_no_file(output)
    require_folder(json)
    if not 1 <= repetitions <= MOST_REPETITIONS:
        raise CfbError(f"--repetitions {repetitions}: repeat the manoeuvre 1 to {MOST_REPETITIONS} times.")
    if not 0 <= disturbance < float("inf"):
        raise CfbError(f"--disturbance {disturbance:g}: the disturbance is an rms in rad/s^2, zero or more.")
    configure_jax(x64=True)
    from cfb_mjx.sysid.excitation.conditions import Conditions
    from cfb_mjx.sysid.excitation.manoeuvres import Limits

    described = load_model_file(model, changes)
    limits = Limits(rate=rate_limit, altitude_loss=altitude_loss)
    conditions = Conditions(measured_rotors=measured_rotors, disturbance=disturbance)
    trials = _trials(manoeuvre, described, parameters, repetitions, duration, limits, conditions)
    chosen = trials[manoeuvre]
    result = _json(manoeuvre, trials, described.name, repetitions, duration, limits, conditions)
    _print(result, trials)
    with together():
        _write(output, chosen, result, limits, f"{manoeuvre} on {described.name}")
        if json is not None:
            write_json(json, result)
    print(f"files: {', '.join(str(output / n) for n in ('commands.csv', 'flight.mcap', 'excitation.png'))}")
    print(f"results: {output / 'excitation.json'}")
    print_paths(results=json)


def _trials(manoeuvre, described, parameters, repetitions, duration, limits, conditions) -> dict[str, Trial]:
    """The manoeuvre; before an optimised one the paper's, which it is compared with and whose noise it assumes."""
    from cfb_mjx.control import FirmwarePid, PositionHold
    from cfb_mjx.model import Quadrotor
    from cfb_mjx.sysid.excitation.design import Problem, optimise
    from cfb_mjx.sysid.excitation.experiment import fly
    from cfb_mjx.sysid.excitation.information import log_determinant, predict, typical
    from cfb_mjx.sysid.excitation.manoeuvres import roll_pitch, scaled, single_motor
    from cfb_mjx.sysid.excitation.safety import attained, worst_of
    from cfb_mjx.sysid.identification.fitting import default_parameters
    from cfb_mjx.sysid.identification.unknowns import choose

    nominal = described.parameters()
    model = Quadrotor.from_file(described)
    stabiliser = PositionHold(FirmwarePid.hovering(nominal))
    if parameters is not None:
        choose(parameters, nominal)  # refuses unknown names before the work
    names = [manoeuvre] if manoeuvre in PAPER else [*PAPER, manoeuvre]
    trials, total = {}, 2 * len(names)
    progress = Progress("simulating")
    problem = None
    for index, name in enumerate(names):
        if name in PAPER:
            shape = {"roll-pitch": roll_pitch, "single-motor": single_motor}[name](duration)
            commands = scaled(model, shape, limits)
        else:
            commands = optimise(problem, duration, ITERATIONS, progress=Progress("optimising")).commands
        calm = fly(model, stabiliser, commands, repetitions, conditions.calm, name=name)
        flown = [fly(model, stabiliser, commands, repetitions, conditions, seed=i, name=name) for i in range(FLIGHTS)]
        progress(2 * index + 1, total)
        unknowns = choose(parameters or default_parameters([flown[0].log]), nominal)
        prediction = typical([predict([flight.log], unknowns, conditions.measured_rotors) for flight in flown])
        problem = problem or Problem.of(model, unknowns, prediction.noise, limits, conditions.measured_rotors)
        progress(2 * index + 2, total)
        trials[name] = Trial(
            commands,
            calm,
            flown[0],
            prediction,
            float(log_determinant(problem.judged(commands))),
            attained(calm)[0],
            worst_of([one for flight in flown for one in attained(flight)], limits),
        )
    return trials


def _json(manoeuvre, trials: dict[str, Trial], model, repetitions, duration, limits, conditions) -> dict:
    chosen = trials[manoeuvre]
    return {
        "manoeuvre": manoeuvre,
        "model": model,
        "repetitions": repetitions,
        "duration_s": duration,
        "limits": asdict(limits),
        "conditions": asdict(conditions),
        "parameters": _numbers(chosen.prediction),
        "unidentifiable": chosen.prediction.unidentifiable,
        "identifiable_together": chosen.prediction.combinations,
        "log_det_one_repetition": chosen.log_det,
        "undisturbed": asdict(chosen.undisturbed) | {"within_limits": chosen.undisturbed.within(limits)},
        "with_disturbances": chosen.worst,
        "compared_with": {
            name: {"parameters": _numbers(t.prediction), "log_det_one_repetition": t.log_det} | t.worst
            for name, t in trials.items()
            if name != manoeuvre
        },
        "environment": environment(),
    }


def _numbers(prediction: Prediction) -> dict:
    return {name: asdict(expected) for name, expected in prediction.parameters.items()}


def _print(result: dict, trials: dict[str, Trial]) -> None:
    others = list(result["compared_with"])
    count, flown = result["repetitions"], result["with_disturbances"]["repetitions"]
    rotors = "rotor speed measured" if result["conditions"]["measured_rotors"] else "commands only"
    print(
        f"{result['manoeuvre']}: {result['duration_s']:g} s, {count} repetition{'s' * (count != 1)} in one flight, "
        f"{rotors}, disturbance {result['conditions']['disturbance']:g} rad/s^2\n"
    )
    heads = "".join(f"{name:>15}" for name in others)
    print(f"{'expected of cfb fit':<22}{'value':>12}{'std':>11}  {'unit':<8}{'std, %':>8}{heads}")
    for name in trials[result["manoeuvre"]].prediction.names:
        cells = [_share(result["compared_with"][other]["parameters"].get(name)) for other in others]
        e = result["parameters"].get(name)
        number = f"{e['value']:>12.4g}{e['std']:>11.2g}  {e['unit']:<8}" if e else f"{'':>12}{'':>11}  {'':<8}"
        print(f"{name:<22}{number}{_share(e):>8}" + "".join(f"{cell:>15}" for cell in cells))
    if result["unidentifiable"]:
        known = f"; known together: {', '.join(result['identifiable_together'])}" * bool(
            result["identifiable_together"]
        )
        print(f"cannot be told: {', '.join(result['unidentifiable'])}{known}")
    calm, rough = result["undisturbed"], result["with_disturbances"]
    print(
        f"\nundisturbed: tilt {calm['tilt_deg']:.0f} deg, body rate {calm['rate']:.1f} rad/s, "
        f"altitude loss {calm['altitude_loss']:.2f} m, drift {calm['drift']:.1f} m, "
        + (f"settled {calm['settled']:.1f} s after the handover" if calm["caught"] else "not caught")
    )
    print(
        f"worst with disturbances: tilt {rough['max_tilt_deg']:.0f} deg, "
        f"body rate {rough['max_rate_radps']:.1f} rad/s, altitude loss {rough['altitude_loss_m']:.2f} m, "
        f"drift {rough['drift_m']:.1f} m; "
        f"within limits {rough['within_limits']}, caught {rough['caught']} of {flown}"
    )
    if not calm["within_limits"]:
        print("warning: the undisturbed manoeuvre with its catch exceeds the limits.")
    if rough["caught"] < flown or not calm["caught"]:
        print("warning: the stabiliser does not always catch the drone; ask for less.")


def _share(expected: dict | None) -> str:
    if expected is None:
        return "cannot tell"
    return f"{100 * expected['std'] / expected['value']:.2g}" if expected["value"] else ""


def _write(folder: Path, chosen: Trial, result: dict, limits, title: str) -> None:
    import numpy as np

    from cfb_mjx.logs import write_mcap
    from cfb_mjx.sysid.excitation.manoeuvres import STEP
    from cfb_mjx.view.excitation import excitation_figure

    output_folder(folder)
    rows = np.column_stack([STEP * np.arange(len(chosen.commands)), chosen.commands])
    lines = ["t,u1,u2,u3,u4", *(f"{t:.3f}," + ",".join(f"{u:.6f}" for u in command) for t, *command in rows)]
    write_text(folder / "commands.csv", "\n".join(lines) + "\n")
    write_mcap(chosen.flown.log, folder / "flight.mcap")
    bounds = {"tilt": limits.tilt_deg, "rate": limits.rate, "height": limits.altitude_loss}
    excitation_figure(chosen.calm, chosen.flown, folder / "excitation.png", bounds, title)
    write_json(folder / "excitation.json", result)
