"""Runs under a Python that has crazyflow (not cfb_mjx): times ``sim.step(500)`` once for every line it is sent.

Usage: python crazyflow_peer.py DRONES. Answers ``ready VERSION COMPILE_SECONDS``, then seconds per request.
"""

import contextlib
import sys
import time
import warnings

warnings.filterwarnings("ignore")
with contextlib.redirect_stdout(sys.stderr):
    from importlib.metadata import version

    import crazyflow
    import jax
    import numpy as np
    from crazyflow.control import Control
    from crazyflow.sim import Sim

    drones = int(sys.argv[1])
    sim = Sim(
        n_worlds=drones,
        n_drones=1,
        drone="cf21B_500",
        dynamics="first_principles",
        control=Control.rotor_vel,
        freq=500,
        device="cpu" if jax.default_backend() == "cpu" else "gpu",
    )
    sim.rotor_vel_control(np.full((drones, 1, 4), 16000.0, dtype=np.float32))
    begin = time.perf_counter()
    sim.step(500)
    jax.block_until_ready(sim.data.states.pos)
    compiled = time.perf_counter() - begin

assert crazyflow is not None
print("ready", version("crazyflow"), compiled, flush=True)
for _ in sys.stdin:
    # A fresh command each time, as a user's loop would set one.
    sim.rotor_vel_control(np.full((drones, 1, 4), 16000.0, dtype=np.float32))
    begin = time.perf_counter()
    sim.step(500)
    jax.block_until_ready(sim.data.states.pos)
    print(time.perf_counter() - begin, flush=True)
