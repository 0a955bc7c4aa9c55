"""Commands that several processes run as one: joining them, and the message if one of them ends.

This module does not import jax, which must not be loaded before `joined` begins. `cfb_mjx.hosts` is for the processes
after they have joined.
"""

from __future__ import annotations

import os
import re
import signal
import socket
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from ipaddress import ip_address

from cfb_mjx.errors import CfbError
from cfb_mjx.supervising import supervised

BOUND = "JAX_COORDINATOR_BIND_ADDRESS"
"""Environment variable with the address that process 0 listens on, if the others use another address."""
LOST = 3
"""Exit status of a process when another one of the group has ended."""
HEARTBEAT_S = 20
"""Time without a heartbeat after which a process counts as dead."""
JOINING_S, LEAVING_S, REFUSED_S = 120, 60, 5
"""Times to wait for all processes at the start, at the end, and after an error in the input."""


@dataclass(frozen=True)
class Hosts:
    """A group of processes.

    Attributes:
        coordinator: ``HOST:PORT`` of the first process, or ``auto``.
        processes: number of processes.
        process: number of this process.
    """

    coordinator: str
    processes: int | None = None
    process: int | None = None

    @classmethod
    def asked(cls, coordinator: str | None, processes: int | None, process: int | None) -> Hosts | None:
        """Return the group that the options describe; None if no option is given.

        Raises:
            CfbError: an option is missing or invalid.
        """
        if coordinator is None:
            if processes is not None or process is not None:
                raise CfbError("--processes and --process need --coordinator HOST:PORT, the address of process 0.")
            return None
        if coordinator == "auto":
            if processes is not None or process is not None:
                raise CfbError("--coordinator auto finds --processes and --process itself; leave them out.")
            return cls(coordinator)
        if not re.fullmatch(r".+:\d{1,5}", coordinator):
            raise CfbError(f"--coordinator {coordinator}: write HOST:PORT, the address of process 0, or auto.")
        if processes is None or process is None:
            raise CfbError(
                "--coordinator needs --processes N and --process I (0 to N - 1); or write --coordinator auto."
            )
        if not 0 <= process < processes:
            raise CfbError(f"--process {process}: with --processes {processes} it must be 0 to {processes - 1}.")
        return cls(coordinator, processes, process)


@contextmanager
def joined(hosts: Hosts | None, goes_on: str) -> Iterator[None]:
    """Run the block as one process of several, or alone if ``hosts`` is None.

    Call it before jax computes anything. If another process ends early, this one ends with the status `LOST` and one
    sentence.

    Args:
        hosts: the group of processes.
        goes_on: end of that sentence: the state of the results, and how to continue.

    Raises:
        CfbError: ``auto`` finds no cluster, or the coordinator's port is in use.
    """
    if hosts is None:
        yield
        return
    supervised(lambda status, printed: _explained(hosts, goes_on, status, printed))
    _join(hosts)
    import jax

    try:
        yield
        jax.distributed.shutdown()
    # os._exit skips the end of the interpreter, where jax would wait for the others and then treat them as dead.
    except KeyboardInterrupt:
        os._exit(130)
    except CfbError as error:
        print(f"cfb: {error}", file=sys.stderr, flush=True)
        _leave_soon()
        os._exit(2)
    except Exception as error:
        if not re.search(r"gloo|nccl|mpi|collective|coordination|heartbeat", str(error), re.IGNORECASE):
            raise
        # With more than two processes, the coordination service reports which one it was, and ends this process.
        if jax.process_count() > 2:
            time.sleep(2 * HEARTBEAT_S)
        os._exit(LOST)


def _leave_soon() -> None:
    """Give the other processes time to print their messages; they may have refused the same input."""
    import jax

    leaving = threading.Thread(target=jax.distributed.shutdown, daemon=True)
    leaving.start()
    leaving.join(REFUSED_S)


def _join(hosts: Hosts) -> None:
    import jax

    # This is the default only in newer versions.
    jax.config.update("jax_cpu_collectives_implementation", "gloo")
    given = {} if hosts.coordinator == "auto" else _arguments(hosts)
    try:
        jax.distributed.initialize(
            **given,
            initialization_timeout=JOINING_S,
            shutdown_timeout_seconds=LEAVING_S,
            heartbeat_timeout_seconds=HEARTBEAT_S,
        )
    except ValueError as error:
        raise CfbError(
            f"--coordinator auto: no cluster is found here ({error}); start cfb with srun or mpirun, or give "
            "--coordinator HOST:PORT --processes N --process I."
        ) from None
    except RuntimeError as error:
        raise CfbError(
            f"--coordinator {hosts.coordinator}: cannot listen there ({error}); use another port, or set "
            f"{BOUND} to the HOST:PORT to listen on."
        ) from None


def _arguments(hosts: Hosts) -> dict:
    if hosts.process == 0 and BOUND not in os.environ:
        _require_reachable(hosts.coordinator)
    return {
        "coordinator_address": hosts.coordinator,
        "num_processes": hosts.processes,
        "process_id": hosts.process,
        # By default jax listens on all addresses of the machine, for anybody who can reach one of them.
        "coordinator_bind_address": os.environ.get(BOUND, hosts.coordinator),
        # The options describe the group completely; do not search for a cluster.
        "cluster_detection_method": "deactivate",
    }


def _require_reachable(coordinator: str) -> None:
    """Refuse the machine's own name if it resolves to a loopback address, as it often does."""
    name = coordinator.rpartition(":")[0]
    try:
        addresses = {str(found[4][0]) for found in socket.getaddrinfo(name.strip("[]"), None)}
    except OSError as error:
        raise CfbError(f"--coordinator {coordinator}: {name} has no address here ({error.strerror}).") from None
    typed = name == "localhost" or addresses == {name.strip("[]")}
    if not typed and all(ip_address(a.partition("%")[0]).is_loopback for a in addresses):
        raise CfbError(
            f"--coordinator {coordinator}: {name} is {', '.join(sorted(addresses))} on this machine, where no other "
            f"machine can reach process 0; give its address, or set {BOUND} to the HOST:PORT to listen on."
        )


def _explained(hosts: Hosts, goes_on: str, status: int, printed: str) -> tuple[int, str] | None:
    if status == LOST:
        return LOST, f"{_other(hosts, printed)} stopped; {goes_on}"
    if status == -signal.SIGABRT and "RegisterTask" in printed:
        return LOST, (
            f"--coordinator {hosts.coordinator}: not all processes joined within {JOINING_S} s; start every process "
            "with the same --coordinator and --processes, and with its own --process."
        )
    if status == -signal.SIGABRT and re.search("distributed service detected fatal|coordination", printed):
        return LOST, f"{_other(hosts, printed)} stopped or cannot be reached; {goes_on}"
    if status == -signal.SIGKILL:
        return 128 + signal.SIGKILL, f"this process was killed, perhaps because it ran out of memory; {goes_on}"
    if status == 130:
        return 130, "interrupted; earlier results are as they were."
    # The output of the libraries is not shown if the process ended normally.
    return (status, "") if status in (0, 2) else None


def _other(hosts: Hosts, printed: str) -> str:
    """Return the name of the process that has ended, as far as it is known."""
    unhealthy = re.search(r"unhealthy \(stopped sending heartbeats\):\s*((?:\d+\s+)+)", printed)
    if hosts.process is not None and hosts.processes == 2:
        return f"process {1 - hosts.process} of 2"
    if unhealthy:
        return f"process {', '.join(unhealthy[1].split())}" + (f" of {hosts.processes}" if hosts.processes else "")
    if "leader task" in printed:
        return "process 0"
    return "another process"
