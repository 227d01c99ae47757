"""True distance between the robot's links and the obstacles, from the geometry that the physics collides."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
import torch

from omniperception.env.env import OmniEnv
from omniperception.lidar.mujoco import convex_hull

CAPSULE, CYLINDER, BOX, HULL = range(4)
"""Kinds of shapes about the local z axis; a sphere is a capsule of length 0."""
_KINDS = {
    mujoco.mjtGeom.mjGEOM_SPHERE: CAPSULE,
    mujoco.mjtGeom.mjGEOM_CAPSULE: CAPSULE,
    mujoco.mjtGeom.mjGEOM_CYLINDER: CYLINDER,
    mujoco.mjtGeom.mjGEOM_BOX: BOX,
}
TOLERANCE = 5e-4
"""Pairs are worked out to within this (m)."""
_ITERATIONS, _BETWEEN_CHECKS = 200, 5


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
        turned_r, turned_o = mat[:, : robot.num], mat[:, robot.num :]
        at_r, at_o = robot.centres(pos[:, : robot.num], turned_r), obstacles.centres(pos[:, robot.num :], turned_o)
        middle = at_r.mean(1)
        reach = ((at_r - middle[:, None]).norm(dim=-1) + robot.radius).amax(1)
        from_middle = distance_from_bounds(obstacles.kind, obstacles.size, turned_o, middle[:, None] - at_o)  # (n, O)
        env_ids, o = (from_middle < (below + reach)[:, None]).nonzero(as_tuple=True)
        offset = at_r[env_ids] - at_o[env_ids, o][:, None]  # (M, R, 3)
        kind, size = obstacles.kind[o][:, None], obstacles.size[env_ids, o][:, None]
        from_bounds = distance_from_bounds(kind, size, turned_o[env_ids, o][:, None], offset)
        from_inside = torch.where(kind == HULL, offset.norm(dim=-1), from_bounds)  # a hull holds its centre
        nearest = below.scatter_reduce(0, env_ids, from_inside.amin(1), "amin")
        pair, r = (from_bounds - robot.radius < nearest[env_ids, None]).nonzero(as_tuple=True)
        env_ids, o = env_ids[pair], o[pair]
        frame_r, frame_o = turned_r[env_ids, r], turned_o[env_ids, o]
        distance = convex_distance(
            robot.shapes(env_ids, r),
            obstacles.shapes(env_ids, o),
            -_into(frame_r, offset[pair, r]),
            (frame_r[..., None] * frame_o[..., None, :]).sum(1),
            nearest[env_ids],
        )
        return below.scatter_reduce(0, env_ids, distance, "amin")


@dataclass(frozen=True)
class Shapes:
    """Convex shapes about their centres.

    Attributes:
        kind: (M,) CAPSULE, CYLINDER, BOX or HULL.
        size: (M, 3) m: radius and half length for the round ones, half extents of boxes and of a hull's bounds.
        faces: (M, F, 4, 3): corners (m) and outward unit normals of a hull's triangles; None where none is a hull.
    """

    kind: torch.Tensor
    size: torch.Tensor
    faces: torch.Tensor | None = None

    def __getitem__(self, which: torch.Tensor) -> Shapes:
        return Shapes(self.kind[which], self.size[which], None if self.faces is None else self.faces[which])

    def nearest(self, point: torch.Tensor) -> torch.Tensor:
        """The point (M, 3) of each shape that is nearest to a point (M, 3) in its frame, m."""
        result = nearest_point(self.kind, self.size, point)
        if self.faces is None:
            return result
        which = (self.kind == HULL).nonzero().flatten()
        return result.index_copy(0, which, nearest_in_hull(self.faces[which], point[which]))

    def support(self, direction: torch.Tensor) -> torch.Tensor:
        """(M,) how far (m) the shapes reach in unit directions (M, 3)."""
        along, across = direction[:, 2].abs(), direction[:, :2].norm(dim=1)
        box = (direction.abs() * self.size).sum(1)
        rounded = torch.where(self.kind == CYLINDER, across, 1.0) * self.size[:, 0]
        reach = torch.where(self.kind == BOX, box, self.size[:, 1] * along + rounded)
        if self.faces is None:
            return reach
        corners = (self.faces[:, :, :3] * direction[:, None, None]).sum(-1).flatten(1).amax(1)
        return torch.where(self.kind == HULL, corners, reach)


class Geoms:
    """Shapes of some geoms of a model.

    Attributes:
        ids: their MuJoCo ids.
        kind: (G,) as in `Shapes`.
        size: (num_envs, G, 3) m, as in `Shapes`.
        radius: (G,) m, of the sphere around a shape's centre that holds it, in the model's size.
    """

    def __init__(self, model: mujoco.MjModel, ids: Sequence[int], num_envs: int, device: torch.device) -> None:
        kinds, sizes, centres, faces, sized = [], [], [], [], []
        for i in ids:
            geom_type = mujoco.mjtGeom(int(model.geom_type[i]))
            kind, size, centre, own = _KINDS.get(geom_type, BOX), model.geom_size[i].copy(), np.zeros(3), None
            if geom_type == mujoco.mjtGeom.mjGEOM_SPHERE:
                size[1:] = 0.0
            elif geom_type == mujoco.mjtGeom.mjGEOM_MESH and model.mesh_graphadr[model.geom_dataid[i]] >= 0:
                kind = HULL
                centre, size, own = _hull(model, int(model.geom_dataid[i]))
            elif geom_type not in _KINDS:
                centre, size = model.geom_aabb[i, :3], model.geom_aabb[i, 3:]
            kinds.append(kind)
            sizes.append(size)
            centres.append(centre)
            faces.append(own)
            sized.append(geom_type in _KINDS)
        self.ids, self.num = tuple(int(i) for i in ids), len(ids)
        self.kind = torch.tensor(kinds, device=device)
        size = torch.tensor(np.array(sizes), dtype=torch.float32, device=device)
        self.size = size.expand(num_envs, -1, -1)
        self._centre = torch.tensor(np.array(centres), dtype=torch.float32, device=device)
        self._is_sized = torch.tensor(sized, device=device)[:, None]
        self._faces = _padded(faces, device)
        by_kind = torch.stack((size[:, 0] + size[:, 1], torch.hypot(size[:, 0], size[:, 1]), *2 * [size.norm(dim=1)]))
        self.radius = by_kind.gather(0, self.kind[None])[0]

    def resize(self, size: torch.Tensor) -> None:
        """Takes the sizes (num_envs, G, 3) in m of spheres, capsules, cylinders and boxes, the unused ones 0."""
        self.size = torch.where(self._is_sized, size.to(self.size), self.size)

    def shapes(self, env_ids: torch.Tensor, which: torch.Tensor) -> Shapes:
        """Geoms `which` (M,) in environments (M,)."""
        return Shapes(self.kind[which], self.size[env_ids, which], None if self._faces is None else self._faces[which])

    def centres(self, pos: torch.Tensor, mat: torch.Tensor) -> torch.Tensor:
        """(n, G, 3) centres of the shapes of geoms at poses (n, G, 3), (n, G, 3, 3)."""
        return pos + _out_of(mat, self._centre) if bool(self._centre.any()) else pos


def _hull(model: mujoco.MjModel, mesh: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Centre (3,) of a mesh's hull, half extents (3,) of bounds about it, and faces (F, 4, 3) as in `Shapes`."""
    vertices, triangles = convex_hull(model, mesh)
    vertices = vertices.astype(np.float64)
    centre = vertices.mean(0)
    corners = (vertices - centre)[triangles]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(normal, axis=1, keepdims=True)
    faces = np.concatenate((corners, (normal / np.maximum(area, 1e-30))[:, None]), 1)[area[:, 0] > 1e-12]
    return centre, np.abs(vertices - centre).max(0), faces


