"""Ray: on this machine for the time of a sweep, or a cluster that is there. The one module that knows it."""

from __future__ import annotations

import os
import re
import secrets
import shutil
import socket
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from cfb_mjx import __version__
from cfb_mjx.errors import CfbError
from cfb_mjx.sweep.attempt import Outcome, TaskFault
from cfb_mjx.sweep.probe import look, say_hello
from cfb_mjx.sweep.workers import environment

ANSWER_S = 15.0
"""A cluster must answer within this."""
LOOK_S = 90.0
"""And start a worker on every node within this."""


@dataclass(frozen=True)
class Needs:
    """Of every task.

    Attributes:
        cpus: processors.
        gpus: GPUs.
        retries: more attempts when a worker dies or the command breaks.
        calls: tasks of one worker process.
    """

    cpus: float = 1.0
    gpus: float = 0.0
    retries: int = 3
    calls: int = 20


@dataclass(frozen=True)
class Pool:
    """Workers to give tasks to."""

    ray: Any
    needs: Needs

    def submit(self, function: Callable[..., Outcome], *arguments: Any) -> Any:
        """Hand in a call; a handle for `finished`."""
        options = {"num_cpus": self.needs.cpus, "num_gpus": self.needs.gpus, "max_calls": self.needs.calls}
        options |= {"max_retries": self.needs.retries, "retry_exceptions": [TaskFault]}
        return self.ray.remote(**options)(function).remote(*arguments)

    def finished(self, handles: list[Any], seconds: float = 1.0) -> list[tuple[Any, Outcome]]:
        """Those that ended by now, after waiting up to ``seconds`` for the first."""
        ready, _ = self.ray.wait(handles, num_returns=1, timeout=seconds)
        if ready:
            ready, _ = self.ray.wait(handles, num_returns=len(handles), timeout=0)
        return [(handle, self._outcome(handle)) for handle in ready]

    def _outcome(self, handle: Any) -> Outcome:
        errors = self.ray.exceptions
        try:
            return self.ray.get(handle)
        except errors.RayTaskError as error:
            cause = error.cause if error.cause is not None else error
            return Outcome(str(cause).strip().splitlines()[-1] if str(cause).strip() else type(cause).__name__)
        except errors.RayError as error:
            tries = self.needs.retries + 1
            return Outcome(
                f"its worker process died, {tries} times if not more ({type(error).__name__}): it may have run out of "
                "memory, or a crash of compiled code; what it printed is below."
            )


@contextmanager
def opened(address: str | None, needs: Needs, folder: Path) -> Iterator[Pool]:
    """Workers during the block: on this machine, or of the cluster at ``address``.

    Args:
        address: ``HOST:PORT`` of a cluster's head, or ``auto`` for the one this machine belongs to; None starts one
            here and stops it at the end.
        needs: of every task.
        folder: of the sweep, which all nodes must see.

    Raises:
        CfbError: Ray is not installed, no cluster answers, its nodes are of no use, or tasks need more than there is.
    """
    # Read when Ray is imported or started. Nothing is reported to its makers, and `uv run` does not pack this folder.
    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
    os.environ.setdefault("RAY_ENABLE_UV_RUN_RUNTIME_ENV", "0")
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
    # By itself Ray tries for ever what runs out of memory.
    os.environ.setdefault("RAY_task_oom_retries", str(needs.retries))
    try:
        import ray
    except ImportError:
        raise CfbError("cfb sweep needs Ray, which is not installed; pip install 'cfb_mjx[sweep]'.") from None
    options = {
        "runtime_env": {"env_vars": environment(needs.cpus, needs.gpus)},
        "log_to_driver": False,
        "logging_level": "ERROR",
    }
    with _embedded(ray, options) if address is None else _joined(ray, address, options):
        _require_room(ray, needs, address)
        if address is not None:
            _require_sight(ray, folder)
        yield Pool(ray, needs)


@contextmanager
def _embedded(ray: Any, options: dict[str, Any]) -> Iterator[None]:
    # A folder of its own: Ray leaves its logs behind. Sockets lie there, whose names must be short.
    short = tempfile.gettempdir() if len(tempfile.gettempdir()) < 30 else "/tmp"
    place = tempfile.mkdtemp(prefix="cfb-ray-", dir=short)
    before = {name: os.environ.get(name) for name in ("RAY_AUTH_MODE", "RAY_AUTH_TOKEN")}
    # Whoever reaches Ray's ports runs what they like. Newer versions ask for a token, and by themselves would leave one
    # in the home folder, after which every `ray start` wants it.
    os.environ.pop("RAY_AUTH_MODE", None)
    os.environ["RAY_AUTH_TOKEN"] = _token()
    try:
        try:
            ray.init(
                address="local",  # not the cluster that RAY_ADDRESS or an earlier `ray start` speaks of
                num_cpus=_processors(),
                include_dashboard=False,
                object_store_memory=100 * 2**20,  # nothing but names passes through it
                _node_ip_address="127.0.0.1",
                _temp_dir=place,
                **options,
            )
        except Exception as error:
            raise CfbError(f"Ray could not be started on this machine ({_first_line(error)}).") from error
        yield
    finally:
        ray.shutdown()
        for name, value in before.items():
            os.environ.pop(name, None)
            if value is not None:
                os.environ[name] = value
        shutil.rmtree(place, ignore_errors=True)


