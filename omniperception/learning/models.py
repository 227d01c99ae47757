"""The actor that reads LiDAR frames: one embedding per frame, shared by the control steps that see it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import TYPE_CHECKING

import torch
from rsl_rl.models import MLPModel
from rsl_rl.modules import HiddenState
from tensordict import TensorDict
from torch import nn
from torch.nn import functional

from omniperception.avoidance.sector_motion import decode, motion_error
from omniperception.learning.embedding import RolloutEmbedding
from omniperception.learning.storage import WindowedObservations
from omniperception.perception import PerceptionNetwork

if TYPE_CHECKING:
    from omniperception.avoidance.velocity_risk import VelocityRisk


class _AddLoss(torch.autograd.Function):
    """Identity on the features whose backward pass also starts that of an auxiliary loss, at unit scale."""

    @staticmethod
    def forward(ctx, features: torch.Tensor, loss: torch.Tensor) -> torch.Tensor:
        ctx.save_for_backward(loss)
        return features.view_as(features)

    @staticmethod
    def backward(ctx, gradient: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        (loss,) = ctx.saved_tensors
        return gradient, torch.ones_like(loss)


AVOIDANCE, MOTION = "avoidance_target", "motion_target"
"""The supervised targets that are not a part of the embedding but read out of it, for a velocity that is added to the
command: this velocity itself, or nearness and motion of obstacles by sector, whence the risk of velocities."""

READ_OUT_HIDDEN = {AVOIDANCE: 64, MOTION: 256}
"""Widths of the read-outs' hidden layers."""


