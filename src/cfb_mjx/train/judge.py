"""Evaluate a position controller: on the nominal drone, on randomised drones, and on a set of drones with effects."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np

from cfb_mjx.control.controllers import Controller
from cfb_mjx.envs import TargetTask
from cfb_mjx.model import Quadrotor
from cfb_mjx.parameters import load_model_file, load_randomisation
from cfb_mjx.train.flying import Hover, hover, load_plants

FLIGHTS, RANDOM_DRONES = 64, 512
SENSORS = {
    "pose 24 ms late, the gyro read on the drone": ({"pose_delay": 0.024}, False, {}),
    "all 16 ms late": ({"pose_delay": 0.016}, True, {}),
    "pose noise 0.5 mm and 0.5 deg, gyro 0.05 rad/s": (
        {},
        None,
        {"position_m": 0.0005, "attitude_rad": math.radians(0.5), "rate_radps": 0.05},
    ),
}
"""Variants of the sensors: changed parameters of the nominal drone, whether the gyro is as late as the pose (None: as
the controller was trained), and changed noise of the estimates."""


class Judge:
    """Evaluates controllers in the paper's hover test.

    Args:
        plants: name of a set of drones with effects (`load_plants`); None: no such drones.
        random_drones: number of drones from the paper's full randomisation.
    """

    def __init__(self, plants: str | None = "off-nominal", random_drones: int = RANDOM_DRONES):
        self.described = load_model_file("cfb-guards")
        self.nominal = Quadrotor.from_file(self.described)
        self.plants = {} if plants is None else load_plants(self.described, plants)
        self.calm, self.wild = TargetTask(), TargetTask(randomisation=load_randomisation("paper"))
        self.few = jax.random.split(jax.random.PRNGKey(0), FLIGHTS)
        self.many = jax.random.split(jax.random.PRNGKey(1), random_drones)

    def __call__(self, controller: Controller) -> dict:
        """Hover error and command std, for JSON; over randomised drones the median of those that did not fail."""

        def measure(task, drone, keys, middle):
            return summary(hover(controller, task, drone, keys)[0], middle)

        score = {"nominal": measure(self.calm, self.nominal, self.few, np.mean)}
        if len(self.many):
            score["random"] = measure(self.wild, self.nominal, self.many, np.median)
        return score | {
            "plants": {name: measure(self.calm, drone, self.few, np.mean) for name, drone in self.plants.items()}
        }

    def with_sensors(self, controller: Controller, lumped_delay: bool = True) -> dict[str, dict]:
        """Hover test on the nominal drone with sensors that are later and noisier than the model's (`SENSORS`).

        Args:
            controller: the controller.
            lumped_delay: whether the controller was trained with a gyro as late as the pose.
        """
        found = {}
        for name, (changes, lumped, noise) in SENSORS.items():
            changed = {key: jnp.asarray(value, self.nominal.parameters.mass.dtype) for key, value in changes.items()}
            drone = replace(self.nominal, parameters=replace(self.nominal.parameters, **changed))
            lumped = lumped_delay if lumped is None else lumped
            task = replace(self.calm, lumped_delay=lumped, noise=replace(self.calm.noise, **noise))
            found[name] = summary(hover(controller, task, drone, self.few)[0], np.mean)
        return found


def summary(measured: Hover, middle: Callable[[np.ndarray], float]) -> dict:
    """Summary of many hover flights, for JSON: error, command std and share of failures.

    Args:
        measured: measurements of the flights.
        middle: mean or median; applied to the flights that did not fail. The result is None if all failed.
    """
    well = ~np.asarray(measured.failed)
    numbers = {
        "hover_mm": 1e3 * np.asarray(measured.mean_distance_m),
        "horizontal_mm": 1e3 * np.asarray(measured.horizontal_m),
        "vertical_mm": 1e3 * np.asarray(measured.vertical_m),
        "command_std": np.asarray(measured.command_std),
    }
    found = {name: float(middle(values[well])) if well.any() else None for name, values in numbers.items()}
    return found | {"failed": float(1 - well.mean())}


def away(score: dict, key: str) -> float | None:
    """Mean over the set of drones with effects; None if one of them failed."""
    values = [plant[key] for plant in score["plants"].values()]
    lost = any(plant["failed"] > 0 or plant[key] is None for plant in score["plants"].values())
    return None if lost else sum(values) / len(values)
