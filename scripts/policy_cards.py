"""Write the card of each shipped policy: algorithm, training conditions, learning curve, scores and limits.

    python scripts/policy_cards.py

The cards are written from the files next to each policy and from the results of scripts/measure_controllers.py and
scripts/flips.py, so run it after these. A card is beside the policy, and in its file.
"""

import argparse
import csv
import json
from dataclasses import replace
from pathlib import Path

import yaml

from cfb_mjx.control.policy_file import load_policy, save_policy, shipped_policies
from cfb_mjx.train.card import ALGORITHMS, conditions

ROOT = Path(__file__).resolve().parents[1]
SWINGS = 0.04
"""Command std in hover above which a drone visibly oscillates."""
CURVE_ROWS = 6
COLUMNS = {
    "hover_mm": "hover, nominal, mm",
    "track_mm": "figure eight, nominal, mm",
    "random_mm": "randomised, median, mm",
    "command_std": "command std",
    "rate_error_radps": "rate error, rad/s",
}


def main() -> None:
    """Write all cards."""
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    from cfb_mjx.files import write_text

    for path in shipped_policies().values():
        text, policy = card(path.parent), load_policy(path)
        write_text(path.with_name("card.md"), text)
        if policy.card != text:
            save_policy(replace(policy, card=text), path)
        print(path.with_name("card.md").relative_to(ROOT))


def card(folder: Path) -> str:
    """Return the card of the policy in ``folder``, as Markdown."""
    config = yaml.safe_load((folder / "config.yaml").read_text())
    last = json.loads((folder / "training.json").read_text())
    parts = [yaml.safe_load(path.read_text()) for path in sorted(folder.glob("config*.yaml"))]
    lines = [f"# {folder.name}", ""]
    for part in parts:
        lines += [" ".join(part["description"].split()), ""]
    lines += ["## Training", "", *_training(folder, config, last), ""]
    lines += ["## Conditions of the training", "", *conditions(config), ""]
    lines += ["## Learning curve", "", *_curve(folder), ""]
    scores = {"flip": _flips, "track": _tracking}.get(config["task"], _scores)
    lines += ["## Scores", "", *scores(folder.name)]
    return "\n".join(lines) + "\n"


def _training(folder: Path, config: dict, last: dict) -> list[str]:
    facts, end = last["environment"], last["last"]
    how = ALGORITHMS[config["algorithm"]]
    lines = [
        f"- {how}, seed {config['seed']}: {end['commands'] / 1e6:.0f} M commands in {end['seconds'] / 60:.0f} min, "
        f"{facts['date']}, {facts['processor']}, Python {facts['python']}, jax {facts['jax']}, cfb_mjx "
        f"{facts['cfb_mjx']}."
    ]
    if (folder / "training-1.json").exists():
        first = json.loads((folder / "training-1.json").read_text())["last"]
        minutes = first["seconds"] / 60
        lines.append(f"- Continues a first part of {first['commands'] / 1e6:.0f} M commands in {minutes:.0f} min.")
    lines.append(
        "- Commands: see `README.md` in the folder above. All settings: `config.yaml`, also stored in `policy.npz`."
    )
    return lines