class PerceptionActor(MLPModel):
    """An MLP on one-dimensional observation groups and the embedding of the LiDAR history.

    While experience is collected (no gradients) the embedding is computed once per LiDAR tick and reused
    until the next tick or parameter change (:class:`RolloutEmbedding`). In updates each distinct window of a
    :class:`WindowedObservations` is embedded once. An environment without a frame since its reset gets the network's
    embedding of an empty history.

    With ``supervision`` and ``end_to_end`` the mean squared error between the part of the embedding that the network
    sets aside for a target (``perception.supervised``) and the observation group of that name, over the steps that
    have a frame, joins whatever loss is back-propagated through the actor (paper, Sec. 3.3.1: privileged height
    supervision).

    With supervision of ``avoidance_target`` an avoidance velocity is read out of the embedding and added to the
    commanded one before the MLP sees it, because that sum is what the reward wants tracked (paper, r_vel_avoid): a
    gait that follows commands then avoids as soon as the read-out is right. Without a frame it is 0. With supervision
    of ``motion_target`` distance and velocity of the nearest obstacle in each sector are read out; the risks of
    candidate velocities follow from them, once per embedding, and the avoidance velocity from these and the command.
    """

    def __init__(
        self,
        obs: TensorDict,
        obs_groups: dict[str, list[str]],
        obs_set: str,
        output_dim: int,
        perception: PerceptionNetwork | Callable[[], PerceptionNetwork],
        supervision: Mapping[str, float] | None = None,
        velocity_risk: VelocityRisk | None = None,
        command_group: str = "command",
        end_to_end: bool = True,
        **mlp_options,
    ) -> None:
        """Build the actor.

        Args:
            obs: example observations.
            obs_groups: groups of each observation set.
            obs_set: this model's set; only one-dimensional groups, LiDAR frames are read besides.
            output_dim: number of actions.
            perception: the network, or a function without arguments that builds it.
            supervision: weight of the regression on each privileged observation group; 0 leaves it out.
            velocity_risk: needed for supervision of ``motion_target``.
            command_group: the group that begins with the commanded velocity (v_x, v_y).
            end_to_end: whether the loss of an update reaches the perception network; otherwise it is trained by a
                :class:`~omniperception.learning.supervision.PerceptionTrainer` alone.
            mlp_options: ``hidden_dims``, ``activation``, ``obs_normalization`` (of the one-dimensional
                groups) and ``distribution_cfg`` of rsl_rl's ``MLPModel``.
        """
        network = perception if isinstance(perception, nn.Module) else perception()
        supervision = {target: weight for target, weight in (supervision or {}).items() if weight != 0.0}
        for target, weight in supervision.items():
            if weight < 0.0:
                raise ValueError(f"supervision: the weight of {target} must not be negative, got {weight}")
        self.command_group, self.end_to_end, self.velocity_risk = command_group, end_to_end, velocity_risk
        self.read_out_target = next((target for target in (AVOIDANCE, MOTION) if target in supervision), None)
        self._feature_dim = network.feature_dim  # read by _get_latent_dim while the base class builds the MLP
        super().__init__(obs, obs_groups, obs_set, output_dim, **mlp_options)
        self.perception: PerceptionNetwork = network
        with torch.no_grad():  # an untrained embedding is noise to the gait; it enters as its weights learn
            self.mlp[0].weight[:, self.obs_dim :] = 0.0
        self.supervision = supervision
        reads_out = self.read_out_target is not None and self.read_out_target not in network.supervised
        self.read_out = self._build_read_out(obs) if reads_out else None
        if self.read_out_target == MOTION:
            self.register_buffer("_candidates", velocity_risk.candidates(), persistent=False)
        for target in supervision:
            self._check_target(target, obs)
        if self.read_out_target is not None:
            self._check_command(obs)
        self.rollout = RolloutEmbedding(network, self._with_risks if self.read_out_target == MOTION else None)
        self._losses: dict[str, list[torch.Tensor]] = {target: [] for target in supervision}

    @property
    def tick(self) -> int:
        """Number of the newest LiDAR frame acted on."""
        return self.rollout.tick

    @property
    def extra_groups(self) -> list[str]:
        """Observation groups that the actor's losses read besides its inputs."""
        return list(self.supervision)

    def get_latent(
        self,
        obs: TensorDict | WindowedObservations,
        masks: torch.Tensor | None = None,
        hidden_state: HiddenState = None,
    ) -> torch.Tensor:
        """Normalised one-dimensional groups and the embedding, concatenated."""
        with torch.set_grad_enabled(torch.is_grad_enabled() and self.end_to_end):
            if isinstance(obs, WindowedObservations):
                features, has_frame = self.embed(obs), obs.step_count > 0
                if self.supervision and obs.has_frames and torch.is_grad_enabled():
                    features = _AddLoss.apply(features, self.supervised_loss(features, obs))
                obs = obs.groups
            else:
                features, has_frame = self.rollout(obs), obs["frame_count"].squeeze(-1) > 0
            if self.read_out_target is not None:
                obs = self._avoiding(obs, features, has_frame)
        embedding = features[:, : self._feature_dim]
        return torch.cat([super().get_latent(obs, masks, hidden_state), embedding], dim=-1)

    def perception_parameters(self) -> Iterator[nn.Parameter]:
        """Parameters of the network and of what is read out of its embedding."""
        yield from self.perception.parameters()
        if self.read_out is not None:
            yield from self.read_out.parameters()

    def avoidance(self, features: torch.Tensor, command: torch.Tensor) -> torch.Tensor:
        """(B, 2) avoidance velocity (m/s, yaw-aligned frame) of embeddings at commands (B, 2).

        Args:
            features: (B, D) embeddings, or (B, D + K) with the risks of the candidate velocities behind them.
            command: m/s.
        """
        if self.read_out_target == AVOIDANCE:
            return self._read(features)
        if features.shape[1] == self._feature_dim:
            features = self._with_risks(features)
        return self.velocity_risk.avoidance(features[:, self._feature_dim :], command, self._candidates)

    def embed(self, obs: WindowedObservations) -> torch.Tensor:
        """(B, D) embeddings of the steps of an update, or with what they were acted on; each window is embedded
        once."""
        if not obs.has_frames:  # the sensor sleeps: there is nothing to embed
            return self.perception.empty(obs.frames).expand(obs.batch_size[0], -1)
        empty = self.perception.empty(obs.frames)
        windows = obs.window_features
        if windows is None:
            windows = self.perception(obs.frames, obs.window_count)
        else:
            empty = functional.pad(empty, (0, windows.shape[2] - empty.shape[1]))
        table = torch.cat([windows.flatten(0, 1), empty])
        return table[torch.where(obs.step_count > 0, obs.step_window, table.shape[0] - 1)]

    def embed_windows(self, obs: WindowedObservations) -> torch.Tensor:
        """(E, W, D) embeddings of an update's windows, with the risks of the candidate velocities where the actor
        acts on them: (E, W, D + K)."""
        windows = self.perception(obs.frames, obs.window_count)
        return self._with_risks(windows) if self.read_out_target == MOTION else windows

    def supervised_loss(self, features: torch.Tensor, obs: WindowedObservations) -> torch.Tensor:
        """Weighted sum of the mean squared errors of all targets, over the steps that have a frame."""
        has_frame = obs.step_count > 0
        total = torch.zeros((), device=features.device)
        for target, weight in self.supervision.items():
            if target == MOTION:
                error = self._motion_error(features, obs[target].unflatten(-1, (-1, 3)))
            else:
                reads = target == AVOIDANCE
                predicted = self._read(features) if reads else features[:, self.perception.supervised[target]]
                error = (predicted - obs[target]).square().mean(dim=-1)
            loss = (error * has_frame).sum() / has_frame.sum().clamp(min=1)
            self._losses[target].append(loss.detach())
            total = total + weight * loss
        return total

    def pop_supervised_losses(self) -> dict[str, float]:
        """Mean squared error of each supervised target since the last call, without those never computed."""
        means = {target: torch.stack(losses).mean().item() for target, losses in self._losses.items() if losses}
        for losses in self._losses.values():
            losses.clear()
        return means

    def _get_latent_dim(self) -> int:
        return self.obs_dim + self._feature_dim

    def _build_read_out(self, obs: TensorDict) -> nn.Module:
        width = READ_OUT_HIDDEN[self.read_out_target]
        last = nn.Linear(width, obs[self.read_out_target].shape[-1])
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)
        return nn.Sequential(nn.Linear(self._feature_dim, width), nn.ELU(), last)

    def _read(self, embedding: torch.Tensor) -> torch.Tensor:
        """What is read out of embeddings: (B, 2) avoidance velocities (m/s), or (B, S, 3) obstacles by sector."""
        if self.read_out is None:
            values = embedding[:, self.perception.supervised[self.read_out_target]].float()
        else:
            values = self.read_out(embedding).float()
        return values if self.read_out_target == AVOIDANCE else values.unflatten(-1, (-1, 3))

    def _motion_error(self, features: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
        """(B,) squared errors of what is read out, (B, S, 3), and of the risks that follow from it."""
        predicted = self._read(features)
        with torch.no_grad():
            risk = self.velocity_risk.risk(decode(target), self._candidates)
        followed = self.velocity_risk.risk(decode(predicted), self._candidates)
        return motion_error(predicted, target) + (followed - risk).square().mean(-1)

    def _with_risks(self, embedding: torch.Tensor) -> torch.Tensor:
        """Embeddings (..., D) with the risks of the candidate velocities behind them (..., D + K)."""
        rows = embedding.flatten(0, -2)
        risk = self.velocity_risk.risk(decode(self._read(rows)), self._candidates)
        return torch.cat((embedding, risk.unflatten(0, embedding.shape[:-1])), -1)

    def _avoiding(self, groups: TensorDict, features: torch.Tensor, has_frame: torch.Tensor) -> TensorDict:
        """The observations with the avoidance velocity, 0 without a frame, added to the commanded one."""
        groups = groups.clone(recurse=False)
        command = groups[self.command_group]
        velocity = self.avoidance(features, command[:, :2]) * has_frame[:, None]
        groups[self.command_group] = command + functional.pad(velocity, (0, command.shape[-1] - 2))
        return groups

    def _check_command(self, obs: TensorDict) -> None:
        if self.command_group not in self.obs_groups or obs[self.command_group].shape[-1] < 2:
            raise ValueError(
                f"perception.avoidance_weight and motion_weight need the actor to observe '{self.command_group}', it"
                f" observes {self.obs_groups}; add it to observations.actor or set both to 0"
            )

    def _check_target(self, target: str, obs: TensorDict) -> None:
        if target == self.read_out_target and self.read_out is not None:
            return
        if target not in self.perception.supervised:
            raise ValueError(
                f"{type(self.perception).__name__} sets nothing aside for {target}; set its weight to 0, e.g."
                " perception.height_weight=0, or use perception=pd_risknet"
            )
        part = self.perception.supervised[target]
        expected = part.stop - part.start
        size = obs[target].shape[-1] if target in obs else 0
        if size != expected or part.stop > self._feature_dim:
            raise ValueError(
                f"supervision needs an observation '{target}' of {expected} values within the embedding's"
                f" {self._feature_dim}, the environment gives {size}; set its weight to 0 or match the sizes"
            )
