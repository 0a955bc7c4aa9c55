"""Drones and compiled functions the model tests share; compiling costs far more than running here."""

from __future__ import annotations

import equinox as eqx
import helpers
import jax
import jax.numpy as jnp
import pytest

from cfb_mjx.model import rollout
from cfb_mjx.parameters import Parameters, load_model_file, load_randomisation, sample_parameters


@pytest.fixture(scope="module")
def write(tmp_path_factory):
    """Write a text into a file of the module's own folder; returns its path."""
    folder = tmp_path_factory.mktemp("mjcf")

    def write(text: str, name: str) -> str:
        (folder / name).write_text(text)
        return str(folder / name)

    return write


@pytest.fixture(scope="session")
def guards() -> Parameters:
    return load_model_file("cfb-guards").parameters()


@pytest.fixture(scope="session")
def off_center(guards) -> Parameters:
    """Centre of gravity away from the rotors' centre on every axis."""
    return eqx.tree_at(lambda p: p.center_of_gravity, guards, jnp.array([0.010, -0.006, 0.004]))


@pytest.fixture(scope="session")
def drones(guards, off_center) -> list[Parameters]:
    """Nominal, off centre, and one drawn from the paper's ranges with an affine motor map."""
    drawn = sample_parameters(jax.random.key(3), guards, load_randomisation("paper"))
    drawn = eqx.tree_at(lambda p: p.motor_speed_offset, drawn, jnp.array([100.0, 0.0, 50.0, 20.0]))
    return [guards, off_center, drawn]


@pytest.fixture(scope="session")
def fleet(drones) -> Parameters:
    """`drones` with a leading batch axis."""
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *drones)


@pytest.fixture(scope="session")
def fly_fleet():
    """``rollout`` vmapped over models, one state and one command sequence for all."""
    return _fly_fleet


_fly_fleet = jax.jit(jax.vmap(rollout, in_axes=(0, None, None)), compiler_options=helpers.QUICK_COMPILE)
