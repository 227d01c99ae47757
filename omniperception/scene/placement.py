"""Where obstacles are put at a reset: off the robot, apart from one another, beside a free path."""

from __future__ import annotations

import math

import torch

from omniperception.common.random import EnvRandom
from omniperception.scene.obstacles import ObstaclesConfig

LAYOUT_SEEDS = {"dev": 1, "test": 2}
"""Seeds of the layouts' worlds, by split."""
_GOLDEN_ANGLE = math.pi * (3.0 - math.sqrt(5.0))
_PUSH_OFF_TURNS = 16


def unit(angle: torch.Tensor) -> torch.Tensor:
    """Horizontal unit vectors (..., 2) at angles (...) in rad."""
    return torch.stack((angle.cos(), angle.sin()), -1)


def push_off(
    xy: torch.Tensor, robot: torch.Tensor, keep: torch.Tensor, bounds: tuple[torch.Tensor, torch.Tensor] | None
) -> torch.Tensor:
    """Moves obstacles that would stand on the robot radially away from it.

    Args:
        xy: (n, O, 2) m, where they would stand.
        robot: (n, 2) m.
        keep: (n, O) m, the least distance of their centres from the robot.
        bounds: low and high (O, 2) m of where they may go; None: anywhere.

    Returns:
        (n, O, 2) m.
    """
    offset = xy - robot[:, None]
    bearing = torch.atan2(offset[..., 1], offset[..., 0])
    turns = torch.arange(_PUSH_OFF_TURNS, dtype=xy.dtype, device=xy.device)[:, None, None]
    outside = robot[:, None] + unit(bearing + turns * _GOLDEN_ANGLE) * (keep + 1e-6)[..., None]
    places = torch.cat((xy[None], outside))  # where it is, then other directions, for robots close to an edge
    if bounds is not None:
        places[1:] = places[1:].clamp(*bounds)
    clear = (places - robot[:, None]).norm(dim=-1) >= keep
    clear[-1] = True
    first = clear.int().argmax(0)
    return places.gather(0, first[None, ..., None].expand(1, -1, -1, 2))[0]


