"""Settings of the perception network and of PPO."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from rsl_rl.utils import resolve_nn_activation

from omniperception.avoidance.velocity import AVOIDANCE_TARGET, MOTION_TARGET, SECTOR_TARGET
from omniperception.avoidance.velocity_risk import VelocityRisk
from omniperception.common.checked import AtLeastOne, Count, NonNegative, Positive, Share, Widths, checked
from omniperception.env.config import HEIGHT_TARGET
from omniperception.env.odometry import TimedOdometry
from omniperception.learning.distillation import DistillationConfig
from omniperception.learning.estimator import EstimatorConfig
from omniperception.learning.log_writers import LoggerConfig
from omniperception.learning.navigation import NavigationConfig, VelocityInput
from omniperception.perception import PerceptionNetwork, Sampler


@checked("perception")
class PerceptionConfig:
    """Configuration of the actor's perception.

    Attributes:
        sampler: makes the sampler that reduces one frame to points.
        network: makes the network that embeds a history of frames, given the sampler's ``sizes`` and the ``history``.
        history: LiDAR frames that the network sees.
        height_weight: weight of the height supervision in the loss; 0 leaves it out.
        sector_weight: weight of the supervision with obstacle nearness by sector; 0, as in the paper, leaves it out.
        avoidance_weight: weight of the supervision of an avoidance velocity that is added to the command which the
            actor follows; 0, as in the paper, leaves it out.
        motion_weight: weight of the supervision of how near obstacles are and how they move, by sector; the velocity
            that is added follows from the risk of velocities among them instead; 0, as in the paper, leaves it out.
        supervised_epochs: passes over each rollout in which the network is trained by supervision alone, while PPO
            takes the embedding as it is; 0, as in the paper: PPO's loss and the supervision together, end to end.
        learning_rate: of those passes.
        final_learning_rate: what it falls to, linearly, until ppo.max_iterations; None keeps it.
        base_motion: whether a frame's last row says how the base moved since the frame before (x, y, yaw), from the
            state estimator.
        frame_times: whether frames bear the time at which they were taken, as those of most devices do: what is late is
            put where it was, and its age is known. It needs `base_motion`, and a network that reads three rows more.
    """

    sampler: Callable[[], Sampler]
    network: Callable[..., PerceptionNetwork]
    history: AtLeastOne
    height_weight: NonNegative
    sector_weight: NonNegative
    avoidance_weight: NonNegative = 0.0
    motion_weight: NonNegative = 0.0
    supervised_epochs: Count = 0
    learning_rate: Positive = 1.0e-3
    final_learning_rate: Positive | None = None
    base_motion: bool = False
    frame_times: bool = False

    def __post_init__(self) -> None:
        if self.frame_times and not self.base_motion:
            raise ValueError("perception.frame_times=true needs perception.base_motion=true")
        if self.avoidance_weight and self.motion_weight:
            raise ValueError(
                f"perception.avoidance_weight={self.avoidance_weight} and motion_weight={self.motion_weight} would both"
                " change the command; set one of them to 0"
            )
        if self.final_learning_rate is not None and self.final_learning_rate > self.learning_rate:
            raise ValueError(
                f"perception.final_learning_rate={self.final_learning_rate} must lie in (0, {self.learning_rate}], or"
                " be null"
            )
        if self.supervised_epochs and not self.supervision:
            raise ValueError(
                f"perception.supervised_epochs={self.supervised_epochs} needs something to learn from; set"
                " perception.avoidance_weight, motion_weight, sector_weight or height_weight, or supervised_epochs=0"
            )

    def build_network(self) -> PerceptionNetwork:
        """The network that fits the sampler's points and the history."""
        sizes = dict(self.sampler().sizes)
        sizes[[name for name, number in sizes.items() if number][-1]] += self.num_rows  # to the last part that there is
        try:
            return self.network(**sizes, history=self.history)
        except TypeError as error:
            raise ValueError(f"perception.network does not fit the sampler, which gives {sizes}: {error}") from None

    @property
    def num_rows(self) -> int:
        """Rows of a frame beside its points: how the base moved, and where frames bear their times what those give."""
        return TimedOdometry.num_rows if self.frame_times else int(self.base_motion)

    @property
    def supervision(self) -> dict[str, float]:
        """Weight of each supervised target, by observation group."""
        weights = {
            HEIGHT_TARGET: self.height_weight,
            SECTOR_TARGET: self.sector_weight,
            AVOIDANCE_TARGET: self.avoidance_weight,
            MOTION_TARGET: self.motion_weight,
        }
        return {target: weight for target, weight in weights.items() if weight > 0}


