"""rsl_rl's PPO on rollouts that share LiDAR frames, its update a list of phases."""

from __future__ import annotations

import torch
from rsl_rl.algorithms import PPO
from rsl_rl.env import VecEnv
from rsl_rl.models import MLPModel
from tensordict import TensorDict
from torch import nn

from omniperception.avoidance.velocity import AVOIDANCE_TARGET, LAST_ASKED
from omniperception.learning.config import LearningConfig
from omniperception.learning.distillation import Teacher
from omniperception.learning.divergence import DivergenceGuard
from omniperception.learning.models import PerceptionActor, build_actor
from omniperception.learning.phases import Distil, FitEstimator, FitPerception, Normalize, Phase, Ppo, WarmCritic
from omniperception.learning.storage import PerceptiveStorage
from omnirobot.common.errors import UserError


class RolloutTooSmall(UserError, ValueError):
    """There is too little in a rollout to learn from it."""


def check_rollout(num_envs: int, num_steps: int, num_mini_batches: int, has_frames: bool) -> None:
    """Refuses rollouts that leave a mini-batch without content; those with frames are of whole environments.

    Raises:
        RolloutTooSmall: one line says what to change.
    """
    available = num_envs if has_frames else num_envs * num_steps
    if available < num_mini_batches:
        what = "environments" if has_frames else f"steps ({num_envs} environments x {num_steps})"
        raise RolloutTooSmall(
            f"ppo.num_mini_batches={num_mini_batches} must not exceed the {available} {what} of a rollout;"
            " lower it or raise num_envs"
        )
    if num_envs * num_steps < 2:
        raise RolloutTooSmall(
            f"num_envs={num_envs} and ppo.num_steps_per_env={num_steps} make rollouts of one step, whose advantages"
            " have no spread to be divided by; raise one of them"
        )


