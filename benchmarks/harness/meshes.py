"""Closed triangle meshes of simple shapes; corners lie on the true surface, so that round shapes are a little small."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

Mesh = tuple[np.ndarray, np.ndarray]
"""Vertices (V, 3), m, float64, and outward triangles (F, 3), int32."""
BOX_QUADS = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))


def tessellate(kind: str, size: Sequence[float], sides: int = 16, belts: int = 8) -> Mesh:
    """A box, cylinder, sphere or capsule of MuJoCo's sizes.

    Args:
        kind: in small letters.
        size: half extents, radius and half length, or radius, m.
        sides: corners of a round shape's circumference.
        belts: of a sphere from pole to pole, even for a capsule.
    """
    if kind == "box":
        return _box(size)
    radius = size[0]
    if kind == "cylinder":
        return _revolve([(0.0, -size[1]), (radius, -size[1]), (radius, size[1]), (0.0, size[1])], sides)
    half = size[1] if kind == "capsule" else 0.0
    angles = np.pi * (np.arange(belts + 1) / belts - 0.5)
    arc = [(radius * np.cos(a), radius * np.sin(a)) for a in angles]
    if kind == "sphere":
        return _revolve(arc, sides)
    if kind != "capsule":
        raise ValueError(f"kind={kind!r} must be one of box, cylinder, sphere, capsule")
    middle = belts // 2
    return _revolve([(r, z - half) for r, z in arc[: middle + 1]] + [(r, z + half) for r, z in arc[middle:]], sides)


def tessellate_to(kind: str, size: Sequence[float], triangles: int) -> Mesh:
    """The same of about so many triangles; a box always has 12."""
    if kind == "cylinder":
        return tessellate(kind, size, sides=max(3, round((triangles + 4) / 4)))
    belts = max(2, round((1.0 + np.sqrt(1.0 + triangles)) / 2.0))
    return tessellate(kind, size, max(3, round(triangles / (2 * (belts - 1)))), belts)


def join(parts: Sequence[Mesh]) -> Mesh:
    """Several meshes as one."""
    offsets = np.cumsum([0] + [len(vertices) for vertices, _ in parts[:-1]])
    faces = [faces + offset for (_, faces), offset in zip(parts, offsets, strict=True)]
    return np.concatenate([vertices for vertices, _ in parts]), np.concatenate(faces).astype(np.int32)


def _box(half: Sequence[float]) -> Mesh:
    corners = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
    faces = [triangle for a, b, c, d in BOX_QUADS for triangle in ((a, b, c), (a, c, d))]
    return corners * np.asarray(half, dtype=np.float64), np.array(faces, dtype=np.int32)


def _revolve(profile: Sequence[tuple[float, float]], sides: int) -> Mesh:
    """The surface of (radius, height) pairs from the bottom pole to the top one, turned about z."""
    angles, here = 2.0 * np.pi * np.arange(sides) / sides, np.arange(sides)
    there, rings = (here + 1) % sides, len(profile) - 2
    circles = [np.stack([r * np.cos(angles), r * np.sin(angles), np.full(sides, z)], 1) for r, z in profile[1:-1]]
    poles = [[0.0, 0.0, profile[0][1]], [0.0, 0.0, profile[-1][1]]]
    bottom, top, last = rings * sides, rings * sides + 1, (rings - 1) * sides
    faces = [np.stack([np.full(sides, bottom), there, here], 1)]
    for low in range(0, last, sides):
        high = low + sides
        faces += [np.stack([low + here, low + there, high + there], 1)]
        faces += [np.stack([low + here, high + there, high + here], 1)]
    faces.append(np.stack([last + here, last + there, np.full(sides, top)], 1))
    return np.concatenate([*circles, poles]), np.concatenate(faces).astype(np.int32)
