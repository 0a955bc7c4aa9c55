"""Land the shipped policy `track` on a platform that moves, in a scene with contacts.

    python examples/landing.py [--flights 32] [--seed 0] [--write FILE.json]

The target is the platform's path plus a descent (`cfb_mjx.train.landing.Descent`), and the policy sees ahead along it.
The motors stop when the estimates say that the drone has touched down; then friction alone keeps it on the platform.
Not simulated: the cushion of air above the platform (the effect `ground_effect` knows the floor alone), and noise of
the estimates, which are 8 ms late. About a minute on two cores.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from cfb_mjx.control import find_controller
from cfb_mjx.envs import StateEstimate
from cfb_mjx.envs.path import Harmonics, derivative
from cfb_mjx.files import write_json
from cfb_mjx.model import Quadrotor, Scene, State
from cfb_mjx.model.scene import SceneState
from cfb_mjx.runtime import configure_jax, environment
from cfb_mjx.train.flight import Flight
from cfb_mjx.train.landing import LANDING_S, Lander, Landing, drawn, touch_down

PLATFORM = Path(__file__).with_name("platform.xml")
HEIGHT_M = 0.5
"""Height of the platform's top above the floor, in the mean."""


def platform_path(circle_m: float = 0.0, heave_m: float = 0.0, rate_radps: float = 1.0, ramp_s: float = 2.0):
    """Path of the middle of the platform's top, from rest.

    Args:
        circle_m: radius of its circle, m.
        heave_m: amplitude of its height, which changes twice in a circle, m.
        rate_radps: rate of the circle, rad/s.
        ramp_s: duration of its beginning, during which it gathers speed, s.
    """
    sine = jnp.array([[circle_m, 0.0, 0.0], [0.0, 0.0, heave_m]])
    cosine = jnp.array([[0.0, circle_m, 0.0], [0.0, 0.0, 0.0]])
    path = Harmonics(jnp.asarray(rate_radps), sine, cosine, jnp.asarray(ramp_s))
    return lambda time: path(time) + jnp.array([0.0, 0.0, HEIGHT_M])


CIRCLE_M, HEAVE_M, RATE_RADPS = 0.5, 0.1, 1.0
RIDES = {
    "circle": platform_path(CIRCLE_M, 0.0, RATE_RADPS),
    "heave": platform_path(0.0, HEAVE_M, RATE_RADPS),
    "both": platform_path(CIRCLE_M, HEAVE_M, RATE_RADPS),
}
"""A circle at 0.5 m/s, heights that change at up to 0.2 m/s, and both."""


def moved(world: SceneState, platform, time: Float[Array, ""]) -> SceneState:
    """The world with the platform where it is at a time, and as fast: between two commands it goes on at that speed."""
    return replace(world, positions=platform(time), velocities=derivative(platform)(time))


def landed(platform, scene: Scene, controller, drone: Quadrotor, key: PRNGKeyArray) -> Flight:
    """Land once, from a start drawn by ``key``; positions and velocities are relative to the platform."""
    dt, horizons = controller.control_dt_s, jnp.asarray(controller.layout.preview_s)
    hold, descent = drone.steps_per_command(dt), drawn(key)

    def path(time):
        return platform(time) + descent(time)

    def seen(state: State, target: Array) -> StateEstimate:
        return StateEstimate(state.position - target, state.velocity, state.quaternion, state.body_rate)

    lander = Lander(controller, path, lambda time: platform(time) + descent.pad, descent.end_s)

    def one(carry, time):
        world, before, memory = carry
        target = path(time)
        ahead = jax.vmap(path)(time + horizons) - target
        memory, command = lander.command(memory, seen(before, target), ahead.reshape(-1))
        command = jnp.where(Lander.stopped(memory), 0.0, command)
        after = scene.rollout(drone, moved(world, platform, time), command[None], hold=hold)
        after = jax.tree.map(lambda x: x[0], after)
        now, later = after.drone, time + dt
        position, velocity = now.position - platform(later), now.velocity - derivative(platform)(later)
        row = Flight(position, velocity, now.quaternion, now.body_rate, command, jnp.asarray(False), descent(later))
        return (after, world.drone, memory), row

    zero = jnp.zeros(())
    start = drone.hover_state(path(zero))
    memory = lander.start(seen(start, path(zero)), drone.hover_command())
    first = scene.begin(drone, start), start, memory
    return jax.lax.scan(one, first, dt * jnp.arange(round(LANDING_S / dt)))[1]


def summary(found: Landing) -> dict[str, float]:
    """Share that landed, and medians and largest values, for JSON."""
    return {
        "landed": float(np.mean(found.landed)),
        "vertical_speed_mps": float(np.nanmedian(found.vertical_speed_mps)),
        "largest_vertical_speed_mps": float(np.nanmax(found.vertical_speed_mps)),
        "horizontal_speed_mps": float(np.nanmedian(found.horizontal_speed_mps)),
        "distance_mm": 1e3 * float(np.median(found.distance_m)),
        "largest_distance_mm": 1e3 * float(np.max(found.distance_m)),
    }


def main() -> None:
    """Land on every platform, and print how it went."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--flights", type=int, default=32, help="landings on each platform")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--write", type=Path, help="JSON file for the results")
    arguments = parser.parse_args()
    configure_jax(x64=False)
    drone = Quadrotor.from_file("cfb-guards", dt=0.002)
    controller, scene = find_controller("track", drone), Scene(PLATFORM, engine="c")
    keys = jax.random.split(jax.random.PRNGKey(arguments.seed), arguments.flights)
    results = {"environment": environment(), "flights": arguments.flights, "seed": arguments.seed, "on": {}}
    for name, platform in RIDES.items():
        flown = jax.jit(jax.vmap(partial(landed, platform, scene, controller, drone)))(keys)
        one = summary(touch_down(flown, controller.control_dt_s))
        results["on"][name] = one
        print(
            f"{name}: {one['landed']:.0%} of {arguments.flights} landed; relative to the platform they touched it at "
            f"{one['vertical_speed_mps']:.2f} m/s (at most {one['largest_vertical_speed_mps']:.2f}) downwards and "
            f"{one['horizontal_speed_mps']:.2f} m/s sideways, and rest {one['distance_mm']:.0f} mm (at most "
            f"{one['largest_distance_mm']:.0f}) from its middle"
        )
    if arguments.write is not None:
        write_json(arguments.write, results)


if __name__ == "__main__":
    main()
