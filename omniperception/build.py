"""Puts a run together: the parts of a composed configuration, then environment, networks and runner."""

from __future__ import annotations

import copy
import random
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np
import torch
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from omniperception import config as configs
from omniperception.avoidance.velocity import AVOIDANCE_TARGET
from omniperception.common.provenance import made_at
from omniperception.config import ConfigError, is_composed, one_line
from omniperception.env.config import EnvConfig
from omniperception.env.env import OmniEnv, Policy
from omniperception.env.mdp.commands import GoalCommandConfig, VelocityCommandConfig
from omniperception.env.mdp.observations import base_ang_vel, base_lin_vel
from omniperception.env.mdp.randomization import Condition
from omniperception.env.mdp.terms import first_difference
from omniperception.env.mirror import Mirror
from omniperception.env.mixed import MixedEnv, check_alike, shares_of
from omniperception.env.state import UndeclaredQuantity
from omniperception.learning import CheckpointError, Runner, distributed, latest_checkpoint, load_checkpoint
from omniperception.learning.checkpoint import difference
from omniperception.learning.config import LearningConfig, PerceptionConfig, PPOConfig
from omniperception.learning.distillation import DistillationConfig, Teacher
from omniperception.learning.estimator import EstimatorConfig
from omniperception.learning.log_writers import LoggerConfig
from omniperception.learning.models import build_actor
from omniperception.learning.navigation import NavigationConfig, VelocityInput
from omniperception.scene import Mount, ObstaclesConfig, RobotConfig, SteppingConfig
from omniperception.scene.held_out import held_out
from omniperception.schema import ANYTHING, make, types_of, words_of
from omniperception.sim.planar import PlanarConfig
from omnirobot.common.errors import DoesNotFit, suggest
from omnirobot.common.shell import command_line

if TYPE_CHECKING:
    from omniperception.env.sensing import SensorConfig


FAMILY_STRIDE = 1009
"""Seeds of two families of worlds are this far apart."""


@dataclass(frozen=True)
class Family:
    """A family of worlds to train in; what it leaves open is the run's.

    Attributes:
        obstacles: what is there.
        commands: what the robot is told.
        share: of the environments, in proportion to the other families'.
        episode_length_s: see TerminationsConfig.
    """

    obstacles: ObstaclesConfig
    commands: VelocityCommandConfig | GoalCommandConfig
    share: float = 1.0
    episode_length_s: float | None = None

    def __post_init__(self) -> None:
        if not self.share > 0:
            raise ValueError(f"share={self.share} must be positive; leave the family out instead")
        if self.obstacles.split != "dev":
            raise ValueError(
                f"obstacles.split={self.obstacles.split} is for reports, and no training may see it; use"
                " obstacles.split=dev"
            )


