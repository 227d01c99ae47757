"""The vectorized environment: one control step from actions to observations."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from rsl_rl.env import VecEnv
from tensordict import TensorDict

from omniperception.avoidance.sector_motion import NEARNESS_RANGE, encode, nothing_near
from omniperception.common.random import EnvRandom
from omniperception.common.rotations import rotate_yaw, yaw_quat
from omniperception.common.rows import chosen, put, replaced, take
from omniperception.common.timing import StageTimer
from omniperception.env.heights import NUM_HEIGHTS, flat_heights
from omniperception.env.mdp.commands import GoalCommandConfig, VelocityCommandConfig
from omniperception.env.mdp.observations import GroupBuffer
from omniperception.env.mdp.randomization import RandomizationConfig, Randomizer
from omniperception.env.mdp.rewards import avoidance_velocity, capped_ray_distance, distal_caps
from omniperception.env.mdp.terminations import TerminationsConfig
from omniperception.env.mdp.terms import ObservationsConfig, RewardsConfig
from omniperception.env.metrics import EpisodeMetrics
from omniperception.env.state import Kinematics, fields_read, plain
from omniperception.lidar import DEVICES, Noise
from omniperception.scene import (
    ObstacleField,
    ObstaclesConfig,
    RobotConfig,
    TerrainConfig,
    TiledTerrainConfig,
    build_world,
)
from omniperception.scene.build import FOOT_FORCE, LINK_FORCE, OBSTACLE_CONTACT
from omniperception.sim import SimConfig, Simulator

if TYPE_CHECKING:  # parts that not every task has, and what they import, are loaded where they are built
    from omniperception.avoidance.true_sectors import TrueSectors
    from omniperception.env.sensing import LidarSensing, SensorConfig
    from omniperception.env.terrain_levels import TerrainLevels
    from omniperception.scene import Ground

HEIGHT_TARGET, SECTOR_TARGET, AVOIDANCE_TARGET = "height_target", "sector_target", "avoidance_target"
MOTION_TARGET = "motion_target"
"""Observation groups that a network can be supervised with: the height grid, 1 - d / NEARNESS_RANGE by sector of what
the LiDAR hits, the avoidance velocity, and nearness and velocity of the true obstacles by sector."""
TARGET_FIELDS = {HEIGHT_TARGET: ("heights",), SECTOR_TARGET: ("sectors",), AVOIDANCE_TARGET: ("sectors",)}
"""The optional fields that each of them is made from."""
SUPERVISION = "supervision."
"""What the names of such readers begin with."""

FOOTING = 0.35
"""Nothing of the ground within this distance (m) of the base reaches above the feet when a robot starts."""

MAX_ACTION = 100.0
"""Actions beyond this magnitude are clipped and counted; a policy that gets here has diverged."""


@dataclass(frozen=True)
class EnvConfig:
    """Everything that defines the task.

    Attributes:
        num_envs: parallel environments.
        seed: seed of every random stream of the task.
        robot, terrain, obstacles, commands, observations, rewards, terminations, randomization, sim: the presets.
        lidar: the sensor, or None.
        sampler: makes the point sampler, or None when no network looks at the cloud.
        frame_history: LiDAR frames kept for the network.
        base_motion: whether a frame's last row is the base's motion since the frame before.
        targets: privileged groups that the network is supervised with; those named *_TARGET here.
        log_interval: control steps between two reports of the metrics.
        initial_obstacle_level: where the obstacles' curriculum starts, 0 to 1; evaluation uses 1.
    """

    num_envs: int
    seed: int
    robot: RobotConfig
    terrain: TerrainConfig | TiledTerrainConfig
    obstacles: ObstaclesConfig
    commands: VelocityCommandConfig | GoalCommandConfig
    observations: ObservationsConfig
    rewards: RewardsConfig
    terminations: TerminationsConfig
    randomization: RandomizationConfig
    sim: SimConfig
    lidar: SensorConfig | None = None
    sampler: Callable | None = None
    frame_history: int = 0
    base_motion: bool = False
    targets: Sequence[str] = ()
    log_interval: int = 24
    initial_obstacle_level: float | None = None

    def __post_init__(self) -> None:
        if self.num_envs < 1:
            raise ValueError(f"num_envs={self.num_envs} must be at least 1")
        if self.log_interval < 1:
            raise ValueError(f"log_interval={self.log_interval} must be at least 1")
        if self.obstacles.free_path is not None and isinstance(self.commands, VelocityCommandConfig):
            raise ValueError("obstacles.free_path leads to a goal, and these commands have none; use commands=goal")
        if MOTION_TARGET in self.targets and self.rewards.avoidance.risk is None:
            raise ValueError(
                "perception.motion_weight needs rewards.avoidance.risk; use rewards=velocity_risk or"
                " perception.motion_weight=0"
            )
        fixed = [name for name, group in self.obstacles.groups.items() if group.poses is not None]
        if fixed and isinstance(self.terrain, TiledTerrainConfig):
            raise ValueError(
                f"obstacles: {', '.join(fixed)} with fixed poses stand on flat ground only; use terrain=flat"
            )
        if self.randomization.lidar_device and self.lidar is not None and self.lidar.device is None:
            raise ValueError(
                "randomization.lidar_device needs a sensor whose maker states its noise, but lidar.device is null; name"
                " the device, or use randomization=lidar"
            )
        if self.lidar is None:
            if self.sampler is not None:
                raise ValueError(
                    "lidar=none gives the perception network nothing to see; use lidar=mid360 or perception=none"
                )
            unmet = sorted(self.fields_read() & {"sectors", "rays"})
            if unmet:
                raise ValueError(
                    f"rewards or observations read {', '.join(unmet)} from the LiDAR, but lidar=none;"
                    " use lidar=mid360 or rewards=walk observations=walk"
                )

    def terms(self) -> tuple[Callable, ...]:
        """The functions of all rewards and observations."""
        observed = (term for group in self.observations.groups.values() for term in group.terms.values())
        return (*(term.func for term in self.rewards.terms.values()), *observed)

    def readers(self) -> dict[str, tuple[str, ...]]:
        """Optional fields of this task and the rewards, observations and targets that read each of them."""
        reads = {**self.rewards.readers(), **self.observations.readers()}
        reads |= {f"{SUPERVISION}{target}": frozenset(TARGET_FIELDS.get(target, ())) for target in self.targets}
        if self.obstacles.num_obstacles:
            reads["metrics.contacts"] = frozenset({"obstacle_contact"})
        read = sorted(frozenset().union(*reads.values()))
        return {field: tuple(name for name, its in reads.items() if field in its) for field in read}

    def fields_read(self) -> frozenset[str]:
        """Optional fields that something in this task reads."""
        return frozenset(self.readers())

    @property
    def remembered_frames(self) -> int:
        """LiDAR frames for which an obstacle that was seen counts in the velocity risk: those that the network sees."""
        return max(self.frame_history, 1)

    @property
    def lidar_noise(self) -> tuple[Noise, ...]:
        """The device's own noise, where asked for, and the randomization's."""
        own = DEVICES[self.lidar.device].noise() if self.randomization.lidar_device else ()
        return (*own, *self.randomization.noise)

    @property
    def uses_lidar(self) -> bool:
        """Whether anything reads the LiDAR; otherwise it is not built."""
        return self.lidar is not None and (self.sampler is not None or bool(self.fields_read() & {"sectors", "rays"}))


class OmniEnv(VecEnv):
    """`num_envs` robots among obstacles behind rsl_rl's VecEnv contract.

    One control step: `decimation` physics steps, before each of which the obstacles move -> robot state -> at the
    LiDAR's rate a frame is cast, given noise and sampled -> rewards and terminations -> finished environments are
    reset -> observations. Contact forces and torques describe the state before the last physics step (5 ms old);
    contacts with obstacles are those of all physics steps of the control step.

    Attributes:
        actions: those applied, newest first, as many as some term reads.
        ground: the terrain's height field; None on flat ground.
        base_height: (num_envs,) height (m) of the base's origin above the ground, the mean of what lies below it and
            below the hips.
        avoidance_velocity: (num_envs, 2) m/s in the yaw-aligned frame, from what was near at the newest frame when a
            term reads it, else 0.
        motion: (num_envs, S, 3) distance (m) and velocity (m/s, yaw-aligned) of the nearest obstacle by sector at the
            newest frame; None where V_avoid is the paper's.
        risk: (num_envs, K) true risk of each candidate velocity that follows from it; None when nobody reads it.
        heights: (num_envs, 187) height (m) of the base's origin above the ground around it, see `HeightLookup`; of this
            moment when a term reads them, else, for supervision, at the newest frame, and 0 before the first.
        weighted_rewards: (num_envs,) of each term in the last step, times its weight and the control step.
        heights_every_step: whether they are of this moment.
    """

    def __init__(self, config: EnvConfig) -> None:
        self.cfg = self.config = config
        self.robot, self.num_envs = config.robot, config.num_envs
        self.num_actions = config.robot.num_joints
        self.control_dt = config.sim.control_dt
        self.max_episode_length = round(config.terminations.episode_length_s / self.control_dt)
        self.timer = StageTimer()
        fields = config.fields_read()
        self._reads = fields
        observed = any(not name.startswith(SUPERVISION) for name in config.readers().get("heights", ()))
        self.heights_every_step = observed or ("heights" in fields and not config.uses_lidar)
        sensors = {FOOT_FORCE, LINK_FORCE, OBSTACLE_CONTACT} & fields
        self.world = build_world(config.robot, config.terrain, config.obstacles, sensors)
        late = config.randomization.latency_s is not None
        self.sim: Simulator = config.sim.build(self.world, config.num_envs, record_states=late)
        self.device = self.sim.device
        self.random = EnvRandom(config.seed, config.num_envs, self.device)
        self.command = config.commands.build(config.num_envs, self.device, self.random)
        self.randomizer = Randomizer(config.randomization, self.sim, self.random)
        self.ground: Ground | None = None
        self.terrain_levels: TerrainLevels | None = None
        if isinstance(config.terrain, TiledTerrainConfig):
            self._build_ground(config.terrain)
        self.obstacles: ObstacleField | None = None
        if config.obstacles.placed_slots():
            poses = self.sim.mocap_pos, self.sim.mocap_quat
            self.obstacles = ObstacleField(config.obstacles, *poses, self.random, self.ground)
            if config.initial_obstacle_level is not None:
                self.obstacles.level = config.initial_obstacle_level
        self.true_sectors = self._build_true_sectors(fields) if config.uses_lidar else None
        self.sensing = self._build_sensing(fields) if config.uses_lidar else None
        self._allocate()
        self.metrics = EpisodeMetrics(self.num_envs, self.device, tuple(config.rewards.terms))
        self.weighted_rewards: dict[str, torch.Tensor] = {}
        self.probes: list[Callable[[], None]] = []  # called in each step before finished environments are reset
        self.step_count = 0
        self._all_envs = torch.arange(self.num_envs, device=self.device)
        self._reset(self._all_envs)
        self._read_state()
        self._groups = {n: GroupBuffer(n, g, self) for n, g in config.observations.groups.items()}
        self._fresh = self._all_envs  # those whose observations begin an episode, see `rows`
        if self.sensing is not None:
            self.sensing.start(self._all_envs, self.sensed)
        self._sense()
        self.observations = self._observe()

    # ---- rsl_rl's contract -------------------------------------------------------------------------------------------

    def get_observations(self) -> TensorDict:
        return self.observations

    def observation_widths(self, group: str) -> dict[str, int]:
        """Numbers of each term of an observation group, in order, per control step."""
        return {term: part.stop - part.start for term, part in self._groups[group].slices.items()}

    def step(self, actions: torch.Tensor) -> tuple[TensorDict, torch.Tensor, torch.Tensor, dict]:
        """One control step with actions (num_envs, num_actions); see rsl_rl.env.VecEnv."""
        self.metrics.record_clipped(actions.abs().amax(1) > MAX_ACTION)
        actions = torch.where(actions.isinf(), torch.nan, actions).clamp(-MAX_ACTION, MAX_ACTION)
        self.actions = (actions, *self.actions[:-1])
        if "last_joint_vel" in self._reads:
            self.last_joint_vel = self.kinematics.joint_vel
        self.step_count += 1
        self.episode_length_buf += 1
        self._advance_physics(actions)
        with self.timer.stage("state"):
            self._read_state()
        if self.sensing is not None:
            self.sensing.follow(self.sensed)
            if self.sensing.due(self.step_count):
                self._sense()
        if self.ground is not None:
            with self.timer.stage("terrain"):
                self.terrain_levels.record(self.kinematics, self.command.value, ~self.sim.failed)
        with self.timer.stage("rewards"):
            self._choose_avoidance()
            outcomes, done = self._terminate()
            rewards = self._reward()
            self._record(done, outcomes)
        for probe in self.probes:
            probe()
        with self.timer.stage("resets"):
            self.command.advance(self.control_dt, self.kinematics)
            self._fresh = ended = chosen(done, costly=self.obstacles is not None and self.obstacles.searches)
            if len(ended):
                self._reset(ended)
                self._read_state()
                if self.sensing is not None:
                    self.sensing.start(ended, self.sensed)
        with self.timer.stage("observations"):
            self.observations = self._observe()
        extras: dict = {"time_outs": outcomes["time_out"].float()}
        if self.step_count % self.config.log_interval == 0:
            extras["log"] = self._report()
        return self.observations, rewards, done.long(), extras

    @property
    def curriculum_level(self) -> float:
        """Share of the obstacles that the curriculum lets in, 0 to 1; 1 where there is none."""
        return 1.0 if self.obstacles is None else self.obstacles.level

    @curriculum_level.setter
    def curriculum_level(self, level: float) -> None:
        if self.obstacles is not None:
            self.obstacles.level = level

    def terms_not_finite(self, name: str, env_id: int) -> list[str]:
        """Which terms of "rewards", or of an observation group, are not finite for an environment."""
        if name == "rewards":
            return [term for term, value in self.weighted_rewards.items() if not torch.isfinite(value[env_id])]
        if name not in self._groups:
            return []
        group = self._groups[name]
        rows = self.observations[name][env_id].view(-1, group.width)
        return [term for term, part in group.slices.items() if not torch.isfinite(rows[:, part]).all()]

    def state_dict(self) -> dict:
        """Everything that a resumed run needs to go on exactly."""
        parts = {name: part.state_dict() for name, part in self._parts().items()}
        return {
            **parts,
            "random": self.random.counter,
            "step_count": self.step_count,
            "episode_length": self.episode_length_buf,
            "actions": list(self.actions),
            "past": list(self._past or ()),
            "risk": self.risk,
            "obstacle_motion": self.motion,
            "heights": self.heights,
            "histories": {name: group.buffer for name, group in self._groups.items()},
            "observations": {name: self.observations[name] for name in self._groups},
        }

    def load_state_dict(self, state: dict) -> None:
        """Goes on from the `state_dict` of an environment with the same configuration."""
        for name, part in self._parts().items():
            part.load_state_dict(state[name])
        self.random.counter.copy_(state["random"])
        self.step_count = state["step_count"]
        self.episode_length_buf.copy_(state["episode_length"])
        self.actions = tuple(state["actions"])
        if self._past is not None:
            self._past = tuple(state["past"])
        for name, buffer in state["histories"].items():
            self._groups[name].buffer = buffer
        self._read_state()
        if self.sensing is not None:
            self.risk, self.motion = state["risk"], state["obstacle_motion"]
            self._read_avoidance()
            self._choose_avoidance()
        self.heights = state.get("heights", self.heights)  # older checkpoints have none
        self.observations = self._collect(dict(state["observations"]))

    # ---- the parts of a step -----------------------------------------------------------------------------------------

    def _advance_physics(self, actions: torch.Tensor) -> None:
        target = self.default_joint_pos + self.robot.action_scale * actions
        if self.randomizer.joint_offset is not None:
            target = target + self.randomizer.joint_offset
        path = None
        if self.obstacles is not None:
            with self.timer.stage("obstacles"):
                path = self._obstacle_path()
        with self.timer.stage("physics"):
            self.sim.step(target, self.config.sim.decimation, path)
            self.sim.detect_failures()
        if OBSTACLE_CONTACT in self.world.sensors:
            self.touching = self.sim.touched(OBSTACLE_CONTACT)
        if self._past is not None:
            for past, recorded in zip(self._past, self.sim.recorded_states(), strict=True):
                past.copy_(torch.cat((past[:, recorded.shape[1] :], recorded), 1)[:, -past.shape[1] :])

    def _obstacle_path(self) -> torch.Tensor:
        """Moves the obstacles through the control step; where they are during each of its physics steps."""
        if self.obstacles.any_approaches:
            commanded = rotate_yaw(self.kinematics.yaw, self.command.value[:, :2])
            self.obstacles.start_anew(self.sim.qpos[:, :2], commanded)
        sim = self.config.sim
        return self.obstacles.travel(sim.timestep, sim.decimation, self.sim.qpos[:, :2])

    def _read_state(self) -> None:
        self.kinematics = Kinematics.of(*self.sim.robot_state())
        self.sensed = self.kinematics if self._past is None else self._late_kinematics()
        if "joint_torque" in self._reads:
            self.joint_torque = self.sim.joint_torque()
        if "foot_force" in self._reads:
            self.foot_force = self.sim.contact_sensor(FOOT_FORCE).unflatten(1, (-1, 3))
        if "link_force" in self._reads:
            self.link_force = self.sim.contact_sensor(LINK_FORCE).unflatten(1, (-1, 3))
        self.base_height = self.kinematics.base_pos_w[:, 2]
        if self.ground is not None:
            self._height_lookup.place(self.kinematics)
            self.base_height = self._height_lookup.base_height()
        if self.heights_every_step:
            self._read_heights()
        if "obstacles" in self._reads:
            self._locate_obstacles()

    def _read_heights(self) -> None:
        """Heights of the base above the ground around it, at the latest state that `_read_state` has seen."""
        flat = self.ground is None
        self.heights = flat_heights(self.base_height) if flat else self._height_lookup.around()

    def _late_kinematics(self) -> Kinematics:
        """The state `delay` physics steps ago, by environment."""
        qpos, qvel = self._past
        index = qpos.shape[1] - 1 - self.randomizer.delay
        return Kinematics.of(qpos[self._all_envs, index], qvel[self._all_envs, index])

    def _locate_obstacles(self) -> None:
        if self.obstacles is None:
            self.obstacle_rel_pos_yaw = torch.zeros(self.num_envs, 1, 2, device=self.device)
            self.obstacle_vel_yaw = torch.zeros_like(self.obstacle_rel_pos_yaw)
            self.obstacle_radius = torch.zeros(1, device=self.device)
            self.obstacle_active = torch.zeros(self.num_envs, 1, dtype=torch.bool, device=self.device)
            return
        yaw, field = self.kinematics.yaw, self.obstacles
        offset = field.pos_w[..., :2].float() - self.kinematics.base_pos_w[:, None, :2]
        self.obstacle_rel_pos_yaw = rotate_yaw(-yaw, offset)
        self.obstacle_vel_yaw = rotate_yaw(-yaw, field.velocity_w.float())
        self.obstacle_radius = field.radius.float()
        self.obstacle_active = field.active

    def _sense(self) -> None:
        """One frame of the LiDAR, which sleeps while the curriculum has not let the first obstacle in."""
        if self.sensing is None or (self.obstacles is not None and self.obstacles.level == 0.0):
            return
        self.sensing.take_frame(self.step_count * self.control_dt, self.sensed.base_quat_w, self.timer)
        if self.sensing.sector_distance is not None:
            with self.timer.stage("sectors"):
                self._read_avoidance()
        if "heights" in self._reads and not self.heights_every_step:
            with self.timer.stage("heights"):
                self._read_heights()
        if self.true_sectors is not None:
            with self.timer.stage("risk"):
                unseen = self.sensing.unseen
                known = None if unseen is None else unseen < self.config.remembered_frames
                self.motion = self.true_sectors.measure(self.kinematics, known)
                if self.risk is not None:
                    self.risk = self.config.rewards.avoidance.risk.risk(self.motion, self._candidates)

    def _read_avoidance(self) -> None:
        """V_avoid of the paper, which holds from one frame to the next."""
        if "sectors" in self._reads and self.true_sectors is None:
            self.avoidance_velocity = avoidance_velocity(self.sensing.sector_distance, self.config.rewards.avoidance)

    def _choose_avoidance(self) -> None:
        """V_avoid from the risk of velocities, which depends on the command of the moment."""
        if self.risk is not None:
            law, command = self.config.rewards.avoidance.risk, self.command.value[:, :2]
            self.avoidance_velocity = law.avoidance(self.risk, command, self._candidates)

    def _terminate(self) -> tuple[dict[str, torch.Tensor], torch.Tensor]:
        """Why environments end, each environment for one reason, and whether they do."""
        diverged = self.sim.failed.clone()
        collided = self.touching if self.config.terminations.on_collision else torch.zeros_like(diverged)
        reached = self.command.reached(self.kinematics)
        causes = {
            "diverged": diverged,
            "fall": self.config.terminations.fallen(self.kinematics, self.base_height),
            "collision_end": collided,
            "goal": torch.zeros_like(diverged) if reached is None else reached,
            "time_out": self.episode_length_buf >= self.max_episode_length,
        }
        if self.ground is not None:
            causes["time_out"] |= self.ground.outside(self.kinematics.base_pos_w[:, :2])
        done = torch.zeros_like(diverged)
        outcomes = {}
        for name, happened in causes.items():
            outcomes[name] = happened & ~done
            done = done | happened
        self.outcomes, self.done = outcomes, done
        return outcomes, done

    def _reward(self) -> torch.Tensor:
        """Weighted sum times the control step; a diverged environment's step counts nothing."""
        healthy = ~self.sim.failed
        total = torch.zeros(self.num_envs, device=self.device)
        for name, term in self.config.rewards.terms.items():
            weighted = torch.where(healthy, term.func(self), 0.0) * (term.weight * self.control_dt)
            self.weighted_rewards[name] = weighted
            total += weighted
        self.metrics.record_rewards(tuple(self.weighted_rewards.values()))
        return total

    def _record(self, done: torch.Tensor, outcomes: dict[str, torch.Tensor]) -> None:
        healthy = ~self.sim.failed
        lin_error = (self.kinematics.base_lin_vel_yaw - self.command.value[:, :2]).norm(dim=1)
        yaw_error = (self.kinematics.base_ang_vel_b[:, 2] - self.command.value[:, 2]).abs()
        lin_error, yaw_error = torch.where(healthy, lin_error, 0.0), torch.where(healthy, yaw_error, 0.0)
        self.velocity_error, self.yaw_rate_error = lin_error, yaw_error
        self.contacts, self.free = self.touching.clone(), self.no_obstacle_near()
        self.metrics.record_tracking(lin_error, yaw_error, healthy, self.free)
        self.metrics.record_contacts(self.touching)
        self.metrics.record_ends(done, outcomes, self.sim.failure)

    def no_obstacle_near(self) -> torch.Tensor | None:
        """(num_envs,) bool: no obstacle within the avoidance threshold in any sector; None without obstacles."""
        if self.sensing is None or self.sensing.sector_distance is None:
            return None
        return (self.sensing.sector_distance >= self.config.rewards.avoidance.threshold).all(1)

    def _reset(self, envs: torch.Tensor) -> None:
        """Starts a new episode in some environments, see `rows`; the others are not touched."""
        self.random.start_episode(envs)
        low, high = self._spawn
        pose = low + self.random.uniform(envs, (3,)) * (high - low)
        height = torch.full((len(envs), 1), self.robot.base_height, device=self.device)
        if self.ground is not None:
            self.terrain_levels.start(envs, pose[:, :2], self._completed(envs))
            height = height + self.ground.highest(pose[:, :2], FOOTING, envs)[:, None]
        joints = self.default_joint_pos.expand(len(envs), -1)
        qpos = torch.cat((pose[:, :2], height, yaw_quat(pose[:, 2]), joints), 1)
        qvel = torch.zeros(len(envs), self.sim.qvel.shape[1], device=self.device)
        self.sim.reset(envs, qpos, qvel)
        self.randomizer.reset(envs)
        if self._past is not None:
            for past, now in zip(self._past, (qpos, qvel), strict=True):
                put(past, envs, now[:, None])
        self.command.reset(envs, Kinematics.of(*self.sim.robot_state()))
        if self.obstacles is not None:
            commanded = rotate_yaw(pose[:, 2], take(self.command.value, envs)[:, :2])
            goal = None if self.command.goal_w is None else take(self.command.goal_w, envs)
            self.obstacles.reset(envs, pose[:, :2], commanded, goal)
        put(self.episode_length_buf, envs, 0)
        self.actions = tuple(replaced(action, envs, 0.0) for action in self.actions)
        put(self.touching, envs, False)
        if self.sensing is not None:
            self.sensing.reset(envs)
            self.avoidance_velocity = replaced(self.avoidance_velocity, envs, 0.0)
            if self.risk is not None:
                self.risk = replaced(self.risk, envs, 0.0)
            if self.motion is not None:
                put(self.motion, envs, nothing_near(1, self.motion.shape[1], self.device))
            if not self.heights_every_step:
                self.heights = replaced(self.heights, envs, 0.0)

    def _completed(self, envs: torch.Tensor) -> torch.Tensor | None:
        """(n,) bool: whether episodes that end now end as planned; None before the first ones."""
        if self.step_count == 0:
            return None
        return take(self.outcomes["time_out"] | self.outcomes["goal"], envs)

    def _observe(self) -> TensorDict:
        return self._collect({name: buffer.update(self, self._fresh) for name, buffer in self._groups.items()})

    def _collect(self, groups: dict[str, torch.Tensor]) -> TensorDict:
        """Adds the LiDAR frames and the height target to the observation groups."""
        if self.sensing is not None and self.sensing.frames is not None:
            groups["frames"] = self.sensing.frames
            groups["frame_count"] = self.sensing.frame_count.clone()
            groups["frame_tick"] = self.sensing.frame_tick.clone()
        if HEIGHT_TARGET in self.config.targets:
            groups[HEIGHT_TARGET] = self.heights
        if SECTOR_TARGET in self.config.targets:
            groups[SECTOR_TARGET] = (1.0 - self.sensing.sector_distance / NEARNESS_RANGE).clamp(min=0.0)
        if AVOIDANCE_TARGET in self.config.targets:
            groups[AVOIDANCE_TARGET] = self.avoidance_velocity
        if MOTION_TARGET in self.config.targets:
            groups[MOTION_TARGET] = encode(self.motion).flatten(1)
        return TensorDict(groups, batch_size=[self.num_envs], device=self.device)

    def _report(self) -> dict[str, float]:
        if self.obstacles is not None and self.config.initial_obstacle_level is None:
            seconds = self.config.log_interval * self.control_dt
            self.obstacles.raise_level(self.metrics.free_velocity_error(), seconds)
        log = self.metrics.drain() | {f"Anomalies/{name}": count for name, count in self.sim.anomalies().items()}
        if self.obstacles is not None:
            log["Metrics/obstacle_level"] = self.obstacles.level
        if self.ground is not None:
            log |= self.terrain_levels.report()
        seconds = self.timer.drain()
        steps = self.config.log_interval * self.num_envs
        for stage, spent in seconds.items():
            log[f"Time/{stage}_us_per_env_step"] = 1e6 * spent / steps
        return log

    def _parts(self) -> dict:
        parts = {
            "sim": self.sim,
            "command": self.command,
            "randomizer": self.randomizer,
            "ground": self.ground,
            "terrain_levels": self.terrain_levels,
            "obstacles": self.obstacles,
            "sensing": self.sensing,
            "metrics": self.metrics,
        }
        return {name: part for name, part in parts.items() if part is not None}

    # ---- construction ------------------------------------------------------------------------------------------------

    def _build_ground(self, terrain: TiledTerrainConfig) -> None:
        from omniperception.env.height_lookup import HeightLookup
        from omniperception.env.terrain_levels import TerrainLevels
        from omniperception.scene import Ground

        threads = self.config.sim.num_threads or None
        self.ground = Ground(terrain, self.world.model, self.sim.ground_pos, threads)
        self.terrain_levels = TerrainLevels(self.ground, self.random, self.control_dt, self.max_episode_length)
        self._height_lookup = HeightLookup(self.ground, self.num_envs, self.device)

    def _build_sensing(self, fields: frozenset[str]) -> LidarSensing:
        from omniperception.env.sensing import LidarSensing, SensingNeeds

        config = self.config
        ray_terms = [term for term in config.terms() if "rays" in fields_read(term)]
        needs = SensingNeeds(
            sectors=config.rewards.avoidance.num_sectors if "sectors" in fields else 0,
            sector_max=config.lidar.max_range,
            distal_caps=distal_caps(ray_terms),
            whole="rays" in fields and (not ray_terms or any(plain(t) is not capped_ray_distance for t in ray_terms)),
            obstacles=self.true_sectors.names if self.true_sectors is not None else (),
        )
        return LidarSensing(
            config.lidar,
            self.sim,
            self.control_dt,
            needs,
            config.lidar_noise,
            config.seed,
            config.sim.num_threads or None,
            config.sampler() if config.sampler is not None else None,
            config.frame_history,
            config.base_motion,
        )

    def _build_true_sectors(self, fields: frozenset[str]) -> TrueSectors | None:
        config, avoidance = self.config, self.config.rewards.avoidance
        if avoidance.risk is None or not ("sectors" in fields or MOTION_TARGET in config.targets):
            return None
        from omniperception.avoidance.true_sectors import TrueSectors

        return TrueSectors(avoidance.num_sectors, config.obstacles, self.obstacles, self.num_envs, self.device)

    def _actions_before(self) -> int:
        """How many actions before the newest something reads."""
        return 2 if "action_before_last" in self._reads else int("last_action" in self._reads)

    def _allocate(self) -> None:
        robot, model = self.robot, self.world.model
        joint_ids = [model.joint(name).id for name in robot.joints]
        limits = torch.tensor(model.jnt_range[joint_ids], dtype=torch.float32, device=self.device)
        self.joint_lower, self.joint_upper = limits[:, 0], limits[:, 1]
        spawn = self.config.commands.spawn
        bounds = (spawn.x, spawn.y, [math.radians(angle) for angle in spawn.yaw_deg])
        self._spawn = torch.tensor(list(zip(*bounds, strict=True)), device=self.device)
        self.default_joint_pos = torch.tensor([robot.default_joint_pos[n] for n in robot.joints], device=self.device)
        zero = torch.zeros(self.num_envs, self.num_actions, device=self.device)
        self.actions: tuple[torch.Tensor, ...] = (zero,) * (1 + self._actions_before())
        if "last_joint_vel" in self._reads:
            self.last_joint_vel = zero
        self.touching = torch.zeros(self.num_envs, dtype=torch.bool, device=self.device)
        self.avoidance_velocity = torch.zeros(self.num_envs, 2, device=self.device)
        self.heights = torch.zeros(self.num_envs, NUM_HEIGHTS if "heights" in self._reads else 0, device=self.device)
        self.risk: torch.Tensor | None = None
        self.motion: torch.Tensor | None = None
        if self.true_sectors is not None:
            law, num_sectors = self.config.rewards.avoidance.risk, self.true_sectors.num_sectors
            self.motion = nothing_near(self.num_envs, num_sectors, self.device)
            if "sectors" in self._reads:
                self._candidates = law.candidates(self.device)
                self.risk = torch.zeros(self.num_envs, law.num_candidates, device=self.device)
        self.episode_length_buf = torch.zeros(self.num_envs, dtype=torch.int64, device=self.device)
        self._past: tuple[torch.Tensor, torch.Tensor] | None = None
        if self.randomizer.delay is not None:
            steps = self.randomizer.max_delay + 1
            self._past = tuple(x[:, None].repeat(1, steps, 1) for x in self.sim.robot_state())
