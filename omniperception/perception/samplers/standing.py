"""Proximities of what stands on the ground, which is taken away by geometry."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch

from omniperception.common.sectors import sector_of
from omniperception.perception.geometry import GeometryConfig, standing
from omniperception.perception.samplers.sampling import PdSampler, checked_edges


class StandingSampler(PdSampler):
    """Proximal points as in :class:`PdSampler`; the distal half as proximities of what stands on the ground.

    As :class:`ProximitySampler`, but heights are above the ground below a hit, found from the same cloud
    (:mod:`omniperception.perception.geometry`), and ground, noise next to the sensor and the robot itself are left out.
    So a low thing is one whatever the ground does and however the robot stands, and an empty cell means that nothing
    stands there, not that the ground is in another band.
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
        ring_deg: float = 2.0,
        geometry: GeometryConfig | None = None,
        num_threads: int | None = None,
    ) -> None:
        """Configure both halves.

        Args:
            num_proximal: slots of the proximal half, written first.
            num_sectors: azimuth sectors.
            max_range: metres; proximal points are divided by it.
            split_deg: elevation in the sensor frame that separates the halves, degrees.
            band_edges: increasing heights that separate the bands, metres above the ground.
            decay: distance over which the proximity falls by e, metres.
            ring_deg: height of a theta ring for sorting the proximal half, degrees.
            geometry: what is ground, noise and body; None: as :class:`GeometryConfig` has it.
            num_threads: CPU threads; all cores by default.
        """
        edges = checked_edges(band_edges, num_sectors, decay)
        super().__init__(
            num_proximal,
            num_sectors * (len(edges) - 1),
            max_range=max_range,
            split_deg=split_deg,
            ring_deg=ring_deg,
            num_threads=num_threads,
        )
        self.num_sectors, self.decay, self.edges = num_sectors, decay, torch.tensor(edges)
        self.geometry = geometry or GeometryConfig()

    @property
    def kernels(self) -> tuple[str, ...]:
        return ("sort_each_environment", "pick_farthest", "write_picked") if self.num_proximal else ()

    def _sample(self, ranges, directions_s, elevation, azimuth, out, attitude) -> None:
        if self.num_proximal:
            self._write_halves(ranges, directions_s, elevation, azimuth, out, num_bins=0)
        points, height = standing(ranges, directions_s, attitude, self.geometry)
        self.edges = self.edges.to(ranges.device)
        band = torch.bucketize(height, self.edges, right=True) - 1
        counts = (band >= 0) & (band < len(self.edges) - 1)
        cell = torch.where(counts, band, 0) * self.num_sectors + sector_of(points[..., :2], self.num_sectors)
        distance = torch.where(counts, points[..., :2].norm(dim=-1), math.inf)
        shape = len(ranges), self.num_distal
        least = distance.new_full(shape, math.inf).scatter_reduce_(1, cell, distance, "amin")
        last = ranges.shape[1] - 1
        rays = torch.arange(last + 1, device=ranges.device).expand_as(cell)
        rays = torch.where(counts & (distance <= least.gather(1, cell)), rays, last)
        first = torch.full(shape, last, device=ranges.device).scatter_reduce_(1, cell, rays, "amin")
        proximity = (-least / self.decay).exp()
        place = points[..., :2].gather(1, first[..., None].expand(-1, -1, 2))
        bearing = place * (proximity / least.clamp(min=1e-6))[..., None]  # 0 where there is no hit
        out[:, self.num_proximal :] = torch.cat((bearing, proximity[..., None]), -1)
