"""Flips: four single flips of different shape, and the double flip."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from cfb_mjx.optional import not_none
from cfb_mjx.reproduce.item import Result, Row, write_csv

SHAPES = ("flip-low", "flip-fast", "flip-wide", "flip-high")
FLIGHTS = 64
SIMULATED = (
    "Our results are from simulation, with observations that are noisy and 8 ms late; the paper's numbers are from its "
    "real drone."
)


def _flown(name: str, count: int):
    import jax

    from cfb_mjx.control.manoeuvre import Manoeuvre
    from cfb_mjx.deploy.deployment import find_deployment
    from cfb_mjx.envs import TargetTask
    from cfb_mjx.model import Quadrotor
    from cfb_mjx.train.flips import flips

    nominal = Quadrotor.from_file("cfb-guards")
    of = find_deployment(name)
    controller = of.controller
    assert isinstance(controller, Manoeuvre)  # all names in this file are flips
    measured, flown = flips(controller, TargetTask(), nominal, jax.random.split(jax.random.PRNGKey(11), count))
    return not_none(of.manoeuvre), measured, flown, controller.control_dt_s


def four_flips(folder: Path, real: Path | None) -> Result:
    """Fly single flips of different shape, and draw them in the YZ plane."""
    from cfb_mjx.view.flight_figures import draw_path
    from cfb_mjx.view.style import context, new_figure, save

    rows, numbers = [], []
    with context():
        figure = new_figure(10.0, 3.8)
        plots = figure.subplots(1, len(SHAPES))
        for axis, name in zip(plots, SHAPES, strict=True):
            of, measured, flown, dt = _flown(name, 1)
            draw_path(axis, flown, dt)
            axis.set_title(name)
            axis.set_aspect("equal", adjustable="datalim")
            numbers += _path(name, flown, dt)
            rate = np.degrees(float(measured.peak_rate_radps[0]))
            rows.append(
                Row(
                    f"{name}: turns; height, m; rate, deg/s",
                    "",
                    f"{float(measured.rotations[0]):.2f}; {float(measured.vertical_extent_m[0]):.2f}; {rate:.0f}",
                    of.description,
                )
            )
        plots[0].set_ylabel("z, m")
        plots[0].legend(loc="upper left")
        figure.subplots_adjust(left=0.07, right=0.99, bottom=0.13, top=0.91, wspace=0.22)
        save(figure, folder / "flips.png")
    write_csv(folder / "flips.csv", ("flip", "time_s", "y_m", "z_m", "roll_deg", "roll_rate_dps", "phase"), numbers)
    rows.insert(0, Row("shapes of single flips", "4", str(len(SHAPES)), kind="input"))
    text = [f"{SIMULATED} One policy, with four settings of switching times and set-points."]
    return Result("Single flips", text, rows, [(folder / "flips.png", "four single flips in the YZ plane")])


def double_flip(folder: Path, real: Path | None) -> Result:
    """Fly double flips, and draw the path in the YZ plane and the roll angle over time."""
    from cfb_mjx.view.flight_figures import flip_figure

    rows, numbers, figures = [], [], []
    stated = {
        "vertical_extent_m": ("vertical movement, m", "1.8", 1.0, ".2f"),
        "peak_rate_radps": ("body rate, deg/s", "about 1000", 180 / np.pi, ".0f"),
        "rate_stop_s": ("rate stopped within, s", "0.35", 1.0, ".2f"),
        "fall_mps": ("falling speed, m/s", "3.5", 1.0, ".2f"),
        "vertical_stop_s": ("fall stopped within, s", "0.6", 1.0, ".2f"),
        "return_error_m": ("distance from the start afterwards, m", "", 1.0, ".3f"),
    }
    for name in ("double-flip-paper", "double-flip"):
        of, measured, _, dt = _flown(name, FLIGHTS)
        values = {key: float(np.mean(x)) for key, x in measured._asdict().items()}
        rows.append(Row(f"{name}: roll, deg", "720", f"{360 * values['rotations']:.0f}", of.description))
        for key, (what, paper, scale, digits) in stated.items():
            rows.append(Row(f"{name}: {what}", paper, format(scale * values[key], digits)))
        good = float(np.mean(measured.completed(of.rotations)))
        rows.append(Row(f"{name}: completed, of {FLIGHTS} flights", "", f"{good:.0%}"))
        _, _, one, _ = _flown(name, 1)
        numbers += _path(name, one, dt)
        flip_figure(one, dt, folder / f"{name}.png", name)
        figures.append((folder / f"{name}.png", f"{name}: path in the YZ plane, roll angle, rate and vertical speed"))
    write_csv(
        folder / "double-flip.csv", ("flip", "time_s", "y_m", "z_m", "roll_deg", "roll_rate_dps", "phase"), numbers
    )
    text = [
        f"{SIMULATED} `double-flip-paper` is as fast as the paper's double flip; `double-flip` is the one that most "
        "randomised drones complete (docs/flips.md has 4096 of them, the lowest double flip, and a triple flip).",
    ]  # fmt: skip
    return Result("The double flip", text, rows, figures)


def _path(name: str, flown, dt: float) -> list[tuple]:
    from cfb_mjx.control.manoeuvre import roll_angle, unwrapped

    roll = np.degrees(np.asarray(unwrapped(roll_angle(flown.quaternion[:1]))))[0]
    position, rate, phase = (np.asarray(x)[0] for x in (flown.position, flown.body_rate, flown.watched))
    return [
        (name, dt * (k + 1), float(p[1]), float(p[2]), float(roll[k]), float(np.degrees(rate[k, 0])), int(phase[k]))
        for k, p in enumerate(position)
    ]
