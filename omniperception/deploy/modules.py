"""The actor without exploration as a network of plain tensors, written as TorchScript and as ONNX."""

from __future__ import annotations

import copy
import warnings
from pathlib import Path

import torch
from rsl_rl.models import MLPModel
from torch import nn

from omniperception.learning.models import PerceptionActor

OPSET = 18
"""ONNX operator set of the exported network."""


class ExportUnavailable(RuntimeError):
    """A package is missing or the network cannot be exported; the message is one line."""


class BlindNetwork(nn.Module):
    """Flat observations -> actions; the observations' normalisation is part of it."""

    input_names = ("observations",)

    def __init__(self, actor: MLPModel) -> None:
        """Args: actor: copied, on the CPU."""
        super().__init__()
        self.actor = copy.deepcopy(actor).cpu().eval().requires_grad_(False)
        self.output = actor.distribution.as_deterministic_output_module() if actor.distribution else nn.Identity()
        self.observation_size = actor.obs_dim

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        """(B, observation_size), the actor's groups in order -> (B, num_actions)."""
        return self.output(self.actor.mlp(self.actor.obs_normalizer(observations)))

    def examples(self, batch: int) -> tuple[torch.Tensor, ...]:
        """Random inputs."""
        return (torch.randn(batch, self.observation_size),)


class PerceptiveNetwork(BlindNetwork):
    """Flat observations and a history of sampled frames -> actions."""

    input_names = ("observations", "frames", "frame_count")

    def __init__(self, actor: PerceptionActor, command_start: int) -> None:
        """Args: actor: copied, on the CPU; command_start: where (v_x, v_y) begin in the observations."""
        super().__init__(actor)
        self.command_start = command_start

    def forward(self, observations: torch.Tensor, frames: torch.Tensor, frame_count: torch.Tensor) -> torch.Tensor:
        """(B, observation_size), (B, H, P, 3) newest last, (B, 1) int64 newest valid frames -> (B, num_actions)."""
        features = self.actor.perception(frames, frame_count)[:, 0]
        if self.actor.read_out is not None:
            start, stop = self.command_start, self.command_start + 2
            command = observations[:, start:stop]
            command = command + self.actor.read_out.velocity(features, command) * (frame_count > 0)
            observations = torch.cat((observations[:, :start], command, observations[:, stop:]), 1)
        return self.output(self.actor.mlp(torch.cat((self.actor.obs_normalizer(observations), features), 1)))

    def examples(self, batch: int) -> tuple[torch.Tensor, ...]:
        """Random inputs, with every number of valid frames in turn."""
        history, points = self.actor.perception.history, self.actor.perception.num_points
        count = torch.arange(batch)[:, None] % (history + 1)
        bearing, nearness = 2 * torch.pi * torch.rand(2, batch, history, points)
        nearness = (-nearness).exp()  # a place in the plane and its proximity, as rows of a grid are
        rows = torch.stack((nearness * bearing.cos(), nearness * bearing.sin(), nearness), -1)
        rows[:, :, -1] *= 0.1  # motion from frame to frame is small
        return *super().examples(batch), rows, count


def exportable(actor: MLPModel, group_sizes: dict[str, int]) -> BlindNetwork:
    """The actor as a network of plain tensors.

    Args:
        actor: of a runner.
        group_sizes: numbers in each of its observation groups, in order.
    """
    if not isinstance(actor, PerceptionActor):
        return BlindNetwork(actor)
    before = 0
    if actor.read_out is not None:
        names = list(group_sizes)
        before = sum(group_sizes[name] for name in names[: names.index(actor.command_group)])
    return PerceptiveNetwork(actor, before)


def write_torchscript(network: BlindNetwork, path: Path) -> None:
    """Writes the network as TorchScript, for any batch size."""
    with torch.no_grad(), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that tracing is deprecated, and that checks of shapes are not traced
        torch.jit.trace(network, network.examples(2), check_trace=False).save(str(path))


def write_onnx(network: BlindNetwork, path: Path) -> None:
    """Writes the network as ONNX, for any batch size.

    torch's TorchScript-based exporter is used: the other one's packages, onnxscript and onnx-ir, are not needed then.
    """
    try:
        import onnx  # noqa: F401  torch's exporter needs it
    except ImportError:
        raise ExportUnavailable(
            "ONNX export needs onnx: pip install 'omniperception[export]', or give formats=torchscript"
        ) from None
    names = list(network.input_names)
    with torch.no_grad(), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.onnx.export(
            network,
            network.examples(2),
            str(path),
            input_names=names,
            output_names=["actions"],
            dynamic_axes={name: {0: "batch"} for name in (*names, "actions")},
            opset_version=OPSET,
            dynamo=False,
        )
