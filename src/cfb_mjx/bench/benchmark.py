"""Measure throughput, together with that of other simulators, in one run on one machine."""

from __future__ import annotations

import contextlib
import functools
import importlib.util
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import jax

from cfb_mjx.bench import page, workloads
from cfb_mjx.bench.first_call import first_call, start_up
from cfb_mjx.bench.roofline import roofline as roofline_of_machine
from cfb_mjx.bench.scaling import braxs_ppo, scaling
from cfb_mjx.bench.timed_process import TimedProcess, without_options
from cfb_mjx.devices import Devices
from cfb_mjx.engine.gpu import kernel_is_chosen
from cfb_mjx.errors import CfbError
from cfb_mjx.files import shipped
from cfb_mjx.optional import not_none
from cfb_mjx.runtime import cores, environment, say

TURN_S = 0.03
"""Least time of a turn; shorter runs are repeated, because a single run of microseconds is not reliable."""
TURNS, QUICK_TURNS = 7, 2
TURNS_S = 20.0
"""Least time of all turns together; other programs on a shared machine can be busy for seconds."""


class Peer(TimedProcess):
    """A process of another simulator that times one run per request, so that its runs can alternate with ours.

    Args:
        name: name of the simulator; the process runs ``peers/NAME_peer.py``.
        python: its Python.
        what: what it is compared with, see `cfb_mjx.bench.workloads`.
        drones: number of drones.
        arguments: further arguments of its script.
        core: the only core that it may use; None does not limit it.

    Raises:
        CfbError: the simulator does not run with that Python.
    """

    def __init__(
        self, name: str, python: Path, what: str, drones: int, arguments: Sequence[str] = (), core: int | None = None
    ):
        script = Path(__file__).with_name("peers") / f"{name.replace('.', '_')}_peer.py"
        try:
            with _bound_to(core):
                self.process = subprocess.Popen(
                    [str(python), str(script), str(drones), *arguments],
                    stdin=subprocess.PIPE,
                    stdout=subprocess.PIPE,
                    stderr=subprocess.PIPE,
                    text=True,
                    env=without_options(),
                )
        except OSError as error:
            raise CfbError(f"--peer-python {python}: cannot be run ({error.strerror}).") from None
        answer = not_none(self.process.stdout).readline().split()
        if len(answer) != 4 or answer[0] != "ready":
            last = (self.process.communicate()[1].strip().splitlines() or ["no output"])[-1]
            raise CfbError(f"{python}: {name} does not run there ({last}); give another --peer-python, or none.")
        self.name, self.what, self.drones = name, what, drones
        self.version, self.compile_s, self.steps = answer[1], float(answer[2]), int(answer[3])
        self.cores = (cores() if core is None else 1) if jax.default_backend() == "cpu" else None


@contextlib.contextmanager
def _bound_to(core: int | None) -> Iterator[None]:
    """Bind processes that start in this block to one core; None does not bind them."""
    if core is None:
        yield
        return
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, [core])
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


def benchmark(
    drones: Sequence[int], peer_python: Path | None = None, quick: bool = False, roofline: bool = False
) -> dict[str, Any]:
    """Measure the throughput of all workloads, and print the progress.

    Args:
        drones: batch sizes.
        peer_python: Python of an environment with crazyflow, to measure it as well; and l2f, if it has that, MuJoCo's
            C alone, and Brax's own PPO.
        quick: measure fewer workloads with fewer repetitions.
        roofline: also compare the speed with the limits of the machine.

    Returns:
        JSON values: ``rows``, ``peers``, ``environment``, ``first_call`` and ``start_up``; ``scaling`` unless
        ``quick``; ``roofline`` if requested.

    Raises:
        CfbError: crazyflow does not run with ``peer_python``.
    """
    # A program from the cache would take no time to compile.
    jax.config.update("jax_enable_compilation_cache", False)
    over, rows, peers = Devices.take(jax.local_device_count()), [], []
    for count in drones:
        several = over if over.several and count >= 64 and count % over.count == 0 else None
        with tempfile.TemporaryDirectory() as folder:
            network = workloads.network_file(Path(folder))
            groups = [_open_loop(count, several, peer_python)]
            if not quick:
                groups += [_closed_loop(count, several, peer_python, network), _environments(count, peer_python)]
                groups += [_contact(count, peer_python), _derivatives(count)]
            for group in filter(None, groups):
                best = _alternate(group, QUICK_TURNS) if quick else _alternate(group, TURNS, TURNS_S)
                for item, seconds in zip(group, best, strict=True):
                    row = _row(item, count, seconds)
                    (peers if isinstance(item, Peer) else rows).append(row)
                    say(f"{row['what']} of {count}, {page.body(row)}: {row['steps_per_s']:.3g} steps/s")
                    if isinstance(item, Peer):
                        item.close()
    say("measuring the first call")
    result = {
        "rows": rows,
        "peers": peers,
        "environment": environment(),
        "first_call": first_call(),
        "start_up": start_up(),
    }
    if not quick:
        say("measuring one core and two cores")
        result["scaling"] = scaling()
        if peer_python is not None:
            say("measuring Brax's own PPO")
            peers += braxs_ppo()
    if roofline:
        say("measuring the limits of the machine")
        result["roofline"] = roofline_of_machine()
    return result


