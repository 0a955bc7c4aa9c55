"""Measure how often the intervals of `cfb fit` cover the truth, and write docs/coverage.md.

    python scripts/coverage.py [--drones 20] [--only hover] [--generator ../shared/cases/fit/make_fit_logs.py]

The flights come from a simulator that shares no code with this library: a program ``GENERATOR OUT --drones N --seed S
--seconds T --rates HZ... [--omega] [--hover] [--wrong-mass SHARE]`` that writes logs and ``truth.json`` (per drone:
files, stated_mass, mass, inertia, motor_time_constant, motor_gain, rotor_inertia, thrust_scale, torque_scale, cog).
Without it the script exits. Every fit is stored in benchmarks/coverage.json, and a later run continues from there;
``--anew`` starts again.
"""

import argparse
import dataclasses
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from campaign import measured_on

from cfb_mjx.files import write_json, write_text
from cfb_mjx.runtime import configure_jax, environment

ROOT = Path(__file__).resolve().parents[1]
GENERATOR = ROOT.parent / "shared" / "cases" / "fit" / "make_fit_logs.py"
RESULTS, PAGE = ROOT / "benchmarks" / "coverage.json", ROOT / "docs" / "coverage.md"
SCALE = 0.002
"""Relative standard deviation of the random error of the mass given to a fit; the fit is told this value too."""


@dataclasses.dataclass(frozen=True)
class Condition:
    """Settings of the flights and fits of one section of the page."""

    what: str
    seconds: float
    hz: int
    flags: tuple[str, ...] = ()
    irregular: bool = False
    mass_std: float | None = SCALE
    """Relative standard deviation of the mass given to the fit; None leaves the default of the fit."""


CONDITIONS = {
    "250": Condition("250 Hz, 30 s", 30, 250),
    "500": Condition("500 Hz (every command logged), 14 s", 14, 500),
    "100": Condition("100 Hz, 60 s", 60, 100),
    "irregular": Condition("irregular rows: 2, 4 or 6 ms apart at random, 28 s", 28, 500, irregular=True),
    "short": Condition("250 Hz, 3 s", 3, 250),
    "omega": Condition("250 Hz, rotor speeds measured, 30 s", 30, 250, ("--omega",)),
    "omega100": Condition("100 Hz, rotor speeds measured, 60 s", 60, 100, ("--omega",)),
    "hover": Condition("250 Hz, hover only, 30 s", 30, 250, ("--hover",)),
    "hover-omega": Condition("250 Hz, hover only, rotor speeds measured, 30 s", 30, 250, ("--hover", "--omega")),
    "mass": Condition(
        "250 Hz, mass stated 8 % too small, its std left at the default 5 %, 30 s",
        30,
        250,
        ("--wrong-mass", "0.08"),
        mass_std=None,
    ),
}


def truths(drone: dict) -> dict[str, float]:
    """Return the true constants of a drone of ``truth.json``, under the names that a fit uses."""
    axes = dict(zip(("inertia_xx", "inertia_yy", "inertia_zz"), drone["inertia"], strict=True))
    same = ("mass", "motor_time_constant", "motor_gain", "rotor_inertia", "thrust_scale", "torque_scale")
    trim = {"cog_x": drone["cog"][0], "cog_y": drone["cog"][1]}
    # The curves are the paper's, scaled; the loop runs at 500 Hz.
    rest = {"motor_speed_offset": 0.0, "thrust_linear": -0.043, "command_hold": 0.002}
    return axes | trim | rest | {name: drone[name] for name in same}


def product(text: str, truth: dict[str, float]) -> float:
    """Evaluate a product such as ``inertia_xx / mass`` with the true constants."""
    value, sign = 1.0, 1.0
    for word in text.split():
        if word in ("*", "/"):
            sign = 1.0 if word == "*" else -1.0
        elif word != "1":
            name, _, power = word.partition("^")
            value *= truth[name] ** (sign * float(power or 1))
    return value


