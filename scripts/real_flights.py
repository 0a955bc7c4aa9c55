"""Evaluate the shipped presets on real flights in the IDSIA layout, refit them, and write docs/real-flights.md.

    python scripts/real_flights.py FOLDER       (FOLDER holds fit/*.parquet and validation/*.parquet)

The presets are evaluated on all flights. The refit uses fit/ only and is evaluated on validation/. Only aggregate
errors are written; the flights do not become part of the project.
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
    """Evaluate the presets and write the page."""
    configure_jax(x64=True)
    paths = sorted(folder.glob("*/*.parquet"))
    if not paths:
        sys.exit(f"{folder}: has no fit/*.parquet or validation/*.parquet")
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

This page shows how well the published presets predict flights of a real drone, and what `cfb fit` changes. To evaluate
a preset on your own log:

```sh
cfb evaluate LOG --model cfb-guards --set mass=0.045
```

## The presets as published

The flights are the public IDSIA nano-drone system-identification benchmark (Busetto et al., "Nonlinear system
identification for a nano-drone benchmark", Control Engineering Practice 172, 2026): {len(logs)} raw 100 Hz logs of a
Crazyflie 2.1 Brushless with AI-deck and flow deck. Nothing was fitted: the presets are used as published, with the
drone's mass set to {MASS} kg. The table gives mean errors of open-loop predictions with 95 % intervals
([protocol](evaluation.md)).

**The published models predict these flights worse than `hold`**, which assumes constant velocity and constant body
rate: at 0.5 s, the attitude error is larger in every case. The models respond to the logged commands with far more
angular acceleration than the drone showed. It is another drone with other decks and other propellers, and it flew with
feedback and unmodelled disturbances. The next section refits the model.
[closing-real-flights.md](closing-real-flights.md) adds effects that the paper's model does not have.

| flights | windows | horizon, s | prediction | position, m | velocity, m/s | attitude, deg | body rate, rad/s |
|---|---:|---:|---|---|---|---|---|
{table}

{refit}

## Alignment

The importer estimates the lead of the motor columns over the gyro and shifts them by whole samples:

| flight | lead, and shift applied |
|---|---|
{shifts}
""",
    )
    print(PAGE)


def _refit(folder: Path) -> str:
    """Return the section on the refit on fit/, evaluated on validation/."""
    base = load_model_file("cfb-guards").with_values("weighed with its decks", mass=MASS)
    logs = [read_log(path) for path in sorted((folder / "fit").glob("*.parquet"))]
    judged = [read_log(path) for path in sorted((folder / "validation").glob("*.parquet"))]
    if not logs or not judged:
        return ""
    pooled = fit(logs, base.parameters())
    names = pooled.names
    single = {log.name: fit([log], base.parameters(), names) for log in logs}
    table = [f"| parameter | preset | all {len(logs)} fit flights | single flights: median, smallest, largest |"]
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
            f"The table compares one `cfb fit` on all {len(logs)} fit flights ({pooled.rows} rows) with fits to single",
            "flights: innovation estimator, body driven by measured rotor speeds, mass weighed, torque curve as",
            "published.",
            "",
            *table,
            "",
            "The two thrust numbers act together: they lower the thrust at hover and make the curve steeper, closer to",
            "the square law that other groups measured. Estimates from single flights differ by more than their",
            "standard deviations, because the model leaves out effects that differ from flight to flight.",
            "",
            "Errors on the validation flights before and after the refit:",
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
