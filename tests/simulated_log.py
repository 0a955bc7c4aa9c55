"""A flight that the model itself makes, for tests that need some log and do not care which."""

from __future__ import annotations

import numpy as np

from cfb_mjx.logs import FlightLog

MODEL = "cfb-guards"


def simulated_log(seconds: float = 4.0, drone=None) -> FlightLog:
    """A flight of the declared model itself or another `Quadrotor`, without noise: a hover with gentle swings."""
    import jax
    import jax.numpy as jnp

    from cfb_mjx.model import Quadrotor, specific_force, step

    drone = drone or Quadrotor.from_file(MODEL)
    delay = round(float(drone.parameters.pose_delay) / drone.dt)
    signs = jnp.array([[-1.0, -1, 1, 1], [-1, 1, 1, -1], [-1, 1, -1, 1]])

    def command(t, state):
        """Attitude follows slow sines and resists drift; height is held. Gains: command per rad, rad/s, m and m/s."""
        q, v = state.quaternion, state.velocity
        target = 0.15 * jnp.sin(jnp.array([2.5, 1.9, 0.8]) * t) + 0.1 * jnp.array([v[1], -v[0], 0.0])
        turn = jnp.array([0.08, 0.08, 0.2]) * (target - 2 * q[1:]) - jnp.array([0.02, 0.02, 0.1]) * state.body_rate
        return drone.hover_command() + 0.3 * (1.0 - state.position[2]) - 0.25 * v[2] + turn @ signs

    def fly(state, t):
        sent = jnp.clip(command(t, state), 0.0, 1.0)
        return step(drone, state, sent), (state, sent)

    instants = drone.dt * jnp.arange(round(seconds / drone.dt) + delay)
    _, (flown, sent) = jax.jit(lambda state: jax.lax.scan(fly, state, instants))(drone.hover_state())
    specific = jax.jit(jax.vmap(lambda state: specific_force(drone, state)))(flown)
    late, now = slice(0, len(instants) - delay), slice(delay, None)
    return FlightLog(
        time=drone.dt * np.arange(len(instants) - delay),
        position=flown.position[late],
        velocity=flown.velocity[late],
        quaternion=flown.quaternion[late],
        body_rate=flown.body_rate[now],
        specific_force=specific[now],
        command=sent[now],
        rotor_speed=flown.rotor_speed[now],
        metadata={"name": "simulated", "source": "tests", "observation_delay": delay * drone.dt},
    )


def noisy(log: FlightLog, seed: int, name: str) -> FlightLog:
    """The log as sensors would have it."""
    rng = np.random.default_rng(seed)

    def some(values, size):
        return values + size * rng.standard_normal(values.shape)

    return log.replace(
        position=some(log.position, 4e-4),
        velocity=some(log.velocity, 4e-3),
        body_rate=some(log.body_rate, 0.015),
        specific_force=some(log.specific_force, 0.2),
        metadata=dict(log.metadata) | {"name": name},
    )
