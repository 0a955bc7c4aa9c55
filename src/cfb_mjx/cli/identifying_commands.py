"""What ``cfb fit``, ``fit-rotors``, ``excite``, ``close-loop`` and ``refine`` take; see `cfb_mjx.cli.commands`."""

from __future__ import annotations

from inspect import signature
from pathlib import Path
from typing import Annotated, Literal

import tyro

from cfb_mjx.cli.argument_types import File, Model, Output, Pairs, flat
from cfb_mjx.errors import CfbError


def fit(
    logs: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="LOG...")],
    output: Output,
    parameters: str | None = None,
    held_out: Annotated[tuple[Path, ...], tyro.conf.arg(metavar="LOG...")] = (),
    model: Model = "cfb-guards",
    set: Pairs = (),
    json: File = None,
    figure: File = None,
    estimator: Literal["auto", "innovation", "shooting"] = "auto",
    robust: bool = False,
    commands_only: bool = False,
    compare: bool = False,
    devices: int = 1,
    mass_std: float | None = None,
) -> None:
    """Refit the model to flights, with uncertainty, and judge it on data kept from the fit.

    The estimator allows for feedback and for unmodelled disturbances. What the flights cannot tell is named instead of
    being given a number.

    Args:
        logs: flight logs to fit.
        output: model YAML to write.
        parameters: names or groups, comma separated: inertia (or inertia_xx, ...), rotor_inertia (J_m), motor
            (motor_time_constant, motor_gain), motor_speed_offset, thrust_scale, torque_scale, mass, cog (cog_x, cog_y),
            pose_delay.
        held_out: logs to judge on; without them the last quarter of every log is kept from the fit.
        model: preset or model YAML to start from.
        set: parameters to set before, for instance mass=0.045 (weigh the drone: flights cannot tell it).
        json: write the results here.
        figure: draw the estimates and the held-out errors before and after here (.png, .svg, .pdf).
        estimator: innovation (safe under feedback) or shooting (predictions over 200 ms; for flights without feedback);
            auto takes innovation unless pose_delay is asked for.
        robust: let outliers count linearly instead of squared.
        commands_only: do not use measured rotor speeds to drive the body.
        compare: show what the other estimator would say; multiple shooting is blind to feedback.
        devices: of this machine that share the flights.
        mass_std: standard deviation of the mass as weighed, kg; 5 % of it where nothing is said. Inertia, J_m and the
            scales of thrust and torque are known no better than the mass.
    """
    if not logs:
        raise CfbError("fit needs at least one log; see 'cfb fit --help'.")
    from cfb_mjx.cli.fitting import run_fit

    run_fit(
        list(logs),
        list(held_out),
        output,
        parameters,
        model,
        flat(set),
        json,
        commands_only,
        compare,
        estimator,
        robust,
        figure,
        devices,
        mass_std,
    )


def fit_rotors(
    files: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="FILE...")],
    output: Output,
    model: Model = "cfb-guards",
    set: Pairs = (),
    offset: bool = False,
    asymmetric: bool = False,
    dead_time: bool = False,
    per_motor: bool = False,
    robust: bool = False,
    json: File = None,
    figure: File = None,
    tared: bool = False,
    rotors: int | None = None,
) -> None:
    """Fit motors and rotor maps on their own, from flights with rotor speed and from bench tables.

    What a file holds is seen from its content: a flight log, command steps (t, u or u1..u4, omega or omega1..omega4),
    steady points (u, omega, vbat), steady force and torque (omega, force, torque, optionally motor), or any of these
    under the names of Bitcraze's, RCbenchmark's or Tyto's tools. What the data cannot tell is named.

    Args:
        files: flight logs and bench tables (csv, parquet).
        output: model YAML to write.
        model: preset or model YAML to start from.
        set: parameters to set before, for instance mass=0.045.
        offset: fit the steady rotor speed at zero command as well (needs commands over a wide range).
        asymmetric: separate time constants for spin-up and spin-down (reported, not written to the model).
        dead_time: time from a command to its first effect (reported, not written to the model).
        per_motor: every motor on its own as well, and a thrust and torque factor for each.
        robust: weigh outliers among the bench points of force and torque down.
        json: write the results here.
        figure: draw fits and residuals here (.png, .svg, .pdf).
        tared: the scale read zero at rest, so that no offset of its readings is tried and none is in the error bars.
        rotors: of how many rotors force and torque are; without it of four where several rotors' speeds stand beside
            them, else of one.
    """
    if not files:
        raise CfbError("fit-rotors needs at least one file; see 'cfb fit-rotors --help'.")
    from cfb_mjx.cli.rotor_fitting import run_fit_rotors

    run_fit_rotors(
        list(files),
        output,
        model,
        flat(set),
        offset,
        asymmetric,
        dead_time,
        per_motor,
        robust,
        json,
        figure,
        tared,
        rotors,
    )


