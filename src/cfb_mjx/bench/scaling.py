"""Measure the speed-up of two cores over one: the same work on one device bound to one core, and on two.

One CPU device of XLA can use several cores, so each measurement runs in a process that may use as many cores as it has
devices. The processes stay alive and take turns.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable
from typing import Any

from cfb_mjx.bench.timed_process import TimedProcess, without_options
from cfb_mjx.optional import not_none
from cfb_mjx.runtime import say

DRONES = {"rollout": 8192, "rollout_policy": 8192, "ppo": 256}
"""Workloads and their numbers of drones."""


def scaling(repetitions: int = 15, drones: dict[str, int] | None = None) -> list[dict[str, Any]]:
    """Measure all workloads on one core and on two.

    Args:
        repetitions: runs of each workload; those on one and on two cores alternate.
        drones: numbers of drones by workload; `DRONES` by default.

    Returns:
        Rows with ``what``, ``drones``, ``devices``, ``steps_per_s`` (the best run) and ``ratio`` to one device. Empty
        if this process may use one core only, or cannot bind processes (systems other than Linux).
    """
    if not hasattr(os, "sched_getaffinity") or len(os.sched_getaffinity(0)) < 2:
        return []
    cores, rows = sorted(os.sched_getaffinity(0))[:2], []
    for what, count in (drones or DRONES).items():
        # Measure one device on either core: if another program keeps one core busy, the ratio would be too large.
        runners = [_Runner(what, count, chosen) for chosen in (cores[:1], cores[1:], cores)]
        times = [float("inf")] * 3
        try:
            for _ in range(repetitions):
                times = [min(best, runner.seconds()) for best, runner in zip(times, runners, strict=True)]
        finally:
            for runner in runners:
                runner.close()
        one, two = min(times[:2]), times[2]
        for n, seconds in ((1, one), (2, two)):
            speed = {"steps_per_s": runners[0].steps / seconds, "ratio": one / seconds}
            rows.append({"what": what, "drones": count, "devices": n} | speed)
    return rows


class _Runner(TimedProcess):
    """A process that times one run of a workload per request."""

    def __init__(self, what: str, drones: int, cores: list[int]):
        self.process = subprocess.Popen(
            [sys.executable, "-m", "cfb_mjx.bench.scaling", what, str(drones), ",".join(map(str, cores))],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        answer = not_none(self.process.stdout).readline()
        if not answer:
            raise RuntimeError(f"the measurement of {what} on {len(cores)} cores ended with {self.process.wait()}")
        self.steps = int(answer)


def _serve(what: str, drones: int, cores: list[int]) -> None:
    os.sched_setaffinity(0, cores)
    from cfb_mjx.runtime import configure_jax

    configure_jax(x64=False, devices=len(cores))
    from cfb_mjx.devices import Devices

    over = Devices.take(len(cores))
    steps, run = (_ppo if what == "ppo" else _rollout)(what, drones, over)
    run()
    print(steps, flush=True)
    for _ in sys.stdin:
        begin = time.perf_counter()
        run()
        print(time.perf_counter() - begin, flush=True)


def _rollout(what: str, drones: int, over) -> tuple[int, Callable[[], None]]:
    import jax

    from cfb_mjx.bench import workloads

    workload = getattr(workloads, what)(drones)
    function, (model, *batch) = not_none(workload.trace)
    divided = jax.jit(over.divided(function, (None, *[0] * len(batch)), 0))
    model, batch = over.whole(model), over.along(batch)
    return drones * workload.steps, lambda: jax.block_until_ready(divided(model, *batch))


def _ppo(_, drones: int, over) -> tuple[int, Callable[[], None]]:
    import jax

    from cfb_mjx.train.config import load_config
    from cfb_mjx.train.run import Training, build, spread

    training = Training.prepare(load_config("target", (f"ppo.drones={drones}",)), {})
    nominal, config = training.nominal(), training.config
    task = config.build_task()
    algorithm = build(config, task, nominal, over)
    state = spread(algorithm.begin(jax.random.PRNGKey(0), training.first_controller(nominal)), over)
    return algorithm.steps_per_update * task.hold(nominal), lambda: jax.block_until_ready(algorithm.update(state)[1])


def braxs_ppo() -> list[dict[str, Any]]:
    """Measure Brax's own PPO on the same task, with networks, drones, batches and epochs of the shipped configuration.

    Returns:
        Rows as peers have them, on one core and on two; empty where `scaling` has none.
    """
    if not hasattr(os, "sched_getaffinity") or len(os.sched_getaffinity(0)) < 2:
        return []
    chosen, rows = sorted(os.sched_getaffinity(0))[:2], []
    for cores in (chosen[:1], chosen):
        command = [sys.executable, "-m", "cfb_mjx.bench.scaling", "brax", "0", ",".join(map(str, cores))]
        done = subprocess.run(command, capture_output=True, text=True, env=without_options())
        if done.returncode:
            say(f"Brax's own PPO does not run here ({(done.stderr.strip().splitlines() or ['no output'])[-1]})")
            return []
        version, drones, speed = done.stdout.splitlines()[-1].split()
        of = {"name": "brax", "version": version, "what": "ppo", "drones": int(drones), "cores": len(cores)}
        rows.append(of | {"steps_per_s": float(speed)})
    return rows


def _brax(cores: list[int]) -> None:
    """Train with Brax for a few updates and print its version, the drones, and steps per second."""
    os.sched_setaffinity(0, cores)
    import functools
    from importlib.metadata import version

    from brax.training.agents.ppo.networks import make_ppo_networks

    from cfb_mjx.envs.brax_env import BraxEnv, wrap
    from cfb_mjx.train.brax_compat import brax_ppo
    from cfb_mjx.train.config import load_config

    config = load_config("target")
    settings, env = config.ppo, BraxEnv(config.build_task(), config.model)
    updates, speeds = 6, []
    with brax_ppo() as train:
        train(
            env,
            # Two parts: the first one compiles.
            num_timesteps=2 * updates * settings.drones * settings.unroll,
            num_evals=3,
            num_resets_per_eval=0,
            run_evals=False,
            episode_length=env.task.episode_steps,
            num_envs=settings.drones,
            max_devices_per_host=1,
            batch_size=settings.drones // settings.minibatches,
            num_minibatches=settings.minibatches,
            unroll_length=settings.unroll,
            num_updates_per_batch=settings.epochs,
            learning_rate=settings.learning_rate,
            discounting=settings.discount,
            wrap_env_fn=wrap,
            network_factory=functools.partial(
                make_ppo_networks,
                policy_hidden_layer_sizes=config.network.hidden,
                value_hidden_layer_sizes=settings.value_hidden,
                policy_obs_key="state",
                value_obs_key="privileged_state",
            ),
            progress_fn=lambda _, metrics: speeds.append(float(metrics["training/sps"])),
        )
    print(version("brax"), settings.drones, speeds[-1] * env.task.hold(env.sys))


if __name__ == "__main__":
    bound_to = [int(core) for core in sys.argv[3].split(",")]
    if sys.argv[1] == "brax":
        _brax(bound_to)
    else:
        _serve(sys.argv[1], int(sys.argv[2]), bound_to)
