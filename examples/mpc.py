"""Model-predictive control through the differentiable model, on a figure eight.

    python examples/mpc.py [--lap-s 2] [--flights 2] [--model cfb-guards] [--write FILE.json]

Every 16 ms, `Mpc` finds the commands of the next third of a second with which the model follows the path best:
nonlinear least squares by optimistix, whose Jacobian is that of the simulator. It sees what policies see (late, noisy
estimates), and knows the model exactly, so it is a baseline for them. Give ``--model`` a model of your own, fitted to
your drone. Without a path it flies to its target: docs/controllers.md compares it with other controllers.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

from cfb_mjx.envs import Layout, StateEstimate, TargetTask, figure_eight
from cfb_mjx.files import write_json
from cfb_mjx.model import Quadrotor, State, rollout, rollout_final
from cfb_mjx.runtime import configure_jax, environment
from cfb_mjx.train.tracking import track

DT_S, STEPS = 0.016, 20
"""Time between two commands, and number of commands that are planned."""
ACCELERATION_MPS2, BRAKING_MPS2, SETTLING_S = 10.0, 5.0, 0.1
"""Of the way to a target at rest: accelerations, and the time constant of its end."""


class Plan(NamedTuple):
    """Memory between two commands."""

    commands: Float[Array, "steps 4"]
    rotor_speed: Float[Array, "4"]
    """Rotor speeds that the model predicts; nobody measures them."""
    last: Float[Array, "4"]
    """The last command."""


class Mpc(eqx.Module):
    """A controller that plans with a model; it flies to targets, and along paths that it sees ahead.

    Attributes:
        model: the drone, in the controller's opinion.
        late: delay of the estimates, in steps of the model.
        layout: what it sees: where the target will be after each of its commands.
    """

    model: Quadrotor
    late: int = eqx.field(static=True)
    layout: Layout = eqx.field(static=True)

    @classmethod
    def of(cls, model: Quadrotor) -> Mpc:
        """Return the controller of a drone."""
        ahead = tuple(round(DT_S * (i + 1), 6) for i in range(STEPS))
        late = max(1, round(float(model.parameters.pose_delay) / model.dt))
        return cls(model, late, Layout(control_dt_s=DT_S, preview_s=ahead, past_estimates=0, past_commands=0))

    @property
    def control_dt_s(self) -> float:
        """Time between two commands, s."""
        return DT_S

    def start(self, estimate: StateEstimate, command: Float[Array, "4"]) -> Plan:
        """Return the memory of a drone that hovers."""
        command = jnp.asarray(command)
        return Plan(jnp.tile(command, (STEPS, 1)), self.model.hover_state().rotor_speed, command)

    def command(
        self, memory: Plan, estimate: StateEstimate, ahead: Float[Array, " shown"] | None = None
    ) -> tuple[Plan, Float[Array, "4"]]:
        """Return the new memory and the first command of the best plan."""
        seen = State(estimate.position, estimate.velocity, estimate.quaternion, estimate.body_rate, memory.rotor_speed)
        # The estimate is late; meanwhile the last command was flown.
        past = rollout_final(self.model, seen, jnp.tile(memory.last, (self.late, 1)))
        now = replace(past, rotor_speed=memory.rotor_speed)
        wanted = (
            _approach(jnp.asarray(now.position), jnp.asarray(now.velocity))
            if ahead is None
            else ahead.reshape(STEPS, 3)
        )
        hold = self.model.steps_per_command(DT_S)

        def residuals(change, plan):
            commands = jnp.clip(plan + change, 0.0, 1.0)
            flown = rollout(self.model, now, commands, hold=hold)
            steps = jnp.diff(commands, axis=0, prepend=memory.last[None])
            outside = plan + change - commands
            heading = flown.quaternion[:, 3]
            return (flown.position - wanted) / 0.02, 0.02 * flown.body_rate, heading, 4.0 * steps, 20.0 * outside

        # The default, a QR of the Jacobian, needs twice the operations; the flights are the same.
        solver = optx.LevenbergMarquardt(rtol=1e-2, atol=1e-2, linear_solver=lx.Normal(lx.Cholesky()))
        zero = jnp.zeros_like(memory.commands)
        found = optx.least_squares(residuals, solver, zero, args=memory.commands, max_steps=10, throw=False)
        commands = jnp.clip(memory.commands + found.value, 0.0, 1.0)
        after = rollout_final(self.model, now, commands[:1], hold=hold)
        plan = jnp.concatenate([commands[1:], commands[-1:]])
        return Plan(plan, after.rotor_speed, commands[0]), commands[0]


def _approach(position: Float[Array, "3"], velocity: Float[Array, "3"]) -> Float[Array, "steps 3"]:
    """Where a drone should be after each command on its way to a target at rest, which it can brake in time for."""

    def one(moving, _):
        position, velocity = moving
        distance = jnp.linalg.norm(position)
        speed = jnp.minimum(jnp.sqrt(2 * BRAKING_MPS2 * distance), distance / SETTLING_S)
        change = -speed * position / jnp.maximum(distance, 1e-6) - velocity
        most = ACCELERATION_MPS2 * DT_S
        velocity = velocity + change * jnp.minimum(1.0, most / jnp.maximum(jnp.linalg.norm(change), 1e-6))
        position = position + DT_S * velocity
        return (position, velocity), position

    return jax.lax.scan(one, (position, velocity), None, length=STEPS)[1]


def main() -> None:
    """Fly, and print how well and how fast."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--lap-s", type=float, default=2.0)
    parser.add_argument("--flights", type=int, default=2)
    parser.add_argument("--model", default="cfb-guards", help="preset or model YAML that flies and plans")
    parser.add_argument("--write", type=Path, help="JSON file for the results")
    arguments = parser.parse_args()
    configure_jax(x64=False)
    drone = Quadrotor.from_file(arguments.model)
    keys = jax.random.split(jax.random.PRNGKey(0), arguments.flights)
    begun = time.perf_counter()
    measured, flown = track(Mpc.of(drone), TargetTask(), drone, keys, figure_eight(2.0, arguments.lap_s))
    jax.block_until_ready(flown)
    seconds = time.perf_counter() - begun
    results = {
        "environment": environment(),
        "model": arguments.model,
        "lap_s": arguments.lap_s,
        "mean_mm": 1e3 * float(measured.mean_distance_m.mean()),
        "largest_mm": 1e3 * float(measured.largest_distance_m.max()),
        "failed": bool(np.any(measured.failed)),
        "seconds": seconds,
    }
    print(
        f"figure eight of 2 m by 1 m in {arguments.lap_s:g} s: {results['mean_mm']:.1f} mm, at most "
        f"{results['largest_mm']:.0f} mm; {arguments.flights} flights of 10 s in {seconds:.0f} s"
    )
    if arguments.write is not None:
        write_json(arguments.write, results)


if __name__ == "__main__":
    main()
