"""Quaternion arithmetic on arrays of ``[w, x, y, z]`` rows (numpy; the simulator has its own in jax)."""

from __future__ import annotations

import numpy as np


def multiply(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Hamilton product, (n, 4) times (n, 4)."""
    aw, ax, ay, az = np.moveaxis(a, -1, 0)
    bw, bx, by, bz = np.moveaxis(b, -1, 0)
    return np.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        axis=-1,
    )


def conjugate(q: np.ndarray) -> np.ndarray:
    """Inverse of unit quaternions."""
    return q * np.array([1.0, -1.0, -1.0, -1.0])


def to_body(q: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Rotate world vectors (n, 3) to body axes: R(q)^T v."""
    return to_world(conjugate(q), vector)


def to_world(q: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Rotate body vectors (n, 3) to world axes: R(q) v."""
    w, u = q[..., :1], q[..., 1:]
    t = 2.0 * np.cross(u, vector)
    return vector + w * t + np.cross(u, t)


def rotation_vector(q: np.ndarray) -> np.ndarray:
    """Rotation vectors (n, 3), rad, of at most half a turn, from unit quaternions (n, 4)."""
    q = np.where(q[..., :1] < 0, -q, q)
    sine = np.linalg.norm(q[..., 1:], axis=-1, keepdims=True)
    angle = 2.0 * np.arctan2(sine, q[..., :1])
    return q[..., 1:] * np.where(sine > 1e-12, angle / np.maximum(sine, 1e-12), 2.0)


def tidy(q: np.ndarray) -> np.ndarray:
    """Normalise (n, 4) quaternions and make their sign continuous from row to row. Idempotent, bit for bit."""
    norm = np.linalg.norm(q, axis=-1, keepdims=True)
    q = np.where(np.abs(norm - 1.0) > 1e-12, q / norm, q)
    flips = np.sum(q[1:] * q[:-1], axis=-1) < 0
    sign = np.concatenate([[1.0], np.where(np.cumsum(flips) % 2 == 1, -1.0, 1.0)])
    return q * sign[:, None]


def exponential(vector: np.ndarray) -> np.ndarray:
    """Unit quaternions of rotation vectors (rad); inverse of `rotation_vector`."""
    angle = np.linalg.norm(vector, axis=-1, keepdims=True)
    # sinc avoids a division by zero at zero angle.
    return np.concatenate([np.cos(angle / 2.0), 0.5 * np.sinc(angle / (2.0 * np.pi)) * vector], axis=-1)


def from_euler(angles: np.ndarray) -> np.ndarray:
    """Quaternions (n, 4) of roll, pitch, yaw (n, 3), rad: the rotation R_z(yaw) R_y(pitch) R_x(roll)."""
    roll, pitch, yaw = (exponential(angles[:, [i]] * np.eye(3)[i]) for i in range(3))
    return multiply(yaw, multiply(pitch, roll))
