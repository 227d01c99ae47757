"""Rollout storage that keeps every LiDAR frame once and draws mini-batches of whole environments."""

from __future__ import annotations

from collections.abc import Generator, Sequence
from dataclasses import dataclass, replace

import torch
from rsl_rl.storage import RolloutStorage
from tensordict import TensorDict

FRAME_GROUPS = ("frames", "frame_count", "frame_tick")
"""Observations that describe LiDAR frames: (N, H, P, 3) newest last, (N, 1) valid frames, (N, 1) tick
counter."""


@dataclass(frozen=True)
class WindowedObservations:
    """Observations of B = T x E control steps whose LiDAR frames are stored once per environment.

    Attributes:
        groups: the one-dimensional observation groups, batch size B.
        frames: (E, F, P, 3) frames of each environment, oldest first.
        window_count: (E, W) valid frames of the window that ends at frame H - 1 + w; 0 where no step needs
            it.
        step_window: (B,) index e * W + w of each step's window.
        step_count: (B,) valid frames at each step; 0 after a reset until the next frame.
        window_features: (E, W, D) embeddings of the windows, where they are fixed during the update, else None.
    """

    groups: TensorDict
    frames: torch.Tensor
    window_count: torch.Tensor
    step_window: torch.Tensor
    step_count: torch.Tensor
    window_features: torch.Tensor | None = None

    @property
    def has_frames(self) -> bool:
        """Whether any step has seen a frame since its environment's reset."""
        return bool(self.window_count.any())

    @property
    def batch_size(self) -> torch.Size:
        """Number of control steps, as a one-element size."""
        return self.groups.batch_size

    def at_steps(self, steps: Sequence[int]) -> WindowedObservations:
        """Those of some control steps alone.

        Args:
            steps: indices of control steps in 0..T-1, E rows each.
        """
        num_envs = len(self.frames)
        rows = torch.cat([torch.arange(num_envs, device=self.frames.device) + step * num_envs for step in steps])
        return replace(
            self, groups=self.groups[rows], step_window=self.step_window[rows], step_count=self.step_count[rows]
        )

    def __getitem__(self, group: str) -> torch.Tensor:
        return self.groups[group]

    def __contains__(self, group: str) -> bool:
        return group in self.groups


