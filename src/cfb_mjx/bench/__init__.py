"""Benchmarks: workloads, the limits of a machine, and the page with the results."""
