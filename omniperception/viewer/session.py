"""A run in a task of one environment, as the viewer holds it: stepping, driving, pushing, obstacles, weights."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from tensordict import TensorDict

from omnilidar import Lidar, LidarFrame
from omniperception import build
from omniperception.config import ConfigError
from omniperception.env.config import FROM_LIDAR, EnvConfig
from omniperception.env.env import OmniEnv, Policy
from omniperception.env.state import AVOIDANCE, MEASURED_CLOUD
from omniperception.evaluation.film.perceived import Perceived, perceived
from omniperception.evaluation.trials.baselines import Limits, baseline, commanded_ranges
from omniperception.evaluation.trials.policies import BASELINES
from omniperception.learning import Runner, latest_checkpoint
from omniperception.scene.obstacle_field import PARKED_HEIGHT
from omniperception.scene.rays import RayShapes, ray_shapes
from omniperception.viewer.drive import Velocity, driven
from omniperception.viewer.options import Shown
from omniperception.viewer.spares import PREFIX as SPARE
from omniperception.viewer.spares import with_spares

CLOUD_OUTPUTS = ("points_w", "valid", "elevation", "class_id", "time_s", "intensity")
MOST_POINTS = 20_000
"""Rays of a frame that are shown of a sensor that has more."""
BY_HAND = "by hand"
"""Why a trial ended that a person has ended."""
DRAG_SPEED = 3.0
"""Speed (m/s) with which an obstacle follows the mouse: it moves, and whoever looks sees it move."""


@dataclass(frozen=True)
class TrialEnd:
    """The end of a trial.

    Attributes:
        cause: name of the termination.
        touched: whether the robot touched an obstacle.
    """

    cause: str
    touched: bool


class Session:
    """A run in a task of one environment.

    Attributes:
        shown: what this is.
        env, policy, checkpoint: the task, who acts in it, and where its weights came from.
        rewards: weighted reward of each term in the last control step, per second.
        outcomes: of the trials that have ended.
        shapes: what rays can hit, and its bodies.
        frames: LiDAR frames shown so far.
    """

    def __init__(self, shown: Shown) -> None:
        """Builds the task and loads the weights.

        Raises:
            ConfigError, CheckpointError: it cannot be shown; one line says why.
        """
        self.shown = shown
        run = build.load_run(shown.run_dir, [*shown.overrides, "num_envs=1"], shown.trust)
        build.check_split(run, "page", shown.run_dir)
        if shown.policy != "run" and shown.policy not in BASELINES:
            raise ConfigError(f"policy={shown.policy} is unknown; known: run, {', '.join(BASELINES)}")
        self._runner: Runner = build.build_runner(replace(run, env=_watched(run.env, shown.policy), families={}), None)
        self.env: OmniEnv = self._runner.env
        self.checkpoint = shown.checkpoint or latest_checkpoint(shown.run_dir)
        self._runner.load_policy(self.checkpoint)
        self.policy: Policy = self._contender()
        self.rewards: dict[str, float] = {}
        self.outcomes: list[TrialEnd] = []
        self.shapes: RayShapes = ray_shapes(self.env.world)
        self._touched = self._given_up = False
        self._held: dict[int, tuple[torch.Tensor, torch.Tensor]] = {}
        self.env.step_hooks.append(self._note)
        self._lidar: Lidar | None = None
        self.frames, self._tick = 0, 0
        self.cloud: LidarFrame | None = None
        self.show_cloud(None)

    # ---- stepping ----------------------------------------------------------------------------------------------------

    def step(self) -> None:
        """One control step."""
        env = self.env
        with torch.no_grad():
            self._carry_held()
            actions = self.policy(env.get_observations())
            env.step(actions)
            self._follow_lidar()

    def reset(self) -> None:
        """Ends the trial: the next one begins with the next step."""
        self._given_up = True
        self.env.episode_length_buf.fill_(self.env.max_episode_length)
        self.step()

    def _note(self) -> None:
        """Takes in a step, before an environment whose trial has ended is reset."""
        env = self.env
        dt = env.control_dt
        self.rewards = {name: float(value[0]) / dt for name, value in env.rewards.weighted.items()}
        self._touched |= bool(env.contacts[0])
        if bool(env.done[0]):
            cause = next(name for name, happened in env.outcomes.items() if happened[0])
            cause, self._given_up = BY_HAND if self._given_up and cause == "time_out" else cause, False
            self.outcomes.append(TrialEnd(cause, self._touched))
            self._touched = False
            self._held.clear()

    @property
    def time_s(self) -> float:
        """Since the trial began (s)."""
        return float(self.env.state.time_s[0])

    # ---- driving and pushing -----------------------------------------------------------------------------------------

    def drive(self, velocity: Velocity | None) -> None:
        """Commands a velocity (v_x, v_y in m/s, yaw rate in rad/s); None gives the task its own commands back."""
        command = self.env.command
        command.driven = velocity  # type: ignore[union-attr]  # see `_watched`
        command.take_over()  # type: ignore[union-attr]

    @property
    def driven(self) -> Velocity | None:
        """What a person commands."""
        return self.env.command.driven  # type: ignore[union-attr]

    def push(self, velocity: Sequence[float]) -> None:
        """Changes the base's horizontal velocity by (x, y) m/s, environment frame, at once."""
        qvel = self.env.sim.qvel
        qvel[0, :2] += qvel.new_tensor(list(velocity))
        self.env.state.invalidate()

    # ---- obstacles ---------------------------------------------------------------------------------------------------

    def obstacle_of(self, part: int) -> int:
        """Number of the obstacle that a part belongs to."""
        assert self.env.obstacles is not None
        return self.env.obstacles.parts[part].obstacle

    def hold(self, obstacle: int, xy_w: Sequence[float]) -> None:
        """Lets an obstacle move to a place (m) at DRAG_SPEED at most, until `let_go`."""
        field = self.env.obstacles
        if field is None:
            return
        before = self._held.get(obstacle)
        velocity = field.root_velocity_w[0, obstacle].clone() if before is None else before[1]
        self._held[obstacle] = field.root_pos_w.new_tensor(list(xy_w)), velocity

    def let_go(self, obstacle: int) -> None:
        """The obstacle goes on as it did before it was held."""
        field, held = self.env.obstacles, self._held.pop(obstacle, None)
        if field is not None and held is not None:
            field.root_velocity_w[0, obstacle] = held[1]

    def bring(self, kind: str, xy_w: Sequence[float]) -> int:
        """Puts a spare obstacle of a kind somewhere (m).

        Returns:
            Its number.

        Raises:
            ValueError: all of that kind are there already.
        """
        field = self.env.obstacles
        assert field is not None  # there are spare ones
        own = [k for k, o in enumerate(field.config.obstacles()) if o.name.startswith(f"obstacle_spare_{kind}_")]
        free = [k for k in own if not field.root_active[0, k]]
        if not own:
            raise ValueError(f"{kind} is no kind of obstacle; known: {', '.join(spare_kinds(self.env))}")
        if not free:
            raise ValueError(f"all {len(own)} of kind {kind} are there already; take one away or start a new trial")
        self._put(free[0], xy_w)
        return free[0]

    def take_away(self, obstacle: int) -> None:
        """Parks an obstacle where nothing finds it."""
        field = self.env.obstacles
        if field is not None:
            self._held.pop(obstacle, None)
            self._set_active(obstacle, False)
            field.root_velocity_w[0, obstacle] = 0.0
            field.root_pos_w[0, obstacle, 2] = PARKED_HEIGHT

    def _put(self, obstacle: int, xy_w: Sequence[float]) -> None:
        field = self.env.obstacles
        assert field is not None
        group = field.config.obstacles()[obstacle].group
        height = group.bottom[0]
        if field.articulation is None:  # else its middle hangs from its foot
            height += float(field.half_height[0, next(k for k, p in enumerate(field.parts) if p.obstacle == obstacle)])
        place = field.root_pos_w[0, obstacle]
        place[:2] = place.new_tensor(list(xy_w))
        place[2] = height
        speed = group.speed[1]
        if speed > 0:  # towards the robot
            way = self.env.state.kinematics.base_pos_w[0, :2].to(place) - place[:2]
            field.root_velocity_w[0, obstacle] = speed * way / way.norm().clamp(min=1e-3)
        self._set_active(obstacle, True)

    def _set_active(self, obstacle: int, there: bool) -> None:
        field = self.env.obstacles
        assert field is not None
        field.root_active[0, obstacle] = there
        for k, part in enumerate(field.parts):
            if part.obstacle == obstacle:
                field.active[0, k] = there

    def _carry_held(self) -> None:
        """Obstacles that are held move towards where they are pulled, during the next control step."""
        field, dt = self.env.obstacles, self.env.control_dt
        for obstacle, (target, _) in self._held.items():
            assert field is not None
            velocity = (target - field.root_pos_w[0, obstacle, :2]) / dt
            speed = velocity.norm().clamp(min=1e-6)
            field.root_velocity_w[0, obstacle] = velocity * (DRAG_SPEED / speed).clamp(max=1.0)

    # ---- weights -----------------------------------------------------------------------------------------------------

    def load(self, checkpoint: Path) -> None:
        """Puts other weights into the same network while the robot walks on.

        Raises:
            CheckpointError: they are missing, damaged, or of another network; what was there goes on.
        """
        before = {name: value.clone() for name, value in self._runner.alg.actor.state_dict().items()}
        try:
            self._runner.load_policy(checkpoint)
        except Exception:
            self._runner.alg.actor.load_state_dict(before)
            raise
        finally:
            self._runner.alg.actor.reset()
        self.checkpoint = checkpoint

    def _contender(self) -> Policy:
        policy, name = self._runner.policy, self.shown.policy
        if name == "run":
            return policy
        try:
            return baseline(name, self.env, policy, self.env.config.rewards.avoidance, self._limits())
        except ValueError as error:
            raise ConfigError(f"policy={name}: {error}") from None

    def _limits(self) -> Limits | None:
        own = self.env.config.rewards.avoidance.risk is not None
        return None if own else commanded_ranges(self.shown.run_dir)

    # ---- what is seen ------------------------------------------------------------------------------------------------

    def perceived(self) -> Perceived | None:
        """What the network makes of its frames; None where it looks at none."""
        observations: TensorDict = self.env.get_observations()
        return perceived(self._runner.alg.actor, observations, self.env.state.reference)

    def show_cloud(self, num_rays: int | None) -> None:
        """Chooses how many rays of a frame are shown; None: those that the task casts, so that points are those that
        the policy is given, noise included."""
        env = self.env
        self._lidar = self.cloud = None
        if env.sensing is None or env.config.lidar is None:
            return
        sensor = env.config.lidar
        pattern = sensor.scan_pattern()
        most = min(pattern.points_per_frame(sensor.period_s), MOST_POINTS)
        self._lidar = Lidar(
            replace(sensor, num_rays=sensor.num_rays if num_rays is None else min(num_rays, most)),
            pattern,
            env.sensing.scene,
            env.sensing.carrier,
            noise=env.config.lidar_noise,
            seed=env.config.seed,
            outputs=CLOUD_OUTPUTS,
        )
        self._tick = env.sensing.tick

    def _follow_lidar(self) -> None:
        """Casts the shown cloud where the task has just cast its own, from the same poses."""
        env, lidar = self.env, self._lidar
        if lidar is None or env.sensing is None:
            return
        if bool(env.done[0]):
            lidar.reset()
            self.cloud, self._tick = None, env.sensing.tick
            return
        sensor = env.config.lidar
        assert sensor is not None
        if env.sensing.tick != self._tick:
            self._tick, self.frames = env.sensing.tick, self.frames + 1
            torch.sub(env.sensing.lidar.frame_count, 1, out=lidar.frame_count)  # the task's, from before its cast
            self.cloud = lidar.cast(env.step_count * env.control_dt)
        elif sensor.motion_segments and self._ends_segment(sensor.motion_segments):
            lidar.record_poses()

    def _ends_segment(self, segments: int) -> bool:
        sensing, step = self.env.sensing, self.env.step_count
        assert sensing is not None
        return step % (sensing.period_steps // segments) == 0


def spare_kinds(env: OmniEnv) -> list[str]:
    """Kinds of obstacles that can be brought in."""
    names = [] if env.obstacles is None else env.obstacles.config.groups
    return [name.removeprefix(SPARE) for name in names if name.startswith(SPARE)]


def _watched(task: EnvConfig, policy: str) -> EnvConfig:
    """The task such that it can be driven, looked at and added to; its observations are the same."""
    extra = [*task.extra_requirements]
    if task.lidar is not None:
        extra += [AVOIDANCE, MEASURED_CLOUD]
    assert set(extra) - set(task.extra_requirements) <= FROM_LIDAR
    return replace(
        task,
        num_envs=1,
        commands=driven(task),
        obstacles=with_spares(task.obstacles),
        extra_requirements=tuple(dict.fromkeys(extra)),
        network_sees_frames=task.network_sees_frames and policy not in BASELINES,
        skip_curricula=True,
        trials=True,
    )
