"""How far the LiDAR toolkit's ranges are from mj_ray in float64, by kind of shape, place and size, and what leaks.

A range is right within 1e-5 of it plus 1e-5 m. A ray that is not right is explained if mj_ray itself hits something
else within 1e-4 rad of it, or within 1e-5 m of its origin (1e-4 m for bodies of 1 km). Errors are in units of the
tolerance. Exit status 1 if a share is below 99.99 %, a ray is unexplained, or a ray leaves a closed room.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np
import torch
import trimesh

from benchmarks.harness.reference import mujoco_ranges
from benchmarks.harness.rotations import matrices, random_unit
from benchmarks.harness.table import Table, about, report
from omnilidar import HeightField, Lidar, LidarConfig, RayScene, ScanPattern, Shape, ShapeKind, TriangleMesh
from omnilidar.mujoco import MujocoScene
from omnirobot.common.cli import Command, argument
from omnirobot.common.errors import ConfigError

RELATIVE, ABSOLUTE = 1e-5, 1e-5
"""A range is right within this fraction of it plus this many metres."""
GRAZING_RAD = 1e-4
"""A ray so near to a silhouette may go either way."""
TOUCHING_M, TOUCHING = 1e-5, 1e-7
"""A ray that starts within these metres of a surface, or this fraction of the body's size, may be on either side."""

REQUIRED_SHARE = 0.9999
"""Of the rays of a case that have to be within the tolerance."""

GEOMS = mujoco.mjtGeom
SIZES: dict[mujoco.mjtGeom, Callable[[np.random.Generator], np.ndarray]] = {
    GEOMS.mjGEOM_PLANE: lambda rng: np.array([*rng.choice([0.0, 1.5], 2), 0.01]),
    GEOMS.mjGEOM_BOX: lambda rng: rng.uniform(0.1, 1.0, 3),
    GEOMS.mjGEOM_SPHERE: lambda rng: np.array([rng.uniform(0.1, 1.0), 0.0, 0.0]),
    GEOMS.mjGEOM_CYLINDER: lambda rng: np.array([*rng.uniform(0.1, 1.0, 2), 0.0]),
    GEOMS.mjGEOM_CAPSULE: lambda rng: np.array([*rng.uniform(0.1, 1.0, 2), 0.0]),
    GEOMS.mjGEOM_ELLIPSOID: lambda rng: rng.uniform(0.1, 1.0, 3),
}
OCTAHEDRON = np.array([(0, 1, 2), (1, 3, 2), (3, 4, 2), (4, 0, 2), (1, 0, 5), (3, 1, 5), (4, 3, 5), (0, 4, 5)])
"""Of the axes' unit vectors and their opposites."""
SHAPES = (*SIZES, GEOMS.mjGEOM_MESH, GEOMS.mjGEOM_HFIELD)


@dataclass(frozen=True)
class Case:
    """What is compared: scenes of a kind at a place and of a size.

    Attributes:
        name: Of the row.
        kinds: Geoms of one scene.
        scale: Metres that stand for the length 1 of the random sizes, distances and spreads.
        offset: Distance of the scene from the origin of the world, metres.
        carried: Whether the geoms hang on a mocap body, whose pose is copied, or on the world.
        distance: How far from a surface rays start at most, metres; 0: anywhere within four times the scale.
        scanned: Whether a sensor casts the rays, all of a scene from one place along directions in float32.
    """

    name: str
    kinds: tuple[mujoco.mjtGeom, ...]
    scale: float = 1.0
    offset: float = 0.0
    carried: bool = True
    distance: float = 0.0
    scanned: bool = False


@dataclass
class Tally:
    """What came out of one case.

    Attributes:
        rays: How many were cast.
        hits: How many of them hit something in mj_ray.
        within: How many have mj_ray's geom (or miss) and its range within the tolerance.
        explained: How many of the others graze a silhouette or start on a surface.
        unexplained: The rest.
        disagreements: How many differ in hit or miss.
        worst: Largest error of a range as a multiple of the tolerance, over rays with mj_ray's geom: not explained,
            explained.
        examples: Of the unexplained, in words.
    """

    rays: int = 0
    hits: int = 0
    within: int = 0
    explained: int = 0
    unexplained: int = 0
    disagreements: int = 0
    worst: list[float] = field(default_factory=lambda: [0.0, 0.0])
    examples: list[str] = field(default_factory=list)

    @property
    def share_within(self) -> float:
        return self.within / max(self.rays, 1)


