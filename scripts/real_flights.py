"""Evaluate the shipped presets on real flights in the IDSIA layout, refit them, and write docs/real-flights.md.

    python scripts/real_flights.py FOLDER       (FOLDER holds fit/*.parquet and validation/*.parquet)

Presets are judged on all flights; the refit uses fit/ only and is judged on validation/.
Only aggregate errors are written; the flights themselves never enter the project.
"""

import sys
from pathlib import Path

import numpy as np

from cfb_mjx.files import write_text
from cfb_mjx.logs import read_log
from cfb_mjx.model import Quadrotor
from cfb_mjx.parameters import load_model_file
from cfb_mjx.runtime import configure_jax, environment
from cfb_mjx.sysid import evaluate
from cfb_mjx.sysid.identification.fitting import fit

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
    refit = _refit(folder)
    shifts = "\n".join(f"| {log.name} | {_shift(log)} |" for log in logs)
    facts = ", ".join(f"{name} {value}" for name, value in environment().items())
    table = "\n".join(lines)
    write_text(
        PAGE,
        f"""# Real flights

Written by `python scripts/real_flights.py FOLDER`; do not edit. {facts}

## The presets as published

Flights: the public IDSIA nano-drone system-identification benchmark (Busetto et al., "Nonlinear system identification
for a nano-drone benchmark", Control Engineering Practice 172, 2026), {len(logs)} raw 100 Hz logs of a Crazyflie 2.1
Brushless with AI-deck and flow deck. Nothing was fitted: these are the presets as published, with the drone's mass set
to {MASS} kg. Mean errors of open-loop predictions with 95 % intervals; protocol in [evaluation.md](evaluation.md).

**The published models predict these flights worse than `hold`**, which assumes constant velocity and constant body
rate, everywhere at 0.5 s in attitude. They respond to the logged commands with far more angular acceleration than the
drone showed: another drone, other decks, other propellers, feedback flights with unmodelled disturbances. What is
missing is the subject of the next section, and of effects the paper's model does not have.

| flights | windows | horizon, s | prediction | position, m | velocity, m/s | attitude, deg | body rate, rad/s |
|---|---:|---:|---|---|---|---|---|
{table}

{refit}

## Alignment

Estimated lead of the motor columns over the gyro, as found and as applied on import (whole samples):

| flight | shift |
|---|---|
{shifts}
""",
    )
    print(PAGE)


def _refit(folder: Path) -> str:
    """The refit on fit/, judged on validation/, as Markdown."""
    base = load_model_file("cfb-guards").with_values("weighed with its decks", mass=MASS)
    logs = [read_log(path) for path in sorted((folder / "fit").glob("*.parquet"))]
    judged = [read_log(path) for path in sorted((folder / "validation").glob("*.parquet"))]
    if not logs or not judged:
        return ""
    pooled = fit(logs, base.parameters())
    names = pooled.names
    single = {log.name: fit([log], base.parameters(), names) for log in logs}
    table = [f"| parameter | preset | all {len(logs)} fit flights | single flights: median, least, most |"]
    table.append("|---|---:|---:|---|")
    for name in names:
        if name not in pooled.estimates:
            table.append(f"| {name} | | {pooled.unidentifiable[name]} | |")
            continue
        e = pooled.estimates[name]
        found = [one.estimates[name].value for one in single.values() if name in one.estimates]
        spread = f"{np.median(found):.3g}, {min(found):.3g}, {max(found):.3g}"
        table.append(f"| {name}, {e.unit} | {e.preset:.3g} | {e.value:.3g} +- {e.std:.2g} | {spread} |")
    corrected = pooled.model_file(base, "refit")
    return "\n".join(
        [
            "## Refitted",
            "",
            f"`cfb fit` on the {len(logs)} fit flights ({pooled.rows} rows) together, innovation estimator, measured",
            "rotor speeds driving the body; mass weighed, torque curve as published.",
            "",
            *table,
            "",
            "The two thrust numbers belong together: they lower the thrust at hover and steepen the curve, towards the",
            "square law other groups measured. What single flights say differs by more than their standard deviations:",
            "the model leaves out effects that differ from flight to flight.",
            "",
            _held_out(base, corrected, judged),
        ]
    )


def _held_out(base, corrected, judged) -> str:
    lines = ["| validation flights, rms | horizon, s | prediction | velocity, m/s | attitude, deg | body rate, rad/s |"]
    lines.append("|---|---:|---|---:|---:|---:|")
    keys = ("velocity_rmse_mps", "attitude_rmse_deg", "rate_rmse_radps")
    for group, prefixes in GROUPS.items():
        chosen = [log for log in judged if log.name.startswith(prefixes)]
        before, after = (evaluate(Quadrotor.from_file(model), chosen) for model in (base, corrected))
        rows = [("hold", before, "hold")]
        for variant, label in (("commands_in", "commands in"), ("rotor_speed_in", "rotor speed in")):
            rows += [(f"before, {label}", before, variant), (f"after, {label}", after, variant)]
        for horizon in ("0.2", "0.5"):
            for name, evaluation, variant in rows:
                found = evaluation.metrics(variant)
                cells = " | ".join(f"{found[f'{key}@{horizon}s']:.3g}" for key in keys)
                lines.append(f"| {group} | {horizon} | {name} | {cells} |")
    return "\n".join(lines)


def _shift(log) -> str:
    found = log.metadata["alignment"]
    return f"{found['shift_ms']:.1f} +- {found['shift_std_ms']:.1f} ms, applied {found['applied_ms']:.0f} ms"


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    main(Path(sys.argv[1]))
