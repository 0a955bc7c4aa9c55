"""The same fit by `mujoco.sysid`: MuJoCo C simulates, finite differences give the Jacobian.

What is MuJoCo's: the rigid body (``assets/cfb.xml`` without floor, RK4 at 2 ms), the geometry that turns a force at a
rotor into a moment (one site per rotor), finite differences, optimiser and intervals. MuJoCo's actuators are affine in
their activation, so they cannot carry a cubic thrust curve: the motor model is evaluated here, in NumPy, from the
logged commands and the candidate's time constant (``custom_rollout`` of `mujoco.sysid`), and every rotor has three
actuators that receive its thrust, its aerodynamic torque and its acceleration. J_m is the gain of the last.

Nothing here uses the library's model or its identification; of `mujoco.sysid` only the public interface is used.
"""

from __future__ import annotations

import dataclasses
import io
from dataclasses import dataclass

import mujoco
import numpy as np
from mujoco import sysid
from open_loop import DELAY_ROWS, HOVER, MANOEUVRE, NOISE
from plant import HALF, SIGMA, THRUST, TORQUE, cubic
from scipy.signal import lfilter

from cfb_mjx.files import shipped
from cfb_mjx.logs import FlightLog

STEP = 0.002
NAMES = ("inertia_xx", "inertia_yy", "inertia_zz", "rotor_inertia", "motor_time_constant")
GAIN = 2900.0
NOMINAL = np.array([3.3e-5, 3.6e-5, 5.9e-5, 5e-8, 0.05])
"""Where the fit starts, in the order of NAMES: the paper's drone."""
# The inertia is fitted through its second moments a, b, c (J_xx = b + c ...): no step can leave the possible bodies,
# which MuJoCo would refuse to compile. All numbers are ratios to the start, because the step of the finite differences
# is absolute.
_MOMENTS = 0.5 * NOMINAL[:3].sum() - NOMINAL[:3]
_SUMS = np.ones((3, 3)) - np.eye(3)
_RATIOS = ("moment_x", "moment_y", "moment_z", "rotor_inertia", "motor_time_constant")


@dataclass(frozen=True)
class MujocoFit:
    """Result of `fit`, in the order of NAMES, SI."""

    values: np.ndarray
    std: np.ndarray
    interval: np.ndarray
    """Half-width of the 95 % confidence intervals."""
    evaluations: int
    """Rollouts of the whole data set."""


@dataclass(frozen=True)
class Piece:
    """A stretch of flight to be predicted: from a state at a row, compared at later rows."""

    log: FlightLog
    start: int
    state: np.ndarray
    """(13,) position, quaternion, velocity, body rate: MuJoCo's order of a free joint."""
    rows: np.ndarray
    noise: np.ndarray
    """(12,) what the errors of position, velocity, attitude and body rate are divided by."""


def windows(logs: list[FlightLog]) -> list[Piece]:
    """The shooting fit's windows: from the measured state at 0.6, 0.8 and 1.0 s, compared every 20 ms up to 200 ms."""
    pieces = []
    for log in logs:
        noise = _noise(log)
        for time in (0.6, 0.8, 1.0):
            start = int(np.searchsorted(log.time, time - 1e-6))
            pose = [x[start + DELAY_ROWS] for x in (log.position, log.quaternion, log.velocity)]
            state = np.concatenate([*pose, log.body_rate[start]])
            rows = start + np.rint(0.02 * np.arange(1, 11) / log.nominal_interval).astype(int)
            pieces.append(Piece(log, start, state, rows, noise))
    return pieces


def _noise(log: FlightLog) -> np.ndarray:
    """Of a window's errors, whose two ends both carry the sensors' noise, from third differences of the log."""
    signals = (log.position, log.velocity, 2 * log.quaternion[:, 1:], log.body_rate)
    third = np.concatenate([np.diff(x, n=3, axis=0) for x in signals], axis=1)
    # Median absolute deviation of a Gaussian; a third difference has the variance 1 + 9 + 9 + 1.
    return np.sqrt(2.0) * 1.4826 * np.median(np.abs(third), axis=0) / np.sqrt(20.0)


