"""The loop closed all the way, for many drones: fly, diagnose, retrain, fly again (cfb demo-loop).

    python scripts/demo_loop.py [--effects payload wind ...] [--seeds 3] [--page-only]

A few minutes for each of effects x seeds; what is done is kept in out/demo-loop, and a run begun anew goes on. Writes
benchmarks/closed-loop.json, which grows drone by drone, docs/closed-loop.md and docs/closed-loop.png.
"""

import argparse
import json
from pathlib import Path

from campaign import ROOT, facts_line

EFFECTS = (
    "payload",
    "cog_offset",
    "motor_gain_mismatch",
    "wind",
    "thrust_tilt",
    "thrust_scale",
    "battery_sag",
    "rotor_drag",
)
"""Chosen before any corrected policy had flown: what should push a drone away from its target, a battery whose voltage
no policy sees, and a drag that hovering should hardly notice."""
RESULTS = ROOT / "benchmarks" / "closed-loop.json"
FIGURE = ROOT / "docs" / "closed-loop.png"


def main() -> None:
    """Fly what is missing, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--effects", nargs="+", default=list(EFFECTS))
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--seed", type=int, default=61_000)
    parser.add_argument("--folder", type=Path, default=ROOT / "out" / "demo-loop")
    parser.add_argument("--page-only", action="store_true", help="write the page from the results that are there")
    arguments = parser.parse_args()
    from cfb_mjx.files import write_json, write_text
    from cfb_mjx.loop.cells import cells_of
    from cfb_mjx.runtime import configure_jax
    from cfb_mjx.view.closed_loop import loop_figure

    cells = cells_of(arguments.effects, arguments.seeds, arguments.seed)
    if not arguments.page_only:
        configure_jax(x64=False)
        from cfb_mjx.loop.study import study

        for results in study(cells, arguments.folder):
            write_json(RESULTS, results)
    results = json.loads(RESULTS.read_text())
    loop_figure(results, FIGURE)
    write_text(ROOT / "docs" / "closed-loop.md", page(results, len(cells)))
    print(f"{RESULTS}\n{FIGURE}\n{ROOT / 'docs' / 'closed-loop.md'}")


def page(results: dict, planned: int) -> str:
    """The Markdown page."""
    from cfb_mjx.view.closed_loop import TITLE, lead, sections

    done = list(results["cells"].values())
    lines = [
        f"# {TITLE}",
        "",
        facts_line("python scripts/demo_loop.py", [cell["trials"] for cell in done]),
        "",
        lead(results),
    ]
    if len(done) < planned:
        lines += ["", f"{len(done)} of {planned} drones have been flown so far; the command goes on with the rest."]
    for section in sections(results, FIGURE):
        lines += ["", f"## {section.title}"]
        for paragraph in section.paragraphs:
            lines += ["", paragraph]
        for caption, header, rows in section.tables:
            lines += ["", caption] if caption else []
            lines += ["", "| " + " | ".join(header) + " |", "|---" * len(header) + "|"]
            lines += ["| " + " | ".join(row) + " |" for row in rows]
        for path, alternative in section.figures:
            lines += ["", f"![{alternative}]({path.name})"]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
