"""What ``cfb demo``, ``cfb demo-loop`` and ``cfb reproduce`` take; see `cfb_mjx.cli.commands`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from cfb_mjx.cli.argument_types import File, Model, Output, Pairs, flat


def demo(output: Output = Path("out/demo"), real: Path | None = None) -> None:
    """Show the library at work: evaluate a flight, draw it, fly 4096 randomised drones, write a page.

    Args:
        output: folder to write to.
        real: folder with real flights in the IDSIA layout (validation/*.parquet).
    """
    from cfb_mjx.cli.demo import run_demo
    from cfb_mjx.runtime import configure_jax

    configure_jax(x64=True)
    run_demo(output, real)


def view(
    logs: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="LOG...")],
    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"], metavar="FILE")] = None,
    model: Model = "cfb-guards",
    set: Pairs = (),
    spawn: bool = False,
    video: File = None,
    slow: float = 1.0,
) -> None:
    """Show flights: a rerun recording, rerun's viewer, or a film.

    The recording has the drone in 3D with the thrust of its rotors, the way it went, where the model thought it would
    go (half a second from every window), the commands, and what the model misses (force and torque per mass and
    inertia). Flights of `cfb fly --log` are shown like any other.

    Args:
        logs: flight logs (MCAP, parquet, csv), or one recording (.rrd) with --spawn.
        output: recording to write (.rrd); the first log's name in this folder by default.
        model: preset or model YAML, for thrust, predictions and residuals.
        set: parameters to change, for instance mass=0.045.
        spawn: open rerun's viewer.
        video: film the first flight here (.mp4 or .gif).
        slow: how many times slower the film is than the flight.
    """
    from cfb_mjx.cli.viewing import run_view

    run_view(list(logs), output, model, flat(set), spawn, video, slow)


def reproduce(
    names: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="NAME")] = ("all",),
    output: Output = Path("out/paper"),
    real: Path | None = None,
    flights: Path | None = None,
    mass: float | None = None,
) -> None:
    """Make the paper's figures and tables, its numbers beside ours.

    For each a figure (PNG), the numbers behind it (CSV) and rows of "paper, ours, how it differs and why"; index.html
    shows all of it, paper.md and paper.json hold the rows. They are written after each; interrupted, the same command
    goes on with what is left. Rows that repeat a constant of the paper, and predictions by the model of its own
    flights, are marked.

    parameters, motor-step, rotor-curves, hover-to-forward, yaw-disturbance, brushed, back-and-forth, controllers,
    randomisation, flips, double-flip; all of them by default, which takes minutes.

    Args:
        names: what to reproduce.
        output: folder to write to.
        real: folder with real flights in the IDSIA layout (fit/*.parquet, validation/*.parquet), to stand beside the
            shipped ones.
        flights: folder with flight logs of your drone: brushless for hover-to-forward and yaw-disturbance, whose useful
            horizon is then measured on them; brushed for brushed.
        mass: of the drone of --flights as weighed, kg; that of the preset by default.
    """
    from cfb_mjx.cli.reproducing import run_reproduce

    run_reproduce(names, output, real, flights, mass)


def demo_loop(
    output: Output = Path("out/demo-loop"),
    effects: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME...")] = (),
    seeds: int = 1,
    seed: int = 61_000,
) -> None:
    """Close the loop all the way, on an independent simulator: fly, diagnose, retrain, fly again.

    A policy trained on the declared model flies and logs a drone with an effect that the model lacks; close-loop names
    it and corrects the model; the policy is trained further on that and flies the same drone again, beside a policy
    trained with more randomisation. Writes loop.json, loop.png and index.html, and for every drone its logs, the report
    of close-loop, the corrected model and the policy. What is done is kept: started again, it goes on where it was.

    Args:
        output: folder to write to.
        effects: of the labelled plants, one drone each: payload, cog_offset, wind ...; by default payload.
        seeds: drones of each effect; every seed has policies of its own.
        seed: the first.
    """
    from cfb_mjx.cli.looping import run_demo_loop

    run_demo_loop(output, effects, seeds, seed)
