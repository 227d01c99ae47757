"""Rotations in NumPy and float64; quaternions are (w, x, y, z)."""

import numpy as np


def quat_about(axis: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Unit quaternions of rotations by ``angle`` (...,), rad, about the unit vectors ``axis`` (..., 3)."""
    half = np.asarray(angle)[..., None] / 2.0
    return np.concatenate([np.cos(half), np.sin(half) * axis], axis=-1)


def quat_multiply(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Hamilton product, (..., 4)."""
    pw, px, py, pz = np.moveaxis(p, -1, 0)
    qw, qx, qy, qz = np.moveaxis(q, -1, 0)
    return np.stack(
        [
            pw * qw - px * qx - py * qy - pz * qz,
            pw * qx + px * qw + py * qz - pz * qy,
            pw * qy - px * qz + py * qw + pz * qx,
            pw * qz + px * qy - py * qx + pz * qw,
        ],
        axis=-1,
    )


def matrices(quats: np.ndarray) -> np.ndarray:
    """Rotation matrices of quaternions, which are normalised first, (..., 3, 3)."""
    quats = np.asarray(quats, dtype=np.float64)
    w, x, y, z = np.moveaxis(quats / np.linalg.norm(quats, axis=-1, keepdims=True), -1, 0)
    rows = [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
        [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
        [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def random_unit(rng: np.random.Generator, *shape: int) -> np.ndarray:
    """Unit vectors, or quaternions, of uniformly distributed direction, ``shape``."""
    vectors = rng.normal(size=shape)
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def unit_vectors(elevation: np.ndarray, azimuth: np.ndarray) -> np.ndarray:
    """Directions with these angles, rad, (..., 3)."""
    flat = np.cos(elevation)
    return np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], axis=-1)
