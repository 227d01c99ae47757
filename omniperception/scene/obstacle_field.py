"""Places the obstacles of all environments and moves them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch

from omniperception.common.random import EnvRandom
from omniperception.scene.obstacles import Obstacle, ObstaclesConfig

if TYPE_CHECKING:
    from omniperception.scene.ground import Ground

PARKED_HEIGHT = -100.0
"""Height (m) at which an inactive obstacle is parked, below the ground where no ray and no contact finds it."""
LOSE_SIGHT = 1.0
"""Distance (m) beyond its farthest start at which an approaching obstacle starts again."""
_GOLDEN_ANGLE = math.pi * (3.0 - math.sqrt(5.0))
_PUSH_OFF_TURNS = 16
_CANDIDATES = 48
"""Places drawn for an obstacle that has to keep clear of something; the first that does is taken."""


class ObstacleField:
    """Places and moves the kinematic obstacles of all environments.

    Attributes:
        pos_w: (num_envs, num_placed, 3) m, environment frame; the simulator's own kinematic positions, whose precision
            everything here has.
        quat_w: (num_envs, num_placed, 4); the simulator's own kinematic orientations.
        velocity_w: (num_envs, num_placed, 2) m/s.
        active: (num_envs, num_placed) bool: whether an obstacle takes part in the current episode.
        radius: (num_placed,) m, of the circle around the footprint.
        approaches: (num_placed,) bool: which obstacles come at the robot.
        any_approaches: whether some do, and `restart_approaching` has to be called.
        level: share of obstacles and of their speed that the curriculum lets in, 0 to 1.
    """

    def __init__(
        self,
        config: ObstaclesConfig,
        pos_w: torch.Tensor,
        quat_w: torch.Tensor,
        random: EnvRandom,
        ground: Ground | None = None,
    ) -> None:
        """`ground` is what they stand on and move over, at the height below their centres; None: a plane at 0."""
        self.config, self._ground = config, ground
        self.pos_w, self.quat_w = pos_w, quat_w
        self._random = random
        slots, device = config.placed_slots(), pos_w.device
        self._dtype = pos_w.dtype

        def column(*values: float | Sequence[float]) -> torch.Tensor:
            return torch.tensor(values, dtype=self._dtype, device=device)

        groups = [slot.group for slot in slots]
        self.radius = column(*(slot.radius for slot in slots))
        self._half_height = column(*(slot.half_height for slot in slots))
        self._speed = column(*(group.speed for group in groups))
        self._bottom = column(*(group.bottom for group in groups))
        self._heading = torch.deg2rad(column(*(group.heading_deg for group in groups)))
        self._yaw = torch.deg2rad(column(*(group.yaw_deg for group in groups)))
        area = column(*(group.area or config.area for group in groups))
        self._low, self._high = area[:, [0, 2]], area[:, [1, 3]]
        self.approaches = torch.tensor([group.approach is not None for group in groups], device=device)
        self._within = column(*(group.approach.within if group.approach else 0.0 for group in groups))
        self._start = column(*(group.approach.distance if group.approach else (0.0, 0.0) for group in groups))
        self.any_approaches = bool(self.approaches.any())
        self._searches = config.spacing > 0.0 or config.free_path is not None
        self._any_moves = any(_moves(slot) for slot in slots)
        self._stands = torch.tensor([not _moves(slot) for slot in slots], device=device)
        self.velocity_w = torch.zeros(pos_w.shape[0], len(slots), 2, dtype=self._dtype, device=device)
        self.active = torch.zeros(pos_w.shape[0], len(slots), dtype=torch.bool, device=device)
        self.level = 1.0 if config.curriculum is None else 0.0
        followers = pos_w.shape[:2] if ground is not None else (0,)
        self._above_ground = torch.zeros(followers, dtype=self._dtype, device=device)
        self._path = torch.zeros(pos_w.shape[0], 0, len(slots), 3, dtype=self._dtype, device=device)

    def reset(
        self,
        env_ids: torch.Tensor,
        robot_xy_w: torch.Tensor,
        command_w: torch.Tensor | None = None,
        goal_w: torch.Tensor | None = None,
    ) -> None:
        """Places the obstacles of some environments again.

        Args:
            env_ids: (n,) which environments.
            robot_xy_w: (n, 2) where the robot stands, m.
            command_w: (n, 2) the velocity (m/s) that it is commanded; None for none.
            goal_w: (n, 2) where it is to go, m; only a free path needs it.
        """
        robot = robot_xy_w.to(self._dtype)
        u = self._random.uniform(env_ids, (7, self.pos_w.shape[1])).to(self._dtype)
        bottom, yaw, heading = (
            _within(bounds, u[:, row]) for row, bounds in ((6, self._bottom), (2, self._yaw), (4, self._heading))
        )
        speed = _within(self._speed, u[:, 3]) * self.level
        active = u[:, 5] < self.level
        if self._searches:
            xy, found = self._keep_clear(env_ids, robot, goal_w, bottom)
            active = active & found
        else:
            xy = self._push_off(self._in_area(u[:, :2], robot), robot)
        self.active[env_ids] = active
        self.velocity_w[env_ids] = _unit(heading) * (speed * active)[..., None]
        z = torch.where(active, bottom + self._half_height, PARKED_HEIGHT)
        self.pos_w[env_ids] = torch.cat((xy, z[..., None]), -1)
        if self._ground is not None:
            self._above_ground[env_ids] = bottom + self._half_height
        zero = torch.zeros_like(yaw)
        self.quat_w[env_ids] = torch.stack(((yaw / 2).cos(), zero, zero, (yaw / 2).sin()), -1)
        if self.any_approaches:
            command = torch.zeros_like(robot) if command_w is None else command_w.to(self._dtype)
            self._start_approach(env_ids, self.approaches & active, robot, command)
        if self._ground is not None:
            self.pos_w[env_ids, :, 2] = self._over_ground(self.pos_w[env_ids, :, :2], env_ids)

    def advance(self, dt: float, robot_xy_w: torch.Tensor) -> None:
        """Moves every obstacle level by `dt` (s); `robot_xy_w` (num_envs, 2) is the centre of a wrapping area."""
        if self._any_moves:
            self.pos_w[..., :2] += self.velocity_w * dt
        if self.config.boundary == "bounce":
            if self._any_moves:
                self._bounce()
        else:
            self._wrap(robot_xy_w)

    def travel(self, dt: float, num_steps: int, robot_xy_w: torch.Tensor) -> torch.Tensor:
        """Moves every obstacle by `num_steps` steps of `dt` (s); see `advance`.

        Returns:
            (num_envs, num_steps, num_placed, 3) m, where they are after each step, on the ground; the same memory in
            every call.
        """
        if self._path.shape[1] != num_steps:
            with torch.inference_mode(False):  # it is written in and out of rollouts
                self._path = self._path.new_zeros(len(self.pos_w), num_steps, *self.pos_w.shape[1:])
        for step in range(num_steps):
            self.advance(dt, robot_xy_w)
            self._path[:, step] = self.pos_w
        if self._ground is not None and self._path.numel():
            self._ground.lift(self._path, self._above_ground, self.active, PARKED_HEIGHT)
            self.pos_w.copy_(self._path[:, -1])
        return self._path

    @property
    def yaw(self) -> torch.Tensor:
        """(num_envs, num_placed) orientation (rad) about the vertical; obstacles turn about no other axis."""
        return 2 * torch.atan2(self.quat_w[..., 3], self.quat_w[..., 0])

    def bottom_above_ground(self) -> torch.Tensor:
        """(num_envs, num_placed) height (m) of the lowest points above the ground below the centres."""
        bottom = self.pos_w[..., 2] - self._half_height
        return bottom if self._ground is None else bottom - self._ground.height(self.pos_w[..., :2])

    def restart_approaching(self, robot_xy_w: torch.Tensor, command_w: torch.Tensor) -> None:
        """Restarts approaching obstacles that have passed the robot; see `reset` for the arguments."""
        distance = (self.pos_w[..., :2] - robot_xy_w.to(self._dtype)[:, None]).norm(dim=-1)
        gone = self.approaches & self.active & (distance > self._start[:, 1] + LOSE_SIGHT)
        env_ids = gone.any(1).nonzero().flatten()
        if len(env_ids):
            robot, command = (xy[env_ids].to(self._dtype) for xy in (robot_xy_w, command_w))
            self._start_approach(env_ids, gone[env_ids], robot, command)

    def raise_level(self, velocity_error: float, seconds: float) -> None:
        """Raises the curriculum's level while the robot walks well (`velocity_error` in m/s)."""
        curriculum = self.config.curriculum
        if curriculum is None:
            return
        bound = curriculum.max_velocity_error if self.level > 0 else curriculum.start_velocity_error
        if velocity_error < bound:
            self.level = min(1.0, self.level + curriculum.rise * seconds)

    def state_dict(self) -> dict:
        """State that `load_state_dict` needs to go on; positions belong to the simulator's state."""
        state = {"velocity_w": self.velocity_w.clone(), "active": self.active.clone(), "level": self.level}
        return state if self._ground is None else {**state, "above_ground": self._above_ground.clone()}

    def load_state_dict(self, state: dict) -> None:
        if self._ground is not None:
            self._above_ground.copy_(state["above_ground"])
        self.velocity_w.copy_(state["velocity_w"])
        self.active.copy_(state["active"])
        self.level = state["level"]

    # ---- placing -----------------------------------------------------------------------------------------------------

    def _in_area(self, u: torch.Tensor, robot: torch.Tensor) -> torch.Tensor:
        """Places (n, num_placed, 2) in the areas from (n, 2, num_placed) draws."""
        anchor = robot[:, None] if self.config.boundary == "wrap" else 0.0
        return self._low + u.transpose(1, 2) * (self._high - self._low) + anchor

    def _push_off(self, xy: torch.Tensor, robot: torch.Tensor) -> torch.Tensor:
        """Moves obstacles that would stand on the robot radially out of its clearance, inside the area."""
        keep = self.config.clearance + self.radius
        offset = xy - robot[:, None]
        bearing = torch.atan2(offset[..., 1], offset[..., 0])
        turns = torch.arange(_PUSH_OFF_TURNS, dtype=self._dtype, device=xy.device)[:, None, None]
        outside = robot[:, None] + _unit(bearing + turns * _GOLDEN_ANGLE) * (keep + 1e-6)[:, None]
        places = torch.cat((xy[None], outside))  # where it is, then other directions, for robots close to an edge
        if self.config.boundary == "bounce":
            places[1:] = places[1:].clamp(self._low, self._high)
        clear = (places - robot[:, None]).norm(dim=-1) >= keep
        clear[-1] = True
        first = clear.int().argmax(0)
        return places.gather(0, first[None, ..., None].expand(1, -1, -1, 2))[0]

    def _keep_clear(
        self, env_ids: torch.Tensor, robot: torch.Tensor, goal: torch.Tensor | None, bottom: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Places (n, num_placed, 2) with the spacing and off the free path, and (n, num_placed) whether found.

        Obstacles choose in turn. Every environment draws equally many random numbers, whatever fits.
        """
        config, count = self.config, self.pos_w.shape[1]
        u = self._random.uniform(env_ids, (_CANDIDATES * 2, count)).to(self._dtype)
        places = torch.stack([self._in_area(pair, robot) for pair in u.split(2, 1)], 2)  # (n, num_placed, C, 2)
        in_the_way = self._stands & (bottom < config.headroom)
        fits = (places - robot[:, None, None]).norm(dim=-1) - self.radius[:, None] >= config.clearance
        if config.free_path is not None:
            assert goal is not None
            bends = config.free_path.bend * (2 * self._random.uniform(env_ids, (2,)).to(self._dtype) - 1)
            off_path = distance_to_path(places, bent_path(robot, goal.to(self._dtype), bends)) - self.radius[:, None]
            fits &= (off_path >= config.free_path.width / 2) | ~in_the_way[..., None]
        xy, found = places[:, :, 0].clone(), self.approaches.repeat(len(robot), 1)
        for k in range(count):
            keep = config.spacing + self.radius[k] + self.radius[:k]
            gap = (places[:, k, :, None] - xy[:, None, :k]).norm(dim=-1) - keep  # (n, C, k)
            counts = (in_the_way[:, :k] & found[:, :k])[:, None] & in_the_way[:, k, None, None]
            free = fits[:, k] & ((gap >= 0) | ~counts).all(-1) if config.spacing else fits[:, k]
            first = free.int().argmax(1)
            xy[:, k] = places[torch.arange(len(robot), device=robot.device), k, first]
            found[:, k] |= free.any(1)
        return xy, found

    def _start_approach(
        self, env_ids: torch.Tensor, which: torch.Tensor, robot: torch.Tensor, command: torch.Tensor
    ) -> None:
        """Puts obstacles `which` (n, num_placed) around the robots (n, 2) on courses that lead past them."""
        u = self._random.uniform(env_ids, (3, self.pos_w.shape[1])).to(self._dtype)
        bearing = _unit(2 * math.pi * u[:, 0])
        distance = _within(self._start, u[:, 1])
        miss = (2 * u[:, 2] - 1) * self._within
        before = self.velocity_w[env_ids]
        speed = before.norm(dim=-1)  # which an obstacle keeps through the episode
        velocity = passing_velocity(bearing, distance, miss, speed, command[:, None])
        xy = robot[:, None] + bearing * distance[..., None]
        self.pos_w[env_ids, :, :2] = torch.where(which[..., None], xy, self.pos_w[env_ids, :, :2])
        self.velocity_w[env_ids] = torch.where(which[..., None], velocity, before)

    # ---- moving ------------------------------------------------------------------------------------------------------

    def _over_ground(self, xy: torch.Tensor, env_ids: torch.Tensor) -> torch.Tensor:
        """Heights (n, num_placed) of the obstacles' centres where they are at (n, num_placed, 2)."""
        assert self._ground is not None
        above = self._above_ground[env_ids] + self._ground.height(xy, env_ids)
        return torch.where(self.active[env_ids], above, PARKED_HEIGHT)

    def _bounce(self) -> None:
        xy, free = self.pos_w[..., :2], self.approaches[:, None]
        below, above = (xy < self._low) & ~free, (xy > self._high) & ~free
        inward = torch.where(below, self.velocity_w.abs(), torch.where(above, -self.velocity_w.abs(), self.velocity_w))
        self.velocity_w.copy_(inward)
        xy.copy_(torch.where(below, 2 * self._low - xy, torch.where(above, 2 * self._high - xy, xy)))

    def _wrap(self, robot_xy_w: torch.Tensor) -> None:
        low = self._low + robot_xy_w.to(self._dtype)[:, None]
        xy = self.pos_w[..., :2]
        wrapped = low + torch.remainder(xy - low, self._high - self._low)
        xy.copy_(torch.where(self.approaches[:, None], xy, wrapped))


def passing_velocity(
    bearing: torch.Tensor, distance: torch.Tensor, miss: torch.Tensor, speed: torch.Tensor, robot_vel: torch.Tensor
) -> torch.Tensor:
    """Velocity of an obstacle whose course leads past a robot that keeps its own velocity.

    Seen from the robot, the obstacle moves along e, which points back to the robot but for the angle
    asin(miss / distance): it passes at distance |miss|. Its own velocity is w = v + s e with |w| = speed, so
    s = -v.e + sqrt((v.e)^2 + speed^2 - |v|^2). Without a solution s > 0 the robot gets away, and w = speed e.

    Args:
        bearing: (..., 2) unit vectors from the robot to the obstacle.
        distance: (...) m, larger than `miss`.
        miss: (...) m, to the left of the way to the robot where positive.
        speed: (...) m/s, of the obstacle.
        robot_vel: (..., 2) v, m/s.

    Returns:
        (..., 2) m/s.
    """
    angle = torch.asin(miss / distance)
    x, y = (-bearing).unbind(-1)
    course = torch.stack((angle.cos() * x - angle.sin() * y, angle.sin() * x + angle.cos() * y), -1)
    along = (robot_vel * course).sum(-1)
    discriminant = along.square() + speed.square() - robot_vel.square().sum(-1)
    relative = discriminant.clamp(min=0.0).sqrt() - along
    catches = (discriminant >= 0) & (relative > 1e-3)
    return torch.where(catches[..., None], robot_vel + relative[..., None] * course, speed[..., None] * course)


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


def _within(bounds: torch.Tensor, u: torch.Tensor) -> torch.Tensor:
    """Maps draws (n, num) from [0, 1) to ranges (num, 2)."""
    return bounds[:, 0] + u * (bounds[:, 1] - bounds[:, 0])


def _unit(angle: torch.Tensor) -> torch.Tensor:
    return torch.stack((angle.cos(), angle.sin()), -1)


def _moves(slot: Obstacle) -> bool:
    return slot.group.speed[1] > 0
