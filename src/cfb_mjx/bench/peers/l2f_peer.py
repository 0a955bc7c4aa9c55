"""Runs under a Python that has l2f, the simulator of Learning to Fly in C++: times steps of all drones.

Usage: python l2f_peer.py DRONES, a power of two up to 8192. Answers ``ready VERSION COMPILE_SECONDS STEPS``, then the
seconds of so many steps for every line it is sent. A step is its own, 10 ms by the method of Runge and Kutta, on drones
that it draws, called from Python once for all drones.
"""

import sys
import time
from importlib.metadata import version

import l2f
import numpy as np

STEPS = 20
drones = int(sys.argv[1])
vector = getattr(l2f, f"vector{drones}")
device, rng, world = l2f.Device(), vector.VectorRng(), vector.VectorEnvironment()
parameters, state, after = vector.VectorParameters(), vector.VectorState(), vector.VectorState()
vector.initialize_rng(device, rng, 0)
vector.initialize_environment(device, world)
vector.sample_initial_parameters(device, world, parameters, rng)
vector.sample_initial_state(device, world, parameters, state, rng)
commands = np.zeros((drones, 4), np.float32)


def fly():
    global state, after
    begin = time.perf_counter()
    for _ in range(STEPS):
        vector.step(device, world, parameters, state, commands, after, rng)
        state, after = after, state
    return time.perf_counter() - begin


fly()
print("ready", version("l2f"), 0.0, STEPS, flush=True)
for _ in sys.stdin:
    print(fly(), flush=True)
