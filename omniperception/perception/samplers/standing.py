"""Proximities of what stands on the ground, which is taken away by geometry."""

from __future__ import annotations

from collections.abc import Sequence

import warp as wp

from omniperception.common.launch import constant, launch_over_envs, view
from omniperception.perception.geometry import GeometryConfig, Standing
from omniperception.perception.samplers.sampling import PdSampler, checked_edges
from omniperception.perception.standing_kernels import nearest_standing


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
        self.num_sectors, self.decay, self.edges = num_sectors, decay, tuple(edges)
        self.geometry = geometry or GeometryConfig()
        self._standing = Standing(self.geometry, num_threads)

    @property
    def kernels(self) -> tuple[str, ...]:
        proximal = ("sort_each_environment", "pick_farthest", "write_picked") if self.num_proximal else ()
        return (*proximal, "find_standing", "nearest_standing")

    def _sample(self, ranges, directions_s, elevation, azimuth, out, attitude) -> None:
        if self.num_proximal:
            self._write_halves(ranges, directions_s, elevation, azimuth, out, num_bins=0)
        points, heights = self._standing(ranges, directions_s, attitude)
        cells = view(constant(self.edges, ranges.device), wp.float32), self.num_sectors, self.decay, self.num_proximal
        inputs = [view(points, wp.vec3), view(heights, wp.float32), *cells, view(out, wp.vec3)]
        launch_over_envs(nearest_standing, len(ranges), inputs, ranges.device, num_threads=self.num_threads)
