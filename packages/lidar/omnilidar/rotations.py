"""Orientations from angles; without kernels, for those who build scenes and cast no rays."""

import math

import numpy as np


def quat_from_rpy(roll: float, pitch: float, yaw: float) -> tuple[float, float, float, float]:
    """(w, x, y, z) of a turn about x by roll, then about fixed y by pitch, then about fixed z by yaw."""
    (cr, sr), (cp, sp), (cy, sy) = ((math.cos(a / 2.0), math.sin(a / 2.0)) for a in (roll, pitch, yaw))
    return (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )


def quat_product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The turn (w, x, y, z) that is b's and then a's."""
    return np.array([a[0] * b[0] - a[1:] @ b[1:], *(a[0] * b[1:] + b[0] * a[1:] + np.cross(a[1:], b[1:]))])


def quat_rotated(quat: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """A vector turned by (w, x, y, z)."""
    return vector + 2.0 * np.cross(quat[1:], np.cross(quat[1:], vector) + quat[0] * vector)


def quat_from_z(normal: np.ndarray) -> np.ndarray:
    """(w, x, y, z) of the shortest turn of the z axis into a direction."""
    x, y, z = normal / np.linalg.norm(normal)
    quat = np.array([1.0 + z, -y, x, 0.0]) if z > -1.0 + 1e-12 else np.array([0.0, 1.0, 0.0, 0.0])
    return quat / np.linalg.norm(quat)