def cases() -> list[Case]:
    """Every kind and a crowd of all at the origin, 1 km away, and of 1 mm and 1 km, also seen from within 5 m."""
    names = {kind: kind.name.removeprefix("mjGEOM_").lower() for kind in SHAPES}
    single = [Case(names[kind], (kind,)) for kind in SHAPES]
    crowd = tuple(SHAPES) * 3
    far = [Case(f"{names[kind]}, 1 km away", (kind,), offset=1000.0) for kind in SHAPES]
    small = [Case(f"{names[kind]}, 1 mm", (kind,), scale=1e-3) for kind in SHAPES]
    large = [Case(f"{names[kind]}, 1 km", (kind,), scale=1e3) for kind in SHAPES]
    fixed = Case("crowd, fixed", crowd, carried=False)
    close = [replace(case, name=f"{case.name} from 5 m", distance=5.0) for case in (*small, *large)]
    crowds = [Case("crowd", crowd), fixed, Case("crowd, 1 km away", crowd, offset=1000.0)]
    scans = [Case("crowd, scanned", crowd, scanned=True), Case("scanned, 1 km away", crowd, offset=1e3, scanned=True)]
    return [*single, *far, *small, *large, *close, *crowds, *scans]


def compare(case: Case, num_rays: int, seed: int, rays_per_scene: int = 10_000, device: str = "cpu") -> Tally:
    """Casts rays through random scenes of a case with both, ours on `device`, and counts where they differ."""
    rng = np.random.default_rng(seed)
    tally = Tally()
    while tally.rays < num_rays:
        model = random_model(case, rng)
        data = random_state(case, model, rng)
        origins, directions = random_rays(case, model, data, min(rays_per_scene, num_rays - tally.rays), rng)
        scene = MujocoScene(model, device=device)
        scene.copy_data(data)
        if case.scanned:
            origins[:] = origins[0]
            ranges, shape, directions = scan(scene, origins[0], directions)
        else:
            starts, along = (torch.from_numpy(vectors)[None].to(device) for vectors in (origins, directions))
            hits = scene.cast(starts, along)
            ranges, shape = hits.ranges[0].cpu().double().numpy(), hits.shape_id[0].cpu().numpy()
        geom = np.where(shape >= 0, np.array([*scene.geom_ids, -1])[shape], -1)
        _count(model, data, origins, directions, ranges, geom, max(TOUCHING_M, TOUCHING * case.scale), tally)
    return tally


