"""Environment of a worker process, set before jax loads."""

from __future__ import annotations

_THREADS: tuple[str, ...] = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NPROC", "PJRT_NPROC")
"""Numbers of threads of BLAS libraries; the last two are XLA's."""


def environment(cpus: float, gpus: float) -> dict[str, str]:
    """Return environment variables that limit a task to its share of a machine.

    Args:
        cpus: processors of the task; it gets as many threads, at least one.
        gpus: GPUs of the task; with 0, jax uses the processors even if a GPU is free.
    """
    threads = max(1, int(cpus))
    found: dict[str, str] = dict.fromkeys(_THREADS, str(threads))
    if not gpus:
        found["JAX_PLATFORMS"] = "cpu"
    elif gpus < 1:
        # By default jax reserves three quarters of a GPU; tasks that share one must leave room for each other.
        found["XLA_PYTHON_CLIENT_MEM_FRACTION"] = f"{0.9 * gpus:.3f}"
    return found
