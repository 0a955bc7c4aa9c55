"""Evaluate the shipped presets on real flights in the IDSIA layout and write docs/real-flights.md.

    python scripts/real_flights.py FOLDER       (FOLDER holds fit/*.parquet and validation/*.parquet)

Only aggregate errors are written; the flights themselves never enter the project.
"""

import sys
from pathlib import Path

from cfb_mjx.cli.runtime import configure_jax, environment
from cfb_mjx.files import write_text
from cfb_mjx.logs import read_log
from cfb_mjx.model import Quadrotor
from cfb_mjx.parameters import load_model_file
from cfb_mjx.sysid import evaluate

PAGE = Path(__file__).resolve().parents[1] / "docs" / "real-flights.md"
GROUPS = {"gentle (random1, random2, multisine)": ("random", "multisine"), "square": ("square",)}
MASS = 0.045
KEYS = ("position_mean_m", "velocity_mean_mps", "attitude_mean_deg", "rate_mean_radps")


def main(folder: Path) -> None:
    """Evaluate and write the page."""
    configure_jax(x64=True)
    paths = sorted(folder.glob("*/*.parquet"))
    if not paths:
        sys.exit(f"{folder}: holds no fit/*.parquet or validation/*.parquet")
    logs = [read_log(path) for path in paths]
    lines = []
    for group, prefixes in GROUPS.items():
        chosen = [log for log in logs if log.name.startswith(prefixes)]
        for preset in ("cfb-guards", "cfb", "cf21b-500"):
            described = load_model_file(preset).with_values("weighed with its decks", mass=MASS)
            evaluation = evaluate(Quadrotor.from_file(described), chosen)
            windows = sum(len(log.windows) for log in evaluation.logs)
            for variant in ("commands_in", "rotor_speed_in") + (("hold",) if preset == "cfb-guards" else ()):
                found, spread = evaluation.metrics(variant), evaluation.intervals(variant)
                name = "hold (no physics)" if variant == "hold" else f"{preset}, {variant.replace('_', ' ')}"
                for horizon in ("0.2", "0.5"):
                    cells = []
                    for key in KEYS:
                        low, high = spread[f"{key}@{horizon}s"]
                        cells.append(f"{found[f'{key}@{horizon}s']:.3g} [{low:.3g}, {high:.3g}]")
                    lines.append(f"| {group} | {windows} | {horizon} | {name} | " + " | ".join(cells) + " |")
    shifts = "\n".join(f"| {log.name} | {_shift(log)} |" for log in logs)
    facts = ", ".join(f"{name} {value}" for name, value in environment().items())
    table = "\n".join(lines)
    write_text(
        PAGE,
        f"""# Real flights

Written by `python scripts/real_flights.py FOLDER`; do not edit. {facts}

Flights: the public IDSIA nano-drone system-identification benchmark (Busetto et al., "Nonlinear system identification
for a nano-drone benchmark", Control Engineering Practice 172, 2026), {len(logs)} raw 100 Hz logs of a Crazyflie 2.1
Brushless with AI-deck and flow deck. Nothing was fitted: these are the presets as published, with the drone's mass set
to {MASS} kg. Mean errors of open-loop predictions with 95 % intervals; protocol in [evaluation.md](evaluation.md).

**The published models predict these flights worse than `hold`**, which assumes constant velocity and constant body
rate, everywhere at 0.5 s in attitude. They respond to the logged commands with far more angular acceleration than the
drone showed: another drone, other decks, other propellers, feedback flights with unmodelled disturbances. What is
missing is the subject of identification, not of this page.

| flights | windows | horizon, s | prediction | position, m | velocity, m/s | attitude, deg | body rate, rad/s |
|---|---:|---:|---|---|---|---|---|
{table}

Estimated lead of the motor columns over the gyro, as found and as applied on import (whole samples):

| flight | shift |
|---|---|
{shifts}
""",
    )
    print(PAGE)


def _shift(log) -> str:
    found = log.metadata["alignment"]
    return f"{found['shift_ms']:.1f} +- {found['shift_std_ms']:.1f} ms, applied {found['applied_ms']:.0f} ms"


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    main(Path(sys.argv[1]))
