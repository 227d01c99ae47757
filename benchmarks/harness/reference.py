"""Exact ranges of rays in float64: MuJoCo's rays, closed forms and triangles one by one; and errors against them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import mujoco
import numpy as np

GROSS = 1e-3
"""A relative error beyond this is another surface, or a surface of another form."""


class Shapes(Protocol):
    """Obstacles of a scene: kinds in small letters, MuJoCo's sizes (S, 3), and whether there is a ground at z = 0."""

    kinds: Sequence[str]
    sizes: np.ndarray
    plane: bool


def compile_model(scene: Shapes, plane_size: float = 0.0) -> mujoco.MjModel:
    """A MuJoCo model of the scene: the plane, infinite or of this half side, then a mocap body per obstacle."""
    spec = mujoco.MjSpec()
    if scene.plane:
        spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=(plane_size, plane_size, 1.0))
    for kind, size in zip(scene.kinds, scene.sizes, strict=True):
        body = spec.worldbody.add_body(mocap=True)
        body.add_geom(type=getattr(mujoco.mjtGeom, f"mjGEOM_{kind.upper()}"), size=size)
    return spec.compile()


def mujoco_ranges(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    origins: np.ndarray,
    directions: np.ndarray,
    groups: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Ranges (N,), ``inf`` for a miss, and geoms (N,), -1 for a miss, by ``mj_ray``.

    Args:
        model, data: with the geoms' poses.
        origins: one for all rays (3,), or one each (N, 3).
        directions: (N, 3); ranges are in units of their lengths.
        groups: whether each of MuJoCo's geom groups is there, (6,) uint8; None for all.
    """
    count = len(directions)
    ranges, geoms = np.empty(count), np.full(count, -1, np.int32)
    if not model.ngeom:
        return np.full(count, math.inf), geoms
    if np.ndim(origins) == 1:
        along = np.ascontiguousarray(directions, dtype=np.float64).reshape(-1)
        origin = np.asarray(origins, dtype=np.float64)
        mujoco.mj_multiRay(model, data, origin, along, groups, 1, -1, geoms, ranges, None, count, mujoco.mjMAXVAL)
    else:
        geom = np.zeros((1, 1), np.int32)
        for i, (origin, direction) in enumerate(zip(origins, directions, strict=True)):
            ranges[i] = mujoco.mj_ray(model, data, origin, direction, groups, 1, -1, geom)
            geoms[i] = geom[0, 0]
    return np.where(geoms < 0, math.inf, ranges), geoms


def sphere_ranges(origins: np.ndarray, directions: np.ndarray, radius: float) -> np.ndarray:
    """Smallest non-negative root of |o + t d| = radius for unit directions, (N,); ``inf`` without one."""
    along = (origins * directions).sum(1)
    foot = origins - along[:, None] * directions
    half = radius**2 - (foot**2).sum(1)
    root = np.sqrt(np.maximum(half, 0.0))
    first, second = -along - root, -along + root
    nearest = np.where(first >= 0, first, second)
    return np.where((half >= 0) & (nearest >= 0), nearest, math.inf)


def box_ranges(origins: np.ndarray, directions: np.ndarray, half: np.ndarray) -> np.ndarray:
    """Ranges to a box of half extents (3,) at the origin, by slabs, (N,)."""
    with np.errstate(divide="ignore", invalid="ignore"):
        a, b = (-half - origins) / directions, (half - origins) / directions
    low, high = np.minimum(a, b).max(1), np.maximum(a, b).min(1)
    nearest = np.where(low >= 0, low, high)
    return np.where((low <= high) & (nearest >= 0), nearest, math.inf)


def triangle_ranges(origins: np.ndarray, directions: np.ndarray, triangles: np.ndarray, chunk: int = 64) -> np.ndarray:
    """Ranges to the nearest of triangles (T, 3, 3), (N,); triangles without area are not there.

    A ray passes through a triangle if it turns the same way about all three edges; neighbours share an edge's value, so
    nothing slips through between them. Origins are (3,) or (N, 3).
    """
    a, b, c = (np.asarray(triangles, dtype=np.float64)[:, k] for k in range(3))
    edges = [(np.cross(p, q), p - q) for p, q in ((a, b), (b, c), (c, a))]
    normal = np.cross(b - a, c - a)
    offset = np.einsum("fi,fi->f", a, normal)
    origins = np.broadcast_to(np.asarray(origins, dtype=np.float64), np.shape(directions))
    ranges = np.empty(len(directions))
    for low in range(0, len(directions), chunk):
        o, d = origins[low : low + chunk], np.asarray(directions[low : low + chunk], dtype=np.float64)
        moment = np.cross(d, o)
        sides = [d @ cross.T + moment @ edge.T for cross, edge in edges]
        inside = np.all([s >= 0.0 for s in sides], axis=0) | np.all([s <= 0.0 for s in sides], axis=0)
        with np.errstate(divide="ignore", invalid="ignore"):
            t = (offset - o @ normal.T) / (d @ normal.T)
        ranges[low : low + chunk] = np.where(inside & (t >= 0.0), t, math.inf).min(axis=1)
    return ranges


@dataclass(frozen=True)
class Errors:
    """How ranges differ from the reference.

    Attributes:
        num_rays: rays compared.
        median, p99, largest: relative error over the rays that hit in both.
        gross: share of those rays whose relative error is beyond ``GROSS``, percent.
        disagree: share of all rays that hit in one and miss in the other, percent.
    """

    num_rays: int
    median: float
    p99: float
    largest: float
    gross: float
    disagree: float


def errors(ranges: np.ndarray, truth: np.ndarray) -> Errors:
    """Errors of ``ranges`` (N,) against ``truth`` (N,), metres, both infinite for a miss."""
    if not len(truth):
        raise ValueError("errors need at least one ray")
    hit, true_hit = np.isfinite(ranges), np.isfinite(truth)
    both, disagree = hit & true_hit, 100.0 * float(np.mean(hit != true_hit))
    if not both.any():
        return Errors(len(truth), math.nan, math.nan, math.nan, math.nan, disagree)
    relative = np.abs(ranges[both] - truth[both]) / truth[both]
    median, p99 = (float(value) for value in np.quantile(relative, (0.5, 0.99)))
    return Errors(len(truth), median, p99, float(relative.max()), 100.0 * float(np.mean(relative > GROSS)), disagree)
