"""The IDSIA nano-drone benchmark for this library's models.

Busetto et al., "Nonlinear system identification for a nano-drone benchmark", Control Engineering Practice 172, 2026.
From every row of a flight, 50 steps at 100 Hz are predicted from measured rotor speeds. The errors are the mean norms
of position, velocity, attitude (geodesic, rad) and body rate after h = 1, 10 and 50 steps, and their sums over
h = 1 to 50. ``docs/nanodrone.md`` lists what is the same and what differs here.

`tune_observer` searches for the noise levels of an `Observer` that give the best predictions.

The maximum-likelihood levels (`cfb_mjx.sysid.observer.fit_observer`) describe the disturbances up to the next row. Over
half a second most of these decay, and a model's errors in fast manoeuvres are not disturbances. Therefore the levels
that predict best respond less to fast changes.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import equinox as eqx
import jax
import numpy as np

from cfb_mjx.errors import CfbError
from cfb_mjx.logs import FlightLog
from cfb_mjx.logs.idsia import VEHICLE_MASS
from cfb_mjx.logs.rotation import exponential, multiply, to_world
from cfb_mjx.model.quadrotor import Quadrotor, integrate_measured, prepare
from cfb_mjx.model.state import State, stack, unstack
from cfb_mjx.model.vector import Vec
from cfb_mjx.parameters import ModelFile, load_model_file
from cfb_mjx.sysid.disturbance import observed_model
from cfb_mjx.sysid.evaluation import OBSERVED, evaluate
from cfb_mjx.sysid.flight import prepare_flight
from cfb_mjx.sysid.metrics import geodesic_deg
from cfb_mjx.sysid.observer import Observer, causal_rotor_speed, observe, usual_observer
from cfb_mjx.sysid.replay import remembered_along
from cfb_mjx.sysid.sensor_faults import HEALTHY, SensorFaults

STEPS = 50
"""Number of predicted steps."""
INTERVAL = 0.01
"""Time between rows, s."""
SHOWN = (1, 10, 50)
"""Numbers of steps ahead whose errors are reported individually."""
BLOCK = 1024
"""Number of windows predicted at once."""
QUANTITIES = {"position": "m", "velocity": "mps", "attitude": "rad", "rate": "radps"}
"""Quantities of the benchmark and their units."""
THRUST, GRAVITY = 3.72e-8, 9.81
"""Constants of the paper's row *physics*: thrust of a rotor over its squared speed, N s^2, and gravity, m/s^2."""
PUBLISHED: dict[str, tuple[float, float, float, float]] = {
    "naive": (17.79, 38.92, 8.21, 29.09),
    "physics": (2.322, 10.62, 5.101, 29.09),
    "physics + residual": (2.363, 10.40, 6.15, 28.99),
    "LSTM": (5.97, 16.72, 5.65, 35.84),
}
"""Sums over h of the errors of position, m, velocity, m/s, attitude, rad, and body rate, rad/s, published in the paper.
They are of the paper's own test flights, which follow another trajectory."""
DECLARED = "cfb-guards"
"""Name of the declared model."""
PLANT = "cfb-idsia"
"""Name of the model fitted to flights of the benchmark's drone, without its test flights."""


@dataclass(frozen=True)
class Starts:
    """W windows of one flight, each of S = `STEPS` steps.

    Attributes:
        row: (W,) row at which each window starts.
        truth: measured position, velocity, quaternion and body rate of every row, (n, 3 or 4).
        rotor_speed: (n, 4) rad/s, using no later rows.
    """

    row: np.ndarray
    truth: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
    rotor_speed: np.ndarray

    def __len__(self) -> int:
        return len(self.row)

    def ahead(self) -> tuple[np.ndarray, ...]:
        """Measurements 1 to S steps after each start, (W, S, 3 or 4)."""
        index = self.row[:, None] + np.arange(1, STEPS + 1)
        return tuple(x[index] for x in self.truth)


