"""Configuration of the task, validated."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from omnilidar import DEVICES, Noise
from omnilidar.noise import NAMES as NOISE_NAMES
from omniperception.avoidance.velocity import AVOIDANCE_TARGET, COMMAND, MOTION_TARGET, SECTOR_TARGET
from omniperception.common.random import MOST_SEEDS
from omniperception.env.mdp.commands import GoalCommandConfig, VelocityCommandConfig
from omniperception.env.mdp.randomization import DRAWN, RandomizationConfig
from omniperception.env.mdp.terminations import TerminationsConfig
from omniperception.env.mdp.terms import ObservationsConfig, RewardsConfig
from omniperception.env.state import AVOIDANCE, CLOUD, DISTAL_RANGE, LEGS, MEASURED_CLOUD, requirements
from omniperception.scene import (
    MapTerrainConfig,
    ObstaclesConfig,
    RobotConfig,
    SteppingConfig,
    TerrainConfig,
    TiledTerrainConfig,
)
from omniperception.scene.build import FOOT_FORCE, LINK_FORCE, OBSTACLE_CONTACT, OBSTACLE_FORCE
from omniperception.sim import SimConfig
from omniperception.sim.planar import PlanarConfig

if TYPE_CHECKING:  # loaded where it is built
    from omniperception.env.sensing import SensorConfig

HEIGHT_TARGET = "height_target"
"""Observation group with the height grid that a network can be supervised with."""

OF_LEGS = frozenset({LEGS, FOOT_FORCE, LINK_FORCE})
"""Requirements that only a simulator with legs fulfils."""
FROM_LIDAR = frozenset({AVOIDANCE, DISTAL_RANGE, CLOUD, MEASURED_CLOUD})
"""Requirements that only a LiDAR fulfils."""

_MOST_STEPS = 0.25
"""Steps of a foot in a control step: with more, a clock has fewer than two control steps for foot up and foot down."""


@dataclass(frozen=True)
class EnvConfig:
    """Configuration of the task.

    Attributes:
        num_envs: parallel environments.
        seed: seed of every random stream of the task.
        robot, terrain, obstacles, commands, observations, rewards, terminations, randomization, sim: the presets.
        lidar: the sensor, or None.
        sampler: makes the point sampler, or None when no network looks at the cloud.
        frame_history: LiDAR frames kept for the network.
        stepping: the motion to which actions are added; None: they are added to the default pose.
        base_motion: whether a frame's last row is the base's motion since the frame before.
        frame_times: whether frames bear the time at which they were taken.
        targets: privileged groups that the network is supervised with: HEIGHT_TARGET and those of `avoidance`.
        network_sees_frames: whether the network is shown frames; where not it never has one, and none is sampled.
        extra_requirements: requirements of who acts in the task, beside those of its terms; see `state.requires`.
        num_asked: components of the velocity that a policy asks its gait for: 2, or 3 where it turns, too.
        log_interval: control steps between two reports of the metrics.
        skip_curricula: whether everything that curricula of obstacles, commands and randomization let in is there from
            the first step on, and stays, as in evaluations; the terrain's has `trials`.
        trials: whether episodes are trials of an evaluation: the k-th to begin is the same scene whatever the number of
            environments, on a tile that it draws; see `TrialRandom`.
    """

    num_envs: int
    seed: int
    robot: RobotConfig
    terrain: TerrainConfig | TiledTerrainConfig | MapTerrainConfig
    obstacles: ObstaclesConfig
    commands: VelocityCommandConfig | GoalCommandConfig
    observations: ObservationsConfig
    rewards: RewardsConfig
    terminations: TerminationsConfig
    randomization: RandomizationConfig
    sim: SimConfig | PlanarConfig
    lidar: SensorConfig | None = None
    sampler: Callable | None = None
    frame_history: int = 0
    stepping: SteppingConfig | None = None
    base_motion: bool = False
    frame_times: bool = False
    targets: Sequence[str] = ()
    network_sees_frames: bool = True
    extra_requirements: Sequence[str] = ()
    num_asked: int = 2
    log_interval: int = 24
    skip_curricula: bool = False
    trials: bool = False

    def __post_init__(self) -> None:
        if self.num_envs < 1:
            raise ValueError(f"num_envs={self.num_envs} must be at least 1")
        if not 0 <= self.seed < MOST_SEEDS:
            raise ValueError(f"seed={self.seed} must lie in 0 to {MOST_SEEDS - 1}")
        if round(self.terminations.episode_length_s / self.sim.control_dt) < 1:
            raise ValueError(
                f"terminations.episode_length_s={self.terminations.episode_length_s:g} is less than a control step of"
                f" {self.sim.control_dt:g} s"
            )
        gait, period = self.robot.gait, self.sim.control_dt
        if gait is not None and gait.frequency * period > _MOST_STEPS:
            raise ValueError(
                f"robot.gait.frequency={gait.frequency:g} is too fast for control steps of {period:g} s; at most"
                f" {_MOST_STEPS / period:g} Hz"
            )
        if not self.sim.has_legs:
            self._check_without_legs()
        if self.log_interval < 1:
            raise ValueError(f"log_interval={self.log_interval} must be at least 1")
        if self.obstacles.free_path is not None and isinstance(self.commands, VelocityCommandConfig):
            raise ValueError("obstacles.free_path leads to a goal, and these commands have none; use commands=goal")
        if isinstance(self.commands, GoalCommandConfig) and self.commands.route_ahead is not None:
            self._check_route(self.commands)
        if MOTION_TARGET in self.targets and self.rewards.avoidance.risk is None:
            raise ValueError(
                "perception.motion_weight needs rewards.avoidance.risk; use rewards=velocity_risk or"
                " perception.motion_weight=0"
            )
        if self.randomization.lidar_device and self.lidar is not None and self.lidar.device is None:
            raise ValueError(
                "randomization.lidar_device needs a sensor whose maker states its noise, but lidar.device is null; name"
                " the device, or use randomization=lidar"
            )
        command = self.observations.groups.get(COMMAND)
        if {AVOIDANCE_TARGET, MOTION_TARGET} & set(self.targets) and command is not None and command.history != 1:
            raise ValueError(
                f"observations.groups.command.history={command.history}: an avoidance velocity is added to the command"
                " of the present; use 1, or perception.avoidance_weight=0 and motion_weight=0"
            )
        self._check_measured_noise()
        self._check_one_noise_of_a_kind()
        if self.base_motion and self.lidar is not None and self.lidar.mount_body is not None:
            raise ValueError(
                "perception.base_motion=true says how the base moves, but the LiDAR is carried by"
                f" {self.lidar.mount_body}, which turns against it; use a lidar.mount on the base, or"
                " perception.base_motion=false with another network than polar_rings"
            )
        if isinstance(self.terrain, MapTerrainConfig):
            spawn = self.commands.spawn
            self.terrain.check_footing(self.robot.footing, max(map(abs, (*spawn.x, *spawn.y))))
        if self.lidar is None:
            if self.sampler is not None:
                raise ValueError(
                    "lidar=none gives the perception network nothing to see; use lidar=mid360 or perception=none"
                )
            unmet = sorted(self.requirements() & FROM_LIDAR)
            if unmet:
                raise ValueError(
                    f"rewards or observations require {', '.join(unmet)} from the LiDAR, but lidar=none;"
                    " use lidar=mid360 or rewards=walk observations=walk"
                )

    def _check_without_legs(self) -> None:
        """Nothing is asked of joints, feet or torques where there are none."""
        terms = {f"rewards.terms.{name}": term.func for name, term in self.rewards.terms.items()}
        for group, own in self.observations.groups.items():
            terms |= {f"observations.groups.{group}.terms.{name}": term for name, term in own.terms.items()}
        reading = [name for name, term in terms.items() if requirements(term) & OF_LEGS]
        if reading:
            raise ValueError(
                f"{', '.join(reading)} read joints, feet or torques, and sim=planar has none; use rewards=navigate"
                " observations=navigate, or sim=mujoco"
            )
        if self.stepping is not None:
            raise ValueError("stepping moves joints, and sim=planar has none; use stepping=null, or sim=mujoco")

    @property
    def num_actions(self) -> int:
        """Joints, or without legs v_x, v_y and yaw rate."""
        return self.robot.num_joints if self.sim.has_legs else 3

    @property
    def drawn_physics(self) -> RandomizationConfig:
        """The randomization, without the rows that a robot without legs has in its measured response."""
        if self.sim.has_legs:
            return self.randomization
        none: dict[str, Any] = dict.fromkeys(name for name in DRAWN if name != "latency_s")
        return replace(self.randomization, **none)

    def _check_route(self, commands: GoalCommandConfig) -> None:
        end = self.obstacles.route_end
        if end is None:
            raise ValueError(
                "commands.route_ahead leads through a maze, and these obstacles have none; use scenario=maze"
            )
        goal, there = (*commands.goal_x, *commands.goal_y), (end[0], end[0], end[1], end[1])
        if not all(math.isclose(own, meant, abs_tol=1e-6) for own, meant in zip(goal, there, strict=True)):
            raise ValueError(
                f"commands.goal_x={list(commands.goal_x)} and goal_y={list(commands.goal_y)} are not where"
                f" commands.route_ahead leads; the maze's goal is [{end[0]:g}, {end[0]:g}] and [{end[1]:g}, {end[1]:g}]"
            )

    def _check_measured_noise(self) -> None:
        if not self.randomization.lidar_measured or self.lidar is None:
            return
        if self.randomization.lidar_device:
            raise ValueError(
                "randomization.lidar_device and lidar_measured are both true, two models of the same errors; set one of"
                " them to false"
            )
        if self.lidar.device is None or not DEVICES[self.lidar.device].measured:
            known = ", ".join(name for name, spec in DEVICES.items() if spec.measured)
            raise ValueError(
                f"randomization.lidar_measured needs a sensor of which there is a recording ({known}), but lidar.device"
                f" is {self.lidar.device or 'null'}; use randomization=device"
            )

    def _check_one_noise_of_a_kind(self) -> None:
        source = "lidar_measured" if self.randomization.lidar_measured else "lidar_device"
        of_device = {type(model) for model in self._device_noise}
        for model in self.randomization.noise:
            if type(model) in of_device:
                row = f"lidar_{NOISE_NAMES[type(model)]}"
                raise ValueError(
                    f"randomization.{source} and {row} are two models of one kind ({type(model).__name__}); set"
                    f" {source} to false or {row} to null"
                )

    def requirements(self) -> frozenset[str]:
        """Sensors that must exist before the world is compiled, see `state.requires`."""
        needed = {*self.rewards.requirements(), *self.observations.requirements(), *self.extra_requirements}
        if {SECTOR_TARGET, AVOIDANCE_TARGET} & set(self.targets):
            needed.add(AVOIDANCE)
        if self.obstacles.num_obstacles:
            needed.add(OBSTACLE_CONTACT)  # metrics count contacts
            needed |= {OBSTACLE_FORCE} if self.trials else set()
        return frozenset(needed)

    @property
    def remembered_frames(self) -> int:
        """LiDAR frames for which an obstacle that was seen counts in the velocity risk: those that the network sees."""
        return max(self.frame_history, 1)

    @property
    def lidar_noise(self) -> tuple[Noise, ...]:
        """The device's noise, stated or measured, where asked for, and the randomization's."""
        return (*self._device_noise, *self.randomization.noise)

    @property
    def _device_noise(self) -> tuple[Noise, ...]:
        if self.lidar is None or self.lidar.device is None:
            return ()
        device = DEVICES[self.lidar.device]
        if self.randomization.lidar_measured:
            return device.measured
        return device.noise() if self.randomization.lidar_device else ()

    @property
    def casts_frames(self) -> bool:
        """Tell whether somebody is shown what the LiDAR sees: the network, or who acts in its place."""
        return self.network_sees_frames or not FROM_LIDAR.isdisjoint(self.extra_requirements)

    @property
    def uses_lidar(self) -> bool:
        """Tell whether anything reads the LiDAR; otherwise it is not built."""
        reads = self.sampler is not None or not FROM_LIDAR.isdisjoint(self.requirements())
        return self.lidar is not None and (reads or bool(self.lidar.consumers))
