"""What a camera of a scene sees: depth and segmentation, by casting a ray through every pixel."""

from __future__ import annotations

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from cfb_mjx.errors import CfbError
from cfb_mjx.model.mjcf import numbers_of
from cfb_mjx.model.quadrotor import Quadrotor, prepare
from cfb_mjx.model.scene import Scene, SceneState
from cfb_mjx.model.scene_engines import cast_by_c, cast_by_mjx
from cfb_mjx.model.vector import Vec, multiply, rotate


class Image(NamedTuple):
    """What every pixel shows, first row at the top."""

    depth: Float[Array, "height width"]
    """Distance along the optical axis, m; infinite where nothing is."""
    geom: Int[Array, "height width"]
    """Number of the geom in `Scene.mujoco_model`; -1 where nothing is."""


def look(scene: Scene, drone: Quadrotor, state: SceneState, camera: str, width: int = 32, height: int = 24) -> Image:
    """Return what a camera sees; a drone does not see itself, nor does a camera on the world see a single drone.

    Use ``jax.vmap`` over drone and state. A pixel costs a ray; a training needs few.

    Args:
        scene: the scene.
        drone: the drone.
        state: one state.
        camera: name of a ``<camera>`` of the MJCF, on a drone (body ``cfb``, ``cfb1`` ...) or on the world.
        width: number of pixels in a row.
        height: number of rows.

    Raises:
        CfbError: there is no such camera, it is on another body, or the engine cannot cast rays at a geom.
    """
    model = scene.mujoco_model
    names = [model.camera(i).name for i in range(model.ncam)]
    if camera not in names:
        raise CfbError(f"{scene.mjcf}: has no camera '{camera}'; its cameras: {', '.join(names) or 'none'}.")
    number, bodies = names.index(camera), numbers_of(model, scene.world.bodies).tolist()
    of = int(model.cam_bodyid[number])
    if of not in (0, *bodies):
        drones = ", ".join(f"'{name}'" for name in scene.world.bodies)
        raise CfbError(f"{scene.mjcf}: camera '{camera}' must be on a drone (body {drones}) or on the world.")
    kind = jnp.asarray(state.drone.position).dtype
    place = Vec.unstack(jnp.asarray(model.cam_pos[number], kind))
    turn = Vec.unstack(jnp.asarray(model.cam_quat[number], kind))
    if of:
        carrier = state.drone if scene.drones is None else jax.tree.map(lambda x: x[bodies.index(of)], state.drone)
        attitude = Vec.unstack(jnp.asarray(carrier.quaternion))
        place = Vec.unstack(jnp.asarray(carrier.position)) + rotate(attitude, place)
        turn = multiply(attitude, turn)
    local = _directions(float(model.cam_fovy[number]), width, height)
    world = jax.vmap(lambda ray: rotate(turn, Vec.unstack(ray)).stack())(jnp.asarray(local, kind))
    # The camera looks along its own -z, and every direction has a length of one along it.
    inputs = scene.inputs(scene.each(prepare)(drone), state)
    cast = {"mjx": cast_by_mjx, "c": cast_by_c}[scene.engine]
    unseen = of or (bodies[0] if scene.drones is None else -1)
    distance, geom = cast(scene.world, unseen, inputs, place.stack(), world)
    depth = jnp.where(geom < 0, jnp.inf, distance)
    return Image(depth.reshape(height, width), geom.reshape(height, width))


@functools.lru_cache(maxsize=16)
def _directions(fovy_deg: float, width: int, height: int) -> np.ndarray:
    """Direction of every pixel in the camera's axes (x right, y up, looking along -z), with a z of -1."""
    step = 2 * np.tan(np.radians(fovy_deg) / 2) / height
    up = -step * (np.arange(height) - (height - 1) / 2)
    right = step * (np.arange(width) - (width - 1) / 2)
    grid = np.stack(np.broadcast_arrays(right[None, :], up[:, None], -1.0), axis=-1)
    return grid.reshape(-1, 3)


def geom_names(scene: Scene) -> list[str]:
    """Names of the geoms by their numbers, for the segmentation; empty for a geom without one."""
    model = scene.mujoco_model
    return [model.geom(i).name for i in range(model.ngeom)]
