"""What the paper measured on its real drone."""

PAPER_HOVER = {0.0: (284.76, 0.0203), 0.5: (100.07, 0.0245), 1.0: (43.16, 0.0197), 1.5: (71.39, 0.0548)}
PAPER_FIRMWARE = {"pid": (27.81, 0.0226), "mellinger": (54.68, 0.0394)}
"""The paper's hover tests on its real drone, networks by magnitude: mean distance in mm, command std."""
