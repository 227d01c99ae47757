"""The actor that reads LiDAR frames: one embedding per frame, shared by the control steps that see it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import torch
from rsl_rl.modules import HiddenState
from tensordict import TensorDict
from torch import nn

from omniperception.avoidance.sector_motion import decode
from omniperception.avoidance.velocity import AVOIDANCE_TARGET, COMMAND, LAST_ASKED, MOTION_TARGET
from omniperception.common.vectors import moved_towards
from omniperception.learning.config import LearningConfig
from omniperception.learning.estimator import EstimatingModel
from omniperception.learning.navigation import ASKED, MOTION, NavigationActor, Navigator
from omniperception.learning.read_out import MotionReadOut, VelocityReadOut
from omniperception.learning.storage import WindowedObservations


def build_actor(obs: TensorDict, config: LearningConfig, num_actions: int) -> EstimatingModel:
    """The actor of a configuration, for observations like the given ones."""
    if config.perception is not None:
        return (PerceptionActor if config.moves_joints else PerceivingNavigator)(obs, config, num_actions)
    given = (obs, {"actor": list(config.actor_groups)}, "actor", num_actions)
    if config.navigation is not None:
        return NavigationActor(*given, navigation=config.navigation, **_options(config))
    return EstimatingModel(*given, config.estimator, **_options(config))


def _options(config: LearningConfig) -> dict[str, Any]:
    distribution = {"class_name": "GaussianDistribution", "init_std": config.ppo.init_std}
    return {"distribution_cfg": distribution, **config.ppo.mlp}


class PerceptionActor(EstimatingModel):
    """An MLP on one-dimensional observation groups and the embedding of the LiDAR history.

    While it acts, the embedding is computed without gradients, once per LiDAR frame: as long as it is given the same
    number ``frame_tick``. :meth:`reset` forgets it, which is due when weights change. In an update each distinct window
    of a :class:`WindowedObservations` is embedded once. An environment without a frame since its reset gets the
    network's embedding of an empty history.

    Where no supervision of its own trains the network (`perception.supervised_epochs` is 0), the gradient of the
    policy's loss reaches it, and the supervised loss is the `auxiliary_loss` (paper, Sec. 3.3.1: privileged height
    supervision). It is the mean squared error between an observation group and the part of the embedding that the
    network sets aside for it (``perception.supervised``), over the steps that have a frame.

    With supervision of ``avoidance_target`` or ``motion_target`` an avoidance velocity is read out of the embedding and
    added to the commanded one before the MLP sees it, because that sum is what the reward wants tracked (paper,
    r_vel_avoid): a gait that follows commands then avoids as soon as the read-out is right. Without a frame it is 0.
    With `max_change` the sum moves no further than that from the one of the step before, which is observed. With a
    navigation policy that one's velocity, yaw rate and all, takes the place of the sum.

    Attributes:
        perception: the network.
        supervision: weight of the regression on each privileged observation group.
        read_out: gives the avoidance velocity, or None.
        velocity_inputs: where v_x, v_y and yaw rate are observed.
        navigation: asks for velocities in place of the sum, or None.
        max_change: most (m/s) by which the sum changes from step to step; None: no limit.
        asked: (N, 2) m/s, or (N, 3) with navigation, which turns (rad/s), too: the sum that the newest actions were
            computed from; None before the first, and without a limit.
    """

    def __init__(self, obs: TensorDict, config: LearningConfig, num_actions: int) -> None:
        """
        Args:
            obs: example observations.
            config: what learns; its actor's groups are one-dimensional, LiDAR frames are read besides.
            num_actions: size of an action.
        """
        assert config.perception is not None
        perception, groups = config.perception.build_network(), {"actor": list(config.actor_groups)}
        self._feature_dim = perception.feature_dim
        super().__init__(
            obs, groups, "actor", num_actions, config.estimator, embedding_dim=self._feature_dim, **_options(config)
        )
        self.perception = perception
        with torch.no_grad():  # an untrained embedding is noise to the gait; it enters as its weights learn
            self.mlp[0].weight[:, self.blind_dim :] = 0.0
        self.supervision = config.perception.supervision
        self.end_to_end = config.perception.supervised_epochs == 0
        self.read_out = self._build_read_out(obs, config)
        self.navigation: Navigator | None = None
        if config.navigation is not None:
            if not isinstance(self.read_out, MotionReadOut):
                raise ValueError("navigation needs to know how obstacles move; set perception.motion_weight")
            if self.read_out.risk_part is not None and config.navigation.risk != config.velocity_risk:
                raise ValueError(
                    "navigation.risk must be rewards.avoidance.risk where the perception network says the risks itself;"
                    " set rewards.avoidance.risk=${navigation.risk}"
                )
            self.navigation = Navigator(config.navigation)
        self.velocity_inputs, self._max_turn = tuple(config.velocity_inputs), config.max_turn
        self.max_change = config.max_change
        self.asked: torch.Tensor | None = None
        self._check_supervision(obs)
        self._newest: tuple[int, torch.Tensor, torch.Tensor] | None = None  # tick, embeddings
        self._losses: dict[str, list[torch.Tensor]] = {target: [] for target in self.supervision}

    def _build_read_out(self, obs: TensorDict, config: LearningConfig) -> VelocityReadOut | MotionReadOut | None:
        if AVOIDANCE_TARGET in self.supervision:
            return VelocityReadOut(self._feature_dim)
        if MOTION_TARGET not in self.supervision:
            return None
        if config.velocity_risk is None:
            raise ValueError("perception.motion_weight needs rewards.avoidance.risk; use rewards=velocity_risk")
        parts, num_values = self.perception.supervised, obs[MOTION_TARGET].shape[-1]
        given = (self._feature_dim, num_values, parts.get(MOTION_TARGET), config.velocity_risk, parts.get("risk"))
        return MotionReadOut(*given)

    def get_latent(
        self,
        obs: TensorDict | WindowedObservations,
        masks: torch.Tensor | None = None,
        hidden_state: HiddenState = None,
    ) -> torch.Tensor:
        """Normalised one-dimensional groups and the embedding, concatenated."""
        groups, features = self._perceive(obs)
        latent = super().get_latent(groups, masks, hidden_state)
        return torch.cat([latent, features[:, : self._feature_dim]], dim=-1)

    def _perceive(self, obs: TensorDict | WindowedObservations) -> tuple[TensorDict, torch.Tensor]:
        """Observations with what the gait is asked for as the command, and features (B, D) or (B, D + K)."""
        is_update = isinstance(obs, WindowedObservations)
        with self._precision(), torch.set_grad_enabled(self.end_to_end and is_update and torch.is_grad_enabled()):
            groups, features, has_frame = self._embedded(obs)
            self.auxiliary_loss = 0.0
            if isinstance(obs, WindowedObservations) and torch.is_grad_enabled() and obs.has_frames:
                self.auxiliary_loss = self.supervised_loss(features, obs)
                features = features.view_as(features)  # the policy's gradients are summed before they join this loss's
            if self.read_out is None:
                return groups, features
            asked, command = self._ask(groups, features, has_frame), groups[COMMAND]
            if not is_update and self.max_change is not None:
                self.asked = asked
            groups = groups.clone(recurse=False)
            groups[COMMAND] = torch.cat((asked, command[:, asked.shape[1] :]), 1)
            return groups, features

    def _embedded(self, obs: TensorDict | WindowedObservations) -> tuple[TensorDict, torch.Tensor, torch.Tensor]:
        """One-dimensional groups, features (B, D) or (B, D + K), and (B,) whether there is a frame."""
        if isinstance(obs, WindowedObservations):
            return obs.groups, self.embed(obs), obs.step_count > 0
        return obs, self.embed_newest(obs), obs["frame_count"].squeeze(-1) > 0

    def reset(self, dones: torch.Tensor | None = None, hidden_state: HiddenState = None) -> None:
        """Drop the embedding of the newest frame; with ``dones`` (single environments were reset) it stays valid."""
        if dones is None:
            self._newest, self.auxiliary_loss = None, 0.0

    def embed_newest(self, obs: TensorDict) -> torch.Tensor:
        """(N, D) embeddings of the current histories, extended for the read-out; the empty one without a frame."""
        frames, count, tick = obs["frames"], obs["frame_count"], obs["frame_tick"]
        if self._newest is None or self._newest[0] != tick:
            features = self._extend(self.perception(frames, count)[:, 0])
            self._newest = (tick, features, self.embed_empty(frames))
        features, empty = self._newest[1:]
        return torch.where(count > 0, features, empty)

    @property
    def tick(self) -> int | None:
        """Number of the newest LiDAR frame acted on; None after a reset."""
        return None if self._newest is None else self._newest[0]

    @property
    def newest(self) -> tuple[torch.Tensor, torch.Tensor] | None:
        """(N, D + K) embeddings that it acts on since that frame, and (1, D + K) the one of no frame."""
        return None if self._newest is None else self._newest[1:]

    def embed(self, obs: WindowedObservations) -> torch.Tensor:
        """(B, D) embeddings of the steps of an update, or (B, D + K) those that were acted on; each window is embedded
        once."""
        if obs.acted_on is not None:
            windows, empty = obs.acted_on.windows, obs.acted_on.empty
        else:
            empty = self.perception.empty(obs.frames)
            if not obs.has_frames:  # no frame has been cast yet: there is nothing to embed
                return empty.expand(obs.batch_size[0], -1)
            windows = self.perception(obs.frames, obs.window_count)
        table = torch.cat([windows.flatten(0, 1), empty])
        return table[torch.where(obs.step_count > 0, obs.step_window, table.shape[0] - 1)]

    def embed_empty(self, frames: torch.Tensor) -> torch.Tensor:
        """(1, D) embedding of a history without a frame, extended for the read-out; see `PerceptionNetwork.empty`."""
        return self._extend(self.perception.empty(frames))

    def perception_parameters(self) -> Iterator[nn.Parameter]:
        """Parameters of the network and of what is read out of its embedding."""
        yield from self.perception.parameters()
        if self.read_out is not None:
            yield from self.read_out.parameters()

    def supervised_loss(self, features: torch.Tensor, obs: WindowedObservations) -> torch.Tensor:
        """Weighted sum of the mean squared errors of all targets, over the steps that have a frame."""
        has_frame = obs.step_count > 0
        total = torch.zeros((), device=features.device)
        for target, weight in self.supervision.items():
            if target in (AVOIDANCE_TARGET, MOTION_TARGET):
                assert self.read_out is not None
                error = self.read_out.error(features, obs[target])
            else:
                error = (features[:, self.perception.supervised[target]] - obs[target]).square().mean(dim=-1)
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

    def _precision(self) -> AbstractContextManager:
        """In which an update embeds: that of acting with a read-out, as V_avoid makes much of what bfloat16 rounds off
        (docs/lab/negative.md, "PPO on top"), otherwise the update's."""
        if self.read_out is None:
            return nullcontext()
        return torch.autocast(next(self.parameters()).device.type, enabled=False)

    def _extend(self, embedding: torch.Tensor) -> torch.Tensor:
        return embedding if self.read_out is None else self.read_out.extend(embedding)

    def _ask(self, groups: TensorDict, features: torch.Tensor, has_frame: torch.Tensor) -> torch.Tensor:
        """(B, 2) V_cmd + V_avoid, V_cmd alone without a frame, or (B, 3) what navigation asks for."""
        assert self.read_out is not None
        command = groups[COMMAND]
        if self.navigation is not None:
            velocity = [groups[one.group][:, one.column] / one.scale for one in self.velocity_inputs]
            return self.navigate(features, has_frame, command, torch.stack(velocity, 1), groups[LAST_ASKED])
        asked = command[:, :2] + self.read_out.velocity(features, command[:, :2]) * has_frame[:, None]
        return asked if self.max_change is None else moved_towards(groups[LAST_ASKED], asked, self.max_change)

    def navigate(
        self,
        features: torch.Tensor,
        has_frame: torch.Tensor,
        command: torch.Tensor,
        velocity: torch.Tensor,
        last_asked: torch.Tensor,
    ) -> torch.Tensor:
        """(B, 3) what the gait is asked for by a navigation policy: what it wants, within the gait's ranges and as fast
        as it may change; the command without a frame.

        Args:
            features: (B, D) or (B, D + K).
            has_frame: (B,) bool.
            command, velocity, last_asked: (B, 3) v_x, v_y (m/s) and yaw rate (rad/s).
        """
        assert self.navigation is not None and self.max_change is not None
        sectors, risks = self._surroundings(features, has_frame)
        wanted = self.navigation(sectors, command, velocity, last_asked, risks)
        wanted = torch.where(has_frame[:, None], wanted, command)
        linear = moved_towards(last_asked[:, :2], wanted[:, :2], self.max_change)
        turn = last_asked[:, 2:] + (wanted - last_asked)[:, 2:].clamp(-self._max_turn, self._max_turn)
        return torch.cat((linear, turn), 1)

    def _surroundings(
        self, features: torch.Tensor, has_frame: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor | None]:
        """(B, S, 3) distance (m) and velocity (m/s, yaw-aligned frame) as perceived, nothing without a frame; (B, K)
        risks of navigation's candidates, 0 without a frame, None where the read-out has others."""
        assert isinstance(self.read_out, MotionReadOut) and self.navigation is not None
        sectors = decode(self.read_out.motion(features[:, : self._feature_dim]))
        empty = torch.cat((sectors[..., :1] + torch.inf, 0.0 * sectors[..., 1:]), -1)
        sectors = torch.where(has_frame[:, None, None], sectors, empty)
        if self.navigation.risk != self.read_out.velocity_risk:
            return sectors, None
        extended = features if features.shape[1] > self._feature_dim else self.read_out.extend(features)
        return sectors, extended[:, self._feature_dim :] * has_frame[:, None]

    def _check_supervision(self, obs: TensorDict) -> None:
        """Every target is observed, in the size that the network gives; what changes the command observes it."""
        for target in self.supervision:
            part = self.perception.supervised.get(target)
            if part is None and target in (AVOIDANCE_TARGET, MOTION_TARGET):
                continue
            if part is None:
                raise ValueError(
                    f"{type(self.perception).__name__} sets nothing aside for {target}; set its weight to 0, e.g."
                    " perception.height_weight=0, or use perception=pd_risknet"
                )
            size = obs[target].shape[-1] if target in obs else 0
            if size != part.stop - part.start or part.stop > self._feature_dim:
                raise ValueError(
                    f"supervision needs an observation '{target}' of {part.stop - part.start} values within the"
                    f" embedding's {self._feature_dim}, the environment gives {size}; set its weight to 0 or match the"
                    " sizes"
                )
        if self.read_out is None:
            return
        if COMMAND not in self.obs_groups or obs[COMMAND].shape[-1] < 2:
            raise ValueError(
                f"perception.avoidance_weight and motion_weight need the actor to observe '{COMMAND}', it"
                f" observes {self.obs_groups}; add it to observations.actor or set both to 0"
            )
        if self.max_change is not None and LAST_ASKED not in obs:
            raise ValueError(
                f"a limit of the change of V_cmd + V_avoid needs observations '{LAST_ASKED}', which the environment"
                " does not give; set rewards.avoidance.max_acceleration of both"
            )