def one(log, drone: dict, condition: Condition, rng) -> dict:
    """Fit one log; return value, std and truth of every reported quantity."""
    from cfb_mjx.parameters import load_model_file
    from cfb_mjx.sysid.identification.fitting import fit

    if condition.irregular:
        keep = np.cumsum(rng.integers(1, 4, len(log.time)))
        keep = keep[keep < len(log.time)]
        log = dataclasses.replace(log, **{f: getattr(log, f)[keep] for f in ROWS if getattr(log, f) is not None})
    error = 1.0 if condition.mass_std is None else 1 + condition.mass_std * rng.normal()
    mass = drone["stated_mass"] * error
    nominal = load_model_file("cfb-guards").with_values("weighed", mass=mass).parameters()
    start = time.perf_counter()
    found = fit([log], nominal, mass_std=None if condition.mass_std is None else condition.mass_std * mass)
    truth = truths(drone)
    reported = {n: [e.value, e.std, truth[n]] for n, e in found.estimates.items()}
    together = {n: [e.value, e.std, product(n, truth)] for n, e in found.combinations.items()}
    return {
        "reported": reported,
        "together": together,
        "untold": list(found.unidentifiable),
        "freed": list(found.contradicted),
        "hold": found.hold,
        "seconds": time.perf_counter() - start,
    }


ROWS = (
    "time",
    "position",
    "velocity",
    "quaternion",
    "body_rate",
    "specific_force",
    "command",
    "rotor_speed",
    "battery_voltage",
)


def fly(generator: Path, folder: Path, condition: Condition, drones: int, seed: int) -> dict:
    """Generate the logs of one condition; return the contents of ``truth.json``."""
    size = ["--drones", drones, "--seed", seed, "--seconds", condition.seconds, "--rates", condition.hz]
    subprocess.run([sys.executable, generator, folder, *map(str, size), *condition.flags], check=True)
    return json.loads((folder / "truth.json").read_text())


def rows_of(fits: list[dict]) -> dict[str, dict]:
    """Return per quantity the number of fits that report it, the number of covering intervals, and the errors."""
    rows = {}
    names = list(dict.fromkeys(n for f in fits for n in (*f["reported"], *f["untold"], *f["together"])))
    for name in names:
        told = np.array([{**f["reported"], **f["together"]}.get(name, [np.nan] * 3) for f in fits])
        told = told[np.isfinite(told[:, 0])]
        z = (told[:, 0] - told[:, 2]) / told[:, 1]
        size = np.where(name.startswith("cog"), 1e-3, np.abs(told[:, 2]))
        rows[name] = {
            "fits": len(z),
            "untold": sum(name in f["untold"] for f in fits),
            "covered": int(np.sum(np.abs(z) < 1.96)),
            "z_mean": float(z.mean()) if len(z) else None,
            "z_std": float(z.std()) if len(z) else None,
            "error": float(np.median(np.abs(told[:, 0] - told[:, 2]) / size)) if len(z) else None,
            "std": float(np.median(told[:, 1] / size)) if len(z) else None,
        }
    return rows


def page(results: dict, environments: dict, options: argparse.Namespace) -> str:
    """Return the page as Markdown, from the fits of each condition and where they were computed."""
    facts = measured_on(environments)
    parts, every = [], []
    for key, condition in CONDITIONS.items():
        fits = list(results.get(key, {}).values())
        if not fits:
            parts.append(f"## {condition.what}\n\nNot run yet.")
            continue
        every += fits
        holds = [1 / condition.hz if f["hold"] is None else f["hold"] for f in fits]
        in_time = sum(f["hold"] is None for f in fits)
        lines = [
            f"## {condition.what}",
            "",
            f"{len(fits)} drones. Estimated time that a logged command acts (true value 2 ms): median "
            f"{1e3 * np.median(holds):.2f} ms; {in_time} fits let it act until the next row.",
            "",
            "| quantity | identified | not identified | covered | mean z | std z | median error | stated std |",
            "|---|---:|---:|---:|---:|---:|---:|---:|",
        ]
        lines += [_line(name, row) for name, row in rows_of(fits).items()]
        parts.append("\n".join(lines))
    total = {name: row for name, row in rows_of(every).items() if row["fits"] >= 10}
    summary = [
        "| quantity | identified | not identified | covered | mean z | std z |",
        "|---|---:|---:|---:|---:|---:|",
    ]
    for name, row in total.items():
        summary.append(
            f"| {name} | {row['fits']} | {row['untold']} | {row['covered'] / row['fits']:.1%} "
            f"| {row['z_mean']:+.2f} | {row['z_std']:.2f} |"
        )
    return f"""# Coverage of the intervals of `cfb fit`

Written by `python scripts/coverage.py --drones {options.drones} --seed {options.seed}`; do not edit. {facts}

This page says how far you can trust the standard deviations of `cfb fit`: it compares the 95 % intervals of many fits
with the true constants of simulated drones. Each fit is one command from the preset, with default options:

```sh
cfb fit flight.mcap --set mass=0.0385 --mass-std 0.0002 -o model.yaml
```

The logs come from a simulator and a controller that share nothing with this library (NumPy, RK4 at 2 ms, a PD
controller at 500 Hz, gyro noise 0.02 rad/s, accelerometer noise 0.15 m/s^2, pose 8 ms late). The constants of each
drone are drawn at random: mass -10 to +15 %, inertia and motor lag +-20 %, gain +-7 %, J_m -40 to +50 %, thrust -16 to
+10 % and torque +-30 % of the paper's curves, centre of gravity +-3 mm. The mass given to the fit has a random error
with a standard deviation of {SCALE:.1%}, which the fit knows, except where a section says otherwise.

| column | meaning |
|---|---|
| identified | fits that give a number for the quantity |
| not identified | fits that report it as not identifiable; they report products such as `inertia_xx / mass` instead |
| covered | 95 % intervals that contain the true value |
| mean z, std z | mean and standard deviation of z, the error over the fit's own standard deviation |
| median error, stated std | medians of the error and of the fit's standard deviation |

If the intervals are correct, 17 to 20 of 20 contain the true value in 99 % of such tables; of {len(every)} intervals,
{_binomial(max(len(every), 1))}.

## All {len(every)} fits

{chr(10).join(summary)}

{(chr(10) * 2).join(parts)}
"""


