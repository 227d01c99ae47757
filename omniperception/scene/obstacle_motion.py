"""How obstacles move: courses past the robot, changes of mind, and what happens at the edge of an area."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch

from omniperception.common.random import EnvRandom
from omniperception.common.stateful import Stateful
from omniperception.scene.obstacle_group import MotionConfig, ObstacleGroup
from omniperception.scene.placement import unit, within

LOSE_SIGHT = 1.0
"""Distance (m) beyond its farthest start at which an approaching obstacle starts again."""


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


def bounce(
    xy: torch.Tensor, velocity: torch.Tensor, bounds: tuple[torch.Tensor, torch.Tensor], bound: torch.Tensor
) -> None:
    """Turns obstacles back at the edge of their areas, in place.

    Args:
        xy, velocity: (n, O, 2) m and m/s.
        bounds: low and high (O, 2) or (n, O, 2) m.
        bound: (O,) bool, whom an area holds.
    """
    low, high = bounds
    below, above = (xy < low) & bound[:, None], (xy > high) & bound[:, None]
    inward = torch.where(below, velocity.abs(), torch.where(above, -velocity.abs(), velocity))
    velocity.copy_(inward)
    xy.copy_(torch.where(below, 2 * low - xy, torch.where(above, 2 * high - xy, xy)))


def wrap(
    xy: torch.Tensor, centre: torch.Tensor, bounds: tuple[torch.Tensor, torch.Tensor], bound: torch.Tensor
) -> None:
    """Lets obstacles that leave their areas around `centre` (n, 2) m in at the opposite edge, in place.

    The other arguments are those of `bounce`.
    """
    low = bounds[0] + centre[:, None]
    wrapped = low + torch.remainder(xy - low, bounds[1] - bounds[0])
    xy.copy_(torch.where(bound[:, None], wrapped, xy))


class Approach:
    """Obstacles of groups with `approach`, which come at the robot again and again.

    Attributes:
        which: (O,) bool.
        any: whether there are some.
    """

    def __init__(self, groups: Sequence[ObstacleGroup], random: EnvRandom, like: torch.Tensor) -> None:
        """`groups` of the O obstacles; `like` has the precision and the device of their positions."""
        given = [group.approach for group in groups]
        self._random, self.any = random, any(given)
        self.which = torch.tensor([own is not None for own in given], dtype=torch.bool, device=like.device)
        self._within = like.new_tensor([own.within if own else 0.0 for own in given])
        self._start = like.new_tensor([own.distance if own else (0.0, 0.0) for own in given])

    def have_passed(self, xy: torch.Tensor, robot: torch.Tensor) -> torch.Tensor:
        """(n, O) bool: which of them at (n, O, 2) have left robots (n, 2) behind."""
        return self.which & ((xy - robot[:, None]).norm(dim=-1) > self._start[:, 1] + LOSE_SIGHT)

    def start(
        self, env_ids: torch.Tensor, robot: torch.Tensor, command: torch.Tensor, pace: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Places (n, O, 2) around the robots and velocities (n, O, 2) that lead past them.

        Args:
            env_ids: (n,) which environments.
            robot: (n, 2) m.
            command: (n, 2) m/s, the velocity that it is commanded.
            pace: (n, O) m/s, of the obstacles.
        """
        u = self._random.uniform(env_ids, (3, pace.shape[1])).to(pace.dtype)
        bearing = unit(2 * math.pi * u[:, 0])
        distance = within(self._start, u[:, 1])
        miss = (2 * u[:, 2] - 1) * self._within
        velocity = passing_velocity(bearing, distance, miss, pace, command[:, None])
        return robot[:, None] + bearing * distance[..., None], velocity


class Wander(Stateful):
    """Obstacles of groups with `motion`, which choose again where they go after random times.

    Attributes:
        timer: (num_envs, O) s until an obstacle chooses again.
        course: (num_envs, O) rad, of the way in which it moved last.
    """

    buffers = ("timer", "course")

    def __init__(self, groups: Sequence[ObstacleGroup], num_envs: int, random: EnvRandom, like: torch.Tensor) -> None:
        """`groups` of the O obstacles; `like` has the precision and the device of their positions."""
        never = MotionConfig((1.0, 1.0))
        motions = [group.motion or never for group in groups]
        self._random, self._which = random, torch.tensor([g.motion is not None for g in groups], device=like.device)
        self._every = like.new_tensor([motion.every_s for motion in motions])
        self._turn = torch.deg2rad(like.new_tensor([motion.turn_deg for motion in motions]))
        self._stop = like.new_tensor([motion.stop for motion in motions])
        self._home = like.new_tensor([motion.home for motion in motions])
        self.timer, self.course = like.new_zeros(2, num_envs, len(groups)).unbind(0)

    def reset(self, env_ids: torch.Tensor, course: torch.Tensor) -> None:
        """Begins an episode in environments (n,), in which obstacles set out on courses (n, O) in rad."""
        u = self._random.uniform(env_ids, (self._every.shape[0],)).to(course.dtype)
        self.timer[env_ids], self.course[env_ids] = within(self._every, u), course

    def choose(
        self, dt: float, xy: torch.Tensor, velocity: torch.Tensor, pace: torch.Tensor, robot: torch.Tensor
    ) -> None:
        """Lets `dt` (s) pass; whose time has come gets another velocity, in place.

        Args:
            dt: s.
            xy, velocity: (num_envs, O, 2) m and m/s.
            pace: (num_envs, O) m/s, at which they move when they do not stand; 0 for those that are not there.
            robot: (num_envs, 2) m.
        """
        self.timer -= dt
        due = (self.timer <= 0) & self._which & (pace > 0)
        env_ids = due.any(1).nonzero().flatten()
        if not len(env_ids):
            return
        due, now, speed = due[env_ids], velocity[env_ids], pace[env_ids]
        u = self._random.uniform(env_ids, (3, due.shape[1])).to(now.dtype)
        moving = now.square().sum(-1) > 0
        course = torch.where(moving, torch.atan2(now[..., 1], now[..., 0]), self.course[env_ids])
        to_robot = robot[env_ids, None] - xy[env_ids]
        homing = (u[:, 1] >= self._stop) & (u[:, 1] < self._stop + self._home)
        turned = course + (2 * u[:, 2] - 1) * self._turn
        chosen = torch.where(homing, torch.atan2(to_robot[..., 1], to_robot[..., 0]), turned)
        stands = u[:, 1] < self._stop
        course = torch.where(stands, course, chosen)
        new = unit(course) * (speed * ~stands)[..., None]
        velocity[env_ids] = torch.where(due[..., None], new, now)
        self.course[env_ids] = torch.where(due, course, self.course[env_ids])
        self.timer[env_ids] = torch.where(due, within(self._every, u[:, 0]), self.timer[env_ids])