def choose_apart(
    places: torch.Tensor,
    fits: torch.Tensor,
    radius: torch.Tensor,
    in_the_way: torch.Tensor,
    placed: torch.Tensor,
    spacing: float,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Lets obstacles choose among candidate places in turn, so that those in the way keep apart.

    Args:
        places: (n, O, C, 2) m.
        fits: (n, O, C) bool, which of them are fit but for the other obstacles.
        radius: (n, O) m.
        in_the_way: (n, O) bool, who keeps the spacing and from whom it is kept.
        placed: (n, O) bool, who needs no place.
        spacing: free distance (m) between edges; 0: none is kept.

    Returns:
        The places (n, O, 2) and who has found one (n, O) bool.
    """
    xy, found = places[:, :, 0].clone(), placed.clone()
    rows = torch.arange(len(places), device=places.device)
    for k in range(places.shape[1]):
        free = fits[:, k]
        if spacing > 0.0:
            keep = spacing + radius[:, k, None] + radius[:, :k]  # (n, k)
            gap = (places[:, k, :, None] - xy[:, None, :k]).norm(dim=-1) - keep[:, None]  # (n, C, k)
            counts = in_the_way[:, :k] & found[:, :k] & in_the_way[:, k, None]
            free = free & ((gap >= 0) | ~counts[:, None]).all(-1)
        xy[:, k] = places[rows, k, free.int().argmax(1)]
        found[:, k] |= free.any(1)
    return xy, found


def bent_path(start: torch.Tensor, goal: torch.Tensor, offset: torch.Tensor) -> torch.Tensor:
    """Corners (n, 4, 2) of a line from start (n, 2) to goal (n, 2) over points at one and two thirds of the way,
    which lie `offset` (n, 2) m to the left of the straight line."""
    way = goal - start
    left = torch.stack((-way[:, 1], way[:, 0]), -1) / way.norm(dim=1, keepdim=True).clamp(min=1e-9)
    corners = [start, *(start + (k + 1) / 3 * way + offset[:, k, None] * left for k in (0, 1)), goal]
    return torch.stack(corners, 1)


def distance_to_path(points: torch.Tensor, path: torch.Tensor) -> torch.Tensor:
    """Distances (n, ...) in m of points (n, ..., 2) from lines with corners (n, C, 2)."""
    flat = points.flatten(1, -2)[:, :, None]  # (n, P, 1, 2)
    start, side = path[:, None, :-1], (path[:, 1:] - path[:, :-1])[:, None]
    along = ((flat - start) * side).sum(-1) / side.square().sum(-1).clamp(min=1e-12)
    foot = start + along.clamp(0.0, 1.0)[..., None] * side
    return (flat - foot).norm(dim=-1).amin(-1).reshape(points.shape[:-1])


def within(bounds: torch.Tensor, u: torch.Tensor) -> torch.Tensor:
    """Maps draws (n, num) from [0, 1) to ranges (num, 2)."""
    return bounds[:, 0] + u * (bounds[:, 1] - bounds[:, 0])


class Poses:
    """Obstacles that stand where they are told: at fixed poses, or as the worlds of layouts have them.

    Attributes:
        which: (O,) bool, those with fixed poses or in a layout.
        fixed: (O,) bool, those with fixed poses.
        any: whether there are some.
    """

    def __init__(self, config: ObstaclesConfig, random: EnvRandom, like: torch.Tensor) -> None:
        """`like` has the precision and the device of positions. The layouts' worlds are made here."""
        obstacles = config.obstacles()
        self._random = random
        self.fixed = torch.tensor([o.pose is not None for o in obstacles], dtype=torch.bool, device=like.device)
        self.which = torch.tensor([o.group.has_poses for o in obstacles], dtype=torch.bool, device=like.device)
        self.any = any(o.group.has_poses for o in obstacles)
        poses = like.new_tensor([o.pose or (0.0, 0.0, 0.0) for o in obstacles])
        poses[:, 2] = torch.deg2rad(poses[:, 2])
        self._pose = poses
        self._tables: list[tuple[int, torch.Tensor]] = []
        names = [own.name for own in obstacles]
        part_names = config.geom_names()
        self._columns: list[tuple[slice, slice]] = []
        for name, group in config.groups.items():
            if group.layout is not None:
                table = like.new_tensor(group.layout.table(LAYOUT_SEEDS[config.split], group.layout.worlds))
                own, part = names.index(f"obstacle_{name}_0"), part_names.index(f"obstacle_{name}_0")
                self._columns.append((slice(own, own + group.count), slice(part, part + group.count)))
                self._tables.append((group.layout.worlds, table))

    def draw(self, env_ids: torch.Tensor, size: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Poses (n, O, 3), x and y in m and yaw in rad, of environments (n,), and which of them there are (n, O).

        The sizes (n, P, 3) of what layouts have are written into `size`.
        """
        pose = self._pose.expand(len(env_ids), -1, -1)
        there = self.which.expand(len(env_ids), -1)
        if not self._tables:
            return pose, there
        pose, there = pose.clone(), there.clone()
        u = self._random.uniform(env_ids, (len(self._tables),))
        for k, ((worlds, table), (own, parts)) in enumerate(zip(self._tables, self._columns, strict=True)):
            rows = table[(u[:, k] * worlds).long()]
            there[:, own] = rows[..., 0].isfinite()
            pose[:, own] = rows[..., :3].nan_to_num(0.0)
            size[:, parts] = torch.where(there[:, own, None], rows[..., 3:], size[:, parts])
        return pose, there


class Presence:
    """Who of the groups with `present` takes part in an episode."""

    def __init__(self, config: ObstaclesConfig, random: EnvRandom) -> None:
        self._random, self._groups, first = random, [], 0
        for group in config.groups.values():
            if group.present is not None:
                low, high = group.present
                self._groups.append((slice(first, first + group.count), low, high))
            first += group.count
        self._count = first

    def draw(self, env_ids: torch.Tensor) -> torch.Tensor | None:
        """(n, O) bool for environments (n,); None where all always take part."""
        if not self._groups:
            return None
        u = self._random.uniform(env_ids, (self._count + len(self._groups),))
        there = torch.ones(len(env_ids), self._count, dtype=torch.bool, device=u.device)
        for k, (own, low, high) in enumerate(self._groups):
            number = low + (u[:, self._count + k] * (high - low + 1)).long()
            rank = u[:, own].argsort(1).argsort(1)
            there[:, own] = rank < number[:, None]
        return there
