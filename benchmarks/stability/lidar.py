"""LiDAR rays at the extremes, against float64: far, tiny, huge, grazing, degenerate, without poses, none, very many."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import torch

from benchmarks.harness.meshes import tessellate
from benchmarks.harness.reference import box_ranges, sphere_ranges, triangle_ranges
from benchmarks.harness.rotations import matrices, random_unit
from omnilidar import Lidar, LidarConfig, RayScene, Shape, ShapeKind, TriangleMesh, grid

K = ShapeKind
CUBE = TriangleMesh(*tessellate("box", (1.0, 1.0, 1.0)))
Row = dict[str, object]
"""A row of the table."""
Rays = tuple[np.ndarray, np.ndarray]
"""Origins and unit directions, (R, 3) float64 each."""
Truth = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Ranges (R,), inf for a miss, of rays in the frame of a body at the origin."""
AT = np.array([0.60011, -0.63989, 0.48007])
"""Where what lies far away lies, times the distance; not what float32 can say."""


def run(rays: int, many: int, seed: int = 0) -> list[Row]:
    """Every extreme.

    Args:
        rays: of each case.
        many: of the case with very many.
        seed: of the rays.
    """
    rng = np.random.default_rng(seed)
    with np.errstate(invalid="ignore"):  # inf - inf where both miss
        return _run(rays, many, rng)


def _run(rays: int, many: int, rng: np.random.Generator) -> list[Row]:
    rows = [row for distance in (1e3, 1e6) for row in far_away(distance, rays, rng)]
    rows += [row for size in (1e-4, 1e4) for row in sizes(size, rays, rng)]
    rows += [*bad_triangles(rays, rng), *grazing(), *edges(rays, rng), *inside(rays, rng)]
    rows += [*sensor_limits(), *poses(rays, rng)]
    rows += [row for bodies in (0, 10_000) for row in crowds(bodies, rays, rng)]
    return [*rows, *[row for count in (1, many) for row in counts(count, rng)]]


# ---- the extremes ----------------------------------------------------------------------------------------------------


def far_away(distance: float, count: int, rng: np.random.Generator) -> list[Row]:
    """A body and its rays `distance` m from the origin, with poses in float64 and in float32."""
    rows = []
    place = distance * AT
    rounding = float(np.linalg.norm(place.astype(np.float32).astype(float) - place) + np.spacing(np.float32(distance)))
    for name, shape, truth in _bodies(1.0):
        origins, directions = _around(count, 1.0, rng)
        true = truth(origins, directions)
        for dtype, allowed in ((torch.float64, 2e-5), (torch.float32, 2e-5 + 2 * rounding)):
            scene = RayScene([_carried(shape)], 1, 1, pose_dtype=dtype)
            scene.body_pos[0, 0] = torch.from_numpy(place).to(dtype)
            ranges = _cast(scene, origins + place, directions)
            case = f"{name} at {distance:g} m, {str(dtype).removeprefix('torch.')} poses"
            rows.append(_row(case, ranges, true, allowed, _near_silhouette(truth, origins, directions, allowed)))
    return rows


def sizes(size: float, count: int, rng: np.random.Generator) -> list[Row]:
    """Bodies of `size` m, seen from up to four sizes away."""
    rows = []
    for name, shape, truth in _bodies(size):
        origins, directions = _around(count, size, rng)
        true, allowed = truth(origins, directions), 2e-5 * max(size, 1e-3)
        loose = _near_silhouette(truth, origins, directions, allowed)
        rows.append(
            _row(f"{name} of {size:g} m", _cast(RayScene([shape], 1, 0), origins, directions), true, allowed, loose)
        )
    return rows


