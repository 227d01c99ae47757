"""One PPO update with every LiDAR frame projected once, against every step's whole window through nn.GRU."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from rsl_rl.env import VecEnv
from rsl_rl.models import MLPModel
from tensordict import TensorDict
from torch import nn

from omniperception.learning import PerceptionActor, PerceptivePpo, PerceptiveStorage, WindowedObservations
from omniperception.perception import PdRiskNet


@dataclass(frozen=True)
class UpdateCase:
    """Sizes of the update; the defaults are the paper's but for the number of environments.

    Attributes:
        num_envs: environments.
        num_steps: control steps per rollout.
        num_proximal: points of the proximal half.
        num_distal: points of the distal half.
        history: frames per window.
        steps_per_frame: control steps between two LiDAR frames.
        hidden_dims: hidden layers of the actor and of the critic.
        num_epochs: passes over the rollout.
        num_mini_batches: mini-batches per pass.
        proprioception: values that actor and critic observe besides.
        proximal_dim: size of the proximal embedding.
        distal_dim: size of the distal embedding.
    """

    num_envs: int = 64
    num_steps: int = 24
    num_proximal: int = 256
    num_distal: int = 128
    history: int = 10
    steps_per_frame: int = 5
    hidden_dims: tuple[int, ...] = (256, 128, 64)
    num_epochs: int = 5
    num_mini_batches: int = 4
    proprioception: int = 333
    proximal_dim: int = 187
    distal_dim: int = 64


class StepwiseActor(PerceptionActor):
    """Embeds the whole window of every control step by itself with PyTorch's GRU."""

    def embed(self, obs: WindowedObservations) -> torch.Tensor:
        """(B, D) embeddings; ``obs.frames`` are the windows (B, H, P, 3), all frames valid."""
        network = self.perception
        halves = obs.frames[:, :, : network.num_proximal], obs.frames[:, :, network.num_proximal :]
        states = [
            nn.GRU.forward(gru, half.flatten(2))[1][0]
            for gru, half in zip((network.proximal, network.distal), halves, strict=True)
        ]
        return torch.cat(states, dim=-1)


class StepwiseStorage(PerceptiveStorage):
    """Keeps each control step's whole window of frames."""

    def __init__(self, *args, **kwargs) -> None:
        """Arguments of :class:`PerceptiveStorage`."""
        super().__init__(*args, **kwargs)
        shape = (self.num_transitions_per_env, self.num_envs, self.history, *self.frames.shape[2:])
        self.windows = torch.zeros(shape, device=self.device)

    def record_frames(self, obs: TensorDict, tick: int) -> None:
        """Copy the current window."""
        super().record_frames(obs, tick)
        self.windows[self.step].copy_(obs["frames"])

    def observations_of(self, env_ids: torch.Tensor, steps: Sequence[int] | None = None) -> WindowedObservations:
        """What some environments saw, with the windows of all steps as ``frames``."""
        return replace(super().observations_of(env_ids, steps), frames=self.windows[:, env_ids].flatten(0, 1))


