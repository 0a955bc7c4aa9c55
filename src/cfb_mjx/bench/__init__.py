"""Measuring speed: workloads, what a machine can do, and the page about it."""
