"""Train the paper's first task with Stable-Baselines3, and measure how well the policy hovers.

    pip install '.[gymnasium]' stable-baselines3
    python examples/train_with_sb3.py [--commands 2000000] [--drones 256] [--seed 0] [--write FILE.json]

Stable-Baselines3 has its own interface of vector environments, which is older than Gymnasium's. `Drones` is the
adapter.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np
import stable_baselines3
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecEnv, VecMonitor, VecNormalize

from cfb_mjx.envs import Starts, TargetReward, TargetTask
from cfb_mjx.envs.gym import TargetVectorEnv
from cfb_mjx.files import write_json
from cfb_mjx.runtime import environment


class Drones(VecEnv):
    """Adapter from `TargetVectorEnv` to the `VecEnv` of Stable-Baselines3."""

    def __init__(self, many: TargetVectorEnv):
        self.many, self.actions = many, None
        super().__init__(many.num_envs, many.single_observation_space, many.single_action_space)

    def reset(self) -> np.ndarray:
        """Start all episodes, with the seed that `seed` has set."""
        seed = self._seeds[0]
        self._reset_seeds()
        return self.many.reset(seed=seed)[0]

    def step_async(self, actions: np.ndarray) -> None:
        """Store the actions for `step_wait`."""
        self.actions = actions

    def step_wait(self):
        """Simulate one control step with the stored actions."""
        seen, reward, failed, timed_out, info = self.many.step(self.actions)
        infos = [{} for _ in range(self.num_envs)]
        for i in np.flatnonzero(failed | timed_out):
            infos[i] = {"terminal_observation": info["final_obs"][i], "TimeLimit.truncated": bool(timed_out[i])}
        return seen, reward, failed | timed_out, infos

    def close(self) -> None:
        """Close the environment."""
        self.many.close()

    def get_attr(self, attr_name, indices=None) -> list:
        """Return an attribute, which is the same for all drones."""
        return [getattr(self.many, attr_name, None)] * len(list(self._get_indices(indices)))

    def set_attr(self, attr_name, value, indices=None) -> None:
        """Not supported: the drones have no separate attributes."""
        raise NotImplementedError

    def env_method(self, method_name, *args, indices=None, **kwargs) -> list:
        """Not supported: the drones have no separate methods."""
        raise NotImplementedError

    def env_is_wrapped(self, wrapper_class, indices=None) -> list[bool]:
        """Return False: no drone is wrapped."""
        return [False] * len(list(self._get_indices(indices)))


def hover_error_m(model: PPO, seconds: float = 6.0) -> np.ndarray:
    """Mean distance to the target after the first second, for 64 drones that start within 0.7 m of it."""
    task = TargetTask(starts=Starts(near=1.0), episode_s=seconds)
    many = TargetVectorEnv(64, task)
    seen, _ = many.reset(seed=1)
    away = []
    for k in range(task.episode_steps - 1):
        seen, _, _, _, info = many.step(model.predict(seen, deterministic=True)[0])
        if k * task.layout.control_dt_s >= 1:
            away.append(np.linalg.norm(info["position"], axis=1))
    return np.mean(away, axis=0)


def main() -> None:
    """Train the policy and measure its hover error."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--commands", type=int, default=2_000_000, help="total number of commands")
    parser.add_argument("--drones", type=int, default=256, help="number of drones simulated in parallel")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--write", type=Path, metavar="FILE.json", help="write time and hover error to this file")
    arguments = parser.parse_args()
    # Rewards are divided by their standard deviation; with the usual penalty of a failure, 300, others would vanish.
    # Most episodes start near the target; otherwise the policy learns only not to fall for millions of commands.
    task = TargetTask(reward=TargetReward(failure=30.0), starts=Starts(near=0.8))
    many = TargetVectorEnv(arguments.drones, task)
    drones = VecNormalize(VecMonitor(Drones(many)), norm_obs=False, gamma=0.995)
    model = PPO(
        "MlpPolicy",
        drones,
        learning_rate=lambda left: 1e-3 * max(left, 0.02),
        n_steps=128,
        batch_size=arguments.drones * 16,
        n_epochs=4,
        gamma=0.995,
        gae_lambda=0.98,
        max_grad_norm=1.0,
        policy_kwargs={"net_arch": {"pi": [32] * 4, "vf": [64, 64]}, "log_std_init": -1.6},
        seed=arguments.seed,
        device="cpu",
        verbose=1,
    )
    begin = time.perf_counter()
    model.learn(arguments.commands, log_interval=10)
    seconds, error = time.perf_counter() - begin, 1e3 * hover_error_m(model)
    print(f"{model.num_timesteps / 1e6:.1f} M commands in {seconds:.0f} s")
    print(f"hover error on the nominal drone: mean {error.mean():.0f} mm, worst of 64 {error.max():.0f} mm")
    if arguments.write:
        found = {"commands": model.num_timesteps, "seconds": seconds, "mean_mm": error.mean(), "worst_mm": error.max()}
        versions = environment() | {"stable_baselines3": stable_baselines3.__version__}
        write_json(arguments.write, found | {"seed": arguments.seed, "environment": versions})


if __name__ == "__main__":
    main()
