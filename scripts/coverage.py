"""How often the intervals of `cfb fit` cover the truth: many flights of an independent plant, each drone drawn anew.

    python scripts/coverage.py [--flights 200] [--seconds 12] [--resume]

The plant is the tests' own (tests/sysid/plant.py: NumPy, classical RK4, none of the library's model code; checked there
against SciPy's DOP853), under feedback, pose 8 ms late, sensor noise. Writes docs/coverage.md and
benchmarks/coverage.json.
"""

import argparse
import json
import sys
import time
from pathlib import Path

import numpy as np

from cfb_mjx.cli.runtime import configure_jax, environment
from cfb_mjx.files import write_json, write_text

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests" / "sysid"))
REQUEST = "inertia,rotor_inertia,motor_time_constant,motor_gain,cog,thrust_scale"
CASES = {
    "rotor speed measured, no disturbance": {"disturbance": 0.0, "measure_rotors": True},
    "rotor speed measured, 4 rad/s^2 of unmodelled torque": {"disturbance": 4.0, "measure_rotors": True},
    "commands only, 4 rad/s^2 of unmodelled torque": {"disturbance": 4.0, "measure_rotors": False},
}
SEED = 2026


def draw(count: int, rng):
    """Drones: inertia (of a possible body) and lag +-20 %, J_m +-30 %, gain +-10 %."""
    from plant import Plant

    def around(value, spread, *shape):
        return np.asarray(value) * (1 + spread * rng.uniform(-1, 1, (count, *shape)))

    inertia = around([3.3e-5, 3.6e-5, 5.9e-5], 0.2, 3)
    # Draws that no mass distribution can have are made again, for the fit knows that they do not exist.
    while np.any(impossible := 2 * inertia.max(axis=1) > 0.99 * inertia.sum(axis=1)):
        inertia[impossible] = around([3.3e-5, 3.6e-5, 5.9e-5], 0.2, 3)[impossible]
    return Plant(
        mass=np.full(count, 0.044),
        inertia=inertia,
        rotor_inertia=around(5e-8, 0.3),
        lag=around(0.05, 0.2),
        gain=around(2900.0, 0.1),
    )


def truths(plant, i: int) -> dict[str, float]:
    """What drone ``i`` really is."""
    axes = dict(zip(("inertia_xx", "inertia_yy", "inertia_zz"), plant.inertia[i], strict=True))
    motors = {"motor_time_constant": plant.lag[i], "motor_gain": plant.gain[i]}
    return axes | {"rotor_inertia": plant.rotor_inertia[i], "thrust_scale": 1.0, "cog_x": 0.0, "cog_y": 0.0} | motors


def study(flights: int, seconds: float, case: dict, progress) -> dict:
    """Fit every flight; per parameter the errors in standard deviations and in per cent of the truth."""
    from plant import fly

    from cfb_mjx.parameters import load_model_file
    from cfb_mjx.sysid.identification.fitting import fit

    rng = np.random.default_rng(SEED)
    plant = draw(flights, rng)
    nominal = load_model_file("cfb-guards").parameters()
    z: dict[str, list[float]] = {}
    off: dict[str, list[float]] = {}
    untold: dict[str, int] = {}
    begin = time.perf_counter()
    request = REQUEST if case["measure_rotors"] else REQUEST.replace(",thrust_scale", "")
    for i, log in enumerate(fly(plant, seconds, seed=SEED + 1, **case)):
        found = fit([log], nominal, request)
        progress(i + 1, flights)
        for name, truth in truths(plant, i).items():
            if name in found.estimates:
                estimate = found.estimates[name]
                z.setdefault(name, []).append((estimate.value - truth) / estimate.std)
                off.setdefault(name, []).append((estimate.value - truth) / (truth or 1e-5))
            elif name in found.unidentifiable:
                untold[name] = untold.get(name, 0) + 1
    rows = {}
    for name, values in z.items():
        values, errors = np.array(values), np.abs(off[name])
        rows[name] = {
            "fits": len(values),
            "untold": untold.get(name, 0),
            "covered_95": float(np.mean(np.abs(values) < 1.96)),
            "z_mean": float(values.mean()),
            "z_std": float(values.std()),
            "error_median": float(np.median(errors)),
            "error_95": float(np.quantile(errors, 0.95)),
        }
    return {"parameters": rows, "seconds": time.perf_counter() - begin}


