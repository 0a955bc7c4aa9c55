"""Time of the first rollout in a new process, with an empty and with a filled compile cache."""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from typing import Any

DRONES = 4096
START_UP = {"import cfb_mjx": 0.7, "cfb --help": 0.3}
"""What `start_up` measures, and the time that it should take at most, s."""


def start_up() -> list[dict[str, Any]]:
    """Measure whole processes: rows with ``command`` and ``seconds``, the best of three."""
    words = {
        "import cfb_mjx": ["-c", "import cfb_mjx"],
        "cfb --help": ["-c", "from cfb_mjx.cli import main; main()", "--help"],
    }
    rows = []
    for command in START_UP:
        times = []
        for _ in range(3):
            begin = time.perf_counter()
            subprocess.run([sys.executable, *words[command]], capture_output=True, check=True)
            times.append(time.perf_counter() - begin)
        rows.append({"command": command, "seconds": min(times)})
    return rows


def first_call() -> list[dict[str, Any]]:
    """Measure the first rollout, each time in a new process with the compile cache in a temporary folder.

    Returns:
        Rows with ``cache`` (``empty``, or ``filled`` by the first row), ``import_s`` and ``call_s``.
    """
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for cache in ("empty", "filled"):
            done = subprocess.run(
                [sys.executable, "-m", "cfb_mjx.bench.first_call", folder], capture_output=True, text=True, check=True
            )
            import_s, call_s = map(float, done.stdout.split())
            rows.append({"cache": cache, "import_s": import_s, "call_s": call_s})
    return rows


def _measure(cache: str) -> None:
    begin = time.perf_counter()
    import os

    os.environ["JAX_COMPILATION_CACHE_DIR"] = cache
    from cfb_mjx.runtime import configure_jax

    configure_jax(x64=False)
    import jax
    import jax.numpy as jnp

    from cfb_mjx.model import Quadrotor, rollout_final

    imported = time.perf_counter()
    model = Quadrotor.from_file("cfb-guards")
    commands = model.hover_command() * jnp.linspace(0.99, 1.01, DRONES)[:, None, None] * jnp.ones((125, 1))
    fly = jax.jit(jax.vmap(rollout_final, in_axes=(None, None, 0)))
    jax.block_until_ready(fly(model, model.hover_state(), commands))
    print(imported - begin, time.perf_counter() - imported)


if __name__ == "__main__":
    _measure(sys.argv[1])
