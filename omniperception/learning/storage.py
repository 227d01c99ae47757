"""Rollout storage that keeps every LiDAR frame once and draws mini-batches of whole environments."""

from __future__ import annotations

from collections.abc import Generator, Sequence
from dataclasses import dataclass

import torch
from rsl_rl.storage import RolloutStorage
from tensordict import TensorDict


@dataclass(frozen=True)
class Embedded:
    """Embeddings that the policy acted on, where an update of perception must not change them.

    Attributes:
        windows: (N, W, D) of each environment's windows.
        empty: (1, D) of a history without a frame.
    """

    windows: torch.Tensor
    empty: torch.Tensor


@dataclass(frozen=True)
class WindowedObservations:
    """Observations of B = T x E control steps whose LiDAR frames are stored once per environment.

    Attributes:
        groups: the one-dimensional observation groups, batch size B.
        frames: (E, F, P, 3) frames of each environment, oldest first.
        window_count: (E, W) valid frames of the window that ends at frame H - 1 + w; 0 where no step needs it.
        step_window: (B,) index e * W + w of each step's window.
        step_count: (B,) valid frames at each step; 0 after a reset until the next frame.
        acted_on: embeddings of the E environments, where they are fixed during the update, else None.
    """

    groups: TensorDict
    frames: torch.Tensor
    window_count: torch.Tensor
    step_window: torch.Tensor
    step_count: torch.Tensor
    acted_on: Embedded | None = None

    @property
    def has_frames(self) -> bool:
        """Tell whether any step has seen a frame since its environment's reset."""
        return bool(self.window_count.any())

    @property
    def batch_size(self) -> torch.Size:
        """Number of control steps, as a one-element size."""
        return self.groups.batch_size

    def __getitem__(self, group: str) -> torch.Tensor:
        return self.groups[group]

    def __contains__(self, group: str) -> bool:
        return group in self.groups