def page(results: dict, flights: int, seconds: float) -> str:
    """The Markdown page."""
    facts = ", ".join(f"{name} {value}" for name, value in environment().items())
    parts = []
    for case, result in results.items():
        lines = [
            f"## {case[0].upper()}{case[1:]}",
            "",
            "| parameter | fits | covered by 95 % interval | mean z | std z | median error | 95 % of errors below |",
            "|---|---:|---:|---:|---:|---:|---:|",
        ]
        for name, row in result["parameters"].items():
            unit, scale = ("mm", 0.01) if name.startswith("cog") else ("%", 100.0)
            lines.append(
                f"| {name} | {row['fits']} | {row['covered_95']:.1%} | {row['z_mean']:+.2f} | {row['z_std']:.2f} "
                f"| {row['error_median'] * scale:.2g} {unit} | {row['error_95'] * scale:.2g} {unit} |"
            )
        parts.append("\n".join(lines))
    return f"""# Do the intervals cover the truth?

Written by `python scripts/coverage.py --flights {flights} --seconds {seconds:g}`; do not edit. {facts}

Every row: `cfb fit`'s default estimator on {flights} flights of {seconds:g} s under feedback, 250 Hz, each of another
drone (inertia, of a possible body, and motor lag +-20 %, J_m +-30 %, motor gain +-10 %), flown by an independent plant
(NumPy, RK4 at 1 ms, pose 8 ms late, gyro noise 0.02 rad/s, accelerometer 0.1 m/s^2, rotor speed 3 rad/s). z is the
error in the fit's own standard deviations. Of {flights} intervals that are right, between {_binomial(flights)} cover
the truth.

{chr(10).join(chr(10) + part for part in parts)}
"""


def _binomial(count: int) -> str:
    draws = np.random.default_rng(0).binomial(count, 0.95, 100_000) / count
    return f"{np.quantile(draws, 0.005):.1%} and {np.quantile(draws, 0.995):.1%} (99 % of the time)"


def _say(done: int, total: int) -> None:
    if done % 20 == 0 or done == total:
        print(f"{done}/{total}", file=sys.stderr, flush=True)


def _finished(options: argparse.Namespace) -> dict:
    """The cases already written, if by these settings, versions and machine."""
    kept = json.loads((ROOT / "benchmarks" / "coverage.json").read_text())
    same = (kept["flights"], kept["seconds"]) == (options.flights, options.seconds)
    then, now = ({k: v for k, v in facts.items() if k != "date"} for facts in (kept["environment"], environment()))
    if not same or then != now:
        raise SystemExit(
            "benchmarks/coverage.json is of other settings, versions or another machine: run without --resume"
        )
    return kept["cases"]


def main() -> None:
    """Run all cases and write the results."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--flights", type=int, default=200)
    parser.add_argument("--seconds", type=float, default=12.0)
    parser.add_argument("--dry", action="store_true", help="print, write nothing")
    parser.add_argument(
        "--resume", action="store_true", help="keep the cases an interrupted run of these settings left"
    )
    options = parser.parse_args()
    configure_jax(x64=True)
    results = _finished(options) if options.resume else {}
    for case, settings in CASES.items():
        if case in results:
            continue
        results[case] = study(options.flights, options.seconds, settings, _say)
        print(case, f"{results[case]['seconds']:.0f} s")
        for name, row in results[case]["parameters"].items():
            print(f"  {name:<20}" + "  ".join(f"{key} {value:.4g}" for key, value in row.items()), flush=True)
        if options.dry:
            continue
        # After every case: an hour's work must not hang on the last.
        everything = {"flights": options.flights, "seconds": options.seconds, "cases": results}
        write_json(ROOT / "benchmarks" / "coverage.json", everything | {"environment": environment()})
        write_text(ROOT / "docs" / "coverage.md", page(results, options.flights, options.seconds))


if __name__ == "__main__":
    main()
