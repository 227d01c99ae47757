"""Policies to compare with: one that has never had a frame, and controllers without learning that steer a gait."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from tensordict import TensorDict

from omniperception.avoidance.sector_tracks import SectorTracks, TracksConfig
from omniperception.avoidance.true_sectors import TrueSectors
from omniperception.avoidance.velocity import COMMAND, AvoidanceConfig, avoidance_velocity
from omniperception.config import read
from omniperception.env.config import EnvConfig
from omniperception.env.env import OmniEnv, Policy
from omniperception.env.mdp.commands import VelocityCommandConfig
from omniperception.env.odometry import Odometry
from omniperception.env.sensing import SensorConfig
from omniperception.env.state import MEASURED_CLOUD
from omniperception.evaluation.trials.policies import BASELINES
from omniperception.perception import Attitude
from omniperception.perception.geometry import NUM_SECTORS, GeometryConfig, Nearest, Standing, nearest_obstacles
from omniperception.scene import RobotConfig
from omniperception.scene.build import FOOT_FORCE

Limits = tuple[tuple[float, float], tuple[float, float]]
"""Ranges of v_x and v_y (m/s)."""

Steering = Callable[[], torch.Tensor]
"""Velocity (num_envs, 2) (m/s, yaw-aligned frame), or (num_envs, 3) with the yaw rate (rad/s), that a gait is commanded
now."""


_NO_LIDAR = "this policy needs a LiDAR, but the run has none; use lidar=mid360"


def prepared(name: str, config: EnvConfig, lidar: SensorConfig | None) -> EnvConfig:
    """The task in which a policy can be tried, without what nobody reads: rewards, and frames for a blind network.

    A policy that reads clouds has the LiDAR of the run.

    Args:
        name: of any policy.
        config: the task, of the run or of the walker.
        lidar: the run's.

    Raises:
        ValueError: there is none, and the policy reads clouds.
    """
    config = replace(config, rewards=replace(config.rewards, terms={}), network_sees_frames=name not in BASELINES)
    if isinstance(config.commands, VelocityCommandConfig):
        config = replace(config, extra_requirements=(FOOT_FORCE,))  # for the figures of a gait
    if name in ("stop", "histogram"):
        if lidar is None:
            raise ValueError(_NO_LIDAR)
        config = replace(config, lidar=lidar, extra_requirements=(*config.extra_requirements, MEASURED_CLOUD))
    return config


def commanded_ranges(run_dir: Path) -> Limits | None:
    """Ranges (m/s) of the commands that the gait of a run has learned to follow; None where it was given goals."""
    commands = read(run_dir).commands
    return (tuple(commands.lin_vel_x), tuple(commands.lin_vel_y)) if "lin_vel_x" in commands else None


def baseline(name: str, env: OmniEnv, policy: Policy, avoidance: AvoidanceConfig, limits: Limits | None) -> Policy:
    """One of BASELINES.

    Args:
        name: which.
        env: where it walks, of a task that was `prepared`.
        policy: the run's, or the gait.
        avoidance: the run's avoidance controller.
        limits: ranges of the commands that the gait has learned to follow; None for no limits.

    Raises:
        ValueError: it cannot be had of this policy or in this environment.
    """
    if name == "blind":
        return blind(env, policy)
    steering: Steering
    if name == "stop":
        steering = _Stop(env, StopConfig.of(env.robot))
    elif name == "ground_truth":
        steering = _navigated(env, policy)
    elif name == "histogram":
        steering = _avoiding(env, avoidance, _Histogram(env))
    else:
        sectors = TrueSectors(avoidance.num_sectors, env.world.obstacles, env.obstacles, env.num_envs, env.device)
        steering = _avoiding(
            env, avoidance, lambda: sectors.measure(env.state.kinematics.base_pos_w, env.state.kinematics.yaw)
        )
    return _driven(env, policy, steering, limits)


def blind(env: OmniEnv, policy: Policy) -> Policy:
    """The policy as it acts before its first frame: in an environment that never shows it one."""
    if env.sensing is None or env.sensing.history is None:
        raise ValueError("this policy does not look at the LiDAR, it is blind already; leave policy=blind out")
    _check_hidden(env)
    return policy


def _navigated(env: OmniEnv, policy: Policy) -> Steering:
    """What a policy's own navigation asks for of the true obstacles, seen or not."""
    navigation = getattr(policy, "navigation", None)
    if navigation is None:
        raise ValueError("this policy has no navigation to give ground truth to; leave policy=ground_truth out")

    def wanted() -> torch.Tensor:
        state = env.state
        return navigation(state.sectors, state.reference, state.measured.planar_velocity, state.last_asked)

    return wanted


