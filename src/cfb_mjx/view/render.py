"""Render the frames of a flight with MuJoCo. `film` runs this in a separate process, which chooses OpenGL at import.

    python -m cfb_mjx.view.render JOB.npz

The job is written by `film`. The frames go to standard output as raw RGB, one after the other.
"""

from __future__ import annotations

import sys
from itertools import pairwise
from typing import Any, cast

import mujoco as _mujoco
import numpy as np

# MuJoCo's compiled module has no type information.
mujoco = cast(Any, _mujoco)

WAY = np.array([0.0, 0.45, 0.7, 0.9], np.float32)
ARROW = np.array([0.84, 0.37, 0.0, 0.9], np.float32)
METRES_PER_NEWTON = 0.8
MOTORS = 0.03535 * np.array([[1, -1, 0], [-1, -1, 0], [-1, 1, 0], [1, 1, 0]])


def main(path: str) -> None:
    """Render the job in ``path``."""
    job = np.load(path)
    model = mujoco.MjModel.from_xml_string(str(job["xml"]))
    # The far plane is a multiple of the extent; this value makes the floor reach the horizon.
    model.stat.extent = 2.0
    width, height = (int(x) for x in job["size"])
    data, camera = mujoco.MjData(model), mujoco.MjvCamera()
    camera.azimuth, camera.elevation, camera.distance = (float(x) for x in job["camera"])
    position, quaternion, thrust, way = job["position"], job["quaternion"], job["thrust"], job["way"]
    with mujoco.Renderer(model, height, width, max_geom=4000) as renderer:
        for i in range(len(position)):
            data.qpos[:3], data.qpos[3:7] = position[i], quaternion[i]
            mujoco.mj_forward(model, data)
            camera.lookat[:] = job["look_at"][i]
            renderer.update_scene(data, camera)
            # Without a graphics card, shadows take longer than everything else.
            renderer.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = False
            renderer.scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = False
            renderer.scene.flags[mujoco.mjtRndFlag.mjRND_HAZE] = False
            for a, b in pairwise(way[: job["passed"][i] + 1]):
                _connect(renderer.scene, mujoco.mjtGeom.mjGEOM_LINE, 3.0, a, b, WAY)
            turn = data.xmat[1].reshape(3, 3)
            for motor, force in zip(MOTORS, thrust[i], strict=True):
                at = position[i] + turn @ motor
                _connect(
                    renderer.scene,
                    mujoco.mjtGeom.mjGEOM_ARROW,
                    0.004,
                    at,
                    at + METRES_PER_NEWTON * force * turn[:, 2],
                    ARROW,
                )
            sys.stdout.buffer.write(renderer.render().tobytes())


def _connect(scene, kind, radius: float, a: np.ndarray, b: np.ndarray, colour: np.ndarray) -> None:
    if scene.ngeom >= scene.maxgeom or np.linalg.norm(b - a) < 1e-4:
        return
    geom = scene.geoms[scene.ngeom]
    mujoco.mjv_initGeom(geom, kind, np.zeros(3), np.zeros(3), np.eye(3).reshape(-1), colour)
    mujoco.mjv_connector(geom, kind, radius, np.asarray(a, np.float64), np.asarray(b, np.float64))
    scene.ngeom += 1


if __name__ == "__main__":
    main(sys.argv[1])
