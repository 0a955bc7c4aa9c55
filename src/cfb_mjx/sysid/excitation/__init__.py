"""Experiment design: manoeuvres, their simulated flight, and what a fit will know of it."""
