"""Memory that training a perception network needs, known before anything is allocated."""

from __future__ import annotations

import os
from dataclasses import dataclass

import torch

from omniperception.learning.config import PerceptionConfig, PPOConfig
from omniperception.learning.storage import max_windows
from omniperception.perception import PerceptionNetwork

GB = 1e9
FLOAT = 4
"""Bytes of a float32."""


@dataclass(frozen=True)
class Footprint:
    """Bytes that one perception network needs; policy, critic and simulation come on top.

    Attributes:
        parameters: number of weights.
        sensor: the history of sampled frames that the environment keeps, twice while a frame is appended.
        rollout: frames stored for the update.
        mini_batch: the frames of a mini-batch and what the forward pass keeps for the backward pass.
    """

    parameters: int
    sensor: int
    rollout: int
    mini_batch: int

    @property
    def optimization(self) -> int:
        """Weights, gradients and Adam's two moments."""
        return 4 * FLOAT * self.parameters

    @property
    def total(self) -> int:
        """Bytes altogether."""
        return self.optimization + self.sensor + self.rollout + self.mini_batch


def footprint(perception: PerceptionConfig, ppo: PPOConfig, num_envs: int, steps_per_frame: int) -> Footprint:
    """Memory for training `perception` with `num_envs` environments and a LiDAR frame every `steps_per_frame` steps.

    The network is built and run on torch's meta device, where tensors have sizes and no memory.
    """
    with torch.device("meta"):
        network = perception.build_network()
    frame = FLOAT * 3 * network.num_points * num_envs
    windows = max_windows(ppo.num_steps_per_env, steps_per_frame)
    return Footprint(
        parameters=sum(parameter.numel() for parameter in network.parameters()),
        sensor=(2 * network.history + 1) * frame,
        rollout=(network.history - 1 + windows) * frame,
        mini_batch=kept_for_backward(network, -(-num_envs // ppo.num_mini_batches), windows),
    )


def kept_for_backward(network: PerceptionNetwork, batch: int, num_windows: int) -> int:
    """Bytes that a training forward pass of `batch` environments holds, its input included."""
    device = next(network.parameters()).device
    frames = torch.empty(batch, network.history - 1 + num_windows, network.num_points, 3, device=device)
    count = torch.zeros(batch, num_windows, dtype=torch.long, device=device)
    kept = [frames, count]

    def keep(tensor: torch.Tensor) -> torch.Tensor:
        kept.append(tensor)
        return tensor

    with torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor):
        kept.append(network(frames, count))
    storages = {tensor.untyped_storage()._cdata: tensor.untyped_storage() for tensor in kept}
    for parameter in network.parameters():
        storages.pop(parameter.untyped_storage()._cdata, None)
    return sum(storage.nbytes() for storage in storages.values())


def check_fits(
    perception: PerceptionConfig, ppo: PPOConfig, num_envs: int, steps_per_frame: int, device: str | torch.device
) -> None:
    """Refuse a network that cannot fit in ``perception.memory_gb``, by default all memory of the device.

    Raises:
        ValueError: one line with the numbers.
    """
    needs = footprint(perception, ppo, num_envs, steps_per_frame)
    limit = perception.memory_gb * GB if perception.memory_gb else device_bytes(device)
    if limit is None or needs.total <= limit:
        return
    name = getattr(perception.network, "func", perception.network).__name__
    raise ValueError(
        f"{name} needs {needs.total / GB:.1f} GB with num_envs={num_envs} ({needs.parameters / 1e6:.1f} M parameters:"
        f" {needs.optimization / GB:.2f} GB with gradients and Adam; frames of the sensor {needs.sensor / GB:.2f} GB,"
        f" of the rollout {needs.rollout / GB:.2f} GB, a mini-batch {needs.mini_batch / GB:.2f} GB), but there are"
        f" {limit / GB:.1f} GB; lower num_envs or the points per frame, raise ppo.num_mini_batches or"
        " perception.memory_gb, or use perception=pd_risknet"
    )


def device_bytes(device: str | torch.device) -> int | None:
    """All memory of a device, or None where the system does not tell."""
    if torch.device(device).type == "cuda":
        return torch.cuda.get_device_properties(device).total_memory
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (ValueError, OSError, AttributeError):
        return None
