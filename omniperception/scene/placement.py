"""Where obstacles are put at a reset: off the robot, apart from one another, beside a free path."""

from __future__ import annotations

import math

import torch

from omniperception.common.random import EnvRandom
from omniperception.scene.obstacles import ObstaclesConfig

_GOLDEN_ANGLE = math.pi * (3.0 - math.sqrt(5.0))
_PUSH_OFF_TURNS = 16
_CANDIDATES = 48
"""Places drawn for an obstacle that has to keep clear of something; the first that does is taken."""


def unit(angle: torch.Tensor) -> torch.Tensor:
    """Horizontal unit vectors (..., 2) at angles (...) in rad."""
    return torch.stack((angle.cos(), angle.sin()), -1)


def within(bounds: torch.Tensor, u: torch.Tensor) -> torch.Tensor:
    """Maps draws (n, num) from [0, 1) to ranges (num, 2)."""
    return bounds[:, 0] + u * (bounds[:, 1] - bounds[:, 0])


class Placement:
    """Chooses where obstacles stand.

    Attributes:
        bounds: low and high (O, 2) m of the obstacles' areas, or (num_envs, O, 2) where each world has its own.
        follows: whether the areas lie around the robot.
    """

    def __init__(self, config: ObstaclesConfig, random: EnvRandom, like: torch.Tensor, by_world: bool) -> None:
        """`like` has the precision and the device of positions; `by_world`: each environment has areas of its own."""
        self._config, self._random = config, random
        area = like.new_tensor([own.group.area or config.area for own in config.obstacles()])
        shape = (len(like), *area.shape) if by_world else area.shape
        area = area.expand(shape).clone()
        self.bounds = area[..., [0, 2]], area[..., [1, 3]]
        self._of_world = torch.tensor([own.group.area is None for own in config.obstacles()], device=like.device)
        self.follows = config.boundary == "wrap"
        self._searches = config.spacing > 0.0 or config.free_path is not None

    def stay_within(self, env_ids: torch.Tensor, areas: torch.Tensor) -> None:
        """Gives obstacles without an area of their own the areas (n, 4) of the worlds of environments (n,)."""
        for bound, columns in zip(self.bounds, ([0, 2], [1, 3]), strict=True):
            bound[env_ids] = torch.where(self._of_world[:, None], areas[:, None, columns], bound[env_ids])

    def _bounds_of(self, env_ids: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Low and high (O, 2) or (n, O, 2) m of the areas in environments (n,)."""
        low, high = self.bounds
        return (low, high) if low.dim() == 2 else (low[env_ids], high[env_ids])

    def choose(
        self,
        env_ids: torch.Tensor,
        u: torch.Tensor,
        robot: torch.Tensor,
        goal: torch.Tensor | None,
        radius: torch.Tensor,
        in_the_way: torch.Tensor,
        placed: torch.Tensor,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Places in environments (n,) that keep the clearance from the robot.

        Every environment draws equally many random numbers, whatever fits.

        Args:
            env_ids: (n,).
            u: (n, 2, O) draws.
            robot, goal: (n, 2) m.
            radius: (n, O) m.
            in_the_way: (n, O) bool, who keeps the spacing and stays off the free path.
            placed: (O,) bool, who needs no place.

        Returns:
            (n, O, 2) m, and who has found one (n, O) bool.
        """
        config, bounds = self._config, self._bounds_of(env_ids)
        if not self._searches:
            xy, found = push_off(
                self._in_area(u, robot, bounds), robot, config.clearance + radius, bounds, around_robot=self.follows
            )
            return xy, found | placed
        u = self._random.uniform(env_ids, (_CANDIDATES * 2, radius.shape[1])).to(radius.dtype)
        places = torch.stack([self._in_area(pair, robot, bounds) for pair in u.split(2, 1)], 2)  # (n, O, C, 2)
        fits = (places - robot[:, None, None]).norm(dim=-1) - radius[..., None] >= config.clearance
        if config.free_path is not None:
            assert goal is not None
            bends = config.free_path.bend * (2 * self._random.uniform(env_ids, (2,)).to(radius.dtype) - 1)
            off_path = distance_to_path(places, bent_path(robot, goal.to(radius.dtype), bends)) - radius[..., None]
            fits &= (off_path >= config.free_path.width / 2) | ~in_the_way[..., None]
        return choose_apart(places, fits, radius, in_the_way, placed.expand(len(robot), -1), config.spacing)

    def _in_area(self, u: torch.Tensor, robot: torch.Tensor, bounds: tuple[torch.Tensor, torch.Tensor]) -> torch.Tensor:
        """Places (n, O, 2) within bounds, those of the areas, from (n, 2, O) draws."""
        low, high = bounds
        return low + u.transpose(1, 2) * (high - low) + (robot[:, None] if self.follows else 0.0)


def push_off(
    xy: torch.Tensor,
    robot: torch.Tensor,
    keep: torch.Tensor,
    bounds: tuple[torch.Tensor, torch.Tensor],
    around_robot: bool = False,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Moves obstacles that would stand on the robot radially away from it.

    Args:
        xy: (n, O, 2) m, where they would stand.
        robot: (n, 2) m.
        keep: (n, O) m, the least distance of their centres from the robot.
        bounds: low and high (O, 2) or (n, O, 2) m of where they may go.
        around_robot: whether the bounds are the robot's; what were beyond them would enter on the other side.

    Returns:
        (n, O, 2) m, and who has found a place (n, O) bool: an area may be too small for one.
    """
    offset = xy - robot[:, None]
    bearing = torch.atan2(offset[..., 1], offset[..., 0])
    turns = torch.arange(_PUSH_OFF_TURNS, dtype=xy.dtype, device=xy.device)[:, None, None]
    outside = robot[:, None] + unit(bearing + turns * _GOLDEN_ANGLE) * (keep + 1e-6)[..., None]
    places = torch.cat((xy[None], outside))  # where it is, then other directions, for robots close to an edge
    if not around_robot:
        places[1:] = places[1:].clamp(*bounds)
    apart = places - robot[:, None]
    clear = apart.norm(dim=-1) >= keep
    if around_robot:
        clear[1:] &= ((apart[1:] >= bounds[0]) & (apart[1:] <= bounds[1])).all(-1)
    first = clear.int().argmax(0)
    return places.gather(0, first[None, ..., None].expand(1, -1, -1, 2))[0], clear.any(0)


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
    """Corners (n, 4, 2) of a line from start (n, 2) to goal (n, 2) over points at one and two thirds of it,
    which lie `offset` (n, 2) m to the left of the straight line."""
    span = goal - start
    left = torch.stack((-span[:, 1], span[:, 0]), -1) / span.norm(dim=1, keepdim=True).clamp(min=1e-9)
    corners = [start, *(start + (k + 1) / 3 * span + offset[:, k, None] * left for k in (0, 1)), goal]
    return torch.stack(corners, 1)


def distance_to_path(points: torch.Tensor, path: torch.Tensor) -> torch.Tensor:
    """Distances (n, ...) in m of points (n, ..., 2) from lines with corners (n, C, 2)."""
    flat = points.flatten(1, -2)[:, :, None]  # (n, P, 1, 2)
    start, side = path[:, None, :-1], (path[:, 1:] - path[:, :-1])[:, None]
    along = ((flat - start) * side).sum(-1) / side.square().sum(-1).clamp(min=1e-12)
    foot = start + along.clamp(0.0, 1.0)[..., None] * side
    return (flat - foot).norm(dim=-1).amin(-1).reshape(points.shape[:-1])
