"""The vectorized environment: one control step from actions to observations."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import lru_cache, partial
from itertools import count

import torch
from rsl_rl.env import VecEnv
from tensordict import NonTensorData, TensorDict

from omnilidar.launch import use_threads
from omniperception.avoidance.velocity import COMMAND, LAST_ASKED
from omniperception.common.random import EnvRandom, TrialRandom
from omniperception.common.rotations import rotate_yaw, yaw_quat
from omniperception.common.stateful import Stateful
from omniperception.common.timing import StageTimer
from omniperception.env.build import (
    build_avoidance,
    build_errors,
    build_ground,
    build_obstacles,
    build_pushes,
    build_sensing,
    build_sim,
)
from omniperception.env.config import HEIGHT_TARGET, EnvConfig
from omniperception.env.mdp.commands import GoalCommand, VelocityCommand
from omniperception.env.mdp.curriculum import Curriculum
from omniperception.env.mdp.managers import ObservationManager, RewardManager
from omniperception.env.mdp.randomization import Randomizer
from omniperception.env.mdp.terms import ActorInput, ObservationsConfig
from omniperception.env.metrics import OUTCOMES, EpisodeMetrics
from omniperception.env.state import CONTACT_SENSORS, EnvState
from omniperception.scene import ObstacleField, build_world

MAX_ACTION = 100.0
"""Actions beyond this magnitude are clipped and counted; a policy that gets here has diverged."""


Policy = Callable[[TensorDict], torch.Tensor]
"""From observations to actions (num_envs, num_actions), without exploration noise."""


_numbers = count(0, 1 << 32)


@lru_cache(8)
def frame_number(number: int, num_envs: int, device: torch.device) -> NonTensorData:
    """Number of the newest LiDAR frame, the same for all environments, as an observation that stays on the host."""
    return NonTensorData(number, batch_size=[num_envs], device=device)


class TaskEnv(VecEnv):
    """What an environment of one world and one of several families have in common of rsl_rl's contract.

    Attributes:
        config: of the task.
        observations: of the present.
    """

    config: EnvConfig
    observations: TensorDict
    _episode_length: torch.Tensor

    @property
    def cfg(self) -> EnvConfig:
        """The name by which rsl_rl knows the configuration."""
        return self.config

    @property
    def episode_length_buf(self) -> torch.Tensor:  # type: ignore[override]
        """(num_envs,) int64 control steps since the episodes began; what is assigned is copied, the state reads it."""
        return self._episode_length

    @episode_length_buf.setter
    def episode_length_buf(self, steps: torch.Tensor) -> None:
        self._episode_length.copy_(steps)

    def get_observations(self) -> TensorDict:
        return self.observations


class OmniEnv(TaskEnv, Stateful):
    """`num_envs` robots among obstacles behind rsl_rl's VecEnv contract.

    One control step: pushes -> `decimation` physics steps, before each of which the obstacles move -> at the LiDAR's
    rate a frame is cast, given noise and sampled -> terminations and rewards -> finished environments are reset ->
    observations. `EnvState` says how old each quantity is.

    Attributes:
        state: what terms read.
        difficulty: share of the randomization.
        ground, terrain_levels, obstacles, avoidance, sensing, pushes: None where the task has none.
        step_hooks: called at the end of each step, before finished environments are reset.
        healthy: (num_envs,) bool: whose physics was sound in the last step.
        done: (num_envs,) bool: which environments ended in the last step.
        outcomes: (num_envs,) bool each: why, by `OUTCOMES`; an environment ends for one reason.
        contacts: (num_envs,) bool: which touched an obstacle in the last step.
        no_obstacle_near: (num_envs,) bool: no obstacle within the avoidance threshold at the newest frame; None where
            that is not measured.
        heights_each_step: whether a term reads heights; else supervision has them from the newest frame.
        velocity_error, yaw_rate_error: (num_envs,) m/s and rad/s against the command in the last step; 0 where the
            physics failed.
    """

    saved = (
        *("sim", "command", "randomizer", "ground", "terrain_levels", "obstacles", "avoidance", "sensing", "pushes"),
        *("state", "metrics", "difficulty", "rewards", "_groups", "random", "step_count", "_frame_heights"),
    )
    buffers = ("_episode_length",)

    def __init__(self, config: EnvConfig, episode_length: torch.Tensor | None = None) -> None:
        """
        Args:
            config: of the task.
            episode_length: (num_envs,) int64 zeros in which `episode_length_buf` is counted, such as a part of others';
                None: it has memory of its own.
        """
        self.config, self.robot = config, config.robot
        self.num_envs, self.num_actions = config.num_envs, config.num_actions
        self.control_dt = config.sim.control_dt
        self.max_episode_length = round(config.terminations.episode_length_s / self.control_dt)
        self.timer, self.step_count, self._has_stepped = StageTimer(), 0, False
        self.step_hooks: list[Callable[[], None]] = []
        use_threads(config.sim.num_threads or None)
        sensors = config.requirements() & CONTACT_SENSORS
        self.world = build_world(config.robot, config.terrain, config.obstacles, sensors)
        streams = TrialRandom if config.trials else EnvRandom
        self.random: EnvRandom = streams(config.seed, self.num_envs, config.sim.torch_device)
        self.sim = build_sim(config, self.world, self.random)
        self.device = self.sim.device
        self.command = config.commands.build(self.num_envs, self.device, self.random)
        own = torch.zeros(self.num_envs, dtype=torch.int64, device=self.device)
        self._episode_length = own if episode_length is None else episode_length
        self.difficulty = Curriculum(config.randomization.curriculum)
        branch = self.random.branch("randomization")
        self.randomizer = Randomizer(config.drawn_physics, self.sim, branch, self.difficulty)
        self.ground, self.terrain_levels, lookup = build_ground(config, self.sim, self.random)
        self.obstacles = build_obstacles(config, self.sim, self.random, self.ground)
        self.avoidance = build_avoidance(config, self.obstacles, self.device)
        self.sensing = build_sensing(config, self.sim, self.random, self.avoidance)
        self.pushes = build_pushes(config, self.sim, self.random, self.difficulty)
        self.state = EnvState(
            config,
            self.sim,
            episode_steps=self._episode_length,
            command=self.command,
            randomizer=self.randomizer,
            difficulty=self.difficulty,
            errors=build_errors(config, self.random, self.difficulty),
            height_lookup=lookup,
            obstacles=self.obstacles,
            sensing=self.sensing,
            avoidance=self.avoidance,
        )
        if not config.sim.has_legs:
            self.state.ask_by(lambda: self.state.asked[:, :2].clone())
        if config.skip_curricula:
            self.curriculum_levels = (1.0,) * len(self._curricula())
        self.metrics = EpisodeMetrics(self.num_envs, self.device, tuple(config.rewards.terms))
        self._spawn = self._spawn_bounds()
        self._sized = self._resizable_geoms()
        self._number = next(_numbers)  # frames of two environments, or of two states of one, never have the same
        self._frame_heights: torch.Tensor | None = None  # at the newest frame, where only supervision reads heights
        self.rewards = RewardManager(config.rewards.terms, self.state)
        self._groups = {n: ObservationManager(n, g, self.state) for n, g in config.observations.groups.items()}
        self.heights_each_step = self.state.has_computed("heights")
        if HEIGHT_TARGET in config.targets and not self.heights_each_step:
            self._frame_heights = torch.zeros_like(self.state.heights)
        self._all_envs = torch.arange(self.num_envs, device=self.device)
        self.done = torch.zeros(self.num_envs, dtype=torch.bool, device=self.device)
        self.outcomes = dict.fromkeys(OUTCOMES, self.done)
        self.velocity_error = self.yaw_rate_error = torch.zeros(self.num_envs, device=self.device)
        self.contacts = self.done
        self.no_obstacle_near: torch.Tensor | None = None
        self._reset(self._all_envs)
        self.healthy = ~self.sim.failed
        self._sense()
        self.observations = self._observe(self._all_envs)

    # ---- rsl_rl's contract -------------------------------------------------------------------------------------------

    def step(self, actions: torch.Tensor) -> tuple[TensorDict, torch.Tensor, torch.Tensor, dict]:
        """One control step with actions (num_envs, num_actions); see rsl_rl.env.VecEnv."""
        rewards = self.advance(actions)
        for hook in self.step_hooks:
            hook()
        return self.conclude(rewards)

    # ---- a step in two halves, for who steps several environments at once --------------------------------------------

    def advance(self, actions: torch.Tensor) -> torch.Tensor:
        """The half of a step before finished environments are reset, with actions (num_envs, num_actions).

        Returns:
            (num_envs,) rewards.
        """
        self.step_count += 1
        self._has_stepped = True
        self.episode_length_buf += 1
        self._advance_physics(self._clipped(actions))
        with self.timer.stage("state"):
            self.state.end_step()
            self.healthy = ~self.sim.failed
        self._follow_sensors()
        self._follow_terrain()
        with self.timer.stage("rewards"):
            self._terminate()
            rewards = self.rewards.compute(self.state, self.healthy)
            self._record()
        return rewards

    def conclude(self, rewards: torch.Tensor) -> tuple[TensorDict, torch.Tensor, torch.Tensor, dict]:
        """The other half, after the step hooks: resets finished environments and returns what `step` does."""
        with self.timer.stage("resets"):
            self.command.advance(self.control_dt, self.state.kinematics)
            ended = self.done.nonzero().flatten()
            if len(ended):
                self._reset(ended)
        with self.timer.stage("observations"):
            self.observations = self._observe(ended)
        # a goal is no failure: what would have come counts, as after a time-out
        extras: dict = {"time_outs": (self.outcomes["time_out"] | self.outcomes["goal"]).float()}
        if self.step_count % self.config.log_interval == 0:
            extras["log"] = self._report()
        return self.observations, rewards, self.done.long(), extras

    # ---- for other learners ------------------------------------------------------------------------------------------

    def reset(self, env_ids: torch.Tensor | None = None, seeds: torch.Tensor | None = None) -> TensorDict:
        """Begins new episodes in environments (n,) int64, or in all, wherever the last ones are.

        Args:
            env_ids: which; None: all.
            seeds: (n,) int64: all that is drawn from now on follows from an environment's seed, whichever environment
                it is, but for its column of a tiled terrain and the levels of curricula. Where all get seeds, the step
                counter restarts, too. None: everything goes on, and no episode repeats another's noise.

        Returns:
            Observations.
        """
        env_ids = self._all_envs if env_ids is None else env_ids
        all_envs = len(env_ids) == self.num_envs
        if seeds is not None:
            self.random.seed(env_ids, seeds)
            if all_envs:
                self.step_count = 0
        time_begins = all_envs and self.step_count == 0
        if time_begins and self.sensing is not None:
            self.sensing.lidar.reset()
        self._reset(env_ids, seeds, interrupted=True)
        self.healthy = ~self.sim.failed
        if time_begins:
            self._sense()
        self.observations = self._observe(env_ids) if all_envs else self._begun(env_ids)
        return self.observations

    def final_observations(self) -> TensorDict:
        """Observations at the end of a step before finished environments are reset; call it from a step hook."""
        return self._collect({name: group.peek(self.state) for name, group in self._groups.items()})

    # ---- a step, in its order ----------------------------------------------------------------------------------------

    def _clipped(self, actions: torch.Tensor) -> torch.Tensor:
        """Actions within MAX_ACTION; infinite ones become NaN, which the simulator counts as a failure."""
        self.metrics.record_clipped(actions.abs().amax(1) > MAX_ACTION)
        return torch.where(actions.isinf(), torch.nan, actions).clamp(-MAX_ACTION, MAX_ACTION)

    def _advance_physics(self, actions: torch.Tensor) -> None:
        self.state.begin_step(actions)
        target = self.state.targets[0]
        if self.randomizer.joint_offset is not None:
            target = target + self.randomizer.joint_offset
        path = turn = None
        if self.obstacles is not None:
            with self.timer.stage("obstacles"):
                path, turn = self._move(self.obstacles)
        with self.timer.stage("physics"):
            if self.pushes is not None:
                self.pushes.advance()
            self.sim.step(target, self.config.sim.decimation, path, turn)
            self.sim.detect_failures()

    def _resize(self, obstacles: ObstacleField, env_ids: torch.Tensor) -> None:
        """Gives the physics and the rays the obstacles' sizes in some environments (n,)."""
        names, geoms, parts = self._sized
        if geoms:
            sizes = obstacles.size[env_ids[:, None], parts]
            self.sim.resize(geoms, env_ids, sizes)
            if self.sensing is not None:
                self.sensing.resize(names, env_ids, sizes)

    def _move(self, obstacles: ObstacleField) -> tuple[torch.Tensor, torch.Tensor | None]:
        """Moves the obstacles through the control step; see `ObstacleField.travel`."""
        sim, robot_xy_w = self.config.sim, self.sim.qpos[:, :2]
        return obstacles.travel(
            sim.timestep,
            sim.decimation,
            robot_xy_w,
            lambda: rotate_yaw(self.state.kinematics.yaw, self.command.value[:, :2]),
        )

    def _follow_sensors(self) -> None:
        """Updates LiDAR and avoidance velocity in each control step, and casts a frame where one is due."""
        if self.sensing is not None:
            self.sensing.follow(self.state.measured)
            if self.sensing.due(self.step_count):
                self._sense()
            elif self._casts_frames():
                self.sensing.record_motion(self.step_count)
        if self.avoidance is not None:
            self.avoidance.choose(self.state.reference[:, :2])

    def _sense(self) -> None:
        """Casts a frame of the LiDAR, samples it and updates the avoidance velocity."""
        if self.sensing is None or not self._casts_frames():
            return
        self.sensing.take_frame(self.step_count * self.control_dt, self.state.measured.base_quat_w, self.timer)
        if self.avoidance is not None:
            with self.timer.stage("avoidance"):
                kinematics, seen = self.state.kinematics, self.sensing.seen_within(self.config.remembered_frames)
                self.avoidance.add_frame(kinematics.base_pos_w, kinematics.yaw, seen)
        if self._frame_heights is not None:
            with self.timer.stage("heights"):
                self._frame_heights = self.state.heights

    def _casts_frames(self) -> bool:
        """Tell whether frames are cast: there is a LiDAR, somebody to see them, and the curriculum has an obstacle."""
        something_there = self.obstacles is None or self.obstacles.level > 0.0 or self.obstacles.any_fixed
        return self.sensing is not None and self.config.casts_frames and something_there

    def _follow_terrain(self) -> None:
        if self.terrain_levels is not None:
            with self.timer.stage("terrain"):
                self.terrain_levels.record(self.state.kinematics, self.command.value, self.healthy)

    def _terminate(self) -> None:
        """Tell whether environments end, and why, each for the first reason that applies."""
        state, config = self.state, self.config.terminations
        never = torch.zeros_like(self.healthy)
        reached = self.command.reached(state.kinematics, state.time_s)
        timed_out = self.episode_length_buf >= self.max_episode_length
        if self.ground is not None:
            timed_out |= self.ground.outside(state.kinematics.base_pos_w[:, :2])
        causes = {
            "diverged": ~self.healthy,
            "fall": config.fallen(state.kinematics, state.base_height),
            "collision_end": state.obstacle_contact if config.on_collision else never,
            "goal": never if reached is None else reached,
            "time_out": timed_out,
        }
        self.done, self.outcomes = never, {}
        for name, happened in causes.items():
            self.outcomes[name] = happened & ~self.done
            self.done = self.done | happened

    def _record(self) -> None:
        healthy, kinematics, command = self.healthy, self.state.kinematics, self.command.value
        lin_error = (kinematics.base_lin_vel_yaw - command[:, :2]).norm(dim=1)
        yaw_error = (kinematics.base_ang_vel_b[:, 2] - command[:, 2]).abs()
        self.velocity_error = torch.where(healthy, lin_error, 0.0)
        self.yaw_rate_error = torch.where(healthy, yaw_error, 0.0)
        self.contacts = self.state.obstacle_contact
        self.no_obstacle_near = None
        if self.avoidance is not None and self.config.casts_frames:
            self.no_obstacle_near = self.avoidance.no_obstacle_near()
        self.metrics.record_rewards(tuple(self.rewards.weighted.values()))
        calm = healthy if self.no_obstacle_near is None else healthy & self.no_obstacle_near
        if isinstance(self.command, VelocityCommand):
            calm = calm & self.command.settled
        self.metrics.record_tracking(self.velocity_error, self.yaw_rate_error, healthy, calm)
        self.metrics.record_contacts(self.contacts)
        self.metrics.record_ends(self.done, self.outcomes, self.sim.failure)

    def _reset(self, env_ids: torch.Tensor, seeds: torch.Tensor | None = None, interrupted: bool = False) -> None:
        """Starts new episodes in some environments (n,); the others are not touched. See `reset`."""
        self.random.start_episode(env_ids)
        low, high = self._spawn
        pose = low + self.random.uniform(env_ids, (3,)) * (high - low)
        height = torch.full((len(env_ids), 1), self.robot.base_height, device=self.device)
        if self.ground is not None and self.terrain_levels is not None:
            self.terrain_levels.start(env_ids, pose[:, :2], self._completed(env_ids, interrupted))
            height = height + self.ground.highest(pose[:, :2], self.robot.footing, env_ids)[:, None]
        joints = self.state.default_joint_pos.expand(len(env_ids), -1)
        qpos = torch.cat((pose[:, :2], height, yaw_quat(pose[:, 2]), joints), 1)
        qvel = torch.zeros(len(env_ids), 6 + self.num_actions, device=self.device)
        self.sim.reset(env_ids, qpos, qvel)
        self.randomizer.reset(env_ids)
        if self.pushes is not None:
            self.pushes.reset(env_ids)
        self.state.reset(env_ids)
        self.command.reset(env_ids, self.state.kinematics)
        if self.obstacles is not None:
            goal = None if self.command.goal_w is None else self.command.goal_w[env_ids]
            command = partial(self._first_command, self.obstacles, env_ids, pose[:, 2])
            self.obstacles.reset(env_ids, pose[:, :2], goal, command)
            self._resize(self.obstacles, env_ids)
        self.episode_length_buf.index_fill_(0, env_ids, 0)
        self.metrics.reset(env_ids)
        if self.sensing is not None:
            self.sensing.reset(env_ids, self.state.measured, seeds)
        if self.avoidance is not None:
            self.avoidance.reset(env_ids)
        if self._frame_heights is not None:
            self._frame_heights = self._frame_heights.index_fill(0, env_ids, 0.0)
        self.rewards.reset(env_ids)
        for group in self._groups.values():
            group.reset(env_ids)

    def _first_command(self, obstacles: ObstacleField, env_ids: torch.Tensor, yaw: torch.Tensor) -> torch.Tensor:
        """(n, 2) m/s, environment frame: what is commanded in the worlds that have been drawn for environments (n,)."""
        if isinstance(self.command, GoalCommand) and self.command.config.route_ahead is not None:
            self.command.follow(env_ids, obstacles.routes(env_ids), self.state.kinematics)
        return rotate_yaw(yaw, self.command.value[env_ids, :2])

    def _completed(self, env_ids: torch.Tensor, interrupted: bool) -> torch.Tensor | None:
        """(n,) bool: whether episodes that end now commanded no more; None before the first ones."""
        if not self._has_stepped:
            return None
        return (self.outcomes["time_out"] | self.outcomes["goal"])[env_ids] | interrupted

    def _observe(self, fresh: torch.Tensor) -> TensorDict:
        """Observations, which begin an episode in the environments `fresh` (n,)."""
        return self._collect({name: group.compute(self.state, fresh) for name, group in self._groups.items()})

    def _begun(self, env_ids: torch.Tensor) -> TensorDict:
        """The newest observations, between two steps; only those of environments (n,) are computed again."""
        groups = self._groups.items()
        return self._collect(
            {name: group.begin(self.state, env_ids, self.observations[name]) for name, group in groups}
        )

    def _collect(self, groups: dict[str, torch.Tensor]) -> TensorDict:
        """Adds LiDAR frames and the targets of supervision to the observation groups."""
        numbered: dict[str, torch.Tensor | NonTensorData] = {}
        if self.sensing is not None and (history := self.sensing.history) is not None:
            groups |= {"frames": history.frames, "frame_count": history.count.clone()}
            numbered["frame_tick"] = frame_number(self._number + self.sensing.tick, self.num_envs, self.device)
        if HEIGHT_TARGET in self.config.targets:
            groups[HEIGHT_TARGET] = self.state.heights if self._frame_heights is None else self._frame_heights
        if self.avoidance is not None:
            groups |= self.avoidance.targets(self.config.targets)
        if self.config.rewards.avoidance.max_acceleration is not None:
            groups[LAST_ASKED] = self.state.last_asked
        return TensorDict(numbered | groups, batch_size=[self.num_envs], device=self.device)

    def _report(self) -> dict[str, float]:
        """Metrics at the end of a log interval."""
        config = self.config
        if not config.skip_curricula:
            seconds, error = config.log_interval * self.control_dt, self.metrics.calm_velocity_error()
            for curriculum in self._curricula().values():
                curriculum.follow(error, seconds)
        log: dict[str, float] = {f"Metrics/{name}_level": part.level for name, part in self._curricula().items()}
        log |= self.metrics.drain()
        log |= {f"Anomalies/{name}": count for name, count in self.sim.anomalies().items()}
        if self.terrain_levels is not None:
            log |= self.terrain_levels.report()
        steps = config.log_interval * self.num_envs
        return log | {f"Time/{name}_us_per_env_step": 1e6 * s / steps for name, s in self.timer.drain().items()}

    # ---- for runners -------------------------------------------------------------------------------------------------

    @property
    def curriculum_levels(self) -> tuple[float, ...]:
        """How far the curricula of obstacles, commands and randomization are, 0 to 1, of those that there are."""
        return tuple(part.level for part in self._curricula().values())

    @curriculum_levels.setter
    def curriculum_levels(self, levels: Sequence[float]) -> None:
        for part, level in zip(self._curricula().values(), levels, strict=True):
            part.level = level

    def _curricula(self) -> dict[str, ObstacleField | Curriculum]:
        """Curricula that follow how well robots walk, by their names in the log."""
        curricula: dict[str, ObstacleField | Curriculum] = {"randomization": self.difficulty}
        if self.obstacles is not None:
            curricula["obstacle"] = self.obstacles
        if isinstance(self.command, VelocityCommand):
            curricula["command"] = self.command.curriculum
        return curricula

    def observation_widths(self, group: str) -> dict[str, int]:
        """Numbers of each term of an observation group, in order, per control step."""
        return {term: part.stop - part.start for term, part in self._groups[group].slices.items()}

    def actor_inputs(self, observations: ObservationsConfig) -> list[ActorInput]:
        """What the one-dimensional inputs of an actor with such observations are here, in order.

        Args:
            observations: of this environment or of another one.
        """
        inputs: list[ActorInput] = []
        for name in observations.actor:
            group = observations.groups[name]
            slices = ObservationManager(name, group, self.state).slices.items()
            for age in reversed(range(group.history)):
                inputs += [ActorInput(name, term, age, i) for term, at in slices for i in range(at.stop - at.start)]
        return inputs

    @property
    def observes_command(self) -> bool:
        """Whether a group holds the command of the present alone, so that another can be observed in its place."""
        observed = self.observations.get(COMMAND)
        return observed is not None and observed.shape == self.command.value.shape

    def terms_not_finite(self, name: str, env_id: int) -> list[str]:
        """Terms of "rewards", or of an observation group, that are not finite for an environment."""
        if name == "rewards":
            return [term for term, value in self.rewards.weighted.items() if not torch.isfinite(value[env_id])]
        if name not in self._groups:
            return []
        group = self._groups[name]
        history = self.observations[name][env_id].view(-1, group.width)
        return [term for term, part in group.slices.items() if not torch.isfinite(history[:, part]).all()]

    def state_dict(self) -> dict:
        """State that an exact resume needs."""
        return super().state_dict() | {"observations": {name: self.observations[name] for name in self._groups}}

    def load_state_dict(self, state: dict) -> None:
        """Resumes from the `state_dict` of an environment with the same configuration."""
        super().load_state_dict(state)
        if self.obstacles is not None:
            self._resize(self.obstacles, self._all_envs)
        self._has_stepped, self._number = True, next(_numbers)
        self.observations = self._collect(dict(state["observations"]))

    def begin_at_levels_of(self, state: dict) -> None:
        """Begins new episodes at the levels that the curricula have in the `state_dict` of another task, of those that
        there are here; of several families', in that of the first."""
        state = next(iter(state.get("families", {"": state}).values()))
        command = state["command"].get("curriculum", {}) if isinstance(self.command, VelocityCommand) else {}
        saved = {"randomization": state["difficulty"], "obstacle": state["obstacles"] or {}, "command": command}
        for name, part in self._curricula().items():
            if part.rises and "level" in saved[name]:
                part.level = saved[name]["level"]
        levels = (state["ground"] or {}).get("level")
        if self.ground is not None and self.terrain_levels is not None and levels is not None and len(levels):
            some = torch.arange(self.num_envs) % len(levels)
            self.ground.load_state_dict({"level": levels.cpu()[some].clamp(max=self.ground.config.levels - 1)})
            self._has_stepped = True  # so that `reset` keeps them
        self.reset()

    def _resizable_geoms(self) -> tuple[tuple[str, ...], tuple[int, ...], torch.Tensor]:
        """Names, geoms and indices of the parts of obstacles whose sizes differ between environments."""
        names: tuple[str, ...] = ()
        varying: tuple[int, ...] = ()
        if self.obstacles is not None:
            varying = self.obstacles.varying
            names = tuple(self.obstacles.parts[k].name for k in varying)
        geoms = tuple(self.world.model.geom(name).id for name in names)
        return names, geoms, torch.tensor(varying, dtype=torch.int64, device=self.device)

    def _spawn_bounds(self) -> torch.Tensor:
        """(2, 3) low and high of x, y (m) and yaw (rad) at which robots start."""
        spawn = self.config.commands.spawn
        bounds = (spawn.x, spawn.y, [math.radians(angle) for angle in spawn.yaw_deg])
        return torch.tensor(list(zip(*bounds, strict=True)), device=self.device)
