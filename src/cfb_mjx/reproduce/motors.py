"""Motor and rotor: the step response with fitted T and K, and the thrust and torque curves."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from cfb_mjx.files import shipped
from cfb_mjx.optional import not_none
from cfb_mjx.reproduce.flights import REAL_MASS_KG, SKIPPED, SOURCE, real_flights
from cfb_mjx.reproduce.item import Result, Row, with_std, write_csv

BENCH = (
    "The paper's bench data are not public. The bench data used here come with the project (`data/bench`); another "
    "program made them from the paper's equations, with added noise. They show that the estimator recovers the "
    "constants with which they were made; they are not a second measurement of the drone."
)
PAPER = {"motor_time_constant": ("T, s", 0.050), "motor_gain": ("K, rad/s", 2900.0)}
CUBICS = {"thrust": (("N", 1.0), (-0.23, 0.562, -0.043)), "torque": (("1e-4 N m", 1e4), (-3.4, 8.7, 2.9))}
SHOWN_S, FITTED = 2.0, 2
"""Shown time of a flight, s, and number of fitted flights (one would be enough)."""
LOW_PASS_HZ = 8.0
"""Cut-off frequency for comparing force and rotor speeds of real flights, to remove vibrations of the rotors."""


def motor_step(folder: Path, real: Path | None) -> Result:
    """Fit T and K to the rotor speed after steps of the command."""
    from cfb_mjx.logs.bench_tables import MotorRecord, read_bench, record_of
    from cfb_mjx.parameters import load_model_file
    from cfb_mjx.sysid.rotors.motors import fit_motors, replay

    nominal = load_model_file("cfb-guards").parameters()
    steps = read_bench(shipped("data", "bench", "motor_steps.csv"))
    assert isinstance(steps, MotorRecord)
    bench = fit_motors([steps], nominal)
    fits, text = {"bench": bench}, [BENCH]
    flights = real_flights(real)[:FITTED]
    if flights:
        fits["real flights"] = fit_motors([not_none(record_of(log)) for log in flights], nominal, offset=True)
        text.append(
            f"Right: the same fit to real flights ({', '.join(log.name for log in flights)}) of {SOURCE}, of which two "
            "seconds are shown. In these flights the command is not compensated for the battery voltage, which is "
            "below its maximum, and the steady speed is an affine function of the command: K and the offset belong "
            "together."
        )
    else:
        text.append(SKIPPED)
    shown = {name: replay(fit)[0] for name, fit in fits.items()}
    rows = []
    for name, fit in fits.items():
        for key, (what, paper) in PAPER.items():
            found = fit.common.estimates[key]
            kind = "input" if name == "bench" else "result"
            rows.append(Row(f"{what} ({name})", f"{paper:g}", with_std(found.value, found.std), _why(name, key), kind))
    if flights:
        offset = fits["real flights"].common.estimates.get("motor_speed_offset")
        if offset is not None:
            rows.append(Row("speed at no command, rad/s (real flights)", "0", with_std(offset.value, offset.std)))
    write_csv(
        folder / "motor-step.csv",
        ("data", "time_s", "command", "measured_radps", "fitted_radps"),
        [
            (name, *map(float, row))
            for name, r in shown.items()
            for row in zip(r.time, r.command, r.measured, r.simulated, strict=True)
        ],
    )
    _draw_steps(shown, folder / "motor-step.png")
    return Result("Motor step response", text, rows, [(folder / "motor-step.png", "rotor speed after steps")])


def _why(name: str, key: str) -> str:
    if name == "bench":
        return "made with the paper's value"
    if key == "motor_gain":
        return "another drone and battery, commands not compensated; with an offset"
    return "another drone, in flight; one constant for rise and fall"


def _draw_steps(shown: dict, path: Path) -> None:
    from cfb_mjx.view.style import COLOURS, MEASURED, context, new_figure, save

    with context():
        figure = new_figure(4.6 * len(shown), 3.4)
        for axis, (name, r) in zip(figure.subplots(1, len(shown), squeeze=False)[0], shown.items(), strict=True):
            # For a flight, the two seconds in which the command varies most.
            first = 0 if name == "bench" else _liveliest(r.time, r.command)
            here = (r.time >= r.time[first]) & (r.time <= r.time[first] + SHOWN_S)
            time = r.time[here] - r.time[first]
            axis.plot(time, r.measured[here], ".", markersize=2, color=MEASURED, label="measured")
            axis.plot(
                time, r.simulated[here], color=COLOURS["commands_in"], linewidth=1.3, label="fitted, from commands"
            )
            axis.set_xlabel("time, s")
            axis.set_title(name)
            axis.set_ylabel("rotor speed, rad/s")
            axis.legend(loc="best")
        width = figure.get_figwidth()
        figure.subplots_adjust(left=0.75 / width, right=1 - 0.12 / width, bottom=0.14, top=0.91, wspace=0.28)
        save(figure, path)


def _liveliest(time: np.ndarray, command: np.ndarray) -> int:
    rows = max(1, round(SHOWN_S / np.median(np.diff(time))))
    spread = [np.std(command[i : i + rows]) for i in range(0, max(1, len(time) - rows), 10)]
    return 10 * int(np.argmax(spread))


def rotor_curves(folder: Path, real: Path | None) -> Result:
    """Fit cubics to thrust and torque of a rotor, and compare them with other sources for the same rotor."""
    import jax.numpy as jnp

    from cfb_mjx.logs.bench_tables import MapTable, read_bench
    from cfb_mjx.model.rotors import thrust, torque
    from cfb_mjx.parameters import load_model_file
    from cfb_mjx.sysid.rotors.rotor_maps import fit_map

    table = read_bench(shipped("data", "bench", "rotor_points.csv"))
    assert isinstance(table, MapTable)
    forces, torques = not_none(table.force), not_none(table.torque)
    fitted = {
        "thrust": fit_map(table.rotor_speed, forces, name="thrust"),
        "torque": fit_map(table.rotor_speed, torques, name="torque"),
    }
    text, rows = [BENCH], []
    for name, ((unit, scale), paper) in CUBICS.items():
        for power, value, ours, std in zip("321", paper, fitted[name].coefficients, fitted[name].std, strict=True):
            what = f"{name} cubic, (Omega/2900)^{power}, {unit} (bench)"
            back = with_std(scale * ours, scale * std)
            rows.append(Row(what, f"{value:g}", back, "made with the paper's value", "input"))
    speed = np.linspace(0.0, 2900.0, 117)
    curves = {}
    for preset, label in (("cfb-guards", "paper"), ("cf21b-500", "drone-models"), ("cf2x", "brushed")):
        p = load_model_file(preset).parameters()
        curves[label] = np.array([[float(f(p, jnp.full(4, s))[0]) for s in speed] for f in (thrust, torque)])
    flights = real_flights(real)
    if not flights:
        text.append(SKIPPED)
    found = _thrust_in_flight(flights) if flights else None
    if found is not None:
        coefficients, low, high, rms = found
        powers = np.stack([(speed / 2900.0) ** k for k in (3, 2, 1)])
        inside = (speed >= low) & (speed <= high)
        curves["real flights"] = np.stack(
            [np.where(inside, coefficients @ powers, np.nan), np.full_like(speed, np.nan)]
        )
        text.append(
            f"Real flights, {SOURCE}: the accelerometer along z times {REAL_MASS_KG:g} kg is fitted with a cubic "
            f"through the origin in the four rotor speeds, below {LOW_PASS_HZ:g} Hz, by least squares; {rms:.3g} N rms "
            "remain. Torque cannot be measured in this way."
        )
        for at in (1000.0, 1700.0, 2300.0):
            if low <= at <= high:
                i = int(np.argmin(np.abs(speed - at)))
                why = "another drone with its own propellers, in flight and not on a bench"
                paper, ours = curves["paper"][0][i], curves["real flights"][0][i]
                rows.append(
                    Row(f"thrust at {speed[i]:.0f} rad/s, N (real flights)", f"{paper:.3f}", f"{ours:.3f}", why)
                )
    write_csv(
        folder / "rotor-curves.csv",
        ("source", "rotor_speed_radps", "thrust_n", "torque_nm"),
        [
            (name, float(s), float(f), float(t))
            for name, (force, moment) in curves.items()
            for s, f, t in zip(speed, force, moment, strict=True)
            if np.isfinite(f)
        ]
        + [
            ("bench point", float(s), float(f), float(t))
            for s, f, t in zip(table.rotor_speed, forces, torques, strict=True)
        ],
    )
    _draw_curves(speed, curves, fitted, folder / "rotor-curves.png")
    return Result(
        "Thrust and torque", text, rows, [(folder / "rotor-curves.png", "thrust and torque over rotor speed")]
    )


def _thrust_in_flight(flights) -> tuple[np.ndarray, float, float, float]:
    """Coefficients (3,) of s^3, s^2, s, N; lower and upper limit of the rotor speeds, rad/s; rms of the residual, N."""
    from scipy.signal import butter, sosfiltfilt

    design, force, speeds = [], [], []
    for log in flights:
        if log.rotor_speed is None:
            continue
        rate = 1.0 / np.median(np.diff(log.time))
        low_pass = butter(2, LOW_PASS_HZ, fs=rate, output="sos")
        for piece in log.segments():
            rows = slice(piece.start, piece.stop)
            speed = log.rotor_speed[rows]
            if len(speed) < 100 or not np.isfinite(speed).all():
                continue
            s = speed / 2900.0
            columns = np.stack([(s**k).sum(axis=1) for k in (3, 2, 1)], axis=1)
            columns = np.concatenate([columns, log.specific_force[rows, 2:] * REAL_MASS_KG], axis=1)
            smooth = sosfiltfilt(low_pass, columns, axis=0)
            design.append(smooth[:, :3])
            force.append(smooth[:, 3])
            speeds.append(speed.mean(axis=1))
    design, force, speeds = map(np.concatenate, (design, force, speeds))
    coefficients = np.linalg.lstsq(design, force, rcond=None)[0]
    low, high = np.quantile(speeds, (0.005, 0.995))
    return coefficients, float(low), float(high), float(np.sqrt(np.mean((design @ coefficients - force) ** 2)))


def _draw_curves(speed: np.ndarray, curves: dict, fitted: dict, path: Path) -> None:
    from cfb_mjx.view.style import COLOURS, MEASURED, context, new_figure, save

    looks = {
        "paper": {"color": COLOURS["commands_in"]},
        "drone-models": {"color": COLOURS["rotor_speed_in"], "linestyle": "--"},
        "brushed": {"color": COLOURS["hold"], "linestyle": ":"},
        "real flights": {"color": "#009E73", "linewidth": 2.2},
    }
    with context():
        figure = new_figure(9.2, 3.6)
        for i, (axis, name, unit) in enumerate(zip(figure.subplots(1, 2), fitted, ("mN", "mN m"), strict=True)):
            of = fitted[name]
            axis.plot(of.rotor_speed, 1e3 * of.value, "o", markersize=3, markerfacecolor="none", color=MEASURED,
                      label="bench points (generated)")  # fmt: skip
            for label, both in curves.items():
                # The brushed rotor's torque is eight times that of the others and would hide them.
                if np.isfinite(both[i]).any() and (label, name) != ("brushed", "torque"):
                    axis.plot(speed, 1e3 * both[i], label=label, **looks[label])
            axis.set_xlabel("rotor speed, rad/s")
            axis.set_ylabel(f"{name} of a rotor, {unit}")
            axis.legend(loc="upper left")
        figure.subplots_adjust(left=0.075, right=0.99, bottom=0.13, top=0.97, wspace=0.2)
        save(figure, path)
