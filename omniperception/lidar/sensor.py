"""The LiDAR: a scan pattern on a moving mount, cast through a scene at its own rate."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
import warp as wp

from .kernels.noise import add_noise
from .kernels.scan import ScanRow, scan_kernel
from .noise import Noise, noise_parameters
from .patterns import ScanPattern
from .scene import PlacedShapes, RayScene, View
from .shapes import finite_tuple


def quat_from_rpy(roll: float, pitch: float, yaw: float) -> tuple[float, float, float, float]:
    """(w, x, y, z) of a turn about x by roll, then about fixed y by pitch, then about fixed z by yaw."""
    (cr, sr), (cp, sp), (cy, sy) = ((math.cos(a / 2.0), math.sin(a / 2.0)) for a in (roll, pitch, yaw))
    return (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )


@dataclass(frozen=True)
class LidarConfig:
    """How a LiDAR is mounted and what of its scan is kept.

    Attributes:
        num_rays: Points kept per frame.
        period_s: Seconds from frame to frame.
        min_range: Nearer surfaces return nothing, metres.
        max_range: Farther surfaces return nothing, metres.
        mount_pos: Sensor position in the mount body's frame, metres.
        mount_rpy: Sensor orientation in the mount body's frame, roll-pitch-yaw about fixed axes, rad.
        mount_quat: The same as (w, x, y, z), in place of ``mount_rpy``.
    """

    num_rays: int = 1000
    period_s: float = 0.1
    min_range: float = 0.1
    max_range: float = 40.0
    mount_pos: tuple[float, float, float] = (0.0, 0.0, 0.0)
    mount_rpy: tuple[float, float, float] | None = None
    mount_quat: tuple[float, float, float, float] | None = None

    def __post_init__(self) -> None:
        if self.num_rays < 1 or self.num_rays != int(self.num_rays):
            raise ValueError(f"lidar.num_rays={self.num_rays} must be a whole number >= 1")
        if not (self.period_s > 0.0 and math.isfinite(self.period_s)):
            raise ValueError(f"lidar.period_s={self.period_s} must be positive and finite")
        if not self.min_range >= 0.0:
            raise ValueError(f"lidar.min_range={self.min_range} must be >= 0")
        if not (self.max_range > self.min_range and math.isfinite(self.max_range)):
            raise ValueError(f"lidar.max_range={self.max_range} must be > lidar.min_range={self.min_range} and finite")
        object.__setattr__(self, "mount_pos", finite_tuple("lidar.mount_pos", self.mount_pos, 3))
        if self.mount_rpy is not None and self.mount_quat is not None:
            raise ValueError("lidar.mount_rpy and lidar.mount_quat are both given; set one of them to null")
        if self.mount_rpy is not None:
            object.__setattr__(self, "mount_rpy", finite_tuple("lidar.mount_rpy", self.mount_rpy, 3))
        if self.mount_quat is not None:
            quat = finite_tuple("lidar.mount_quat", self.mount_quat, 4)
            object.__setattr__(self, "mount_quat", quat)
            if abs(math.hypot(*quat) - 1.0) > 1e-3:
                raise ValueError(f"lidar.mount_quat={quat} must be a unit quaternion (w, x, y, z)")

    @property
    def quat(self) -> tuple[float, float, float, float]:
        """Sensor orientation in the mount body's frame, (w, x, y, z)."""
        return self.mount_quat or quat_from_rpy(*(self.mount_rpy or (0.0, 0.0, 0.0)))


@dataclass(frozen=True)
class LidarFrame:
    """One scan of every environment. The tensors are the sensor's own and are overwritten by the next cast.

    Attributes:
        ranges: Measured distance along each ray with noise, metres, ``inf`` for a miss, (num_envs, N).
        true_ranges: The same without noise; the very tensor ``ranges`` when no noise is configured.
        shape_id: Index of the shape that was hit, -1 for a miss, (num_envs, N) int32.
        class_id: Class of that shape, -1 for a miss, (num_envs, N) int32.
        directions_s: Unit direction of each ray in the sensor frame, (num_envs, N, 3).
        elevation: Angle theta of each ray in the sensor frame, rad, (num_envs, N).
        azimuth: Angle phi of each ray in the sensor frame, rad in [0, 2 pi), (num_envs, N).
        row: Row of the scan table, (num_envs, N) int32.
    """

    ranges: torch.Tensor
    true_ranges: torch.Tensor
    shape_id: torch.Tensor
    class_id: torch.Tensor
    directions_s: torch.Tensor
    elevation: torch.Tensor
    azimuth: torch.Tensor
    row: torch.Tensor


