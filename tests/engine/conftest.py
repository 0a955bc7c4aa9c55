"""The drones that tests of the model fly, too."""

from tests.model.conftest import drones, fleet, fly_fleet, guards, off_center

__all__ = ["drones", "fleet", "fly_fleet", "guards", "off_center"]
