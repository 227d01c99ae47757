"""PPO with shared LiDAR frames, supervised perception and a stop at the first non-finite number."""

from __future__ import annotations

import torch
from rsl_rl.algorithms import PPO
from rsl_rl.env import VecEnv
from rsl_rl.extensions import Symmetry
from rsl_rl.models import MLPModel
from rsl_rl.storage import RolloutStorage
from tensordict import TensorDict
from torch import nn
from torch.nn import functional

from omniperception.avoidance.velocity import AVOIDANCE_TARGET, LAST_ASKED
from omniperception.learning import distributed
from omniperception.learning.config import LearningConfig
from omniperception.learning.distillation import DistillationConfig, Teacher
from omniperception.learning.divergence import DivergenceGuard
from omniperception.learning.estimator import EstimatingModel
from omniperception.learning.models import PerceivingNavigator, PerceptionActor
from omniperception.learning.navigation import NavigationActor
from omniperception.learning.storage import Embedded, PerceptiveStorage, WindowedObservations
from omnirobot.common.errors import UserError

ESTIMATOR_LEARNING_RATE = 1.0e-3
"""Of the estimator's own optimiser, which passes over each rollout once."""
FIRST_LEARNING_RATE = 1.0e-5
"""Of an adaptive schedule's first update of a policy that can do something already; rsl_rl's least."""


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


class RolloutTooSmall(UserError, ValueError):
    """There is too little in a rollout to learn from it."""


class MirrorImages(Symmetry):
    """rsl_rl's mirror images of samples, without the mirror loss, which it only reports, in a fifth of an update."""

    def compute_loss(self, actor: MLPModel, batch: RolloutStorage.Batch, original_batch_size: int) -> torch.Tensor:
        return batch.actions.new_zeros(())


