"""What each subcommand takes. Kept light: ``cfb --help`` must not load jax, so the work is imported when it starts."""

from __future__ import annotations

from contextlib import nullcontext
from functools import wraps
from pathlib import Path
from typing import Annotated

import tyro

from cfb_mjx.cli.argument_types import File, Model, Pairs, flat, with_plugins
from cfb_mjx.cli.deploying_commands import export
from cfb_mjx.cli.identifying_commands import close_loop, excite, fit, fit_rotors, refine
from cfb_mjx.cli.learning_commands import fly, train
from cfb_mjx.cli.recording_commands import check, import_log
from cfb_mjx.cli.showing_commands import demo, demo_loop, reproduce, view
from cfb_mjx.cli.sweep_commands import sweep
from cfb_mjx.errors import CfbError
from cfb_mjx.terminal import escaped, shown


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
        model: preset (cfb-guards, cfb, cfb-fleet, cfb-idsia, cf21b-500, cf2x) or model YAML.
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
    official: bool = False,
) -> None:
    """Judge a model by the rules of the IDSIA nano-drone benchmark, beside the published results.

    Predictions of 50 steps at 100 Hz from every row, rotor speeds in, and only those measured by then. The preset
    cfb-idsia, the plant fitted to flights of that drone, stands beside the model.

    Args:
        folder: holds the flights, raw 100 Hz merges or processed files (parquet or csv).
        model: preset or model YAML; judged alone and with a disturbance observer. The default was fitted to flights of
            the benchmark's drone, none of them its test flights.
        json: write the results here.
        stride: rows from one prediction's start to the next.
        official: the folder holds the benchmark's processed files (data/real/processed): every row counts as it is, as
            in the benchmark's own evaluation, and the published rows are comparable. Raw merges are cleaned otherwise.
    """
    from cfb_mjx.cli.nanodrone import run_nanodrone

    run_nanodrone(folder, model, json, stride, official)


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
    from cfb_mjx.bench.benchmark import run_bench

    run_bench(list(drones), json, markdown, peer_python, quick, roofline)


def version() -> None:
    """Print the versions of the library and of what it computes with."""
    from cfb_mjx.runtime import environment

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