def bad_triangles(count: int, rng: np.random.Generator) -> list[Row]:
    """Meshes with triangles without area, twice the same ones, slivers, and faces that lie in each other."""
    corners, faces = CUBE.vertices, CUBE.triangles
    pointed = np.array([(0, 0, 0), (1, 1, 1), (2, 2, 2)])
    sliver = np.array([(-1, -1, 0.5), (1, -1, 0.5), (1, -1 + 1e-6, 0.5)])
    cases = {
        "degenerate triangles": (np.concatenate([corners, pointed]), np.concatenate([faces, [(0, 0, 1), (8, 9, 10)]])),
        "duplicated triangles": (corners, np.concatenate([faces, faces, faces])),
        "slivers of 1e-6 m": (np.concatenate([corners, sliver]), np.concatenate([faces, [(8, 9, 10)]])),
        "coplanar faces": (np.concatenate([corners, corners]), np.concatenate([faces, faces + 8])),
    }
    rows = []
    for name, (vertices, triangles) in cases.items():
        origins, directions = _around(count, 1.0, rng)

        def truth(o: np.ndarray, d: np.ndarray, vertices=vertices, triangles=triangles) -> np.ndarray:
            return triangle_ranges(o, d, vertices[triangles])

        scene = RayScene([Shape(K.MESH, asset=TriangleMesh(vertices, triangles))], 1, 0)
        loose = _near_silhouette(truth, origins, directions, 2e-5)
        rows.append(_row(name, _cast(scene, origins, directions), truth(origins, directions), 2e-5, loose))
    return rows


def grazing(angle: float = 1e-6) -> list[Row]:
    """Rays that hit the ground at `angle` rad, from 0.01 to 10 m above it, and as many that rise as steeply."""
    heights = np.geomspace(0.01, 10.0, 50).repeat(2)
    sign = np.tile([-1.0, 1.0], 50)
    origins = np.stack([np.zeros(100), np.zeros(100), heights], -1)
    directions = np.stack([np.full(100, math.cos(angle)), np.zeros(100), sign * math.sin(angle)], -1)
    true = np.where(sign < 0, heights / math.sin(angle), math.inf)
    ranges = _cast(RayScene([Shape(K.PLANE)], 1, 0), origins, directions)
    relative = np.where(np.isfinite(true), ranges / np.where(np.isfinite(true), true, 1.0), ranges)
    return [_row("ground at 1e-6 rad (relative)", relative, np.where(np.isfinite(true), 1.0, true), 1e-5)]


def edges(count: int, rng: np.random.Generator) -> list[Row]:
    """Rays along the edges and in the faces of a cube: a point of it, or a miss, and never anything else."""
    along, sides = rng.integers(0, 3, count), rng.choice([-1.0, 1.0], (count, 3))
    inner = rng.random(count) < 0.5
    origins = sides.copy()
    origins[inner, (along[inner] + 1) % 3] = rng.uniform(-1, 1, inner.sum())
    origins[np.arange(count), along] = -3.0
    directions = np.zeros((count, 3))
    directions[np.arange(count), along] = 1.0
    rows = []
    for name, shape in (("box", Shape(K.BOX, (1, 1, 1))), ("mesh", Shape(K.MESH, asset=CUBE))):
        ranges = _cast(RayScene([shape], 1, 0), origins, directions)
        sound = np.isinf(ranges) | ((ranges > 2 - 1e-5) & (ranges < 4 + 1e-5))
        rows.append(_judged(f"along edges and faces of a {name}", count, int((~sound).sum()), 0.0, "a point or a miss"))
    return rows


def inside(count: int, rng: np.random.Generator) -> list[Row]:
    """A sensor inside a body sees its far side."""
    rows = []
    for name, shape, truth in _bodies(1.0):
        origins, directions = 0.3 * rng.uniform(-1, 1, (count, 3)), random_unit(rng, count, 3)
        ranges = _cast(RayScene([shape], 1, 0), origins, directions)
        rows.append(_row(f"inside a {name}", ranges, truth(origins, directions), 2e-5))
    return rows


