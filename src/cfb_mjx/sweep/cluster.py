"""Workers by Ray: started on this machine for one sweep, or those of an existing cluster. No other module uses Ray.

Other machines must see the folders of the sweep, which is checked first.
"""

from __future__ import annotations

import os
import re
import secrets
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from cfb_mjx import __version__
from cfb_mjx.errors import CfbError
from cfb_mjx.sweep.drive import Outcome, TaskFault, environment

PATIENCE_S = 10.0
"""Time to wait for a new file; network file systems show it with a delay."""


@contextmanager
def say_hello(folder: Path) -> Iterator[Path]:
    """Create a file in the folder during the block, for other machines to look for."""
    handle, name = tempfile.mkstemp(prefix=".seen-", dir=folder)
    os.close(handle)
    try:
        yield Path(name)
    finally:
        Path(name).unlink(missing_ok=True)


def look(marker: str, place: str, patience_s: float = PATIENCE_S) -> tuple[str, str | None]:
    """Return the library's version on this machine, and the folder that it does not see (None: it sees both)."""
    end = time.monotonic() + patience_s
    while not Path(marker).exists():
        if time.monotonic() > end:
            return __version__, str(Path(marker).parent)
        time.sleep(0.2)
    return __version__, None if Path(place).is_dir() else place


ANSWER_S = 15.0
"""Time within which a cluster must answer."""
LOOK_S = 90.0
"""Time within which every node must start a worker."""


@dataclass(frozen=True)
class Needs:
    """Resources of a task.

    Attributes:
        cpus: processors per task.
        gpus: GPUs per task.
        retries: further attempts if a worker dies or the command fails.
        calls: tasks per worker process.
    """

    cpus: float = 1.0
    gpus: float = 0.0
    retries: int = 3
    calls: int = 20


@dataclass(frozen=True)
class Pool:
    """Workers that run tasks."""

    ray: Any
    needs: Needs

    def submit(self, function: Callable[..., Outcome], *arguments: Any) -> Any:
        """Submit a call; return a handle for `finished`."""
        options = {"num_cpus": self.needs.cpus, "num_gpus": self.needs.gpus, "max_calls": self.needs.calls}
        options |= {"max_retries": self.needs.retries, "retry_exceptions": [TaskFault]}
        return self.ray.remote(**options)(function).remote(*arguments)

    def finished(self, handles: list[Any], seconds: float = 1.0) -> list[tuple[Any, Outcome]]:
        """Wait up to ``seconds`` for a call to end; return all that have ended, with their outcomes."""
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
                f"its worker process died at least {tries} times ({type(error).__name__}): it may have run out of "
                "memory, or compiled code may have crashed; its output is below."
            )


@contextmanager
def opened(address: str | None, needs: Needs, folder: Path) -> Iterator[Pool]:
    """Provide workers during the block, on this machine or on the cluster at ``address``.

    Args:
        address: ``HOST:PORT`` of a cluster's head, or ``auto`` for the cluster that this machine belongs to. None
            starts Ray on this machine and stops it at the end.
        needs: resources of every task.
        folder: folder of the sweep, which all nodes must share.

    Raises:
        CfbError: Ray is not installed, no cluster answers, a node cannot run tasks, or a task needs more resources than
            there are.
    """
    # Ray reads these when it is imported or started: no usage statistics, and `uv run` does not upload this folder.
    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
    os.environ.setdefault("RAY_ENABLE_UV_RUN_RUNTIME_ENV", "0")
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
    # By default Ray retries a task that runs out of memory without a limit.
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
    # A separate folder, because Ray leaves its logs behind. Its sockets need short paths.
    short = tempfile.gettempdir() if len(tempfile.gettempdir()) < 30 else "/tmp"
    place = tempfile.mkdtemp(prefix="cfb-ray-", dir=short)
    before = {name: os.environ.get(name) for name in ("RAY_AUTH_MODE", "RAY_AUTH_TOKEN")}
    # Anybody who can reach Ray's ports can run code. Newer versions require a token; without this they would store one
    # in the home folder, and every `ray start` would then ask for it.
    os.environ.pop("RAY_AUTH_MODE", None)
    os.environ["RAY_AUTH_TOKEN"] = _token()
    try:
        try:
            ray.init(
                address="local",  # not the cluster of RAY_ADDRESS or of an earlier `ray start`
                num_cpus=_processors(),
                include_dashboard=False,
                object_store_memory=100 * 2**20,  # only names pass through it
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
    """Token of this process, always the same one, because Ray keeps the first."""
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
    """Refuse an address where no cluster answers; Ray would try for minutes."""
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
        raise _not_joined(address, "the program that listens there is not Ray") from None
    except (OSError, OverflowError) as error:
        raise _not_joined(address, f"nothing listens there: {getattr(error, 'strerror', None) or error}") from None
    if asked.returncode:
        lines = [line for line in asked.stderr.splitlines() if line.strip()] or ["it gives no reason"]
        if "InvalidAuthToken" in asked.stderr:
            lines = ["it requires a token: set RAY_AUTH_MODE=token and RAY_AUTH_TOKEN to the token of the cluster"]
        raise _not_joined(address, lines[-1])


def _not_joined(address: str, why: str) -> CfbError:
    return CfbError(
        f"--address {address}: no Ray cluster could be joined ({why.rstrip('.')}); start one with 'ray start --head' "
        "and run cfb sweep on one of its machines, or leave --address out."
    )


def _first_line(error: Exception) -> str:
    return next(iter(str(error).strip().splitlines()), type(error).__name__)


def _processors() -> int | None:
    """Processors that this process may use, if fewer than the machine has (SLURM, taskset); None lets Ray count."""
    if not hasattr(os, "sched_getaffinity"):
        return None
    allowed = len(os.sched_getaffinity(0))
    return allowed if allowed < (os.cpu_count() or 1) else None


def _require_room(ray: Any, needs: Needs, address: str | None) -> None:
    """Refuse tasks that need more than any machine has; Ray would wait for ever."""
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
    """Refuse nodes that do not see the sweep's or the current folder, or have another version of the library."""
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
                    f"{host} of the cluster does not see {missing}; the folders of a sweep must be on a file system "
                    "that all machines share, under the same path."
                )
            if version != __version__:
                raise CfbError(
                    f"{host} of the cluster has cfb_mjx {version}, this machine has {__version__}; install the same "
                    "version."
                )
