"""Samplers that turn one LiDAR frame into a fixed number of points: raw, farthest points, proximal and
distal."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import torch

from omniperception.common.launch import launch_over_envs, view
from omniperception.perception.samplers import by_ray, kernels
from omniperception.perception.samplers.base import Attitude, Sampler

_FPS_LANES = 128
"""CUDA threads that share one environment's farthest point sampling."""

BUCKETS_FROM = 1024
"""Points from which on farthest point sampling by buckets is faster on a CPU than looking at every point."""

vec4 = kernels.wp.vec4
vec3, float32, int32 = kernels.wp.vec3, kernels.wp.float32, kernels.wp.int32


class RawSampler(Sampler):
    """Every ray's point in ray order, a miss as zeros: the input of the direct MLP."""

    def __init__(self, num_rays: int, *, max_range: float, num_threads: int | None = None) -> None:
        """Args: num_rays: R of every frame; max_range: metres."""
        super().__init__(num_rays, max_range, num_threads)

    @property
    def sizes(self) -> dict[str, int]:
        return {"num_rays": self.num_points}

    @property
    def kernels(self) -> tuple[str, ...]:
        return ("raw_points",)

    def _sample(self, ranges, directions_s, elevation, azimuth, out, attitude) -> None:
        inputs = [view(ranges, float32), view(directions_s, vec3), 1.0 / self.max_range, view(out, vec3)]
        launch_over_envs(
            kernels.raw_points,
            ranges.shape[0],
            inputs,
            ranges.device,
            inner=self.num_points,
            num_threads=self.num_threads,
        )


