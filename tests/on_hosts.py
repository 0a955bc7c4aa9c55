"""One process of several of `train/test_hosts`: rollouts and an evaluation over the devices of all, results written."""

import sys

import jax

address, processes, process, output = sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), sys.argv[4]
jax.config.update("jax_enable_x64", True)
if processes > 1:
    jax.distributed.initialize(address, processes, process, initialization_timeout=120)

import numpy as np  # noqa: E402

from cfb_mjx.devices import Devices  # noqa: E402
from cfb_mjx.files import shipped  # noqa: E402
from cfb_mjx.logs import read_log  # noqa: E402
from cfb_mjx.model import Quadrotor, in_chunks, rollout_final  # noqa: E402
from cfb_mjx.sysid import evaluate  # noqa: E402

over = Devices.take()
assert over.count == processes
model = Quadrotor.from_file("cfb-guards")


def fly(key):
    commands = model.hover_command() * (1 + 0.1 * jax.random.normal(key, (20, 4)))
    return rollout_final(model, model.hover_state(), commands)


flown = in_chunks(fly, 4, jax.random.split(jax.random.key(0), 7), over=over)
log = read_log(sorted(shipped("data", "flight_logs").glob("*.mcap"))[0])
errors = np.array(list(evaluate(model, [log], over=over).metrics("commands_in").values()))
np.savez(output, position=flown.position, body_rate=flown.body_rate, errors=errors)
if processes > 1:
    jax.distributed.shutdown()
