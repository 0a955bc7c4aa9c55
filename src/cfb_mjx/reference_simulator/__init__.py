"""Independent simulator of the drone with feedback control, for labelled test data.

It shares no code with the library but `FlightLog`. `fly_campaigns` returns the logs of drones that are nominal or have
one or more of `EFFECTS`, flown by the simulator's own controller. `simulation.simulate` flies them with another one, an
`controller.OtherController`.
"""

from cfb_mjx.reference_simulator.campaigns import Campaign, Case, fly_campaigns
from cfb_mjx.reference_simulator.effects import EFFECTS, OUTSIDE, PAIRED, label

__all__ = ["EFFECTS", "OUTSIDE", "PAIRED", "Campaign", "Case", "fly_campaigns", "label"]
