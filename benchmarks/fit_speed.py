"""Measure the speed of the fits, and of SciPy with finite differences, on a minute of flight.

    python benchmarks/fit_speed.py [-o docs/fit-speed.md]

Six rigid-body parameters (three moments of inertia, J_m, two offsets of the centre of gravity) of one drone are fitted
to five closed-loop flights of 12 s at 250 Hz by the independent plant of the tests (``tests/sysid/plant.py``).
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from importlib.metadata import version
from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)

import numpy as np  # noqa: E402
import optimistix as optx  # noqa: E402
from scipy.integrate import solve_ivp  # noqa: E402

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT / "tests" / "sysid"), str(ROOT / "benchmarks")]
from plant import SIGMA, THRUST, Plant, cubic, derivative, fly  # noqa: E402
from same_residual import by_scipy, of_innovations, of_shooting, timed  # noqa: E402

from cfb_mjx.files import write_text  # noqa: E402
from cfb_mjx.parameters import load_model_file  # noqa: E402
from cfb_mjx.runtime import environment  # noqa: E402
from cfb_mjx.sysid.identification.fitting import fit  # noqa: E402
from cfb_mjx.sysid.identification.shooting import shoot  # noqa: E402

NOMINAL = load_model_file("cfb-guards").parameters()
NAMES = ("inertia_xx", "inertia_yy", "inertia_zz", "rotor_inertia", "cog_x", "cog_y")
TOLERANCE = 1e-8
"""Tolerance of all optimisers: SciPy's default."""
OPTIMISTIX = {
    "LevenbergMarquardt": optx.LevenbergMarquardt(rtol=TOLERANCE, atol=TOLERANCE),
    "Dogleg": optx.Dogleg(rtol=TOLERANCE, atol=TOLERANCE),
}
FLIGHTS, SECONDS, ROW, DELAY_ROWS = 5, 12.0, 0.004, 2
REPEATS = 3


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--output", type=Path, default=ROOT / "docs" / "fit-speed.md")
    parser.add_argument("--json", type=Path, default=ROOT / "benchmarks" / "fit_speed.json")
    arguments = parser.parse_args()
    plant, logs = flights()
    results = {
        "environment": environment() | {"scipy": version("scipy")},
        "load_average_before": os.getloadavg()[0],
        "truth": dict(zip(NAMES, [*plant.inertia[0], plant.rotor_inertia[0], 0.0, 0.0], strict=True)),
    }
    measurements = {
        "innovation": innovation,
        "shooting": shooting,
        "shooting_free_starts": lambda logs: timings(lambda: shoot(logs, NOMINAL, NAMES, use_measured=False)),
    }
    for name, measure in measurements.items():
        results[name], seconds = timed(lambda m=measure: m(logs))
        print(f"{name} measured in {seconds:.0f} s", flush=True)
    results["load_average_after"] = os.getloadavg()[0]
    write_text(arguments.json, json.dumps(results, indent=1, default=float) + "\n")
    write_text(arguments.output, page(results))
    print(f"wrote {arguments.output} and {arguments.json}")


def flights():
    """Simulate five flights, with an unmodelled torque, of a drone that differs from the preset."""
    plant = Plant(
        mass=np.full(FLIGHTS, 0.044),
        inertia=np.tile([3.0e-5, 3.9e-5, 6.2e-5], (FLIGHTS, 1)),
        rotor_inertia=np.full(FLIGHTS, 6e-8),
        lag=np.full(FLIGHTS, 0.05),
        gain=np.full(FLIGHTS, 2900.0),
    )
    return plant, fly(plant, SECONDS, seed=3, disturbance=1.0)


def timings(call) -> dict:
    """Return the time of the first call (with compilation), the best of the next ones, and the estimates."""
    _, first = timed(call)
    later = []
    for _ in range(REPEATS):
        result, seconds = timed(call)
        later.append(seconds)
    return {
        "first_s": first,
        "compiled_s": min(later),
        "estimates": {name: {"value": e.value, "std": e.std} for name, e in result.estimates.items()},
    }


