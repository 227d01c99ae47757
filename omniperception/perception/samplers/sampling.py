"""Samplers that turn one LiDAR frame into a fixed number of points: raw, farthest points, proximal and distal."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence

import torch
import warp as wp

from omnilidar.launch import launch_over_envs, view
from omniperception.perception.samplers import kernels, sorting, sorting_kernels
from omniperception.perception.samplers.base import Sampler
from omniperception.perception.samplers.kernels import Work

BUCKETS_FROM = 1024
"""Points from which on farthest point sampling by buckets is faster on a CPU than looking at every point."""


class RawSampler(Sampler):
    """Every ray's point in ray order, a miss as zeros: the input of the direct MLP."""

    def __init__(self, num_rays: int, *, max_range: float, num_threads: int | None = None) -> None:
        """Args: num_rays: R of every frame; max_range: metres; num_threads: those of `use_threads` by default."""
        super().__init__(num_rays, max_range, num_threads)

    @property
    def sizes(self) -> dict[str, int]:
        return {"num_rays": self.num_points}

    def _sample(self, ranges, directions_s, elevation, azimuth, out, attitude) -> None:
        if ranges.shape[1] != self.num_points:
            raise ValueError(f"sampler: frames of {self.num_points} rays were said, got {ranges.shape[1]}")
        launch, lanes = _launcher(ranges, self.num_threads), kernels.LANES[ranges.device.type]
        cloud, points = (view(ranges, wp.float32), view(directions_s, wp.vec3)), view(out, wp.vec3)
        launch(kernels.write_raw, lanes, *cloud, 1.0 / self.max_range, lanes, points)


