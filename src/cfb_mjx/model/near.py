"""Which drones may touch static geometry: a cheap test that misses no contact.

Where nothing is near, MuJoCo's accelerations are those of the closed form (`cfb_mjx.model.bodies.RigidBody`).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Bool, Float

from cfb_mjx.model.mjcf import BODY_NAME, meet, numbers_of
from cfb_mjx.model.vector import Vec

SLACK_M = 1e-3
"""Added to every distance at which a geom is near. Positions of 32 bits are off by this far from the origin: 3 km."""


class Plane(NamedTuple):
    """A half-space: all points x with normal . x <= height are near it."""

    normal: tuple[float, float, float]
    height: float


class Surroundings(NamedTuple):
    """Where a drone's centre must be for it to touch something: in half-spaces, or near boxes."""

    planes: Sequence[Plane]
    centers: Float[np.ndarray, "boxes 3"]
    axes: Float[np.ndarray, "boxes 3 3"]
    """Axes of the boxes in the world, one a row."""
    halves: Float[np.ndarray, "boxes 3"]
    """Half their lengths, m."""
    reaches: Float[np.ndarray, " boxes"]
    """Distances from them within which they are near, m."""
    everywhere: bool
    """Whether MuJoCo is needed wherever the drone is, because more than contacts act on it."""


def surroundings(model: mujoco.MjModel) -> Surroundings:
    """What the drone of a compiled world, its only moving body, can touch."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    (drone,) = numbers_of(model, [BODY_NAME])
    own = model.geom_bodyid == drone
    # Distances are of the body's origin. A contact exists within the margins of both geoms.
    radii = np.linalg.norm(data.geom_xpos - data.xpos[drone], axis=-1) + model.geom_rbound
    margins = model.geom_margin + np.abs(model.geom_gap)
    met = meet(model, slice(None), slice(None))
    # Explicit pairs touch whatever their kinds, with margins of their own.
    pairs, of_pairs = np.stack([model.pair_geom1, model.pair_geom2]), model.pair_margin + np.abs(model.pair_gap)
    met[pairs[0], pairs[1]] = met[pairs[1], pairs[0]] = True
    most = float(of_pairs.max(initial=0.0)) + SLACK_M
    planes, boxes = [], []
    for geom in np.flatnonzero(~own):
        reach = float(np.max((radii + margins)[own & met[geom]], initial=-np.inf) + margins[geom] + most)
        if not np.isfinite(reach):
            continue
        place, axes = data.geom_xpos[geom], data.geom_xmat[geom].reshape(3, 3).T
        if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_PLANE:
            x, y, z = axes[2].tolist()
            planes.append(Plane((x, y, z), float(axes[2] @ place) + reach))
        else:
            center, half = model.geom_aabb[geom, :3], model.geom_aabb[geom, 3:]
            boxes.append((place + center @ axes, axes, half, reach))
    centers, rows, halves, reaches = (np.array([box[i] for box in boxes]) for i in range(4))
    everywhere = not _only_contacts(model, int(drone))
    return Surroundings(
        planes, centers.reshape(-1, 3), rows.reshape(-1, 3, 3), halves.reshape(-1, 3), reaches, everywhere
    )


def _only_contacts(model: mujoco.MjModel, drone: int) -> bool:
    """Whether nothing but gravity, along z, and contacts acts on the drone."""
    more = (
        model.opt.density,
        model.opt.viscosity,
        *model.opt.gravity[:2],
        model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_GRAVITY),
        model.opt.enableflags,
        *model.dof_damping,
        *model.dof_armature,
        *model.dof_frictionloss,
        *model.jnt_stiffness,
        model.body_gravcomp[drone],
        model.neq,
        model.nu,
        model.ntendon,
        model.nflex,
        model.nplugin,
        # Other bodies that move with it have a mass of their own.
        np.count_nonzero(model.body_weldid == model.body_weldid[drone]) - 1,
    )
    return not any(more)


def near(around: Surroundings, center: Vec) -> Bool[Array, ""]:
    """Whether a drone whose body's origin is at ``center`` [m] may touch something."""
    found = jnp.asarray(around.everywhere)
    for normal, height in around.planes:
        found = found | (center.dot(normal) <= height)
    if not len(around.reaches):
        return found
    dtype = jnp.result_type(*center)
    distance = 0.0
    offset = center - Vec.unstack(around.centers.astype(dtype))
    for axis in range(3):
        along = offset.dot(Vec.unstack(around.axes[:, axis].astype(dtype)))
        distance = distance + jnp.square(jnp.maximum(jnp.abs(along) - around.halves[:, axis].astype(dtype), 0.0))
    inside = distance <= np.square(around.reaches).astype(dtype)
    # A sum, because groups of drones (`cfb_mjx.engine.lanes`) have no other reduction.
    return found | (jnp.sum(jnp.where(inside, 1.0, 0.0)) > 0.0)


def where_touching(touching: Bool[Array, ""], found: Float[Array, "6"], free: tuple[Vec, Vec]) -> tuple[Vec, Vec]:
    """Linear and angular accelerations: those ``found`` by MuJoCo if the drone may touch something, else the others."""
    numbers = Vec.unstack(found)
    pairs = zip(numbers, (*free[0], *free[1]), strict=True)
    x, y, z, *angular = (jnp.where(touching, a, b) for a, b in pairs)
    return Vec(x, y, z), Vec(*angular)