def compare_optimisers(problem) -> dict:
    """Time the library's optimiser, optimistix and SciPy on the same compiled residual."""
    problem.solve()
    solved = [timed(problem.solve) for _ in range(REPEATS)]
    start = np.asarray(problem.unknowns.start)
    problem.residual(start)
    one = min(timed(lambda: problem.residual(start))[1] for _ in range(10))
    scipy = by_scipy(problem.residual, start)
    vector = solved[0][0]
    others = {}
    for name, solver in OPTIMISTIX.items():
        problem.solve(solver)
        runs = [timed(lambda s=solver: problem.solve(s)) for _ in range(REPEATS)]
        found = runs[0][0]
        others[name] = {
            "solve_s": min(seconds for _, seconds in runs),
            "solution": values(problem, found),
            "cost": 0.5 * float(np.sum(problem.residual(found) ** 2)),
        }
    return {
        "optimistix": others,
        "residuals": len(problem.residual(start)),
        "solve_s": min(seconds for _, seconds in solved),
        "residual_s": one,
        "scipy_s": scipy["seconds"],
        "scipy_evaluations": scipy["evaluations"],
        "solution": values(problem, vector),
        "scipy_solution": values(problem, scipy["x"]),
        "cost": 0.5 * float(np.sum(problem.residual(vector) ** 2)),
        "scipy_cost": 0.5 * float(np.sum(problem.residual(scipy["x"]) ** 2)),
    }


def values(problem, vector) -> dict[str, float]:
    """Return the values of the unknowns by name, SI units."""
    return dict(zip(problem.unknowns.names, np.asarray(problem.unknowns.values(vector)).tolist(), strict=True))


def innovation(logs) -> dict:
    """Measure the default fit."""
    found = []

    def call():
        found.append(fit(logs, NOMINAL, NAMES))
        return found[-1]

    whole = timings(call)
    return whole | compare_optimisers(of_innovations(logs, found[-1], NOMINAL))


def shooting(logs) -> dict:
    """Measure multiple shooting from measured starts, driven by commands, which is easy to write in NumPy as well."""
    whole = timings(lambda: shoot(logs, NOMINAL, NAMES, use_measured=False, free_start=False))
    problem = of_shooting(logs, NOMINAL, NAMES, use_measured=False)
    both = whole | compare_optimisers(problem)
    own = OwnResidual(logs)
    start = np.asarray(problem.unknowns.start)
    ours = problem.residual(start)
    # The library pads its batch with windows of weight zero; the other residuals must be equal.
    theirs = own(physical(start))
    both["numpy_agrees"] = float(np.max(np.abs(ours[: len(theirs)] - theirs)))
    numpy = by_scipy(lambda x: own(physical(x)), start)
    some = 8
    _, seconds = timed(lambda: own.by_solve_ivp(physical(start), some))
    both |= {
        "numpy_s": numpy["seconds"],
        "numpy_evaluations": numpy["evaluations"],
        "numpy_residual_s": min(timed(lambda: own(physical(start)))[1] for _ in range(3)),
        "numpy_solution": values(problem, numpy["x"]),
        "solve_ivp_windows_measured": some,
        "solve_ivp_residual_s": seconds / some * own.count,
        "solve_ivp_s": seconds / some * own.count * numpy["evaluations"],
    }
    return both


def physical(vector: np.ndarray) -> np.ndarray:
    """Return SI values of the optimiser's vector, which has the inertia as second moments and offsets in cm."""
    inertia = np.array([3.3e-5, 3.6e-5, 5.9e-5])
    moments = (0.5 * inertia.sum() - inertia) * np.exp(vector[:3])
    return np.concatenate([moments.sum() - moments, [5e-8 * np.exp(vector[3])], 0.01 * vector[4:]])