def _open_loop(count: int, several: Devices | None, python: Path | None) -> list:
    """Workloads that take turns with rollouts of crazyflow and of Learning to Fly's simulator."""
    found = [workloads.rollout(count), workloads.rollout_kept(count), workloads.rollout_randomised(count)]
    found += [workloads.rollout(count, "rigid-plain")] if kernel_is_chosen() else []
    found += [workloads.rollout(count, over=several)] if several else []
    found += _peers("crazyflow", python, "rollout", count)
    # It has no other numbers of drones.
    if python is not None and count <= 8192 and count & (count - 1) == 0 and _has(python, "l2f"):
        # Its threads wait for one another on a shared machine, so it is bound to one core.
        found += _peers("l2f", python, "rollout", count, one_core=True)
    return found


def _closed_loop(count: int, several: Devices | None, python: Path | None, network: Path) -> list:
    """Workloads that take turns with crazyflow and the same network."""
    found = [workloads.rollout_policy(count), workloads.network_alone(count)]
    found += [workloads.rollout_policy(count, several)] if several else []
    return found + _peers("crazyflow", python, "rollout_policy", count, str(network))


def _environments(count: int, python: Path | None) -> list:
    """Our environment for Gymnasium, if that is installed, and crazyflow's."""
    if count > 8192 or importlib.util.find_spec("gymnasium") is None:
        return []
    return [workloads.gymnasium(count), *_peers("crazyflow", python, "gymnasium", count, "environment")]


def _contact(count: int, python: Path | None) -> list:
    """Bodies with a floor that is rarely touched, and MuJoCo's C alone."""
    found = [workloads.rollout(count, body) for body in ("mjx", "mjx-floor", "mujoco-floor")]
    arguments = str(shipped("assets", "cfb.xml")), str(workloads.HEIGHT_M)
    # With the MuJoCo of this library.
    python = None if python is None else Path(sys.executable)
    return found + _peers("mujoco.batch", python, "rollout", count, *arguments)


@functools.cache
def _has(python: Path, module: str) -> bool:
    found = subprocess.run([str(python), "-c", f"import {module}"], capture_output=True).returncode == 0
    if not found:
        say(f"{python} has no {module}, which is left out")
    return found


def _peers(
    name: str, python: Path | None, what: str, count: int, *arguments: str, one_core: bool = False
) -> list[Peer]:
    """A simulator as its users run it, and bound to one core, to compare it with one device."""
    if python is None:
        return []
    apart = jax.default_backend() == "cpu" and cores() > 1 and hasattr(os, "sched_getaffinity")
    bound_to = [None, min(os.sched_getaffinity(0))][one_core:] if apart else [None]
    return [Peer(name, python, what, count, arguments, core) for core in bound_to]


def _derivatives(count: int) -> list:
    """Workloads of derivatives, and plain MJX."""
    found = [workloads.stock_mjx(count)]
    if count <= 8192:
        found += [workloads.rollout_gradient(count), workloads.rollout_ten(count), workloads.rollout_hundred(count)]
    return found


def _alternate(items: list, turns: int, least_s: float = 0.0) -> list[float]:
    """Return the best time of each item. The runs take turns, so that a busy moment of the machine affects all.

    Args:
        items: what to run.
        turns: least number of turns of each.
        least_s: least total time, s.
    """
    best, end, turn = [float("inf")] * len(items), time.perf_counter() + least_s, 0
    while turn < turns or time.perf_counter() < end:
        turn += 1
        for index, item in enumerate(items):
            spent = 0.0
            while spent < TURN_S:
                seconds = item.seconds()
                spent += seconds
                best[index] = min(best[index], seconds)
    return best


def _row(item: workloads.Workload | Peer, drones: int, seconds: float) -> dict:
    speed = {"steps_per_s": drones * item.steps / seconds, "compile_s": item.compile_s}
    if isinstance(item, Peer):
        of = {"name": item.name, "version": item.version, "what": item.what, "drones": drones, "cores": item.cores}
        return of | speed
    of = {"what": item.what, "body": item.body, "drones": drones, "devices": item.devices}
    return of | speed | {"peak_mb": item.peak_mb}
