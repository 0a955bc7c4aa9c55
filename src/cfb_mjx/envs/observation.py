"""Observation of a neural controller: newest estimate, past estimates, past commands, and set-points.

The same contract holds for training, simulation and the exported C: `Layout` defines the contents, their order and
scale. Order: newest frame, past frames (newest first), past commands (newest first), integral, previews of a path,
set-points. A frame is
the position relative to the target, velocity (world or body axes), the nine entries of the rotation matrix body to
world by rows (the same for q and -q), and the body rate.

All functions accept one drone, or many along the last axis of every array. The numbers are then concatenated row by
row; ``vmap`` would concatenate them drone by drone, which on a CPU takes longer than flying.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from cfb_mjx.documents import with_former
from cfb_mjx.model.state import AnyArray
from cfb_mjx.optional import not_none


@dataclass(frozen=True)
class Layout:
    """Size, order and scale of an observation. Hashable; fixed for the lifetime of a policy."""

    control_dt_s: float = 0.008
    """Time between two commands, s."""
    past_estimates: int = 1
    estimate_stride: int = 1
    """Control steps between one observed estimate and the next older one."""
    past_commands: int = 6
    integral: bool = False
    """Whether to observe the integral of the relative position, which allows constant errors to be held."""
    position_limit_m: float = 8.0
    """Largest observed distance, m: farther targets appear at this distance in the same direction."""
    position_scale_m: float = 0.1
    position_bend_m: float = 0.1
    """Distances much longer than this appear on a logarithmic scale, b asinh(d / b), in m; 0: linear scale.

    A network is nearly linear at the beginning of a training. With a linear scale it uses one gain for all distances,
    no larger than the gain that a target 6 m away allows.
    """
    velocity_scale_mps: float = 2.0
    velocity_bend_mps: float = 0.5
    """The same for speeds, m/s: the braking that is right at 0.5 m/s turns the drone over at 6 m/s."""
    rate_scale_radps: float = 10.0
    integral_input_limit_m: float = 0.3
    """Largest position error per axis that enters the integral, m."""
    integral_limit_ms: float = 0.6
    """Largest integral per axis, m s."""
    position: bool = True
    """Whether to observe the position."""
    body_position: bool = True
    """Whether the position is in body axes, not the world's; the right command then does not depend on the heading."""
    body_velocity: bool = True
    """Whether the velocity is in body axes, not the world's."""
    setpoint_scales: tuple[float, ...] = ()
    """Divisor of each set-point."""
    preview_s: tuple[float, ...] = ()
    """For paths: how far ahead the policy sees its moving target, s. For each, it observes the target's displacement
    from now until then, in the axes of the position."""
    preview_scale_m: float = 0.5
    action: str = "motors"
    """Meaning of the four outputs, a name in `cfb_mjx.firmware.ACTIONS`: motor commands, or set-points of the
    firmware's own loops."""

    @classmethod
    def from_document(cls, written: Mapping[str, Any]) -> Layout:
        """Return the layout that a file holds.

        Args:
            written: fields by name; those that a file of an earlier version lacks get the values they had then.

        Raises:
            TypeError: there is no such field.
        """
        settings: dict[str, Any] = dict(with_former(dict(written), "position_scale_m", BEFORE_BENDS))
        settings |= {key: tuple(written.get(key, ())) for key in ("setpoint_scales", "preview_s")}
        return cls(**settings)

    @property
    def shown(self) -> int:
        """Number of values that are observed beside the estimates: displacements of the target, then set-points."""
        return 3 * len(self.preview_s) + len(self.setpoint_scales)

    @property
    def frame(self) -> int:
        """Number of values in a frame."""
        return 15 + 3 * self.position

    @property
    def size(self) -> int:
        """Length of the observation."""
        past = self.frame * (1 + self.past_estimates) + 4 * self.past_commands
        return past + 3 * self.integral + self.shown


BEFORE_BENDS = {"position_bend_m": 0.0, "velocity_bend_mps": 0.0, "body_position": False, "body_velocity": False}
"""Settings of layouts written before these fields existed: linear scales and world axes. Such a layout gives
``position_scale_m`` and none of these fields."""


class StateEstimate(eqx.Module):
    """Output of the state estimator."""

    position: Float[AnyArray, " 3 *drones"]
    """Position minus target, world, m."""
    velocity: Float[AnyArray, " 3 *drones"]
    """World, m/s."""
    quaternion: Float[AnyArray, " 4 *drones"]
    """[w, x, y, z], body to world."""
    body_rate: Float[AnyArray, " 3 *drones"]
    """Body, rad/s."""


class Memory(eqx.Module):
    """Memory of a controller between two steps."""

    frames: Float[Array, "estimates frame *drones"]
    """Frames of every control step, observed or not, newest first."""
    commands: Float[Array, "commands 4 *drones"]
    """Past commands as observed: 2 u - 1."""
    integral: Float[Array, " 3 *drones"]
    """Integral of the relative position, m s."""
    hidden: Float[Array, " n *drones"] | None = None
    """State of a recurrent network."""


