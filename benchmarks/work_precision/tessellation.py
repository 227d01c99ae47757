"""Closed meshes of about so many triangles for the shapes of obstacles."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

Mesh = tuple[np.ndarray, np.ndarray]
"""Vertices (V, 3), m, and outward triangles (F, 3)."""


def tessellate(kind: str, size: np.ndarray, triangles: int) -> Mesh:
    """A box, cylinder or sphere of MuJoCo's sizes; corners lie on the true surface, a box has 12 triangles always."""
    if kind == "box":
        return _box(size)
    if kind == "cylinder":  # sides 2 n, ends n - 2 each
        return _prism(max(3, round((triangles + 4) / 4)), *size[:2])
    if kind == "sphere":
        return _ball(triangles, size[0])
    raise ValueError(f"kind={kind!r} must be one of box, cylinder, sphere")


def join(parts: Sequence[Mesh]) -> Mesh:
    """Several meshes as one."""
    offsets = np.cumsum([0] + [len(vertices) for vertices, _ in parts[:-1]])
    faces = [faces + offset for (_, faces), offset in zip(parts, offsets, strict=True)]
    return np.concatenate([vertices for vertices, _ in parts]), np.concatenate(faces)


def _box(size: np.ndarray) -> Mesh:
    corners = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return corners * size, np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])


def _prism(sides: int, radius: float, half: float) -> Mesh:
    angle = 2.0 * np.pi * np.arange(sides) / sides
    ring = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.full(sides, half)], axis=1)
    low, high = np.arange(sides), np.arange(sides) + sides
    after = np.roll(low, -1)
    walls = [np.stack([low, after, after + sides], 1), np.stack([low, after + sides, high], 1)]
    fan = np.stack([np.zeros(sides - 2, int), low[1:-1], low[2:]], 1)
    return np.concatenate([ring * [1, 1, -1], ring]), np.concatenate([*walls, fan[:, ::-1], fan + sides])


def _ball(triangles: int, radius: float) -> Mesh:
    """Rings between two poles, 2 n (m - 1) triangles of n sectors and m belts, about twice as many sectors as belts."""
    belts = max(2, round((1.0 + np.sqrt(1.0 + triangles)) / 2.0))
    sectors = max(3, round(triangles / (2 * (belts - 1))))
    polar = np.pi * np.arange(1, belts) / belts
    angle = 2.0 * np.pi * np.arange(sectors) / sectors
    theta, phi = np.meshgrid(polar, angle, indexing="ij")
    rings = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1).reshape(-1, 3)
    here = np.arange(sectors)
    there, top, bottom = np.roll(here, -1), len(rings), len(rings) + 1
    last = (belts - 2) * sectors
    faces = [np.stack([np.full(sectors, top), here, there], 1)]
    for k in range(belts - 2):
        up, down = k * sectors, (k + 1) * sectors
        faces += [
            np.stack([up + here, down + here, down + there], 1),
            np.stack([up + here, down + there, up + there], 1),
        ]
    faces.append(np.stack([last + here, np.full(sectors, bottom), last + there], 1))
    return radius * np.concatenate([rings, [[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]]), np.concatenate(faces)
