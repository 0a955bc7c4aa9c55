"""MJCF files with the drone: compiled, with clear messages."""

from __future__ import annotations

import functools
import warnings
from pathlib import Path

import mujoco
import numpy as np

from cfb_mjx.errors import CfbError, CfbWarning
from cfb_mjx.files import shipped
from cfb_mjx.optional import not_none

BODY_NAME = "cfb"


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
def compiled_scene(path: str) -> mujoco.MjModel:
    """Compile a world, and add the drone if it has none.

    Raises:
        CfbError: MuJoCo cannot compile it, or its body ``cfb`` has other joints than one free joint.

    Warns:
        CfbWarning: the drone cannot touch some of its geoms, or MuJoCo's drag acts on it.
    """
    spec = specification(path)
    body = spec.body(BODY_NAME)
    if body is None or not (list(body.joints) or list(body.geoms)):
        _add_drone(spec, body)
    # MuJoCo's shortcut for bodies with their centre of gravity at their origin; a drone's is where the parameters say.
    not_none(spec.body(BODY_NAME)).simple = 0
    model = compiled(path, spec)
    body = model.body(BODY_NAME)
    if body.jntnum[0] != 1 or model.jnt_type[body.jntadr[0]] != mujoco.mjtJoint.mjJNT_FREE:
        raise CfbError(f"{path}: body '{BODY_NAME}' must have one joint, a free joint.")
    warn_of_untouched(path, model)
    if model.opt.density or model.opt.viscosity:
        warnings.warn(
            f"{path}: MuJoCo's drag (density, viscosity) acts on the drone too, beside the effects of its model; leave "
            "them out if the model has rotor_drag or parasitic_drag.",
            CfbWarning,
            stacklevel=4,
        )
    return model


_COPIED = ("name", "type", "size", "pos", "quat", "fromto", "contype", "conaffinity", "condim", "friction", "solref")


def _add_drone(spec: mujoco.MjSpec, body: mujoco.MjsBody | None) -> None:
    """Add the drone of ``assets/cfb.xml``, to an empty body if there is one.

    Geom by geom, because attaching the file would bring its options and its floor.
    """
    drone = not_none(specification(shipped("assets", "cfb.xml")).body(BODY_NAME))
    own = not_none(spec.worldbody.add_body(name=BODY_NAME, pos=drone.pos) if body is None else body)
    own.mass, own.inertia, own.explicitinertial = drone.mass, drone.inertia, True
    own.add_freejoint(name=BODY_NAME)
    for geom in drone.geoms:
        own.add_geom(mass=0, group=geom.group, rgba=geom.rgba, **{name: getattr(geom, name) for name in _COPIED})


def warn_of_untouched(path: str | Path, model: mujoco.MjModel) -> None:
    """Warn of geoms in view that the drone flies through.

    Args:
        path: name of the file, for the message.
        model: the compiled world.
    """
    if untouched := _untouched(model):
        warnings.warn(
            f'{path}: the drone flies through {", ".join(untouched)}; give them contype="1" conaffinity="1", or a '
            "group from 3 if they are not there to be touched.",
            CfbWarning,
            stacklevel=4,
        )


def _untouched(model: mujoco.MjModel) -> list[str]:
    """Names of geoms in view that neither the drone nor any of its geoms can touch."""
    drone = model.geom_bodyid == model.body(BODY_NAME).id
    own = [(int(a), int(b)) for a, b in zip(model.geom_contype[drone], model.geom_conaffinity[drone], strict=True)]
    found = []
    for i in np.flatnonzero(~drone & (model.geom_group < 3)):
        kind, affinity = int(model.geom_contype[i]), int(model.geom_conaffinity[i])
        if not any(kind & b or a & affinity for a, b in own):
            found.append(f"geom '{model.geom(i).name or i}'")
    return found