def find_starts(log: FlightLog, stride: int = 1) -> Starts:
    """Find the windows: every ``stride``-th row that is followed by 50 rows without a gap.

    Args:
        log: the flight.
        stride: number of rows between windows.

    Raises:
        CfbError: the log is not sampled at 100 Hz or has no rotor speeds.
    """
    if abs(log.nominal_interval - INTERVAL) > 1e-3:
        raise CfbError(f"{log.name}: sampled every {log.nominal_interval:g} s; the benchmark needs rows every 0.01 s.")
    speed = causal_rotor_speed(log)
    if speed is None:
        raise CfbError(f"{log.name}: the benchmark needs rotor speeds of all motors throughout the flight.")
    missing = np.append(0, np.cumsum(np.abs(np.diff(log.time) - INTERVAL) > INTERVAL / 2))
    rows = np.arange(0, max(len(log) - STEPS, 0), stride)
    rows = rows[missing[rows + STEPS] == missing[rows]]
    return Starts(rows, (log.position, log.velocity, log.quaternion, log.body_rate), speed)


def errors(starts: Starts, predicted: tuple[np.ndarray, ...]) -> dict[str, np.ndarray]:
    """Norms (W, S) of the errors of a prediction, by quantity; the attitude error is the geodesic angle, rad.

    Args:
        starts: the windows.
        predicted: position, velocity, quaternion and body rate, (W, S, 3 or 4).
    """
    true = starts.ahead()
    norm = [np.linalg.norm(p - t, axis=-1) for p, t in zip(predicted, true, strict=True)]
    norm[2] = np.radians(geodesic_deg(predicted[2], true[2]))
    return dict(zip(QUANTITIES, norm, strict=True))


def metrics(error: dict[str, np.ndarray]) -> dict[str, float]:
    """Mean errors over all windows: ``<quantity>_mean_<unit>@<h>``, and their sums ``<quantity>_sum_<unit>``."""
    found = {}
    for quantity, unit in QUANTITIES.items():
        mean = error[quantity].mean(axis=0)
        found |= {f"{quantity}_mean_{unit}@{h}": float(mean[h - 1]) for h in SHOWN}
        found[f"{quantity}_sum_{unit}"] = float(mean.sum())
    return found


def naive(starts: Starts) -> tuple[np.ndarray, ...]:
    """Baseline in which the state does not change."""
    return tuple(np.repeat(x[starts.row][:, None], STEPS, axis=1) for x in starts.truth)


def hold(starts: Starts) -> tuple[np.ndarray, ...]:
    """Baseline with constant velocity and constant body rate."""
    position, velocity, quaternion, rate = naive(starts)
    time = (INTERVAL * np.arange(1, STEPS + 1))[:, None]
    return position + velocity * time, velocity, multiply(quaternion, exponential(rate * time)), rate


def physics(starts: Starts) -> tuple[np.ndarray, ...]:
    """The paper's row *physics*: thrust accelerates the drone, and the body rate is constant.

    Its rate errors equal those of *naive* to the last digit. The paper explains why: torques from squared rotor speeds
    predicted the rotation worse than no torque, so the angular acceleration is set to zero.
    """
    position, velocity, quaternion, rate = (x[starts.row] for x in starts.truth)
    half, whole = exponential(rate * (INTERVAL / 2)), exponential(rate * INTERVAL)
    found = []
    for k in range(STEPS):
        middle, quaternion = multiply(quaternion, half), multiply(quaternion, whole)
        lift = np.zeros_like(rate)
        lift[:, 2] = THRUST * np.sum(starts.rotor_speed[starts.row + k] ** 2, axis=1) / VEHICLE_MASS
        acceleration = to_world(middle, lift) - [0.0, 0.0, GRAVITY]
        position = position + INTERVAL * velocity + 0.5 * INTERVAL**2 * acceleration
        velocity = velocity + INTERVAL * acceleration
        found.append((position, velocity, quaternion, rate))
    return tuple(np.stack(x, axis=1) for x in zip(*found, strict=True))