class OwnResidual:
    """The residual as a user without the library would write it: all windows at once in NumPy, RK4 at 4 ms."""

    def __init__(self, logs):
        windows = []
        for log in logs:
            third = [np.diff(x, n=3, axis=0) for x in (log.position, log.velocity, 2 * log.quaternion[:, 1:])]
            third = np.concatenate([*third, np.diff(log.body_rate, n=3, axis=0)], axis=1)
            noise = np.sqrt(2.0) * 1.4826 * np.median(np.abs(third), axis=0) / np.sqrt(20.0)
            last = log.time[-1] - 0.53
            for t0 in np.arange(0.6, last + 1e-9, 0.2):
                windows.append((log, round(t0 / ROW), noise))
        self.count = len(windows)
        rows = np.arange(5, 51, 5)

        def pose(log, row):
            return np.concatenate([log.position[row], log.velocity[row], log.quaternion[row]], axis=-1)

        self.start = np.array([np.append(pose(g, r + DELAY_ROWS), g.body_rate[r]) for g, r, _ in windows])
        self.truth = np.array([np.c_[pose(g, r + DELAY_ROWS + rows), g.body_rate[r + rows]] for g, r, _ in windows])
        self.command = np.array([g.command[r : r + 50] for g, r, _ in windows])
        self.before = np.array([g.command[r - 150 : r] for g, r, _ in windows])
        self.noise = np.array([noise for *_, noise in windows])[:, None]

    def __call__(self, values: np.ndarray) -> np.ndarray:
        x, path = self._initial(values), []
        for step in range(50):
            u = self.command[:, step]
            k1 = self.rate(values, x, u)
            k2 = self.rate(values, x + 0.5 * ROW * k1, u)
            k3 = self.rate(values, x + 0.5 * ROW * k2, u)
            k4 = self.rate(values, x + ROW * k3, u)
            x = x + ROW / 6 * (k1 + 2 * (k2 + k3) + k4)
            x[:, 6:10] /= np.linalg.norm(x[:, 6:10], axis=1, keepdims=True)
            if step % 5 == 4:
                path.append(x)
        return self._errors(values, np.stack(path, axis=1)).ravel()

    def by_solve_ivp(self, values: np.ndarray, windows: int) -> np.ndarray:
        """Predict the first windows, with one `solve_ivp` each."""
        initial, path = self._initial(values), []
        for i in range(windows):

            def rate(t, x, i=i):
                return self.rate(values, x[None], self.command[i, min(int(t / ROW + 1e-9), 49)][None])[0]

            times = np.arange(5, 51, 5) * ROW
            # Steps of at most one row, so that the solver does not skip changes of the command.
            path.append(solve_ivp(rate, (0, 0.2), initial[i], t_eval=times, max_step=ROW, rtol=1e-6, atol=1e-8).y.T)
        return np.array(path)

    def _initial(self, values):
        speed = 2900.0 * self.before[:, 0]
        decay = np.exp(-ROW / 0.05)
        for row in range(self.before.shape[1]):
            target = 2900.0 * self.before[:, row]
            speed = target + (speed - target) * decay
        x = np.concatenate([self.start, speed], axis=1)
        offset, rotation = np.array([values[4], values[5], 0.0]), _matrix(x[:, 6:10])
        x[:, :3] += rotation @ offset
        x[:, 3:6] += np.einsum("nij,nj->ni", rotation, np.cross(x[:, 10:13], offset))
        return x

    def rate(self, values, x, u):
        """Derivative of the state of the centre of gravity, with the moment of the offset thrust."""
        count = len(x)
        plant = Plant(
            np.full(count, 0.044),
            np.tile(values[:3], (count, 1)),
            np.full(count, values[3]),
            np.full(count, 0.05),
            np.full(count, 2900.0),
        )
        thrust = np.maximum(cubic(THRUST, x[:, 13:] / SIGMA), 0).sum(1)
        push = np.stack([-values[5] * thrust, values[4] * thrust, 0 * thrust], axis=1) / values[:3]
        return derivative(plant, x, u, push)

    def _errors(self, values, path):
        offset, rotation = np.array([values[4], values[5], 0.0]), _matrix(path[..., 6:10])
        position = path[..., :3] - rotation @ offset
        swing = np.cross(path[..., 10:13], offset)
        velocity = path[..., 3:6] - np.einsum("...ij,...j->...i", rotation, swing)
        a, b = self.truth[..., 6:10], path[..., 6:10]
        turn = a[..., :1] * b[..., 1:] - b[..., :1] * a[..., 1:] - np.cross(a[..., 1:], b[..., 1:])
        turn *= 2 * np.sign(np.sum(a * b, axis=-1, keepdims=True))
        parts = (position, velocity, turn, path[..., 10:13])
        wanted = (self.truth[..., :3], self.truth[..., 3:6], 0.0, self.truth[..., 10:])
        return np.concatenate([p - w for p, w in zip(parts, wanted, strict=True)], axis=-1) / self.noise