def sensor_limits() -> list[Row]:
    """A scan that hits nothing, one whose every hit lies at the minimum range, one with the body a hair nearer."""
    rows = []
    for name, minimum, height, expected in (
        ("all misses", 0.5, 100.0, math.inf),
        ("all hits at the minimum range", 1.0, 0.0, 1.0),
        ("all hits nearer than it", 1.001, 0.0, math.inf),
    ):
        scene = RayScene([Shape(K.SPHERE, (1.0,), body=0)], 1, 1)
        scene.body_pos[0, 0, 2] = height
        lidar = Lidar(LidarConfig(128, 1 / 30, minimum, 9.0), grid(16, 8, 60.0), scene, mount_body=-1)
        ranges = lidar.cast(torch.zeros(1, dtype=torch.float64)).ranges[0].double().numpy()
        rows.append(_row(name, ranges, np.full(128, expected), 0.0))
    return rows


def poses(count: int, rng: np.random.Generator) -> list[Row]:
    """Bodies with a broken pose are not there and are reported; quaternions of another length turn as unit ones."""
    rows = []
    quat = np.array([0.9, 0.1, -0.2, 0.3])
    quat /= np.linalg.norm(quat)
    origins, directions = _around(count, 1.0, rng)
    box = _carried(Shape(K.BOX, (1, 0.5, 0.25)))
    settings = {
        "position NaN": (math.nan, 1.0),
        "position infinite": (math.inf, 1.0),
        "quaternion of norm 0": (0.0, 0.0),
        "quaternion NaN": (0.0, math.nan),
        "quaternion of norm 1 - 1e-3": (0.0, 1 - 1e-3),
        "quaternion of norm 1 + 1e-3": (0.0, 1 + 1e-3),
    }
    turned = [v @ matrices(quat) for v in (origins, directions)]  # into the body's frame
    true = box_ranges(*turned, np.array([1, 0.5, 0.25]))
    for name, (x, norm) in settings.items():
        scene = RayScene([box], 2, 1)
        scene.body_quat[:, 0] = torch.from_numpy(quat).float()
        scene.body_pos[1, 0, 0] = x
        scene.body_quat[1, 0] = torch.from_numpy(norm * quat).float()
        both = [torch.from_numpy(v)[None].expand(2, -1, -1).contiguous() for v in (origins, directions)]
        ranges = scene.cast(*both).ranges.double().numpy()
        there = not (x or norm == 0 or math.isnan(norm))
        reported = scene.broken_poses().tolist() == [[False], [not there]]
        loose = _near_silhouette(lambda o, d: box_ranges(o, d, np.array([1, 0.5, 0.25])), *turned, 2e-5)
        row = _row(name, ranges[1], true if there else np.full(count, math.inf), 2e-5, loose & there)
        other = _row("", ranges[0], true, 2e-5, loose)["good"]
        rows.append({**row, "good": row["good"] and reported and other})
    return rows


def crowds(num_bodies: int, count: int, rng: np.random.Generator) -> list[Row]:
    """None, or very many small balls."""
    centres = rng.uniform(-4, 4, (num_bodies, 3)).astype(np.float32).astype(float)
    scene = RayScene([Shape(K.SPHERE, (0.05,), body=k) for k in range(num_bodies)], 1, num_bodies)
    scene.body_pos[0] = torch.from_numpy(centres).float()
    count = min(count, 300)
    origins, directions = np.zeros((count, 3)), random_unit(rng, count, 3)
    true = np.full(count, math.inf)
    for centre in centres:
        true = np.minimum(true, sphere_ranges(origins - centre, directions, 0.05))
    loose = np.zeros(count, bool)
    for sign in (-1e-5, 1e-5):
        other = np.full(count, math.inf)
        for centre in centres:
            other = np.minimum(other, sphere_ranges(origins - centre, directions, 0.05 + sign))
        loose |= ~(np.abs(other - true) < 1e-3) & ~(np.isinf(other) & np.isinf(true))
    return [_row(f"{num_bodies} bodies", _cast(scene, origins, directions), true, 1e-4, loose)]


