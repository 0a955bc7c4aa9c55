"""What ``cfb train`` and ``cfb fly`` take; see `cfb_mjx.cli.commands`."""

from __future__ import annotations

from typing import Annotated, Literal

import tyro

from cfb_mjx.cli.argument_types import File, Output, Pairs, flat


def train(
    task: Annotated[Literal["target", "flip"], tyro.conf.Positional],
    output: Output,
    config: Annotated[str | None, tyro.conf.arg(metavar="CONFIG")] = None,
    model: Annotated[str | None, tyro.conf.arg(metavar="MODEL")] = None,
    randomise: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None,
    algorithm: Literal["ppo", "analytic"] | None = None,
    seed: int | None = None,
    set: Pairs = (),
    start: File = None,
    resume: bool = False,
    force: bool = False,
    devices: int = 1,
    coordinator: Annotated[str | None, tyro.conf.arg(metavar="HOST:PORT")] = None,
    processes: int | None = None,
    process: int | None = None,
    tensorboard: bool = False,
) -> None:
    """Train a controller. Interrupt it whenever you like: --resume goes on to the same result.

    Writes policy.npz (what `cfb fly` flies), best.npz (what was judged best on the way), curve.csv and curve.png
    (learning curve), updates.csv (what every update measured), config.yaml and checkpoint.npz.

    Args:
        task: what to learn: fly to a target and hold it, or turn about the x axis at a rate that is asked for.
        output: folder for the results.
        config: training YAML, or the name of a shipped one; the task's own by default.
        model: preset or model YAML of the drone, with its effects; in place of the configuration's.
        randomise: ranges from which drones are drawn: a shipped name, a YAML file, or a model whose numbers have a
            spread (cfb-fleet); in place of the configuration's. How much of them: --set randomisation.magnitude.
        algorithm: ppo (the paper's) or analytic (back-propagation through the model); in place of the configuration's.
        seed: of everything random; in place of the configuration's.
        set: changes to the configuration, for instance randomisation.magnitude=0.5 ppo.steps=2e7.
        start: policy to start from, in place of random weights: a file, or the name of a shipped one.
        resume: go on from the checkpoint in the folder.
        force: train on a model that is a predictor, not a plant.
        devices: of this machine, or of each of several processes, over which the drones are spread.
        coordinator: where several processes meet that train one policy together: the address of process 0, or auto
            within srun or mpirun.
        processes: how many they are; not with auto.
        process: which of them this is, from 0; not with auto.
        tensorboard: write the numbers of every update and checkpoint for TensorBoard too, into the folder's events.
    """
    from cfb_mjx.cli.hosts import Hosts
    from cfb_mjx.cli.training import run_train

    hosts = Hosts.asked(coordinator, processes, process)
    choices = {"model": model, "algorithm": algorithm, "seed": seed}
    ranges = () if randomise is None else (f"randomisation.ranges={randomise}",)
    run_train(task, config, output, (*ranges, *flat(set)), choices, start, resume, force, devices, hosts, tensorboard)


def fly(
    controller: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="CONTROLLER")],
    task: Literal["hover", "step", "recover", "flip", "double-flip", "triple-flip"] | None = None,
    model: Annotated[str, tyro.conf.arg(metavar="MODEL")] = "cfb-guards",
    plants: int = 1,
    magnitude: float = 0.0,
    randomisation: Annotated[str, tyro.conf.arg(metavar="NAME", aliases=["--randomise"])] = "paper",
    on: Annotated[str | None, tyro.conf.arg(metavar="SET")] = None,
    noise: bool = True,
    seed: int = 0,
    json: File = None,
    figure: File = None,
    recording: File = None,
    video: File = None,
    log: File = None,
    knobs: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None,
    set: Pairs = (),
    holder: Annotated[str | None, tyro.conf.arg(metavar="CONTROLLER")] = None,
    search: Literal["height", "margin"] | None = None,
    keep: File = None,
    devices: int = 1,
    gyro: Literal["late", "local"] | None = None,
) -> None:
    """Fly a controller in simulation and measure it.

    hover: 6 s at the target, the first second not counted. step: 6 m to one side. recover: thrown at 3 m/s, tilted 60
    deg. flip, double-flip, triple-flip: climb, turn about the x axis, return to the start; `cfb fly double-flip` is
    short for `cfb fly flip --task double-flip`.

    Args:
        controller: pid or mellinger (the firmware's), a shipped policy, a policy file of `cfb train`, or the name of a
            flip.
        task: what to fly; hover by default, and flip with a flip policy.
        model: preset or model YAML of the drone, with its effects.
        plants: number of flights, each on a drone drawn anew.
        magnitude: factor on the randomisation of the drones; 0 flies the model itself.
        randomisation: which ranges: a shipped name, a YAML file, or a model whose numbers have a spread (cfb-fleet).
        on: fly the model with each list of effects of a set in turn: off-nominal (shipped) or a YAML file.
        noise: with the noise of state and estimates that policies are trained with.
        seed: of everything random.
        json: write the results here.
        figure: draw the flights here.
        recording: write the flights here, for rerun (.rrd).
        video: film the first flight here (.mp4 or .gif).
        log: write the first flight here as a flight log (.mcap), for cfb view, evaluate, fit.
        knobs: of a flip: when it switches and what it asks for, a shipped manoeuvre (flip-wide, double-flip-low ...) or
            a YAML file; the task's own by default.
        set: changes to the knobs of a flip, for instance rate_radps=18 climb_s=0.4; a search leaves these alone.
        holder: the target policy that climbs and catches in a flip; by default the one its knobs were found with.
        search: look for the knobs of a flip first: least height on the model, or largest margin on drones of the
            randomisation.
        keep: write the knobs that were flown here, for --knobs.
        devices: of this machine that share the flights of many plants.
        gyro: late: as late as the pose, the model's pose_delay, as in the paper; local: on the drone, gyro_delay late.
            By default a policy flies as it was trained, and pid and mellinger with a local one, as in the firmware.
    """
    from cfb_mjx.cli.flying import Outputs, Turn, run_fly

    outputs, turn = Outputs(json, figure, recording, video, log), Turn(knobs, tuple(flat(set)), holder, search, keep)
    run_fly(controller, task, model, plants, magnitude, randomisation, on, noise, seed, outputs, turn, devices, gyro)
