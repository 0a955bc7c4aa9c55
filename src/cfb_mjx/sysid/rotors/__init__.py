"""Fits of the rotors on their own: motor dynamics, thrust and torque maps."""
