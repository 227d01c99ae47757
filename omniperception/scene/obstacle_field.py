"""Places the obstacles of all environments, draws their sizes and moves them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch

from omniperception.common.random import EnvRandom
from omniperception.scene.obstacle_motion import bounce, passing_velocity, wrap
from omniperception.scene.obstacles import ObstaclesConfig
from omniperception.scene.parts import PartShapes
from omniperception.scene.placement import bent_path, choose_apart, distance_to_path, push_off, unit

if TYPE_CHECKING:
    from omniperception.scene.ground import Ground

PARKED_HEIGHT = -100.0
"""Height (m) at which an inactive obstacle is parked, below the ground where no ray and no contact finds it."""
LOSE_SIGHT = 1.0
"""Distance (m) beyond its farthest start at which an approaching obstacle starts again."""
_CANDIDATES = 48
"""Places drawn for an obstacle that has to keep clear of something; the first that does is taken."""


class ObstacleField:
    """Places and moves the obstacles of all environments; P is the number of their parts.

    Attributes:
        parts: the parts, in the order of the kinematic bodies.
        pos_w: (num_envs, P, 3) m, environment frame; the simulator's own kinematic positions, whose precision
            everything here has.
        quat_w: (num_envs, P, 4); the simulator's own kinematic orientations.
        velocity_w: (num_envs, P, 2) m/s.
        active: (num_envs, P) bool: whether a part takes part in the current episode.
        size: (num_envs, P, 3) m, in MuJoCo's order, padded with 0; drawn at every reset.
        outline: (num_envs, P, 2) m: half x and half y of the rectangle seen from above, about `yaw`; radius and -1 of
            a circle.
        radius: (num_envs, P) m, of the circle around the outline.
        half_height: (num_envs, P) m.
        free: index of the parts that have no fixed pose.
        approaches: (P,) bool: which obstacles come at the robot.
        any_approaches: whether some do, and `restart_approaching` has to be called.
        varying: indices of the parts whose sizes differ between environments.
        level: share of obstacles and of their speed that the curriculum lets in, 0 to 1; fixed ones are always there.
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
        self.parts, obstacles, device = config.parts(), config.obstacles(), pos_w.device
        self._dtype = pos_w.dtype

        def column(*values: float | Sequence[float]) -> torch.Tensor:
            return torch.tensor(values, dtype=self._dtype, device=device)

        groups = [obstacle.group for obstacle in obstacles]
        self._shapes = PartShapes(self.parts, self._dtype, device)
        self.varying = tuple(k for k, part in enumerate(self.parts) if part.varies)
        self._speed = column(*(group.speed for group in groups))
        self._bottom = column(*(group.bottom for group in groups))
        self._heading = torch.deg2rad(column(*(group.heading_deg for group in groups)))
        self._yaw = torch.deg2rad(column(*(group.yaw_deg for group in groups)))
        area = column(*(group.area or config.area for group in groups))
        self._bounds = area[:, [0, 2]], area[:, [1, 3]]
        poses = column(*(obstacle.pose or (0.0, 0.0, 0.0) for obstacle in obstacles))
        self._fixed_xy, self._fixed_yaw = poses[:, :2], torch.deg2rad(poses[:, 2])
        self._fixed = torch.tensor([obstacle.pose is not None for obstacle in obstacles], device=device)
        self._any_fixed = bool(self._fixed.any())
        loose = [k for k, part in enumerate(self.parts) if part.group.poses is None]
        self.free = torch.tensor(loose, device=device) if self._any_fixed else slice(None)
        self.approaches = torch.tensor([group.approach is not None for group in groups], device=device)
        self._within = column(*(group.approach.within if group.approach else 0.0 for group in groups))
        self._start = column(*(group.approach.distance if group.approach else (0.0, 0.0) for group in groups))
        self.any_approaches = bool(self.approaches.any())
        self._bound = ~(self.approaches | self._fixed)
        self._searches = config.spacing > 0.0 or config.free_path is not None
        self._any_moves = any(group.moves for group in groups)
        self._in_the_way = torch.tensor([not group.moves for group in groups], device=device) & ~self._fixed
        n, count = len(pos_w), len(groups)
        self.velocity_w = torch.zeros(n, count, 2, dtype=self._dtype, device=device)
        self.active = torch.zeros(n, count, dtype=torch.bool, device=device)
        self.level = 1.0 if config.curriculum is None else 0.0
        self._above_ground = torch.zeros(n if ground is not None else 0, count, dtype=self._dtype, device=device)
        self._path = torch.zeros(n, 0, count, 3, dtype=self._dtype, device=device)
        self.size = self._shapes.draw(torch.zeros(n, 3, count, dtype=self._dtype, device=device))
        self._follow_sizes()

    @property
    def yaw(self) -> torch.Tensor:
        """(num_envs, P) orientation (rad) about the vertical; obstacles turn about no other axis."""
        return 2 * torch.atan2(self.quat_w[..., 3], self.quat_w[..., 0])

    def bottom_above_ground(self) -> torch.Tensor:
        """(num_envs, P) height (m) of the lowest points above the ground below the centres."""
        bottom = self.pos_w[..., 2] - self.half_height
        return bottom if self._ground is None else bottom - self._ground.height(self.pos_w[..., :2])

    def reset(
        self,
        env_ids: torch.Tensor,
        robot_xy_w: torch.Tensor,
        command_w: torch.Tensor | None = None,
        goal_w: torch.Tensor | None = None,
    ) -> None:
        """Places the obstacles of some environments again, in sizes drawn anew.

        Args:
            env_ids: (n,) which environments.
            robot_xy_w: (n, 2) where the robot stands, m.
            command_w: (n, 2) the velocity (m/s) that it is commanded; None for none.
            goal_w: (n, 2) where it is to go, m; only a free path needs it.
        """
        robot = robot_xy_w.to(self._dtype)
        u = self._random.uniform(env_ids, (10, self.pos_w.shape[1])).to(self._dtype)
        self.size[env_ids] = self._shapes.draw(u[:, 7:])
        self._follow_sizes(env_ids)
        bottom, yaw, heading = (
            _within(bounds, u[:, row]) for row, bounds in ((6, self._bottom), (2, self._yaw), (4, self._heading))
        )
        speed = _within(self._speed, u[:, 3]) * self.level
        active = u[:, 5] < self.level
        if self._searches:
            xy, found = self._keep_clear(env_ids, robot, goal_w, bottom)
            active = active & found
        else:
            bounds = self._bounds if self.config.boundary == "bounce" else None
            keep = self.config.clearance + self.radius[env_ids]
            xy = push_off(self._in_area(u[:, :2], robot), robot, keep, bounds)
        if self._any_fixed:
            active = active | self._fixed
            xy = torch.where(self._fixed[:, None], self._fixed_xy, xy)
            yaw = torch.where(self._fixed, self._fixed_yaw, yaw)
        self.active[env_ids] = active
        self.velocity_w[env_ids] = unit(heading) * (speed * active)[..., None]
        above_ground = bottom + self.half_height[env_ids]
        z = torch.where(active, above_ground, PARKED_HEIGHT)
        self.pos_w[env_ids] = torch.cat((xy, z[..., None]), -1)
        zero = torch.zeros_like(yaw)
        self.quat_w[env_ids] = torch.stack(((yaw / 2).cos(), zero, zero, (yaw / 2).sin()), -1)
        if self.any_approaches:
            command = torch.zeros_like(robot) if command_w is None else command_w.to(self._dtype)
            self._start_approach(env_ids, self.approaches & active, robot, command)
        if self._ground is not None:
            self._above_ground[env_ids] = above_ground
            self.pos_w[env_ids, :, 2] = self._over_ground(self.pos_w[env_ids, :, :2], env_ids)

    def advance(self, dt: float, robot_xy_w: torch.Tensor) -> None:
        """Moves every obstacle level by `dt` (s); `robot_xy_w` (num_envs, 2) is the centre of a wrapping area."""
        xy = self.pos_w[..., :2]
        if self._any_moves:
            xy += self.velocity_w * dt
        if self.config.boundary == "wrap":
            wrap(xy, robot_xy_w.to(self._dtype), self._bounds, self._bound)
        elif self._any_moves:
            bounce(xy, self.velocity_w, self._bounds, self._bound)

    def travel(self, dt: float, num_steps: int, robot_xy_w: torch.Tensor) -> torch.Tensor:
        """Moves every obstacle by `num_steps` steps of `dt` (s); see `advance`.

        Returns:
            (num_envs, num_steps, P, 3) m, where they are after each step, on the ground; the same memory in every call.
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
        kept = ("velocity_w", "active", "size", "_above_ground")
        return {"level": self.level, **{name: getattr(self, name).clone() for name in kept}}

    def load_state_dict(self, state: dict) -> None:
        for name, value in state.items():
            if name == "level":
                self.level = value
            else:
                getattr(self, name).copy_(value)
        self._follow_sizes()

    def _follow_sizes(self, env_ids: torch.Tensor | None = None) -> None:
        """Brings what depends on the sizes up to date, in all environments or in some (n,)."""
        size = self.size if env_ids is None else self.size[env_ids]
        derived = self._shapes.outline(size), self._shapes.radius(size), self._shapes.half_height(size)
        if env_ids is None:
            self.outline, self.radius, self.half_height = derived
            return
        for own, new in zip((self.outline, self.radius, self.half_height), derived, strict=True):
            own[env_ids] = new

    # ---- placing -----------------------------------------------------------------------------------------------------

    def _in_area(self, u: torch.Tensor, robot: torch.Tensor) -> torch.Tensor:
        """Places (n, O, 2) in the areas from (n, 2, O) draws."""
        anchor = robot[:, None] if self.config.boundary == "wrap" else 0.0
        low, high = self._bounds
        return low + u.transpose(1, 2) * (high - low) + anchor

    def _keep_clear(
        self, env_ids: torch.Tensor, robot: torch.Tensor, goal: torch.Tensor | None, bottom: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Places (n, O, 2) with the spacing and off the free path, and (n, O) whether found.

        Every environment draws equally many random numbers, whatever fits.
        """
        config, radius = self.config, self.radius[env_ids]
        u = self._random.uniform(env_ids, (_CANDIDATES * 2, radius.shape[1])).to(self._dtype)
        places = torch.stack([self._in_area(pair, robot) for pair in u.split(2, 1)], 2)  # (n, O, C, 2)
        in_the_way = self._in_the_way & (bottom < config.headroom)
        fits = (places - robot[:, None, None]).norm(dim=-1) - radius[..., None] >= config.clearance
        if config.free_path is not None:
            assert goal is not None
            bends = config.free_path.bend * (2 * self._random.uniform(env_ids, (2,)).to(self._dtype) - 1)
            off_path = distance_to_path(places, bent_path(robot, goal.to(self._dtype), bends)) - radius[..., None]
            fits &= (off_path >= config.free_path.width / 2) | ~in_the_way[..., None]
        placed = (self.approaches | self._fixed).expand(len(robot), -1)
        return choose_apart(places, fits, radius, in_the_way, placed, config.spacing)

    def _start_approach(
        self, env_ids: torch.Tensor, which: torch.Tensor, robot: torch.Tensor, command: torch.Tensor
    ) -> None:
        """Puts obstacles `which` (n, O) around the robots (n, 2) on courses that lead past them."""
        u = self._random.uniform(env_ids, (3, self.pos_w.shape[1])).to(self._dtype)
        bearing = unit(2 * math.pi * u[:, 0])
        distance = _within(self._start, u[:, 1])
        miss = (2 * u[:, 2] - 1) * self._within
        before = self.velocity_w[env_ids]
        speed = before.norm(dim=-1)  # which an obstacle keeps through the episode
        velocity = passing_velocity(bearing, distance, miss, speed, command[:, None])
        xy = robot[:, None] + bearing * distance[..., None]
        self.pos_w[env_ids, :, :2] = torch.where(which[..., None], xy, self.pos_w[env_ids, :, :2])
        self.velocity_w[env_ids] = torch.where(which[..., None], velocity, before)

    def _over_ground(self, xy: torch.Tensor, env_ids: torch.Tensor) -> torch.Tensor:
        """Heights (n, P) of the centres where they are at (n, P, 2)."""
        assert self._ground is not None
        above = self._above_ground[env_ids] + self._ground.height(xy, env_ids)
        return torch.where(self.active[env_ids], above, PARKED_HEIGHT)


def _within(bounds: torch.Tensor, u: torch.Tensor) -> torch.Tensor:
    """Maps draws (n, num) from [0, 1) to ranges (num, 2)."""
    return bounds[:, 0] + u * (bounds[:, 1] - bounds[:, 0])