def _matrix(q):
    w, x, y, z = np.moveaxis(q, -1, 0)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def page(results: dict) -> str:
    """Return the page as Markdown."""
    env, a, b = results["environment"], results["innovation"], results["shooting"]
    packages = ", ".join(f"{name} {env[name]}" for name in ("cfb_mjx", "jax", "numpy", "scipy"))
    load = f"{results['load_average_before']:.1f} before and {results['load_average_after']:.1f} after"
    lines = [
        "# How fast are the fits?",
        "",
        f"Measured {env['date']} on {env['processor']}, {env['device']}, Python {env['python']},",
        f"{packages}, float64,",
        f"load average {load} (the machine is shared), by",
        "",
        "    python benchmarks/fit_speed.py",
        "",
        "which writes this page and `benchmarks/fit_speed.json`. One drone off the preset, five closed-loop flights of",
        "12 s at 250 Hz; unknown: J_xx, J_yy, J_zz, J_m and two offsets of the centre of gravity. All methods start at",
        "the preset. Times are wall time; compiled ones the best of three.",
        "",
        "## Whole fits",
        "",
        "Preparing the logs, weights or noise levels, every iteration and the bootstrap of the uncertainty included.",
        "",
        "| call | first, with compilation [s] | compiled [s] |",
        "|---|---|---|",
    ]
    calls = (
        ("`fit` (innovations, measured rotor speeds)", a),
        ("`shoot(use_measured=False)`", results["shooting_free_starts"]),
        ("`shoot(use_measured=False, free_start=False)`", b),
    )
    lines += [f"| {name} | {x['first_s']:.1f} | {x['compiled_s']:.2f} |" for name, x in calls]
    lines += [
        "",
        "## Optimisers on the same residual",
        "",
        "The optimiser alone, with noise levels and weights fixed. The library's is `GaussNewton`, a solver for",
        "optimistix; `fit(..., solver=optx.LevenbergMarquardt(rtol=1e-8, atol=1e-8))` takes another. SciPy is",
        "`least_squares` with its defaults (2-point differences, tolerances 1e-8).",
        "",
        "| residual | who | evaluations | one evaluation [ms] | time [s] | times the library's |",
        "|---|---|---|---|---|---|",
    ]

    def row(residual, who, count, one, total, base):
        shown = "" if one is None else f"{1e3 * one:.1f}"
        lines.append(f"| {residual} | {who} | {count} | {shown} | {total:.2f} | {total / base:.1f} |")

    for name, x in (("innovations", a), ("shooting", b)):
        row(f"{name} ({x['residuals']} numbers)", "library", "", None, x["solve_s"], x["solve_s"])
        for solver, there in x["optimistix"].items():
            row(f"{name}, the library's, compiled", f"optimistix `{solver}`", "", None, there["solve_s"], x["solve_s"])
        row(
            f"{name}, the library's, compiled",
            "SciPy",
            x["scipy_evaluations"],
            x["residual_s"],
            x["scipy_s"],
            x["solve_s"],
        )
    row(
        "shooting, written in NumPy (all windows at once)",
        "SciPy",
        b["numpy_evaluations"],
        b["numpy_residual_s"],
        b["numpy_s"],
        b["solve_s"],
    )
    row(
        "shooting, one `solve_ivp` per window",
        "SciPy",
        b["numpy_evaluations"],
        b["solve_ivp_residual_s"],
        b["solve_ivp_s"],
        b["solve_s"],
    )
    lines += [
        "",
        f"The last row is extrapolated from {b['solve_ivp_windows_measured']} windows and the evaluations of the row "
        "above. The NumPy residual",
        f"differs from the library's by at most {b['numpy_agrees']:.1g} standard deviations. What they found:",
        "",
        "| parameter | truth | innovations: library | SciPy | shooting: library | SciPy | SciPy on NumPy |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, value in results["truth"].items():
        found = (a["solution"], a["scipy_solution"], b["solution"], b["scipy_solution"], b["numpy_solution"])
        lines.append(f"| {name} | {value:.5g} | " + " | ".join(f"{x[name]:.5g}" for x in found) + " |")
    lines += [
        "",
        "Shooting is driven by commands here and biased by the unmodelled torque under feedback",
        "(`docs/identification.md`); it is in this table for its speed.",
        "",
        "## Asked for",
        "",
        *verdict(a, b, results["shooting_free_starts"]),
        "",
    ]
    return "\n".join(lines)


def verdict(a: dict, b: dict, free: dict) -> list[str]:
    """Compare the measurements with the targets."""
    slowest = max(x["compiled_s"] for x in (a, b, free))

    def said(seconds, base):
        ratio = seconds / base
        return f"{ratio:.1f} times, {'met' if ratio >= 10 else 'not met'}"

    return [
        f"- A minute of flight, six parameters, in under 30 s on two cores after compilation: {slowest:.1f} s at most,",
        f"  {'met' if slowest < 30 else 'not met'}.",
        "- Ten times faster than SciPy with finite differences on the same residual:",
        f"  innovations, the library's compiled residual: {said(a['scipy_s'], a['solve_s'])};",
        f"  shooting, the library's compiled residual: {said(b['scipy_s'], b['solve_s'])};",
        f"  shooting, written in vectorised NumPy: {said(b['numpy_s'], b['solve_s'])};",
        f"  shooting, one `solve_ivp` per window (extrapolated): {said(b['solve_ivp_s'], b['solve_s'])}.",
        "- The whole `shoot` against SciPy, which computes no weights and no bootstrap here, on the NumPy residual:",
        f"  {said(b['numpy_s'], b['compiled_s'])}.",
    ]


if __name__ == "__main__":
    main()
