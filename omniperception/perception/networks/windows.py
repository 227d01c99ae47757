"""Layers over sliding windows of frames: each frame enters a layer once, however many windows contain it.

Window w of a (B, F, ...) sequence covers frames w .. w + H - 1, so W = F - H + 1 windows; count (B, W) is the number of
a window's newest frames that are valid.
"""

from __future__ import annotations

import torch
from torch import nn
from torch.nn import functional


def window_count(frames: torch.Tensor, count: torch.Tensor, history: int) -> int:
    """W, after checking that ``frames`` (B, F, ...) and ``count`` (B, W) belong together."""
    num_windows = frames.shape[1] - history + 1
    if num_windows < 1 or tuple(count.shape) != (frames.shape[0], num_windows):
        raise ValueError(
            f"{frames.shape[1]} frames give {num_windows} windows of {history}; count must have shape"
            f" {(frames.shape[0], num_windows)}, got {tuple(count.shape)}"
        )
    return num_windows


def valid_frames(count: torch.Tensor, history: int) -> torch.Tensor:
    """(B, W, H) bool: which frames of each window are valid, oldest first."""
    age = torch.arange(history - 1, -1, -1, device=count.device)
    return age < count.unsqueeze(-1)


class WindowedGru(nn.GRU):
    """A GRU whose last state over each window is wanted; parameters are those of ``nn.GRU`` with one layer.

    The input projection W_ih x + b_ih does not depend on the state, so it is computed once per frame and shared by the
    H windows that contain the frame; the H recurrent steps then run over all B * W windows at once. Frames older than
    a window's count are skipped: the state stays zero until the first valid frame.
    """

    weight_ih_l0: torch.Tensor
    bias_ih_l0: torch.Tensor
    weight_hh_l0: torch.Tensor
    bias_hh_l0: torch.Tensor

    def __init__(self, input_size: int, hidden_size: int, history: int) -> None:
        """Args: input_size: numbers per frame; hidden_size: size of the embedding; history: H, frames per window."""
        super().__init__(input_size, hidden_size, batch_first=True)
        self.history = history

    def forward(self, frames: torch.Tensor, count: torch.Tensor) -> torch.Tensor:  # type: ignore[override]  # own inputs
        """Frames (B, F, input_size) and count (B, W) -> last hidden states (B, W, hidden_size)."""
        num_windows = window_count(frames, count, self.history)
        gates, new = 2 * self.hidden_size, self.hidden_size  # PyTorch's order: reset, update, new
        projected = functional.linear(frames, self.weight_ih_l0, self.bias_ih_l0).to(self.weight_hh_l0.dtype)
        valid = valid_frames(count, self.history).unsqueeze(-1)  # (B, W, H, 1)
        state = projected.new_zeros(*count.shape, self.hidden_size)
        for k in range(self.history):
            frame_gates, frame_new = projected[:, k : k + num_windows].split((gates, new), -1)
            recurrent = functional.linear(state, self.weight_hh_l0, self.bias_hh_l0) if k else self.bias_hh_l0
            state_gates, state_new = recurrent.to(state.dtype).split((gates, new), -1)
            reset, update = (frame_gates + state_gates).sigmoid_().chunk(2, -1)
            candidate = torch.addcmul(frame_new, reset, state_new).tanh_()
            state = torch.where(valid[:, :, k], torch.lerp(candidate, state, update), state)
        return state


class WindowedLinear(nn.Module):
    """A linear layer on a window's flattened frames, invalid frames zeroed, without building the windows."""

    def __init__(self, frame_size: int, output_size: int, history: int) -> None:
        """Args: frame_size: numbers per frame; output_size; history: H, frames per window."""
        super().__init__()
        self.history = history
        self.linear = nn.Linear(history * frame_size, output_size)

    def forward(self, frames: torch.Tensor, count: torch.Tensor) -> torch.Tensor:
        """Frames (B, F, frame_size) and count (B, W) -> (B, W, output_size)."""
        num_windows = window_count(frames, count, self.history)
        valid = valid_frames(count, self.history).unsqueeze(-1)  # (B, W, H, 1)
        weights = self.linear.weight.unflatten(1, (self.history, -1)).unbind(1)  # H x (output, frame_size)
        total: torch.Tensor = self.linear.bias
        for k, weight in enumerate(weights):
            part = functional.linear(frames[:, k : k + num_windows], weight)
            total = total + part.masked_fill(~valid[:, :, k], 0.0)
        return total
