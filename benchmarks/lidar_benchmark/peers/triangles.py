"""A scene's shapes as triangles, for the methods that know nothing else."""

from __future__ import annotations

from functools import cache

import numpy as np

from ..rotations import matrices
from ..scenes import BenchmarkScene

SEGMENTS = 16
"""Sides of a round shape; its corners lie on the true surface, so that it is a little too small everywhere."""


def tessellate(kind: str, size: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) float32, metres, and outward triangles (F, 3) int32 of one shape in its own frame."""
    if kind == "box":
        return _box(size)
    if kind == "cylinder":
        return _revolve([(0.0, -size[1]), (size[0], -size[1]), (size[0], size[1]), (0.0, size[1])])
    half = size[1] if kind == "capsule" else 0.0
    angles = np.linspace(-np.pi / 2.0, np.pi / 2.0, SEGMENTS // 2 + 1)
    lower = [(size[0] * np.cos(a), size[0] * np.sin(a) - half) for a in angles if a <= 1e-9]
    upper = [(size[0] * np.cos(a), size[0] * np.sin(a) + half) for a in angles if a >= -1e-9]
    return _revolve(lower + (upper if half else upper[1:]))


def environment_triangles(scene: BenchmarkScene, frame: int, env: int) -> tuple[np.ndarray, np.ndarray]:
    """All triangles of one environment's obstacles and terrain; a plane becomes a large square."""
    parts = [tessellate(kind, size) for kind, size in zip(scene.kinds, scene.sizes, strict=True)]
    turn = matrices(scene.quats[frame, env])
    placed = [(v @ turn[k].T + scene.positions[frame, env, k], f) for k, (v, f) in enumerate(parts)]
    return join([*placed, *ground(scene)])


def ground(scene: BenchmarkScene) -> list[tuple[np.ndarray, np.ndarray]]:
    """The terrain, or the plane as a square that reaches beyond every ray."""
    if scene.terrain is not None:
        return [(scene.terrain.vertices, scene.terrain.faces)]
    if not scene.plane:
        return []
    reach = 2.0 * scene.max_range
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], dtype=np.float32) * np.float32(reach)
    return [(corners, np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32))]


def join(parts: list[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    """Several meshes as one."""
    offsets = np.cumsum([0] + [len(v) for v, _ in parts[:-1]])
    vertices = np.concatenate([v for v, _ in parts]).astype(np.float32)
    return vertices, np.concatenate([f + k for (_, f), k in zip(parts, offsets, strict=True)]).astype(np.int32)


def _box(size: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=np.float32)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = [triangle for a, b, c, d in quads for triangle in ((a, b, c), (a, c, d))]
    return corners * np.asarray(size, dtype=np.float32), np.array(faces, dtype=np.int32)


def _revolve(profile: list[tuple[float, float]]) -> tuple[np.ndarray, np.ndarray]:
    """The surface of (radius, height) pairs, from the bottom to the top, turned about z."""
    faces = _revolution_faces(len(profile))
    angles = 2.0 * np.pi * np.arange(SEGMENTS) / SEGMENTS
    rings = [np.stack([r * np.cos(angles), r * np.sin(angles), np.full(SEGMENTS, z)], axis=1) for r, z in profile[1:-1]]
    ends = [[0.0, 0.0, profile[0][1]], [0.0, 0.0, profile[-1][1]]]
    return np.concatenate([*rings, ends]).astype(np.float32), faces


@cache
def _revolution_faces(num_points: int) -> np.ndarray:
    rings, here = num_points - 2, np.arange(SEGMENTS)
    there = (here + 1) % SEGMENTS
    bottom, top = rings * SEGMENTS, rings * SEGMENTS + 1
    faces = [np.stack([np.full(SEGMENTS, bottom), there, here], axis=1)]
    for k in range(rings - 1):
        low, high = k * SEGMENTS, (k + 1) * SEGMENTS
        faces.append(np.stack([low + here, low + there, high + there], axis=1))
        faces.append(np.stack([low + here, high + there, high + here], axis=1))
    last = (rings - 1) * SEGMENTS
    faces.append(np.stack([last + here, last + there, np.full(SEGMENTS, top)], axis=1))
    return np.concatenate(faces).astype(np.int32)