class Lidar:
    """Casts one LiDAR per environment along its scan pattern.

    A surface nearer than ``min_range`` blocks the ray and returns nothing. A ray that starts inside a closed
    shape hits its exit surface, as in ``mj_ray``; give the shapes of the sensor's own housing in
    ``exclude_shapes``.

    Attributes:
        config, pattern, scene: As given.
        frame: The frame that ``cast`` fills and returns.
        phase_rows: Rows by which each environment's device is ahead, (num_envs,) int64, from the seed.
        frame_count: Frames cast so far, (1,) int32; the noise is a function of it.
    """

    def __init__(
        self,
        config: LidarConfig,
        pattern: ScanPattern,
        scene: RayScene,
        mount_body: int,
        exclude_shapes: Sequence[int] = (),
        noise: Sequence[Noise] = (),
        seed: int = 0,
    ) -> None:
        if not -1 <= mount_body < scene.num_bodies:
            raise ValueError(
                f"lidar.mount_body={mount_body} must be in 0..{scene.num_bodies - 1}, or -1 (fixed sensor)"
            )
        stride = pattern.stride(config.period_s, config.num_rays)
        self.config, self.pattern, self.scene = config, pattern, scene
        self.phase_rows = self._draw_phase(seed)
        self._first_row = torch.zeros(scene.num_envs, dtype=torch.int64, device=scene.device)
        self._scratch = torch.zeros(scene.num_envs, dtype=torch.float64, device=scene.device)
        self.frame_count = torch.zeros(1, dtype=torch.int32, device=scene.device)
        self.frame = self._allocate_frame(has_noise=bool(noise))
        view = View(mount_body, config.mount_pos, config.quat, config.max_range, self._elevation_span())
        self._placed = PlacedShapes(scene, exclude_shapes, view)
        self._cast = self._record_cast(stride)
        self._add_noise = self._record_noise(noise, seed) if noise else None

    def cast(self, time_s: torch.Tensor) -> LidarFrame:
        """Casts the frame that ends at ``time_s`` from the bodies' current poses.

        Args:
            time_s: Each environment's time, s, (num_envs,) float64.

        Returns:
            ``self.frame``, every element of it rewritten.
        """
        if time_s.dtype != torch.float64 or time_s.shape != (self.scene.num_envs,):
            raise ValueError(
                f"time_s must be float64 ({self.scene.num_envs},), got {time_s.dtype} {tuple(time_s.shape)}"
            )
        self.pattern.first_rows(time_s, self.config.period_s, self.phase_rows, self._first_row, self._scratch)
        self._placed.refresh()
        self._cast()
        if self._add_noise is not None:
            self._add_noise()
            self.frame_count.add_(1)
        return self.frame

    def _draw_phase(self, seed: int) -> torch.Tensor:
        generator = torch.Generator().manual_seed(seed)
        phase = torch.randint(self.pattern.num_rows, (self.scene.num_envs,), generator=generator)
        return phase.to(self.scene.device)

    def _elevation_span(self) -> tuple[float, float]:
        elevation = torch.asin(self.pattern.directions_s[:, 2].double().clamp(-1.0, 1.0))
        return float(elevation.min()), float(elevation.max())

    def _allocate_frame(self, has_noise: bool) -> LidarFrame:
        shape, device = (self.scene.num_envs, self.config.num_rays), self.scene.device
        true_ranges = torch.full(shape, math.inf, device=device)
        return LidarFrame(
            ranges=true_ranges.clone() if has_noise else true_ranges,
            true_ranges=true_ranges,
            shape_id=torch.full(shape, -1, dtype=torch.int32, device=device),
            class_id=torch.full(shape, -1, dtype=torch.int32, device=device),
            directions_s=torch.zeros(*shape, 3, device=device),
            elevation=torch.zeros(shape, device=device),
            azimuth=torch.zeros(shape, device=device),
            row=torch.zeros(shape, dtype=torch.int32, device=device),
        )

    def _record_cast(self, stride: int):
        pattern, scene, frame, placed = self.pattern, self.scene, self.frame, self._placed
        self._scan = torch.cat([pattern.directions_s, pattern.elevation[:, None], pattern.azimuth[:, None]], dim=1)
        self._scan = self._scan.to(device=scene.device, dtype=torch.float32).contiguous()
        args = [
            wp.from_torch(self._scan, dtype=ScanRow),
            wp.from_torch(self._first_row),
            stride,
            self.config.min_range,
            self.config.max_range,
            scene.geometry,
            placed.bound,
            placed.near,
            placed.shape,
            placed.axes,
            placed.count,
            wp.from_torch(frame.true_ranges),
            wp.from_torch(frame.shape_id),
            wp.from_torch(frame.class_id),
            wp.from_torch(frame.directions_s, dtype=wp.vec3),
            wp.from_torch(frame.elevation),
            wp.from_torch(frame.azimuth),
            wp.from_torch(frame.row),
        ]
        num_rays = self.config.num_rays
        return scene.launch(
            scan_kernel(scene.kinds), (num_rays,), args, work_per_env=num_rays * (len(scene.shapes) + 4)
        )

    def _record_noise(self, noise: Sequence[Noise], seed: int):
        args = [
            seed & 0x7FFFFFFF,
            wp.from_torch(self.frame_count),
            *noise_parameters(noise),
            self.config.min_range,
            self.config.max_range,
            wp.from_torch(self.frame.true_ranges),
            wp.from_torch(self.frame.ranges),
        ]
        return self.scene.launch(add_noise, (self.config.num_rays,), args, work_per_env=4 * self.config.num_rays)
