"""Settings of the whole test session: float64, a compilation cache, and shape checks of the model's annotations."""

from __future__ import annotations

import gc
import os
from pathlib import Path
from pkgutil import iter_modules

import cfb_mjx
from cfb_mjx.plugins import plugged
from cfb_mjx.runtime import set_up_xla

# As the commands do: large programs compile in half the time. Not for derivatives of MJX (`make test-long`): there
# jaxlib aborts as soon as the option is named, whatever its value.
if not os.environ.get("PLAIN_XLA"):
    set_up_xla()

import jax
import pytest
from jaxtyping import install_import_hook

# Float64 so that tests can tell a wrong term from rounding; model/test_rollout.py covers float32.
jax.config.update("jax_enable_x64", True)

# Tracing a program allocates a great many short-lived objects beside a heap of millions that stay: collecting as often
# as Python does on its own took a quarter of the time of the tests that trace most.
gc.set_threshold(50_000, 20, 10)

# Annotated shapes and dtypes are checked in tests only. Must run before anything imports these packages. Not in
# `Vec`, whose arithmetic of single numbers has no shapes to check: that took a fifth of the time of tests that trace.
MODEL = Path(cfb_mjx.__file__).with_name("model")
CHECKED = [f"cfb_mjx.model.{module.name}" for module in iter_modules([str(MODEL)]) if module.name != "vector"]
CHECKED += ["cfb_mjx.engine", "cfb_mjx.parameters", "cfb_mjx.envs", "cfb_mjx.control"]
install_import_hook(CHECKED, "beartype.beartype")


def pytest_configure(config) -> None:
    """Keep compiled programs beside pytest's own cache: a second run then spends its time on running."""
    cache = getattr(config, "cache", None)
    if cache is None:  # run with -p no:cacheprovider
        return
    jax.config.update("jax_compilation_cache_dir", str(cache.mkdir("jax")))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.3)


SETTINGS = (
    "jax_enable_x64",
    "jax_compilation_cache_dir",
    "jax_persistent_cache_min_compile_time_secs",
    "jax_default_matmul_precision",
)


@pytest.fixture(autouse=True)
def settings_as_before():
    """Commands that a test runs in this process set up jax as they need it, and a test may register effects; the next
    one must not notice."""
    before = {name: getattr(jax.config, name) for name in SETTINGS}
    with plugged():
        yield
    for name, value in before.items():
        if getattr(jax.config, name) != value:
            jax.config.update(name, value)


@pytest.fixture(autouse=True)
def in_haste(request, monkeypatch):
    """Compile in haste for tests that compile far more than they run (mark ``haste``); jax has no setting for it."""
    if request.node.get_closest_marker("haste") is None:
        return
    from jax._src import compiler

    from tests.helpers import haste

    options, wanted = compiler.get_compile_options, haste()
    monkeypatch.setattr(
        compiler,
        "get_compile_options",
        lambda *args, **given: options(
            *args, **given | {"env_options_overrides": wanted | (given.get("env_options_overrides") or {})}
        ),
    )


MAPS = Path("/proc/self/maps")
MANY_MAPS, MOST_MAPS = 20_000, 40_000
"""Linux gives a process 65530 memory maps, and every compiled program keeps some: a worker that keeps the programs of
the whole suite dies while it compiles."""


def _forget_programs(beyond: int) -> None:
    if MAPS.exists() and MAPS.read_bytes().count(b"\n") > beyond:
        jax.clear_caches()
        gc.collect()


@pytest.fixture(autouse=True, scope="module")
def few_programs():
    """Forget compiled programs between modules once they are many."""
    yield
    _forget_programs(beyond=MANY_MAPS)


@pytest.fixture(autouse=True)
def not_too_many_programs(request):
    """Within a module that compiles a lot (mark ``haste``), whose tests share some, when they are far too many."""
    yield
    if request.node.get_closest_marker("haste") is not None:
        _forget_programs(beyond=MOST_MAPS)
