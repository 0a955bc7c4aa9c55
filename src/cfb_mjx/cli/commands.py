"""What each subcommand takes. Kept light: ``cfb --help`` must not load jax, so the work is imported when it starts."""

from __future__ import annotations

from contextlib import nullcontext
from functools import wraps
from inspect import signature
from pathlib import Path
from typing import Annotated, Literal

import tyro

from cfb_mjx.cli.argument_types import File, Model, Output, Pairs, Spans, flat, with_plugins
from cfb_mjx.cli.deploying_commands import export
from cfb_mjx.cli.learning_commands import fly, train
from cfb_mjx.cli.showing_commands import demo, demo_loop, reproduce, view
from cfb_mjx.cli.sweep_commands import sweep
from cfb_mjx.cli.terminal import escaped, shown
from cfb_mjx.errors import CfbError


def import_log(
    sources: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="LOG...")] = (),
    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"], metavar="PATH")] = None,
    format: Literal[
        "auto", "tabular", "idsia", "mcap", "usd_card", "crazyswarm", "radio_csv", "ulog", "foxglove"
    ] = "auto",
    motor_shift: float | None = None,
    mapping: File = None,
    topics_yaml: File = None,
    robot: str | None = None,
    time_unit: str | None = None,
    keep_ground: bool = False,
    cut: Spans = (),
    fix: Pairs = (),
    print_config: Literal["sd", "radio"] | None = None,
) -> None:
    """Convert a flight log to MCAP.

    Checks units, frames and time stamps on the way, and says what it changed.

    Args:
        sources: log to read: parquet, csv, MCAP, Crazyflie micro SD card binary, ROS bag or its folder, radio csv,
            .npz, .mat, PX4's ULog, an MCAP of others; several tables, as cfclient writes one per log block, are one
            flight.
        output: MCAP file to write.
        format: layout of the source; auto looks at its content.
        motor_shift: s by which to delay the motor columns of an IDSIA log instead of the estimated shift.
        mapping: YAML saying which logged variable, column or field is what.
        topics_yaml: crazyflies.yaml with the variable names of the custom topics of a Crazyswarm2 bag.
        robot: whose flight to read from a Crazyswarm2 bag or a table of several.
        time_unit: unit of the time column of a radio csv: s, ms, us or ns.
        keep_ground: leave in what was recorded on the ground and in the hand.
        cut: seconds of the recording to leave out, for instance 12.5:15, :3 (all up to 3 s) or 40: (all from then on).
        fix: a change of unit, axes or order, as a refusal names it, for instance velocity-frame=body.
        print_config: print what to log, and read nothing: the config.txt of the micro SD card deck, or the log
            blocks of the radio for cfclient.
    """
    from cfb_mjx.cli.importing import print_logging, run_import

    if print_config is not None:
        print_logging(print_config)
        return
    if not sources or output is None:
        raise CfbError("import needs a log and -o FILE.mcap; see 'cfb import --help'.")
    options = {"motor_shift": motor_shift, "mapping": mapping, "topics_yaml": topics_yaml, "robot": robot}
    options |= {"time_unit": time_unit, "keep_ground": keep_ground, "cut": flat(cut), "fix": flat(fix)}
    run_import(list(sources), output, None if format == "auto" else format, options)


def check(
    logs: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="LOG...")],
    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"], metavar="FOLDER")] = None,
    json: File = None,
    mapping: File = None,
    topics_yaml: File = None,
    robot: str | None = None,
    time_unit: str | None = None,
    keep_ground: bool = False,
    cut: Spans = (),
    fix: Pairs = (),
) -> None:
    """Say what recordings hold, whether their signals agree, what they are good for and what to log next time.

    Every recording is read as by import, by itself; one that is refused stops none of the others.

    Args:
        logs: recordings of any format.
        output: folder for a page with figures (index.html).
        json: write the results here.
        mapping: as for import.
        topics_yaml: as for import.
        robot: as for import.
        time_unit: as for import.
        keep_ground: as for import.
        cut: as for import.
        fix: as for import.
    """
    if not logs:
        raise CfbError("check needs at least one log; see 'cfb check --help'.")
    from cfb_mjx.cli.checking import run_check

    options = {"mapping": mapping, "topics_yaml": topics_yaml, "robot": robot, "time_unit": time_unit}
    options |= {"keep_ground": keep_ground, "cut": flat(cut), "fix": flat(fix)}
    if refused := run_check(list(logs), output, json, options):
        raise CfbError(f"{refused} of {len(logs)} recordings were refused, for the reasons above.")