@dataclass(frozen=True)
class RunConfig:
    """A run, assembled from its composed configuration.

    Attributes:
        env: the task.
        perception: the actor's view of the LiDAR, or None.
        ppo: the learning settings.
        logger: where scalars of the training go, or None.
        init: the runs whose weights this one starts from: see `Runner.start_from`.
        distillation: of a teacher at the beginning, or None.
        navigation: of a policy that asks a gait for velocities, or None.
        condition: under which the robot walks, where its randomization is one of conf/condition as it stands.
        composed: the resolved configuration as plain dicts and lists, as saved in the run directory.
        families: worlds to train in, by name, in place of the obstacles and commands of `env`; none: in these alone.
            Nothing but training reads them.
    """

    env: EnvConfig
    perception: PerceptionConfig | None
    ppo: PPOConfig
    logger: LoggerConfig | None
    init: tuple[str, ...]
    distillation: DistillationConfig | None
    condition: Condition | None
    navigation: NavigationConfig | None
    composed: dict
    families: Mapping[str, Family] = field(default_factory=dict)

    def __post_init__(self) -> None:
        supervised = self.perception is not None and self.perception.supervised_epochs > 0
        if self.ppo.num_learning_epochs == 0 and not supervised:
            raise ValueError(
                "ppo.num_learning_epochs=0 keeps the policy as it is, and nothing else learns; set it to at least 1, or"
                " perception.supervised_epochs"
            )
        if self.ppo.num_learning_epochs == 0 and (self.distillation is not None or self.ppo.critic_warmup > 0):
            given = "distillation" if self.distillation is not None else "ppo.critic_warmup"
            raise ValueError(
                f"{given} is a beginning of a policy's learning, and ppo.num_learning_epochs=0 keeps it as it is; leave"
                " one of them out"
            )
        if self.distillation is not None and self.perception is None:
            raise ValueError(
                "distillation teaches a policy that sees what its teacher is told of, and perception=none sees nothing;"
                " leave it out or choose a perception"
            )
        if self.adds_velocity and self.env.observations.estimated is not None and self.ppo.num_learning_epochs > 0:
            raise ValueError(
                "observations.estimated: estimates would be fitted to the command without the avoidance velocity that"
                " is added to it; set perception.avoidance_weight and motion_weight, or ppo.num_learning_epochs, to 0"
            )

    @property
    def adds_velocity(self) -> bool:
        """Whether the policy adds an avoidance velocity to its command."""
        return self.perception is not None and (self.perception.avoidance_weight or self.perception.motion_weight) > 0

    @property
    def max_acceleration(self) -> float | None:
        """Limit (m/s^2) of V_cmd + V_avoid; None without one, and where V_avoid is not added."""
        return self.env.rewards.avoidance.max_acceleration if self.adds_velocity else None

    def family_envs(self) -> dict[str, EnvConfig]:
        """The tasks of the families by name, with seeds of their own, which share the run's environments.

        Raises:
            ConfigError: one line that says what to change.
        """
        if not self.families:
            return {}
        try:
            numbers = shares_of({name: family.share for name, family in self.families.items()}, self.env.num_envs)
        except ValueError as error:
            raise ConfigError(str(error)) from None
        tasks = {}
        for index, (name, family) in enumerate(self.families.items()):
            try:
                terminations = self.env.terminations
                if family.episode_length_s is not None:
                    terminations = replace(terminations, episode_length_s=family.episode_length_s)
                tasks[name] = replace(
                    self.env,
                    num_envs=numbers[name],
                    seed=self.env.seed + FAMILY_STRIDE * index,
                    obstacles=family.obstacles,
                    commands=family.commands,
                    terminations=terminations,
                )
            except ValueError as error:
                raise ConfigError(f"families.{name}: {one_line(error)}") from None
        try:
            check_alike(tasks)
        except ValueError as error:
            raise ConfigError(str(error)) from None
        return tasks

    @property
    def task(self) -> dict:
        """What the configuration says of the environments."""
        task = copy.deepcopy(self.composed)
        for key in _BESIDE_THE_TASK:
            group, _, name = key.rpartition(".")
            (task.get(group) or {} if group else task).pop(name, None)
        return task


_TASK = (
    *("num_envs", "seed", "robot", "terrain", "obstacles", "commands", "observations", "rewards", "terminations"),
    *("randomization", "sim"),
)
"""Keys of a configuration that are fields of EnvConfig as they stand."""
_BESIDE_THE_TASK = (
    *("ppo", "logger", "init", "seed", "sim.num_threads", configs.SEARCH_PATH),
    *("perception.learning_rate", "perception.final_learning_rate", "perception.supervised_epochs"),
)
"""Keys of a configuration that change nothing in the environments."""


