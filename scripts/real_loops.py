"""Run `cfb close-loop` with default settings on real drones, one after the other; write docs/real-loops.md.

    python scripts/real_loops.py NAME=FOLDER,MODEL,MASS_KG ... [--work out/real-loops]

FOLDER holds fit/ and validation/. MODEL is a preset, a model file, or the NAME of an earlier drone, whose corrected
model is then the start. Nothing is fitted to validation/. Results that are already in the work folder are not computed
again. Only aggregate numbers are written; the flights do not become part of the project.
"""

import argparse
import json
import math
import resource
import subprocess
import sys
from pathlib import Path

from cfb_mjx.files import write_text
from cfb_mjx.runtime import environment

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "real-loops.md"
HORIZONS = ("0.05", "0.1", "0.2", "0.5")
VARIANTS = {
    "hold": "hold",
    "commands_in": "commands in",
    "rotor_speed_in": "rotor speeds in",
    "commands_in_observer": "commands in, observer",
    "rotor_speed_in_observer": "rotor speeds in, observer",
}
INTRODUCTION = """
This page shows what `cfb close-loop` finds on recordings of real drones with default settings: no effect, weight or
setting was chosen by hand. Read it to see what a report says, and how large the errors of a corrected model are.

Each section is one drone: the command, the first paragraph of the report, the effects sorted by what each buys, and the
errors of the corrected model on held-out flights. A drone called *captured* has the same flights, imported with
`--motion-capture` ([logs](logs.md)): pose and velocity are not those of the on-board estimator.

The columns of the tables of effects:

- *from accelerations*: the same numbers from one-step innovations, which are not biased by the controller's responses
  to disturbances. Bold numbers contradict those from predictions: such a number stands in for something else.
- *buys*: share by which the effect lowers the mean prediction error of the fit flights (attitude and velocity, 0.1 to
  0.5 s ahead, relative to the error of `hold`). In the comparison the other effects are adjusted to compensate for it.
- *t*: improvement of the predictions of the held-out flights by the effect, in standard deviations. A motor effect that
  measured rotor speeds show is kept unless *t* clearly contradicts it.
- *at a bound*: numbers at the edge of their plausible range.
"""


def cfb(*arguments: str) -> None:
    """Run a ``cfb`` command."""
    subprocess.run([Path(sys.executable).with_name("cfb"), *arguments], check=True)


def close(name: str, folder: Path, model: str, mass: str, work: Path) -> tuple[list[str], float | None]:
    """Correct the model of a drone unless that is done; return its fit flights and the processor time in s."""
    sides = {side: sorted(str(path) for path in (folder / side).iterdir()) for side in ("fit", "validation")}
    own = work / name
    arguments = ["--model", model, "--set", f"mass={mass}", "-o", str(own)]
    if not (own / "report.json").exists():
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        cfb("close-loop", "--fit", *sides["fit"], "--held-out", *sides["validation"], *arguments)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        used = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
        write_text(own / "seconds.txt", f"{used:.0f}\n")
    cfb("evaluate", *sides["validation"], "--model", f"{own}/model.yaml", "--observer", "--json", f"{own}/errors.json")
    seconds = own / "seconds.txt"
    return sides["fit"], float(seconds.read_text()) if seconds.exists() else None


def values(effect: dict) -> str:
    """Format the numbers of an effect with their standard deviations."""
    found = []
    for key, value in effect["parameters"].items():
        std = effect["uncertainty"].get(key)
        several = isinstance(value, list)
        pairs = zip(value, std, strict=True) if several else [(value, std)]
        found.append(f"{key} " + ", ".join(f"{v:.4g}" if s is None else f"{v:.4g} ± {s:.1g}" for v, s in pairs))
    return "; ".join(found)


def asked(effect: dict) -> str:
    """Format the numbers from innovations; bold where they contradict those from predictions."""
    found = []
    for name, each in effect.get("innovations", {}).items():
        text = f"{name.split('.', 1)[1]} {each['value']:.3g} ± {each['std']:.1g}"
        found.append(f"**{text}**" if each["contradicts"] else text)
    return "; ".join(found)


def section(name: str, folder: Path, model: str, mass: str, work: Path, before: dict[str, Path]) -> str:
    """Return the section of one drone."""
    start = str(before[model] / "model.yaml") if model in before else model
    fit, seconds = close(name, folder, start, mass, work)
    own = work / name
    report, errors = (json.loads((own / file).read_text()) for file in ("report.json", "errors.json"))
    shown = f"{model}/model.yaml" if model in before else model
    lines = [f"## {name}", "", "```sh"]
    lines += [
        f"cfb close-loop --fit fit/* --held-out validation/* --model {shown} --set mass={mass} -o {name}",
        "```",
        "",
    ]
    cost = "" if seconds is None else f" {seconds / 60:.1f} minutes of processor time."
    lines += [f"{len(fit)} fit flights, {len(errors['logs'])} held-out flights.{cost}", ""]
    lines += [
        f"> {report['summary']}",
        "",
        "| effect | numbers | from accelerations | buys | t | at a bound |",
        "|---|---|---|---:|---:|---|",
    ]
    for effect in report["effects"]:
        bound = ", ".join(effect.get("at_bound", []))
        buys = f"{100 * effect['buys']:.0f} %" if "buys" in effect else ""
        t = f"{effect['held_out_t']:.1f}" if "held_out_t" in effect else ""
        lines.append(f"| {effect['name']} | {values(effect)} | {asked(effect)} | {buys} | {t} | {bound} |")
    gone = ", ".join(effect["name"] for effect in report["unconfirmed"])
    lines += ["", f"Fitted, but not confirmed by the held-out flights: {gone}." if gone else ""]
    formula = report["formula"] or []
    lines += ["", "Formula terms: " + ("; ".join(formula) if formula else "none") + ".", ""]
    head = " | ".join(f"{1e3 * float(h):.0f} ms" for h in HORIZONS)
    lines += [f"| mean attitude error, rad / velocity error, m/s | {head} |", "|---|" + "---|" * len(HORIZONS)]
    for key, words in VARIANTS.items():
        found = errors[key]
        cells = [
            f"{math.radians(found[f'attitude_mean_deg@{h}s']):.3f} / {found[f'velocity_mean_mps@{h}s']:.3f}"
            for h in HORIZONS
        ]
        lines.append(f"| {words} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def main() -> None:
    """Correct the models of all drones and write the page."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("drones", nargs="+", metavar="NAME=FOLDER,MODEL,MASS_KG")
    parser.add_argument("--work", type=Path, default=ROOT / "out" / "real-loops")
    options = parser.parse_args()
    sections, before = [], {}
    for drone in options.drones:
        name, _, rest = drone.partition("=")
        folder, model, mass = rest.split(",")
        sections.append(section(name, Path(folder), model, mass, options.work, before))
        before[name] = options.work / name
    facts = ", ".join(f"{name} {value}" for name, value in environment().items())
    by = f"Written by `python scripts/real_loops.py`; do not edit. {facts}"
    head = "# Model correction on real drones with default settings"
    write_text(PAGE, "\n".join([head, "", by, "", INTRODUCTION.strip(), "", "\n\n".join(sections), ""]))


if __name__ == "__main__":
    main()
