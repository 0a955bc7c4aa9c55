"""Two manoeuvres and the bands of 4096 simulations of each: hover to horizontal flight, and a yaw disturbance."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from cfb_mjx.errors import CfbError
from cfb_mjx.logs import FlightLog
from cfb_mjx.reproduce.flights import GENERATED, REAL_MASS_KG, SKIPPED, SOURCE, Given, generated, real_flights
from cfb_mjx.reproduce.item import Result, Row, write_csv

SIMULATIONS, FEWER, NOISE = 4096, 512, 1e-3
"""Number of simulations (as in the paper), number for each of many flights, and the standard deviation of the noise
that is added to velocity, m/s, and body rate, rad/s, in every step."""
REACH_S, USEFUL_S = 0.6, 0.2
"""Simulated time, and the horizon that the paper calls useful, s."""
LOST_DEG = 20.0
"""Attitude error above which a simulation counts as lost."""
CALM_MPS, CALM_RADPS = 0.35, 0.8
"""Largest velocity and body rate that count as hover at the start."""


@dataclass(frozen=True)
class Bands:
    """A part of a flight, and simulations of it.

    Attributes:
        name: name of the flight.
        start: start in the log's time, s.
        time: (T,) s since the start, of the simulations.
        simulated: (N, T, 9) velocity, m/s; roll, pitch and yaw, deg; body rate, rad/s.
        measured_time: (K,) s since the start, of the measurement.
        measured: (K, 9) the same quantities, measured.
    """

    name: str
    start: float
    time: np.ndarray
    simulated: np.ndarray
    measured_time: np.ndarray
    measured: np.ndarray

    def lost(self) -> np.ndarray:
        """Share (T,) of the simulations whose attitude error is larger than `LOST_DEG`."""
        measured = np.stack([np.interp(self.time, self.measured_time, self.measured[:, i]) for i in (3, 4, 5)], axis=-1)
        apart = Rotation.from_euler("ZYX", measured[:, ::-1], degrees=True).inv()
        turned = self.simulated[..., 5:2:-1].reshape(-1, 3)
        flown = Rotation.from_euler("ZYX", turned, degrees=True).as_quat().reshape(*self.simulated.shape[:2], 4)
        return np.array(
            [
                np.mean(np.degrees((apart[k] * Rotation.from_quat(flown[:, k])).magnitude()) > LOST_DEG)
                for k in range(len(self.time))
            ]
        )

    def off(self, at: float) -> list[float]:
        """Errors of the median simulation at a time (s): velocity (m/s), attitude (deg), body rate (rad/s)."""
        median = np.median(self.simulated, axis=0)
        both = [
            np.array([np.interp(at, t, x[:, i]) for i in range(9)])
            for t, x in ((self.time, median), (self.measured_time, self.measured))
        ]
        return [float(np.linalg.norm((both[0] - both[1])[i : i + 3])) for i in (0, 3, 6)]


def hover_to_forward(folder: Path, real: Path | None, given: Given | None = None) -> Result:
    """Simulate and draw the transition from hover to horizontal flight."""
    return _manoeuvre(
        "hover-to-forward",
        "From hover into horizontal flight",
        "figure8",
        lambda log, rows: float(np.linalg.norm(log.velocity[rows, :2], axis=1)[-1]),
        folder,
        real,
        given,
    )


def yaw_disturbance(folder: Path, real: Path | None, given: Given | None = None) -> Result:
    """Simulate and draw a yaw disturbance and the recovery from it."""
    return _manoeuvre(
        "yaw-disturbance",
        "Disturbed about yaw",
        "yaw",
        lambda log, rows: float(np.abs(log.body_rate[rows, 2] - log.body_rate[rows.start, 2]).mean()),
        folder,
        real,
        given,
    )


def _manoeuvre(
    name: str,
    title: str,
    shipped_log: str,
    size: Callable[[FlightLog, slice], float],
    folder: Path,
    real: Path | None,
    given: Given | None,
) -> Result:
    from cfb_mjx.parameters import load_model_file

    model = load_model_file("cfb-guards")
    own = _pieces([generated(shipped_log)], size)
    text = [
        f"{SIMULATIONS} simulations from the measured state with the logged commands. Parameters vary within 2 %, the "
        f"centre of gravity within 2 mm; noise of {NOISE:g} m/s and rad/s is added every 4 ms. Shaded: 5 to 95 % and "
        f"25 to 75 %; black: the measured flight; dotted line: {1e3 * USEFUL_S:g} ms.",
        f"The paper's own flights are not public. Generated: {GENERATED}. It was simulated with the model's own "
        "constants, so it does not show how long the model is useful for a drone; only real flights do (--real, "
        "--flights).",
    ]
    flown = {"generated": (model, own)}
    flights = real_flights(real)
    if flights:
        heavier = model.with_values("weighed, with two decks", mass=REAL_MASS_KG)
        flown["real"] = heavier, _pieces(flights, size)
        text.append(
            f"Real: {len(flights)} flights of {SOURCE}; from each flight the part that fits the manoeuvre best, of "
            "which the best is shown. The mass is the weighed mass; every other constant is the paper's. The paper's "
            "parameters are those of another drone: without a new fit, the simulations diverge from these flights "
            "(docs/real-flights.md), and a spread of 2 % does not cover the difference."
        )
    else:
        text.append(SKIPPED)
    if given is not None:
        flown["given"] = given.drone("cfb-guards"), _pieces(given.logs, size)
        text.append(f"Given: {given.said()}; every other constant is the paper's.")
    found = {}
    rows = [
        Row("simulations", "4096", str(SIMULATIONS), kind="input"),
        Row("spread of parameters; of the centre of gravity", "+-2 %; +-2 mm", _spread(), kind="input"),
        Row(
            "noise on velocity and body rate per 4 ms step",
            "0.001 m/s, 0.001 rad/s",
            f"{NOISE:g} m/s, {NOISE:g} rad/s",
            kind="input",
        ),
    ]
    until = f"here: until half of the simulations have an attitude error above {LOST_DEG:g} deg"
    for which, (drone, pieces) in flown.items():
        if not pieces:
            raise CfbError(f"{name}: none of the {which} flights begins a manoeuvre from hover; give other flights.")
        found[which] = piece = bands(drone, *pieces[0])
        if which == "generated":
            shown = _shown(_useful(piece))
            rows.append(Row(f"useful horizon, ms ({which})", "200", shown, f"{until}; no drone was measured", "own"))
        else:
            horizons = [_useful(bands(drone, *one, count=FEWER)) for one in pieces]
            low, middle, high = np.quantile(horizons, (0.25, 0.5, 0.75))
            what = f"useful horizon, ms ({which}; median and quartiles of {len(pieces)} flights)"
            rows.append(Row(what, "200", f"{_shown(middle)} ({_shown(low)} to {_shown(high)})", until))
        velocity, attitude, rate = piece.off(USEFUL_S)
        rows.append(
            Row(
                f"error of the median simulation after {1e3 * USEFUL_S:g} ms ({which}, {piece.name})",
                "",
                f"{velocity:.2g} m/s, {attitude:.2g} deg, {rate:.2g} rad/s",
                kind="own" if which == "generated" else "result",
            )
        )
    write_csv(
        folder / f"{name}.csv",
        ("flight", "time_s", "signal", "measured", "p5", "p25", "p50", "p75", "p95"),
        [row for which, piece in found.items() for row in _numbers(which, piece)],
    )
    figures = []
    for which, piece in found.items():
        path = folder / (f"{name}.png" if which == "generated" else f"{name}-{which}.png")
        _draw(piece, path, f"{which}: {piece.name}, from {piece.start:.2f} s")
        figures.append((path, f"{title}, {which}"))
    return Result(title, text, rows, figures)


def _spread() -> str:
    from cfb_mjx.parameters import load_randomisation

    ranges = dict(load_randomisation("identification").ranges)
    widths = {max(r.half_width) for name, r in ranges.items() if name != "center_of_gravity"}
    shown = " to ".join(f"{100 * x:g}" for x in sorted(widths))
    return f"+-{shown} %; +-{1e3 * max(ranges['center_of_gravity'].half_width):g} mm"


def _useful(piece: Bands) -> float:
    """Time at which half of the simulations are lost, s; infinite if fewer are lost at all times."""
    lost = np.flatnonzero(piece.lost() > 0.5)
    return float(piece.time[lost[0]]) if len(lost) else np.inf


def _shown(horizon: float) -> str:
    return f"{1e3 * horizon:.0f}" if np.isfinite(horizon) else f"more than {1e3 * REACH_S:.0f}"


def _pieces(logs: Sequence[FlightLog], size: Callable[[FlightLog, slice], float]) -> list[tuple[FlightLog, float]]:
    """For each flight, the start of the largest manoeuvre that begins from hover; the largest of all flights first."""
    found = []
    for log in logs:
        gaps, best = log.time[log.gaps()], (-np.inf, 0.0)
        for start in np.arange(log.time[0] + 0.1, log.time[-1] - REACH_S - 0.1, 0.05):
            if np.any((gaps > start - 0.3) & (gaps < start + REACH_S + 0.05)):
                continue
            row, last = np.searchsorted(log.time, (start, start + REACH_S))
            if np.linalg.norm(log.velocity[row]) < CALM_MPS and np.linalg.norm(log.body_rate[row]) < CALM_RADPS:
                best = max(best, (size(log, slice(row, last)), float(start)))
        if np.isfinite(best[0]):
            found.append((best[0], log, best[1]))
    return [(log, start) for _, log, start in sorted(found, key=lambda piece: -piece[0])]


def bands(model, log: FlightLog, start: float, count: int = SIMULATIONS, seed: int = 0) -> Bands:
    """Simulate a part of a flight many times with randomised parameters and noise.

    Args:
        model: `ModelFile` of the drone.
        log: the flight.
        start: start in the log's time, s.
        count: number of simulations.
        seed: seed of parameters and noise.
    """
    import jax
    import jax.numpy as jnp

    from cfb_mjx.model import Quadrotor, State
    from cfb_mjx.sysid.flight import delay_of
    from cfb_mjx.sysid.prediction import start_of_windows
    from cfb_mjx.sysid.windows import find_windows

    nominal = Quadrotor.from_file(model)
    delay = delay_of(log, nominal.parameters)
    window = find_windows(log, (0.05,), delay, float(nominal.parameters.gyro_delay), np.array([start]))
    speed = start_of_windows(nominal, log, window, delay)[0]
    first = State(
        *(jnp.asarray(x[0]) for x in (window.position, window.velocity, window.quaternion, window.body_rate, speed))
    )
    steps = round(REACH_S / nominal.dt)
    instants = start + nominal.dt * np.arange(steps)
    commands = jnp.asarray(log.command[np.searchsorted(log.time, instants + 1e-9, side="right") - 1])
    keys = jax.random.split(jax.random.PRNGKey(seed), count)
    velocity, quaternion, rate = map(np.asarray, _fly()(nominal, first, commands, keys))
    flown = _signals(velocity, quaternion, rate)
    begun = _signals(*(np.asarray(x)[None, None] for x in (first.velocity, first.quaternion, first.body_rate)))
    simulated = np.concatenate([np.broadcast_to(begun, (count, 1, 9)), flown], axis=1)
    simulated[..., 3:6] = np.degrees(np.unwrap(np.radians(simulated[..., 3:6]), axis=1))
    # Pose and velocity lag the gyro, so they are read from rows that are later by the delay.
    at = np.arange(0.0, REACH_S + 1e-9, float(np.median(np.diff(log.time))))
    seen = _signals(log.velocity, log.quaternion, log.body_rate)
    seen[:, 3:6] = np.degrees(np.unwrap(np.radians(seen[:, 3:6]), axis=0))
    late = [np.interp(start + at + delay * (i < 6), log.time, seen[:, i]) for i in range(9)]
    measured = np.stack(late, axis=1)
    # Shift the angles by whole turns to the initial angles of the simulations.
    measured[:, 3:6] -= 360.0 * np.round((measured[0, 3:6] - simulated[0, 0, 3:6]) / 360.0)
    return Bands(log.name, start, nominal.dt * np.arange(steps + 1), simulated, at, measured)


@cache
def _fly():
    """The compiled simulation, shared by all parts of flights."""
    import equinox as eqx
    import jax

    from cfb_mjx.model import step
    from cfb_mjx.parameters import load_randomisation, sample_parameters

    ranges = load_randomisation("identification")

    @eqx.filter_jit
    @eqx.filter_vmap(in_axes=(None, None, None, 0))
    def fly(nominal, first, commands, key):
        of_drone, of_noise = jax.random.split(key)
        drone = replace(nominal, parameters=sample_parameters(of_drone, nominal.parameters, ranges))

        def one(state, now):
            command, key = now
            state = step(drone, state, command)
            kicks = NOISE * jax.random.normal(key, (2, 3), state.velocity.dtype)
            kicked = (state.velocity + kicks[0], state.body_rate + kicks[1])
            state = eqx.tree_at(lambda s: (s.velocity, s.body_rate), state, kicked)
            return state, (state.velocity, state.quaternion, state.body_rate)

        return jax.lax.scan(one, first, (commands, jax.random.split(of_noise, len(commands))))[1]

    return fly


def _signals(velocity: np.ndarray, quaternion: np.ndarray, rate: np.ndarray) -> np.ndarray:
    from cfb_mjx.view.prediction import euler_deg

    return np.concatenate([velocity, euler_deg(quaternion), rate], axis=-1)


LABELS = (
    *(f"velocity {axis}, m/s" for axis in "xyz"),
    *(f"{angle}, deg" for angle in ("roll", "pitch", "yaw")),
    *(f"body rate {axis}, rad/s" for axis in "xyz"),
)


def _numbers(which: str, piece: Bands):
    quantiles = np.percentile(piece.simulated, [5, 25, 50, 75, 95], axis=0)
    for i, label in enumerate(LABELS):
        measured = np.interp(piece.time, piece.measured_time, piece.measured[:, i])
        for k, time in enumerate(piece.time):
            yield which, float(time), label, float(measured[k]), *map(float, quantiles[:, k, i])


def _draw(piece: Bands, path: Path, title: str) -> None:
    from cfb_mjx.view.spread import BANDS
    from cfb_mjx.view.style import COLOURS, MEASURED, context, new_figure, save

    with context():
        figure = new_figure(10.0, 6.4)
        panels = figure.subplots(3, 3, sharex=True)
        for i, (axis, label) in enumerate(zip(panels.flat, LABELS, strict=True)):
            values = piece.simulated[..., i]
            for low, high, name, alpha in BANDS:
                lower, upper = np.percentile(values, [low, high], axis=0)
                axis.fill_between(
                    piece.time, lower, upper, color=COLOURS["commands_in"], alpha=alpha, linewidth=0, label=name
                )
            axis.plot(piece.time, np.median(values, axis=0), color=COLOURS["commands_in"], label="median")
            axis.plot(piece.measured_time, piece.measured[:, i], color=MEASURED, linewidth=1.3, label="flown")
            axis.axvline(USEFUL_S, color=MEASURED, linewidth=0.8, linestyle=":")
            axis.set_ylabel(label)
            axis.margins(x=0)
            if i >= 6:
                axis.set_xlabel("time, s")
        figure.legend(*panels[-1, -1].get_legend_handles_labels(), loc="lower center", ncols=4)
        figure.suptitle(title, fontsize=10)
        figure.subplots_adjust(left=0.07, right=0.99, top=0.94, bottom=0.13, wspace=0.3, hspace=0.12)
        save(figure, path)
