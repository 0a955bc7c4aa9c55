"""A closed-loop simulator of the drone that shares nothing with the library but `FlightLog`: labelled data.

`fly_campaigns` returns the logs of drones that are nominal or have one or more of `EFFECTS`, flown by a controller of
its own; `simulation.simulate` flies them with any other, an `other_controller.OtherController`.
"""

from cfb_mjx.reference_simulator.campaigns import Campaign, Case, fly_campaigns
from cfb_mjx.reference_simulator.effects import EFFECTS, OUTSIDE, label

__all__ = ["EFFECTS", "OUTSIDE", "Campaign", "Case", "fly_campaigns", "label"]
