"""Train a policy to race through the gates of an MJCF, and fly it where the gates can be hit.

    python examples/gate_race.py [--commands 30000000] [--seed 0] [--write FILE.json] [--policy FILE.npz]

A task of one's own: `RaceTask` says what is rewarded and what ends an episode. It is trained without contact, where a
drone that comes too near to a bar has failed, and flown in a `Scene`, where MuJoCo's contacts stop it. About four
minutes on two cores.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from cfb_mjx.control import NeuralController, PolicyFile, save_policy
from cfb_mjx.envs import Layout, StateEstimate, Task
from cfb_mjx.envs.reward import length, too_fast
from cfb_mjx.files import write_json
from cfb_mjx.model import Quadrotor, Scene, State
from cfb_mjx.parameters import Parameters, load_randomisation
from cfb_mjx.runtime import configure_jax, environment
from cfb_mjx.train.analytic import Analytic
from cfb_mjx.train.config import AnalyticSettings

TRACK = Path(__file__).with_name("gates.xml")
COMMANDS = 30_000_000
OPENING_M = 0.30
"""Half of the opening of a gate."""
LAYOUT = Layout(setpoint_scales=(2.0, 2.0, 2.0), velocity_bend_mps=0.0, position_bend_m=1.0, position_scale_m=1.0)
DRONE_M = 0.09
"""Distance from a drone's centre at which a bar fails it, in training."""


def gates_of(mjcf: Path) -> tuple[tuple[float, float, float, float], ...]:
    """Position [m] and yaw [rad] of the bodies gate0, gate1 ... of an MJCF."""
    model = mujoco.MjModel.from_xml_path(str(mjcf))
    found = []
    for i in range(model.nbody):
        if model.body(i).name.startswith("gate"):
            w, _, _, z = model.body_quat[i]
            found.append((*map(float, model.body_pos[i]), float(2 * np.arctan2(z, w))))
    return tuple(found)


