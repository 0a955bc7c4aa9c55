"""Time the first steps of a new user in a fresh clone and a fresh virtual environment.

python scripts/newcomers_path.py     docs/newcomers-path.md and benchmarks/newcomers-path.json (two minutes)

The steps lead from Python and pip to a policy that is trained, flown, viewed and exported to C.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import textwrap
import time
from pathlib import Path

from campaign import ROOT, facts_line
from marked_block import write_block

from cfb_mjx.files import write_json, write_text
from cfb_mjx.runtime import environment

NUMBERS, PAGE = ROOT / "benchmarks" / "newcomers-path.json", ROOT / "docs" / "newcomers-path.md"
STEPS = (
    ("install", "{python} -m venv .venv && .venv/bin/pip install -q -c constraints.txt ."),
    ("look at what is there", ".venv/bin/cfb demo -o out/demo"),
    ("train a policy", ".venv/bin/cfb train target --config quick-analytic -o out/mine"),
    (
        "fly it",
        ".venv/bin/cfb fly out/mine/policy.npz --json out/fly.json --log out/flight.mcap --figure out/flight.png",
    ),
    ("look at its flight", ".venv/bin/cfb view out/flight.mcap -o out/flight.rrd"),
    ("export it", ".venv/bin/cfb export out/mine/policy.npz -o out/c --check"),
)

WEIGHED = """
import json
from importlib.metadata import distributions
sizes = {d.metadata["Name"]: sum(p.stat().st_size for f in d.files or [] if (p := f.locate()).is_file())
         for d in distributions()}
print(json.dumps(sizes))
"""
WHY = {
    "rerun-sdk": "`cfb view`, with the viewer itself",
    "jaxlib": "compiles and runs everything",
    "pyarrow": "tables of flights; rerun needs it",
    "scipy": "statistics, filters",
    "tensorstore": "Brax needs it",
    "numpy": "arrays",
}
"""What the largest packages are for."""


def weight(place: Path) -> dict[str, float]:
    """Size of every installed package, MB, the largest first."""
    printed = subprocess.run(
        [str(place / ".venv/bin/python"), "-c", WEIGHED], check=True, capture_output=True, text=True
    )
    sizes = {name: size / 2**20 for name, size in json.loads(printed.stdout).items()}
    return dict(sorted(sizes.items(), key=lambda item: -item[1]))


def weighed(sizes: dict[str, float]) -> str:
    """What an installation weighs, in a sentence."""
    most = [f"{name} {size:.0f} ({WHY.get(name, 'needed by others')})" for name, size in list(sizes.items())[:6]]
    return (
        f"An installation takes {sum(sizes.values()) / 1024:.1f} GB in {len(sizes)} packages, of which in MB: "
        f"{', '.join(most)}."
    )


def walk(python: str) -> dict:
    """Run the steps; return the seconds of each, and the scores of the policy."""
    with tempfile.TemporaryDirectory(prefix="newcomer-") as folder:
        place = Path(folder) / "cfb_mjx"
        subprocess.run(["git", "clone", "-q", str(ROOT), str(place)], check=True)
        # An empty home, so that neither pip's cache nor compiled programs shorten the times.
        fresh = os.environ | {"HOME": folder, "XDG_CACHE_HOME": str(Path(folder) / "cache")}
        taken, sizes = [], {}
        for what, command in STEPS:
            print(f"$ {command}", flush=True)
            began = time.perf_counter()
            subprocess.run(command.format(python=python), shell=True, check=True, cwd=place, env=fresh)
            shown = command.format(python="python3")
            taken.append({"step": what, "command": shown, "seconds": time.perf_counter() - began})
            sizes = weight(place) if what == "install" else sizes
        hover = json.loads((place / "out" / "fly.json").read_text())
        check = json.loads((place / "out" / "c" / "check.json").read_text())
    return {"steps": taken, "hover": hover, "check": check, "sizes": sizes, "environment": environment()}


def page(found: dict) -> str:
    """Write the text of docs/newcomers-path.md."""
    rows, total = [], 0.0
    for step in found["steps"]:
        total += step["seconds"]
        rows.append(f"| {step['step']} | `{step['command']}` | {step['seconds']:.0f} | {total / 60:.1f} |")
    table, hover, check = "\n".join(rows), found["hover"], found["check"]
    return f"""# A newcomer's path, timed

This page shows new users how long the first steps take, from an empty environment to a policy in C. Every command can
be copied from the table.

{facts_line("python scripts/newcomers_path.py", [found], "measured")}

The steps ran in a fresh clone and a fresh virtual environment with empty caches: packages are downloaded, and every
program is compiled.

| step | command | s | total, min |
|---|---|---|---|
{table}

{weighed(found["sizes"])}

The trained policy hovers {hover["mean_distance_mm"]:.1f} mm from its target on average, with a standard deviation of
its commands of {hover["command_std"]:.4f}. The commands of the C and of JAX differ by at most
{check["parity"]["largest"]:.1e}. The policy was trained on the nominal drone only. For a real drone use a shipped
policy, or `cfb train target --config target-analytic`, which draws a new drone for every flight
([training](training.md)).
"""


def main() -> None:
    """Time the steps and write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--python", default=sys.executable)
    parser.add_argument("--page-only", action="store_true")
    arguments = parser.parse_args()
    if not arguments.page_only:
        write_json(NUMBERS, walk(arguments.python))
    found = json.loads(NUMBERS.read_text())
    write_text(PAGE, page(found))
    write_block(ROOT / "README.md", "weight", textwrap.fill(weighed(found["sizes"]), 120, break_long_words=False))
    print(PAGE.relative_to(ROOT))


if __name__ == "__main__":
    main()
