"""PPO with shared LiDAR frames, height supervision and a stop at the first non-finite number."""

from __future__ import annotations

import contextlib
import io

import torch
from rsl_rl.algorithms import PPO
from rsl_rl.env import VecEnv
from rsl_rl.extensions import resolve_rnd_config, resolve_symmetry_config
from rsl_rl.utils import resolve_class, resolve_obs_groups
from tensordict import TensorDict

from omniperception.learning.models import PerceptionActor
from omniperception.learning.storage import PerceptiveStorage
from omniperception.learning.supervision import PerceptionTrainer


class TrainingDiverged(RuntimeError):
    """A loss, gradient or parameter is no longer finite; no step has been taken with it."""


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
        self.perception_trainer: PerceptionTrainer | None = None
        if type(self.optimizer) is torch.optim.Adam:  # rsl_rl's choice, in one pass over the parameters
            parameters = self.optimizer.param_groups[0]["params"]
            self.optimizer = torch.optim.Adam(parameters, lr=self.learning_rate, fused=True)
            # It does not mark them as changed, which embeddings that are kept go by.
            self.optimizer.register_step_post_hook(lambda *_: torch.autograd.graph.increment_version(parameters))
        self.optimizer.register_step_pre_hook(lambda *_: self._check_gradients())

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
                "rnd_cfg and symmetry_cfg work on one-dimensional observations only; leave them out with a"
                " perceptive actor"
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
            state_dim=actor.perception.feature_dim if perceptive and actor.perception.carried else 0,
        )
        alg = alg_class(actor, critic, storage, device=device, **alg_cfg, multi_gpu_cfg=cfg["multi_gpu"])
        if perceptive and not actor.end_to_end:
            alg.perception_trainer = PerceptionTrainer(actor, max_grad_norm=alg.max_grad_norm, **cfg["supervision"])
        alg.compile(cfg.get("torch_compile_mode"))
        return alg

    def act(self, obs: TensorDict) -> torch.Tensor:
        """Sample actions; LiDAR frames are copied now because the environment may reuse their memory."""
        actions = super().act(obs) if self.learns_policy else self._follow(obs)
        self.storage.record_frames(obs, self._raw_actor.carried_state if self.storage.has_frames else None)
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
        losses = super().update() if self.learns_policy else self.storage.clear() or {}
        self.num_updates += 1
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
        """States of the networks, of the optimisers and of embeddings that are carried on."""
        state = super().save()
        if isinstance(self._raw_actor, PerceptionActor):
            state["carried"] = self._raw_actor.rollout.state_dict()
        if self.perception_trainer is not None:
            state["perception_optimizer_state_dict"] = self.perception_trainer.optimizer.state_dict()
        return state

    def load(self, loaded_dict: dict, load_cfg: dict | None, strict: bool) -> bool:
        """Load the parts that ``load_cfg`` names, all by default; whether the iteration is one of them."""
        if self.perception_trainer is not None and (load_cfg is None or load_cfg.get("optimizer")):
            self.perception_trainer.optimizer.load_state_dict(loaded_dict["perception_optimizer_state_dict"])
        if isinstance(self._raw_actor, PerceptionActor) and (load_cfg is None or load_cfg.get("env")):
            self._raw_actor.rollout.load_state_dict(loaded_dict.get("carried"))
        return super().load(loaded_dict, load_cfg, strict)

    def _check_gradients(self) -> None:
        for name, model in (("actor", self._raw_actor), ("critic", self._raw_critic)):
            if not _all_finite([p.grad for p in model.parameters() if p.grad is not None]):
                raise TrainingDiverged(
                    f"update {self.num_updates}: the gradient of the {name} is not finite"
                    f" ({self._diagnosis()}); the weights are those of the last good step"
                )

    def _check_parameters(self) -> None:
        for name, model in (("actor", self._raw_actor), ("critic", self._raw_critic)):
            tensors = [t for t in (*model.parameters(), *model.buffers()) if t.is_floating_point()]
            if not _all_finite(tensors):
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
        return f"rollout finite, learning rate {self.learning_rate:.2e}: lower it, or max_grad_norm"


def _all_finite(tensors: list[torch.Tensor]) -> bool:
    """Whether every element is finite, with one read-back if so.

    Euclidean norms take a twentieth of the time of maximum norms; they may overflow, so a bad one is looked into.
    """
    if not tensors or bool(torch.isfinite(torch.stack(torch._foreach_norm(tensors))).all()):
        return True
    return all(bool(torch.isfinite(tensor).all()) for tensor in tensors)
