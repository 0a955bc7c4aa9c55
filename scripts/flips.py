"""Search for the settings of the shipped flips, measure the flips, and write docs/flips.md.

python scripts/flips.py             measure: docs/flips.md, its figures, benchmarks/flips.json (minutes)
python scripts/flips.py --search    search for the settings first: configs/manoeuvres (a quarter of an hour)
python scripts/flips.py --before EARLIER.json   list the changes since those results
python scripts/flips.py --page-only write the page from the stored results
"""

import argparse
import json
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from campaign import ROOT, facts_line, moved

from cfb_mjx.runtime import configure_jax, environment, say

RANDOM, NOMINAL, SEED = 4096, 64, 11
PAPER_EXTENT_M = 1.8
MANOEUVRES, RESULTS, PAGE = ROOT / "configs" / "manoeuvres", ROOT / "benchmarks" / "flips.json", ROOT / "docs"


@dataclass(frozen=True)
class Wanted:
    """Requirements of a shipped flip."""

    rotations: int
    aim: str
    why: str
    fixed: dict = field(default_factory=dict)
    goal: dict = field(default_factory=dict)
    magnitude: float = 1.0
    """Magnitude of the randomisation in the search; above one where hardly any drone fails at one."""
    holder: str = "target-analytic"
    """Policy that flies the climb and the catch."""


# About 1000 deg/s is 17.5 rad/s; the drone overshoots the commanded rate by a tenth.
FLIPS = {
    "flip": Wanted(
        1,
        "margin",
        "One turn, completed by as many randomised drones as possible.",
        {"rate_radps": 17.0},
        magnitude=1.2,
    ),
    "double-flip": Wanted(
        2, "margin", "Two turns, completed by as many randomised drones as possible.", {"rate_radps": 17.1}
    ),
    "double-flip-within": Wanted(2, "within", "Two turns within 1.8 m for as many randomised drones as possible."),
    "double-flip-ppo": Wanted(
        2,
        "within",
        "Two turns within 1.8 m for as many randomised drones as possible, with policies trained by PPO.",
        holder="target",
    ),
    "double-flip-paper": Wanted(
        2,
        "margin",
        "Two turns as in the paper: 1000 deg/s, and a fall of 3.5 m/s to stop.",
        {"rate_radps": 15.7},
        {"fall_mps": 3.5},
    ),
    "double-flip-low": Wanted(2, "height", "Two turns in the least height."),
    "triple-flip": Wanted(
        3, "margin", "Three turns, completed by as many randomised drones as possible.", {}, {"extent_m": 3.0}, 0.8
    ),
    "triple-flip-low": Wanted(3, "height", "Three turns in the least height."),
    "flip-low": Wanted(1, "height", "One turn in the least height."),
    "flip-fast": Wanted(1, "height", "One fast turn.", {"rate_radps": 21.0, "climb_mps": 2.5, "climb_s": 1.2}),
    "flip-wide": Wanted(
        1,
        "height",
        "One slow turn with thrust throughout.",
        {"rate_radps": 8.5, "speed_mps": 5.0, "climb_mps": 3.5, "climb_s": 1.2},
    ),
    "flip-high": Wanted(
        1,
        "height",
        "One turn from a fast climb.",
        {"rate_radps": 14.0, "climb_mps": 4.5, "climb_s": 1.2, "climb_m": 6.0},
    ),
}
SHAPES = ("flip-low", "flip-fast", "flip-wide", "flip-high")
"""Single flips in the figure."""