@dataclass(frozen=True)
class RaceTask(Task):
    """Fly through the gates in turn, as fast as possible.

    The set-point is the number of the next gate, and how far the drone was ahead of it. The target is a point behind
    the gate; the policy also sees where the target after it will be.
    """

    layout: Layout = LAYOUT
    gates: tuple[tuple[float, float, float, float], ...] = ()
    behind_m: float = 0.2
    episode_s: float = 5.0

    @property
    def largest_reward(self) -> float:
        """Reward of a step at 6 m/s towards the target."""
        return 6.0

    def _gate(self, number: Array) -> tuple[Array, Array]:
        gate = jnp.asarray(self.gates)[number.astype(int) % len(self.gates)]
        return gate[:3], jnp.stack([jnp.cos(gate[3]), jnp.sin(gate[3]), 0.0])

    def _seen_from(self, number: Array, position: Array) -> Float[Array, "3"]:
        """Position in the axes of a gate: ahead, left, up."""
        center, ahead = self._gate(number)
        offset = position - center
        return jnp.stack([offset @ ahead, offset @ jnp.stack([-ahead[1], ahead[0], 0.0]), offset[2]])

    def draw_setpoint(self, key: PRNGKeyArray) -> Float[Array, "2"]:
        """Any gate is the first one."""
        return jnp.stack([jnp.floor(len(self.gates) * jax.random.uniform(key)), -1.0])

    def draw_start(self, model: Quadrotor, target: Array, setpoint: Float[Array, "2"], key: PRNGKeyArray) -> State:
        """On the way from the gate before, fast or slow; or in hover on the axis of this gate, where races begin."""
        shares, spread = jax.random.uniform(key, (2,)), jax.random.normal(jax.random.fold_in(key, 1), (13,))
        before, ahead = self._gate(setpoint[0] - 1)
        way = self._gate(setpoint[0])[0] - before
        place = before + way * (0.1 + 0.5 * shares[0]) + 0.12 * spread[:3]
        velocity = jnp.where(shares[1] < 0.7, 3.0 * shares[1] * ahead, 0.0) + 0.7 * spread[3:6]
        turn = jnp.concatenate([jnp.ones(1), 0.15 * spread[6:9]])
        turn = turn / jnp.linalg.norm(turn)
        center, axis = self._gate(setpoint[0])
        begins = shares[1] > 0.85
        place = jnp.where(begins, center - (0.5 + 1.5 * shares[0]) * axis + 0.05 * spread[:3], place)
        velocity = jnp.where(begins, 0.1 * velocity, velocity)
        start = model.hover_state(place)
        return replace(start, velocity=velocity, quaternion=turn, body_rate=1.5 * spread[9:12])

    def next_setpoint(self, setpoint: Float[Array, "2"], state: State) -> Float[Array, "2"]:
        """The next gate, once the plane of this one was crossed within its opening."""
        ahead, left, up = self._seen_from(setpoint[0], jnp.asarray(state.position))
        through = (setpoint[1] < 0) & (ahead >= 0) & (jnp.maximum(jnp.abs(left), jnp.abs(up)) < OPENING_M)
        number = jnp.where(through, setpoint[0] + 1, setpoint[0])
        return jnp.stack([number, jnp.where(through, -1.0, ahead)])

    def target(self, setpoint: Float[Array, "2"], origin: Array) -> Float[Array, "3"]:
        """A point behind the next gate."""
        center, ahead = self._gate(setpoint[0])
        return center + self.behind_m * ahead

    def shown(self, setpoint: Float[Array, "2"]) -> Float[Array, "3"]:
        """From this target to the one after it."""
        return self.target(setpoint + 1, jnp.zeros(3)) - self.target(setpoint, jnp.zeros(3))

    def judge(
        self, state: State, target: Array, setpoint: Float[Array, "2"], command: Array, parameters: Parameters
    ) -> Float[Array, ""]:
        """The negative of `haste`, less for a failure."""
        return -self.haste(state, target, setpoint) - 30.0 * self.failed(state)

    def haste(self, state: State, target: Array, setpoint: Float[Array, "2"]) -> Float[Array, ""]:
        """Cost of a state: speed away from the target, distance from the gate's axis near to the gate, turning."""
        offset = target - state.position
        speed = jnp.asarray(state.velocity) @ offset / length(offset)
        ahead, left, up = self._seen_from(setpoint[0], jnp.asarray(state.position))
        beside = jnp.exp(-((ahead / 0.5) ** 2)) * (left**2 + up**2) / 0.15**2
        turning = jnp.sum(jnp.asarray(state.body_rate) ** 2 * jnp.array([0.002, 0.002, 0.02]))
        return 2.0 * beside + turning - speed

    def failed(self, state: State) -> Bool[Array, ""]:
        """Whether the drone is too near to a bar or to the floor, too far away, or too fast."""
        position = jnp.asarray(state.position)
        seen = jax.vmap(lambda number: self._seen_from(number, position))(jnp.arange(len(self.gates)))
        across = jnp.maximum(jnp.abs(seen[:, 1]), jnp.abs(seen[:, 2]))
        hit = (jnp.abs(seen[:, 0]) < DRONE_M) & (across > OPENING_M - DRONE_M) & (across < 0.34 + DRONE_M)
        away = (position[2] < 0.15) | (position[2] > 3.0) | (jnp.abs(position[:2]).max() > 6.0)
        return jnp.any(hit) | away | too_fast(state, 12.0, 30.0)

    @property
    def diverged_reward(self) -> float:
        """As for a drone that hits a bar."""
        return -30.0

    def errors(self, state: State, target: Array, setpoint: Float[Array, "2"]) -> Float[Array, "3"]:
        """Distance to the target, and the distance from the gate's axis, and speed."""
        _, left, up = self._seen_from(setpoint[0], jnp.asarray(state.position))
        return jnp.stack(
            [length(target - state.position), jnp.sqrt(left**2 + up**2 + 1e-6), length(state.velocity) / 5]
        )


@dataclass(frozen=True)
class RaceCost:
    """Cost of a control step for back-propagation: the negative of what `RaceTask` rewards, and changes of commands."""

    task: RaceTask
    command_change: float = 2.0
    failure: float = 8.0

    def __call__(
        self, state: State, target: Array, setpoint: Float[Array, "2"], command: Array, last: Array
    ) -> Float[Array, ""]:
        """Cost of a step that ended in ``state`` after ``command``; ``last`` is the command before it."""
        return self.task.haste(state, target, setpoint) + self.command_change * jnp.sum((command - last) ** 2)