class RandomFrames(VecEnv):
    """Random observations and frames, full histories, no resets."""

    def __init__(self, case: UpdateCase) -> None:
        self.case, self.num_envs, self.num_actions, self.device, self.cfg = case, case.num_envs, 12, "cpu", {}
        self.max_episode_length, self.episode_length_buf = 1000, torch.zeros(case.num_envs)
        self.step_count = 0
        points = case.num_proximal + case.num_distal
        self.frames = 0.2 * torch.randn(case.num_envs, case.history, points, 3)

    def get_observations(self) -> TensorDict:
        """Observations of the current step."""
        n = self.num_envs
        groups = {
            "policy": torch.randn(n, self.case.proprioception),
            "height_target": torch.rand(n, self.case.proximal_dim) - 0.5,
            "frames": self.frames,
            "frame_count": torch.full((n, 1), self.case.history),
            "frame_tick": torch.full((n, 1), self.step_count // self.case.steps_per_frame),
        }
        return TensorDict(groups, batch_size=[n])

    def step(self, actions: torch.Tensor) -> tuple[TensorDict, torch.Tensor, torch.Tensor, dict]:
        """One control step; every ``steps_per_frame`` of them a new frame."""
        self.step_count += 1
        if self.step_count % self.case.steps_per_frame == 0:
            newest = 0.2 * torch.randn_like(self.frames[:, :1])
            self.frames = torch.cat((self.frames[:, 1:], newest), 1)
        return self.get_observations(), torch.randn(self.num_envs), torch.zeros(self.num_envs, dtype=torch.long), {}


@dataclass(frozen=True)
class UpdatePair:
    """The same update in both formulations, on the same rollout and from the same weights."""

    shared: PerceptivePpo
    stepwise: PerceptivePpo


def build(case: UpdateCase, seed: int = 0) -> UpdatePair:
    """Both algorithms with one rollout each, identical but for how windows are kept and embedded."""
    algorithms = []
    for stepwise in (False, True):
        torch.manual_seed(seed)
        algorithms.append(_with_rollout(case, stepwise))
    return UpdatePair(*algorithms)


def differences(pair: UpdatePair) -> tuple[float, float]:
    """Largest relative differences (L2) of the embeddings, and of the gradients of the perception network's weights."""
    features, gradients = [], []
    for algorithm in (pair.shared, pair.stepwise):
        observations = algorithm.storage.observations_of(torch.arange(algorithm.storage.num_envs))
        embedded = algorithm.actor.embed(observations)
        generator = torch.Generator().manual_seed(1)
        weights = torch.randn(embedded.shape, generator=generator)
        network = algorithm.actor.perception
        gradients.append(torch.autograd.grad((embedded * weights).sum(), list(network.parameters())))
        features.append([embedded.detach()])
    return _largest(*features), _largest(*gradients)


def seconds(algorithm: PerceptivePpo) -> float:
    """Wall time of one update; the rollout stays for the next."""
    start = time.perf_counter()
    algorithm.update()
    return time.perf_counter() - start


def embedding_seconds(algorithm: PerceptivePpo) -> float:
    """Wall time of the perception network alone, forward and backward, on one mini-batch."""
    storage = algorithm.storage
    observations = storage.observations_of(torch.arange(storage.num_envs // algorithm.num_mini_batches))
    start = time.perf_counter()
    algorithm.actor.embed(observations).sum().backward()
    return time.perf_counter() - start


def rollout_bytes(algorithm: PerceptivePpo) -> int:
    """Bytes of point clouds that the storage keeps for an update."""
    storage = algorithm.storage
    clouds = storage.windows if isinstance(storage, StepwiseStorage) else storage.frames
    return clouds.numel() * clouds.element_size()


def _with_rollout(case: UpdateCase, stepwise: bool) -> PerceptivePpo:
    env = RandomFrames(case)
    obs = env.get_observations()
    groups = {"actor": ["policy"], "critic": ["policy"]}
    mlp = {"hidden_dims": list(case.hidden_dims), "activation": "elu"}
    gaussian = {"class_name": "GaussianDistribution", "init_std": 1.0}
    network = PdRiskNet(
        case.num_proximal, case.num_distal, case.history, proximal_dim=case.proximal_dim, distal_dim=case.distal_dim
    )
    actor_class = StepwiseActor if stepwise else PerceptionActor
    supervision = {"height_target": 1.0}
    actor = actor_class(obs, groups, "actor", 12, network, supervision, distribution_cfg=gaussian, **mlp)
    critic = MLPModel(obs, groups, "critic", 1, **mlp)
    storage_class = StepwiseStorage if stepwise else PerceptiveStorage
    storage = storage_class(
        case.num_envs,
        case.num_steps,
        obs,
        ["policy", "height_target"],
        12,
        frames=True,
        steps_per_frame=case.steps_per_frame,
    )
    algorithm = PerceptivePpo(
        actor, critic, storage, num_learning_epochs=case.num_epochs, num_mini_batches=case.num_mini_batches
    )
    with torch.inference_mode():
        for _ in range(case.num_steps):
            obs, rewards, dones, extras = env.step(algorithm.act(obs))
            algorithm.process_env_step(obs, rewards, dones, extras)
        algorithm.compute_returns(obs)
    storage.clear = lambda: None  # the rollout is used again
    return algorithm


def _largest(ours: list[torch.Tensor], theirs: list[torch.Tensor]) -> float:
    return max(((a - b).norm() / b.norm()).item() for a, b in zip(ours, theirs, strict=True))