def max_windows(num_steps: int, steps_per_frame: int) -> int:
    """Most LiDAR frames that can be the newest one during ``num_steps`` control steps."""
    return 1 + -(-(num_steps - 1) // steps_per_frame)


class PerceptiveStorage(RolloutStorage):
    """Rollout storage for PPO, with or without LiDAR frames.

    Observations describe LiDAR frames as `frames` (N, H, P, 3) newest last, `frame_count` (N, 1) valid ones and
    `frame_tick` (N, 1) the number of the newest, the same in all environments.

    One-dimensional groups are stored per step by rsl_rl. With frames, the H frames seen at the first step are copied
    and then one frame per tick; a step keeps its tick and its count of valid frames. Mini-batches are then random
    subsets of environments with all their steps, so that each window is embedded once per mini-batch. Without frames
    the mini-batches are rsl_rl's.

    Attributes:
        has_frames: whether the actor reads LiDAR frames.
        frames: (N, H - 1 + W, P, 3) frames of the rollout, oldest first.
        acted_on: embeddings that the policy acted on, where they were recorded.
    """

    def __init__(
        self,
        num_envs: int,
        num_steps: int,
        obs: TensorDict,
        stored_groups: list[str],
        num_actions: int,
        device: str = "cpu",
        frames: bool = False,
        steps_per_frame: int = 1,
    ) -> None:
        """Allocate the buffers.

        Args:
            num_envs: N.
            num_steps: T, control steps per rollout.
            obs: example observations.
            stored_groups: one-dimensional groups that a model or a loss reads.
            num_actions: size of an action.
            device: where the buffers live.
            frames: whether the actor reads LiDAR frames.
            steps_per_frame: least control steps between two frames; 1 is always enough, the true value saves memory.
        """
        super().__init__("rl", num_envs, num_steps, obs.select(*stored_groups), [num_actions], device)
        self.stored_groups = stored_groups
        self.has_frames = frames
        if not frames:
            return
        self.history = obs["frames"].shape[1]
        self.steps_per_frame = steps_per_frame
        capacity = self.history - 1 + max_windows(num_steps, steps_per_frame)
        self.frames = torch.zeros(num_envs, capacity, *obs["frames"].shape[2:], device=device)
        self.frame_count = torch.zeros(num_steps, num_envs, dtype=torch.int16, device=device)
        self.acted_on: Embedded | None = None
        self._ticks: list[int] = []  # of the newest frame at each step

    @property
    def first_steps(self) -> list[int]:
        """The first control step of this rollout at which each window is the newest."""
        return [self._ticks.index(tick) for tick in range(self._ticks[0], self._ticks[-1] + 1)]

    def record_frames(
        self, obs: TensorDict, tick: int, embedded: tuple[torch.Tensor, torch.Tensor] | None = None
    ) -> None:
        """Copy what is new in the observations of the current step; call before the environment moves on.

        Args:
            obs: observations of the step.
            tick: number of their newest frame, which is the same in all environments.
            embedded: (N, D) embeddings that the policy acts on and (1, D) that of no frame, to be the update's; None:
                the update embeds the frames itself.
        """
        if not self._ticks:
            self.frames[:, : self.history].copy_(obs["frames"])
        elif tick != self._ticks[-1]:
            if tick != self._ticks[-1] + 1:
                raise ValueError(
                    f"storage: LiDAR tick {tick} follows {self._ticks[-1]} at step {self.step};"
                    " frame_tick must grow by one per frame, at most once per control step"
                )
            window = tick - self._ticks[0]
            slot = self.history - 1 + window
            if slot >= self.frames.shape[1]:
                raise ValueError(
                    f"storage: frame {window} of this rollout comes at step {self.step},"
                    f" but steps_per_frame={self.steps_per_frame}; set it to the environment's value"
                )
            self.frames[:, slot].copy_(obs["frames"][:, -1])
        if embedded is not None and (not self._ticks or tick != self._ticks[-1]):
            self._record_embedded(tick - self._ticks[0] if self._ticks else 0, *embedded)
        self._ticks.append(tick)
        self.frame_count[self.step].copy_(obs["frame_count"].squeeze(-1))

    def _record_embedded(self, window: int, newest: torch.Tensor, empty: torch.Tensor) -> None:
        """Copy embeddings (N, D) of a window of all environments, and (1, D) of no frame."""
        if self.acted_on is None:
            num_windows = self.frames.shape[1] - self.history + 1
            self.acted_on = Embedded(newest.new_zeros(len(newest), num_windows, newest.shape[1]), empty.clone())
        self.acted_on.windows[:, window].copy_(newest)

    def add_transition(self, transition: RolloutStorage.Transition) -> None:
        """Store one transition; of the observations only the groups that are read."""
        transition.observations = transition.observations.select(*self.stored_groups)
        super().add_transition(transition)

    def clear(self) -> None:
        """Start the next rollout."""
        super().clear()
        if self.has_frames:
            self.acted_on = None
            self._ticks.clear()

    def mini_batch_generator(
        self, num_mini_batches: int, num_epochs: int = 8
    ) -> Generator[RolloutStorage.Batch, None, None]:
        """Shuffled mini-batches: of steps without frames, of whole environments with frames.

        Environments are spread over the mini-batches as evenly as possible (sizes differ by one at most) and each is
        visited once per epoch, in a new order.
        """
        if not self.has_frames:
            yield from super().mini_batch_generator(num_mini_batches, num_epochs)
            return
        for _ in range(num_epochs):
            for env_ids in self.shuffled_envs(num_mini_batches):
                yield self.batch_of(env_ids)

    def shuffled_envs(self, num_parts: int) -> tuple[torch.Tensor, ...]:
        """All environments in a new order, in parts whose sizes differ by one at most."""
        return torch.randperm(self.num_envs, device=self.device).tensor_split(num_parts)

    def batch_of(self, env_ids: torch.Tensor) -> RolloutStorage.Batch:
        """All steps of some environments, flattened in (step, environment) order."""

        def take(buffer: torch.Tensor) -> torch.Tensor:
            return buffer[:, env_ids].flatten(0, 1)

        return RolloutStorage.Batch(
            observations=self.observations_of(env_ids),  # type: ignore[arg-type]
            actions=take(self.actions),
            values=take(self.values),
            advantages=take(self.advantages),
            returns=take(self.returns),
            old_actions_log_prob=take(self.actions_log_prob),
            old_distribution_params=tuple(take(p) for p in self.distribution_params),
        )

    def observations_of(self, env_ids: torch.Tensor, steps: Sequence[int] | None = None) -> WindowedObservations:
        """Rollout of some environments, flattened in (step, environment) order.

        Args:
            env_ids: (E,).
            steps: control steps of the rollout, all by default.
        """
        fixed = self.acted_on
        windows = torch.tensor(self._ticks, device=self.device) - self._ticks[0]  # (T,)
        num_windows = self._ticks[-1] - self._ticks[0] + 1
        step_count = self.frame_count[:, env_ids]  # (T, E)
        # Within a tick an environment's count is constant or, after a reset, 0: the largest is the window's.
        count = step_count.new_zeros(num_windows, len(env_ids))
        count.scatter_reduce_(0, windows.unsqueeze(1).expand_as(step_count), step_count, "amax")
        first = torch.arange(len(env_ids), device=self.device) * num_windows
        groups = self.observations
        if steps is not None:
            groups, windows, step_count = groups[steps], windows[steps], step_count[steps]
        return WindowedObservations(
            groups=groups[:, env_ids].flatten(0, 1),
            frames=self.frames[env_ids, : self.history - 1 + num_windows],
            window_count=count.t().contiguous().long(),
            step_window=(first + windows.unsqueeze(1)).flatten(),
            step_count=step_count.flatten().long(),
            acted_on=fixed and Embedded(fixed.windows[env_ids, :num_windows], fixed.empty),
        )
