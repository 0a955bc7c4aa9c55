"""Load weights into a Crazyflie that flies an exported policy; it keeps them until it is switched off.

python load_weights.py radio://0/80/2M/E7E7E7E7E7 weights.bin

The drone must stand, with the policy's controller selected. Needs cflib. See README.md.
"""

import struct
import sys
import threading
from pathlib import Path

import cflib.crtp
from cflib.crazyflie import Crazyflie
from cflib.crazyflie.log import LogConfig
from cflib.crazyflie.mem import MemoryElement
from cflib.crazyflie.syncCrazyflie import SyncCrazyflie
from cflib.crazyflie.syncLogger import SyncLogger

HEADER = struct.Struct("<5I")  # magic, version, architecture, number of floats, CRC-32
MAGIC = int.from_bytes(b"CFBW", "little")
STATUS = (
    "nothing was written",
    "it was not checked",
    "it is good",
    "parts are missing",
    "it is no set of weights, or of another version",
    "it is for another network or observation",
    "its CRC is wrong",
    "a number is not finite",
)
"""Of `cfb_weights_status_t` in cfb_weights.h."""


def write(cf, memory, address: int, data: bytes) -> bool:
    """Write bytes and wait for the answer of the drone; return whether it took them."""
    answers, answered = [], threading.Event()

    def answer(taken):
        def callback(written, _):
            if written.id == memory.id:
                answers.append(taken)
                answered.set()

        return callback

    good, bad = answer(True), answer(False)
    cf.mem.mem_write_cb.add_callback(good)
    cf.mem.mem_write_failed_cb.add_callback(bad)
    cf.mem.write(memory, address, data)
    answered.wait(timeout=60)
    cf.mem.mem_write_cb.remove_callback(good)
    cf.mem.mem_write_failed_cb.remove_callback(bad)
    return answers == [True]


def flying(cf) -> tuple[int, int, int]:
    """Read which weights fly: whether loaded ones, their CRC, and the status of the set that was written."""
    names = {"cfb.loaded": "uint8_t", "cfb.crc": "uint32_t", "cfb.weights": "uint8_t"}
    config = LogConfig("weights", period_in_ms=100)
    for name, kind in names.items():
        config.add_variable(name, kind)
    with SyncLogger(cf, config) as logger:
        _, values, _ = next(logger)
    loaded, crc, status = (values[name] for name in names)
    return loaded, crc, status


def main(uri: str, path: str) -> str:
    """Load a set of weights; return what to say, or exit with what went wrong."""
    data = Path(path).read_bytes()
    if len(data) < HEADER.size or HEADER.unpack_from(data)[0] != MAGIC:
        sys.exit(f"{path}: is no set of weights; give the weights.bin of cfb export --loadable.")
    crc = HEADER.unpack_from(data)[-1]
    cflib.crtp.init_drivers()
    with SyncCrazyflie(uri, cf=Crazyflie(rw_cache="./cache")) as connected:
        cf = connected.cf
        # One byte more than the set: writing that makes the set fly.
        memory = next((m for m in cf.mem.get_mems(MemoryElement.TYPE_APP) if m.size == len(data) + 1), None)
        if memory is None:
            sys.exit(f"{path}: the policy on the drone has another architecture, or cannot load weights.")
        written = write(cf, memory, 0, data)
        applied = written and write(cf, memory, len(data), b"\1")
        loaded, found, status = flying(cf)
    now = f"{'loaded weights' if loaded else 'the weights in flash'} fly, CRC {found:#010x}"
    if not written or (not applied and status == STATUS.index("it is good")):
        sys.exit(f"{path}: the drone took no weights, because it flies or for want of a connection; {now}.")
    if not applied or found != crc:
        sys.exit(f"{path}: the drone refused these weights: {STATUS[status]}; {now}.")
    return f"{path}: {now}."


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    print(main(*sys.argv[1:]))