def assemble(config: DictConfig, trust: Sequence[str] = ()) -> RunConfig:
    """Builds and validates every part of a configuration.

    Args:
        config: from `config.compose`, which may name whatever can be imported, or from `config.load`, which may not.
        trust: modules outside of this package that a loaded configuration may name, with what is below them.

    Raises:
        ConfigError: one line that says what to change.
    """
    trusted = ANYTHING if is_composed(config) else trust
    if config.get("perception") and not config.get("lidar"):
        raise ConfigError("perception needs a LiDAR, but lidar=none; use lidar=mid360 or perception=none")
    composed = _resolved(config)
    for key in {*_TASK, "lidar", "perception", "ppo", "logger"} - composed.keys():
        raise DoesNotFit(f"the configuration has no {key}")
    hints = types_of(EnvConfig)
    task = {key: make(hints[key], composed[key], key, trusted) for key in _TASK}
    if isinstance(task["sim"], PlanarConfig):
        task["sim"] = replace(task["sim"], response=str(_gait_of(task["sim"].response, task["robot"])))
    if task["obstacles"].split == "test":
        try:
            task["obstacles"] = held_out(task["obstacles"])
        except ValueError as error:
            raise ConfigError(one_line(error)) from None
    ppo = make(PPOConfig, composed["ppo"], "ppo", trusted)
    perception = make(PerceptionConfig | None, composed["perception"] or None, "perception", trusted)
    seen = {}
    if perception is not None:
        seen = {"sampler": perception.sampler, "frame_history": perception.history}
        seen |= {"base_motion": perception.base_motion, "frame_times": perception.frame_times}
        seen |= {"targets": tuple(perception.supervision)}
    if composed.get("navigation") and task["sim"].has_legs:
        seen["num_asked"] = 3
    distillation = make(DistillationConfig | None, composed.get("distillation"), "distillation")
    if distillation is not None:
        seen["targets"] = tuple(dict.fromkeys((*seen.get("targets", ()), AVOIDANCE_TARGET)))
    try:
        lidar = _sensor(composed["lidar"], task["robot"], trusted) if composed["lidar"] else None
        stepping = make(SteppingConfig | None, composed.get("stepping"), "stepping")
        env = EnvConfig(**task, lidar=lidar, log_interval=ppo.num_steps_per_env, stepping=stepping, **seen)
        condition = make(Condition | None, composed.get("condition"), "condition")
        logger = _logger(composed, trusted)
        init = _names(composed.get("init"), bool(composed.get("navigation")))
        navigation = make(NavigationConfig | None, composed.get("navigation"), "navigation")
        families = _families(composed.get("families"), trusted)
        return RunConfig(env, perception, ppo, logger, init, distillation, condition, navigation, composed, families)
    except ValueError as error:
        raise ConfigError(one_line(error)) from None


def load_run(run_dir: Path, overrides: Sequence[str] = (), trust: Sequence[str] = ()) -> RunConfig:
    """A run's configuration, changed by overrides, as objects; see `config.load` and `assemble`.

    Raises:
        ConfigError: one line that says what to change; where the run's own file is of a version of this program with
            other keys, that it is.
    """
    try:
        return assemble(configs.load(run_dir, overrides), trust)
    except ConfigError:
        check_version(run_dir, trust)
        raise


def check_version(run_dir: Path, trust: Sequence[str] = ()) -> None:
    """Refuses a run whose configuration, without overrides, has keys that this program does not know, or lacks some."""
    try:
        assemble(configs.load(run_dir), trust)
    except DoesNotFit as error:
        raise ConfigError(
            f"{run_dir / configs.CONFIG_FILE} is of another version of this program ({error}); train again, or use the"
            f" version that made it: {made_at(run_dir)}"
        ) from None
    except ConfigError:
        return  # it fits; what else is wrong is told by whoever asked


def _gait_of(name: str, robot: RobotConfig) -> Path:
    """The run directory whose gait robots without legs follow, of the same robot."""
    run_dir = configs.find_run(name, "sim.response")
    theirs = configs.read(run_dir).robot
    if theirs.file != robot.file or list(theirs.joints) != list(robot.joints):
        raise ConfigError(
            f"sim.response={name} is the gait of {theirs.file}, this robot is {robot.file}; give sim.response=<a run of"
            " experiment=gait with this robot>"
        )
    return run_dir