@dataclass(frozen=True)
class Contestant:
    """A model to be judged, with an optional observer and with the sensor faults of the recording."""

    model: Quadrotor
    observer: Observer | None = None
    faults: SensorFaults = HEALTHY

    @classmethod
    def of(cls, described: ModelFile, observer: Observer | None = None, where: str = "") -> Contestant:
        """Contestant from a model file, with the sensor faults that the file lists.

        Args:
            described: the model file.
            observer: optional observer.
            where: name of the file, for messages.

        Raises:
            CfbError: effects or faults of the file are invalid.
        """
        faults = SensorFaults.from_mappings(described.effects, where or f"model {described.name}")
        return cls(Quadrotor.from_file(described), observer, faults)


def usual_contestants(model: str) -> dict[str, Contestant]:
    """Contestants for a comparison: the declared drone with the benchmark's mass, the fitted plant, and a given model.

    Args:
        model: preset or model YAML. Like the plant, it is judged with and without an observer.

    Raises:
        CfbError: the model is invalid.
    """
    declared = load_model_file(DECLARED).with_values("the benchmark's description", mass=VEHICLE_MASS)
    found = {"declared": Contestant.of(declared)}
    for name, where in {"plant": PLANT, "model": model}.items():
        described = load_model_file(where)
        found[name] = Contestant.of(described, where=where)
        found[f"{name}_observer"] = Contestant.of(described, usual_observer(described.kind), where=where)
    return found


def published_rows() -> dict[str, dict[str, float]]:
    """The results `PUBLISHED` in the paper, with the keys of `metrics`."""
    return {
        name: {f"{quantity}_sum_{unit}": x for (quantity, unit), x in zip(QUANTITIES.items(), sums, strict=True)}
        for name, sums in PUBLISHED.items()
    }


def predict(contestant: Contestant, log: FlightLog, starts: Starts):
    """Predict all windows of a flight: position, velocity, quaternion and body rate, (W, S, 3 or 4).

    In the step after row k, the rotor speeds are those of row k. A stretch of the velocity column is removed from the
    initial state and applied to the prediction, which requires earlier rows only. If the stretch affects only the
    position, its scale is estimated from the earlier rows of this flight. Lags of sensors are not corrected, because
    this would require later rows. An observer adds its estimates of disturbance and body rate at the initial row.

    Args:
        contestant: model, observer and sensor faults.
        log: the flight.
        starts: windows of the flight.
    """
    model, observer, faults = contestant.model, contestant.observer, contestant.faults
    carried = faults.stretch.memory(log.time, log.velocity)[starts.row]
    at_row, at_window = _stretch_of_flight(faults, log, starts)
    log = faults.unstretched(log) if at_row is None else log.replace(position=at_row)
    _, _, quaternion, rate = (x[starts.row] for x in starts.truth)
    position, velocity = log.position[starts.row], log.velocity[starts.row]
    began = velocity, carried
    memory = _memory(model, log, starts.row)
    if observer is not None:
        # The delay of the pose is not corrected, because this would require rows later than a window's start.
        known = jax.tree.map(lambda x: x[starts.row], observe(model, log, 0.0, observer))
        rate, memory = known.body_rate, (*memory, known.memory(rotors=False))
        model = observed_model(model, observer)
    model = Quadrotor(model.parameters, model.effects, body=model.body, integrator="rk4", rotor_loads="instant")
    inputs = starts.rotor_speed[starts.row[:, None] + np.arange(STEPS)]
    state = State(position, velocity, quaternion, rate, inputs[:, 0], memory)
    parts = []
    for first in range(0, len(starts), BLOCK):
        index = np.minimum(np.arange(first, first + BLOCK), len(starts) - 1)
        flown = _fly(model, jax.tree.map(lambda x, i=index: x[i], state), inputs[index])
        parts.append(jax.tree.map(lambda x, n=len(starts) - first: np.asarray(x)[:n], flown))
    position, velocity, quaternion, rate = jax.tree.map(lambda *x: np.concatenate(x), *parts)
    step = np.full(STEPS, INTERVAL)
    if at_window is None:
        position, velocity = faults.stretched(began, step, position, velocity)
    else:
        flown = np.concatenate([began[0][:, None], velocity], axis=1)
        position = at_window.left(position, at_window.carried(carried, step, flown)[:, 1:])
    return position, velocity, quaternion, rate


