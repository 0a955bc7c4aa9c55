"""Position controllers: the hover table, six metres back and forth, and the effect of randomisation.

The paper's own numbers, measured on its real drone, stand at the top.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from cfb_mjx.files import shipped
from cfb_mjx.reproduce.item import Result, Row, write_csv

PAPER_HOVER = {0.0: (284.76, 0.0203), 0.5: (100.07, 0.0245), 1.0: (43.16, 0.0197), 1.5: (71.39, 0.0548)}
PAPER_FIRMWARE = {"pid": (27.81, 0.0226), "mellinger": (54.68, 0.0394)}
"""The paper's hover tests (mean distance, mm; command std): networks by magnitude, and the firmware's controllers."""


SIMULATED = "Our results are from simulation, the paper's numbers from its real drone."
LEG_S, LEGS = 3.0, 4
ALGORITHMS = {"analytic": "back-propagation", "ppo": "PPO"}
SEEDS = 3


def controllers(folder: Path, real: Path | None) -> Result:
    """Measure hover error and command std of the network and of the firmware's controllers."""
    from cfb_mjx.control.controllers import find_controller
    from cfb_mjx.train.flying import hover
    from cfb_mjx.train.judge import Judge, away

    judge = Judge(random_drones=0)
    paper = {"target": PAPER_HOVER[1.0], **PAPER_FIRMWARE}
    rows, numbers, distances = [], [], {}
    for name, (mm, std) in paper.items():
        controller = find_controller(name, judge.nominal)
        score = judge(controller)
        _, flown = hover(controller, judge.calm, judge.nominal, judge.few)
        distances[name] = controller.control_dt_s, 1e3 * np.linalg.norm(flown.position, axis=-1)
        label = "network" if name == "target" else name
        spread, off_std = away(score, "hover_mm"), away(score, "command_std")
        rows.append(
            Row(f"hover, {label}: mean distance, mm", f"{mm:g}", f"{score['nominal']['hover_mm']:.1f}", _why(name))
        )
        rows.append(Row(f"hover, {label}: command std", f"{std:g}", f"{score['nominal']['command_std']:.4f}"))
        lost = sum(plant["failed"] > 0 for plant in score["plants"].values())
        off = "lost one" if spread is None else f"{spread:.1f} mm, {off_std:.4f}"
        rows.append(Row(f"hover, {label}, {len(score['plants'])} drones with effects: mean distance, std", "", off))
        numbers.append(
            (name, score["nominal"]["hover_mm"], score["nominal"]["command_std"], spread, off_std, lost, mm, std)
        )
    header = ("controller", "hover_mm", "command_std", "effects_hover_mm", "effects_std", "effects_lost")
    write_csv(folder / "controllers.csv", (*header, "paper_hover_mm", "paper_std"), numbers)
    _draw_hover(distances, paper, folder / "controllers.png")
    text = [
        f"{SIMULATED} Six seconds at the target, of which the last five count; mean of {len(judge.few)} flights with "
        "the noise and the delay (of pose and gyro) with which networks are trained; then the ten drones of "
        "`configs/plants/off-nominal.yaml`, whose effects are unknown to all controllers.",
        "The firmware's PID has integral action, and without wind and battery drift it comes to rest at the target. "
        "Mellinger's height error is caused by the firmware's default mass and thrust scale.",
    ]
    return Result(
        "Controllers in hover", text, rows, [(folder / "controllers.png", "distance from the target over time")]
    )


def _why(name: str) -> str:
    if name == "target":
        return "a reward with other weights; simulated, without the real drone's unmodelled effects"
    return "simulated drone: no wind, no drift" if name == "pid" else "default mass and thrust scale of the firmware"


def _draw_hover(distances: dict, paper: dict, path: Path) -> None:
    from cfb_mjx.view.style import COLOURS, MEASURED, context, new_figure, save

    with context():
        figure = new_figure(9.6, 3.2)
        for axis, (name, (dt, distance)) in zip(figure.subplots(1, len(distances)), distances.items(), strict=True):
            time = dt * (1 + np.arange(distance.shape[1]))
            low, middle, high = np.percentile(distance, [5, 50, 95], axis=0)
            axis.fill_between(time, low, high, color=COLOURS["commands_in"], alpha=0.25, linewidth=0, label="5 to 95 %")
            axis.plot(time, middle, color=COLOURS["commands_in"], label="median, simulated")
            axis.axhline(paper[name][0], color=MEASURED, linestyle=":", label="paper's mean, real drone")
            axis.axvspan(0, 1, color="#f2f2f2", linewidth=0)
            axis.set_title("network" if name == "target" else name)
            axis.set_xlabel("time, s")
            axis.set_ylim(0, None)
            axis.margins(x=0)
        figure.axes[0].set_ylabel("distance, mm")
        figure.axes[0].legend(loc="upper right", fontsize=8)
        figure.subplots_adjust(left=0.055, right=0.99, bottom=0.15, top=0.91, wspace=0.16)
        save(figure, path)


