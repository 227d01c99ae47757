"""Rings: the nearest hits around the levelled base by azimuth sector and band of height, over several frames that are
moved to the present pose of the base, and convolutions around the azimuth."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
import warp as wp
from torch import nn
from torch.nn import functional

from omnilidar.launch import constant, launch_over_envs, view
from omniperception.common.sectors import FAR, bearing_in_sectors, sector_at
from omniperception.perception.networks.kernels import LATERAL, LEAST_PROXIMITY, write_rings
from omniperception.perception.networks.motion_match import MotionMatch
from omniperception.perception.networks.windows import valid_frames, window_count

MOTION_CHANNELS = 3
"""Per sector: nearness, radial and tangential velocity of the nearest obstacle (:mod:`sector_motion`)."""


_GAIN = 8.0
"""Factor on all inputs, which are small because most cells are far or empty; speeds learning up several times."""

_WIDE, _WIDE_SPAN = 2, 11
"""Sectors between the taps of the convolution behind the risks, and their number: what crosses comes from the side."""

_SAFE = -3.0
"""Logit of an untrained risk."""

_REACH, _NEARNESS = 6.0, 2.0
"""Distance (m) at which the nearness of the nearest hit falls to 0, and the nearness of a hit at the base."""


def moved_rings(
    cells: torch.Tensor,
    moved: torch.Tensor,
    count: torch.Tensor,
    shape: RingShape,
    since: torch.Tensor | None = None,
) -> torch.Tensor:
    """The frames of every window, moved to the pose of the base when the window's newest frame came.

    Args:
        cells: (B, F, bands * S, 3) cells of :class:`StandingSampler`.
        moved: (B, F, 3) motion of the base since the frame before, in the levelled base of that one: x, y (m), yaw
            (rad).
        count: (B, W) valid frames of each window; the others are empty.
        shape: sizes and lengths of the rings.
        since: (B, F, 3) motion of the base since the frame was taken until it came, likewise; None: it comes at once.

    Returns:
        (B, W, H * bands * (len(decays) + 1), S), oldest frame first: for each band the proximities exp(-d / decay) of
        the nearest hit in the cell, and its bearing within the sector times the last of them; empty cells are 0.

    An exporter traces torch operations in place of the kernel, which is 2.4 times as fast (docs/lab/perception.md).
    """
    if torch.jit.is_tracing() or torch.onnx.is_in_onnx_export() or cells.is_meta:
        return _moved_rings(cells, moved, count, shape, since)
    batch, windows = count.shape
    bands = cells.shape[2] // shape.num_sectors
    rings = cells.new_zeros(batch, windows, shape.history * bands * shape.channels, shape.num_sectors)
    cells, count = cells.contiguous(), count.long().contiguous()
    origin, yaw = _poses(moved)
    here, heading = _later(origin, yaw, since)
    scratch = cells.new_empty(batch, bands, shape.num_sectors)
    decays = constant(shape.decays, cells.device)
    inputs = [
        view(cells, wp.vec3),
        view(origin, wp.vec2),
        view(yaw, wp.float32),
        view(here, wp.vec2),
        view(heading, wp.float32),
        view(count, wp.int64),
        shape.decay,
        view(decays, wp.float32),
        shape.history,
        bands,
        view(scratch, wp.float32),
        view(rings, wp.float32),
    ]
    launch_over_envs(write_rings, batch, inputs, cells.device)
    return rings


def _moved_rings(
    cells: torch.Tensor,
    moved: torch.Tensor,
    count: torch.Tensor,
    shape: RingShape,
    since: torch.Tensor | None = None,
) -> torch.Tensor:
    """:func:`moved_rings` in operations that can be exported."""
    bearing, proximity = cells[..., :2], cells[..., 2]
    hit = proximity > LEAST_PROXIMITY
    known = proximity.clamp(min=LEAST_PROXIMITY)
    places = bearing / known[..., None] * (-shape.decay * known.log())[..., None]
    places, hit = places.unflatten(2, (-1, shape.num_sectors)), hit.unflatten(2, (-1, shape.num_sectors))
    origin, yaw = _poses(moved)
    base, heading = _later(origin, yaw, since)
    fixed = _turned(yaw[:, :, None, None], places) + origin[:, :, None, None]
    windows = _windows(fixed, shape.history)  # (B, W, H, bands, S, 2)
    newest = slice(shape.history - 1, None)
    here = _turned(-heading[:, newest, None, None, None], windows - base[:, newest, None, None, None])
    hit = _windows(hit, shape.history) & valid_frames(count, shape.history)[..., None, None]
    distance = torch.where(hit, here.square().sum(-1).sqrt(), FAR)
    turned = bearing_in_sectors(here, shape.num_sectors)
    sector = sector_at(turned, shape.num_sectors)
    empty = 0.0 * distance  # not zeros_like, whose shape an exporter takes for a constant
    nearest = (empty + FAR).scatter_reduce(-1, sector, distance, "amin")
    is_nearest = (distance <= nearest.gather(-1, sector)) & hit
    within = (turned - sector - 0.5) * (2 * math.pi / shape.num_sectors)
    lateral = empty.scatter_reduce(-1, sector, torch.where(is_nearest, within, 0.0), "sum")
    proximities = [torch.exp(-nearest / decay) for decay in shape.decays]
    return torch.stack((*proximities, LATERAL * lateral * proximities[-1]), -2).flatten(2, 4)


def _windows(frames: torch.Tensor, history: int) -> torch.Tensor:
    """(B, F, ...) -> (B, F - H + 1, H, ...)."""
    count = frames.shape[1] - history + 1
    return torch.stack([frames[:, k : k + count] for k in range(history)], 2)


def _poses(moved: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Positions (B, F, 2) and headings (B, F) of the base at each frame, from its motion between frames."""
    yaw = moved[..., 2].cumsum(1)
    step = _turned(yaw - moved[..., 2], moved[..., :2])  # given in the base of the frame before
    return step.cumsum(1), yaw


