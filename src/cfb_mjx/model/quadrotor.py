"""The drone: rotors on a body, with effects, stepped in time."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from cfb_mjx.errors import CfbError, CfbWarning
from cfb_mjx.model import rotors
from cfb_mjx.model.bodies import Body, RigidBody
from cfb_mjx.model.effects import (
    SENSOR_FAULTS,
    Condition,
    Effect,
    Motors,
    Wind,
    Wrench,
    effect_from_mapping,
    overrides,
)
from cfb_mjx.model.effects.base import CONSTRAINT, in_order
from cfb_mjx.model.effects.inertia import Inertia
from cfb_mjx.model.integrate import END, INTEGRATORS, MIDDLE, START
from cfb_mjx.model.state import Components, State, stack, stacked, unstack
from cfb_mjx.model.vector import Vec, rotate_inverse
from cfb_mjx.parameters import SPECIFICATIONS, ModelFile, Parameters, load_model_file
from cfb_mjx.parameters.parameters import concrete, physical_inertia


class Quadrotor(eqx.Module):
    """The 17-state model (paper eqs. 1-10): a pytree of parameters and effects, plus static choices.

    Use ``jax.vmap`` over the model itself for a batch: every array in it may carry batch axes.

    Attributes:
        parameters: constants of the drone.
        effects: physical effects beyond the paper's model; their order has no influence (`Effect.rank`).
        body: `RigidBody()` (closed form, no ground, fastest) or `MjxBody()` (MuJoCo XLA, floor contact).
        dt: time between commands, s.
        substeps: integration steps per command.
        integrator: ``"leapfrog"`` (second order, free rotation fourth order), ``"euler"`` (MuJoCo's
            semi-implicit Euler, first order, for parity with MuJoCo) or ``"rk4"`` (fourth order, three times the cost).
        rotor_loads: ``"instant"`` evaluates thrust and torque at the integrator's stages; ``"mean"`` applies their
            exact impulses over each integration step (``docs/accuracy.md`` compares the two).
    """

    parameters: Parameters
    effects: tuple[Effect, ...] = ()
    body: Body = eqx.field(static=True, default_factory=RigidBody)
    dt: float = eqx.field(static=True, default=0.004)
    substeps: int = eqx.field(static=True, default=1)
    integrator: Literal["leapfrog", "euler", "rk4"] = eqx.field(static=True, default="leapfrog")
    rotor_loads: Literal["instant", "mean"] = eqx.field(static=True, default="instant")

    def __check_init__(self):
        if self.integrator not in INTEGRATORS:
            raise CfbError(f"integrator must be one of {', '.join(INTEGRATORS)}, found {self.integrator!r}.")
        if self.rotor_loads not in ("mean", "instant"):
            raise CfbError(f"rotor_loads must be 'mean' or 'instant', found {self.rotor_loads!r}.")
        if not (isinstance(self.dt, int | float) and 0 < self.dt < float("inf")):
            raise CfbError(f"dt must be a positive number of seconds, found {self.dt!r}.")
        if not (isinstance(self.substeps, int) and self.substeps >= 1):
            raise CfbError(f"substeps must be a whole number from 1, found {self.substeps!r}.")
        bound = [type(effect).name for effect in self.effects if type(effect).rank == CONSTRAINT]
        if len(bound) > 1:
            raise CfbError(f"{' and '.join(bound)} each follow from all other forces; a model can have one of them.")
        # A wind may have a conductance of its own, which acts without any other effect.
        _require_felt(self.effects, [e.name for e in self.effects if overrides(e, "air") and not overrides(e, "body")])

    @classmethod
    def from_file(cls, model: ModelFile | str | Path = "cfb-guards", **choices) -> Quadrotor:
        """Build the drone, with its effects, from a preset name, a model YAML or a loaded `ModelFile`.

        Further keyword arguments set fields of the class, such as ``body`` and ``dt``.

        Raises:
            CfbError: the file is bad (see `cfb_mjx.parameters.load_model_file`), an effect is unknown or has an
                impossible value, or the effects together make an impossible drone.

        Warns:
            CfbWarning: unusual values, or a drone that cannot hover.
        """
        model = model if isinstance(model, ModelFile) else load_model_file(model)
        where = model.path or model.name
        # Sensor faults do not change how the drone flies.
        physical = (item for item in model.effects if item.get("name") not in SENSOR_FAULTS)
        effects = tuple(effect_from_mapping(item, where, model.parameters()) for item in physical)
        _require_felt(effects, [e.name for e in effects if isinstance(e, Wind) and not np.any(e.conductance)], where)
        found = cls(parameters=model.parameters(), effects=effects, **choices)
        _require_possible(found, model, where)
        return found

    def changed_parameters(self) -> Parameters:
        """Return the parameters with the changes of all effects (payload, centre of gravity ...).

        Raises:
            CfbError: a parameter or a field of an effect is not an array or has a wrong shape.
        """
        self.parameters.require_arrays()
        for effect in self.effects:
            for field in effect.limits:
                if isinstance(value := getattr(effect, field), int | float):
                    raise CfbError(f"{effect.name}.{field} = {value!r} is not an array; put jnp.asarray(...) there.")
        parameters = self.parameters
        for i in in_order(self.effects):
            parameters = self.effects[i].change(parameters)
        return parameters

    def steps_per_command(self, control_dt_s: float) -> int:
        """Return the number of simulation steps from one command of a controller to the next.

        Args:
            control_dt_s: time between two commands, s.

        Raises:
            CfbError: the control step is not a multiple of the simulation step.
        """
        steps = control_dt_s / self.dt
        if round(steps) < 1 or abs(steps - round(steps)) > 1e-6:
            raise CfbError(f"control_dt_s = {control_dt_s} is not a multiple of the simulation step of {self.dt} s.")
        return round(steps)

    def hover_state(self, position: ArrayLike | Sequence[Any] = (0.0, 0.0, 1.0)) -> State:
        """Level state at rest at ``position`` [m] with rotors that carry the weight (forces of effects ignored)."""
        return begin(self, State.at_rest(position, rotors.hover_rotor_speed(self.changed_parameters())))

    def hover_command(self) -> Float[Array, "4"]:
        """Commands that hold `hover_state` (forces of effects ignored)."""
        return rotors.hover_command(self.changed_parameters())


def _require_possible(model: Quadrotor, described: ModelFile, where: str) -> None:
    """Refuse effects that together make an impossible drone, and warn if it cannot hover.

    The inertia of a predictor is free. The best estimate of a fitted inertia (one with an uncertainty) may be
    impossible for a rigid body; it only gives a warning.
    """
    changed = model.changed_parameters()
    if concrete(changed.mass) is None:
        return
    bodies = described.kind == "plant"
    for name, specification in SPECIFICATIONS.items():
        specification.check(getattr(changed, name), f"{where}: with its effects, parameters.{name}", together=False)
    if bodies and not physical_inertia(changed.inertia):
        moments = ", ".join(f"{x:.3g}" for x in changed.inertia.tolist())
        said = f"{where}: with its effects, parameters.inertia = [{moments}] kg m^2 is impossible for a rigid body"
        said += " (one moment is larger than the sum of the other two)"
        if not any("uncertainty" in item for item in described.effects if item.get("name") == Inertia.name):
            raise CfbError(f"{said}.")
        warnings.warn(f"{said}; the error of a fit may be that large.", CfbWarning, stacklevel=3)
    speed = changed.motor_gain + changed.motor_speed_offset
    lift, weight = float(jnp.sum(rotors.thrust(changed, speed))), float(changed.mass * changed.gravity)
    if lift < weight:
        said = f"{where}: the drone cannot hover: it weighs {weight:.3g} N, its rotors lift {lift:.3g} N at most"
        warnings.warn(f"{said}; check mass and thrust.", CfbWarning, stacklevel=3)


def _require_felt(effects: tuple[Effect, ...], blowing: list[str], where: str = "") -> None:
    """Refuse effects that only move the air in a model in which no effect depends on the air."""
    if blowing and not any(type(effect).feels_air for effect in effects):
        raise CfbError(
            f"{where and where + ': '}{', '.join(blowing)}: the air moves, but no effect of the model feels it; "
            "add rotor_drag or parasitic_drag" + (", or a conductance." if "wind" in blowing else ".")
        )


def begin(model: Quadrotor, state: State) -> State:
    """Add the memory of a long steady flight to a state without memory; other states are returned unchanged."""
    if len(state.memory) == len(model.effects):
        return state
    if len(state.memory):
        raise ValueError(f"the state remembers {len(state.memory)} effects, the model has {len(model.effects)}")
    parameters, speed = _unstacked(model.changed_parameters()), Vec.unstack(jnp.asarray(state.rotor_speed))
    memory = tuple(effect.begin(speed, parameters, model.dt / model.substeps) for effect in model.effects)
    return replace(state, memory=stacked(memory))


class Prepared(eqx.Module):
    """A model prepared for integration steps of one length."""

    model: Quadrotor
    parameters: Parameters
    """Parameters with `Vec` in place of arrays: slicing them in every step would cost more than the step."""
    rotors: rotors.RotorConstants
    body: object
    dt: Array
    wrench_once: bool = eqx.field(static=True, default=True)
    """Keep XLA from computing the wrench again for every component of the acceleration. Derivatives, which need more
    intermediate results, are faster without."""


def prepare(model: Quadrotor, dt: float | Float[Array, ""] | None = None) -> Prepared:
    """Compute once what every integration step of ``dt`` seconds (default: the model's) needs.

    Raises:
        CfbError: a parameter is not an array, or has batch axes (use `jax.vmap` over the model).
    """
    model.parameters.require_arrays(batched=False)
    dt = model.dt / model.substeps if dt is None else dt
    dt = jnp.asarray(dt, model.parameters.mass.dtype)
    parameters = _unstacked(model.changed_parameters())
    return Prepared(model, parameters, rotors.prepare(parameters, dt), model.body.prepare(parameters, dt), dt)


def _unstacked(parameters: Parameters) -> Parameters:
    leaves, structure = jax.tree.flatten(parameters)
    return jax.tree.unflatten(structure, [Vec.unstack(x) if x.ndim else x for x in leaves])


def step(model: Quadrotor, state: State, command: Float[Array, "4"]) -> State:
    """Advance the state by ``model.dt`` with a constant ``command`` (clipped to [0, 1])."""
    prepared = prepare(model)
    center = prepared.parameters.center_of_gravity
    return stack(advance(prepared, unstack(begin(model, state), center), Vec.unstack(command)), center)


def advance(prepared: Prepared, state: Components, command: Vec) -> Components:
    """`step` on components: ``substeps`` integration steps with a constant command."""
    for _ in range(prepared.model.substeps):
        state = integrate_commanded(prepared, state, command)
    return state


def integrate_commanded(prepared: Prepared, state: Components, command: Vec) -> Components:
    """One integration step of ``prepared.dt`` with a constant command."""
    path, memory = commanded_path(prepared, state.rotor_speed, state.memory, command)
    return _integrate(prepared, remembering(state, memory), path)


def commanded_path(prepared: Prepared, rotor_speed: Vec, memory: tuple, command: Vec) -> tuple[rotors.RotorPath, tuple]:
    """Path of the rotor speeds during ``prepared.dt`` with a constant command, and the new memory."""
    model, parameters, remembered = prepared.model, prepared.parameters, list(memory)
    command = command.map(lambda u: jnp.clip(u, 0.0, 1.0))
    order = in_order(model.effects)
    for i in order:
        command, remembered[i] = model.effects[i].command(command, remembered[i], prepared.dt, parameters)
    motors = Motors(rotors.steady_speed(prepared.rotors, command), Vec.unstack(parameters.motor_time_constant))
    for i in order:
        motors, remembered[i] = model.effects[i].motors(motors, rotor_speed, remembered[i], prepared.dt, parameters)
    constants = prepared.rotors
    if any(overrides(effect, "motors") for effect in model.effects):
        constants = rotors.with_time_constant(constants, motors.time_constant, prepared.dt)
    return rotors.path_to(constants, rotor_speed, motors.target), tuple(remembered)


def remembering(state: Components, memory: tuple) -> Components:
    """Replace the memory of a state."""
    return Components(state.position, state.velocity, state.quaternion, state.body_rate, state.rotor_speed, memory)


def integrate_measured(prepared: Prepared, state: Components, end_speed: Vec) -> Components:
    """One integration step with rotor speeds that change linearly from the state's to ``end_speed`` [rad/s]."""
    return _integrate(prepared, state, rotors.path_between(prepared.rotors, state.rotor_speed, end_speed))


def _integrate(prepared: Prepared, state: Components, path: rotors.RotorPath) -> Components:
    model, parameters = prepared.model, prepared.parameters
    center = Vec.unstack(parameters.center_of_gravity)
    stages = {
        START: (path.start, path.rate_start),
        MIDDLE: (path.middle, path.rate_middle),
        END: (path.end, path.rate_end),
    }

    def accelerations(at: Components, stage: int, gyroscopic: bool = True) -> tuple[Vec, Vec]:
        speed, rate = stages[stage]
        loads = path.mean if model.rotor_loads == "mean" else rotors.loads_at(prepared.rotors, speed, rate)
        wrench = loaded(model, parameters, loads, conditions(prepared, at, speed))
        if prepared.wrench_once:
            wrench = jax.lax.optimization_barrier(wrench)
        torque = wrench.torque - center.cross(wrench.force)
        return model.body.accelerations(prepared.body, at, Wrench(wrench.force, torque), gyroscopic)

    inertia = Vec.unstack(parameters.inertia)
    moved = INTEGRATORS[model.integrator](accelerations, state, prepared.dt, inertia)
    memory = state.memory
    if any(overrides(effect, "advance") for effect in model.effects):
        pushed = (moved.velocity - state.velocity) * prepared.rotors.inverse_dt
        memory = advanced(prepared, conditions(prepared, state, path.start), pushed)
    return Components(moved.position, moved.velocity, moved.quaternion, moved.body_rate, path.end, memory)


def specific_force(model: Quadrotor, state: State) -> Float[Array, "3"]:
    """Reading of an ideal accelerometer at the rotors' centre, body axes, m/s^2 (rotor speeds assumed steady)."""
    prepared = prepare(model, 0.0)
    center = prepared.parameters.center_of_gravity
    at = unstack(begin(model, state), center)
    loads = rotors.loads_at(prepared.rotors, at.rotor_speed, 0.0 * at.rotor_speed)
    wrench = loaded(model, prepared.parameters, loads, conditions(prepared, at, at.rotor_speed))
    return at_rotor_center(prepared.parameters, wrench, at.body_rate)[1].stack()


def at_rotor_center(parameters: Parameters, wrench: Wrench, body_rate: Vec) -> tuple[Vec, Vec]:
    """Angular acceleration [rad/s^2] and specific force [m/s^2] at the rotors' centre under ``wrench`` about it.

    In body axes, in free flight: the derivative of a gyro and the reading of an accelerometer there.
    """
    center, inertia = Vec.unstack(parameters.center_of_gravity), Vec.unstack(parameters.inertia)
    about = wrench.torque - center.cross(wrench.force)
    turning = (about - body_rate.cross(inertia * body_rate)) * inertia.map(lambda x: 1 / x)
    lever = -center
    # The centre of gravity accelerates with F / m; a point beside it also rotates about it.
    force = wrench.force * (1 / parameters.mass) + turning.cross(lever) + body_rate.cross(body_rate.cross(lever))
    return turning, force


def conditions(prepared: Prepared, at: Components, speed: Vec) -> tuple[Condition, ...]:
    """Flight condition for each effect: its own memory, and the air that all effects move."""
    effects = prepared.model.effects
    if not effects:
        return ()
    still = in_still_air(prepared, at, speed)
    seen = [replace(still, memory=memory) for memory in at.memory]
    blowing = [effects[i].air(seen[i]) for i in in_order(effects) if overrides(effects[i], "air")]
    if not blowing:
        return tuple(seen)
    wind = rotate_inverse(at.quaternion, sum(blowing[1:], blowing[0]))
    return tuple(replace(each, airspeed_body=still.velocity_body - wind) for each in seen)


def in_still_air(prepared: Prepared, at: Components, speed: Vec) -> Condition:
    """Flight condition in still air, without memory."""
    parameters = prepared.parameters
    center = Vec.unstack(parameters.center_of_gravity)
    velocity = rotate_inverse(at.quaternion, at.velocity) - at.body_rate.cross(center)
    return Condition(at.position, at.velocity, velocity, velocity, at.quaternion, at.body_rate, speed, parameters)


def advanced(prepared: Prepared, at: tuple[Condition, ...], acceleration: Vec) -> tuple:
    """Memory of every effect after ``prepared.dt`` seconds with this acceleration (world, m/s^2)."""
    pairs = zip(prepared.model.effects, at, strict=True)
    return tuple(effect.advance(condition, acceleration, prepared.dt) for effect, condition in pairs)


def followed(prepared: Prepared, at: tuple[Condition, ...], acceleration: Vec, missed: Vec) -> tuple:
    """`advanced` along a log: measured acceleration, and the part of it that the model misses (world, m/s^2)."""
    pairs = zip(prepared.model.effects, at, strict=True)
    return tuple(effect.follow(condition, acceleration, missed, prepared.dt) for effect, condition in pairs)


def loaded(model: Quadrotor, parameters: Parameters, loads: rotors.RotorLoads, conditions: tuple) -> Wrench:
    """Wrench of the rotors and of every effect about the rotors' centre, body axes."""
    order = in_order(model.effects)
    for i in order:
        loads = model.effects[i].rotors(loads, conditions[i])
    wrench = wrench_of(parameters, loads)
    for i in order:
        wrench = model.effects[i].body(wrench, replace(conditions[i], loads=loads))
    return wrench


def wrench_of(parameters: Parameters, loads: rotors.RotorLoads) -> Wrench:
    """Sum the rotors' loads about their centre (paper eqs. 6-7), body axes."""
    thrust = loads.thrust
    half = parameters.rotor_spacing / 2
    reaction = loads.torque + parameters.rotor_inertia * loads.rate
    return Wrench(
        force=Vec(0.0, 0.0, thrust.sum()),
        torque=Vec(
            half * thrust.dot(rotors.POSITION_SIGNS_Y),
            -half * thrust.dot(rotors.POSITION_SIGNS_X),
            reaction.dot(rotors.YAW_SIGNS),
        ),
    )
