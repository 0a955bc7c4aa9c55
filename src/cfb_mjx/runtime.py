"""How commands run jax: precision, compile cache, versions, progress."""

from __future__ import annotations

import os
import platform
import sys
from datetime import date
from importlib import metadata
from pathlib import Path

from cfb_mjx import __version__
from cfb_mjx.interrupts import held_back
from cfb_mjx.terminal import shown

XLA_CPU_FLAGS = "--xla_backend_extra_options=xla_cpu_use_multi_output_fusion=true"
"""Option that makes a time step on CPU up to 4 times faster: a few kernels share their results, instead of about
thirty that repeat computations. It has no effect elsewhere. XLA reads it when jax starts its first backend, so commands
set it themselves, and scripts put it into XLA_FLAGS (docs/model.md). It is not used for derivatives of the MJX body,
because jaxlib 0.10.1 aborts while it compiles some of them (`differentiate_mjx`). It is not used from jaxlib 0.11 on:
with 0.12, a rollout that keeps its states was 150 times slower with the option, whatever its value, and fits 15 times.
"""
_OPTION_UNTIL = (0, 11)

_CPU_DEVICES = "xla_force_host_platform_device_count"


def configure_jax(x64: bool, devices: int = 1) -> None:
    """Set the precision and the persistent compile cache of jax. Commands call this; importing the library does not.

    The cache is in the user's cache folder (``XDG_CACHE_HOME`` is respected); ``JAX_COMPILATION_CACHE_DIR`` overrides
    it. If jax has not been loaded yet, `XLA_CPU_FLAGS` are set as well.

    Args:
        x64: use 64-bit floats.
        devices: number of jax devices that a CPU is divided into, unless ``XLA_FLAGS`` sets it.
    """
    set_up_xla()
    flags = os.environ.get("XLA_FLAGS", "")
    if devices > 1 and _CPU_DEVICES not in flags:
        os.environ["XLA_FLAGS"] = f"{flags} --{_CPU_DEVICES}={devices}".strip()
    with held_back():
        import jax

    jax.config.update("jax_enable_x64", x64)
    # Tensor-core formats round inputs to 10 bits, which changes a trained policy.
    jax.config.update("jax_default_matmul_precision", "highest")
    if not os.environ.get("JAX_COMPILATION_CACHE_DIR"):
        folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "cfb_mjx" / "jax"
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError:
            return  # Without a writable home there is no cache.
        jax.config.update("jax_compilation_cache_dir", str(folder))
    # Small programs too: together they took a quarter of a short command's time.
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)


def set_up_xla() -> None:
    """Set the environment variables that jaxlib reads when it loads; later calls have no effect.

    `XLA_CPU_FLAGS` are added to ``XLA_FLAGS`` for versions that profit from them, unless it has extra options already.
    """
    # For programs from the compile cache XLA logs an error about tuning hints that it mistakes for processor features.
    # Real errors reach Python as exceptions.
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    if _option_helps() and "xla_backend_extra_options" not in os.environ.get("XLA_FLAGS", ""):
        os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {XLA_CPU_FLAGS}".strip()


def _option_helps() -> bool:
    """Whether `XLA_CPU_FLAGS` make this version of jaxlib faster."""
    numbers = metadata.version("jaxlib").split(".")[:2]
    return tuple(int(n) for n in numbers if n.isdigit()) < _OPTION_UNTIL


def differentiate_mjx() -> None:
    """Remove `XLA_CPU_FLAGS`, for derivatives of the MJX body; call it before jax computes anything."""
    os.environ["XLA_FLAGS"] = os.environ.get("XLA_FLAGS", "").replace(XLA_CPU_FLAGS, "").strip()


def cores() -> int:
    """Return the number of CPU cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def say(text: str) -> None:
    """Print a line of progress to standard error."""
    print(f"... {text}", file=sys.stderr, flush=True)


def environment() -> dict[str, str]:
    """Return date, machine and versions, which are stored with every measured number."""
    import jax

    versions = {name: metadata.version(name) for name in ("jax", "jaxlib", "mujoco", "mujoco-mjx", "numpy")}
    return {
        "date": date.today().isoformat(),
        "processor": f"{_processor()}, {os.cpu_count()} cores",
        "device": f"{jax.devices()[0].device_kind} x {jax.device_count()}",
        "python": platform.python_version(),
        # The metadata of an editable install may have an old version.
        "cfb_mjx": __version__,
        **versions,
    }


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


class Progress:
    """Progress bar: one line on standard error, rewritten in place; silent if that is not a terminal."""

    def __init__(self, what: str):
        self.what = what
        self.live = sys.stderr.isatty()

    def __call__(self, done: int, total: int, more: str = "") -> None:
        if not self.live:
            return
        filled = round(30 * done / max(total, 1))
        end = "\n" if done >= total else ""
        # Clear the rest of an earlier, longer line.
        line = shown(f"{self.what} [{'#' * filled}{'.' * (30 - filled)}] {done}/{total} {more}")
        self._write(f"\r{line}\x1b[K{end}")

    def clear(self) -> None:
        """Clear the line, before other text is printed."""
        if self.live:
            self._write("\r\x1b[K")

    def _write(self, text: str) -> None:
        print(text, end="", file=getattr(sys.stderr, "unescaped", sys.stderr), flush=True)
