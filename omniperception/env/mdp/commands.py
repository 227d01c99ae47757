"""Velocity commands: sampled, or steering to a goal."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F

from omniperception.common.checked import NonNegative, Pair, Positive, PositivePair, Share, checked
from omniperception.common.random import EnvRandom
from omniperception.common.rotations import rotate_yaw
from omniperception.common.stateful import Stateful
from omniperception.env.kinematics import Kinematics
from omniperception.env.mdp.curriculum import Curriculum, CurriculumConfig


@checked("commands.spawn")
class SpawnConfig:
    """Start pose of a robot, in its environment's frame.

    Attributes:
        x: range (m).
        y: range (m).
        yaw_deg: range (deg).
    """

    x: Pair = (0.0, 0.0)
    y: Pair = (0.0, 0.0)
    yaw_deg: Pair = (-180.0, 180.0)


@checked("commands")
class VelocityCommandConfig:
    """Velocities drawn uniformly in the base frame.

    Attributes:
        lin_vel_x: range (m/s).
        lin_vel_y: range (m/s).
        ang_vel_z: range (rad/s).
        resample_s: range of the time (s) between two draws.
        standing: share of the draws that command to stand still.
        spawn: where the robot starts.
        curriculum: of the share of the ranges that velocities are drawn from, because fast ones from the first step on
            keep a gait from emerging; None: the whole ranges.
    """

    lin_vel_x: Pair
    lin_vel_y: Pair
    ang_vel_z: Pair
    resample_s: PositivePair
    standing: Share
    spawn: SpawnConfig
    curriculum: CurriculumConfig | None = None

    def build(self, num_envs: int, device: torch.device, random: EnvRandom) -> VelocityCommand:
        return VelocityCommand(self, num_envs, device, random)


@checked("commands")
class GoalCommandConfig:
    """Walk to a goal: the command points along the way there, and turns the robot to face it.

    Attributes:
        goal_x: range (m, environment frame) from which the goal's x is drawn at every reset.
        goal_y: range (m) of its y.
        radius: the goal is reached within this distance (m, horizontal, of the base's origin); None: beyond the line
            x = goal_x, wherever. The command then aims one metre beyond it, so that it never turns around.
        speed: commanded speed (m/s), or the range from which it is drawn at every reset.
        yaw_gain: yaw rate per heading error (1/s).
        max_ang_vel_z: bound of the commanded yaw rate (rad/s).
        spawn: where the robot starts.
        slow_within: at this distance (m) from the goal and nearer, speed and yaw rate fade in proportion to the
            distance, so that a robot can stay; 0: they do not.
        hold_s: the goal counts as reached only from this time (s) of an episode on, so that a robot has to stay.
        route_ahead: the command points to the place so far (m) ahead on the route through the obstacles' world, which
            its layout has to give: as a planner with a coarse map commands, corners cut and all. None: to the goal.
    """

    goal_x: Pair
    goal_y: Pair
    radius: Positive | None
    speed: Positive | PositivePair
    yaw_gain: Positive
    max_ang_vel_z: Positive
    spawn: SpawnConfig
    slow_within: NonNegative = 0.0
    hold_s: NonNegative = 0.0
    route_ahead: Positive | None = None

    def __post_init__(self) -> None:
        for key in ("slow_within", "hold_s"):
            if getattr(self, key) > 0 and self.radius is None:
                raise ValueError(f"commands.{key}={getattr(self, key)} needs a place to stay: give commands.radius")
        if self.route_ahead is not None and self.radius is None:
            raise ValueError("commands.route_ahead leads to a place, not across a line: give commands.radius")

    @property
    def speeds(self) -> tuple[float, float]:
        """Least and most commanded speed (m/s)."""
        return (self.speed, self.speed) if isinstance(self.speed, int | float) else (self.speed[0], self.speed[1])

    def build(self, num_envs: int, device: torch.device, random: EnvRandom) -> GoalCommand:
        return GoalCommand(self, num_envs, device, random)


class Command(Stateful):
    """A source of commands.

    Attributes:
        value: (num_envs, 3): v_x, v_y (m/s) and yaw rate (rad/s) in the base frame.
        goal_w: (num_envs, 2) the goal (m, environment frame), or None for commands without one.
    """

    value: torch.Tensor
    goal_w: torch.Tensor | None = None

    def reset(self, env_ids: torch.Tensor, kinematics: Kinematics) -> None:
        """Draws new commands for some environments (n,); `kinematics` of all."""
        raise NotImplementedError

    def advance(self, dt: float, kinematics: Kinematics) -> None:
        """A control step of `dt` (s)."""
        raise NotImplementedError

    def reached(self, kinematics: Kinematics, time_s: torch.Tensor | float) -> torch.Tensor | None:
        """(num_envs,) bool whether the goal is reached, time_s (num_envs,) into the episodes; None without one."""
        return None


_ROUNDING_S = 1e-3  # of times that are sums or products of control steps
SETTLE_S = 0.5
"""Time (s) after a new command from which on a robot is held to it."""


class VelocityCommand(Command):
    """Draws a new velocity at every reset and after every `resample_s`.

    Attributes:
        curriculum: of the share of the ranges that velocities are drawn from.
        time_left: (num_envs,) s until the next draw.
        age: (num_envs,) s since the last one.
    """

    saved, buffers = ("curriculum",), ("value", "time_left", "age")

    def __init__(self, config: VelocityCommandConfig, num_envs: int, device: torch.device, random: EnvRandom) -> None:
        self.config = config
        self.value = torch.zeros(num_envs, 3, device=device)
        self.curriculum = Curriculum(config.curriculum)
        self.time_left, self.age = torch.zeros(2, num_envs, device=device).unbind(0)
        self._random = random
        ranges = (config.lin_vel_x, config.lin_vel_y, config.ang_vel_z)
        self._low = torch.tensor([r[0] for r in ranges], device=device)
        self._high = torch.tensor([r[1] for r in ranges], device=device)

    def reset(self, env_ids: torch.Tensor, kinematics: Kinematics) -> None:
        self._draw(env_ids)

    def advance(self, dt: float, kinematics: Kinematics) -> None:
        self.time_left -= dt
        self.age += dt
        expired = (self.time_left <= 0).nonzero().flatten()
        if len(expired):
            self._draw(expired)

    @property
    def settled(self) -> torch.Tensor:
        """(num_envs,) bool: whose command was SETTLE_S old, or older, when the control step began."""
        return self.age > SETTLE_S - 1e-3  # sums of time steps are not exact

    def _draw(self, env_ids: torch.Tensor) -> None:
        u = self._random.uniform(env_ids, (5,))
        velocity = self.curriculum.level * (self._low + u[:, :3] * (self._high - self._low))
        self.value[env_ids] = velocity * (u[:, 3:4] >= self.config.standing)
        shortest, longest = self.config.resample_s
        self.time_left[env_ids] = shortest + u[:, 4] * (longest - shortest)
        self.age.index_fill_(0, env_ids, 0.0)


ROUTE_WINDOW = 1.0
"""How far (m) on along a route the point nearest to the robot is looked for, so that it skips no bend behind a wall."""


class GoalCommand(Command):
    """Points to the goal from wherever the robot is, or to a place ahead on a route there.

    Attributes:
        route_w: (num_envs, R, 2) m, points of the routes; None: straight to the goal.
        along: (num_envs, R) m, the way along the routes to their points.
        progress: (num_envs,) m, the way along the routes to the points nearest to the robots; never falls.
        speed: (num_envs, 1) m/s, what is commanded on the way.
    """

    goal_w: torch.Tensor
    saved, buffers = ("route_w", "along", "progress", "speed"), ("value", "goal_w")

    def __init__(self, config: GoalCommandConfig, num_envs: int, device: torch.device, random: EnvRandom) -> None:
        self.config = config
        self.value = torch.zeros(num_envs, 3, device=device)
        self.goal_w = torch.zeros(num_envs, 2, device=device)
        self.route_w: torch.Tensor | None = None
        self.along = torch.zeros(num_envs, 1, device=device)
        self.progress = torch.zeros(num_envs, device=device)
        self.speed = torch.full((num_envs, 1), config.speeds[0], device=device)
        self._random = random
        ranges = (config.goal_x, config.goal_y)
        self._low = torch.tensor([r[0] for r in ranges], device=device)
        self._high = torch.tensor([r[1] for r in ranges], device=device)

    def reset(self, env_ids: torch.Tensor, kinematics: Kinematics) -> None:
        self.goal_w[env_ids] = self._low + self._random.uniform(env_ids, (2,)) * (self._high - self._low)
        if self._draws_speed:
            low, high = self.config.speeds
            self.speed[env_ids] = low + self._random.uniform(env_ids, (1,)) * (high - low)
        self._steer(kinematics)

    def follow(self, env_ids: torch.Tensor, route: torch.Tensor, kinematics: Kinematics) -> None:
        """Leads some environments (n,) along routes (n, R, 2) in m, from their starts to their goals; after `reset`."""
        if self.route_w is None or self.route_w.shape[1] != route.shape[1]:
            self.route_w = self.goal_w.new_zeros(len(self.goal_w), *route.shape[1:])
            self.along = self.goal_w.new_zeros(self.route_w.shape[:2])
        self.route_w[env_ids] = route.to(self.route_w.dtype)
        self.along[env_ids] = _along(self.route_w[env_ids])
        self.progress = self.progress.index_fill(0, env_ids, 0.0)
        self._steer(kinematics)

    def way(self, kinematics: Kinematics) -> torch.Tensor:
        """(num_envs,) m, from the robot to the goal: straight, or over all points of the route."""
        if self.route_w is None:
            return self._distance(kinematics, self.goal_w)
        return self.along[:, -1] + self._distance(kinematics, self.route_w[:, 0])

    def advance(self, dt: float, kinematics: Kinematics) -> None:
        if self.route_w is not None:
            distance = (self.route_w - kinematics.base_pos_w[:, None, :2]).norm(dim=-1)
            on = self.along - self.progress[:, None]
            nearest = distance.masked_fill((on < 0) | (on > ROUTE_WINDOW), math.inf).argmin(1)
            self.progress = self.along.gather(1, nearest[:, None])[:, 0]
        self._steer(kinematics)

    @property
    def _draws_speed(self) -> bool:
        low, high = self.config.speeds
        return low < high

    def _target(self) -> torch.Tensor:
        """(num_envs, 2) m, where the commands point to."""
        if self.route_w is None or self.config.route_ahead is None:
            return self.goal_w
        last = self.route_w.shape[1] - 1
        point = (self.along < (self.progress + self.config.route_ahead)[:, None]).sum(1).clamp(max=last)
        return self.route_w.gather(1, point[:, None, None].expand(-1, 1, 2))[:, 0]

    def _steer(self, kinematics: Kinematics) -> None:
        config = self.config
        ahead, aside = (self._target() - kinematics.base_pos_w[:, :2]).unbind(1)
        if config.radius is None:
            ahead = (ahead + 1.0).clamp(min=0.5)
        bearing = torch.atan2(aside, ahead)
        to_goal = torch.stack((bearing.cos(), bearing.sin()), -1)
        self.value[:, :2] = rotate_yaw(-kinematics.yaw, to_goal) * self.speed
        error = torch.remainder(bearing - kinematics.yaw + math.pi, 2 * math.pi) - math.pi
        self.value[:, 2] = (config.yaw_gain * error).clamp(-config.max_ang_vel_z, config.max_ang_vel_z)
        if config.slow_within > 0:
            self.value *= (self._distance(kinematics, self.goal_w) / config.slow_within).clamp(max=1.0)[:, None]

    def reached(self, kinematics: Kinematics, time_s: torch.Tensor | float) -> torch.Tensor:
        if self.config.radius is None:
            return kinematics.base_pos_w[:, 0] >= self.goal_w[:, 0]
        near = self._distance(kinematics, self.goal_w) <= self.config.radius
        return near & (time_s >= self.config.hold_s - _ROUNDING_S) if self.config.hold_s > 0 else near

    def _distance(self, kinematics: Kinematics, point_w: torch.Tensor) -> torch.Tensor:
        """(num_envs,) m, horizontal, from the bases to points (num_envs, 2)."""
        return (point_w - kinematics.base_pos_w[:, :2]).norm(dim=1)


def _along(route: torch.Tensor) -> torch.Tensor:
    """(n, R) m, the way along routes (n, R, 2) from their starts to their points."""
    return F.pad(route.diff(dim=1).norm(dim=-1).cumsum(1), (1, 0))
