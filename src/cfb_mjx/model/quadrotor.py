"""The drone: rotors on a body, with effects, stepped in time."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from cfb_mjx.errors import CfbError
from cfb_mjx.model import rotors
from cfb_mjx.model.bodies import Body, RigidBody
from cfb_mjx.model.effects import Condition, Effect, Wrench, effect_from_mapping
from cfb_mjx.model.integrate import END, INTEGRATORS, MIDDLE, START
from cfb_mjx.model.state import Components, State, stack, unstack
from cfb_mjx.model.vector import Vec, rotate_inverse
from cfb_mjx.parameters import ModelFile, Parameters, load_model_file


class Quadrotor(eqx.Module):
    """The 17-state model (paper eqs. 1-10): a pytree of parameters and effects plus static choices.

    Batch it with ``vmap`` over itself: every array in it may carry batch axes.

    Attributes:
        parameters: constants.
        effects: physical effects beyond the paper's model, applied in order.
        body: `RigidBody()` (closed form, no ground, fastest) or `MjxBody()` (MuJoCo XLA, floor contact).
        dt: time between commands, s.
        substeps: integration steps per command.
        integrator: ``"euler"`` (MuJoCo's semi-implicit Euler, the parity reference) or ``"rk4"``.
        rotor_loads: ``"instant"`` evaluates thrust and torque at the integrator's stages; ``"mean"`` applies their
            exact impulses over each integration step (``docs/accuracy.md`` says what that buys).
    """

    parameters: Parameters
    effects: tuple[Effect, ...] = ()
    body: Body = eqx.field(static=True, default_factory=RigidBody)
    dt: float = eqx.field(static=True, default=0.004)
    substeps: int = eqx.field(static=True, default=1)
    integrator: Literal["euler", "rk4"] = eqx.field(static=True, default="euler")
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

    @classmethod
    def from_file(cls, model: ModelFile | str | Path = "cfb-guards", **choices) -> Quadrotor:
        """From a preset name, a model YAML or a loaded `ModelFile`, with its effects.

        Raises:
            CfbError: as `cfb_mjx.parameters.load_model_file`, or an unknown effect.
        """
        where = str(model) if not isinstance(model, ModelFile) else model.name
        model = model if isinstance(model, ModelFile) else load_model_file(model)
        effects = tuple(effect_from_mapping(item, where) for item in model.effects)
        return cls(parameters=model.parameters(), effects=effects, **choices)

    def hover_state(self, position=(0.0, 0.0, 1.0)) -> State:
        """Level and motionless at ``position`` [m], rotors carrying the weight (effects not considered)."""
        return State.at_rest(position, rotors.hover_rotor_speed(self.parameters))

    def hover_command(self) -> Float[Array, "4"]:
        """Commands that hold `hover_state` (effects not considered)."""
        return rotors.hover_command(self.parameters)


class Prepared(eqx.Module):
    """A model made ready for steps of one length."""

    model: Quadrotor
    parameters: Parameters
    """With `Vec` in place of arrays: slicing them anew in every step would cost more than the step."""
    rotors: rotors.RotorConstants
    body: object
    dt: Array


def prepare(model: Quadrotor, dt: float | Float[Array, ""] | None = None) -> Prepared:
    """Compute once what every integration step of ``dt`` seconds (default: the model's) needs."""
    dt = model.dt / model.substeps if dt is None else dt
    dt = jnp.asarray(dt, model.parameters.mass.dtype)
    parameters = _unstacked(model.parameters)
    return Prepared(model, parameters, rotors.prepare(parameters, dt), model.body.prepare(parameters, dt), dt)


def _unstacked(parameters: Parameters) -> Parameters:
    leaves, structure = jax.tree.flatten(parameters)
    return jax.tree.unflatten(structure, [Vec.unstack(x) if x.ndim else x for x in leaves])


def step(model: Quadrotor, state: State, command: Float[Array, "4"]) -> State:
    """Advance by ``model.dt`` with ``command`` (clipped to [0, 1]) held."""
    prepared = prepare(model)
    center = prepared.parameters.center_of_gravity
    return stack(advance(prepared, unstack(state, center), Vec.unstack(command)), center)


def advance(prepared: Prepared, state: Components, command: Vec) -> Components:
    """`step` on components: ``substeps`` integration steps with the command held."""
    for _ in range(prepared.model.substeps):
        state = integrate_commanded(prepared, state, command)
    return state


def integrate_commanded(prepared: Prepared, state: Components, command: Vec) -> Components:
    """One integration step of ``prepared.dt`` with the command held."""
    model = prepared.model
    command = command.map(lambda u: jnp.clip(u, 0.0, 1.0))
    for effect in model.effects:
        command = effect.command(command, prepared.parameters)
    target = rotors.steady_speed(prepared.rotors, command)
    return _integrate(prepared, state, rotors.path_to(prepared.rotors, state.rotor_speed, target))


def integrate_measured(prepared: Prepared, state: Components, end_speed: Vec) -> Components:
    """One integration step with rotor speeds going straight from the state's to ``end_speed`` [rad/s]."""
    return _integrate(prepared, state, rotors.path_between(prepared.rotors, state.rotor_speed, end_speed))


def _integrate(prepared: Prepared, state: Components, path: rotors.RotorPath) -> Components:
    model, parameters = prepared.model, prepared.parameters
    stages = {
        START: (path.start, path.rate_start),
        MIDDLE: (path.middle, path.rate_middle),
        END: (path.end, path.rate_end),
    }

    def accelerations(at: Components, stage: int) -> tuple[Vec, Vec]:
        speed, rate = stages[stage]
        loads = path.mean if model.rotor_loads == "mean" else rotors.loads_at(prepared.rotors, speed, rate)
        if model.effects:
            condition = Condition(
                at.position,
                at.velocity,
                rotate_inverse(at.quaternion, at.velocity) - at.body_rate.cross(parameters.center_of_gravity),
                at.quaternion,
                at.body_rate,
                speed,
                parameters,
            )
            for effect in model.effects:
                loads = effect.rotors(loads, condition)
        wrench = wrench_of(parameters, loads)
        for effect in model.effects:
            wrench = effect.body(wrench, condition)
        # Every component of the acceleration needs the wrench; without the barrier XLA recomputes it for each.
        wrench = jax.lax.optimization_barrier(wrench)
        about_center = Wrench(wrench.force, wrench.torque - parameters.center_of_gravity.cross(wrench.force))
        return model.body.accelerations(prepared.body, at, about_center)

    moved = INTEGRATORS[model.integrator](accelerations, state, prepared.dt)
    return Components(moved.position, moved.velocity, moved.quaternion, moved.body_rate, path.end)


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