def main() -> None:
    """Search if asked to, measure the flips and write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--search",
        nargs="*",
        choices=list(FLIPS),
        metavar="NAME",
        help="search for the settings of these flips; of all without a NAME",
    )
    parser.add_argument("--page-only", action="store_true")
    parser.add_argument("--before", type=Path, help="results of an earlier run to compare with")
    arguments = parser.parse_args()
    before = json.loads(arguments.before.read_text()) if arguments.before else None
    configure_jax(x64=False)
    from cfb_mjx.files import write_json, write_text

    if not arguments.page_only:
        course = Course()
        for name in FLIPS if arguments.search == [] else arguments.search or ():
            course.search(name)
        write_json(RESULTS, {"environment": environment(), "flips": {name: course.measure(name) for name in FLIPS}})
        course.draw()
    found = json.loads(RESULTS.read_text())
    change = moved(before, found, _headlines) if before else []
    write_text(PAGE / "flips.md", page(found, change))
    print("docs/flips.md")


class Course:
    """The drone, the policies and the tests that all flips share."""

    def __init__(self):
        import jax

        from cfb_mjx.control.controllers import find_controller
        from cfb_mjx.envs import TargetTask
        from cfb_mjx.model import Quadrotor
        from cfb_mjx.parameters import load_model_file, load_randomisation
        from cfb_mjx.train.flying import load_plants

        described = load_model_file("cfb-guards")
        self.nominal = Quadrotor.from_file(described)
        self.plants = load_plants(described)
        self.turner = find_controller("flip", self.nominal)
        self.calm, self.wild = TargetTask(), TargetTask(randomisation=load_randomisation("paper"))
        self.few, self.many = (jax.random.split(jax.random.PRNGKey(SEED), n) for n in (NOMINAL, RANDOM))

    def manoeuvre(self, name: str):
        """Load a flip from configs/manoeuvres."""
        from cfb_mjx.deploy.deployment import find_deployment

        return find_deployment(name).controller

    def search(self, name: str) -> None:
        """Search for the knobs of a flip, beginning from its present ones if it has any, and save them."""
        from dataclasses import replace

        import jax

        from cfb_mjx.control.controllers import find_controller
        from cfb_mjx.control.manoeuvre import Knobs, Manoeuvre, ManoeuvreFile, save_manoeuvre
        from cfb_mjx.train.flips import Goal, bounds, search

        wanted = FLIPS[name]
        there = (MANOEUVRES / f"{name}.yaml").exists()
        knobs = self.manoeuvre(name).knobs if there else bounds(wanted.rotations).low
        found = search(
            Manoeuvre(find_controller(wanted.holder, self.nominal), self.turner, knobs),
            replace(self.wild, magnitude=wanted.magnitude),
            self.nominal,
            Goal(wanted.rotations, wanted.aim, **wanted.goal),
            jax.random.PRNGKey(0),
            bounds(wanted.rotations, **wanted.fixed),
            report=lambda done, cost: say(f"{name}, round {done}: {cost:.4f}"),
        )
        written = ManoeuvreFile(wanted.rotations, Knobs(*map(float, found.knobs)), wanted.why, wanted.holder)
        save_manoeuvre(written, MANOEUVRES / f"{name}.yaml")

    def measure(self, name: str) -> dict:
        """Measure a flip on nominal, randomised and off-nominal drones, and replay its commands in open loop."""
        from cfb_mjx.train.flips import flips, replay

        say(name)
        manoeuvre, rotations = self.manoeuvre(name), FLIPS[name].rotations
        at_home, flown = flips(manoeuvre, self.calm, self.nominal, self.few)
        away, _ = flips(manoeuvre, self.wild, self.nominal, self.many)
        well = np.asarray(away.completed(rotations))
        kept = {key: np.asarray(value) for key, value in at_home._asdict().items()}
        others = {}
        for plant, drone in self.plants.items():
            measured = flips(manoeuvre, self.calm, drone, self.few[:16])[0]
            others[plant] = float(np.mean(measured.completed(rotations)))
        again = {key: float(x) for key, x in replay(manoeuvre, self.nominal)._asdict().items()}
        extent = np.asarray(away.vertical_extent_m)[well]
        return {
            "holder": FLIPS[name].holder,
            "knobs": {key: float(x) for key, x in manoeuvre.knobs._asdict().items()},
            "nominal": {key: float(np.mean(value)) for key, value in kept.items()},
            "worst": {key: float(np.max(value)) for key, value in kept.items()},
            "completed_nominal": float(np.mean(at_home.completed(rotations))),
            "completed_random": float(well.mean()),
            "completed_within": float(np.mean(well & (np.asarray(away.vertical_extent_m) <= PAPER_EXTENT_M))),
            "random_extent_m": {f"{q:g}": float(np.quantile(extent, q)) for q in (0.5, 0.95)},
            "off_nominal": others,
            "command": [float(np.min(flown.command)), float(np.max(flown.command))],
            "replay": again,
        }

    def draw(self) -> None:
        """Draw the figures of the page and write a recording of each flip to out/flips."""
        from cfb_mjx.files import output_folder
        from cfb_mjx.train.flips import flips
        from cfb_mjx.view.flight import write_flight_recording
        from cfb_mjx.view.flight_figures import draw_path, flip_figure
        from cfb_mjx.view.style import context, new_figure, save

        with context():
            figure = new_figure(10.0, 3.8)
            plots = figure.subplots(1, len(SHAPES))
            for axis, name in zip(plots, SHAPES, strict=True):
                flown = flips(self.manoeuvre(name), self.calm, self.nominal, self.few[:1])[1]
                draw_path(axis, flown, self.turner.control_dt_s)
                axis.set_title(name)
                axis.set_aspect("equal", adjustable="datalim")
            plots[0].set_ylabel("z, m")
            plots[0].legend(loc="upper left")
            figure.subplots_adjust(left=0.07, right=0.99, bottom=0.13, top=0.91, wspace=0.22)
            save(figure, PAGE / "flips.png")
        for name in ("double-flip-paper", "double-flip-low", "triple-flip-low"):
            flown = flips(self.manoeuvre(name), self.calm, self.nominal, self.few[:1])[1]
            flip_figure(flown, self.turner.control_dt_s, PAGE / f"{name}.png", name)
        folder = output_folder(ROOT / "out" / "flips")
        for name in FLIPS:
            flown = flips(self.manoeuvre(name), self.calm, self.nominal, self.few[:1])[1]
            write_flight_recording(folder / f"{name}.rrd", flown, self.turner.control_dt_s)


def page(found: dict, change: list[str]) -> str:
    """The Markdown page."""
    degrees = 180 / np.pi
    lines = [
        "# Flips",
        "",
        "This page is for users who fly the shipped flips or search for their own. It measures each shipped flip in "
        "simulation.",
        "",
        "```sh",
        "cfb fly double-flip --figure flip.png",
        "```",
        "",
        facts_line("python scripts/flips.py", [found]).replace("trained", "flown"),
        "",
        "A flip has three phases. A policy that holds a target (the holder) climbs, the shipped policy `flip`, trained "
        "by PPO, turns about the x axis at a given rate, and the holder catches the drone at the start. The holder is "
        "the shipped `target-analytic`, trained by back-propagation, and in `double-flip-ppo` it is `target`, trained "
        "by PPO. `configs/manoeuvres` has the holder and the settings (knobs) of each flip. `python scripts/flips.py "
        "--search` found them in simulation with the cross-entropy method.",
        "",
        "In all flights the estimates are noisy and 8 ms late. The columns of the table:",
        "",
        f"- turns to error: on the nominal drone, mean of {NOMINAL} flights. Height is the highest minus the lowest "
        "point; rate and fall are the largest roll rate and downward speed; error is the mean distance from the start "
        "in the last second.",
        "- rate stopped, fall stopped: time from the switch to the holder until the body rate is below 100 deg/s, and "
        "until the drone no longer falls.",
        f"- completed: share of {RANDOM} drones of the paper's full randomisation that make all turns, return within "
        "0.75 m, are never 2 m below the start and exceed no limit of speed or rate.",
        f"- within {PAPER_EXTENT_M} m: share of the same drones that complete the flip in no more height than that.",
        "",
        "The paper's double flip on the real drone takes 1.8 m; it stops about 1000 deg/s in 0.35 s, and about 3.5 m/s "
        "in 0.6 s.",
        "",
        "| flip | turns | height, m | rate, deg/s | rate stopped, s | fall, m/s | fall stopped, s | error, mm "
        f"| completed | within {PAPER_EXTENT_M} m | height of completed flips, m: median, 95 % |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for name, r in found["flips"].items():
        n, tall = r["nominal"], r["random_extent_m"]
        cells = [
            name,
            f"{n['rotations']:.2f}",
            f"{n['vertical_extent_m']:.2f}",
            f"{n['peak_rate_radps'] * degrees:.0f}",
        ]
        cells += [_time(n["rate_stop_s"]), f"{n['fall_mps']:.2f}", _time(n["vertical_stop_s"])]
        cells += [f"{1e3 * n['return_error_m']:.0f}", f"{r['completed_random']:.2%}"]
        cells.append(f"{r['completed_within']:.2%}")
        cells += [f"{tall['0.5']:.2f}, {tall['0.95']:.2f}"]
        lines.append("| " + " | ".join(cells) + " |")
    lines += [
        "",
        "![double flip like the paper's](double-flip-paper.png)",
        "",
        "Left: the trajectory in the YZ plane, with the drone. Right: roll angle, roll rate and vertical speed. The "
        "flip policy flies in the grey interval.",
        "",
        "## Single flips",
        "",
        "One policy flies four shapes with four settings of the knobs. The script writes Rerun recordings of all flips "
        "to `out/flips`.",
        "",
        "![single flips](flips.png)",
        "",
        "## The least height",
        "",
        "`double-flip-low` and `triple-flip-low` are the lowest flips that the search found. Fewer randomised drones "
        "complete them (see the table).",
        "",
        "![lowest double flip](double-flip-low.png)",
        "",
        "![lowest triple flip](triple-flip-low.png)",
        "",
        "## Other drones",
        "",
        "Share of 16 flights that are completed on drones with effects that no policy was trained on "
        "(`configs/plants/off-nominal.yaml`).",
        "",
    ]
    plants = list(next(iter(found["flips"].values()))["off_nominal"])
    lines += ["| flip | " + " | ".join(plants) + " |", "|---|" + "---|" * len(plants)]
    for name, r in found["flips"].items():
        lines.append(f"| {name} | " + " | ".join(f"{r['off_nominal'][p]:.0%}" for p in plants) + " |")
    lines += [
        "",
        "## No hidden thrust",
        "",
        "This check shows that only the motors move the drone. Commands stay within [0, 1]. The recorded commands of a "
        "flight without noise, replayed in open loop on the nominal drone, give the same trajectory. The thrust in "
        "flight (specific force times mass) never exceeds the thrust of the motor model at full command.",
        "",
        "| flip | least and largest command | distance between trajectories, mm | largest thrust, N "
        "| motor model at full command, N |",
        "|---|---|---|---|---|",
    ]
    for name, r in found["flips"].items():
        again, (low, high) = r["replay"], r["command"]
        cells = [name, f"{low:.3f}, {high:.3f}", f"{1e3 * again['apart_m']:.3g}"]
        cells += [f"{again['largest_thrust_n']:.3f}", f"{again['model_thrust_n']:.3f}"]
        lines.append("| " + " | ".join(cells) + " |")
    knobs = list(next(iter(found["flips"].values()))["knobs"])
    lines += ["", "## Knobs", "", "| flip | holder | " + " | ".join(knobs) + " |", "|---|---|" + "---|" * len(knobs)]
    for name, r in found["flips"].items():
        lines.append(f"| {name} | {r['holder']} | " + " | ".join(f"{r['knobs'][k]:.4g}" for k in knobs) + " |")
    return "\n".join([*lines, *change]) + "\n"


def _headlines(found: dict) -> dict[str, float]:
    """Return the main numbers of each flip, for the comparison with an earlier run."""
    numbers = {}
    for name, r in found["flips"].items():
        n = r["nominal"]
        numbers |= {f"{name}: completed": r["completed_random"], f"{name}: height, m": n["vertical_extent_m"]}
        numbers |= {f"{name}: rate, rad/s": n["peak_rate_radps"], f"{name}: fall, m/s": n["fall_mps"]}
        numbers[f"{name}: knob climb_m"] = r["knobs"]["climb_m"]
    return numbers


def _time(seconds: float | None) -> str:
    return "never" if seconds is None or not np.isfinite(seconds) else f"{seconds:.2f}"


if __name__ == "__main__":
    main()
