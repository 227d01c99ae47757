"""How much memory a perception network needs to be trained, counted before anything is allocated."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from functools import partial

import torch

from omniperception.learning.config import PerceptionConfig, PPOConfig
from omniperception.learning.storage import max_windows, point_cloud_bytes

GB = 1e9
FLOAT = 4
"""Bytes of a float32."""


@dataclass(frozen=True)
class Footprint:
    """Bytes that one perception network needs; policy, critic and simulation come on top.

    Attributes:
        weights: float32 parameters.
        gradients: as many.
        optimizer: Adam's two moments.
        sensor: the history of sampled frames that the environment keeps, twice while a frame is appended.
        rollout: frames stored for the update.
        mini_batch: the frames of a mini-batch and what the forward pass keeps for the backward pass.
    """

    weights: int
    gradients: int
    optimizer: int
    sensor: int
    rollout: int
    mini_batch: int

    @property
    def parameters(self) -> int:
        """Number of weights."""
        return self.weights // FLOAT

    @property
    def total(self) -> int:
        """Bytes altogether."""
        return sum(getattr(self, field.name) for field in fields(self))


def footprint(
    perception: PerceptionConfig, ppo: PPOConfig, num_envs: int, steps_per_frame: int, window_per_step: bool = False
) -> Footprint:
    """Memory for training ``perception`` with ``num_envs`` environments.

    The network is built and run on torch's meta device, where tensors have sizes and no memory.

    Args:
        perception: network, sampler and history.
        ppo: steps per rollout and mini-batches.
        num_envs: N.
        steps_per_frame: control steps between two LiDAR frames.
        window_per_step: as if every control step's whole window of frames were stored and embedded, as a storage that
            knows nothing of frames does.
    """
    with torch.device("meta"):
        network = perception.build_network()
    weights = FLOAT * sum(parameter.numel() for parameter in network.parameters())
    frame = FLOAT * 3 * network.num_points * num_envs
    num_steps, history = ppo.num_steps_per_env, network.history
    shared, windows = point_cloud_bytes(num_envs, num_steps, network.num_points, history, steps_per_frame)
    batch, num_windows = -(-num_envs // ppo.num_mini_batches), max_windows(num_steps, steps_per_frame)
    if window_per_step:
        batch, num_windows = batch * num_steps, 1
    return Footprint(
        weights=weights,
        gradients=weights,
        optimizer=2 * weights,
        sensor=(2 * history + 1) * frame,
        rollout=windows if window_per_step else shared,
        mini_batch=_kept_for_backward(network, batch, num_windows),
    )


def largest_cloud(
    perception: PerceptionConfig,
    ppo: PPOConfig,
    num_envs: int,
    steps_per_frame: int,
    budget: float,
    window_per_step: bool = False,
) -> int:
    """Most rays per frame whose raw cloud fits ``budget`` bytes; for a network whose memory is linear in them."""

    def total(num_rays: int) -> int:
        sampler = partial(perception.sampler.func, **{**perception.sampler.keywords, "num_rays": num_rays})
        return footprint(replace(perception, sampler=sampler), ppo, num_envs, steps_per_frame, window_per_step).total

    one, two = total(1000), total(2000)
    return max(0, int(1000 + (budget - one) * 1000 / (two - one)))


def check_fits(
    perception: PerceptionConfig, ppo: PPOConfig, num_envs: int, steps_per_frame: int, device: str | torch.device
) -> None:
    """Refuses a network that cannot fit in ``perception.memory_gb``, by default all memory of the device.

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
        f" {4 * needs.weights / GB:.2f} GB with gradients and Adam; frames of the sensor {needs.sensor / GB:.2f} GB, of"
        f" the rollout {needs.rollout / GB:.2f} GB, a mini-batch {needs.mini_batch / GB:.2f} GB), but there are"
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


def _kept_for_backward(network: torch.nn.Module, batch: int, num_windows: int) -> int:
    """Bytes that a training forward pass of ``batch`` environments holds, its input included."""
    device = next(network.parameters()).device
    frames = torch.empty(batch, network.history - 1 + num_windows, network.num_points, 3, device=device)
    count = torch.zeros(batch, num_windows, dtype=torch.long, device=device)
    with _saved_storages() as storages:
        output = network(frames, count)
    owned = {parameter.untyped_storage()._cdata for parameter in network.parameters()}
    storages |= {tensor.untyped_storage()._cdata: tensor.untyped_storage() for tensor in (frames, count, output)}
    return sum(storage.nbytes() for key, storage in storages.items() if key not in owned)


@contextmanager
def _saved_storages() -> Iterator[dict[int, torch.UntypedStorage]]:
    """The distinct memory of all tensors that are saved for a backward pass within the block."""
    found: dict[int, torch.UntypedStorage] = {}

    def keep(tensor: torch.Tensor) -> torch.Tensor:
        storage = tensor.untyped_storage()
        found[storage._cdata] = storage
        return tensor

    with torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor):
        yield found
