"""A process of `test_devices`: the same work on as many devices as it is told, results into a file."""

import sys

from cfb_mjx.runtime import configure_jax

DEVICES, OUTPUT, *ASKED = int(sys.argv[1]), *sys.argv[2:]
configure_jax(x64=True, devices=DEVICES)

import equinox as eqx  # noqa: E402
import jax  # noqa: E402
import numpy as np  # noqa: E402

from cfb_mjx.devices import Devices  # noqa: E402
from cfb_mjx.files import shipped  # noqa: E402
from cfb_mjx.logs import read_log  # noqa: E402
from cfb_mjx.model import Quadrotor, in_chunks, rollout_final  # noqa: E402
from cfb_mjx.optional import not_none  # noqa: E402
from cfb_mjx.parameters import load_randomisation, sample_parameters  # noqa: E402
from cfb_mjx.sysid import evaluate  # noqa: E402
from cfb_mjx.sysid.identification.fitting import fit  # noqa: E402
from cfb_mjx.sysid.identification.flight_data import ROWS_PER_SEGMENT, prepare  # noqa: E402

over = Devices.take(DEVICES)
assert over.count == DEVICES
model = Quadrotor.from_file("cfb-guards")
log = read_log(sorted(shipped("data", "flight_logs").glob("*.mcap"))[0])
ranges = load_randomisation("paper")


def fly(key):
    """A drone drawn from a key, a few commands about hover."""
    parameters = sample_parameters(key, model.parameters, ranges)
    drone = eqx.tree_at(lambda m: m.parameters, model, parameters)
    commands = model.hover_command() * (1 + 0.1 * jax.random.normal(key, (20, 4)))
    return rollout_final(drone, model.hover_state(), commands)


def rollouts():
    """Eleven drones, five at a time: chunks, and the last of them, that do not divide by two."""
    flown = in_chunks(fly, 5, jax.random.split(jax.random.key(0), 11), over=over)
    return np.concatenate([flown.position, flown.body_rate])


def fitted(estimator):
    """Value and uncertainty of what is fitted to one flight, whose segments do not divide by two."""
    odd = read_log(shipped("data", "flight_logs") / "yaw.mcap").rows(slice(ROWS_PER_SEGMENT))
    assert len(not_none(prepare([odd]).segments).valid) % 2
    result = fit([odd], model.parameters, "inertia,motor_gain", estimator=estimator, over=over)
    # Each over its own size: they are of very different units.
    sizes = np.array([[e.preset, e.preset] for e in result.estimates.values()])
    return np.array([[e.value, e.std] for e in result.estimates.values()]) / sizes


def flights():
    """What `cfb fly --plants 3` measures."""
    from cfb_mjx.commands import Fly

    said = Fly("pid", task="hover", plants=3, magnitude=1.0, devices=DEVICES).run().numbers
    return np.array([*said["quantiles"]["mean_distance_mm"].values(), said["command_std"]])


WORK = {
    "rollout": rollouts,
    "evaluation": lambda: np.array(list(evaluate(model, [log], over=over).metrics("commands_in").values())),
    "fit": lambda: fitted("innovation"),
    "shooting": lambda: fitted("shooting"),
    "flights": flights,
}
np.savez(OUTPUT, **{what: WORK[what]() for what in ASKED})