def _resolved(config: DictConfig) -> dict:
    """A configuration as plain data."""
    try:
        return cast("dict", OmegaConf.to_container(config, resolve=True))
    except OmegaConfBaseException as error:
        message = one_line(error).partition(" full_key:")[0]
        if "robot.gait" in message:
            raise ConfigError(
                "robot.gait, or part of it, is missing, and rewards, observations or commands follow it; give it, with"
                " an offset for each foot, such as robot.gait={frequency: 2, offsets: [0, 0.5, 0.5, 0], duty: 0.5,"
                " foot_height: 0.1, lift: 1, lin_vel_x: [-1, 1], lin_vel_y: [-1, 1], ang_vel_z: [-1, 1]}, or choose"
                " another recipe (experiment=walk) or scenario"
            ) from None
        raise ConfigError(message.partition("raised while resolving interpolation: ")[2] or message) from None


def _sensor(preset: object, robot: RobotConfig, trust: Sequence[str] | None) -> SensorConfig:
    """A sensor on one of the robot's mounts."""
    from omniperception.env.sensing import SensorConfig

    if not isinstance(preset, dict):
        raise ConfigError(f"lidar={preset} must be a group of settings")
    settings = dict(preset)
    mount = settings.pop("mount", None)
    if isinstance(mount, str) and mount not in robot.mounts:
        raise ConfigError(f"lidar.mount={mount} is unknown; robot.mounts has {', '.join(robot.mounts) or 'none'}")
    mount = robot.mounts[mount] if isinstance(mount, str) else make(Mount, mount, "lidar.mount", trust)
    mounted = {"mount_pos": mount.pos, "mount_rpy": mount.rpy, "exclude_geoms": mount.exclude_geoms}
    if mount.body is not None:
        place = robot.place(mount)
        mounted |= {"mount_pos": place.pos, "mount_rpy": None, "mount_quat": place.quat, "mount_body": place.body}
    for name in settings.keys() & mounted.keys():
        raise ConfigError(f"lidar.{name} is unknown; a mount has it: lidar.mount=... or robot.mounts.<name>=...")
    return make(SensorConfig, settings | mounted, "lidar", trust)


def _families(given: object, trust: Sequence[str] | None) -> dict[str, Family]:
    """Families of worlds, each checked where its name can be said."""
    if given is not None and not isinstance(given, dict):
        raise DoesNotFit(f"families={given} must be a group of families by name, such as family=[corridor,hold]")
    families = {}
    for name, settings in (given or {}).items():
        if settings is None:  # left out
            continue
        try:
            if not isinstance(settings, dict):
                raise DoesNotFit("must be a group of settings")
            hints = types_of(Family)
            for key in settings:
                if key not in hints:
                    raise DoesNotFit(f"{key} is unknown; {suggest(str(key), tuple(hints))}")
            for key in ("obstacles", "commands"):
                if not settings.get(key):
                    raise DoesNotFit(f"lacks {key}; give families.{name}.{key}=..., as conf/family does")
            parts = {key: make(hints[key], value, key, trust) for key, value in settings.items()}
            families[name] = Family(**parts)
        except DoesNotFit as error:
            raise DoesNotFit(f"families.{name}: {one_line(error)}") from None
        except ValueError as error:
            raise ConfigError(f"families.{name}: {one_line(error)}") from None
    return families


def _logger(composed: dict, trust: Sequence[str] | None) -> LoggerConfig | None:
    """What logs a run."""
    return make(LoggerConfig, composed["logger"], "logger", trust) if composed["logger"] else None