def geometry_of(robot: RobotConfig) -> GeometryConfig:
    """From the clouds of a robot to what stands around it."""
    return GeometryConfig(body=robot.outline, standing=robot.base_height, headroom=robot.height)


@dataclass(frozen=True)
class StopConfig:
    """Settings of `stop`.

    Attributes:
        stand, slow: the commanded speed is kept beyond `slow` (m) from the base's origin and falls linearly to zero at
            `stand` (m).
        half_width: (m) of the strip ahead of the base in which obstacles count.
    """

    stand: float = 0.7
    slow: float = 1.4
    half_width: float = 0.35

    @classmethod
    def of(cls, robot: RobotConfig) -> StopConfig:
        """As for a Go2, as far from the robot's front and sides."""
        _, front, side = robot.outline
        return cls(front + 0.34, front + 1.04, side + 0.03)


class _Clouds:
    """Newest clouds of an environment's LiDAR, each handed on once.

    Attributes:
        period_s: from frame to frame.
    """

    def __init__(self, env: OmniEnv) -> None:
        if env.sensing is None:
            raise ValueError(_NO_LIDAR)
        if env.sensing.carrier != env.sensing.base:
            raise ValueError(
                f"this policy needs the LiDAR on the base, but lidar.mount has it on {env.sensing.config.mount_body}"
            )
        self._env, self._sensing, self._tick = env, env.sensing, -1
        self._standing = Standing(geometry_of(env.robot))
        self.period_s = env.sensing.period_steps * env.control_dt

    @property
    def begun(self) -> torch.Tensor:
        """(num_envs,) bool: whose episode has just begun; their newest cloud shows the one before."""
        return (self._env.episode_length_buf == 0) & (self._env.step_count > 0)

    def new(self) -> tuple[Nearest, torch.Tensor] | None:
        """Nearest obstacle by sector in the clouds that have come since the last call, and (num_envs,) bool which of
        them came with the newest tick and show this episode; None where none has."""
        if self._sensing.tick == self._tick:
            return None
        self._tick, frame, sensor = self._sensing.tick, self._sensing.frame, self._sensing.config
        assert frame is not None and frame.ranges is not None and frame.directions_s is not None  # it has been cast
        attitude = Attitude(self._env.state.measured.base_quat_w, sensor.mount_pos, sensor.quat)
        nearest = nearest_obstacles(frame.ranges, frame.directions_s, attitude, self._standing)
        return nearest, self._sensing.fresh & ~self.begun


class _Histogram:
    """Distance and velocity of the nearest obstacle by sector, (num_envs, S, 3), at each control step."""

    def __init__(self, env: OmniEnv) -> None:
        self._env, self._clouds, self._step = env, _Clouds(env), -1
        self._odometry = Odometry(env.num_envs, env.control_dt, env.device)
        self._odometry.start(torch.arange(env.num_envs, device=env.device), env.state.measured)
        self._tracks = SectorTracks(TracksConfig(), env.num_envs, NUM_SECTORS, self._clouds.period_s, env.device)

    def __call__(self) -> torch.Tensor:
        """As of now; takes in the control step that has just been done, once."""
        if self._env.step_count != self._step:
            self._step = self._env.step_count
            self._follow()
        return self._tracks.motion()

    def _follow(self) -> None:
        clouds, measured, begun = self._clouds, self._env.state.measured, self._clouds.begun
        self._odometry.advance(measured)
        self._odometry.start(begun.nonzero().flatten(), measured)
        self._tracks.reset(begun)
        self._tracks.advance(self._odometry.take(torch.ones_like(begun))[:, 0], self._env.control_dt)
        if (new := clouds.new()) is not None:
            nearest, fresh = new
            self._tracks.update(nearest.distance, nearest.place, fresh)


