"""A closed-loop simulator of the drone that shares nothing with the library but `FlightLog`: labelled test data.

`fly_campaigns` returns the logs of drones that are nominal or have one or more of `EFFECTS`.
"""

from plants.campaigns import Campaign, Case, fly_campaigns
from plants.effects import EFFECTS, OUTSIDE, label

__all__ = ["EFFECTS", "OUTSIDE", "Campaign", "Case", "fly_campaigns", "label"]