def _later(origin: torch.Tensor, yaw: torch.Tensor, since: torch.Tensor | None) -> tuple[torch.Tensor, torch.Tensor]:
    """Positions (B, F, 2) and headings (B, F) of the base after it has moved on from there."""
    if since is None:
        return origin, yaw
    return origin + _turned(yaw, since[..., :2]), yaw + since[..., 2]


@dataclass(frozen=True)
class RingShape:
    """Sizes and lengths of rings.

    Attributes:
        num_sectors: S.
        history: H, frames per window.
        decay: decay of the sampler's proximities, metres.
        decays: decays of the rings' proximities, metres.
    """

    num_sectors: int
    history: int
    decay: float
    decays: tuple[float, ...]

    @property
    def channels(self) -> int:
        """Numbers per cell."""
        return len(self.decays) + 1


class RingPath(nn.Module):
    """A window's rings, stacked as channels, through convolutions around the azimuth.

    The path is equivariant to turns by whole sectors, so what is learned about an obstacle ahead holds on either side
    as well. All frames show an obstacle that stands still in the same cell, because they are moved to the same pose.
    """

    _velocities: torch.Tensor

    def __init__(
        self,
        num_cells: int,
        history: int,
        num_sectors: int = 36,
        decay: float = 0.5,
        decays: Sequence[float] = (0.5, 2.0),
        channels: Sequence[int] = (96, 64, 64, 64),
        kernel_sizes: Sequence[int] = (1, 5, 5, 1),
        match: MotionMatch | None = None,
        risk_rings: int = 0,
        times: bool = False,
    ) -> None:
        """Configure the path.

        Args:
            num_cells: of :class:`StandingSampler`, bands x sectors.
            history: H, frames per window.
            num_sectors: S.
            decay: decay of the sampler's proximities, metres.
            decays: decays of the proximities that the convolutions read, metres.
            channels: widths of the hidden layers.
            kernel_sizes: sectors that each hidden layer spans, odd.
            times: whether frames say when they were taken.
            risk_rings: speeds of velocities whose risk is said, in as many directions as there are sectors; 0: none.
            match: candidate velocities, scored against the nearest hits; None: the convolutions find motion alone.
        """
        super().__init__()
        if num_sectors < 1 or num_cells % num_sectors:
            lacks_motion = num_sectors > 0 and (num_cells + 1) % num_sectors == 0  # its row was taken from the cells
            raise ValueError(
                f"perception.network.rings: num_cells={num_cells} must be a multiple of num_sectors={num_sectors}"
                f"{'; it needs perception.base_motion=true' if lacks_motion else ''}"
            )
        if len(kernel_sizes) != len(channels) or any(n % 2 == 0 or not 0 < n <= num_sectors for n in kernel_sizes):
            raise ValueError(
                f"perception.network.rings.kernel_sizes={list(kernel_sizes)} must be one odd number, up to"
                f" num_sectors={num_sectors}, for each of the {len(channels)} channels"
            )
        for name, values in (("channels", channels), ("decays", decays), ("decay", [decay])):
            if not values or min(values) <= 0:
                raise ValueError(f"perception.network.rings.{name}={list(values)} must be at least one, all positive")
        num_bands = num_cells // num_sectors
        if match is not None and history < 2:
            raise ValueError(
                f"perception.history={history} shows no motion; take 2 or more, or perception.network.rings.match=null"
            )
        self.shape = RingShape(num_sectors, history, decay, tuple(decays))
        self.match = match
        width = history * num_bands * self.shape.channels
        if match is not None:
            width += (history - 1) * match.num_velocities + 2 * history
            self.register_buffer("_velocities", match.velocities(), persistent=False)
        width += history if times else 0
        layers: list[nn.Module] = []
        for size, span in zip(channels, kernel_sizes, strict=True):
            layers += [_RingConv(width, size, span), nn.ELU()]
            width = size
        self.layers = nn.Sequential(*layers, _from_zero(width, MOTION_CHANNELS))
        self.risk_rings = risk_rings
        self.risk: nn.Sequential | None = None
        if risk_rings:
            if num_sectors % 2 or num_sectors < _WIDE * (_WIDE_SPAN - 1):
                raise ValueError(f"perception.network.rings.risk_rings needs another num_sectors than {num_sectors}")
            wide = _RingConv(width + MOTION_CHANNELS, width, _WIDE_SPAN, dilation=_WIDE)
            self.risk = nn.Sequential(wide, nn.ELU(), _from_zero(width, risk_rings + 1, _SAFE))

    @property
    def feature_dim(self) -> int:
        """Numbers per window: MOTION_CHANNELS of each sector in turn, then the risks."""
        return self.motion_dim + (self.risk_rings * self.shape.num_sectors + 1 if self.risk_rings else 0)

    @property
    def motion_dim(self) -> int:
        """Of these the first ones, of the motion."""
        return MOTION_CHANNELS * self.shape.num_sectors

    def forward(
        self,
        cells: torch.Tensor,
        moved: torch.Tensor,
        count: torch.Tensor,
        since: torch.Tensor | None = None,
        times: torch.Tensor | None = None,
    ) -> torch.Tensor:
        """(B, F, bands * S, 3) cells, (B, F, 3) motion, (B, W) valid frames, (B, F, 3) motion since then, and (B, F, 3)
        whose first two numbers are the age and the time since the frame before (s) -> (B, W, D)."""
        window_count(cells, count, self.shape.history)
        rings = moved_rings(cells, moved, count, self.shape, since).flatten(0, 1)
        ages = None if times is None else self._ages(times)
        if self.match is not None:
            rings = torch.cat((rings, self._matched(rings, self.match, ages)), 1)
        if times is not None and ages is not None:
            age = times[:, self.shape.history - 1 :, 0].flatten()[:, None]
            known = torch.cat((age, ages), 1)[..., None].expand(-1, -1, rings.shape[-1])
            rings = torch.cat((rings, known), 1)
        hidden = self.layers[:-1](_GAIN * rings)
        motion = self.layers[-1](hidden)  # (B * W, 3, S)
        said = motion.transpose(1, 2).flatten(1)
        if self.risk is not None:
            said = torch.cat((said, self._risks(self.risk(torch.cat((hidden, motion), 1)))), 1)
        return said.reshape(*count.shape, self.feature_dim)

    def _risks(self, logits: torch.Tensor) -> torch.Tensor:
        """(n, 1 + R S) risks of standing still and of R speeds in S directions each, from straight ahead on
        counter-clockwise, as `VelocityRisk.candidates` has them, of logits (n, R + 1, S): a direction is the left edge
        of its sector, and to stand is as risky as the sector that says most."""
        ahead = self.shape.num_sectors // 2 - 1
        moving = torch.cat((logits[:, :-1, ahead:], logits[:, :-1, :ahead]), -1)
        return torch.sigmoid(torch.cat((logits[:, -1].amax(-1, keepdim=True), moving.flatten(1)), 1))

    def _ages(self, times: torch.Tensor) -> torch.Tensor:
        """(B * W, H - 1) s by which the frames of each window, the oldest first, were taken before its newest one."""
        taken = times[..., 1].cumsum(1)
        windows = _windows(taken, self.shape.history)
        return (windows[..., -1:] - windows[..., :-1]).flatten(0, 1)

    def _matched(self, rings: torch.Tensor, match: MotionMatch, ages: torch.Tensor | None) -> torch.Tensor:
        """(n, (H - 1) * K + 2 H, S): scores of candidate velocities, then nearness and bearing of each frame's nearest
        hit."""
        cells = rings.unflatten(1, (self.shape.history, -1, self.shape.channels))
        proximity, band = cells[:, :, :, -2].max(2)
        known = proximity.clamp(min=LEAST_PROXIMITY)
        bearing = cells[:, :, :, -1].gather(2, band[:, :, None])[:, :, 0] / (LATERAL * known)
        reach = -self.shape.decays[-1] * known.log()
        distance = torch.where(proximity > LEAST_PROXIMITY, reach, FAR)
        nearness = _NEARNESS * (1.0 - distance / _REACH).clamp(min=0.0)
        return torch.cat(
            (match(distance, bearing[:, -1], self._velocities, ages), nearness, 2.0 * LATERAL * bearing), 1
        )


class _RingConv(nn.Conv1d):
    """A convolution around the azimuth; ``padding_mode="circular"`` does the same and takes a tenth longer."""

    def forward(self, ring: torch.Tensor) -> torch.Tensor:
        step = int(self.dilation[0])
        reach = step * (self.kernel_size[0] // 2)
        closed = torch.cat((ring[..., -reach:], ring, ring[..., :reach]), -1) if reach else ring
        return functional.conv1d(closed, self.weight, self.bias, dilation=step)


def _from_zero(inputs: int, outputs: int, bias: float = 0.0) -> nn.Conv1d:
    """A last layer whose outputs are `bias` until it is trained."""
    layer = nn.Conv1d(inputs, outputs, 1)
    nn.init.zeros_(layer.weight)
    assert layer.bias is not None
    nn.init.constant_(layer.bias, bias)
    return layer


def _turned(yaw: torch.Tensor, vectors: torch.Tensor) -> torch.Tensor:
    """Vectors (..., 2) turned by angles (...) counter-clockwise."""
    cos, sin = yaw.cos(), yaw.sin()
    x, y = vectors.unbind(-1)
    return torch.stack((cos * x - sin * y, sin * x + cos * y), -1)