def _line(name: str, row: dict) -> str:
    if not row["fits"]:
        return f"| {name} | 0 | {row['untold']} | | | | | |"
    unit, scale = ("mm", 1.0) if name.startswith("cog") else ("%", 100.0)
    return (
        f"| {name} | {row['fits']} | {row['untold']} | {row['covered']} of {row['fits']} | {row['z_mean']:+.2f} "
        f"| {row['z_std']:.2f} | {row['error'] * scale:.2g} {unit} | {row['std'] * scale:.2g} {unit} |"
    )


def _binomial(count: int) -> str:
    draws = np.random.default_rng(0).binomial(count, 0.95, 100_000) / count
    return f"{np.quantile(draws, 0.005):.1%} to {np.quantile(draws, 0.995):.1%}"


def main() -> None:
    """Run the missing fits and write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--drones", type=int, default=20, help="number of drones per condition")
    parser.add_argument("--only", nargs="+", choices=list(CONDITIONS), default=list(CONDITIONS))
    parser.add_argument("--generator", type=Path, default=GENERATOR)
    parser.add_argument(
        "--seed", type=int, default=9000, help="seed of the first condition; the next ones count up from it"
    )
    parser.add_argument("--anew", action="store_true", help="discard the fits of earlier runs")
    options = parser.parse_args()
    if not options.generator.is_file():
        raise SystemExit(
            f"{options.generator}: no such file; give the generator of the logs with --generator. Nothing was done."
        )
    configure_jax(x64=True)
    from cfb_mjx.logs import read_log

    kept = json.loads(RESULTS.read_text()) if RESULTS.is_file() and not options.anew else {}
    results, environments = kept.get("conditions", {}), kept.get("environments", {})
    for index, (key, condition) in enumerate(CONDITIONS.items()):
        done = results.setdefault(key, {})
        if key not in options.only or len(done) >= options.drones:
            continue
        with tempfile.TemporaryDirectory() as folder:
            truth = fly(options.generator, Path(folder), condition, options.drones, options.seed + index)
            for number, (drone, facts) in enumerate(truth.items()):
                if drone in done:
                    continue
                rng = np.random.default_rng([options.seed + index, number])
                environments[key] = environment()
                done[drone] = one(read_log(Path(folder) / facts["files"][0]), facts, condition, rng)
                # Write after every fit, so that an interruption loses one fit only.
                write_json(
                    RESULTS,
                    {
                        "drones": options.drones,
                        "seed": options.seed,
                        "conditions": results,
                        "environments": environments,
                    },
                )
        for name, row in rows_of(list(done.values())).items():
            numbers = "  ".join(f"{k} {v:.3g}" for k, v in row.items() if v is not None)
            print(f"{key:<12}{name:<28}{numbers}", flush=True)
        print(f"{key}: {np.median([f['seconds'] for f in done.values()]):.1f} s a fit", flush=True)
        write_text(PAGE, page(results, environments, options))


if __name__ == "__main__":
    main()