def excite(
    manoeuvre: tyro.conf.Positional[Literal["roll-pitch", "single-motor", "optimised", "separate"]],
    output: Output,
    parameters: str | None = None,
    model: Model = "cfb-guards",
    set: Pairs = (),
    repetitions: int = 5,
    duration: float = 0.5,
    rate_limit: float = 12.0,
    altitude_loss: float = 0.5,
    measured_rotors: bool = False,
    disturbance: float = 4.0,
    between: Annotated[str | None, tyro.conf.arg(metavar="EFFECT,EFFECT")] = None,
    json: File = None,
) -> None:
    """Design a manoeuvre that identifies the drone, fly it in simulation, and predict what a fit will know.

    A stabiliser like the firmware's hovers, hands over to open-loop commands and catches the drone. Writes the commands
    (commands.csv), the simulated flight (flight.mcap), a figure and the expected uncertainty (excitation.json).

    separate looks for the path a position controller should fly to tell apart effects that cfb close-loop calls
    confusable, and writes its set-points (setpoints.csv), a simulated flight and what every path tells
    (separation.json).

    Args:
        manoeuvre: roll-pitch (doublets, for the inertia about x and y), single-motor (for J_z and J_m), optimised
            for the chosen parameters and compared with the other two, or separate.
        output: folder to write to.
        parameters: what will be fitted, as for cfb fit; by default what cfb fit would choose.
        model: preset or model YAML: the best guess of the drone before the flight.
        set: parameters to change, for instance mass=0.045.
        repetitions: of the manoeuvre in one flight.
        duration: of the open-loop part, s.
        rate_limit: body rate not to exceed, rad/s.
        altitude_loss: height that may be lost until the drone is caught, m.
        measured_rotors: rotor speed will be logged.
        disturbance: rms of the unmodelled torque over inertia to expect, rad/s^2.
        between: effects to tell apart (separate); those the model has are taken at its strengths.
        json: write the results here too.
    """
    from cfb_mjx.cli.exciting import refuse_unused, run_excite

    limits = {"duration": duration, "rate_limit": rate_limit, "altitude_loss": altitude_loss}
    told, usual = limits | {"parameters": parameters, "repetitions": repetitions}, signature(excite).parameters
    refuse_unused(manoeuvre, between, [name for name, value in told.items() if value != usual[name].default])
    if manoeuvre == "separate":
        from cfb_mjx.cli.separating import run_separate

        run_separate(between, output, model, flat(set), measured_rotors, disturbance, json)
        return
    run_excite(
        manoeuvre,
        output,
        parameters,
        model,
        flat(set),
        repetitions,
        duration,
        rate_limit,
        altitude_loss,
        measured_rotors,
        disturbance,
        json,
    )


def close_loop(
    output: Output,
    fit: Annotated[tuple[Path, ...], tyro.conf.arg(metavar="LOG...")] = (),
    held_out: Annotated[tuple[Path, ...], tyro.conf.arg(metavar="LOG...")] = (),
    model: Model = "cfb-guards",
    set: Pairs = (),
) -> None:
    """Find which physical effect a model lacks, add it, and report the error before and after on other flights.

    The sensors are compared with each other first; then effects of the catalogue are proposed, fitted together, and
    accepted only if they improve data they were not fitted on beyond chance. Writes report.html, report.json,
    residual.rrd and model.yaml. An interrupted run goes on where it was when started again.

    Args:
        output: folder to write to.
        fit: flights to learn from, of one drone, with different manoeuvres.
        held_out: other flights of it, to be judged on; nothing is fitted to them.
        model: preset or model YAML the flights are compared with.
        set: parameters to change, for instance mass=0.045.
    """
    from cfb_mjx.cli.closing import run_close_loop

    run_close_loop(list(fit), list(held_out), output, model, flat(set))


def refine(
    logs: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="LOG...")],
    output: Output,
    effects: str | None = None,
    held_out: Annotated[tuple[Path, ...], tyro.conf.arg(metavar="LOG...")] = (),
    model: Model = "cfb-guards",
    set: Pairs = (),
    estimator: Literal["predictions", "innovations"] = "predictions",
    predictor: bool = False,
    weight: Pairs = (),
    as_logged: bool = False,
    json: File = None,
) -> None:
    """Fit the numbers of effects you name, where close-loop would search for them.

    Innovations are not biased by feedback. Predictions over half a second are what a model is used for, and feedback
    biases them: every number stays within what is plausible, inertia within 25 %.

    Args:
        logs: flight logs to fit.
        output: model YAML to write.
        effects: names, comma separated (docs/effects.md), or plant: all that a drone in one piece usually lacks. By
            default those the model has.
        held_out: other flights, to be judged on.
        model: preset or model YAML to start from.
        set: parameters to change, for instance mass=0.045.
        estimator: what is fitted.
        predictor: leave inertia and inflow free; the result predicts better, is a wrong plant, and is marked so.
        weight: what flights whose names begin with NAME count against the others (predictions only).
        as_logged: take no sensor fault out, even where sensors disagree or the model lists one. A stretched velocity is
            then said to be an attitude's too, and only the position predicted is put right.
        json: write the results here.
    """
    if not logs:
        raise CfbError("refine needs at least one log; see 'cfb refine --help'.")
    from cfb_mjx.cli.refining import run_refine

    paths = list(logs), list(held_out)
    run_refine(*paths, output, model, flat(set), effects, estimator, predictor, flat(weight), as_logged, json)
