"""What a worker process must be told before jax loads in it."""

from __future__ import annotations

_THREADS: tuple[str, ...] = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NPROC", "PJRT_NPROC")
"""Of BLAS and the like; the last two of XLA."""


def environment(cpus: float, gpus: float) -> dict[str, str]:
    """Environment variables that hold a task to its share of a machine.

    Args:
        cpus: of the task: that many threads, at least one.
        gpus: of the task; without one jax computes on processors, also where a GPU is free.
    """
    threads = max(1, int(cpus))
    found: dict[str, str] = dict.fromkeys(_THREADS, str(threads))
    if not gpus:
        found["JAX_PLATFORMS"] = "cpu"
    elif gpus < 1:
        # jax takes three quarters of a GPU unless told otherwise; tasks that share one need room beside each other.
        found["XLA_PYTHON_CLIENT_MEM_FRACTION"] = f"{0.9 * gpus:.3f}"
    return found
