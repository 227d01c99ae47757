"""True distance between the robot's links and the obstacles, from the geometry that the physics collides."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np
import torch

from omniperception.env.env import OmniEnv

CAPSULE, CYLINDER, BOX = range(3)
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

    Spheres, capsules, cylinders and boxes are taken as they are, other geoms as their bounding boxes. Overlap is 0.
    """

    def __init__(self, env: OmniEnv) -> None:
        model, names = env.world.model, env.world.obstacles.geom_names()
        robot = np.flatnonzero(model.body_rootid[model.geom_bodyid] == env.world.base_body)
        self._robot = Geoms(model, robot.tolist(), env.device)
        self._obstacles = Geoms(model, [model.geom(name).id for name in names], env.device)
        self._sim = env.sim

    def measure(self, below: torch.Tensor) -> torch.Tensor:
        """Clearances (num_envs,) at the current state where they are less than `below` (num_envs,), else `below`.

        Only pairs that can be nearer than `below` are worked out, so that a low bound is fast.
        """
        robot, obstacles = self._robot, self._obstacles
        pos, mat = self._sim.geom_poses(robot.ids + obstacles.ids)
        turned_r, turned_o = mat[:, : robot.num], mat[:, robot.num :]
        at_r, at_o = robot.centres(pos[:, : robot.num], turned_r), obstacles.centres(pos[:, robot.num :], turned_o)
        middle = at_r.mean(1)
        reach = ((at_r - middle[:, None]).norm(dim=-1) + robot.radius).amax(1)
        from_middle = obstacles.distance(slice(None), turned_o, middle[:, None] - at_o)  # (n, O)
        env_ids, o = (from_middle < (below + reach)[:, None]).nonzero(as_tuple=True)
        offset = at_r[env_ids] - at_o[env_ids, o][:, None]  # (M, R, 3)
        from_centre = obstacles.distance(o[:, None], turned_o[env_ids, o][:, None], offset)
        nearest = below.scatter_reduce(0, env_ids, from_centre.amin(1), "amin")
        pair, r = (from_centre - robot.radius < nearest[env_ids, None]).nonzero(as_tuple=True)
        env_ids, o = env_ids[pair], o[pair]
        frame_r, frame_o = turned_r[env_ids, r], turned_o[env_ids, o]
        distance = convex_distance(
            robot.kind[r],
            robot.size[r],
            obstacles.kind[o],
            obstacles.size[o],
            -_into(frame_r, offset[pair, r]),
            (frame_r[..., None] * frame_o[..., None, :]).sum(1),
            nearest[env_ids],
        )
        return below.scatter_reduce(0, env_ids, distance, "amin")


class Geoms:
    """Shapes of some geoms of a model.

    Attributes:
        ids: their MuJoCo ids.
        kind: (G,) CAPSULE, CYLINDER or BOX.
        size: (G, 3) m: radius and half length for the round ones, half extents for boxes.
        radius: (G,) m, of the sphere around a shape's centre that holds it.
    """

    def __init__(self, model: mujoco.MjModel, ids: Sequence[int], device: torch.device) -> None:
        kinds, sizes, centres = [], [], []
        for i in ids:
            geom_type = mujoco.mjtGeom(int(model.geom_type[i]))
            size, centre = model.geom_size[i].copy(), np.zeros(3)
            if geom_type == mujoco.mjtGeom.mjGEOM_SPHERE:
                size[1:] = 0.0
            elif geom_type not in _KINDS:
                centre, size = model.geom_aabb[i, :3], model.geom_aabb[i, 3:]
            kinds.append(_KINDS.get(geom_type, BOX))
            sizes.append(size)
            centres.append(centre)
        self.ids, self.num = tuple(int(i) for i in ids), len(ids)
        self.kind = torch.tensor(kinds, device=device)
        self.size = torch.tensor(np.array(sizes), dtype=torch.float32, device=device)
        self._centre = torch.tensor(np.array(centres), dtype=torch.float32, device=device)
        radius, half = self.size[:, 0], self.size[:, 1]
        by_kind = torch.stack((radius + half, torch.hypot(radius, half), self.size.norm(dim=1)))
        self.radius = by_kind.gather(0, self.kind[None])[0]

    def centres(self, pos: torch.Tensor, mat: torch.Tensor) -> torch.Tensor:
        """(n, G, 3) centres of the shapes of geoms at poses (n, G, 3), (n, G, 3, 3)."""
        return pos + _out_of(mat, self._centre) if bool(self._centre.any()) else pos

    def distance(self, which: torch.Tensor | slice, mat: torch.Tensor, offset: torch.Tensor) -> torch.Tensor:
        """Distances (...) in m of points `offset` (..., 3) from the centres of shapes `which` from these shapes."""
        local = _into(mat, offset)
        return (local - nearest_point(self.kind[which], self.size[which], local)).norm(dim=-1)