def trained(task: RaceTask, drone: Quadrotor, commands: int, seed: int) -> NeuralController:
    """Train by back-propagation through the simulator, as ``cfb train --algorithm analytic`` does."""
    settings = AnalyticSettings(drones=256, horizon_s=1.0, learning_rate=2e-3, cost=RaceCost(task))
    settings = replace(settings, updates=max(1, round(commands / (256 * 1.0 / task.layout.control_dt_s))))
    algorithm = Analytic(settings, task, drone)
    of_network, of_learning = jax.random.split(jax.random.PRNGKey(seed))
    state = algorithm.begin(of_learning, NeuralController.random(of_network, task.layout, (64, 64)))
    for i in range(algorithm.updates):
        state, numbers = algorithm.update(state)
        if i % 50 == 0 or i + 1 == algorithm.updates:
            done = (i + 1) * algorithm.steps_per_update / 1e6
            print(
                f"... {done:.1f} M commands, loss {numbers['loss']:.3f}, failing {numbers['failing']:.3f}", flush=True
            )
    return algorithm.controller(state)


def raced(task: RaceTask, controller: NeuralController, drone: Quadrotor, key, seconds: float = 10.0, scene=None):
    """Fly from hover before the first gate, in a scene with contacts; the policy sees the state of 8 ms ago.

    Returns:
        Gates passed, whether anything was touched, positions (steps, 3).
    """
    scene = Scene(TRACK, engine="c") if scene is None else scene
    hold = drone.steps_per_command(controller.control_dt_s)
    start = replace(drone.hover_state((0.5, 0.0, 1.0)), velocity=0.1 * jax.random.normal(key, (3,)))

    def seen(state: State, target: Array) -> StateEstimate:
        return StateEstimate(state.position - target, state.velocity, state.quaternion, state.body_rate)

    def one(carry, _):
        world, before, memory, setpoint, touched = carry
        target = task.target(setpoint, jnp.zeros(3))
        memory, command = controller.command(memory, seen(before, target), task.shown(setpoint))
        after = scene.rollout(drone, world, command[None], hold=hold)
        after = jax.tree.map(lambda x: x[0], after)
        touched = touched | (jnp.abs(after.constraint).max() > 1e-6)
        return (after, world.drone, memory, task.next_setpoint(setpoint, after.drone), touched), after.drone.position

    world = scene.begin(drone, start)
    memory = controller.start(seen(start, task.target(jnp.zeros(2), jnp.zeros(3))))
    first = world, start, memory, jnp.array([0.0, -1.0]), jnp.asarray(False)
    (_, _, _, setpoint, touched), way = jax.lax.scan(one, first, length=round(seconds / controller.control_dt_s))
    return setpoint[0], touched, way


def main() -> None:
    """Train, race, and print how it went."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--commands", type=int, default=COMMANDS)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--drones", type=int, default=64, help="drones that race, each from another start")
    parser.add_argument("--write", type=Path, help="JSON file for the results")
    parser.add_argument("--policy", type=Path, help="file for the policy")
    arguments = parser.parse_args()
    configure_jax(x64=False)
    drone = Quadrotor.from_file("cfb-guards")
    task = RaceTask(gates=gates_of(TRACK), randomisation=load_randomisation("paper"), magnitude=0.3)
    begun = time.perf_counter()
    controller = trained(task, drone, arguments.commands, arguments.seed)
    seconds = time.perf_counter() - begun
    if arguments.policy is not None:
        save_policy(PolicyFile(controller, "race"), arguments.policy)
    keys = jax.random.split(jax.random.PRNGKey(1), arguments.drones)
    passed, touched, way = jax.jit(jax.vmap(partial(raced, task, controller, drone)))(keys)
    laps = 10.0 * len(task.gates) / np.maximum(passed, 1)
    speeds = np.linalg.norm(np.diff(way, axis=1), axis=-1) / controller.control_dt_s
    results = {
        "environment": environment(),
        "commands": arguments.commands,
        "seconds": seconds,
        "seed": arguments.seed,
        "drones": arguments.drones,
        "gates_in_10_s": float(np.mean(passed)),
        "lap_s": float(np.median(laps)),
        "touched": float(np.mean(touched)),
        "speed_mps": float(speeds.max()),
    }
    print(
        f"{results['gates_in_10_s']:.1f} gates in 10 s, a lap of {len(task.gates)} gates in {results['lap_s']:.2f} s; "
        f"{results['touched']:.1%} of {arguments.drones} drones touched something"
    )
    if arguments.write is not None:
        write_json(arguments.write, results)


if __name__ == "__main__":
    main()
