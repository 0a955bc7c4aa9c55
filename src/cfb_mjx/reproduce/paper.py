"""Results of the paper's measurements on its real drone."""

PAPER_HOVER = {0.0: (284.76, 0.0203), 0.5: (100.07, 0.0245), 1.0: (43.16, 0.0197), 1.5: (71.39, 0.0548)}
PAPER_FIRMWARE = {"pid": (27.81, 0.0226), "mellinger": (54.68, 0.0394)}
"""The paper's hover tests (mean distance, mm; command std): networks by magnitude, and the firmware's controllers."""