class PdSampler(Sampler):
    """PD-RiskNet's proximal and distal sampling (paper, Sec. 3.3.1).

    The cloud is split by elevation in the sensor frame: proximal where theta > ``split_deg``, distal elsewhere.
    Proximal points are picked by exact farthest point sampling, which starts at the first proximal hit in ray order and
    never picks a point twice (of equally far points the first in ray order). Distal points are sorted and cut into bins
    of consecutive points, one mean per bin. Both halves are sorted by (theta ring, phi), where
    ring = floor((theta + pi / 2) / ring_deg) and phi starts at -pi in steps of 2 pi / 65536. With fewer points than
    slots each point has its own slot and the remaining slots are zero.

    Which direction a distal bin covers thus depends on how many hits there are before it in the order.
    """

    def __init__(
        self,
        num_proximal: int = 256,
        num_distal: int = 128,
        *,
        max_range: float,
        split_deg: float,
        ring_deg: float = 2.0,
        num_threads: int | None = None,
    ) -> None:
        """Configure the two halves.

        Args:
            num_proximal: slots of the proximal half, written first.
            num_distal: slots of the distal half.
            max_range: metres; points are divided by it.
            split_deg: elevation in the sensor frame that separates the halves, degrees.
            ring_deg: height of a theta ring for sorting, degrees.
            num_threads: CPU threads; those of `use_threads` by default.
        """
        if num_proximal < 0 or num_distal < 0:
            raise ValueError(f"num_proximal and num_distal must not be negative, got {num_proximal} and {num_distal}")
        super().__init__(num_proximal + num_distal, max_range, num_threads)
        if not 180.0 / kernels.MAX_RING < ring_deg <= 180.0:
            raise ValueError(f"ring_deg must lie in (0.006, 180], got {ring_deg}")
        if math.isnan(split_deg):
            raise ValueError("split_deg must be a number of degrees, got nan")
        self.buckets_from = BUCKETS_FROM
        self.num_proximal = num_proximal
        self.num_distal = num_distal
        self.split = math.radians(split_deg)
        self.ring = math.radians(ring_deg)
        self._work: Work | None = None
        self._work_fits: tuple[int, tuple] = (0, ())
        self._tensors: dict[str, torch.Tensor] = {}

    @property
    def sizes(self) -> dict[str, int]:
        return {"num_proximal": self.num_proximal, "num_distal": self.num_distal}

    def _sample(self, ranges, directions_s, elevation, azimuth, out, attitude) -> None:
        self._write_halves(ranges, directions_s, elevation, azimuth, out, num_bins=self.num_distal)

    def _write_halves(self, ranges, directions_s, elevation, azimuth, out, num_bins: int) -> None:
        """Writes the proximal half and the bins of the distal one."""
        device, lanes = ranges.device, kernels.LANES[ranges.device.type]
        num_envs, num_rays = ranges.shape
        work, launch = self._work_for(num_envs, num_rays, device), _launcher(ranges, self.num_threads)
        cloud = view(ranges, wp.float32), view(directions_s, wp.vec3)
        angles, points = (view(elevation, wp.float32), view(azimuth, wp.float32)), view(out, wp.vec3)
        order = cloud[0], *angles, self.split, self.ring, int(num_bins > 0)
        sorting.sort_rays(launch, lanes, work, self._tensors, num_envs, order)
        scale, k = 1.0 / self.max_range, self.num_proximal
        if k:
            block = kernels.BLOCK[device.type]
            picks = scale, self.ring, k, block, self.buckets_from
            launch(kernels.pick_farthest, block, *cloud, *angles, *picks, work)
            launch(kernels.write_picked, lanes, k, lanes, work, points)
        if num_bins:
            launch(kernels.write_bins, lanes, *cloud, scale, k, num_bins, lanes, work, points)

    def _work_for(self, n: int, r: int, device: torch.device) -> Work:
        """Work memory for N environments of R rays, allocated when there are more of them than before."""
        most, fits = self._work_fits
        if self._work is not None and n <= most and fits == (r, device):
            return self._work
        by_bucket = device.type == "cpu" and self.num_proximal and r >= self.buckets_from
        num_words = -(-r // kernels.BUCKET_SIZE) * kernels.WORDS_PER_BUCKET if by_bucket else 0
        shapes = {
            "parts": (n, 3),
            "distance": (n, r),
            "buckets": (n, num_words),
            "picked": (n, self.num_proximal),
            "picked_keys": (n, self.num_proximal),
            "keys": (2, n, r),
            "items": (2, n, r),
            "histogram": (n, sorting_kernels.RADIX_SIZE),
        }
        tensors = {name: torch.empty(shape, dtype=torch.int32, device=device) for name, shape in shapes.items()}
        tensors |= {name: torch.empty(n, r, device=device) for name in "xyz"}
        tensors["rays"] = sorting.memory_of_order(tensors["items"])
        self._work, self._work_fits, self._tensors = Work(), (n, (r, device)), tensors
        for name, tensor in tensors.items():
            setattr(self._work, name, view(tensor, wp.float32 if tensor.is_floating_point() else wp.int32))
        return self._work


class ProximitySampler(PdSampler):
    """Proximal points as in :class:`PdSampler`; the distal half as proximities around the levelled base.

    Distal hits are binned by where they are: azimuth sector around the base and band of height, in the base's frame
    without roll and pitch, which the IMU gives. Each cell holds the bearing of its horizontally nearest hit times
    exp(-d / decay), and that proximity itself: (x, y, proximity), with free space 0. A network input thus always
    covers the same directions, does not move as the trunk rolls and pitches, and is large where an obstacle is near;
    the avoidance velocity (paper, Sec. 'Risk-Aware Locomotion Policy') is nearly linear in it. Sector 0 starts at -pi.
    Hits on the robot's own body, and nearer than ``blind``, are left out.
    """

    needs_attitude = True

    def __init__(
        self,
        num_proximal: int,
        num_sectors: int = 36,
        *,
        max_range: float,
        split_deg: float,
        band_edges: Sequence[float],
        decay: float,
        blind: float,
        body: Sequence[float],
        ring_deg: float = 2.0,
        num_threads: int | None = None,
    ) -> None:
        """Configure both halves.

        Args:
            num_proximal: slots of the proximal half, written first.
            num_sectors: azimuth sectors.
            max_range: metres; proximal points are divided by it.
            split_deg: elevation in the sensor frame that separates the halves, degrees.
            band_edges: increasing heights that separate the bands, metres above the base's origin.
            decay: distance over which the proximity falls by e, metres.
            blind: nearest range that counts, metres.
            body: half length and half width of the robot's own body around the base's origin, metres.
            ring_deg: height of a theta ring for sorting the proximal half, degrees.
            num_threads: CPU threads; those of `use_threads` by default.
        """
        edges = checked_edges(band_edges, num_sectors, decay)
        if not 0.0 <= blind < max_range:
            raise ValueError(f"blind={blind} must lie in [0, max_range={max_range})")
        if len(body) != 2 or min(body) < 0.0:
            raise ValueError(f"body={list(body)} must be [half length, half width] in metres")
        super().__init__(
            num_proximal,
            num_sectors * (len(edges) - 1),
            max_range=max_range,
            split_deg=split_deg,
            ring_deg=ring_deg,
            num_threads=num_threads,
        )
        self.num_sectors = num_sectors
        self.edges, self.decay, self.blind, self.body = torch.tensor(edges), decay, blind, tuple(body)
        self._nearest: torch.Tensor | None = None

    def _sample(self, ranges, directions_s, elevation, azimuth, out, attitude) -> None:
        if self.num_proximal:
            self._write_halves(ranges, directions_s, elevation, azimuth, out, num_bins=0)
        n, device = len(ranges), ranges.device
        if self._nearest is None or n > len(self._nearest) or self._nearest.device != device:
            with torch.inference_mode(False):  # a tensor of inference mode could not be zeroed outside of it
                self._nearest = torch.empty(n, self.num_distal, dtype=torch.int64, device=device)
            self.edges = self.edges.to(device)
        nearest = view(self._nearest[:n].zero_(), wp.int64)
        cloud, lanes = (view(ranges, wp.float32), view(directions_s, wp.vec3)), kernels.LANES[device.type]
        mount = view(attitude.base_quat, wp.vec4), wp.vec3(*attitude.mount_pos), wp.vec4(*attitude.mount_quat)
        counts = view(elevation, wp.float32), self.split, self.blind, wp.vec2(*self.body)
        cells = view(self.edges, wp.float32), self.num_sectors, self.decay
        launch = _launcher(ranges, self.num_threads)
        launch(kernels.find_nearest, lanes, *cloud, *mount, *counts, *cells, lanes, nearest)
        launch(kernels.write_nearest, lanes, *cloud, *mount, nearest, self.num_proximal, lanes, view(out, wp.vec3))


def checked_edges(band_edges: Sequence[float], num_sectors: int, decay: float) -> list[float]:
    """The edges of bands; a ValueError where they are none, or the other settings of cells cannot be."""
    edges = [float(edge) for edge in band_edges]
    if len(edges) < 2 or any(low >= high for low, high in itertools.pairwise(edges)):
        raise ValueError(f"band_edges={edges} must be at least two increasing heights")
    if num_sectors < 1 or not decay > 0.0:
        raise ValueError(f"num_sectors={num_sectors} must be at least 1 and decay={decay} positive")
    return edges


class FpsSampler(PdSampler):
    """Exact farthest point sampling over all hits, then sorted by (theta ring, phi); zeros after the last point.

    The sampling starts at the first hit in ray order, so a frame always gives the same points.
    """

    def __init__(
        self,
        num_points: int,
        *,
        max_range: float,
        ring_deg: float = 2.0,
        num_threads: int | None = None,
    ) -> None:
        """Configure the sampler.

        Args:
            num_points: slots.
            max_range: metres; points are divided by it.
            ring_deg: height of a theta ring for sorting, degrees.
            num_threads: CPU threads; those of `use_threads` by default.
        """
        super().__init__(
            num_points, 0, max_range=max_range, split_deg=-math.inf, ring_deg=ring_deg, num_threads=num_threads
        )

    @property
    def sizes(self) -> dict[str, int]:
        return {"num_points": self.num_points}


def _launcher(ranges: torch.Tensor, num_threads: int | None) -> Callable:
    """Launches a kernel over (N, lanes), or over (N,) where lanes is 0, with further arguments."""

    def launch(kernel: wp.Kernel, lanes: int, *inputs) -> None:
        block_dim = lanes if lanes > 1 else 256
        launch_over_envs(kernel, len(ranges), list(inputs), ranges.device, lanes, block_dim, num_threads)

    return launch
