"""Runs under a Python that has MuJoCo: times steps of `mujoco.batch` alone, MuJoCo's C on all cores it may use.

Usage: python mujoco_batch_peer.py DRONES MJCF HEIGHT. Answers ``ready VERSION COMPILE_SECONDS STEPS``, then the seconds
of so many steps of 4 ms for every line it is sent. Every drone hovers, without rotors or effects, under a constant
force at HEIGHT [m] above the floor of the MJCF, all steps in one call.
"""

import sys
import time
from importlib.metadata import version

import mujoco
from mujoco.batch import Batch

STEPS = 50
drones, path, height = int(sys.argv[1]), sys.argv[2], float(sys.argv[3])
model = mujoco.MjModel.from_xml_path(path)
model.opt.timestep = 0.004
batch = Batch(model, drones)
batch.bind("qpos")[:, 2] = height
batch.bind("qfrc_applied")[:, 2] = 9.81 * model.body("cfb").mass[0]


def fly():
    begin = time.perf_counter()
    batch.step(nstep=STEPS)
    return time.perf_counter() - begin


fly()
print("ready", version("mujoco"), 0.0, STEPS, flush=True)
for _ in sys.stdin:
    print(fly(), flush=True)