def whole_manoeuvres(logs: list[FlightLog]) -> list[Piece]:
    """Every manoeuvre in one piece and every row of it, from a start known without noise: hover at rest."""
    noise = np.repeat([NOISE[name] for name in ("position", "velocity", "attitude", "body_rate")], 3)
    at_rest = np.array([0, 0, 1.0, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0])
    pieces = []
    for log in logs:
        start = int(np.searchsorted(log.time, HOVER - 1e-6))
        rows = start + 1 + np.arange(round((MANOEUVRE + 0.1) / log.nominal_interval))
        pieces.append(Piece(log, start, at_rest, rows, noise))
    return pieces


def fit(pieces: list[Piece], optimizer: str = "mujoco") -> MujocoFit:
    """Fit NAMES to the pieces."""
    spec = specification()
    model = spec.compile()
    count = [0]

    def modify_residual(params, predicted, measured, model, return_all, state, **_):
        piece = pieces[round(measured.times[0])]
        path = state[np.rint((piece.rows - piece.start) * piece.log.nominal_interval / STEP).astype(int) - 1, 1:14]
        return residual(piece, path).ravel(), measured, measured

    def custom_rollout(models, datas, control_signal, initial_states, param_dicts, **_):
        count[0] += len(models)
        loads = [
            sysid.TimeSeries(*rotor_loads(c, p["motor_time_constant"].value[0] * NOMINAL[4], s[0]))
            for c, s, p in zip(control_signal, initial_states, param_dicts, strict=True)
        ]
        return sysid.sysid_rollout(models, datas, loads, initial_states)

    sequences = sysid.ModelSequences(
        "cfb",
        spec,
        [f"piece{i}" for i in range(len(pieces))],
        [_initial(model, piece) for piece in pieces],
        # All the commands since the log began: those before the piece tell the rotor speeds at its start.
        [sysid.TimeSeries(p.log.time[: p.rows[-1] + 1], np.tile(p.log.command[: p.rows[-1] + 1], 3)) for p in pieces],
        # The residual reads the measurements from the log; the time says which piece it is about.
        [sysid.TimeSeries(np.array([float(i)]), np.zeros((1, model.nsensordata))) for i in range(len(pieces))],
    )
    residual_fn = sysid.build_residual_fn(
        models_sequences=[sequences],
        modify_residual=modify_residual,
        custom_rollout=custom_rollout,
        resample_true=False,
    )
    # At its default of 1e-8 the optimiser goes on searching in the noise of its finite differences, with four times
    # the evaluations and the same result.
    # Its progress goes to standard output; keep that clear.
    options = {"xtol": 1e-6, **({"output": io.StringIO()} if optimizer == "mujoco" else {})}
    found, result = sysid.optimize(parameters(), residual_fn, optimizer=optimizer, verbose=False, **options)
    at_end, _, _ = residual_fn(result.x, found)
    covariance, interval = sysid.calculate_intervals(at_end, np.asarray(result.jac))
    # From ratios of second moments to moments of inertia: linear.
    change = np.zeros((5, 5))
    change[:3, :3] = _SUMS * _MOMENTS
    change[3, 3], change[4, 4] = NOMINAL[3:]
    std = np.sqrt(np.diag(change @ covariance @ change.T))
    quantile = interval[3] / np.sqrt(covariance[3, 3])
    return MujocoFit(change @ result.x, std, quantile * std, count[0] // len(pieces))


def residual(piece: Piece, path: np.ndarray) -> np.ndarray:
    """(rows, 12) errors over the sensors' noise of a predicted ``path`` (rows, 13) in MuJoCo's order."""
    log, rows = piece.log, piece.rows
    late = rows + DELAY_ROWS
    turn = [np.zeros(3) for _ in rows]
    for out, ahead, measured in zip(turn, path[:, 3:7], log.quaternion[late], strict=True):
        mujoco.mju_subQuat(out, ahead, measured)
    errors = (
        path[:, :3] - log.position[late],
        path[:, 7:10] - log.velocity[late],
        np.array(turn),
        path[:, 10:13] - log.body_rate[rows],
    )
    return np.concatenate(errors, axis=1) / piece.noise


def specification() -> mujoco.MjSpec:
    """``assets/cfb.xml`` without its floor and visuals, with three actuators for each rotor."""
    spec = mujoco.MjSpec.from_string(shipped("assets", "cfb.xml").read_text(encoding="utf-8"))
    for geom in list(spec.geoms):
        spec.delete(geom)
    spec.option.timestep = STEP
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_RK4
    body = spec.body("cfb")
    corners = ((HALF, -HALF), (-HALF, -HALF), (-HALF, HALF), (HALF, HALF))
    for i, (x, y) in enumerate(corners, 1):
        body.add_site(name=f"rotor{i}", pos=[x, y, 0.0])
    for what, gear in (("thrust", (0, 0, 1, 0, 0, 0)), ("drag", (0, 0, 0, 0, 0, 1)), ("spin", (0, 0, 0, 0, 0, 1))):
        for i in range(1, 5):
            # Rotors 1 and 3 push the body clockwise.
            sign = 1.0 if what == "thrust" or i in (2, 4) else -1.0
            actuator = spec.add_actuator(name=f"{what}{i}", target=f"rotor{i}", trntype=mujoco.mjtTrn.mjTRN_SITE)
            actuator.gear = sign * np.array(gear, dtype=float)
    return spec


def parameters() -> sysid.ParameterDict:
    """The unknowns as ratios to the start."""
    found = sysid.ParameterDict()

    def moment(axis):
        def write(spec, parameter):
            moments = np.array(found_moments(spec))
            moments[axis] = parameter.value[0] * _MOMENTS[axis]
            spec.body("cfb").inertia = _SUMS @ moments

        return write

    def found_moments(spec):
        inertia = np.array(spec.body("cfb").inertia)
        return 0.5 * inertia.sum() - inertia

    def spin(spec, parameter):
        for i in range(1, 5):
            spec.actuator(f"spin{i}").gainprm[0] = parameter.value[0] * NOMINAL[3]

    # The time constant acts in the motor model of the rollout, not in the MJCF.
    writers = (moment(0), moment(1), moment(2), spin, None)
    for name, writer in zip(_RATIOS, writers, strict=True):
        low, high = (0.01, 20.0) if name.startswith("moment") else (0.2, 5.0)
        found.add(sysid.Parameter(name, 1.0, low, high, modifier=writer))
    return found


def rotor_loads(given: sysid.TimeSeries, lag: float, start: float) -> tuple[np.ndarray, np.ndarray]:
    """Step times and (steps, 12) thrust [N], aerodynamic torque [N m] and acceleration [rad/s^2] of the rotors.

    First-order lag solved exactly between rows, means over each MuJoCo step by Simpson's rule. The log begins in steady
    state; ``start`` is the time of the first step.
    """
    interval = given.times[1] - given.times[0]
    per_row = round(interval / STEP)
    target = np.repeat(GAIN * given.data[:, :4], 2 * per_row, axis=0)
    # Speeds at every half step: x[k + 1] = decay x[k] + (1 - decay) target[k].
    decay = np.exp(-0.5 * STEP / lag)
    away = lfilter([0.0, 1.0 - decay], [1.0, -decay], target - target[0], axis=0)
    speed = (away + target[0])[2 * per_row * round(start / interval) :]
    steps = (len(speed) - 1) // 2
    first, middle, last = speed[0 : 2 * steps : 2], speed[1 : 2 * steps : 2], speed[2 : 2 * steps + 1 : 2]

    def mean(coefficients, floor):
        values = (np.maximum(cubic(coefficients, x / SIGMA), floor) for x in (first, middle, last))
        return np.tensordot([1 / 6, 4 / 6, 1 / 6], np.array(list(values)), axes=1)

    loads = np.concatenate([mean(THRUST, 0.0), mean(TORQUE, -np.inf), (last - first) / STEP], axis=1)
    return start + STEP * np.arange(steps), loads


def _initial(model: mujoco.MjModel, piece: Piece) -> np.ndarray:
    state = sysid.create_initial_state(model, piece.state[:7], piece.state[7:])
    state[0] = piece.log.time[piece.start]
    return state


def in_si(result: MujocoFit) -> dict[str, dict[str, float]]:
    """Values by name, for JSON."""
    rows = (dataclasses.asdict(result)[key] for key in ("values", "std", "interval"))
    return {
        name: {"value": float(v), "std": float(s), "interval_95": float(w)}
        for name, v, s, w in zip(NAMES, *rows, strict=True)
    }