def _stretch_of_flight(faults: SensorFaults, log: FlightLog, starts: Starts) -> tuple:
    """Positions consistent with the logged velocity, and the stretch of each window, with this flight's own scale.

    The stretch depends on trajectory and height. Both are None if velocity and position are consistent, or if only the
    velocity is stretched, which affects the drone's motion and not only its logged position.
    """
    stretch = faults.stretch
    if stretch.none or faults.with_attitude is None:
        return None, None
    own = stretch.learned(log.time, log.velocity, log.position)
    memory = stretch.memory(log.time, log.velocity)
    followed = dataclasses.replace(stretch, scale=own).followed(log.position, memory)
    return followed, dataclasses.replace(stretch, scale=own[starts.row][:, None])


def _memory(model: Quadrotor, log: FlightLog, rows: np.ndarray) -> tuple:
    if not model.effects:
        return ()
    ((_, memory),) = remembered_along(model, [prepare_flight(log, 0.0, 0.0)], rows=[rows])
    return memory


@eqx.filter_jit
def _fly(model: Quadrotor, state: State, inputs):
    center = Vec.unstack(model.changed_parameters().center_of_gravity)
    prepared = prepare(model, INTERVAL)

    def one(state, inputs):
        def step(components, speed):
            components = dataclasses.replace(components, rotor_speed=speed)
            components = integrate_measured(prepared, components, speed)
            at = stack(components, center)
            return components, (at.position, at.velocity, at.quaternion, at.body_rate)

        return jax.lax.scan(step, unstack(state, center), Vec.unstack(inputs))[1]

    return jax.vmap(one)(state, inputs)


def benchmark(
    logs: Sequence[FlightLog],
    contestants: dict[str, Contestant],
    stride: int = 1,
    progress: Callable[[int, int], None] | None = None,
) -> dict:
    """Compare contestants with the baselines `naive`, `hold` and `physics` on flights.

    Args:
        logs: flights at 100 Hz with rotor speeds.
        contestants: by name.
        stride: number of rows between windows.
        progress: called with (done, total) after each flight.

    Returns:
        ``windows``, the number of windows; ``rows``, `metrics` over all windows of all flights by name; and
        ``flights``, both of these for each flight.

    Raises:
        CfbError: a log does not suit the benchmark, or none is long enough.
    """
    found: dict[str, dict[str, dict[str, np.ndarray]]] = {}
    for index, log in enumerate(logs):
        starts = find_starts(log, stride)
        if len(starts):
            simple = {"naive": naive, "hold": hold, "physics": physics}
            found[log.name] = {name: errors(starts, rule(starts)) for name, rule in simple.items()}
            for name, contestant in contestants.items():
                found[log.name][name] = errors(starts, predict(contestant, log, starts))
        if progress is not None:
            progress(index + 1, len(logs))
    if not found:
        raise CfbError(f"no flight has {STEPS + 1} rows without a gap; longer flights are needed.")

    def judged(flights) -> dict:
        rows = {
            name: metrics({q: np.concatenate([f[name][q] for f in flights]) for q in QUANTITIES}) for name in flights[0]
        }
        return {"windows": sum(len(f["naive"]["position"]) for f in flights), "rows": rows}

    return judged(list(found.values())) | {"flights": {name: judged([f]) for name, f in found.items()}}


FACTORS = (2.0, 1.5)
"""Factors of the search: levels are multiplied and divided by the first until nothing improves, then by the next."""
LEAST = 1e-3
"""Smallest decrease of the score by a step."""
HORIZON = 0.5
"""Prediction horizon of the score, s."""
STRIDE = 10
"""Number of rows between windows in `benchmark_score`."""

Level = tuple[str, int | None]
"""Name of a field of `Observer`, and the axis; None: all axes, or a field without axes."""


def levels_of(observer: Observer) -> list[Level]:
    """All levels: (field, None) for every field, and (field, axis) for each axis of fields that have axes."""
    found: list[Level] = []
    for field in dataclasses.fields(observer):
        value = getattr(observer, field.name)
        found.append((field.name, None))
        if isinstance(value, tuple):
            found += [(field.name, axis) for axis in range(len(value))]
    return found


