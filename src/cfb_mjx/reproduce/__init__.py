"""Reproduction of the paper's figures and tables, with its numbers next to ours."""

from cfb_mjx.reproduce import brushed, constants, controllers, flips, manoeuvres, motors
from cfb_mjx.reproduce.item import Item, Result, Row

ITEMS = {
    "parameters": Item("table of parameters and ranges of the randomisation", constants.parameters, False),
    "motor-step": Item("motor step response with fitted T and K", motors.motor_step, True),
    "rotor-curves": Item("thrust and torque curves with fitted cubics", motors.rotor_curves, True),
    "hover-to-forward": Item("hover to horizontal flight in 4096 simulations", manoeuvres.hover_to_forward, True, True),
    "yaw-disturbance": Item("a yaw disturbance in 4096 simulations", manoeuvres.yaw_disturbance, True, True),
    "brushed": Item("comparison with the brushed Crazyflie of gym-pybullet-drones", brushed.brushed, True, True),
    "back-and-forth": Item("six metres back and forth", controllers.back_and_forth, False),
    "controllers": Item("hover of the network, PID and Mellinger", controllers.controllers, False),
    "randomisation": Item("hover error over the magnitude of the randomisation", controllers.randomisation, False),
    "flips": Item("four single flips in the YZ plane", flips.four_flips, False),
    "double-flip": Item("the double flip", flips.double_flip, False),
}
"""Figures and tables by name, in the order of the paper."""

__all__ = ["ITEMS", "Item", "Result", "Row"]