@cache
def _token() -> str:
    """The same for all of this process: Ray keeps the first it sees."""
    return secrets.token_hex(32)


@contextmanager
def _joined(ray: Any, address: str, options: dict[str, Any]) -> Iterator[None]:
    found = os.environ.get("RAY_ADDRESS", address) if address == "auto" else address
    if found != "auto":
        _require_answer(found)
    try:
        ray.init(address=found, **options)
    except Exception as error:
        raise _not_joined(found, _first_line(error)) from None
    try:
        yield
    finally:
        ray.shutdown()


def _require_answer(address: str) -> None:
    """Ask before Ray is let at it, which would try for minutes."""
    if not re.fullmatch(r"[^/]+:\d+", address):
        raise CfbError(
            f"--address {address}: give HOST:PORT of the cluster's head, for instance 10.0.0.1:6379, or auto."
        )
    command = [sys.executable, "-m", "ray.scripts.scripts", "status", "--address", address]
    try:
        host, _, port = address.rpartition(":")
        socket.create_connection((host.strip("[]"), int(port)), timeout=ANSWER_S).close()
        asked = subprocess.run(command, capture_output=True, text=True, timeout=ANSWER_S, check=False)
    except subprocess.TimeoutExpired:
        raise _not_joined(address, "what listens there does not answer as Ray does") from None
    except (OSError, OverflowError) as error:
        raise _not_joined(address, f"nothing listens there: {getattr(error, 'strerror', None) or error}") from None
    if asked.returncode:
        lines = [line for line in asked.stderr.splitlines() if line.strip()] or ["it does not say why"]
        if "InvalidAuthToken" in asked.stderr:
            lines = ["it asks for a token: set RAY_AUTH_MODE=token, with the cluster's token in RAY_AUTH_TOKEN"]
        raise _not_joined(address, lines[-1])


def _not_joined(address: str, why: str) -> CfbError:
    return CfbError(
        f"--address {address}: no Ray cluster could be joined ({why.rstrip('.')}); start one with 'ray start --head' "
        "and run cfb sweep on one of its machines, or leave --address out."
    )


def _first_line(error: Exception) -> str:
    return next(iter(str(error).strip().splitlines()), type(error).__name__)


def _processors() -> int | None:
    """What this process may use, where that is less than the machine has (SLURM, taskset); None lets Ray count."""
    if not hasattr(os, "sched_getaffinity"):
        return None
    allowed = len(os.sched_getaffinity(0))
    return allowed if allowed < (os.cpu_count() or 1) else None


def _require_room(ray: Any, needs: Needs, address: str | None) -> None:
    """Ray would wait for ever for a machine that is large enough."""
    nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]
    if any(n.get("CPU", 0) >= needs.cpus and n.get("GPU", 0) >= needs.gpus for n in nodes):
        return
    largest = ", ".join(f"{max(n.get(kind, 0) for n in nodes):g} {kind}" for kind in ("CPU", "GPU"))
    where = "this machine has" if address is None else "its largest machines have"
    raise CfbError(
        f"a task needs {needs.cpus:g} CPU and {needs.gpus:g} GPU, {where} {largest}; change 'cpus' and 'gpus' of the "
        "sweep."
    )


def _require_sight(ray: Any, folder: Path) -> None:
    """Every node must see the folder of the sweep and the current one, and have this version of the library."""
    from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

    with say_hello(folder) as marker:
        seeing = ray.remote(num_cpus=0, max_retries=0)(look)
        handles = []
        for node in (node for node in ray.nodes() if node["Alive"]):
            there = NodeAffinitySchedulingStrategy(node["NodeID"], soft=True)
            asked = seeing.options(scheduling_strategy=there).remote(str(marker), os.getcwd())
            handles.append((node["NodeManagerHostname"], asked))
        for host, handle in handles:
            try:
                version, missing = ray.get(handle, timeout=LOOK_S)
            except Exception as error:
                lines = str(error).strip().splitlines()
                raise CfbError(
                    f"{host} of the cluster cannot run cfb_mjx ({lines[-1] if lines else type(error).__name__}); "
                    "install it there, in the environment that Ray was started from."
                ) from None
            if missing:
                raise CfbError(
                    f"{host} of the cluster does not see {missing}; the folders of a sweep must lie on a file system "
                    "that all machines share, under the same path."
                )
            if version != __version__:
                raise CfbError(
                    f"{host} of the cluster has cfb_mjx {version}, here it is {__version__}; install the same."
                )