class PerceivingNavigator(PerceptionActor):
    """A navigation policy on what a perception network says of LiDAR frames, for robots without legs.

    Its actions are the velocities (N, 3) that a gait is asked for. It observes the groups COMMAND, MOTION and ASKED.
    """

    def __init__(self, obs: TensorDict, config: LearningConfig, num_actions: int) -> None:
        """As of `PerceptionActor`, with a `config.navigation`."""
        super().__init__(obs, config, num_actions)
        missing = [name for name in (COMMAND, MOTION, ASKED) if name not in self.obs_groups]
        if missing:
            raise ValueError(
                f"navigation on a perception needs the observations {', '.join(missing)}; use observations=perceive"
            )
        assert self.navigation is not None
        self.mlp = self.navigation.mlp
        self.max_change = None  # the simulator limits it

    @torch.no_grad()
    def get_latent(
        self,
        obs: TensorDict | WindowedObservations,
        masks: torch.Tensor | None = None,
        hidden_state: HiddenState = None,
    ) -> torch.Tensor:
        """The inputs of navigation."""
        assert self.navigation is not None
        groups, features, has_frame = self._embedded(obs)
        sectors, risks = self._surroundings(features, has_frame)
        return self.navigation.inputs(sectors, groups[COMMAND], groups[MOTION], groups[ASKED], risks)