def _names(value: object, navigates: bool) -> tuple[str, ...]:
    """Run directories of `init`: none, one, or one that perceives, perhaps one that navigates, and one that moves."""
    names = [] if value is None else value if isinstance(value, list) else [value]
    if not all(isinstance(name, str) for name in names):
        raise ConfigError(f"init={value} must be a run directory, a list of them, or null")
    if len(names) > 2 + navigates:
        most = "three at most, runs that perceive, navigate and move" if navigates else "two at most, a run that"
        raise ConfigError(f"init={value}: give {most}" + ("" if navigates else " perceives and one that moves"))
    return tuple(names)


def build_runner(run: RunConfig, log_dir: Path | None) -> Runner:
    """The environments, of all families where there are some, and what learns in them, seeded; each process of several
    with a seed of its own.

    A setting that only the compiled world can judge, such as a geom's name, is a ConfigError here.

    Args:
        run: the assembled configuration.
        log_dir: where TensorBoard files and checkpoints go; None writes nothing.
    """
    run = replace(run, env=replace(run.env, seed=run.env.seed + distributed.SEED_STRIDE * distributed.rank()))
    seed_everything(run.env.seed)
    try:
        env = MixedEnv(run.family_envs()) if run.families else OmniEnv(run.env)
        return Runner(env, learning_config(run, env), log_dir, str(env.device))
    except (ValueError, ImportError) as error:
        raise ConfigError(str(error)) from error


def check_split(run: RunConfig, what: str, run_dir: Path | None = None) -> None:
    """Refuses to show or train on obstacles of the test split, by which nothing may be chosen.

    Args:
        run: the configuration.
        what: would see them.
        run_dir: of a run that can be evaluated instead; None: the newest.

    Raises:
        ConfigError: it has them.
    """
    if run.env.obstacles.split != "dev":
        line = command_line("evaluate", "split=test", *(words_of(run_dir, run.composed) if run_dir else ()))
        raise ConfigError(
            f"obstacles.split={run.env.obstacles.split} is for reports, and no {what} may see it; use"
            f" obstacles.split=dev, or for a report: {line}"
        )


@dataclass(frozen=True)
class TrainedPolicy:
    """A run's newest policy and the environment to try it in.

    Attributes:
        env: at the start of its first trials, with all obstacles.
        policy: from observations to actions, without exploration noise.
        checkpoint: where the weights came from.
    """

    env: OmniEnv
    policy: Policy
    checkpoint: Path


def load_policy(run: RunConfig, run_dir: Path) -> TrainedPolicy:
    """The policy of the newest checkpoint in `run_dir`, in the environment of `run`.

    Raises:
        CheckpointError: there is none, or it does not fit.
    """
    checkpoint = latest_checkpoint(run_dir)
    runner = build_runner(replace(run, env=replace(run.env, skip_curricula=True, trials=True), families={}), None)
    runner.load_policy(checkpoint)
    return TrainedPolicy(runner.env, runner.policy, checkpoint)


