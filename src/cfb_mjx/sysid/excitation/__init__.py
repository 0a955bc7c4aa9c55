"""Experiment design: manoeuvres, their simulation, and the expected uncertainty of a fit to them."""