def counts(count: int, rng: np.random.Generator) -> list[Row]:
    """One ray, and very many."""
    scene = RayScene([Shape(K.SPHERE, (1.0,))], 1, 0)
    origins, directions = np.tile([0.0, 0.0, 3.0], (count, 1)), random_unit(rng, count, 3)
    directions[: (count + 1) // 2] = [0.0, 0.1, -1.0] / np.sqrt(1.01)
    true = sphere_ranges(origins, directions, 1.0)
    loose = _near_silhouette(lambda o, d: sphere_ranges(o, d, 1.0), origins, directions, 2e-5)
    return [_row("1 ray" if count == 1 else f"{count} rays", _cast(scene, origins, directions), true, 2e-5, loose)]


def _bodies(size: float) -> list[tuple[str, Shape, Truth]]:
    """A ball, a box and a cube of triangles of half extent `size`, with their true ranges."""
    half = np.full(3, size)
    mesh = TriangleMesh(CUBE.vertices * size, CUBE.triangles)
    return [
        ("ball", Shape(K.SPHERE, (size,)), lambda o, d: sphere_ranges(o, d, size)),
        ("box", Shape(K.BOX, tuple(half)), lambda o, d: box_ranges(o, d, half)),
        ("mesh", Shape(K.MESH, asset=mesh), lambda o, d: box_ranges(o, d, half)),
    ]


# ---- rays and rows ---------------------------------------------------------------------------------------------------


def _around(count: int, size: float, rng: np.random.Generator) -> Rays:
    """Rays from within four sizes, half of them aimed at the body."""
    origins = size * rng.uniform(-4, 4, (count, 3))
    directions = random_unit(rng, count, 3)
    aimed = size * rng.uniform(-1, 1, (count, 3)) - origins
    half = count // 2
    directions[:half] = (aimed / np.linalg.norm(aimed, axis=1, keepdims=True))[:half]
    return origins, directions


def _carried(shape: Shape) -> Shape:
    return Shape(shape.kind, shape.size, 0, shape.pos, shape.quat, shape.class_id, shape.asset)


def _cast(scene: RayScene, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    return scene.cast(torch.from_numpy(origins)[None], torch.from_numpy(directions)[None]).ranges[0].double().numpy()


def _near_silhouette(truth: Truth, origins: np.ndarray, directions: np.ndarray, allowed: float) -> np.ndarray:
    """(R,) bool: rays that, moved by what a range may be wrong, hit something else: they may go either way."""
    true, loose = truth(origins, directions), np.zeros(len(origins), bool)
    for step in 2 * allowed * np.concatenate([np.eye(3), -np.eye(3)]):
        other = truth(origins + step, directions)
        with np.errstate(invalid="ignore"):
            loose |= (np.isinf(other) != np.isinf(true)) | (np.abs(other - true) > 20 * allowed)
    return loose


def _row(case: str, ranges: np.ndarray, true: np.ndarray, allowed: float, loose: np.ndarray | None = None) -> Row:
    """Ranges against the truth, but for rays that may go either way; NaN is wrong everywhere."""
    strict = np.ones(len(true), bool) if loose is None else ~loose
    missed = (np.isinf(ranges) != np.isinf(true)) & strict
    both = np.isfinite(ranges) & np.isfinite(true) & strict
    error = np.abs(np.where(both, ranges, 0.0) - np.where(both, true, 0.0))
    worst = float(error.max(initial=0.0))
    wrong = int(missed.sum() + np.isnan(ranges).sum() + (error > allowed).sum())
    return _judged(case, len(true), wrong, worst, f"within {allowed:.2g} m") | {"either way": int((~strict).sum())}


def _judged(case: str, count: int, wrong: int, worst: float, expected: str) -> Row:
    return {"case": case, "good": wrong == 0, "rays": count, "wrong": wrong, "worst error": worst, "expected": expected}