def evaluate(
    logs: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="LOG...")],
    model: Model = "cfb-guards",
    set: Pairs = (),
    json: File = None,
    figure: File = None,
    observer: bool = False,
    devices: int = 1,
) -> None:
    """Measure how well a model predicts flights, open loop, at 50, 100, 200 and 500 ms.

    Windows start from measured states; the logged commands (and, where measured, the rotor speeds) go in; errors are
    compared with "hold", which assumes constant velocity and constant body rate.

    Args:
        logs: flight logs (MCAP, parquet, csv).
        model: preset (cfb-guards, cfb, cfb-idsia, cf21b-500, cf2x) or model YAML.
        set: parameters to change, for instance mass=0.045.
        json: write the results here.
        figure: draw prediction against measurement here (.png, .svg, .pdf).
        observer: add predictions with disturbances estimated from the data before each window starts.
        devices: of this machine that share the windows.
    """
    if not logs:
        raise CfbError("evaluate needs at least one log; see 'cfb evaluate --help'.")
    from cfb_mjx.cli.evaluating import run_evaluate

    run_evaluate(list(logs), model, flat(set), json, figure, observer, devices)


def benchmark_nanodrone(
    folder: tyro.conf.Positional[Path],
    model: str = "cfb-idsia-predictor",
    json: File = None,
    stride: int = 1,
) -> None:
    """Judge a model by the rules of the IDSIA nano-drone benchmark, beside the published results.

    Predictions of 50 steps at 100 Hz from every row, rotor speeds in, and only those measured by then. The preset
    cfb-idsia, the plant fitted to flights of that drone, stands beside the model.

    Args:
        folder: holds the flights, raw 100 Hz merges (parquet or csv).
        model: preset or model YAML; judged alone and with a disturbance observer. The default was fitted to flights of
            the benchmark's drone, none of them its test flights.
        json: write the results here.
        stride: rows from one prediction's start to the next.
    """
    from cfb_mjx.cli.nanodrone import run_nanodrone

    run_nanodrone(folder, model, json, stride)


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
        effects: names, comma separated (docs/effects.md); by default those the model has.
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


def bench(
    drones: Annotated[tuple[int, ...], tyro.conf.arg(metavar="N...")] = (1, 64, 1024, 8192, 65536),
    json: File = None,
    markdown: File = None,
    peer_python: File = None,
    quick: bool = False,
    roofline: bool = False,
) -> None:
    """Measure throughput: simulation steps per second of every body, compile time and memory.

    Args:
        drones: batch sizes.
        json: write the results here.
        markdown: write the results as a Markdown page here.
        peer_python: a Python that has crazyflow installed, to measure it side by side.
        quick: fewer rows and repetitions, for a first look.
        roofline: measure also what this machine can do at most, and how much of it the hot paths use.
    """
    from cfb_mjx.cli.benchmark import run_bench

    run_bench(list(drones), json, markdown, peer_python, quick, roofline)


def version() -> None:
    """Print the versions of the library and of what it computes with."""
    from cfb_mjx.cli.runtime import environment

    for name, value in environment().items():
        print(f"{name}: {value}")


COMMANDS = {
    "import": import_log,
    "check": check,
    "evaluate": evaluate,
    "benchmark-nanodrone": benchmark_nanodrone,
    "fit": fit,
    "fit-rotors": fit_rotors,
    "excite": excite,
    "close-loop": close_loop,
    "refine": refine,
    "train": train,
    "fly": fly,
    "sweep": sweep,
    "export": export,
    "view": view,
    "bench": bench,
    "reproduce": reproduce,
    "demo-loop": demo_loop,
    "demo": demo,
    "version": version,
}
COMMANDS = {name: with_plugins(command) for name, command in COMMANDS.items()}


def run(name: str, arguments: list[str]) -> None:
    """Parse the arguments of subcommand ``name`` and run it."""
    command = COMMANDS[name]

    @wraps(command)
    def given(**values):
        return values

    # The parser's own words are coloured; it repeats what was typed, or what the shell put there.
    harmless = all(shown(argument) == argument for argument in arguments)
    with nullcontext() if harmless else escaped():
        values = tyro.cli(given, prog=f"cfb {name}", args=arguments)
    with escaped():
        command(**values)
