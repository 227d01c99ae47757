"""True distance between the robot's links and the obstacles, from the geometry that the physics collides."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np
import torch
import warp as wp

from omnilidar.launch import launch_over_envs, view
from omnilidar.mujoco import convex_hull
from omniperception.env.env import OmniEnv
from omniperception.evaluation.trials import clearance_kernels as kernels
from omniperception.evaluation.trials.clearance_kernels import BOX, CAPSULE, CYLINDER, HULL

_KINDS = {
    mujoco.mjtGeom.mjGEOM_SPHERE: CAPSULE,
    mujoco.mjtGeom.mjGEOM_CAPSULE: CAPSULE,
    mujoco.mjtGeom.mjGEOM_CYLINDER: CYLINDER,
    mujoco.mjtGeom.mjGEOM_BOX: BOX,
}


class Clearance:
    """Smallest distance (m) in space between the surfaces of any geom of the robot and of any obstacle.

    Spheres, capsules, cylinders and boxes are taken as they are, obstacles in the sizes that each environment has,
    meshes as the convex hulls that touch, other geoms as their bounding boxes. Overlap is 0.
    """

    def __init__(self, env: OmniEnv) -> None:
        assert env.obstacles is not None  # from which there is a distance
        model, names = env.world.model, [part.name for part in env.obstacles.parts]
        own = model.body_rootid[model.geom_bodyid] == env.world.base_body
        robot = np.flatnonzero(own & (model.geom_conaffinity != 0))
        self._robot = Geoms(model, robot.tolist(), env.num_envs, env.device)
        self._obstacles = Geoms(model, [model.geom(name).id for name in names], env.num_envs, env.device)
        self._sim, self._field = env.sim, env.obstacles

    def measure(self, below: torch.Tensor) -> torch.Tensor:
        """Clearances (num_envs,) at the current state where they are less than `below` (num_envs,), else `below`.

        Only pairs that can be nearer than `below` are worked out, so that a low bound is fast.
        """
        robot, obstacles = self._robot, self._obstacles
        obstacles.resize(self._field.size)
        pos, mat = self._sim.geom_poses(robot.ids + obstacles.ids)
        pos_r, pos_o = pos.split((robot.num, obstacles.num), 1)
        mat_r, mat_o = mat.split((robot.num, obstacles.num), 1)
        return clearances(robot, pos_r, mat_r, obstacles, pos_o, mat_o, below)


def clearances(
    robot: Geoms,
    pos_r: torch.Tensor,
    mat_r: torch.Tensor,
    obstacles: Geoms,
    pos_o: torch.Tensor,
    mat_o: torch.Tensor,
    below: torch.Tensor,
) -> torch.Tensor:
    """Distances (n,) in m between the nearest two of some geoms and others, where less than `below` (n,), else that.

    Args:
        robot, obstacles: R and O geoms.
        pos_r, mat_r, pos_o, mat_o: (n, R, 3), (n, R, 3, 3), (n, O, 3), (n, O, 3, 3): poses of the geoms, m.
        below: m; at most TOLERANCE is what a distance is too large.
    """
    least, held = below.to(torch.float32).clone(), []
    for geoms, pos, mat in ((robot, pos_r, mat_r), (obstacles, pos_o, mat_o)):
        mat = mat.contiguous()
        held.append((geoms, geoms.centres(pos, mat).contiguous(), mat, geoms.size.contiguous()))
    (robot, at_r, mat_r, size_r), (obstacles, at_o, mat_o, size_o) = held
    inputs = [
        *(view(robot.kind, wp.int32), view(size_r, wp.vec3), view(robot.radius, wp.float32)),
        *(view(robot.faces, wp.vec3), view(robot.num_faces, wp.int32), view(at_r, wp.vec3), view(mat_r, wp.mat33)),
        *(view(obstacles.kind, wp.int32), view(size_o, wp.vec3)),
        *(view(obstacles.faces, wp.vec3), view(obstacles.num_faces, wp.int32), view(at_o, wp.vec3)),
        *(view(mat_o, wp.mat33), view(least, wp.float32)),
    ]
    launch_over_envs(kernels.clearances, len(least), inputs, least.device)
    return least


class Geoms:
    """Shapes of some geoms of a model.

    Attributes:
        ids: their MuJoCo ids.
        kind: (G,) int32, CAPSULE, CYLINDER, BOX or HULL.
        size: (num_envs, G, 3) m: radius and half length of round ones, half extents of boxes and of a hull's bounds.
        radius: (G,) m, of the sphere around a shape's centre that holds it, in the model's size.
        faces: (G, F, 4, 3): corners (m) and outward unit normals of a hull's triangles; `num_faces` (G,) int32 count.
    """

    def __init__(self, model: mujoco.MjModel, ids: Sequence[int], num_envs: int, device: torch.device) -> None:
        rows, sized = [], []
        for i in ids:
            geom_type = mujoco.mjtGeom(int(model.geom_type[i]))
            kind, size, centre, faces = _KINDS.get(geom_type, BOX), model.geom_size[i].copy(), np.zeros(3), None
            if geom_type == mujoco.mjtGeom.mjGEOM_SPHERE:
                size[1:] = 0.0
            elif geom_type == mujoco.mjtGeom.mjGEOM_MESH and model.mesh_graphadr[model.geom_dataid[i]] >= 0:
                kind = HULL
                centre, size, faces = _hull(model, int(model.geom_dataid[i]))
            elif geom_type not in _KINDS:
                centre, size = model.geom_aabb[i, :3], model.geom_aabb[i, 3:]
            rows.append((kind, size, centre, faces))
            sized.append(geom_type in _KINDS)
        kinds, sizes, centres, all_faces = zip(*rows, strict=True)
        self.ids, self.num = tuple(int(i) for i in ids), len(ids)
        self.kind = torch.tensor(kinds, dtype=torch.int32, device=device)
        size = torch.tensor(np.array(sizes), dtype=torch.float32, device=device)
        self.size = size.expand(num_envs, -1, -1)
        self._centre = torch.tensor(np.array(centres), dtype=torch.float32, device=device)
        self._is_sized = torch.tensor(sized, device=device)[:, None]
        self.faces, self.num_faces = _padded(all_faces, device)
        by_kind = torch.stack((size[:, 0] + size[:, 1], torch.hypot(size[:, 0], size[:, 1]), *2 * [size.norm(dim=1)]))
        self.radius = by_kind.gather(0, self.kind[None].long())[0]

    def resize(self, size: torch.Tensor) -> None:
        """Takes the sizes (num_envs, G, 3) in m of spheres, capsules, cylinders and boxes, the unused ones 0."""
        self.size = torch.where(self._is_sized, size.to(self.size), self.size)

    def centres(self, pos: torch.Tensor, mat: torch.Tensor) -> torch.Tensor:
        """(n, G, 3) centres of the shapes of geoms at poses (n, G, 3), (n, G, 3, 3)."""
        return pos + (mat * self._centre[:, None]).sum(-1) if bool(self._centre.any()) else pos


def _hull(model: mujoco.MjModel, mesh: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Centre (3,) of a mesh's hull, half extents (3,) of bounds about it, and faces (F, 4, 3) as in `Geoms`."""
    vertices, triangles = convex_hull(model, mesh)
    vertices = vertices.astype(np.float64)
    centre = vertices.mean(0)
    corners = (vertices - centre)[triangles]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(normal, axis=1, keepdims=True)
    faces = np.concatenate((corners, (normal / np.maximum(area, 1e-30))[:, None]), 1)[area[:, 0] > 1e-12]
    return centre, np.abs(vertices - centre).max(0), faces


def _padded(faces: Sequence[np.ndarray | None], device: torch.device) -> tuple[torch.Tensor, torch.Tensor]:
    """(G, F, 4, 3) faces of all geoms, zeros where one has fewer, and (G,) how many each has."""
    counts = [0 if own is None else len(own) for own in faces]
    rows = np.zeros((len(faces), max(1, *counts), 4, 3))
    for row, own in zip(rows, faces, strict=True):
        if own is not None:
            row[: len(own)] = own
    padded = torch.tensor(rows, dtype=torch.float32, device=device)
    return padded, torch.tensor(counts, dtype=torch.int32, device=device)