class PerceptivePpo(PPO):
    """rsl_rl's PPO on a :class:`PerceptiveStorage`.

    A perception network that is not trained end to end learns by supervision alone, a few epochs on the frames of each
    rollout, with an optimiser of its own; PPO takes its embedding as a fixed observation. A supervised network learns
    with far larger steps than the trust region of a policy allows, and PPO's epochs need not pass through it. With
    ``num_learning_epochs=0`` the policy stays as it is and perception learns alone.

    Gradients are checked before each optimiser step and parameters after each update; a non-finite number raises
    :class:`~omniperception.learning.divergence.TrainingDiverged`, so weights are never overwritten with it.

    Attributes:
        num_updates: completed updates.
        critic_warmup: number of updates, the first ones, in which of policy and critic only the critic learns.
        distillation: of how many updates a teacher teaches the actor instead of PPO, and how; None: of none.
        teacher: that does.
        learns_policy: whether PPO changes the policy.
        is_new: whether the policy begins with weights of its own, not with another run's.
        perception_optimizer: of the perception network and its read-out; None where PPO trains them, or there is none.
        estimator_optimizer: of the actor's estimator; None where there is none, or it stays as it is.
    """

    storage: PerceptiveStorage
    entropy_coef: float
    learning_rate: float
    schedule: str
    perception_optimizer: torch.optim.Adam | None = None
    estimator_optimizer: torch.optim.Adam | None = None
    distillation: DistillationConfig | None
    teacher: Teacher | None = None

    def __init__(self, *args, critic_learning_rate: float | None = None, **kwargs) -> None:
        """Arguments of rsl_rl's PPO, and the critic's own learning rate; None: it takes the policy's steps."""
        super().__init__(*args, **kwargs)
        if kwargs.get("symmetry_cfg") is not None:
            self.symmetry: Symmetry | None = MirrorImages(**kwargs["symmetry_cfg"])
        self.num_updates = 0
        self._annealed: dict[str, tuple[float, float, int]] = {}
        self.critic_warmup, self.distillation, self.is_new = 0, None, True
        self.learns_policy = self.num_learning_epochs > 0
        own = critic_learning_rate is not None
        parts = [[self.actor], [self.critic]] if own else [[self.actor, self.critic]]
        groups = [{"params": [p for model in part for p in model.parameters()]} for part in parts]
        self.optimizer = torch.optim.Adam(groups, lr=self.learning_rate, fused=True)  # rsl_rl's is not fused
        if own:  # rsl_rl sets the rate of all groups
            self.optimizer.register_step_pre_hook(lambda adam, *_: adam.param_groups[1].update(lr=critic_learning_rate))
        self.guard = DivergenceGuard(self)

    @classmethod
    def build(cls, env: VecEnv, config: LearningConfig, device: str, multi_gpu: dict | None = None) -> PerceptivePpo:
        """Models, storage and algorithm for an environment.

        Args:
            env: the environments.
            config: what learns, and how.
            device: of models and storage.
            multi_gpu: rsl_rl's ``multi_gpu_cfg``; None for a single process.
        """
        ppo, perception, obs = config.ppo, config.perception, env.get_observations()
        groups = {"actor": list(config.actor_groups), "critic": list(config.critic_groups)}
        for name, used in groups.items():
            if not used:
                raise ValueError(f"observations.{name} is empty; name at least one group of observations")
        distribution = {"class_name": "GaussianDistribution", "init_std": ppo.init_std}
        if config.navigation is not None and perception is None:
            actor = NavigationActor(
                obs,
                groups,
                "actor",
                env.num_actions,
                navigation=config.navigation,
                distribution_cfg=distribution,
                **ppo.mlp,
            )
        elif perception is None:
            actor = EstimatingModel(
                obs,
                groups,
                "actor",
                env.num_actions,
                config.estimator,
                distribution_cfg=distribution,
                **ppo.mlp,
            )
        elif config.mirror is not None:
            raise ValueError(
                "ppo.symmetry works on one-dimensional observations only; with perception set ppo.symmetry=false"
            )
        else:
            actor = (PerceptionActor if config.moves_joints else PerceivingNavigator)(
                obs,
                groups,
                "actor",
                env.num_actions,
                perception.build_network(),
                perception.supervision,
                config.velocity_risk,
                navigation=config.navigation,
                velocity_inputs=config.velocity_inputs,
                max_turn=config.max_turn,
                max_change=config.max_change,
                end_to_end=perception.supervised_epochs == 0,
                estimator=config.estimator,
                distribution_cfg=distribution,
                **ppo.mlp,
            )
        actor = actor.to(device)
        of_critic = ppo.mlp | ({"obs_normalization": True} if config.navigation is not None else {})
        critic = MLPModel(obs, groups, "critic", 1, **of_critic).to(device)
        stored = {*config.actor_groups, *config.critic_groups, *(perception.supervision if perception else ())}
        if config.max_change is not None:
            stored.add(LAST_ASKED)
        if config.estimator is not None:
            stored.add(config.estimator.group)
        if config.distillation is not None:
            stored.add(AVOIDANCE_TARGET)
        storage = PerceptiveStorage(
            env.num_envs,
            ppo.num_steps_per_env,
            obs,
            sorted(stored),
            env.num_actions,
            device,
            frames=perception is not None,
            steps_per_frame=config.steps_per_frame,
        )
        symmetry = {"env": env, "data_augmentation_func": config.mirror, "use_data_augmentation": True}
        algorithm = cls(
            actor,
            critic,
            storage,
            device=device,
            symmetry_cfg=symmetry if config.mirror is not None else None,
            multi_gpu_cfg=multi_gpu,
            critic_learning_rate=ppo.critic_learning_rate,
            **ppo.algorithm,
        )
        for name, final in (("entropy_coef", ppo.final_entropy_coef), ("desired_kl", ppo.final_desired_kl)):
            if final is not None:
                algorithm.anneal(name, final, ppo.max_iterations)
        algorithm.critic_warmup, algorithm.distillation = ppo.critic_warmup, config.distillation
        if config.estimator is not None and algorithm.learns_policy:
            algorithm.fit_estimator()
        if perception is not None and perception.supervised_epochs > 0:
            last = perception.final_learning_rate or perception.learning_rate
            algorithm.supervise_perception(
                perception.supervised_epochs, (perception.learning_rate, last), ppo.max_iterations
            )
        return algorithm

    def supervise_perception(self, epochs: int, learning_rates: tuple[float, float], num_updates: int) -> None:
        """Let supervision alone train the perception network.

        Args:
            epochs: passes over a rollout.
            learning_rates: of the first and of the last update, linear between them.
            num_updates: updates after which the last learning rate holds.
        """
        self._supervision = epochs, learning_rates, num_updates
        self._perception_parameters = list(self.actor.perception_parameters())
        self.perception_optimizer = torch.optim.Adam(self._perception_parameters, lr=learning_rates[0])

    def act(self, obs: TensorDict) -> torch.Tensor:
        """Sample actions; LiDAR frames are copied now because the environment may reuse their memory."""
        actions = super().act(obs) if self.learns_policy else self._act_without_value(obs)
        if self.storage.has_frames:
            self.storage.record_frames(obs, self.actor.tick)
        return actions

    def compute_returns(self, obs: TensorDict) -> None:
        """As rsl_rl's, for a policy that learns."""
        if self.learns_policy:
            super().compute_returns(obs)

    def update(self) -> dict[str, float]:
        """Learn from a full rollout; mean losses, among them those of the supervised targets."""
        self.guard.start(self.num_updates)
        for name, (first, last, num_updates) in self._annealed.items():
            setattr(self, name, first + (last - first) * min(self.num_updates / num_updates, 1.0))
        if self.perception_optimizer is not None:
            acted_on = self._embed_rollout() if self.learns_policy else None
            self.train_perception()
            self.storage.acted_on = acted_on  # PPO sees what the policy acted on
        losses = {}
        if self.learns_policy:
            losses = self._update_policy()
            losses |= self.train_estimator()  # afterwards: PPO saw what the policy acted on
        else:
            self.storage.clear()
        self.num_updates += 1
        self.guard.check_learning(losses)
        if isinstance(self.actor, PerceptionActor):
            losses |= self.actor.pop_supervised_losses()
        self.guard.check_parameters()
        self.actor.reset()  # what it has embedded, it embedded with other weights
        return losses

    def _update_policy(self) -> dict[str, float]:
        """rsl_rl's update, while the critic warms up without the actor; first of all a teacher's lessons."""
        if self.distillation is not None and self.num_updates < self.distillation.iterations:
            return self._imitate(self.distillation.learning_rate)
        if self.num_updates >= self.critic_warmup:
            if self._is_first_ppo_update_of_pretrained() and self.schedule == "adaptive":
                self.learning_rate = FIRST_LEARNING_RATE  # a larger step leaves the trust region
            return super().update()
        schedule = self.schedule
        self.schedule = "fixed"  # a policy that stays would have its steps grow without end
        self.actor.requires_grad_(False)
        try:
            return super().update()
        finally:
            self.schedule = schedule
            self.actor.requires_grad_(True)

    def _is_first_ppo_update_of_pretrained(self) -> bool:
        """Whether this is PPO's first update of a policy that is another run's, has been taught or has waited."""
        lessons = self.distillation.iterations if self.distillation is not None else 0
        return self.num_updates == max(self.critic_warmup, lessons) and (self.num_updates > 0 or not self.is_new)

    def _step_by(self, learning_rate: float) -> None:
        """Gives the optimiser a rate, where rsl_rl does not give it `learning_rate` in an update."""
        for group in self.optimizer.param_groups:
            group["lr"] = learning_rate

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

    def _imitate(self, learning_rate: float) -> dict[str, float]:
        """Fits the actor to what the teacher would have done where the actor was, and the critic to the returns."""
        if self.teacher is None:
            raise RuntimeError("distillation needs a teacher: learn_from")
        self._step_by(learning_rate)
        device_type, losses = torch.device(self.device).type, []
        for batch in self.storage.mini_batch_generator(self.num_mini_batches, self.num_learning_epochs):
            obs = batch.observations
            wanted = self.teacher.actions(obs.groups if isinstance(obs, WindowedObservations) else obs)
            with torch.autocast(device_type, dtype=torch.bfloat16, enabled=self.use_mixed_precision):
                error = functional.mse_loss(self.actor(obs), wanted)
                value_error = functional.mse_loss(self.critic(obs), batch.returns)
                loss = error + self.value_loss_coef * value_error
            self.optimizer.zero_grad()
            loss.backward()
            for model in (self.actor, self.critic):
                distributed.average_gradients(list(model.parameters()))
                nn.utils.clip_grad_norm_(model.parameters(), self.max_grad_norm)
            self.optimizer.step()
            losses.append(torch.stack((error.detach(), value_error.detach())))
        observed = self.storage.observations.flatten(0, 1)
        self.actor.update_normalization(observed)
        self.critic.update_normalization(observed)
        self.storage.clear()
        self._step_by(self.learning_rate)
        imitation, value = torch.stack(losses).mean(0).tolist()
        return {"imitation": imitation, "value": value}

    def train_perception(self) -> None:
        """Fit the supervised targets on the frames of a rollout; one without a frame teaches nothing.

        Each frame is compared with the targets of the first control step of the rollout that sees it: of those when it
        was cast, or, for the frame that a rollout begins with, of up to a frame's period later.
        """
        optimizer = self.perception_optimizer
        if optimizer is None:  # PPO trains it, or there is none
            return
        epochs, (first, last), num_updates = self._supervision
        for group in optimizer.param_groups:
            group["lr"] = first + (last - first) * min(self.num_updates / num_updates, 1.0)
        device_type = torch.device(self.device).type
        for _ in range(epochs):
            for env_ids in self.storage.shuffled_envs(self.num_mini_batches):
                obs = self.storage.observations_of(env_ids, self.storage.first_steps)
                if distributed.mean(float(obs.has_frames), self.device) < 1.0:  # all processes take a step, or none
                    continue
                with torch.autocast(device_type, dtype=torch.bfloat16, enabled=self.use_mixed_precision):
                    loss = self.actor.supervised_loss(self.actor.embed(obs), obs)
                optimizer.zero_grad()
                loss.backward()
                distributed.average_gradients(self._perception_parameters)
                nn.utils.clip_grad_norm_(self._perception_parameters, self.max_grad_norm)
                self.guard.check_gradients("perception network", self._perception_parameters)
                optimizer.step()

    def anneal(self, name: str, final: float, num_updates: int) -> None:
        """Let one of rsl_rl's settings change evenly to `final` within `num_updates` updates."""
        self._annealed[name] = (getattr(self, name), final, num_updates)

    def fit_estimator(self) -> None:
        """Let the truth train the actor's estimator."""
        self._estimator_parameters = list(self.actor.estimator.parameters())
        self.estimator_optimizer = torch.optim.Adam(self._estimator_parameters, lr=ESTIMATOR_LEARNING_RATE)

    def train_estimator(self) -> dict[str, float]:
        """Fit the estimates on the steps of a rollout and their mirror images; the mean squared error."""
        optimizer = self.estimator_optimizer
        if optimizer is None:
            return {}
        groups, losses = self.storage.observations.flatten(0, 1), []
        for steps in torch.randperm(len(groups), device=self.device).tensor_split(self.num_mini_batches):
            obs = groups[steps]
            if self.symmetry is not None:
                obs, _ = self.symmetry.data_augmentation_func(self.symmetry.env, obs, None)
            loss = self.actor.estimation_error(obs)
            optimizer.zero_grad()
            loss.backward()
            distributed.average_gradients(self._estimator_parameters)
            self.guard.check_gradients("estimator", self._estimator_parameters)
            optimizer.step()
            losses.append(loss.detach())
        return {"estimate": torch.stack(losses).mean().item()}

    def save(self) -> dict:
        """States of the networks and of the optimisers."""
        state = super().save()
        if self.perception_optimizer is not None:
            state["perception_optimizer_state_dict"] = self.perception_optimizer.state_dict()
        if self.estimator_optimizer is not None:
            state["estimator_optimizer_state_dict"] = self.estimator_optimizer.state_dict()
        return state | {"learning_rate": self.learning_rate, "num_updates": self.num_updates}

    def load(self, state: dict, load_cfg: dict | None = None, strict: bool = True) -> bool:
        """Load what :meth:`save` returned; all of it, or the actor alone with ``load_cfg={"actor": True}``."""
        configured = self.learning_rate
        super().load(state, load_cfg, strict)
        self.actor.reset()
        if load_cfg is not None:
            return False
        supervised = state.get("perception_optimizer_state_dict")  # None: perception was not supervised before
        if self.perception_optimizer is not None and supervised is not None:
            self.perception_optimizer.load_state_dict(supervised)
        if self.estimator_optimizer is not None:
            self.estimator_optimizer.load_state_dict(state["estimator_optimizer_state_dict"])
        self.num_updates = state["num_updates"]
        self.learning_rate = configured if self.schedule == "fixed" else state["learning_rate"]
        self._step_by(self.learning_rate)
        return True

    def check_rollout(self) -> None:
        """Refuse rollouts that leave a mini-batch without content."""
        storage = self.storage
        check_rollout(storage.num_envs, storage.num_transitions_per_env, self.num_mini_batches, storage.has_frames)

    def _act_without_value(self, obs: TensorDict) -> torch.Tensor:
        """As rsl_rl's `act`, for a policy that does not learn: nothing is valued."""
        transition = self.transition
        transition.observations = obs
        transition.actions = self.actor(obs, stochastic_output=True).detach()
        transition.values = torch.zeros(len(obs), 1, device=self.device)
        transition.actions_log_prob = torch.zeros(len(obs), device=self.device)
        transition.distribution_params = tuple(p.detach() for p in self.actor.output_distribution_params)
        return transition.actions

    def _embed_rollout(self) -> Embedded | None:
        """What the policy acted on, in as many parts as there are mini-batches; None without a frame."""
        storage = self.storage
        if not storage.frame_count.any():
            return None
        parts = torch.arange(storage.num_envs, device=self.device).tensor_split(self.num_mini_batches)
        with torch.no_grad():
            windows = torch.cat([self.actor.embed_windows(storage.observations_of(part)) for part in parts])
            return Embedded(windows, self.actor.embed_empty(storage.frames))