def scan(scene: RayScene, origin: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Ranges, shapes and directions of a sensor's rays, whose order is the sensor's, (count,) and (count, 3)."""
    table = torch.from_numpy(directions).float()
    pattern = ScanPattern(table, torch.zeros(len(table)), torch.zeros(len(table)), float(len(table)))
    config = LidarConfig(len(table), period_s=1.0, min_range=0.0, max_range=1e6, mount_pos=tuple(origin))
    lidar = Lidar(config, pattern, scene, mount_body=-1, outputs=("ranges", "shape_id", "directions_s"))
    frame = lidar.cast(torch.zeros(1, dtype=torch.float64, device=scene.device))
    cast = frame.directions_s[0].cpu().double().numpy()
    lengths = np.linalg.norm(cast, axis=1, keepdims=True)
    return frame.ranges[0].cpu().double().numpy(), frame.shape_id[0].cpu().numpy(), cast / lengths


def random_model(case: Case, rng: np.random.Generator) -> mujoco.MjModel:
    """A model of the case's geoms, each on a body of its own or on the world."""
    spec = mujoco.MjSpec()
    spec.compiler.balanceinertia = True
    for k, kind in enumerate(case.kinds):
        parent = spec.worldbody.add_body(name=f"body_{k}", mocap=True) if case.carried else spec.worldbody
        place = {"quat": random_unit(rng, 4)}
        spread = 0.3 if len(case.kinds) == 1 or case.carried else 3.0
        place["pos"] = rng.uniform(-spread, spread, 3) * case.scale
        if not case.carried:
            place["pos"] = place["pos"] + _far_point(case)
        if kind == GEOMS.mjGEOM_MESH:
            vertices, faces = random_mesh(rng)
            spec.add_mesh(
                name=f"mesh_{k}",
                uservert=(vertices * case.scale).ravel(),
                userface=faces.ravel(),
                inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,
            )
            parent.add_geom(type=kind, meshname=f"mesh_{k}", **place)
        elif kind == GEOMS.mjGEOM_HFIELD:
            rows, cols = rng.integers(2, 40, 2)
            size = np.array([*rng.uniform(0.5, 1.5, 2), rng.uniform(0.1, 0.6), rng.uniform(0.05, 0.3)]) * case.scale
            heights = rng.uniform(0.0, 1.0, rows * cols) * rng.choice([0.0, 1.0], rows * cols, p=[0.2, 0.8])
            spec.add_hfield(name=f"field_{k}", nrow=rows, ncol=cols, size=size, userdata=heights)
            parent.add_geom(type=kind, hfieldname=f"field_{k}", **place)
        else:
            size = SIZES[kind](rng) * case.scale
            parent.add_geom(type=kind, size=size, **place)
    return spec.compile()


def random_mesh(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """A closed bumpy ball, (V, 3) and (T, 3): an octahedron divided three times, with noise on the radii."""
    points, faces = np.concatenate([np.eye(3), -np.eye(3)]), OCTAHEDRON
    for _ in range(3):
        points, faces = trimesh.remesh.subdivide(points, faces)
    points = points / np.linalg.norm(points, axis=1, keepdims=True)
    radii = rng.uniform(0.4, 1.0, (len(points), 1)) * rng.uniform(0.5, 1.0)
    return points * radii * rng.uniform(0.5, 1.0, 3), faces


def random_state(case: Case, model: mujoco.MjModel, rng: np.random.Generator) -> mujoco.MjData:
    """Random poses of the bodies around the case's place."""
    data = mujoco.MjData(model)
    if model.nmocap:
        spread = 0.0 if model.nmocap == 1 else 3.0
        data.mocap_pos[:] = _far_point(case) + rng.uniform(-spread, spread, (model.nmocap, 3)) * case.scale
        data.mocap_quat[:] = [random_unit(rng, 4) for _ in range(model.nmocap)]
    mujoco.mj_kinematics(model, data)
    return data


def random_rays(
    case: Case, model: mujoco.MjModel, data: mujoco.MjData, count: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Rays around the bodies, half of them aimed at one, (count, 3) each; a tenth starts in one, or all near one."""
    target = data.geom_xpos[rng.integers(0, len(data.geom_xpos), count)]
    origins = _far_point(case) + rng.uniform(-4.0, 4.0, (count, 3)) * case.scale
    at = target + rng.uniform(-1.0, 1.0, (count, 3)) * case.scale
    if case.distance:
        towards = at - origins
        ranges, _ = mujoco_ranges(model, data, origins, towards)  # in units of `towards`
        on = np.where(np.isfinite(ranges), ranges, 1.0)[:, None]
        at = origins + on * towards + rng.uniform(-0.1, 0.1, (count, 3)) * min(case.scale, case.distance)
        origins = rng.permutation(at) if case.scale > case.distance else at
        origins = origins + rng.uniform(-1.0, 1.0, (count, 3)) * case.distance
    else:
        inside = rng.random(count) < 0.1
        origins[inside] = target[inside] + rng.uniform(-0.3, 0.3, (inside.sum(), 3)) * case.scale
    directions = rng.normal(size=(count, 3))
    aimed = rng.random(count) < 0.5
    directions[aimed] = (at - origins)[aimed]
    return origins, directions / np.linalg.norm(directions, axis=1, keepdims=True)


def _count(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    origins: np.ndarray,
    directions: np.ndarray,
    ours: np.ndarray,
    geom: np.ndarray,
    touching: float,
    tally: Tally,
) -> None:
    """Adds our ranges and geoms to the tally."""
    ranges, geoms = mujoco_ranges(model, data, origins, directions)
    both = (geom >= 0) & (geoms >= 0)
    error = np.zeros(len(ranges))
    error[both] = np.abs(ours[both] - ranges[both]) / (RELATIVE * ranges[both] + ABSOLUTE)
    right = (geom == geoms) & (error <= 1.0)
    tally.rays += len(ranges)
    tally.hits += int((geoms >= 0).sum())
    tally.within += int(right.sum())
    tally.disagreements += int(((geom >= 0) != (geoms >= 0)).sum())
    tally.worst[0] = max(tally.worst[0], error[right].max(initial=0.0))
    for i in np.flatnonzero(~right):
        explained = is_explained(model, data, origins[i], directions[i], touching)
        tally.explained += explained
        tally.unexplained += not explained
        kind = 1 if explained else 0
        tally.worst[kind] = max(tally.worst[kind], error[i])
        if not explained and len(tally.examples) < 5:
            tally.examples.append(
                f"geom {geom[i]} at {ours[i]:.9g} m, mj_ray {geoms[i]} at {ranges[i]:.9g} m; "
                f"origin {origins[i].tolist()}, direction {directions[i].tolist()}"
            )


def is_explained(
    model: mujoco.MjModel, data: mujoco.MjData, origin: np.ndarray, direction: np.ndarray, touching: float
) -> bool:
    """Whether mj_ray itself hits something else within GRAZING_RAD of the direction.

    Or within ``touching`` metres of the origin. A jump of the range to another part of the same geom counts as well.
    """
    side = np.cross(direction, np.eye(3)[np.argmin(np.abs(direction))])
    side /= np.linalg.norm(side)
    other = np.cross(direction, side)
    angles = np.linspace(0.0, 2.0 * math.pi, 16, endpoint=False)
    ring = np.cos(angles)[:, None] * side + np.sin(angles)[:, None] * other
    turned = direction + GRAZING_RAD * ring
    moved = origin + touching * np.concatenate([ring, [direction, -direction]])
    start = np.concatenate([np.broadcast_to(origin, (17, 3)), moved])
    along = np.concatenate([direction[None], turned, np.broadcast_to(direction, (18, 3))])
    ranges, geoms = mujoco_ranges(model, data, start, along)
    if len(set(geoms.tolist())) > 1:
        return True
    steepest = ranges[0] * GRAZING_RAD / 1e-2 + touching / 1e-2  # a surface hit at 0.01 rad goes no farther
    return bool(np.abs(ranges - ranges[0]).max() > steepest) if math.isfinite(ranges[0]) else False


class Room(NamedTuple):
    """A closed shape, rays in its frame from ``origins`` to ``targets`` (N, 3), and where its vertices have moved."""

    shape: Shape
    origins: np.ndarray
    targets: np.ndarray
    vertices: np.ndarray | None = None


def leaks(num_rays: int, seed: int, only: str = "") -> list[tuple[str, int, int]]:
    """(kind, rays, rays that escaped) from inside closed shapes and above height fields, of 1 mm to 1 km, rotated."""
    rooms = {"mesh": _mesh_room, "deformable": _deformable_room, "hfield": _field_room, "box": _box_room}
    rng = np.random.default_rng(seed)
    return [(name, *_escaped(room, num_rays, rng)) for name, room in rooms.items() if only in name]


def _escaped(build: Callable[..., Room], num_rays: int, rng: np.random.Generator) -> tuple[int, int]:
    rays = escaped = 0
    while rays < num_rays:
        scale, quat, place = 10.0 ** rng.uniform(-3, 3), random_unit(rng, 4), rng.uniform(-10, 10, 3)
        room = build(rng, scale)
        turn = matrices(quat)
        scene = RayScene([replace(room.shape, body=0)], 1, 1, pose_dtype=torch.float64)
        if room.vertices is not None:
            scene.update_vertices(0, torch.from_numpy(room.vertices))
        scene.body_pos[:], scene.body_quat[:] = torch.from_numpy(place), torch.from_numpy(quat)
        start, end = (torch.from_numpy(points @ turn.T + place)[None] for points in (room.origins, room.targets))
        ranges = scene.cast(start, end - start).ranges
        rays += ranges.numel()
        escaped += int(ranges.isinf().sum())
    return rays, escaped


def _edge_points(vertices: np.ndarray, faces: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Corners, middles of edges and other points of edges."""
    edges = np.concatenate([vertices[faces[:, [k, (k + 1) % 3]]] for k in range(3)])
    along = rng.uniform(0, 1, (len(edges), 1))
    return np.concatenate([vertices, edges.mean(1), edges[:, 0] * along + edges[:, 1] * (1 - along)])


def _rays_out(points: np.ndarray, scale: float, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Rays from the middle of a room to points of it, and from anywhere near the middle to them and to anywhere."""
    near = rng.uniform(-0.05, 0.05, points.shape) * scale
    anywhere = rng.normal(size=points.shape) * scale
    return np.concatenate([np.zeros_like(points), near, near]), np.concatenate([points, points, anywhere])


def _mesh_room(rng: np.random.Generator, scale: float) -> Room:
    """A bumpy room as it is in float32."""
    vertices, faces = random_mesh(rng)
    mesh = TriangleMesh(vertices * scale, faces)
    points = _edge_points(mesh.vertices.astype(np.float64), mesh.triangles, rng)
    return Room(Shape(ShapeKind.MESH, asset=mesh), *_rays_out(points, scale, rng))


def _deformable_room(rng: np.random.Generator, scale: float) -> Room:
    """A bumpy room that has taken on another one's form."""
    before, faces = random_mesh(rng)
    mesh = TriangleMesh(before * scale, faces)
    vertices = (random_mesh(rng)[0] * scale).astype(np.float32)
    points = _edge_points(vertices.astype(np.float64), mesh.triangles, rng)
    return Room(Shape(ShapeKind.DEFORMABLE, asset=mesh), *_rays_out(points, scale, rng), vertices)


def _box_room(rng: np.random.Generator, scale: float) -> Room:
    """The exact shape from inside."""
    half = rng.uniform(0.1, 1.0, 3) * scale
    corners = half * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    along = rng.uniform(-1, 1, (500, 1)) * half
    edges = [np.where(np.arange(3) == axis, along, corners[rng.integers(0, 8, 500)]) for axis in range(3)]
    return Room(Shape(ShapeKind.BOX, tuple(half)), *_rays_out(np.concatenate([corners, *edges]), scale, rng))


def _field_room(rng: np.random.Generator, scale: float) -> Room:
    """A field with a base: rays from inside to anywhere, and straight down on the grid's points and lines."""
    rows, cols = rng.integers(2, 60, 2)
    heights = rng.uniform(0.2, 1.0, (rows, cols)).astype(np.float32)
    half_x, half_y, top = rng.uniform(0.5, 2.0) * scale, rng.uniform(0.5, 2.0) * scale, rng.uniform(0.1, 2.0) * scale
    shape = Shape(ShapeKind.HEIGHTFIELD, asset=HeightField(heights, half_x, half_y, 0.1 * scale, top))
    x, y = np.meshgrid(np.linspace(-half_x, half_x, cols), np.linspace(-half_y, half_y, rows))
    grid = np.stack([x, y, heights.astype(np.float64) * top], -1)
    lines = [(grid[1:] + grid[:-1]) / 2, (grid[:, 1:] + grid[:, :-1]) / 2, (grid[1:, 1:] + grid[:-1, :-1]) / 2]
    points = np.concatenate([grid.reshape(-1, 3), *(line.reshape(-1, 3) for line in lines)])
    within = points * np.array([1 - 1e-6, 1 - 1e-6, 1.0])  # the rim is a silhouette
    above = within * np.array([1.0, 1.0, 0.0]) + np.array([0.0, 0.0, 3.0 * top])
    inside = np.broadcast_to([0.0, 0.0, 0.1 * top], points.shape)
    anywhere = rng.normal(size=points.shape) * scale
    return Room(shape, np.concatenate([above, inside, inside]), np.concatenate([within, points, anywhere]))


def _far_point(case: Case) -> np.ndarray:
    return case.offset * np.array([0.6, -0.64, 0.48])


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """The command line."""

    rays: int = argument(1_000_000, "rays of each case", least=1)
    seed: int = argument(0, "seed of the scenes", least=0)
    only: str = argument("", "run the cases whose names contain this")
    out: Path = argument(Path("outputs/lidar_accuracy"), "folder of the results")


def accuracy(num_rays: int, seed: int, only: str = "", device: str = "cpu") -> tuple[Table, bool]:
    """All cases, and whether all of them are right."""
    table = Table(
        "lidar_accuracy",
        f"ranges against mj_ray in float64, {num_rays:,} rays a case, on {device}",
        ("case", "rays", "hits", "within", "hit/miss differs", "explained", "unexplained", "error", "explained error"),
    )
    good = True
    for case in cases():
        if only in case.name:
            tally = compare(case, num_rays, seed, device=device)
            good &= tally.share_within >= REQUIRED_SHARE and tally.unexplained == 0
            counts = (tally.disagreements, tally.explained, tally.unexplained)
            table.rows.append((case.name, tally.rays, tally.hits, f"{tally.share_within:.5%}", *counts, *tally.worst))
            table.notes += tally.examples
    return table, good


def main(given: Arguments) -> None:
    """Measures, prints, writes, and exits with 1 if something is wrong."""
    table, good = accuracy(given.rays, given.seed, given.only)
    escaped = leaks(given.rays, given.seed, given.only)
    if not table.rows and not escaped:
        names = (case.name for case in cases())
        raise ConfigError(f"only={given.only} is in no name of a case or room; cases are {', '.join(names)}")
    good &= all(count == 0 for *_, count in escaped)
    rooms = Table("leaks", "rays out of closed rooms", ("room", "rays", "escaped"), escaped)
    report([table, rooms] if escaped else [table], about(1, seed=given.seed), given.out)
    sys.exit(0 if good else 1)


command = Command(main, Arguments, __doc__)

if __name__ == "__main__":
    command()