def back_and_forth(folder: Path, real: Path | None) -> Result:
    """Fly six metres back and forth with the network."""
    import jax

    from cfb_mjx.control.controllers import find_controller
    from cfb_mjx.envs import TargetTask
    from cfb_mjx.model import Quadrotor
    from cfb_mjx.train.flying import STEP_DISTANCE_M, back_and_forth, six_metres

    nominal = Quadrotor.from_file("cfb-guards")
    controller = find_controller("target", nominal)
    flown = back_and_forth(controller, TargetTask(), nominal, jax.random.PRNGKey(0), LEGS, LEG_S)
    step, _ = six_metres(controller, TargetTask(), nominal, jax.random.split(jax.random.PRNGKey(1), 64))
    dt = controller.control_dt_s
    time, position = dt * (1 + np.arange(len(flown.position))), np.asarray(flown.position)
    speed, target = np.linalg.norm(flown.velocity, axis=-1), np.asarray(flown.watched)
    arrival, peak = float(np.median(step.arrival_s)), float(np.median(step.peak_speed_mps))
    slower = "to within 10 cm, median of 64 flights; ours flies faster"
    limit = "the reward does not limit the speed below the 10 m/s at which an episode ends"
    rows = [
        Row("distance, m", "6", f"{STEP_DISTANCE_M:g}", kind="input"),
        Row("time, s", "2", f"{arrival:.2f}", slower),
        Row("largest speed, m/s", "about 5", f"{peak:.1f}", limit),
        Row("beyond the target, m", "", f"{float(np.median(step.overshoot_m)):.2f}"),
    ]
    table = [tuple(map(float, row)) for row in np.column_stack([time, target[:, 0], position, speed, flown.command])]
    header = ("time_s", "target_x_m", "x_m", "y_m", "z_m", "speed_mps", "u1", "u2", "u3", "u4")
    write_csv(folder / "back-and-forth.csv", header, table)
    _draw_back_and_forth(time, target, position, speed, folder / "back-and-forth.png")
    text = [f"{SIMULATED} The target jumps by six metres every {LEG_S:g} s."]
    return Result(
        "Six metres back and forth", text, rows, [(folder / "back-and-forth.png", "position and speed over time")]
    )


def _draw_back_and_forth(time, target, position, speed, path: Path) -> None:
    from cfb_mjx.view.style import COLOURS, MEASURED, context, new_figure, save

    with context():
        figure = new_figure(7.0, 4.6)
        above, middle, below = figure.subplots(3, 1, sharex=True, height_ratios=(1.6, 1, 1))
        above.plot(time, target[:, 0], color=MEASURED, linestyle=":", label="target")
        above.plot(time, position[:, 0], color=COLOURS["commands_in"], label="x")
        above.set_ylabel("x, m")
        above.legend(loc="center right")
        for i, (name, colour) in enumerate((("y", COLOURS["hold"]), ("z", COLOURS["rotor_speed_in"])), 1):
            middle.plot(time, position[:, i], color=colour, label=name)
        middle.set_ylabel("y, z, m")
        middle.legend(loc="upper right", ncols=2)
        below.plot(time, speed, color=COLOURS["commands_in"])
        below.set_ylabel("speed, m/s")
        below.set_xlabel("time, s")
        below.margins(x=0)
        figure.subplots_adjust(left=0.1, right=0.99, bottom=0.1, top=0.98, hspace=0.12)
        save(figure, path)


def randomisation(folder: Path, real: Path | None) -> Result:
    """Fly networks that were trained with different magnitudes of randomisation."""
    from cfb_mjx.control.controllers import find_controller
    from cfb_mjx.train.judge import Judge, away
    from cfb_mjx.view.magnitudes import magnitudes_figure

    judge, found, rows, numbers = Judge(random_drones=0), {}, [], []
    for algorithm, title in ALGORITHMS.items():
        found[title] = {}
        for magnitude, (mm, std) in PAPER_HOVER.items():
            files = [shipped("data", "study", algorithm, f"{magnitude:g}-{seed}.npz") for seed in range(SEEDS)]
            scores = [judge(find_controller(file, judge.nominal)) for file in files]
            of = found[title][magnitude] = {
                "nominal": [s["nominal"]["hover_mm"] for s in scores],
                "nominal_std": [s["nominal"]["command_std"] for s in scores],
                "away": [away(s, "hover_mm") for s in scores],
                "away_std": [away(s, "command_std") for s in scores],
            }
            numbers += [
                (algorithm, magnitude, seed, *values) for seed, values in enumerate(zip(*of.values(), strict=True))
            ]
            ours = f"{_mean(of['nominal'], '.1f')}; {_mean(of['away'], '.1f')}"
            rows.append(
                Row(
                    f"magnitude {magnitude:g}, {title}: mean distance, mm: nominal; with effects",
                    f"{mm:g}",
                    ours,
                    _less(algorithm, files[0]),
                )
            )
            ours = f"{_mean(of['nominal_std'], '.4f')}; {_mean(of['away_std'], '.4f')}"
            rows.append(Row(f"magnitude {magnitude:g}, {title}: command std: nominal; with effects", f"{std:g}", ours))
    header = ("algorithm", "magnitude", "seed", "nominal_mm", "nominal_std", "effects_mm", "effects_std")
    write_csv(folder / "randomisation.csv", header, numbers)
    magnitudes_figure(found, PAPER_HOVER, folder / "randomisation.png")
    text = [
        f"{SIMULATED} Three networks per magnitude and algorithm (`data/study`; trained for hours by "
        "`python scripts/study_magnitudes.py`, docs/magnitudes.md) fly the hover test again: on the nominal drone, and "
        "on ten drones with effects that represent the real one. Means over the seeds; lost: a drone was lost.",
    ]  # fmt: skip
    return Result("Effect of randomisation", text, rows, [(folder / "randomisation.png", "hover error over magnitude")])


def _less(algorithm: str, policy: Path) -> str:
    from cfb_mjx.control.policy_file import load_policy

    if algorithm != "ppo":
        return "not the paper's algorithm"
    return f"{load_policy(policy).training['config']['ppo']['steps'] / 1e6:.0f} M commands each; another reward"


def _mean(values: list, digits: str) -> str:
    there = [v for v in values if v is not None]
    lost = f" ({len(values) - len(there)} lost)" if len(there) < len(values) else ""
    return (format(sum(there) / len(there), digits) if there else "all") + lost
