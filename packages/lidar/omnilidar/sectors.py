"""Nearest horizontal distance to hits of one class, per azimuth sector around the robot."""

import torch
import warp as wp

from .kernels.sectors import sector_minima
from .launch import SplitLaunch, default_num_threads

LANES = {"cpu": 1, "cuda": 128}
"""Threads that share an environment's rays, by kind of device."""


class SectorDistances:
    """Minimum horizontal distance from the base's origin, in the base's yaw-aligned frame.

    Sector j holds the azimuths [-pi + j 2 pi/n, -pi + (j + 1) 2 pi/n). Hits of other classes do not count. Calling it
    reads the tensors given here and allocates nothing.

    Attributes:
        distances: Metres, (num_envs, num_sectors); overwritten by each call.
    """

    def __init__(
        self,
        true_ranges: torch.Tensor,
        directions_s: torch.Tensor,
        class_id: torch.Tensor,
        body_pos: torch.Tensor,
        body_quat: torch.Tensor,
        base: int,
        mount_pos: tuple[float, float, float],
        mount_quat: tuple[float, float, float, float],
        obstacle_class: int,
        max_distance: float,
        num_sectors: int = 36,
        num_threads: int | None = None,
        out: torch.Tensor | None = None,
        carrier: int | None = None,
    ) -> None:
        """Records the launch.

        Args:
            true_ranges: Noise-free distances, metres, ``inf`` for a miss, (num_envs, N).
            directions_s: Ray directions in the sensor frame, (num_envs, N, 3).
            class_id: Class that each ray hit, -1 for a miss, (num_envs, N) int32.
            body_pos: Positions of bodies in the world, metres, (num_envs, num_bodies, 3) float32.
            body_quat: Their orientations, (w, x, y, z), (num_envs, num_bodies, 4) float32.
            base: Which body is the base.
            mount_pos: Sensor position in the frame of the body that carries it, metres.
            mount_quat: Sensor orientation likewise, (w, x, y, z).
            obstacle_class: The class that counts.
            max_distance: Value of a sector without such a hit, and the most that is reported, metres.
            num_sectors: n, the number of sectors.
            num_threads: CPU threads; None for all cores.
            out: Memory for ``distances``; None allocates it.
            carrier: Which body carries the sensor; None for the base.
        """
        num_envs, num_rays = true_ranges.shape
        if num_sectors < 1:
            raise ValueError(f"num_sectors={num_sectors} must be at least 1")
        if not max_distance > 0.0:
            raise ValueError(f"max_distance={max_distance} must be > 0")
        out = torch.empty(num_envs, num_sectors, device=true_ranges.device) if out is None else out
        num_bodies = max(body_quat.shape[1], base + 1)
        for name, given, shape in (
            ("directions_s", directions_s, (num_envs, num_rays, 3)),
            ("class_id", class_id, (num_envs, num_rays)),
            ("body_quat", body_quat, (num_envs, num_bodies, 4)),
            ("body_pos", body_pos, (num_envs, num_bodies, 3)),
            ("out", out, (num_envs, num_sectors)),
        ):
            if given.shape != shape:
                raise ValueError(f"{name} must be {shape}, got {tuple(given.shape)}")
        self.distances = out.fill_(max_distance)
        wp.init()  # from_torch does not, and no scene need have been built before
        lanes = LANES[true_ranges.device.type]
        args = [
            wp.from_torch(true_ranges),
            wp.from_torch(directions_s, dtype=wp.vec3),
            wp.from_torch(class_id),
            wp.from_torch(body_pos, dtype=wp.vec3),
            wp.from_torch(body_quat, dtype=wp.vec4),
            base,
            base if carrier is None else carrier,
            wp.vec3(*mount_pos),
            wp.vec4(*mount_quat),
            obstacle_class,
            lanes,
            wp.from_torch(self.distances),
        ]
        self._max_distance, threads, device = max_distance, num_threads or default_num_threads(), true_ranges.device
        self._launch = SplitLaunch(sector_minima, num_envs, (lanes,), args, device, threads, 16 * num_rays)

    def __call__(self) -> torch.Tensor:
        """Measures the tensors' present contents; returns ``distances``."""
        self.distances.fill_(self._max_distance)
        self._launch()
        return self.distances
