"""Page of a study of the whole cycle (fly, correct the model, train, fly again): figure, tables and explanations."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from cfb_mjx.loop.summary import MEASURES, POLICIES, Row, Spread, summarise, value_of
from cfb_mjx.view.page import Section
from cfb_mjx.view.style import check_path, context, new_figure, save

TITLE = "From a flight to a better flight, by correcting the model"
LABELS = {
    "without_effect": "nominal policy, drone without the effect",
    "nominal": "nominal policy",
    "longer": "nominal policy, trained longer",
    "randomised": "more randomisation",
    "corrected": "corrected model",
    "both": "corrected model and more randomisation",
}
_HEADS = {"hover_mm": "hover error, mm", "track_m": "tracking error, m"}
_DIGITS = {"hover_mm": ".0f", "track_m": ".3f"}
_LOOKS = {
    "without_effect": ("#8C8C8C", "|", 9),
    "nominal": ("#D55E00", "o", 5),
    "longer": ("#E69F00", "x", 5),
    "randomised": ("#009E73", "^", 5),
    "corrected": ("#0072B2", "s", 5),
    "both": ("#56B4E9", "D", 4.5),
}
ERROR = "position_rmse_m@0.5s"


def lead(results: dict[str, Any]) -> str:
    """First paragraph: numbers of effects that were found, and of effects with better flights.

    Args:
        results: results of `cfb_mjx.loop.study.study`.
    """
    rows = summarise(results["cells"].values())
    count = len(results["cells"])
    right = sum(row.right for row in rows)
    better = {m: sum(row.improved(m) for row in rows) for m in MEASURES}
    drones = "drone" if count == 1 else "drones"
    effects = "effect" if len(rows) == 1 else "effects"
    return (
        f"{count} {drones} with {len(rows)} {effects} that the model lacks. From flights of a policy trained on "
        f"that model, close-loop named the effect of {right} of {count}. Trained further on the corrected model, the "
        f"policy hovers the same drone better for {better['hover_mm']} of {len(rows)} {effects} and tracks better for "
        f"{better['track_m']} of {len(rows)} (median over the seeds)."
    )


def sections(results: dict[str, Any], figure: Path) -> list[Section]:
    """All sections after the first paragraph.

    Args:
        results: results of `cfb_mjx.loop.study.study`.
        figure: file drawn by `loop_figure`.
    """
    rows = summarise(results["cells"].values())
    short = (
        "Each row is the median over the seeds of an effect. The changes compare the policy trained on the corrected "
        "model with the nominal policy that it started from. Training alone: the change after as much further training "
        "on the declared model."
    )
    return [
        Section("In short", [short], [_in_short(rows)], [(figure, "hover and tracking error, effect by effect")]),
        Section("What was done", _story(results["settings"])),
        Section("What was named", (), [_named(rows)]),
        Section(
            "How it flies",
            [
                "Each cell is the median over the seeds [smallest, largest]. The value of a seed is the mean over its "
                "flights. If one flight of a policy crashes, the policy counts as lost with that seed."
            ],
            [_table(rows, measure) for measure in MEASURES],
        ),
        Section("Where it did not help, and why", _failures(rows)),
        Section("Drone by drone", (), [_each(results)]),
    ]


def _in_short(rows: Sequence[Row]) -> tuple:
    body = [
        [
            row.effect,
            f"{row.right} of {len(row.named)}",
            *(_percent(change) for m in MEASURES for change in (row.change[m], row.alone[m])),
            _verdict(row),
        ]
        for row in rows
    ]
    alone = "training alone"
    return "", ["effect", "named right", "hover error", alone, "tracking error", alone, "the flight is"], body


def _verdict(row: Row) -> str:
    better = [row.improved(m) for m in MEASURES]
    if all(better):
        return "better"
    if not any(better):
        return "not better"
    return "better in hover only" if better[0] else "better in tracking only"


def _percent(change: float) -> str:
    return "lost" if math.isinf(change) else f"{100 * change:+.0f} %"


def _story(settings: dict[str, Any]) -> list[str]:
    flights, trials, config = settings["flights"], settings["trials"], settings["config"]
    analytic = config["analytic"]
    further = dict(change.split("=") for change in settings["further"])
    more = dict(change.split("=") for change in settings["randomised"])
    return [
        "The drones fly in the reference simulator (cfb_mjx.reference_simulator): plain NumPy that shares no code with "
        "the model, with effects of other functional forms than the catalogue's, sensor noise, gusts of force and "
        "torque, and a battery that drains. The effects were chosen by their expected influence on a flight, before "
        "any corrected policy had flown. Flights and training were developed on other seeds.",
        f"1. A policy is trained on the declared model by back-propagation (configuration `loop`, "
        f"{analytic['updates']} updates of {analytic['drones']} drones, randomisation x "
        f"{config['randomisation']['magnitude']:g}).",
        f"2. The policy flies the drone, and the flights are logged: {', '.join(flights['FIT'])} to fit, "
        f"{', '.join(flights['HELD_OUT'])} held out, {flights['USUAL_SECONDS'][0]:g} to "
        f"{flights['USUAL_SECONDS'][1]:g} s each (long_hover {flights['SECONDS']['long_hover'][0]:g} to "
        f"{flights['SECONDS']['long_hover'][1]:g} s). Its input is position, velocity and heading relative to a moving "
        f"target, {flights['RAISE']:g} m higher than the target that the simulator's own controller would get. In "
        f"motor_excitation (a few hundredths) and in jumps (up to {flights['DITHER_OF_JUMPS']:g}), and only there, a "
        "dither is added to its commands, which is not part of its own memory of commands.",
        "3. `cfb close-loop` gets these logs and the declared model, nothing else, and writes the corrected model.",
        f"4. The policy is trained further on the corrected model: {further['analytic.updates']} updates.",
        f"5. The same drone is flown again with other noise. Hover: {trials['HOVERS']} flights of "
        f"{trials['HOVER_S']:g} s at a target that was held for two seconds before; mean distance without the first "
        f"{trials['SETTLING_S']:g} s. Tracking: {trials['TRACKS']} flights along a level figure eight of "
        f"{2 * trials['WIDTH_M']:g} m by {2 * trials['DEPTH_M']:g} m, one round in {trials['PERIOD_S']:g} s, RMS "
        f"distance from its moving point from {trials['ENTRY_S']:g} s to {trials['TRACK_S']:g} s. Positions are those "
        "that the drone's own tracking reports.",
        f"For comparison: the nominal policy trained further by the same number of updates on the declared model (the "
        f"value of more training); a policy trained with randomisation x {float(more['randomisation.magnitude']):g} "
        f"and as many updates as the corrected one in total; that policy trained further on the corrected model, still "
        "randomised; and the nominal policy on the same drone without the effect, "
        "as it would fly if the model were right.",
    ]


def _named(rows: Sequence[Row]) -> tuple:
    body = []
    for row in rows:
        names = "; ".join(", ".join(names) or "nothing" for names in row.named)
        before, after = row.held_out[ERROR]
        body.append([row.effect, names, f"{1e3 * before:.1f}", f"{1e3 * after:.1f}"])
    caption = "Reported effects by seed; RMS position error of predictions over 0.5 s on held-out flights (median)"
    return caption, ["effect", "close-loop reports", "before, mm", "after, mm"], body


def _table(rows: Sequence[Row], measure: str) -> tuple:
    body = [[row.effect, *(_span(row.spreads[measure][p], _DIGITS[measure]) for p in POLICIES)] for row in rows]
    return _HEADS[measure], ["effect", *(LABELS[p] for p in POLICIES)], body


def _span(spread: Spread, digits: str) -> str:
    middle, least, greatest = (_one(x, digits) for x in (spread.median, spread.least, spread.greatest))
    crashed = f" ({spread.crashed} crashed)" if spread.crashed else ""
    return middle + ("" if spread.least == spread.greatest else f" [{least}, {greatest}]") + crashed


def _one(value: float, digits: str) -> str:
    return "lost" if math.isinf(value) else format(value, digits)


def _failures(rows: Sequence[Row]) -> list[str]:
    words = []
    for row in rows:
        worse = [m for m in MEASURES if not row.improved(m)]
        if worse:
            what = " and ".join(f"{_HEADS[m].split(',')[0]} {_percent(row.change[m])}" for m in worse)
            words.append(f"{row.effect}: {what}. {' '.join(row.why_not)}".strip())
    rivals = [row for row in rows if _beaten(row)]
    if rivals:
        which = "; ".join(f"{row.effect} ({', '.join(_beaten(row))})" for row in rivals)
        words.append(f"More randomisation alone flies better than the corrected model, in the median, for: {which}.")
    return words or ["It helped with every effect, in both tests, and more randomisation alone did not do better."]


def _beaten(row: Row) -> list[str]:
    of = row.spreads
    return [
        {"hover_mm": "hover", "track_m": "tracking"}[m]
        for m in MEASURES
        if of[m]["randomised"].median < of[m]["corrected"].median
    ]


def _each(results: dict[str, Any]) -> tuple:
    body = []
    for cell in results["cells"].values():
        names = ", ".join(item["name"] for item in cell["report"]["effects"]) or "nothing"
        names += " and something unexplained" if cell["report"]["unexplained"] else ""
        ends = [[value_of(cell["trials"][p], m) for p in ("nominal", "corrected")] for m in MEASURES]
        values = [" to ".join(_one(x, _DIGITS[m]) for x in pair) for m, pair in zip(MEASURES, ends, strict=True)]
        body.append([f"{cell['effect']}, {cell['seed']}", names, *values])
    return "From the nominal to the corrected policy", ["effect, seed", "close-loop reports", *_HEADS.values()], body


def loop_figure(results: dict[str, Any], path: Path) -> None:
    """Draw one row per effect: errors of each policy, seeds as points, an arrow from nominal to corrected policy.

    Args:
        results: results of `cfb_mjx.loop.study.study`.
        path: file to write.

    Raises:
        CfbError: the ending of ``path`` is not supported, or the file cannot be written.
    """
    rows = summarise(results["cells"].values())
    cells = list(results["cells"].values())
    with context():
        from matplotlib.ticker import FormatStrFormatter, LogLocator, NullFormatter

        plot = new_figure(9.6, 1.5 + 0.6 * len(rows))
        panels = plot.subplots(1, 2, sharey=True)
        for axis, measure in zip(panels, MEASURES, strict=True):
            for height, row in enumerate(rows):
                own = [cell["trials"] for cell in cells if cell["effect"] == row.effect]
                _draw_row(axis, height, row.spreads[measure], own, measure, height == 0)
            axis.set_xscale("log")
            axis.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 3.0, 5.0)))
            axis.xaxis.set_major_formatter(FormatStrFormatter("%g"))
            axis.xaxis.set_minor_formatter(NullFormatter())
            axis.set_xlabel(_HEADS[measure])
            axis.set_yticks(range(len(rows)), [row.effect.replace("_", " ") for row in rows])
            axis.set_ylim(len(rows) - 0.5, -0.5)
        inches = plot.get_size_inches()[1]
        plot.subplots_adjust(left=0.16, right=0.98, bottom=0.55 / inches, top=1 - 0.62 / inches, wspace=0.06)
        plot.legend(*panels[-1].get_legend_handles_labels(), loc="upper center", ncols=3, fontsize=8)
        save(plot, check_path(path))


def _draw_row(axis, height: int, spreads: dict[str, Spread], trials: list[dict], measure: str, label: bool) -> None:
    for number, policy in enumerate(POLICIES):
        colour, marker, size = _LOOKS[policy]
        at = height + 0.13 * (number - 2.5)
        values = [value for value in (value_of(trial[policy], measure) for trial in trials) if math.isfinite(value)]
        axis.plot(values, [at] * len(values), marker, color=colour, markersize=0.6 * size, alpha=0.4)
        if math.isfinite(spreads[policy].median):
            axis.plot(
                spreads[policy].median,
                at,
                marker,
                color=colour,
                markersize=size,
                linestyle="none",
                label=LABELS[policy] if label else None,
            )
    before, after = spreads["nominal"].median, spreads["corrected"].median
    if math.isfinite(before) and math.isfinite(after):
        ends = {"xy": (after, height + 0.195), "xytext": (before, height - 0.195)}
        axis.annotate("", **ends, arrowprops={"arrowstyle": "->", "color": "#555555", "linewidth": 0.8})