@checked("ppo")
class PPOConfig:
    """PPO after the paper's Table 'PPO Hyperparameters'.

    Attributes:
        max_iterations: iterations at which training ends.
        max_minutes: wall time (min) after which it ends, over all resumptions; None for no limit.
        save_interval: iterations between checkpoints.
        keep_checkpoints: how many of the newest checkpoints stay.
        num_steps_per_env: control steps per environment and iteration.
        num_learning_epochs: passes of PPO over a rollout; 0 keeps the policy as it is, and perception learns alone.
        hidden_dims: hidden layers of the actor and of the critic.
        init_std: initial standard deviation of the actions.
        start_std: standard deviation of the actions with which a policy that starts from another run's weights (init=)
            explores; None: what it had there, with which a finished one learns nothing new (docs/lab/end_to_end.md).
        obs_normalization: whether observations are normalised by running statistics.
        mixed_precision: whether updates multiply matrices in bfloat16, which takes half to 1.6 times as long, by the
            CPU; None, in files of older runs: no.
        critic_warmup: iterations at the beginning in which only the critic learns, for a policy that starts from
            another run's weights (init=): advantages by a critic that knows nothing destroy it. Those in which a
            teacher teaches (`distillation`) are among them: there the critic learns as well.
        critic_learning_rate: of the critic's steps, which stay so; None: they are the policy's, which an adaptive
            schedule makes as small as its trust region asks for (docs/lab/negative.md, "PPO on top").
        final_entropy_coef: what entropy_coef changes to, linearly, until max_iterations; None: it stays as it is.
        final_desired_kl: what desired_kl changes to, likewise: smaller steps at the end.
        symmetry: whether updates see every sample's left-right mirror image, too (a blind policy only).
        phases: of one's own, after the others of every update, by name: each makes a :class:`Phase` of the algorithm.
            Those named perception or estimator take the place of what fits these.
        The others are rsl_rl's PPO arguments.
    """

    max_iterations: AtLeastOne
    max_minutes: Positive | None
    save_interval: AtLeastOne
    keep_checkpoints: AtLeastOne
    num_steps_per_env: AtLeastOne
    num_learning_epochs: Count
    num_mini_batches: AtLeastOne
    clip_param: Positive
    gamma: Share
    lam: Share
    learning_rate: Positive
    schedule: Literal["adaptive", "fixed"]
    desired_kl: Positive
    value_loss_coef: NonNegative
    use_clipped_value_loss: bool
    entropy_coef: NonNegative
    max_grad_norm: Positive
    hidden_dims: Widths
    activation: str
    init_std: Positive
    obs_normalization: bool
    start_std: Positive | None = None
    mixed_precision: bool | None = False
    final_entropy_coef: NonNegative | None = None
    final_desired_kl: Positive | None = None
    critic_warmup: Count = 0
    critic_learning_rate: Positive | None = None
    symmetry: bool = False
    phases: Mapping[str, Callable[..., Any]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.final_desired_kl is not None and self.schedule != "adaptive":
            raise ValueError("ppo.final_desired_kl is for ppo.schedule=adaptive; give one of them")
        try:
            resolve_nn_activation(self.activation)
        except ValueError as error:
            raise ValueError(f"ppo.activation={self.activation} is unknown: {error}") from None

    @property
    def mlp(self) -> dict[str, Any]:
        """Arguments of rsl_rl's `MLPModel` for the actor and for the critic."""
        return {
            "hidden_dims": list(self.hidden_dims),
            "activation": self.activation,
            "obs_normalization": self.obs_normalization,
        }

    @property
    def algorithm(self) -> dict[str, Any]:
        """Arguments of rsl_rl's `PPO`."""
        return {name: getattr(self, name) for name in _RSL_RL} | {"use_mixed_precision": bool(self.mixed_precision)}


_RSL_RL = (
    "num_learning_epochs",
    "num_mini_batches",
    "clip_param",
    "gamma",
    "lam",
    "learning_rate",
    "schedule",
    "desired_kl",
    "value_loss_coef",
    "use_clipped_value_loss",
    "entropy_coef",
    "max_grad_norm",
)
"""Fields of :class:`PPOConfig` that are arguments of rsl_rl's `PPO` under the same name."""


@dataclass(frozen=True)
class LearningConfig:
    """Configuration of a runner.

    Attributes:
        ppo: learning settings.
        perception: the actor's view of the LiDAR; None for a blind policy.
        actor_groups: observation groups of the actor.
        critic_groups: observation groups of the critic.
        steps_per_frame: control steps between two LiDAR frames.
        velocity_risk: the controller of a policy that is supervised with obstacles' motion, else None.
        max_change: most (m/s) by which V_cmd + V_avoid of a policy that adds V_avoid changes from step to step; None:
            no limit.
        mirror: rsl_rl's `data_augmentation_func`, which adds mirror images to samples, or None.
        estimator: of what the actor does not observe; None: it estimates nothing.
        navigation: of a policy that asks a gait for velocities; None: it moves joints.
        velocity_inputs: where the policy observes the velocity that navigation reads; none where it has a group of its
            own.
        max_turn: most (rad/s) by which the yaw rate that navigation asks for changes from step to step.
        moves_joints: whether actions are joints'; otherwise they are the velocities that navigation asks for.
        distillation: of a teacher, which :meth:`PerceptivePpo.learn_from` gives; None: there is none.
        logger: where scalars go; None: nowhere.
        settings: the run's composed configuration, for what is logged.
        task: the part of it that says what the environments are; a checkpoint of another task begins new episodes.
    """

    ppo: PPOConfig
    perception: PerceptionConfig | None
    actor_groups: Sequence[str]
    critic_groups: Sequence[str]
    steps_per_frame: int = 1
    velocity_risk: VelocityRisk | None = None
    max_change: float | None = None
    mirror: Callable | None = None
    estimator: EstimatorConfig | None = None
    navigation: NavigationConfig | None = None
    velocity_inputs: Sequence[VelocityInput] = ()
    max_turn: float = 0.0
    moves_joints: bool = True
    distillation: DistillationConfig | None = None
    logger: LoggerConfig | None = field(default_factory=LoggerConfig)
    settings: Mapping[str, Any] = field(default_factory=dict)
    task: Mapping[str, Any] = field(default_factory=dict)
