"""Nearest horizontal distance to hits of one class, per azimuth sector around the robot."""

import torch
import warp as wp

from .kernels.sectors import sector_minima
from .launch import SplitLaunch, default_num_threads


def sector_distances(
    true_ranges: torch.Tensor,
    directions_s: torch.Tensor,
    class_id: torch.Tensor,
    base_quat: torch.Tensor,
    mount_pos: tuple[float, float, float],
    mount_quat: tuple[float, float, float, float],
    obstacle_class: int,
    max_distance: float,
    num_sectors: int = 36,
    num_threads: int | None = None,
) -> torch.Tensor:
    """Minimum horizontal distance from the base's origin, in the base's yaw-aligned frame.

    Sector j holds the azimuths [-pi + j 2 pi/n, -pi + (j + 1) 2 pi/n). Hits of other classes do not count.

    Args:
        true_ranges: Noise-free distances, metres, ``inf`` for a miss, (num_envs, N).
        directions_s: Ray directions in the sensor frame, (num_envs, N, 3).
        class_id: Class that each ray hit, -1 for a miss, (num_envs, N) int32.
        base_quat: Orientation of the base in the world, (w, x, y, z), (num_envs, 4).
        mount_pos: Sensor position in the base frame, metres.
        mount_quat: Sensor orientation in the base frame, (w, x, y, z).
        obstacle_class: The class that counts.
        max_distance: Value of a sector without such a hit, and the most that is reported, metres.
        num_sectors: n, the number of sectors.
        num_threads: CPU threads; None for all cores.

    Returns:
        Distances, metres, (num_envs, num_sectors).
    """
    num_envs, num_rays = true_ranges.shape
    if num_sectors < 1:
        raise ValueError(f"num_sectors={num_sectors} must be at least 1")
    if not max_distance > 0.0:
        raise ValueError(f"max_distance={max_distance} must be > 0")
    if base_quat.shape != (num_envs, 4):
        raise ValueError(f"base_quat must be ({num_envs}, 4), got {tuple(base_quat.shape)}")
    distances = torch.full((num_envs, num_sectors), max_distance, device=true_ranges.device)
    if num_rays == 0:
        return distances
    args = [
        wp.from_torch(true_ranges.contiguous()),
        wp.from_torch(directions_s.contiguous(), dtype=wp.vec3),
        wp.from_torch(class_id.contiguous()),
        wp.from_torch(base_quat.float().contiguous(), dtype=wp.vec4),
        wp.vec3(*mount_pos),
        wp.vec4(*mount_quat),
        obstacle_class,
        max_distance,
        wp.from_torch(distances),
    ]
    threads = num_threads or default_num_threads()
    SplitLaunch(sector_minima, num_envs, (), args, true_ranges.device, threads, work_per_env=num_rays)()
    return distances