def max_windows(num_steps: int, steps_per_frame: int) -> int:
    """Most LiDAR frames that can be the newest one during ``num_steps`` control steps."""
    return 1 + -(-(num_steps - 1) // steps_per_frame)


def point_cloud_bytes(
    num_envs: int, num_steps: int, num_points: int, history: int, steps_per_frame: int
) -> tuple[int, int]:
    """Bytes of float32 point clouds in one rollout: (each frame once, each step's whole window).

    With the paper's 4096 environments, 24 steps, 256 + 128 points, 10 frames and 5 control steps per frame:
    (283,115,520, 4,529,848,320).
    """
    frame = num_envs * num_points * 3 * 4
    return frame * (history - 1 + max_windows(num_steps, steps_per_frame)), frame * history * num_steps


class PerceptiveStorage(RolloutStorage):
    """Rollout storage for PPO, with or without LiDAR frames.

    One-dimensional groups are stored per step by rsl_rl. With frames, the H frames seen at the first step are
    copied and then one frame per tick; a step keeps its tick and its count of valid frames. Mini-batches are
    then random subsets of environments with all their steps, so that each window is embedded once per
    mini-batch. Without frames the mini-batches are rsl_rl's.
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
            steps_per_frame: least control steps between two frames; 1 is always enough, the true value saves
                memory.
        """
        super().__init__("rl", num_envs, num_steps, obs.select(*stored_groups), [num_actions], device)
        self.stored_groups = stored_groups
        self.has_frames = frames
        if not frames:
            return
        missing = [name for name in FRAME_GROUPS if name not in obs]
        if missing:
            raise ValueError(
                f"the actor reads LiDAR frames but the environment gives no observations {missing};"
                " choose a perception that fits the environment"
            )
        if steps_per_frame < 1:
            raise ValueError(f"steps_per_frame must be at least 1, got {steps_per_frame}")
        self.history = obs["frames"].shape[1]
        self.steps_per_frame = steps_per_frame
        capacity = self.history - 1 + max_windows(num_steps, steps_per_frame)
        self.frames = torch.zeros(num_envs, capacity, *obs["frames"].shape[2:], device=device)
        self.frame_count = torch.zeros(num_steps, num_envs, dtype=torch.int16, device=device)
        self.window_features: torch.Tensor | None = None
        self._step_windows: list[int] = []
        self._ticks: list[int] = []

    @property
    def num_windows(self) -> int:
        """Windows recorded in this rollout so far."""
        return len(self._ticks)

    @property
    def first_steps(self) -> list[int]:
        """The first control step of this rollout at which each window is the newest."""
        return [self._step_windows.index(window) for window in range(self.num_windows)]

    def record_frames(self, obs: TensorDict, tick: int) -> None:
        """Copy what is new in the observations of the current step; call before the environment moves on.

        Args:
            obs: observations of the step.
            tick: number of their newest frame, which is the same in all environments.
        """
        if not self.has_frames:
            return
        if len(self._step_windows) != self.step:
            raise RuntimeError(
                f"storage: frames recorded for {len(self._step_windows)} steps, transitions for"
                f" {self.step}; call record_frames once before each add_transition"
            )
        if not self._ticks:
            self.frames[:, : self.history].copy_(obs["frames"])
            self._ticks.append(tick)
        elif tick != self._ticks[-1]:
            slot = self.history - 1 + len(self._ticks)
            if tick != self._ticks[-1] + 1:
                raise ValueError(
                    f"storage: LiDAR tick {tick} follows {self._ticks[-1]} at step {self.step};"
                    " frame_tick must grow by one per frame, at most once per control step"
                )
            if slot >= self.frames.shape[1]:
                raise ValueError(
                    f"storage: frame {slot + 1 - self.history} of this rollout comes at step {self.step},"
                    f" but steps_per_frame={self.steps_per_frame}; set it to the environment's value"
                )
            self.frames[:, slot].copy_(obs["frames"][:, -1])
            self._ticks.append(tick)
        self._step_windows.append(len(self._ticks) - 1)
        self.frame_count[self.step].copy_(obs["frame_count"].squeeze(-1))

    def add_transition(self, transition: RolloutStorage.Transition) -> None:
        """Store one transition; of the observations only the groups that are read."""
        transition.observations = transition.observations.select(*self.stored_groups)
        super().add_transition(transition)

    def clear(self) -> None:
        """Start the next rollout."""
        super().clear()
        if self.has_frames:
            self.window_features = None
            self._step_windows.clear()
            self._ticks.clear()

    def mini_batch_generator(
        self, num_mini_batches: int, num_epochs: int = 8
    ) -> Generator[RolloutStorage.Batch, None, None]:
        """Shuffled mini-batches: of steps without frames, of whole environments with frames.

        Environments are spread over the mini-batches as evenly as possible (sizes differ by one at most) and
        each is visited once per epoch, in a new order.
        """
        if not self.has_frames:
            yield from super().mini_batch_generator(num_mini_batches, num_epochs)
            return
        if self.num_envs < num_mini_batches:
            raise ValueError(
                f"{self.num_envs} environments cannot fill {num_mini_batches} mini-batches of whole"
                f" environments; set num_mini_batches to at most {self.num_envs}"
            )
        for _ in range(num_epochs):
            for env_ids in self.shuffled_envs(num_mini_batches):
                yield self._batch(env_ids)

    def shuffled_envs(self, num_parts: int) -> tuple[torch.Tensor, ...]:
        """All environments in a new order, in parts whose sizes differ by one at most."""
        return torch.randperm(self.num_envs, device=self.device).tensor_split(num_parts)

    def _batch(self, env_ids: torch.Tensor) -> RolloutStorage.Batch:
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

    def observations_of(self, env_ids: torch.Tensor) -> WindowedObservations:
        """What some environments saw at all steps, flattened in (step, environment) order."""
        num_windows = self.num_windows
        window = torch.tensor(self._step_windows, device=self.device)  # (T,)
        step_count = self.frame_count[:, env_ids]  # (T, E)
        # Within a tick an environment's count is constant or, after a reset, 0: the largest is the window's.
        count = step_count.new_zeros(num_windows, len(env_ids))
        count.scatter_reduce_(0, window.unsqueeze(1).expand_as(step_count), step_count, "amax")
        first = torch.arange(len(env_ids), device=self.device) * num_windows
        return WindowedObservations(
            groups=self.observations[:, env_ids].flatten(0, 1),
            frames=self.frames[env_ids, : self.history - 1 + num_windows],
            window_count=count.t().contiguous().long(),
            step_window=(first + window.unsqueeze(1)).flatten(),
            step_count=step_count.flatten().long(),
            window_features=None if self.window_features is None else self.window_features[env_ids],
        )
