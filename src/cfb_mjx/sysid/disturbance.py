"""Disturbances estimated by an `Observer`, as an effect of a model that decays during the prediction."""

from __future__ import annotations

from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from cfb_mjx.model.effects import Condition, Effect, Memory, Motors, Wrench
from cfb_mjx.model.quadrotor import Quadrotor
from cfb_mjx.model.vector import Vec
from cfb_mjx.parameters import Parameters
from cfb_mjx.sysid.observer import Observer


class Disturbance(Effect):
    """Adds the estimates of an `Observer` to a model. It is not a physical effect and not in the catalogue.

    Its memory holds the fast and the slow angular acceleration, the specific force and the error of the steady rotor
    speeds (`Observed.memory`). Each decays with its own correlation time.
    """

    name: ClassVar[str] = "observed_disturbance"
    units: ClassVar[dict[str, str]] = {"times": "s"}
    source: ClassVar[str] = "estimated from the flight itself (cfb_mjx.sysid.observer)"
    prior: ClassVar[dict[str, tuple[float, float]]] = {}
    strengths: ClassVar[tuple[str, ...]] = ()

    times: tuple[Array, Array, Array, Array]

    @classmethod
    def of(cls, observer: Observer) -> Disturbance:
        """Disturbance with the correlation times of ``observer``."""
        o = observer
        times = o.torque_time, o.trim_time, o.force_time, o.rotor_offset_time
        torque, trim, force, rotors = (jnp.asarray(t, jnp.result_type(float)) for t in times)
        return cls((torque, trim, force, rotors))

    def start(self, rotor_speed: Vec, parameters: Parameters) -> Memory:
        zero = jnp.zeros_like(rotor_speed[0])
        return (*(Vec(zero, zero, zero) for _ in range(3)), Vec(zero, zero, zero, zero))

    def motors(
        self, motors: Motors, rotor_speed: Vec, memory: Memory, dt: Any, parameters: Parameters
    ) -> tuple[Motors, Memory]:
        return Motors(motors.target + memory[3], motors.time_constant), memory

    def body(self, wrench: Wrench, condition: Condition) -> Wrench:
        torque, trim, force, _ = condition.memory
        drone = condition.parameters
        push = force * drone.mass
        turn = Vec.unstack(drone.inertia).map(lambda inertia, a: inertia * a, torque + trim)
        # The force was measured at the rotors' centre. It must not turn the drone, because the angular accelerations
        # were estimated from the gyro, so apply it at the centre of gravity.
        return Wrench(wrench.force + push, wrench.torque + turn + Vec.unstack(drone.center_of_gravity).cross(push))

    def advance(self, condition: Condition, acceleration: Vec, dt: Any) -> Memory:
        return tuple(m * jnp.exp(-dt / time) for m, time in zip(condition.memory, self.times, strict=True))


def observed_model(model: Quadrotor, observer: Observer) -> Quadrotor:
    """The model with a `Disturbance` as its last effect."""
    return eqx.tree_at(lambda m: m.effects, model, (*model.effects, Disturbance.of(observer)))