def _curve(folder: Path) -> list[str]:
    rows = list(csv.DictReader((folder / "curve.csv").read_text().splitlines()))
    # Evenly spaced, the last row included.
    chosen = rows[:: -(-len(rows) // CURVE_ROWS)]
    chosen += [] if chosen[-1] is rows[-1] else [rows[-1]]
    there = {key: title for key, title in COLUMNS.items() if key in rows[0]}
    lines = ["| commands | time | " + " | ".join(there.values()) + " |", "|---|---|" + "---|" * len(there)]
    for row in chosen:
        cells = [f"{float(row['commands']) / 1e6:.0f} M", f"{float(row['seconds']) / 60:.1f} min"]
        lines.append("| " + " | ".join(cells + [f"{float(row[key]):.3g}" for key in there]) + " |")
    return lines


def _scores(name: str) -> list[str]:
    whole = json.loads((ROOT / "benchmarks" / "controllers.json").read_text())
    if name not in whole:
        return ["Not measured."]
    r = whole[name]
    sensors = {what: there["command_std"] for what, there in r["sensors"].items()}
    lines = [
        f"`scripts/measure_controllers.py`, {r['environment']['date']}; full results in docs/controllers.md.",
        "",
        f"- Hover on the nominal drone: {r['hover_mm']:.0f} mm, command std {r['command_std']:.3f}.",
        f"- Hover on {r['drones']} drones of the paper's randomisation: median {r['random_hover_mm']['0.5']:.0f} mm, "
        f"95 % within {r['random_hover_mm']['0.95']:.0f} mm; {r['random_failed']:.2%} failed.",
        f"- Flight over 6 m: {r['arrival_s']:.2f} s, peak speed {r['peak_speed_mps']:.1f} m/s, overshoot "
        f"{r['overshoot_m']:.2f} m.",
        f"- Thrown at 3 m/s with 60 deg of tilt: {r['random_recovered']:.1%} of the randomised drones and "
        f"{r['recovered']:.1%} of the nominal drones recover within 6 s.",
        "",
        "## Limits",
        "",
    ]
    lines += [
        f"- {what[0].upper() + what[1:]}: "
        + ("all failed." if std is None else f"command std {std:.3f}, the drone oscillates.")
        for what, std in sensors.items()
        if std is None or std > SWINGS
    ]
    worst, of = max(r["factors"].items(), key=lambda item: item[1]["most_third_mm"] - item[1]["least_third_mm"])
    lines.append(
        f"- Factor with the largest influence: {worst}. The median hover error is {of['least_third_mm']:.0f} mm for "
        "the third of the drones that deviate least from nominal in this factor, and "
        f"{of['most_third_mm']:.0f} mm for the third that deviates most."
    )
    errors = {plant: there["hover_mm"] or float("inf") for plant, there in r["plants"].items()}
    plant = max(errors, key=errors.get)
    lines.append(
        f"- Largest hover error on drones with effects outside the training: {errors[plant]:.0f} mm, `{plant}`."
    )
    return lines


def _tracking(name: str) -> list[str]:
    whole = json.loads((ROOT / "benchmarks" / "tracking.json").read_text())
    of = whole["controllers"][name]
    late = max(of["late"].items(), key=lambda item: item[1]["mean_mm"] or float("inf"))
    plant = max(of["plants"], key=lambda plant: of["plants"][plant]["mean_mm"] or float("inf"))
    wild = of["random"]["1 2.5"]
    return [
        f"`scripts/tracking.py`, {whole['environment']['date']}; full results in docs/tracking.md.",
        "",
        *(
            f"- Figure eight of 2 m by 1 m in {lap} s on the nominal drone: {of['eights'][lap]['mean_mm']:.1f} mm, at "
            f"most {of['eights'][lap]['largest_mm']:.0f} mm."
            for lap in ("4", "2")
        ),
        f"- The same in 2.5 s on {whole['drones']} drones of the paper's randomisation: median "
        f"{wild['median_mm']:.0f} mm; {wild['failed']:.1%} failed.",
        "",
        "## Limits",
        "",
        f"- {late[0][0].upper() + late[0][1:]}, 2 s: "
        + ("all failed." if late[1]["mean_mm"] is None else f"{late[1]['mean_mm']:.0f} mm."),
        f"- Largest error on drones with effects outside the training, 3 s: {of['plants'][plant]['mean_mm']:.0f} mm, "
        f"`{plant}`.",
        "- A path that asks for more thrust than the drone has is not followed: see `demand`.",
    ]


def _flips(name: str) -> list[str]:
    whole = json.loads((ROOT / "benchmarks" / "flips.json").read_text())
    if name != "flip":
        return ["Not measured. docs/flips.md has the scores of `flip`."]
    lines = [
        f"`scripts/flips.py`, {whole['environment']['date']}; full results in docs/flips.md.",
        "",
        "| flip | holder | height, nominal drone, m | completed, randomised drones | height of 95 % of these, m |",
        "|---|---|---|---|---|",
    ]
    for flip, of in whole["flips"].items():
        cells = [flip, of["holder"], f"{of['nominal']['vertical_extent_m']:.2f}", f"{of['completed_random']:.1%}"]
        lines.append("| " + " | ".join([*cells, f"{of['random_extent_m']['0.95']:.2f}"]) + " |")
    few = {flip: of["completed_random"] for flip, of in whole["flips"].items()}
    worst = min(few, key=few.get)
    return [*lines, "", "## Limits", "", f"- Only {few[worst]:.0%} of the randomised drones complete `{worst}`."]


if __name__ == "__main__":
    main()