class PerceptivePpo(PPO):
    """Rollouts, returns and checkpoints as rsl_rl's PPO has them, and an update that is a list of `phases`.

    Gradients are checked before each optimiser step and parameters after each update; a non-finite number raises
    :class:`~omniperception.learning.divergence.TrainingDiverged`, so weights are never overwritten with it.

    Attributes:
        config: what learns, and how.
        num_updates: completed updates.
        lessons: updates, the first ones, in which a teacher teaches.
        teacher: that does.
        learns_policy: whether policy and critic learn; otherwise they stay, and perception learns alone.
        is_new: whether the policy begins with weights of its own, not with another run's.
        fitting: phases with an optimiser of their own, by the name under which a checkpoint has it.
    """

    storage: PerceptiveStorage
    learning_rate: float
    schedule: str

    def __init__(self, env: VecEnv, config: LearningConfig, device: str, multi_gpu: dict | None = None) -> None:
        """Models, storage and optimisers for an environment.

        Args:
            env: the environments.
            config: what learns, and how.
            device: of models and storage.
            multi_gpu: rsl_rl's ``multi_gpu_cfg``; None for a single process.
        """
        ppo, obs = config.ppo, env.get_observations()
        for name, used in (("actor", config.actor_groups), ("critic", config.critic_groups)):
            if not used:
                raise ValueError(f"observations.{name} is empty; name at least one group of observations")
        if config.mirror is not None and config.perception is not None:
            raise ValueError(
                "ppo.symmetry works on one-dimensional observations only; with perception set ppo.symmetry=false"
            )
        actor = build_actor(obs, config, env.num_actions).to(device)
        of_critic = ppo.mlp | ({"obs_normalization": True} if config.navigation is not None else {})
        critic = MLPModel(obs, {"critic": list(config.critic_groups)}, "critic", 1, **of_critic).to(device)
        storage = PerceptiveStorage(
            env.num_envs,
            ppo.num_steps_per_env,
            obs,
            _stored_groups(config),
            env.num_actions,
            device,
            frames=config.perception is not None,
            steps_per_frame=config.steps_per_frame,
        )
        symmetry = {"env": env, "data_augmentation_func": config.mirror, "use_data_augmentation": True}
        super().__init__(
            actor,
            critic,
            storage,
            device=device,
            symmetry_cfg=symmetry if config.mirror is not None else None,
            multi_gpu_cfg=multi_gpu,
            **ppo.algorithm,
        )
        self.config, self.num_updates, self.is_new = config, 0, True
        self.learns_policy = ppo.num_learning_epochs > 0
        self.lessons = config.distillation.iterations if config.distillation is not None else 0
        self.teacher: Teacher | None = None
        groups = [{"params": parameters} for parameters in self.policy_and_critic().values()]
        if ppo.critic_learning_rate is None:
            groups = [{"params": [p for group in groups for p in group["params"]]}]
        self.optimizer = torch.optim.Adam(groups, lr=self.learning_rate, fused=True)  # rsl_rl's is not fused
        self.set_learning_rate(self.learning_rate)
        self.guard = DivergenceGuard(self)
        self.fitting: dict[str, Phase] = {}
        if config.perception is not None and config.perception.supervised_epochs > 0:
            self.fitting["perception"] = FitPerception(self)
        if config.estimator is not None and self.learns_policy:
            self.fitting["estimator"] = FitEstimator(self)
        self.fitting |= {name: make(self) for name, make in ppo.phases.items()}

    def phases(self) -> list[Phase]:
        """What the next update does, in this order."""
        perception, estimator = (self.fitting.get(name) for name in ("perception", "estimator"))
        own = [phase for name, phase in self.fitting.items() if name not in ("perception", "estimator")]
        if not self.learns_policy:
            policy = []
        elif self.num_updates < self.lessons:
            policy = [Distil(self), Normalize(self)]
        elif self.num_updates < self.config.ppo.critic_warmup:
            policy = [WarmCritic(self), Normalize(self)]
        else:
            policy = [Ppo(self), Normalize(self)]
        # PPO sees the embeddings and the estimates that the policy acted on, not newer ones
        return [phase for phase in (perception, *policy, estimator, *own) if phase is not None]

    def update(self) -> dict[str, float]:
        """Learns from a full rollout; mean losses, among them those of the supervised targets."""
        ppo, losses = self.config.ppo, dict[str, float]()
        self.guard.start(self.num_updates)
        self.entropy_coef = self.annealed(ppo.entropy_coef, ppo.final_entropy_coef)
        self.desired_kl = self.annealed(ppo.desired_kl, ppo.final_desired_kl)
        for phase in self.phases():
            losses |= phase.update(self.storage)
        self.storage.clear()
        self.num_updates += 1
        self.guard.check_learning(losses)
        if isinstance(self.actor, PerceptionActor):
            losses |= self.actor.pop_supervised_losses()
        self.guard.check_parameters()
        self.actor.reset()  # what it has embedded, it embedded with other weights
        return losses

    def act(self, obs: TensorDict) -> torch.Tensor:
        """Sample actions; LiDAR frames are copied now because the environment may reuse their memory."""
        actions = super().act(obs)
        if self.storage.has_frames:
            fixed = "perception" in self.fitting and self.learns_policy
            self.storage.record_frames(obs, self.actor.tick, self.actor.newest if fixed else None)
        return actions

    def annealed(self, first: float, last: float | None) -> float:
        """A setting that changes evenly from `first` to `last` until ppo.max_iterations; None: it stays."""
        share = min(self.num_updates / self.config.ppo.max_iterations, 1.0)
        return first if last is None else first + (last - first) * share

    def policy_and_critic(self) -> dict[str, list[nn.Parameter]]:
        """Parameters of both."""
        return {"actor": list(self.actor.parameters()), "critic": list(self.critic.parameters())}

    def precision(self) -> torch.autocast:
        """In which losses are computed: bfloat16 where ppo.mixed_precision asks for it."""
        return torch.autocast(torch.device(self.device).type, torch.bfloat16, enabled=self.use_mixed_precision)

    def set_learning_rate(self, learning_rate: float) -> None:
        """Of the next steps of policy and critic, but for a critic with a rate of its own."""
        rates = (learning_rate, self.config.ppo.critic_learning_rate)
        for group, rate in zip(self.optimizer.param_groups, rates, strict=False):
            group["lr"] = rate

    def is_first_of_pretrained(self) -> bool:
        """Whether this is PPO's first update of a policy that is another run's, has been taught or has waited."""
        first = max(self.config.ppo.critic_warmup, self.lessons)
        return self.num_updates == first and (first > 0 or not self.is_new)

    def learn_from(self, teacher: Teacher) -> None:
        """Lets a teacher teach the first updates.

        Raises:
            ValueError: it reads what the rollouts of this run do not hold.
        """
        missing = sorted(set(teacher.groups) - set(self.storage.stored_groups))
        if missing:
            raise ValueError(
                f"distillation.teacher reads the observations {', '.join(missing)}, which neither actor nor critic of"
                " this run does; give both the same preset of observations"
            )
        self.teacher = teacher

    def check_rollout(self) -> None:
        """Refuse rollouts that leave a mini-batch without content."""
        storage = self.storage
        check_rollout(storage.num_envs, storage.num_transitions_per_env, self.num_mini_batches, storage.has_frames)

    def save(self) -> dict:
        """States of the networks and of the optimisers."""
        state = super().save() | {"learning_rate": self.learning_rate, "num_updates": self.num_updates}
        return state | {_key(name): phase.optimizer.state_dict() for name, phase in self.fitting.items()}

    def load(self, state: dict, load_cfg: dict | None = None, strict: bool = True) -> bool:
        """Load what :meth:`save` returned; all of it, or the actor alone with ``load_cfg={"actor": True}``."""
        configured = self.learning_rate
        super().load(state, load_cfg, strict)
        self.actor.reset()
        if load_cfg is not None:
            return False
        for name, phase in self.fitting.items():
            if _key(name) in state:  # otherwise it begins here
                phase.optimizer.load_state_dict(state[_key(name)])
        self.num_updates = state["num_updates"]
        self.learning_rate = configured if self.schedule == "fixed" else state["learning_rate"]
        return True


def _key(name: str) -> str:
    """Under which a checkpoint has the optimiser of a phase."""
    return f"{name}_optimizer_state_dict"


def _stored_groups(config: LearningConfig) -> list[str]:
    """One-dimensional groups of observations that a model or a loss reads."""
    stored = {*config.actor_groups, *config.critic_groups}
    if config.perception is not None:
        stored |= set(config.perception.supervision)
    if config.max_change is not None:
        stored.add(LAST_ASKED)
    if config.estimator is not None:
        stored.add(config.estimator.group)
    if config.distillation is not None:
        stored.add(AVOIDANCE_TARGET)
    return sorted(stored)