class PdSampler(Sampler):
    """PD-RiskNet's proximal and distal sampling (Sec. 3.3.1 of the paper).

    The cloud is split by elevation in the sensor frame: proximal where theta > ``split_deg``, distal
    elsewhere. Proximal points are thinned by exact farthest point sampling, which starts at the first
    proximal hit in ray order and never picks a point twice (of equally far points the first in ray order).
    Distal points are sorted and cut into bins of consecutive points, one output point per bin. Both halves
    are ordered by (theta ring, phi), where ring = floor((theta + pi / 2) / ring_deg) and phi starts at -pi in
    steps of 2 pi / 65536. With fewer points than slots each point has its own slot and the remaining slots
    are zero.

    Where a distal bin looks thus depends on how many hits there are before it in the order.
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
            num_threads: CPU threads; all cores by default.
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
        self._scratch: kernels.Scratch | None = None
        self._scratch_key: tuple[int, tuple | None] = (0, None)
        self._tensors: dict[str, torch.Tensor] = {}

    @property
    def sizes(self) -> dict[str, int]:
        return {"num_proximal": self.num_proximal, "num_distal": self.num_points - self.num_proximal}

    @property
    def kernels(self) -> tuple[str, ...]:
        proximal = ("gather_proximal", "pick_farthest", "write_proximal") if self.num_proximal else ()
        return (*proximal, "write_distal") if self.num_distal else proximal

    def _sample(self, ranges, directions_s, elevation, azimuth, out, attitude) -> None:
        if ranges.device.type in by_ray.USED_ON:
            self._sample_by_ray(ranges, directions_s, elevation, azimuth, out)
            return
        n, r = ranges.shape
        scratch = self._scratch_for(n, r, ranges.device)
        ranges_v, directions_v = view(ranges, float32), view(directions_s, vec3)
        theta, phi, points = view(elevation, float32), view(azimuth, float32), view(out, vec3)
        scale = 1.0 / self.max_range

        def launch(kernel, *inputs, **options) -> None:
            launch_over_envs(kernel, n, list(inputs), ranges.device, num_threads=self.num_threads, **options)

        if self.num_proximal:
            launch(
                kernels.gather_proximal,
                ranges_v,
                directions_v,
                theta,
                self.split,
                scale,
                scratch,
                block_dim=32,
            )
            self._pick(n, scratch, ranges.device)
            launch(
                kernels.write_proximal,
                theta,
                phi,
                self.ring,
                self.num_proximal,
                scratch,
                points,
                block_dim=32,
            )
        if self.num_distal:
            launch(
                kernels.write_distal,
                ranges_v,
                directions_v,
                theta,
                phi,
                self.split,
                self.ring,
                scale,
                self.num_proximal,
                self.num_distal,
                scratch,
                points,
                block_dim=32,
            )

    def _sample_by_ray(self, ranges, directions_s, elevation, azimuth, out) -> None:
        n, r = ranges.shape
        scratch, device = self._scratch_for(n, r, ranges.device), ranges.device
        cloud = view(ranges, float32), view(directions_s, vec3)
        theta, phi, points = view(elevation, float32), view(azimuth, float32), view(out, vec3)
        scale, first_bin = 1.0 / self.max_range, self.num_proximal

        def launch(kernel, inner, *inputs) -> None:
            launch_over_envs(kernel, n, list(inputs), device, inner=inner, num_threads=self.num_threads)

        rays = by_ray.SortedRays(self._tensors, n, r)
        launch(by_ray.key_rays, r, cloud[0], theta, phi, self.split, self.ring, rays.keys, rays.items)
        rays.sort()
        launch(by_ray.find_parts, 0, r, rays.keys, rays.parts, scratch.num_proximal)
        if self.num_distal:
            bins = (first_bin, self.num_distal, rays.items, rays.parts)
            launch(by_ray.write_bins, self.num_distal, *cloud, scale, *bins, points)
        if self.num_proximal:
            launch(by_ray.gather_ranked, r, *cloud, scale, rays.items, rays.parts, scratch)
            self._pick(n, scratch, device)
            picks = by_ray.SortedRays(self._tensors, n, self.num_proximal)
            launch(
                by_ray.key_picks,
                self.num_proximal,
                theta,
                phi,
                self.ring,
                self.num_proximal,
                scratch,
                picks.keys,
                picks.items,
            )
            picks.sort()
            launch(by_ray.write_picks, self.num_proximal, self.num_proximal, picks.items, scratch, points)

    def _pick(self, n: int, scratch: kernels.Scratch, device: torch.device) -> None:
        """Farthest points among the proximal hits."""
        threads = {"num_threads": self.num_threads}
        lanes = _FPS_LANES if device.type == "cuda" else 1
        picks = [self.num_proximal, lanes, self.buckets_from, scratch]
        launch_over_envs(kernels.pick_farthest, n, picks, device, inner=lanes, block_dim=lanes, **threads)

    def _scratch_for(self, n: int, r: int, device: torch.device) -> kernels.Scratch:
        """Work memory for N environments of R rays, allocated when the shape or device is new."""
        per_ray = device.type in by_ray.USED_ON
        most, fits = self._scratch_key
        if n <= most and fits == (r, device, per_ray):
            return self._scratch  # of the largest part of the environments
        longest = max(r, self.num_proximal) if per_ray else r
        by_bucket = device.type == "cpu" and self.num_proximal and r >= self.buckets_from
        num_buckets = -(-r // kernels.BUCKET_SIZE) if by_bucket else 0
        sizes = {
            "picked": (n, max(self.num_proximal, 1)),
            "num_proximal": (n,),
            "keys": (2, n, longest),
            "items": (2, n, longest),
            "histogram": (n, kernels.RADIX_SIZE),
            "ray": (n, r),
            "distance": (n, num_buckets * kernels.BUCKET_SIZE or r),
            "position": (n, num_buckets * kernels.BUCKET_SIZE),
            "bucket_distance": (n, num_buckets),
        }
        real = {name: (n, r) for name in "xyz"}
        real |= {"bucketed": (n, 3, num_buckets * kernels.BUCKET_SIZE), "boxes": (n, 6, num_buckets)}
        self._tensors = {name: torch.empty(size, dtype=torch.int32, device=device) for name, size in sizes.items()}
        self._tensors |= {name: torch.empty(size, device=device) for name, size in real.items()}
        scratch = kernels.Scratch()
        for name, tensor in self._tensors.items():
            setattr(scratch, name, view(tensor, float32 if name in real else int32))
        if per_ray:
            num_cells = self.num_points - self.num_proximal
            self._tensors["parts"] = torch.empty(n, 2, dtype=torch.int32, device=device)
            self._tensors["first"] = torch.empty(n, num_cells, dtype=torch.int32, device=device)
            self._tensors["nearest"] = torch.empty(n, num_cells, device=device)
        self._scratch, self._scratch_key = scratch, (n, (r, device, per_ray))
        return scratch


class ProximitySampler(PdSampler):
    """Proximal points as in :class:`PdSampler`; the distal half as proximities around the levelled base.

    Distal hits are sorted by where they are: azimuth sector around the base and band of height, in the base's frame
    without roll and pitch, which the IMU gives. Each cell holds the bearing of its horizontally nearest hit times
    exp(-d / decay), and that proximity itself: (x, y, proximity), with free space 0. A network input thus always
    looks the same way, does not move as the trunk rolls and pitches, and is large where an obstacle is near; the
    avoidance velocity (paper, Sec. 'Risk-Aware Locomotion Policy') is nearly linear in it. Sector 0 starts at -pi.
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
            num_threads: CPU threads; all cores by default.
        """
        edges = [float(edge) for edge in band_edges]
        if len(edges) < 2 or any(low >= high for low, high in itertools.pairwise(edges)):
            raise ValueError(f"band_edges={edges} must be at least two increasing heights")
        if num_sectors < 1 or not decay > 0.0:
            raise ValueError(f"num_sectors={num_sectors} must be at least 1 and decay={decay} positive")
        if not 0.0 <= blind < max_range:
            raise ValueError(f"blind={blind} must lie in [0, max_range={max_range})")
        if len(body) != 2 or min(body) < 0.0:
            raise ValueError(f"body={list(body)} must be [half length, half width] in metres")
        options = {"split_deg": split_deg, "ring_deg": ring_deg, "num_threads": num_threads}
        num_cells = num_sectors * (len(edges) - 1)
        super().__init__(num_proximal, num_cells, max_range=max_range, **options)
        self.num_distal = 0  # of the averages that PdSampler would write
        self.num_sectors = num_sectors
        self.edges, self.decay, self.blind, self.body = torch.tensor(edges), decay, blind, tuple(body)

    @property
    def kernels(self) -> tuple[str, ...]:
        return (*super().kernels, "proximity_grid")

    def _sample(self, ranges, directions_s, elevation, azimuth, out, attitude) -> None:
        super()._sample(ranges, directions_s, elevation, azimuth, out, attitude)
        self.edges = self.edges.to(ranges.device)
        cloud, stands = (view(ranges, float32), view(directions_s, vec3)), self._views_of(attitude)
        looks = (view(elevation, float32), self.split, self.blind, *stands, kernels.wp.vec2(*self.body))
        cells = (view(self.edges, float32), self.num_sectors, self.decay)
        written = (self.num_proximal, view(out, vec3))
        n, r = ranges.shape

        def launch(kernel, inner, *inputs) -> None:
            options = {"num_threads": self.num_threads, "block_dim": 256 if inner else 32}
            launch_over_envs(kernel, n, list(inputs), ranges.device, inner=inner, **options)

        if ranges.device.type not in by_ray.USED_ON:
            launch(kernels.proximity_grid, 0, *cloud, *looks, *cells, *written)
            return
        scratch, num_cells = self._scratch_for(n, r, ranges.device), self.num_points - self.num_proximal
        nearest, first = self._tensors["nearest"][:n].zero_(), self._tensors["first"][:n].fill_(r)
        found = view(nearest, float32), view(first, int32)
        launch(by_ray.find_nearest, r, *cloud, *looks, *cells, scratch, found[0])
        launch(by_ray.find_first, r, scratch, *found)
        launch(by_ray.write_nearest, num_cells, *cloud, *stands, *found, *written)

    @staticmethod
    def _views_of(attitude: Attitude) -> tuple:
        return view(attitude.base_quat, vec4), vec3(*attitude.mount_pos), vec4(*attitude.mount_quat)


class FpsSampler(PdSampler):
    """Exact farthest point sampling over all hits, then sorted by (theta ring, phi); zeros after the last
    point.

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
        """Args: num_points: slots; max_range: metres; ring_deg: height of a theta ring for sorting, degrees."""
        super().__init__(
            num_points,
            0,
            max_range=max_range,
            split_deg=-math.inf,
            ring_deg=ring_deg,
            num_threads=num_threads,
        )

    @property
    def sizes(self) -> dict[str, int]:
        return {"num_points": self.num_points}
