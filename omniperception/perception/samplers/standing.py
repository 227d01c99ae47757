"""Proximities of what stands on the ground, which is taken away by geometry."""

from __future__ import annotations

from collections.abc import Sequence

import warp as wp

from omnilidar.launch import constant, launch_over_envs, view
from omniperception.perception.geometry import GeometryConfig, Standing
from omniperception.perception.samplers.base import Sampler
from omniperception.perception.samplers.sampling import checked_edges
from omniperception.perception.standing_kernels import nearest_standing


class StandingSampler(Sampler):
    """Of what stands on the ground, the nearest by azimuth sector and band of height.

    Cells as the distal half of :class:`ProximitySampler` has them, but heights are above the ground below a hit, found
    from the same cloud (:mod:`omniperception.perception.geometry`), and ground, noise next to the sensor and the robot
    itself are left out. So a low thing is one whatever the ground does and however the robot stands, and an empty cell
    means that nothing stands there, not that the ground is in another band.
    """

    needs_attitude = True

    def __init__(
        self,
        num_sectors: int = 36,
        *,
        max_range: float,
        band_edges: Sequence[float],
        decay: float,
        geometry: GeometryConfig | None = None,
        num_threads: int | None = None,
    ) -> None:
        """Configure the cells.

        Args:
            num_sectors: S, azimuth sectors; sector 0 starts at -pi.
            max_range: metres.
            band_edges: increasing heights that separate the bands, metres above the ground.
            decay: distance over which the proximity falls by e, metres.
            geometry: what is ground, noise and body; None: as :class:`GeometryConfig` has it.
            num_threads: CPU threads; those of `use_threads` by default.
        """
        edges = checked_edges(band_edges, num_sectors, decay)
        super().__init__(num_sectors * (len(edges) - 1), max_range, num_threads)
        self.num_sectors, self.decay, self.edges = num_sectors, decay, tuple(edges)
        self.geometry = geometry or GeometryConfig()
        self._standing = Standing(self.geometry, num_threads)

    @property
    def sizes(self) -> dict[str, int]:
        return {"num_cells": self.num_points}

    def _sample(self, ranges, directions_s, elevation, azimuth, out, attitude) -> None:
        points, heights = self._standing(ranges, directions_s, attitude)
        cells = view(constant(self.edges, ranges.device), wp.float32), self.num_sectors, self.decay
        inputs = [view(points, wp.vec3), view(heights, wp.float32), *cells, view(out, wp.vec3)]
        launch_over_envs(nearest_standing, len(ranges), inputs, ranges.device, num_threads=self.num_threads)
