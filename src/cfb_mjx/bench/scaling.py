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

from cfb_mjx.bench.timed_process import TimedProcess
from cfb_mjx.optional import not_none

DRONES = {"rollout": 8192, "rollout_policy": 8192, "ppo": 512}
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
    function, (model, *batch) = workload.trace
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


if __name__ == "__main__":
    _serve(sys.argv[1], int(sys.argv[2]), [int(core) for core in sys.argv[3].split(",")])