class _Stop:
    """The commanded velocity, slower while something stands in its way."""

    def __init__(self, env: OmniEnv, config: StopConfig) -> None:
        self._env, self._config, self._clouds = env, config, _Clouds(env)
        self._place = torch.zeros(env.num_envs, NUM_SECTORS, 2, device=env.device)
        self._distance = self._place.new_full(self._place.shape[:2], torch.inf)

    def __call__(self) -> torch.Tensor:
        """(num_envs, 2) m/s."""
        clouds, config = self._clouds, self._config
        if (new := clouds.new()) is not None:
            nearest, fresh = new
            self._place = torch.where(fresh[:, None, None], nearest.place, self._place)
            self._distance = torch.where(fresh[:, None], nearest.distance, self._distance)
        self._distance = torch.where(clouds.begun[:, None], torch.inf, self._distance)
        command = self._env.state.reference[:, :2]
        return command * free_share(self._place, self._distance, command, config)[:, None]


def free_share(place: torch.Tensor, distance: torch.Tensor, command: torch.Tensor, config: StopConfig) -> torch.Tensor:
    """(n,) share of the commanded speed that obstacles ahead leave.

    Args:
        place: (n, S, 2) m, yaw-aligned frame: nearest obstacle by sector.
        distance: (n, S) m, infinite without one.
        command: (n, 2) m/s.
        config: how near is too near.
    """
    heading = command / command.norm(dim=1, keepdim=True).clamp(min=1e-6)
    along = (place * heading[:, None]).sum(-1)
    across = place[..., 0] * heading[:, None, 1] - place[..., 1] * heading[:, None, 0]
    ahead = distance.isfinite() & (along > 0.0) & (across.abs() < config.half_width)
    gap = torch.where(ahead, along, torch.inf).amin(1)
    return ((gap - config.stand) / (config.slow - config.stand)).clamp(0.0, 1.0)


def _avoiding(env: OmniEnv, avoidance: AvoidanceConfig, motion: Steering) -> Steering:
    """V_cmd + V_avoid, from the distance and velocity of obstacles by sector (num_envs, S, 3)."""
    risk = avoidance.risk
    candidates = None if risk is None else risk.candidates(env.device)

    def velocity() -> torch.Tensor:
        command, sectors = env.state.reference[:, :2], motion()
        if risk is None or candidates is None:
            return command + avoidance_velocity(sectors[..., 0], avoidance)
        return command + risk.avoidance(risk.risk(sectors, candidates), command, candidates)

    return velocity


def _driven(env: OmniEnv, policy: Policy, steering: Steering, limits: Limits | None) -> Policy:
    """The policy with another velocity in place of V_cmd.

    A policy that sees, too, must never be shown a frame, so that it adds no avoidance of its own. One that limits how
    fast what it asks of its gait changes limits this velocity, too.

    Args:
        env: where it walks.
        policy: follows velocity commands.
        steering: the velocity, asked for once at each control step.
        limits: ranges to which it is clipped: what the policy has learned to follow; None for no limits.
    """
    if not env.observes_command:
        raise ValueError(
            f"it drives a policy by its command and needs observations with a group '{COMMAND}' that holds the"
            " command alone, without history; name another gait: walker=<run directory of experiment=walk>"
        )

    _check_hidden(env)

    def drive(observations: TensorDict) -> torch.Tensor:
        velocity = steering()
        if limits is not None:
            low, high = velocity.new_tensor(limits).unbind(1)
            velocity = torch.cat((velocity[:, :2].clamp(low, high), velocity[:, 2:]), 1)
        observations = observations.clone(recurse=False)
        observations[COMMAND] = torch.cat((velocity, env.state.reference[:, velocity.shape[1] :]), 1)
        return policy(observations)

    return drive


def _check_hidden(env: OmniEnv) -> None:
    if env.sensing is not None and env.sensing.history is not None and env.config.network_sees_frames:
        raise ValueError(
            "this task shows the network LiDAR frames; prepare it with EnvConfig.network_sees_frames=False"
        )
