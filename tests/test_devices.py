"""Two devices compute what one does. Devices of a CPU are made when jax starts, so both runs have their own process."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest

from cfb_mjx.devices import Devices
from cfb_mjx.errors import CfbError

pytestmark = pytest.mark.xdist_group("devices")

WORKER = Path(__file__).with_name("on_devices.py")
ALIKE = {"rollout": 1e-12, "evaluation": 1e-12, "fit": 1e-6, "shooting": 1e-6, "flights": 2e-4}
"""Relative tolerances. Rollouts and predictions are computed in doubles, and every one by itself. Fits add up over
devices, and stop at a thousandth of a standard deviation, from which rounding may keep them. Flights are of single
precision, and feedback amplifies its rounding over six seconds."""


def run(folder: Path, *names: str) -> list[dict[str, np.ndarray]]:
    """Results of one device and of two."""
    results = []
    for devices in (1, 2):
        done = subprocess.run(
            [sys.executable, WORKER, str(devices), folder / f"{devices}.npz", *names],
            capture_output=True,
            text=True,
            timeout=400,
            check=False,
            env=os.environ | {"JAX_COMPILATION_CACHE_DIR": str(jax.config.jax_compilation_cache_dir or folder)},
        )
        assert done.returncode == 0, done.stderr
        with np.load(folder / f"{devices}.npz") as archive:
            results.append(dict(archive))
    return results


@pytest.fixture(scope="module")
def found(tmp_path_factory) -> list[dict[str, np.ndarray]]:
    """All that is not too long to compile."""
    return run(tmp_path_factory.mktemp("devices"), *(what for what in ALIKE if what != "shooting"))


@pytest.mark.parametrize("what", [what for what in ALIKE if what != "shooting"])
def test_two_devices_compute_what_one_does(found, what):
    same(what, found)


@pytest.mark.long
def test_two_devices_shoot_as_one_does(tmp_path):
    same("shooting", run(tmp_path, "shooting"))


def same(what: str, found: list[dict[str, np.ndarray]]) -> None:
    one, two = (result[what] for result in found)
    assert np.all(np.isfinite(one))
    assert np.ptp(one) > 0
    np.testing.assert_allclose(two, one, rtol=ALIKE[what], atol=ALIKE[what] * np.abs(one).max() * 1e-3)


def test_fewer_devices_than_asked_for_are_refused():
    with pytest.raises(CfbError, match=r"--devices \d+: only \d+ are available"):
        Devices.take(jax.local_device_count() + 1)
    with pytest.raises(CfbError, match="--devices must be at least 1"):
        Devices.take(0)


def test_one_device_changes_nothing():
    over = Devices.take()
    batch = {"a": np.arange(3.0)}
    assert over.along(batch) is batch
    assert over.whole(batch) is batch
    np.testing.assert_array_equal(over.mapped(lambda x: 2 * x)(batch["a"]), [0.0, 2.0, 4.0])