def _padded(faces: list[np.ndarray | None], device: torch.device) -> torch.Tensor | None:
    """(G, F, 4, 3) faces of all geoms, repeated where one has fewer; None without any."""
    most = max((len(own) for own in faces if own is not None), default=0)
    if not most:
        return None
    rows = [np.zeros((most, 4, 3)) if own is None else own[np.arange(most) % len(own)] for own in faces]
    return torch.tensor(np.array(rows), dtype=torch.float32, device=device)


def distance_from_bounds(
    kind: torch.Tensor, size: torch.Tensor, mat: torch.Tensor, offset: torch.Tensor
) -> torch.Tensor:
    """Distances (...) in m of points `offset` (..., 3) from the centres of shapes from these shapes, hulls as boxes."""
    local = _into(mat, offset)
    return (local - nearest_point(kind, size, local)).norm(dim=-1)


def convex_distance(a: Shapes, b: Shapes, pos: torch.Tensor, mat: torch.Tensor, below: torch.Tensor) -> torch.Tensor:
    """Distances (M,) in m between pairs of shapes, at most TOLERANCE too large where they are less than `below`.

    Half the squared distance of a point x of A from B has the gradient x - P_B(x), so that projected gradient
    descent alternates the projections onto the two shapes; it is accelerated after Nesterov and restarted where the
    momentum points away from the descent. A pair is done when the plane through P_B(x) square to the way from x
    proves that B is not nearer: no point of B lies before it, and none of A farther than A's support.

    Args:
        a, b: M shapes each.
        pos, mat: (M, 3) m and (M, 3, 3): pose of B in the frame of A.
        below: (M,) m; a pair is given up, at some distance not less than this, once that is proven.
    """
    result = torch.zeros(len(pos), device=pos.device)
    left = torch.arange(len(pos), device=pos.device)
    point = a.nearest(pos)
    ahead, momentum = point, torch.ones_like(pos[:, :1])
    for _ in range(_ITERATIONS // _BETWEEN_CHECKS):
        for _ in range(_BETWEEN_CHECKS):
            new = a.nearest(_onto(b, pos, mat, ahead))
            step = new - point
            momentum = torch.where(((ahead - new) * step).sum(1, keepdim=True) > 0, 1.0, momentum)
            grown = (1 + (1 + 4 * momentum.square()).sqrt()) / 2
            ahead, point, momentum = new + (momentum - 1) / grown * step, new, grown
        foot = _onto(b, pos, mat, point)
        distance = (foot - point).norm(dim=1)
        result[left] = distance
        normal = (foot - point) / distance.clamp(min=1e-9)[:, None]
        proven = (normal * foot).sum(1) - a.support(normal)
        unsure = (distance > TOLERANCE) & (distance - proven > TOLERANCE) & (proven < below)
        if not unsure.any():
            break
        left, point, ahead, momentum = left[unsure], point[unsure], ahead[unsure], momentum[unsure]
        a, b, pos, mat, below = a[unsure], b[unsure], pos[unsure], mat[unsure], below[unsure]
    return result


def _onto(shapes: Shapes, pos: torch.Tensor, mat: torch.Tensor, point: torch.Tensor) -> torch.Tensor:
    """The points of shapes at poses (M, 3), (M, 3, 3) that are nearest to points (M, 3)."""
    return _out_of(mat, shapes.nearest(_into(mat, point - pos))) + pos


def nearest_in_hull(faces: torch.Tensor, point: torch.Tensor) -> torch.Tensor:
    """The point (M, 3) of a convex hull that is nearest to another (M, 3), itself where it lies inside; m.

    Of all its triangles (M, F, 4, 3): the foot on the plane where it falls within the sides, or on a side.
    """
    corners, normal, at = faces[:, :, :3], faces[:, :, 3], point[:, None]
    height = ((at - corners[:, :, 0]) * normal).sum(-1)  # (M, F)
    side, from_corner = corners.roll(-1, 2) - corners, at[:, :, None] - corners  # (M, F, 3, 3)
    along = (from_corner * side).sum(-1) / side.square().sum(-1)
    on_side = corners + along.clamp(0.0, 1.0)[..., None] * side
    inward = torch.linalg.cross(normal[:, :, None].expand_as(side), side)
    is_over = ((from_corner * inward).sum(-1) >= 0).all(-1)
    on_plane = at - height[..., None] * normal
    distance = (on_side - at[:, :, None]).norm(dim=-1).flatten(1)
    distance = torch.cat((distance, torch.where(is_over, height.abs(), torch.inf)), 1)
    feet = torch.cat((on_side.flatten(1, 2), on_plane), 1)  # (M, 4 F, 3)
    nearest = feet.gather(1, distance.argmin(1)[:, None, None].expand(-1, 1, 3))[:, 0]
    return torch.where((height <= 0).all(1, keepdim=True), point, nearest)


def nearest_point(kind: torch.Tensor, size: torch.Tensor, point: torch.Tensor) -> torch.Tensor:
    """The point of a shape that is nearest to another, which is the point itself where it lies inside; hulls are boxes.

    Args:
        kind: (...) as in `Shapes`.
        size: (..., 3) likewise.
        point: (..., 3) m, in the shape's frame.
    """
    radius, half = size[..., :1], size[..., 1:2]
    xy, z = point[..., :2], point[..., 2:]
    on_axis = z.clamp(-half, half)
    disc = xy * (radius / xy.norm(dim=-1, keepdim=True).clamp(min=1e-12)).clamp(max=1.0)
    from_axis = torch.cat((xy, z - on_axis), -1)
    ball = from_axis * (radius / from_axis.norm(dim=-1, keepdim=True).clamp(min=1e-12)).clamp(max=1.0)
    capsule = torch.cat((ball[..., :2], ball[..., 2:] + on_axis), -1)
    cylinder = torch.cat((disc, on_axis), -1)
    box = point.clamp(-size, size)
    kind = kind[..., None]
    return torch.where(kind == CAPSULE, capsule, torch.where(kind == CYLINDER, cylinder, box))


def _into(mat: torch.Tensor, vec: torch.Tensor) -> torch.Tensor:
    """Vectors (..., 3) in the frames with axes in the columns of (..., 3, 3)."""
    return (mat * vec[..., None]).sum(-2)


def _out_of(mat: torch.Tensor, vec: torch.Tensor) -> torch.Tensor:
    return (mat * vec[..., None, :]).sum(-1)
