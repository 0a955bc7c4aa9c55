"""Commands that several processes run as one: joining, and what is said when one of them is gone.

Without jax, which must not be there yet when `joined` begins; what joined processes agree on is `cfb_mjx.hosts`.
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
"""The environment variable that says where process 0 listens, if not where the others find it."""
LOST = 3
"""Exit status of a process whose fellows are gone."""
HEARTBEAT_S = 20
"""A process is believed dead that has been silent for so long."""
JOINING_S, LEAVING_S, REFUSED_S = 120, 60, 5
"""How long all are waited for at the start, at the end, and at an end with a refusal."""


@dataclass(frozen=True)
class Hosts:
    """Where the processes meet (``HOST:PORT`` of the first, or ``auto``), how many they are, and which this is."""

    coordinator: str
    processes: int | None = None
    process: int | None = None

    @classmethod
    def asked(cls, coordinator: str | None, processes: int | None, process: int | None) -> Hosts | None:
        """From the options; None where none is given.

        Raises:
            CfbError: some are missing, or impossible.
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
            raise CfbError(f"--process {process}: with --processes {processes} it is 0 to {processes - 1}.")
        return cls(coordinator, processes, process)


@contextmanager
def joined(hosts: Hosts | None, goes_on: str) -> Iterator[None]:
    """Run the block as one process of several; without ``hosts``, just run it.

    Call it before jax computes anything. Where another process is gone this one ends with the status `LOST` and one
    sentence.

    Args:
        hosts: the others.
        goes_on: the end of that sentence: what is left, and how to go on.

    Raises:
        CfbError: no cluster is found by ``auto``, or the coordinator's port is taken.
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
    # Not through the interpreter's end: there jax waits for the others, and then ends this process as if they had died.
    except KeyboardInterrupt:
        os._exit(130)
    except CfbError as error:
        print(f"cfb: {error}", file=sys.stderr, flush=True)
        _leave_soon()
        os._exit(2)
    except Exception as error:
        if not re.search(r"gloo|nccl|mpi|collective|coordination|heartbeat", str(error), re.IGNORECASE):
            raise
        # Of several the coordination service will say which one it was, and end this process as it does.
        if jax.process_count() > 2:
            time.sleep(2 * HEARTBEAT_S)
        os._exit(LOST)


def _leave_soon() -> None:
    """Give the others, who may have been refused with the same sentence, time to say it."""
    import jax

    leaving = threading.Thread(target=jax.distributed.shutdown, daemon=True)
    leaving.start()
    leaving.join(REFUSED_S)


def _join(hosts: Hosts) -> None:
    import jax

    # The default of newer versions only.
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
            f"--coordinator auto: no cluster is found here ({error}); start with srun or mpirun, or give "
            "--coordinator HOST:PORT --processes N --process I."
        ) from None
    except RuntimeError as error:
        raise CfbError(
            f"--coordinator {hosts.coordinator}: cannot listen there ({error}); take another port, or set "
            f"{BOUND} to the HOST:PORT that this machine has for it."
        ) from None


def _arguments(hosts: Hosts) -> dict:
    if hosts.process == 0 and BOUND not in os.environ:
        _require_reachable(hosts.coordinator)
    return {
        "coordinator_address": hosts.coordinator,
        "num_processes": hosts.processes,
        "process_id": hosts.process,
        # Left alone, jax listens on all addresses of the machine, to whoever can reach one of them.
        "coordinator_bind_address": os.environ.get(BOUND, hosts.coordinator),
        # All is said: whatever cluster this may be is not to be asked.
        "cluster_detection_method": "deactivate",
    }


def _require_reachable(coordinator: str) -> None:
    """Refuse the machine's own name where, as on many, only the machine itself can reach it by that name."""
    name = coordinator.rpartition(":")[0]
    try:
        addresses = {str(found[4][0]) for found in socket.getaddrinfo(name.strip("[]"), None)}
    except OSError as error:
        raise CfbError(f"--coordinator {coordinator}: {name} has no address here ({error.strerror}).") from None
    typed = name == "localhost" or addresses == {name.strip("[]")}
    if not typed and all(ip_address(a.partition("%")[0]).is_loopback for a in addresses):
        raise CfbError(
            f"--coordinator {coordinator}: here {name} is {', '.join(sorted(addresses))}, where no other machine can "
            f"reach process 0; give its address, or set {BOUND} to the HOST:PORT to listen on."
        )


def _explained(hosts: Hosts, goes_on: str, status: int, printed: str) -> tuple[int, str] | None:
    if status == LOST:
        return LOST, f"{_other(hosts, printed)} stopped; {goes_on}"
    if status == -signal.SIGABRT and "RegisterTask" in printed:
        return LOST, (
            f"--coordinator {hosts.coordinator}: not all processes came together there within {JOINING_S} s; start "
            "every process, with one coordinator, one number of processes and a number of its own."
        )
    if status == -signal.SIGABRT and re.search("distributed service detected fatal|coordination", printed):
        return LOST, f"{_other(hosts, printed)} stopped or cannot be reached; {goes_on}"
    if status == -signal.SIGKILL:
        return 128 + signal.SIGKILL, f"this process was killed, for want of memory perhaps; {goes_on}"
    if status == 130:
        return 130, "interrupted; earlier results are as they were."
    # What the libraries of a process that ended by itself print is of no interest.
    return (status, "") if status in (0, 2) else None


def _other(hosts: Hosts, printed: str) -> str:
    """Which process is gone, as far as it can be known."""
    unhealthy = re.search(r"unhealthy \(stopped sending heartbeats\):\s*((?:\d+\s+)+)", printed)
    if hosts.process is not None and hosts.processes == 2:
        return f"process {1 - hosts.process} of 2"
    if unhealthy:
        return f"process {', '.join(unhealthy[1].split())}" + (f" of {hosts.processes}" if hosts.processes else "")
    if "leader task" in printed:
        return "process 0"
    return "another process"
