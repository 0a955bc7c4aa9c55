"""The commands of ``cfb`` as Python classes::

    from cfb_mjx.commands import Evaluate
    evaluated = Evaluate("flight.mcap", model="cfb").run()
    print(evaluated)

A command is a frozen dataclass of its arguments; ``run()`` executes it and returns a `Result`. The classes are imported
on first use, so that ``cfb --help`` and a misspelt command name load nothing else.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from cfb_mjx.commands.bench import Bench
    from cfb_mjx.commands.benchmark_nanodrone import BenchmarkNanodrone
    from cfb_mjx.commands.check import Check
    from cfb_mjx.commands.close_loop import CloseLoop
    from cfb_mjx.commands.command import Command, Result
    from cfb_mjx.commands.demo import Demo
    from cfb_mjx.commands.demo_loop import DemoLoop
    from cfb_mjx.commands.evaluate import Evaluate
    from cfb_mjx.commands.excite import Excite
    from cfb_mjx.commands.export import Export
    from cfb_mjx.commands.fit import Fit
    from cfb_mjx.commands.fit_rotors import FitRotors
    from cfb_mjx.commands.fly import Fly
    from cfb_mjx.commands.import_log import Import
    from cfb_mjx.commands.refine import Refine
    from cfb_mjx.commands.reproduce import Reproduce
    from cfb_mjx.commands.sweep import Sweep
    from cfb_mjx.commands.train import Train
    from cfb_mjx.commands.version import Version
    from cfb_mjx.commands.view import View


class Entry(NamedTuple):
    """What is known about a command before its class is imported."""

    place: str
    """Module and class, ``module.Class``."""
    summary: str
    examples: tuple[str, ...]


COMMANDS = {
    "import": Entry(
        "import_log.Import",
        "convert a flight log to MCAP",
        ("cfb import flight.csv -o flight.mcap", "cfb import rosbag2_folder -o flight.mcap --robot cf5 --cut :3"),
    ),
    "check": Entry(
        "check.Check",
        "report what recordings contain, whether their signals agree, and their uses",
        ("cfb check flight.mcap", "cfb check *.csv -o out/check --json check.json"),
    ),
    "evaluate": Entry(
        "evaluate.Evaluate",
        "measure how well a model predicts flights in open loop",
        ("cfb evaluate flight.mcap", "cfb evaluate a.mcap b.mcap --model cfb --json errors.json --figure errors.png"),
    ),
    "benchmark-nanodrone": Entry(
        "benchmark_nanodrone.BenchmarkNanodrone",
        "evaluate a model by the rules of the IDSIA nano-drone benchmark",
        (
            "cfb benchmark-nanodrone data/real/processed --official",
            "cfb benchmark-nanodrone flights --model my_drone.yaml --json nanodrone.json",
        ),
    ),
    "fit": Entry(
        "fit.Fit",
        "fit the parameters of a model to flights, with uncertainty",
        (
            "cfb fit flight.mcap -o my_drone.yaml --set mass=0.042",
            "cfb fit a.mcap b.mcap -o my_drone.yaml --held-out c.mcap --parameters inertia,motor --figure fit.png",
        ),
    ),
    "fit-rotors": Entry(
        "fit_rotors.FitRotors",
        "fit motors, thrust and torque curves to flights or bench measurements",
        (
            "cfb fit-rotors thrust_stand.csv -o my_rotors.yaml",
            "cfb fit-rotors steps.csv flight.mcap -o my_rotors.yaml --per-motor --figure rotors.png",
        ),
    ),
    "excite": Entry(
        "excite.Excite",
        "design a manoeuvre that identifies the drone, and predict the fit's uncertainty",
        (
            "cfb excite roll-pitch -o out/roll-pitch",
            "cfb excite separate -o out/separate --between wind,cog_offset --model out/loop/model.yaml",
        ),
    ),
    "close-loop": Entry(
        "close_loop.CloseLoop",
        "find the physical effects a model lacks, and correct the model",
        (
            "cfb close-loop --fit a.mcap b.mcap --held-out c.mcap -o out/loop",
            "cfb close-loop --fit a.mcap b.mcap --held-out c.mcap -o out/loop --model my_drone.yaml --set mass=0.042",
        ),
    ),
    "refine": Entry(
        "refine.Refine",
        "fit the parameters of effects that you name",
        (
            "cfb refine a.mcap b.mcap -o refined.yaml --effects rotor_drag,wind",
            "cfb refine a.mcap -o refined.yaml --effects plant --held-out b.mcap --json refined.json",
        ),
    ),
    "train": Entry(
        "train.Train",
        "train a controller with PPO or by back-propagation through the model",
        (
            "cfb train target -o out/target --config quick",
            "cfb train target -o out/target --model my_drone.yaml --set randomisation.magnitude=0.5 --seed 1",
        ),
    ),
    "fly": Entry(
        "fly.Fly",
        "fly a controller in simulation and measure its performance",
        ("cfb fly target --task hover", "cfb fly out/target/policy.npz --plants 4096 --magnitude 1 --json flown.json"),
    ),
    "sweep": Entry(
        "sweep.Sweep",
        "run a command with many combinations of arguments, here or on a cluster",
        ("cfb sweep firmware-pid -o out/sweep --dry-run", "cfb sweep my_sweep.yaml -o out/sweep --workers 4"),
    ),
    "export": Entry(
        "export.Export",
        "export a policy as C for the drone, and check the C against JAX",
        ("cfb export target -o out/target_c", "cfb export out/target/policy.npz -o out/policy_c --check"),
    ),
    "view": Entry(
        "view.View",
        "show flights in rerun, with predictions and residuals, or as a video",
        ("cfb view flight.mcap -o flight.rrd", "cfb view flight.mcap --video flight.mp4"),
    ),
    "bench": Entry(
        "bench.Bench",
        "measure simulation speed, compile time and memory",
        ("cfb bench --quick", "cfb bench --drones 64 4096 --json bench.json --markdown bench.md"),
    ),
    "reproduce": Entry(
        "reproduce.Reproduce",
        "reproduce the paper's figures and tables, with its numbers beside ours",
        ("cfb reproduce all -o out/paper", "cfb reproduce rotor-curves -o out/paper --real flights"),
    ),
    "demo-loop": Entry(
        "demo_loop.DemoLoop",
        "fly a drone with an unmodelled effect, correct the model, retrain, fly again",
        ("cfb demo-loop -o out/loop", "cfb demo-loop -o out/loop --effects payload --seeds 2"),
    ),
    "demo": Entry(
        "demo.Demo",
        "evaluate a flight, fly 4096 randomised drones, write a page with the results",
        ("cfb demo -o out/demo", "cfb demo -o out/demo --real flights"),
    ),
    "version": Entry("version.Version", "print the versions of cfb_mjx and of its dependencies", ("cfb version",)),
}
_CLASSES = {entry.place.rpartition(".")[2]: name for name, entry in COMMANDS.items()}
__all__ = [
    "COMMANDS",
    "Bench",
    "BenchmarkNanodrone",
    "Check",
    "CloseLoop",
    "Command",
    "Demo",
    "DemoLoop",
    "Entry",
    "Evaluate",
    "Excite",
    "Export",
    "Fit",
    "FitRotors",
    "Fly",
    "Import",
    "Refine",
    "Reproduce",
    "Result",
    "Sweep",
    "Train",
    "Version",
    "View",
    "load",
]


def load(name: str) -> type[Command]:
    """Import and return the class of a command."""
    module, _, kind = COMMANDS[name].place.rpartition(".")
    return getattr(importlib.import_module(f"cfb_mjx.commands.{module}"), kind)


def __getattr__(name: str):
    if name in _CLASSES:
        return load(_CLASSES[name])
    if name in ("Command", "Result"):
        return getattr(importlib.import_module("cfb_mjx.commands.command"), name)
    raise AttributeError(f"module 'cfb_mjx.commands' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