def scaled(observer: Observer, level: Level, factor: float) -> Observer:
    """The observer with one level (one axis, or all) multiplied by a factor."""
    name, axis = level
    value = getattr(observer, name)
    if isinstance(value, tuple):
        changed = tuple(factor * x if axis is None or i == axis else x for i, x in enumerate(value))
    else:
        changed = factor * value
    return dataclasses.replace(observer, **{name: changed})


def score(
    model: Quadrotor, groups: Mapping[str, Sequence[FlightLog]], observer: Observer, faults: SensorFaults = HEALTHY
) -> float:
    """Mean logarithm of the mean attitude and velocity errors at `HORIZON`, over groups and kinds of prediction.

    Args:
        model: the drone.
        groups: flights by kind of flight; all groups have the same weight.
        observer: noise levels to judge.
        faults: of the sensors.

    Raises:
        CfbError: there is no group, or a group without a prediction window.
    """
    if not groups:
        raise CfbError("Tuning an observer needs flights.")
    logs = []
    for flights in groups.values():
        found = evaluate(model, flights, horizons=(HORIZON,), observer=observer, faults=faults, keep_diverged=True)
        for metrics in filter(None, map(found.metrics, OBSERVED)):
            logs += [metrics[f"{q}@{HORIZON:g}s"] for q in ("attitude_mean_deg", "velocity_mean_mps")]
    return float(np.mean(np.log(logs)))


def benchmark_score(
    model: Quadrotor, groups: Mapping[str, Sequence[FlightLog]], observer: Observer, faults: SensorFaults = HEALTHY
) -> float:
    """Mean logarithm of the nano-drone benchmark's sums (`cfb_mjx.sysid.nanodrone`), over groups and quantities.

    Args:
        model: the drone.
        groups: flights by kind of flight; all groups have the same weight.
        observer: noise levels to judge.
        faults: of the sensors.

    Raises:
        CfbError: there is no group, or a flight does not suit the benchmark.
    """
    if not groups:
        raise CfbError("Tuning an observer needs flights.")
    contestant = Contestant(model, observer, faults)
    logs = []
    for flights in groups.values():
        row = benchmark(flights, {"tuned": contestant}, STRIDE)["rows"]["tuned"]
        logs += [row[f"{quantity}_sum_{unit}"] for quantity, unit in QUANTITIES.items()]
    return float(np.mean(np.log(logs)))


def tune_observer(
    model: Quadrotor,
    groups: Mapping[str, Sequence[FlightLog]],
    observer: Observer | None = None,
    faults: SensorFaults = HEALTHY,
    levels: Sequence[Level] | None = None,
    factors: Sequence[float] = FACTORS,
    progress: Callable[[str], None] = lambda _: None,
    judge: Callable[..., float] = score,
) -> Observer:
    """Minimise a score over the noise levels by coordinate descent.

    Args:
        model: the drone, with the effects with which it will be used; run with x64 enabled.
        groups: flights that are not used for evaluation, by kind of flight. All groups have the same weight, so many
            gentle flights do not outweigh a few aggressive ones.
        observer: initial levels.
        faults: of the sensors.
        levels: levels to tune; by default all.
        factors: factors of the steps, the largest first.
        progress: called with a message after each accepted step.
        judge: score to minimise, `score` or `benchmark_score`.

    Raises:
        CfbError: there are no flights, or a group has no prediction window.
    """
    best = observer or Observer()
    lowest = judge(model, groups, best, faults)
    moving = levels_of(best) if levels is None else levels

    def moved(level: Level, step: float) -> bool:
        nonlocal best, lowest
        before = lowest
        while (other := judge(model, groups, tried := scaled(best, level, step), faults)) < lowest - LEAST:
            best, lowest = tried, other
            progress(f"{level[0]}{'' if level[1] is None else f'[{level[1]}]'} x {step:.3g}: {lowest:.4f}")
        return lowest < before

    for factor in factors:
        # A list rather than a generator, so that every level is tried in every round.
        while any([moved(level, factor) or moved(level, 1 / factor) for level in moving]):
            pass
    return best