def load_teacher(run_dir: Path, env: OmniEnv | MixedEnv, trust: Sequence[str] = ()) -> Teacher:
    """The blind policy of a run, to teach in an environment with the same observations; `trust` as `load_run` has it.

    Raises:
        ConfigError, CheckpointError: it perceives, or does not fit.
    """
    run, observations = load_run(run_dir, trust=trust), env.get_observations().clone(recurse=False)
    if run.perception is not None:
        raise ConfigError(f"distillation.teacher={run_dir} perceives; give a run of experiment=gait or walk")
    groups = run.env.observations.actor
    missing = sorted(set(groups) - set(observations.keys()))
    if missing:
        raise ConfigError(
            f"distillation.teacher={run_dir} reads the observations {', '.join(missing)}, which this run has not; give"
            " both the same preset of observations"
        )
    own = replace(env.config.observations, actor=list(groups))
    try:
        theirs = env.actor_inputs(run.env.observations)
    except UndeclaredQuantity as error:
        raise CheckpointError(
            f"distillation.teacher={run_dir} observes {error.name}, which nothing here reads; give both the same preset"
            " of observations"
        ) from None
    if reason := first_difference(env.actor_inputs(own), theirs):
        raise CheckpointError(
            f"distillation.teacher={run_dir} does not fit: {reason}; give both the same preset of observations"
        )
    estimated = run.env.observations.estimated
    if estimated and estimated not in observations:  # its number of values is all that is read
        values = env.actor_inputs(replace(run.env.observations, actor=[estimated]))
        observations[estimated] = torch.zeros(env.num_envs, len(values), device=env.device)
    with torch.random.fork_rng(devices=[]):  # learning draws as if nobody had taught
        estimator = EstimatorConfig(estimated) if estimated else None
        settings = LearningConfig(run.ppo, None, groups, (), estimator=estimator)
        actor = build_actor(observations, settings, env.num_actions).to(env.device)
    weights = load_checkpoint(latest_checkpoint(run_dir), str(env.device))["actor_state_dict"]
    reason = difference(actor.state_dict(), weights)
    if reason is not None:
        raise CheckpointError(
            f"distillation.teacher={run_dir} does not fit: {reason}; give both the same preset of observations and"
            " history"
        )
    actor.load_state_dict(weights)
    try:
        return Teacher(actor)
    except ValueError as error:
        raise ConfigError(f"{error}, to which V_avoid is added; give another run than {run_dir}") from None


def steps_per_frame(run: RunConfig) -> int:
    """Control steps between two LiDAR frames."""
    assert run.env.lidar is not None  # a network looks at its frames
    return max(1, round(run.env.lidar.period_s / run.env.sim.control_dt))


def learning_config(run: RunConfig, env: OmniEnv | MixedEnv) -> LearningConfig:
    """The runner that trains in the environment of a run."""
    return LearningConfig(
        run.ppo,
        run.perception,
        run.env.observations.actor,
        run.env.observations.critic,
        steps_per_frame(run) if run.perception is not None else 1,
        run.env.rewards.avoidance.risk,
        None if run.max_acceleration is None else run.max_acceleration * env.control_dt,
        Mirror(env) if run.ppo.symmetry else None,
        navigation=run.navigation,
        velocity_inputs=velocity_inputs(env) if run.navigation is not None and run.env.sim.has_legs else (),
        moves_joints=run.env.sim.has_legs,
        max_turn=0.0 if run.navigation is None else run.navigation.turn_acceleration * env.control_dt,
        estimator=EstimatorConfig(run.env.observations.estimated) if run.env.observations.estimated else None,
        distillation=run.distillation,
        logger=run.logger,
        settings=run.composed,
        task=run.task,
    )


def velocity_inputs(env: OmniEnv) -> tuple[VelocityInput, ...]:
    """Where the actor observes v_x, v_y and yaw rate of the present, as the base's own velocity.

    Raises:
        ValueError: it does not observe them.
    """
    found: dict[Callable, list[VelocityInput]] = {}
    for name in env.config.observations.actor:
        group, widths = env.config.observations.groups[name], env.observation_widths(name)
        column = (group.history - 1) * sum(widths.values())
        for term_name, term in group.terms.items():
            function, options = (term.func, term.keywords) if isinstance(term, partial) else (term, {})
            scale = options.get("scale", 1.0)
            found[function] = [VelocityInput(name, column + k, scale) for k in range(widths[term_name])]
            column += widths[term_name]
    linear, angular = found.get(base_lin_vel), found.get(base_ang_vel)
    if linear is None or angular is None:
        raise ValueError(
            "navigation reads the base's own velocity, and this policy observes none (base_lin_vel and base_ang_vel);"
            " use observations=gait"
        )
    return (*linear[:2], angular[2])


def seed_everything(seed: int) -> None:
    """Seeds the global generators; the task's own streams come from its configuration."""
    torch.manual_seed(seed)
    np.random.seed(seed % 2**32)
    random.seed(seed)