def convex_distance(
    kind_a: torch.Tensor,
    size_a: torch.Tensor,
    kind_b: torch.Tensor,
    size_b: torch.Tensor,
    pos: torch.Tensor,
    mat: torch.Tensor,
    below: torch.Tensor,
) -> torch.Tensor:
    """Distances (M,) in m between pairs of shapes, at most TOLERANCE too large where they are less than `below`.

    Half the squared distance of a point x of A from B has the gradient x - P_B(x), so that projected gradient
    descent alternates the projections onto the two shapes; it is accelerated after Nesterov and restarted where the
    momentum points away from the descent. A pair is done when the plane through P_B(x) square to the way from x
    proves that B is not nearer: no point of B lies before it, and none of A farther than A's support.

    Args:
        kind_a, size_a: (M,) and (M, 3), as in `Geoms`.
        kind_b, size_b: likewise.
        pos, mat: (M, 3) m and (M, 3, 3): pose of B in the frame of A.
        below: (M,) m; a pair is given up, at some distance not less than this, once that is proven.
    """
    result = torch.zeros(len(pos), device=pos.device)
    left = torch.arange(len(pos), device=pos.device)
    pairs: tuple[torch.Tensor, ...] = kind_a, size_a, kind_b, size_b, pos, mat, below
    point = nearest_point(kind_a, size_a, pos)
    ahead, momentum = point, torch.ones_like(pos[:, :1])
    for _ in range(_ITERATIONS // _BETWEEN_CHECKS):
        kind_a, size_a, kind_b, size_b, pos, mat, below = pairs
        for _ in range(_BETWEEN_CHECKS):
            new = nearest_point(kind_a, size_a, _onto(kind_b, size_b, pos, mat, ahead))
            step = new - point
            momentum = torch.where(((ahead - new) * step).sum(1, keepdim=True) > 0, 1.0, momentum)
            grown = (1 + (1 + 4 * momentum.square()).sqrt()) / 2
            ahead, point, momentum = new + (momentum - 1) / grown * step, new, grown
        foot = _onto(kind_b, size_b, pos, mat, point)
        distance = (foot - point).norm(dim=1)
        result[left] = distance
        normal = (foot - point) / distance.clamp(min=1e-9)[:, None]
        proven = (normal * foot).sum(1) - support(kind_a, size_a, normal)
        unsure = (distance > TOLERANCE) & (distance - proven > TOLERANCE) & (proven < below)
        if not unsure.any():
            break
        left, point, ahead, momentum = left[unsure], point[unsure], ahead[unsure], momentum[unsure]
        pairs = tuple(part[unsure] for part in pairs)
    return result


def _onto(
    kind: torch.Tensor, size: torch.Tensor, pos: torch.Tensor, mat: torch.Tensor, point: torch.Tensor
) -> torch.Tensor:
    """The points of shapes at poses (M, 3), (M, 3, 3) that are nearest to points (M, 3)."""
    return _out_of(mat, nearest_point(kind, size, _into(mat, point - pos))) + pos


def support(kind: torch.Tensor, size: torch.Tensor, direction: torch.Tensor) -> torch.Tensor:
    """(M,) how far (m) shapes about their centres reach in unit directions (M, 3)."""
    along, across = direction[:, 2].abs(), direction[:, :2].norm(dim=1)
    box = (direction.abs() * size).sum(1)
    axis = size[:, 1] * along
    round_off = torch.where(kind == CYLINDER, across, 1.0) * size[:, 0]
    return torch.where(kind == BOX, box, axis + round_off)


def nearest_point(kind: torch.Tensor, size: torch.Tensor, point: torch.Tensor) -> torch.Tensor:
    """The point of a shape that is nearest to another, which is the point itself where it lies inside.

    Args:
        kind: (...) CAPSULE, CYLINDER or BOX.
        size: (..., 3) as in `Geoms`.
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
    return torch.where(kind == BOX, box, torch.where(kind == CYLINDER, cylinder, capsule))


def _into(mat: torch.Tensor, vec: torch.Tensor) -> torch.Tensor:
    """Vectors (..., 3) in the frames with axes in the columns of (..., 3, 3)."""
    return (mat * vec[..., None]).sum(-2)


def _out_of(mat: torch.Tensor, vec: torch.Tensor) -> torch.Tensor:
    return (mat * vec[..., None, :]).sum(-1)
