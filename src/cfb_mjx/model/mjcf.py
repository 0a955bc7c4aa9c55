"""MJCF files with the drone: compiled, with clear messages."""

from __future__ import annotations

import functools
import itertools
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np

from cfb_mjx.errors import CfbError, CfbWarning
from cfb_mjx.files import shipped
from cfb_mjx.optional import not_none

BODY_NAME = "cfb"


class World(NamedTuple):
    """What determines a compiled world."""

    mjcf: str
    drones: int = 1

    @property
    def bodies(self) -> list[str]:
        """Names of the drones' bodies: cfb, cfb1, cfb2 ..."""
        return [BODY_NAME, *(f"{BODY_NAME}{i}" for i in range(1, self.drones))]


def specification(path: str | Path) -> mujoco.MjSpec:
    """Read an MJCF.

    Raises:
        CfbError: there is no such file, or MuJoCo cannot read it.
    """
    try:
        return mujoco.MjSpec.from_file(str(path))
    except ValueError as error:
        raise _uncompiled(path, error) from None


def compiled(path: str | Path, spec: mujoco.MjSpec) -> mujoco.MjModel:
    """Compile what was read from ``path``.

    Raises:
        CfbError: MuJoCo cannot compile it.
    """
    try:
        return spec.compile()
    except ValueError as error:
        raise _uncompiled(path, error) from None


def _uncompiled(path: str | Path, error: ValueError) -> CfbError:
    return CfbError(f"{path}: MuJoCo cannot compile this MJCF ({' '.join(str(error).split())}).")


@functools.lru_cache(maxsize=8)
def compiled_scene(world: World) -> mujoco.MjModel:
    """Compile a world, and add the drones that it lacks.

    Raises:
        CfbError: MuJoCo cannot compile it, or a drone's body has other joints than one free joint.

    Warns:
        CfbWarning: the drones cannot touch some of its geoms or each other, or MuJoCo's drag acts on them.
    """
    path, spec = world.mjcf, specification(world.mjcf)
    for name in world.bodies:
        body = spec.body(name)
        if body is None or not (list(body.joints) or list(body.geoms)):
            try:
                _add_drone(spec, name, body)
            except ValueError as error:
                raise _uncompiled(path, error) from None
        # MuJoCo's shortcut for bodies with their centre of gravity at their origin; a drone's is where its parameters
        # say.
        not_none(spec.body(name)).simple = 0
    model = compiled(path, spec)
    if world.drones > 1 and spec.numeric("max_geom_pairs") is None:
        # MJX looks closer at so many of the pairs of two shapes: at all of drones with the world, but not at all of
        # drones with drones, whose number grows with the square of theirs.
        most = 4 * world.drones + _most_pairs(model, world.bodies)
        spec.add_numeric(name="max_geom_pairs", size=1, data=[most])
        model = compiled(path, spec)
    for name in world.bodies:
        body = model.body(name)
        if body.jntnum[0] != 1 or model.jnt_type[body.jntadr[0]] != mujoco.mjtJoint.mjJNT_FREE:
            raise CfbError(f"{path}: body '{name}' must have one joint, a free joint.")
    warn_of_untouched(path, model, world.bodies)
    if model.opt.density or model.opt.viscosity:
        warnings.warn(
            f"{path}: MuJoCo's drag (density, viscosity) acts on the drone too, beside the effects of its model; leave "
            "them out if the model has rotor_drag or parasitic_drag.",
            CfbWarning,
            stacklevel=4,
        )
    return model


_COPIED = ("type", "size", "pos", "quat", "fromto", "contype", "conaffinity", "condim", "friction", "solref")


def _add_drone(spec: mujoco.MjSpec, name: str, body: mujoco.MjsBody | None) -> None:
    """Add the drone of ``assets/cfb.xml``, to an empty body if there is one.

    Geom by geom, because attaching the file would bring its options and its floor.
    """
    drone = not_none(specification(shipped("assets", "cfb.xml")).body(BODY_NAME))
    own = not_none(spec.worldbody.add_body(name=name, pos=drone.pos) if body is None else body)
    own.mass, own.inertia, own.explicitinertial = drone.mass, drone.inertia, True
    own.add_freejoint(name=name)
    suffix = name.removeprefix(BODY_NAME)
    for geom in drone.geoms:
        copied = {key: getattr(geom, key) for key in _COPIED}
        own.add_geom(name=geom.name + suffix, mass=0, group=geom.group, rgba=geom.rgba, **copied)


def warn_of_untouched(path: str | Path, model: mujoco.MjModel, drones: Sequence[str] = (BODY_NAME,)) -> None:
    """Warn of geoms in view that the drone flies through, and of drones that fly through each other.

    Args:
        path: name of the file, for the message.
        model: the compiled world.
        drones: names of the drones' bodies.
    """
    bodies = numbers_of(model, drones)
    first = model.geom_bodyid == bodies[0]
    others = np.flatnonzero(~np.isin(model.geom_bodyid, bodies) & (model.geom_group < 3))
    if untouched := [f"geom '{model.geom(i).name or i}'" for i in others if not meet(model, first, [i]).any()]:
        warnings.warn(
            f'{path}: the drone flies through {", ".join(untouched)}; give them contype="1" conaffinity="1", or a '
            "group from 3 if they are not there to be touched.",
            CfbWarning,
            stacklevel=4,
        )
    # Not by their feet alone, which touch every outline.
    solid = (model.geom_contype & model.geom_conaffinity) != 0
    drone_geoms = [solid & (model.geom_bodyid == body) for body in bodies]
    if not all(meet(model, a, b).any() for a, b in itertools.combinations(drone_geoms, 2)):
        warnings.warn(
            f"{path}: the drones fly through each other; leave their geoms out, so that those of assets/cfb.xml are "
            "added, or copy the geoms of class outline from there.",
            CfbWarning,
            stacklevel=4,
        )


def meet(model: mujoco.MjModel, some, others) -> np.ndarray:
    """Whether each of some geoms, an index of them, can touch each of others, (some, others)."""
    kinds, affinities = model.geom_contype, model.geom_conaffinity
    return (kinds[some][:, None] & affinities[others] | affinities[some][:, None] & kinds[others]) != 0


def numbers_of(model: mujoco.MjModel, bodies: Sequence[str]) -> np.ndarray:
    """Numbers of bodies by their names."""
    return np.array([int(model.body(name).id) for name in bodies])


def _most_pairs(model: mujoco.MjModel, drones: Sequence[str]) -> int:
    """Largest number of pairs of the same two shapes that can touch, without those of two drones."""
    bodies, every = model.geom_bodyid, slice(None)
    drone = np.isin(bodies, numbers_of(model, drones))
    met = meet(model, every, every) & (bodies[:, None] != bodies) & ~(drone[:, None] & drone)
    first, second = np.nonzero(np.triu(met))
    shapes = np.sort(np.stack([model.geom_type[first], model.geom_type[second]]), axis=0)
    return int(np.unique(shapes, axis=1, return_counts=True)[1].max(initial=0))
