"""Layers over sliding windows of frames: each frame enters a layer once, however many windows contain it.

Window w of a (B, F, ...) sequence covers frames w .. w + H - 1, so W = F - H + 1 windows; count (B, W) says
how many of a window's newest frames are valid.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from functools import partial

import torch
from torch import nn
from torch.autograd.function import once_differentiable
from torch.nn import functional

aten = torch.ops.aten


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

    The input projection W_ih x + b_ih does not depend on the state, so it is computed once per frame and
    shared by the H windows that contain the frame; the H recurrent steps then run over all B * W windows at
    once. Frames older than a window's count are skipped: the state stays zero until the first valid frame.
    """

    def __init__(self, input_size: int, hidden_size: int, history: int) -> None:
        """Args: input_size: numbers per frame; hidden_size: size of the embedding; history: H, frames per
        window."""
        super().__init__(input_size, hidden_size, batch_first=True)
        self.history = history

    def forward(self, frames: torch.Tensor, count: torch.Tensor) -> torch.Tensor:
        """Frames (B, F, input_size) and count (B, W) -> last hidden states (B, W, hidden_size)."""
        window_count(frames, count, self.history)
        projected = functional.linear(frames, self.weight_ih_l0, self.bias_ih_l0)  # (B, F, 3 hidden)
        valid = valid_frames(count, self.history).unsqueeze(-1)  # (B, W, H, 1)
        unroll = _UnrolledGru.apply if torch.is_grad_enabled() else _last_states
        return unroll(projected.to(self.weight_hh_l0.dtype), valid, self.weight_hh_l0, self.bias_hh_l0)


def _last_states(
    projected: torch.Tensor, valid: torch.Tensor, weight: torch.Tensor, bias: torch.Tensor, saved: list | None = None
) -> torch.Tensor:
    """(B, F, 3 h), (B, W, H, 1) bool, (3 h, h), (3 h,) -> last states (B, W, h).

    Every step's (state before it, gates, new state, what recurs into it) is appended to `saved`.
    """
    batch, windows, history, _ = valid.shape
    hidden = weight.shape[1]
    state = projected.new_zeros(batch, windows, hidden)
    for k in range(history):
        from_frame = projected[:, k : k + windows]
        recurrent = functional.linear(state, weight, bias).to(state.dtype) if k else bias.expand_as(from_frame)
        gates = (from_frame[..., : 2 * hidden] + recurrent[..., : 2 * hidden]).sigmoid_()
        reset, update = gates.split(hidden, dim=-1)
        recurrent_new = recurrent[..., 2 * hidden :]
        new = torch.addcmul(from_frame[..., 2 * hidden :], reset, recurrent_new).tanh_()
        if saved is not None:
            saved.append((state, gates, new, recurrent_new))
        state = torch.where(valid[:, :, k], torch.lerp(new, state, update), state)
    return state


class _UnrolledGru(torch.autograd.Function):
    """The recurrent steps over all windows, with the backward pass written out.

    Autograd would make three times as many small operations and accumulate the weights' gradient step by step; here it
    is one matrix product over all steps. Gate order is PyTorch's: reset, update, new. Under autocast the matrix
    products of both passes are of its type and everything else stays float32.
    """

    @staticmethod
    def forward(
        ctx, projected: torch.Tensor, valid: torch.Tensor, weight: torch.Tensor, bias: torch.Tensor
    ) -> torch.Tensor:
        """As :func:`_last_states`."""
        keep = any(ctx.needs_input_grad)
        saved = [] if keep else None
        state = _last_states(projected, valid, weight, bias, saved)
        if keep:
            ctx.save_for_backward(valid, weight, *(tensor for step in saved for tensor in step))
            ctx.num_frames = projected.shape[1]
            ctx.autocast = _autocast_like_now(projected.device.type)
        return state

    @staticmethod
    @once_differentiable
    def backward(ctx, gradient: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        valid, weight, *saved = ctx.saved_tensors
        batch, windows, history, _ = valid.shape
        hidden = weight.shape[1]
        d_projected = gradient.new_zeros(batch, ctx.num_frames, 3 * hidden)
        d_recurrent = gradient.new_empty(history, batch, windows, 3 * hidden)
        for k in reversed(range(history)):
            state, gates, new, recurrent_new = saved[4 * k : 4 * k + 4]
            reset, update = gates.split(hidden, dim=-1)
            d_step = d_recurrent[k]
            d_state = gradient * valid[:, :, k]
            through_new = torch.addcmul(d_state, d_state, update, value=-1.0)
            d_new = aten.tanh_backward(through_new, new)
            torch.mul(d_new, recurrent_new, out=d_step[..., :hidden])
            torch.mul(d_state, state - new, out=d_step[..., hidden : 2 * hidden])
            d_gates = d_step[..., : 2 * hidden]
            aten.sigmoid_backward(d_gates, gates, grad_input=d_gates)
            torch.mul(d_new, reset, out=d_step[..., 2 * hidden :])
            d_projected[:, k : k + windows, : 2 * hidden] += d_gates
            d_projected[:, k : k + windows, 2 * hidden :] += d_new
            if k:
                with ctx.autocast():
                    d_previous = (d_step @ weight).to(gradient.dtype)
                gradient = (gradient - through_new).add_(d_previous)
        # The first step starts from zero: it adds to the bias's gradient alone.
        states = torch.stack(saved[0::4]).flatten(0, 2)[batch * windows :]
        flat = d_recurrent.flatten(0, 2)
        with ctx.autocast():
            d_weight = (flat[batch * windows :].t() @ states).to(weight.dtype)
        return d_projected, None, d_weight, flat.sum(0)


def _autocast_like_now(device_type: str) -> Callable[[], AbstractContextManager]:
    """Makes contexts with the present state of autocast, for a backward pass, which runs outside of it."""
    if not torch.amp.is_autocast_available(device_type):  # torch's meta device, on which memory is counted
        return nullcontext
    enabled, dtype = torch.is_autocast_enabled(device_type), torch.get_autocast_dtype(device_type)
    return partial(torch.autocast, device_type, dtype=dtype, enabled=enabled)


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
        total = self.linear.bias
        for k, weight in enumerate(weights):
            part = functional.linear(frames[:, k : k + num_windows], weight)
            total = total + part.masked_fill(~valid[:, :, k], 0.0)
        return total
