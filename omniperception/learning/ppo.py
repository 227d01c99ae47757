"""PPO with shared LiDAR frames, height supervision and a stop at the first non-finite number."""

from __future__ import annotations

import contextlib
import io
import math

import torch
from rsl_rl.algorithms import PPO
from rsl_rl.env import VecEnv
from rsl_rl.extensions import resolve_rnd_config, resolve_symmetry_config
from rsl_rl.utils import resolve_class, resolve_obs_groups
from tensordict import TensorDict

from omniperception.learning.distributed import average_gradients
from omniperception.learning.models import PerceptionActor
from omniperception.learning.storage import PerceptiveStorage
from omniperception.learning.supervision import PerceptionTrainer


class TrainingDiverged(RuntimeError):
    """A loss, gradient or parameter is no longer finite; no step has been taken with it."""


class RolloutTooSmall(ValueError):
    """There is too little in a rollout to learn from it."""


class PerceptivePpo(PPO):
    """rsl_rl's PPO on a :class:`PerceptiveStorage`.

    Gradients are checked before each optimiser step and parameters after each update; a non-finite number
    raises :class:`TrainingDiverged`, so weights are never overwritten with it.
    """

    storage: PerceptiveStorage

    def __init__(self, *args, **kwargs) -> None:
        """Arguments of rsl_rl's PPO."""
        super().__init__(*args, **kwargs)
        self.num_updates = 0
        self.learns_policy = self.num_learning_epochs > 0
        self._has_gradient: dict[str, bool] = {}
        self.perception_trainer: PerceptionTrainer | None = None
        if type(self.optimizer) is torch.optim.Adam:  # rsl_rl's choice, in one pass over the parameters
            parameters = self.optimizer.param_groups[0]["params"]
            self.optimizer = torch.optim.Adam(parameters, lr=self.learning_rate, fused=True)
            # It does not mark them as changed, which embeddings that are kept go by.
            self.optimizer.register_step_post_hook(lambda *_: torch.autograd.graph.increment_version(parameters))
        self.optimizer.register_step_pre_hook(lambda *_: self._check_gradients())

    def set_perception_trainer(self, trainer: PerceptionTrainer) -> None:
        """Lets supervision alone train the perception network: on the gradients of all processes, with PPO's check."""
        self.perception_trainer = trainer
        network = list(self._raw_actor.perception_parameters())

        def prepare(*_: object) -> None:
            average_gradients(network)
            self._check_finite("perception network", network)

        trainer.optimizer.register_step_pre_hook(prepare)

    @staticmethod
    def construct_algorithm(obs: TensorDict, env: VecEnv, cfg: dict, device: str) -> PerceptivePpo:
        """Build models, storage and algorithm from the runner's configuration.

        ``cfg["steps_per_frame"]`` (default 1) is the least number of control steps between two LiDAR frames.
        """
        alg_class, alg_cfg = resolve_class(cfg["algorithm"])
        actor_class, actor_cfg = resolve_class(cfg["actor"])
        critic_class, critic_cfg = resolve_class(cfg["critic"])
        default_sets = ["actor", "critic"] + (["rnd_state"] if alg_cfg.get("rnd_cfg") else [])
        with contextlib.redirect_stdout(io.StringIO()):
            cfg["obs_groups"] = resolve_obs_groups(obs, cfg["obs_groups"], default_sets)
        perceptive = isinstance(actor_class, type) and issubclass(actor_class, PerceptionActor)
        if perceptive and (alg_cfg.get("rnd_cfg") or alg_cfg.get("symmetry_cfg")):
            raise ValueError(
                "ppo.symmetry (symmetry_cfg) and rnd_cfg work on one-dimensional observations only; with perception set"
                " ppo.symmetry=false"
            )
        alg_cfg = resolve_rnd_config(alg_cfg, obs, cfg["obs_groups"], env)
        alg_cfg = resolve_symmetry_config(alg_cfg, env)

        actor = actor_class(obs, cfg["obs_groups"], "actor", env.num_actions, **actor_cfg).to(device)
        critic = critic_class(obs, cfg["obs_groups"], "critic", 1, **critic_cfg).to(device)
        groups = {group for names in cfg["obs_groups"].values() for group in names}
        stored = sorted(groups | set(actor.extra_groups if perceptive else ()))
        storage = PerceptiveStorage(
            env.num_envs,
            cfg["num_steps_per_env"],
            obs,
            stored,
            env.num_actions,
            device,
            frames=perceptive,
            steps_per_frame=cfg.get("steps_per_frame", 1),
        )
        alg = alg_class(actor, critic, storage, device=device, **alg_cfg, multi_gpu_cfg=cfg["multi_gpu"])
        if perceptive and not actor.end_to_end:
            alg.set_perception_trainer(PerceptionTrainer(actor, max_grad_norm=alg.max_grad_norm, **cfg["supervision"]))
        alg.compile(cfg.get("torch_compile_mode"))
        return alg

    def act(self, obs: TensorDict) -> torch.Tensor:
        """Sample actions; LiDAR frames are copied now because the environment may reuse their memory."""
        actions = super().act(obs) if self.learns_policy else self._follow(obs)
        if self.storage.has_frames:
            self.storage.record_frames(obs, self._raw_actor.tick)
        return actions

    def train_mode(self) -> None:
        """As rsl_rl's; a policy that does not learn keeps the statistics of its observations, too."""
        super().train_mode()
        if not self.learns_policy:
            for model in (self._raw_actor, self._raw_critic):
                model.obs_normalizer.eval()

    def _follow(self, obs: TensorDict) -> torch.Tensor:
        """As rsl_rl's `act` of a policy that does not learn: nothing is valued."""
        self.transition.observations = obs
        self.transition.actions = self.actor(obs, stochastic_output=True).detach()
        self.transition.values = torch.zeros(len(obs), 1, device=self.device)
        self.transition.actions_log_prob = torch.zeros(len(obs), device=self.device)
        self.transition.distribution_params = tuple(p.detach() for p in self.actor.output_distribution_params)
        return self.transition.actions

    def compute_returns(self, obs: TensorDict) -> None:
        """As rsl_rl's, for a policy that learns."""
        if self.learns_policy:
            super().compute_returns(obs)

    def update(self) -> dict[str, float]:
        """One PPO update; mean losses, among them those of the supervised targets. Without epochs of PPO the policy
        stays as it is and perception learns alone.

        A perception network that is not trained end to end has embedded the rollout before it learns from it, so that
        PPO sees what the policy acted on.
        """
        if self.perception_trainer is not None:
            acted_on = self._embed_rollout() if self.learns_policy else None
            self.perception_trainer.train(
                self.storage, self.num_updates, self.num_mini_batches, self.use_mixed_precision
            )
            self.storage.window_features = acted_on
        self._has_gradient.clear()
        losses = {}
        if self.learns_policy:
            losses = super().update()
        else:
            self.storage.clear()
        self.num_updates += 1
        self._check_learning(losses)
        if isinstance(self._raw_actor, PerceptionActor):
            losses |= self._raw_actor.pop_supervised_losses()
        self._check_parameters()
        return losses

    def _embed_rollout(self) -> torch.Tensor | None:
        """(N, W, D) embeddings of the rollout's windows; None without a frame."""
        everyone = self.storage.observations_of(torch.arange(self.storage.num_envs, device=self.device))
        if not everyone.has_frames:
            return None
        with torch.no_grad():
            return self._raw_actor.embed_windows(everyone)

    def save(self) -> dict:
        """States of the networks and of the optimisers."""
        state = super().save()
        if self.perception_trainer is not None:
            state["perception_optimizer_state_dict"] = self.perception_trainer.optimizer.state_dict()
        return state

    def load(self, loaded_dict: dict, load_cfg: dict | None, strict: bool) -> bool:
        """Load the parts that ``load_cfg`` names, all by default; whether the iteration is one of them."""
        if self.perception_trainer is not None and (load_cfg is None or load_cfg.get("optimizer")):
            self.perception_trainer.optimizer.load_state_dict(loaded_dict["perception_optimizer_state_dict"])
        return super().load(loaded_dict, load_cfg, strict)

    def check_rollout(self) -> None:
        """Refuses rollouts that leave a mini-batch without content; those with frames are of whole environments."""
        num_envs, num_steps = self.storage.num_envs, self.storage.num_transitions_per_env
        available = num_envs if self.storage.has_frames else num_envs * num_steps
        if available < self.num_mini_batches:
            steps = f"steps ({num_envs} environments x {num_steps})"
            what = "environments" if self.storage.has_frames else steps
            raise RolloutTooSmall(
                f"ppo.num_mini_batches={self.num_mini_batches} must not exceed the {available} {what} of a rollout;"
                " lower it or raise num_envs"
            )
        if num_envs * num_steps < 2:
            raise RolloutTooSmall(
                f"num_envs={num_envs} and ppo.num_steps_per_env={num_steps} make rollouts of one step, whose advantages"
                " have no spread to be divided by; raise one of them"
            )

    def _check_gradients(self) -> None:
        models = {"actor": self._raw_actor, "critic": self._raw_critic}
        for name, model in models.items():
            moved = self._check_finite(name, list(model.parameters())) > 0.0
            self._has_gradient[name] = self._has_gradient.get(name, False) or moved

    def _check_learning(self, losses: dict[str, float]) -> None:
        """Stops if no step had a gradient: one whose norm overflows is made 0 where it is clipped.

        In the first step nothing is clipped by PPO, so that the actor has one unless all advantages are 0.
        """
        idle = [name for name, moved in self._has_gradient.items() if not moved]
        if "actor" in idle and not bool(self.storage.advantages.any()):
            idle.remove("actor")
        if idle:
            raise TrainingDiverged(
                f"update {self.num_updates}: the gradient of the {' and '.join(idle)} overflowed in every step, so that"
                f" nothing was learnt (value loss {losses['value']:.3g}, rewards up to"
                f" {float(self.storage.rewards.abs().max()):.3g}); scale the rewards down"
            )

    def _check_finite(self, name: str, parameters: list[torch.nn.Parameter]) -> float:
        """The largest norm of a parameter's gradient; one that is not finite stops the training."""
        gradients = [p.grad for p in parameters if p.grad is not None]
        finite, largest = _finite_and_largest(gradients)
        if not finite:
            raise TrainingDiverged(
                f"update {self.num_updates}: the gradient of the {name} is not finite"
                f" ({self._diagnosis()}); the weights are those of the last good step"
            )
        return largest

    def _check_parameters(self) -> None:
        for name, model in (("actor", self._raw_actor), ("critic", self._raw_critic)):
            tensors = [t for t in (*model.parameters(), *model.buffers()) if t.is_floating_point()]
            if not _finite_and_largest(tensors)[0]:
                bad = next(n for n, t in model.state_dict().items() if not torch.isfinite(t).all())
                raise TrainingDiverged(
                    f"update {self.num_updates}: {name} parameter '{bad}' is not finite ({self._diagnosis()})"
                )

    def _diagnosis(self) -> str:
        """Which stored quantity is not finite, or advice if all are."""
        storage = self.storage
        stored: dict[str, torch.Tensor] = {f"observation '{k}'": v for k, v in storage.observations.items()}
        if storage.has_frames:
            stored["observation 'frames'"] = storage.frames
        stored |= {name: getattr(storage, name) for name in ("rewards", "actions", "values", "returns", "advantages")}
        for name, tensor in stored.items():
            finite = torch.isfinite(tensor)
            if not finite.all():
                return f"{int((~finite).sum())} non-finite numbers in the rollout's {name}"
        ratio = self._largest_log_ratio()
        if ratio > _MAX_LOG_RATIO:
            return (
                f"rollout finite, an action became exp({ratio:.3g}) times as likely, smallest standard deviation"
                f" {float(self._raw_actor.output_std.min()):.1e}: lower the learning rate or keep more noise"
            )
        name, value = max(((n, float(t.abs().max())) for n, t in stored.items()), key=lambda item: item[1])
        if value > _HUGE:
            return f"the rollout's {name} reach {value:.2g}, whose square overflows"
        return f"rollout finite, learning rate {self.learning_rate:.2e}: lower it, or max_grad_norm"

    def _largest_log_ratio(self) -> float:
        """Largest logarithm of an action's likelihood now over that in the rollout."""
        largest = -math.inf
        if self.storage.step == 0:  # the update is over
            return largest
        with torch.no_grad():
            for batch in self.storage.mini_batch_generator(self.num_mini_batches, 1):
                self._raw_actor(batch.observations, stochastic_output=True)
                now = self._raw_actor.get_output_log_prob(batch.actions)
                largest = max(largest, float((now - batch.old_actions_log_prob.squeeze(-1)).max()))
        return largest


_MAX_LOG_RATIO = math.log(torch.finfo(torch.float32).max)
_HUGE = math.sqrt(torch.finfo(torch.float32).max)


def _finite_and_largest(tensors: list[torch.Tensor]) -> tuple[bool, float]:
    """Whether every element is finite, and the largest norm of a tensor, with one read-back.

    Euclidean norms take a twentieth of the time of maximum norms; they may overflow, so a bad one is looked into.
    """
    if not tensors:
        return True, 0.0
    largest = float(torch.stack(torch._foreach_norm(tensors)).detach().amax())
    return math.isfinite(largest) or all(bool(torch.isfinite(tensor).all()) for tensor in tensors), largest
