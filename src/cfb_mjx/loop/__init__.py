"""Demonstration of the whole cycle: fly, correct the model, train on the corrected model, fly the same drone again.

The drones fly in the reference simulator (`cfb_mjx.reference_simulator`), which shares no code with the model.
"""