def rotation_matrix(q: Float[AnyArray, " 4 *drones"]) -> Float[Array, "3 3 *drones"]:
    """Rotation matrix of a unit quaternion, body to world."""
    w, x, y, z = q
    return jnp.stack(
        [
            jnp.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)]),
            jnp.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)]),
            jnp.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]),
        ]
    )


def frame(layout: Layout, estimate: StateEstimate) -> Float[Array, " frame *drones"]:
    """Scaled numbers of one estimate."""
    turn = rotation_matrix(estimate.quaternion)

    def in_axes(vector, body):
        return jnp.einsum("i...,ij...->j...", vector, turn) if body else vector

    velocity = in_axes(estimate.velocity, layout.body_velocity)
    position = in_axes(estimate.position, layout.body_position)
    turn = turn.reshape(9, *velocity.shape[1:])
    if layout.velocity_bend_mps:
        velocity = velocity * _bent(_length(velocity), layout.velocity_bend_mps)
    parts = [velocity / layout.velocity_scale_mps, turn, estimate.body_rate / layout.rate_scale_radps]
    if layout.position:
        distance = _length(position)
        p = position * jnp.minimum(1.0, layout.position_limit_m / distance)
        if layout.position_bend_m:
            p = p * _bent(jnp.minimum(distance, layout.position_limit_m), layout.position_bend_m)
        parts.insert(0, p / layout.position_scale_m)
    return jnp.concatenate(parts)


def _length(vector: Float[AnyArray, " 3 *drones"]) -> Float[Array, " *drones"]:
    # The square root has no derivative at zero; the small number keeps the gradient finite there.
    return jnp.sqrt(jnp.sum(vector * vector, axis=0) + 1e-12)


def _bent(length: Float[Array, " *drones"], bend: float) -> Float[Array, " *drones"]:
    """Factor that changes the length of a vector to bend asinh(length / bend)."""
    return bend * jnp.arcsinh(length / bend) / length


def start(layout: Layout, estimate: StateEstimate, command: Float[Array, " 4 *drones"] | float) -> Memory:
    """Memory of a controller that has seen ``estimate`` and commanded ``command`` [0 to 1] for long."""
    shown = frame(layout, estimate)
    drones = shown.shape[1:]
    past = jnp.broadcast_to(2 * jnp.asarray(command, shown.dtype) - 1, (layout.past_commands, 4, *drones))
    kept = layout.past_estimates * layout.estimate_stride
    return Memory(jnp.broadcast_to(shown, (kept, layout.frame, *drones)), past, jnp.zeros((3, *drones), shown.dtype))


def observation(
    layout: Layout, memory: Memory, estimate: StateEstimate, setpoint: Float[Array, " setpoints *drones"] | None = None
) -> Float[Array, " size *drones"]:
    """Input of the network, (``layout.size``,).

    Args:
        layout: layout of the observation.
        memory: memory of the controller.
        estimate: newest estimate.
        setpoint: displacements of the target in world axes, m, three for each of ``layout.preview_s``, and one number
            for each of ``layout.setpoint_scales``. None: the target stands still; a policy with set-points needs them.
    """
    shown = memory.frames[layout.estimate_stride - 1 :: layout.estimate_stride]
    drones = estimate.position.shape[1:]
    parts = [frame(layout, estimate), shown.reshape(-1, *drones), memory.commands.reshape(-1, *drones)]
    if layout.integral:
        parts.append(memory.integral / layout.integral_limit_ms)
    ahead = 3 * len(layout.preview_s)
    if ahead:
        given = jnp.zeros((ahead, *drones), estimate.velocity.dtype) if setpoint is None else setpoint[:ahead]
        moved = given.reshape(-1, 3, *drones)
        if layout.body_position:
            moved = jnp.einsum("ki...,ij...->kj...", moved, rotation_matrix(estimate.quaternion))
        parts.append(moved.reshape(-1, *drones) / layout.preview_scale_m)
    if layout.setpoint_scales:
        scales = jnp.asarray(layout.setpoint_scales, estimate.velocity.dtype)
        parts.append(not_none(setpoint)[ahead:] / scales.reshape(-1, *(1 for _ in drones)))
    return jnp.concatenate(parts)


def remember(layout: Layout, memory: Memory, estimate: StateEstimate, command: Float[Array, " 4 *drones"]) -> Memory:
    """Memory after ``command`` [0 to 1] on ``estimate``; call it once every ``layout.control_dt_s``."""
    frames, commands = memory.frames, memory.commands
    if layout.past_estimates:
        frames = jnp.concatenate([frame(layout, estimate)[None], frames[:-1]])
    if layout.past_commands:
        commands = jnp.concatenate([(2 * command - 1)[None], commands[:-1]])
    limit, total = layout.integral_input_limit_m, layout.integral_limit_ms
    grown = memory.integral + layout.control_dt_s * jnp.clip(estimate.position, -limit, limit)
    return Memory(frames, commands, jnp.clip(grown, -total, total), memory.hidden)
