"""The LiDAR of the task: casts at its own rate, samples each frame once, keeps the history of frames."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch

from omniperception.common.rows import put
from omniperception.common.timing import StageTimer
from omniperception.env.odometry import Odometry
from omniperception.env.state import Kinematics
from omniperception.lidar import (
    DEVICES,
    Lidar,
    LidarConfig,
    LidarFrame,
    Noise,
    RayScene,
    ScanPattern,
    SectorDistances,
    env_slices,
    max_deviation,
    ray_bytes,
)
from omniperception.perception import Attitude
from omniperception.scene.rays import HitClass, hidden_geoms, ray_shapes
from omniperception.scene.reach import FieldOfView
from omniperception.sim import Simulator

NEVER = 2**31
"""Frames since something was seen that has not been seen in this episode."""


@dataclass(frozen=True)
class SensorConfig(LidarConfig):
    """A LiDAR on the robot.

    Attributes:
        pattern: makes the scan pattern; None: the device's.
        exclude_geoms: geoms of the robot that its rays pass through: the housing around the sensor.
        device: name in `omniperception.lidar.DEVICES` of the sensor whose own noise `randomization.lidar_device` puts
            on, or None.
        distal_below_deg: rays whose elevation in the sensor frame is below this count for `capped_ray_distance`.
        cloud_mb: most memory (MB) for clouds that exist at the same time; where those of all environments take more,
            environments are cast and sampled in parts.
    """

    pattern: Callable[[], ScanPattern] | None = None
    exclude_geoms: Sequence[str] = ()
    device: str | None = None
    distal_below_deg: float = 20.0
    cloud_mb: float = 1000.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.cloud_mb > 0:
            raise ValueError(f"lidar.cloud_mb={self.cloud_mb} must be positive")
        if self.device is not None and self.device not in DEVICES:
            raise ValueError(f"lidar.device={self.device} is unknown; known: {', '.join(DEVICES)}, or null")
        if self.pattern is None:
            if self.device is None:
                raise ValueError("lidar.pattern must be given where lidar.device is null")
            object.__setattr__(self, "pattern", DEVICES[self.device].pattern)


@dataclass(frozen=True)
class SensingNeeds:
    """What the composed task reads from the LiDAR; nothing else is computed.

    Attributes:
        sectors: number of azimuth sectors of obstacle distances, or 0.
        sector_max: distance (m) of a sector without an obstacle.
        distal_caps: distances (m) at which ranges are capped whose mean is read.
        whole: whether something reads `LidarSensing.frame`, the clouds of all environments.
        obstacles: geoms of the obstacles whose sightings are noted, none by default.
    """

    sectors: int
    sector_max: float
    distal_caps: Sequence[float] = ()
    whole: bool = False
    obstacles: Sequence[str] = ()

    @property
    def rays(self) -> bool:
        """Whether ranges are read, beside what is sampled."""
        return bool(self.distal_caps) or self.whole


class LidarSensing:
    """Casts a frame every `period_steps` control steps, for all environments at the same moment.

    Clouds are reduced to what is read of them as soon as they are cast, in as many parts as `cloud_mb` asks for: those
    of all environments never have to exist at the same time. A reset empties an environment's history; its next frame
    comes with the sensor's next tick.

    Attributes:
        hidden: geoms that are not in the ray scene because no ray meets them, and why.
        base: index of the robot's base among the bodies of the ray scene.
        frames: (num_envs, history, num_points, 3) sampled points in the sensor frame divided by the maximum range,
            newest last, with `base_motion` one row more: how the base moved since the frame before; None without a
            sampler.
        frame_count: (num_envs, 1) int64 how many of the newest frames are valid.
        frame_tick: (num_envs, 1) int64 number of the newest frame, the same for all environments.
        sector_distance: (num_envs, num_sectors) horizontal distance (m) from the base to the nearest obstacle hit,
            without noise, in the yaw-aligned frame; None when nobody reads it.
        unseen: (num_envs, O) int64 frames since a ray last hit each of the obstacles of the needs; None without any.
    """

    def __init__(
        self,
        config: SensorConfig,
        sim: Simulator,
        control_dt: float,
        needs: SensingNeeds,
        noise: Sequence[Noise],
        seed: int,
        num_threads: int | None,
        sampler: Callable | None = None,
        history: int = 0,
        base_motion: bool = False,
    ) -> None:
        if config.motion_segments > 1:
            raise ValueError(
                f"lidar.motion_segments={config.motion_segments} must be 0 or 1: the task gives the LiDAR"
                " the poses of its frames only"
            )
        ratio = config.period_s / control_dt
        self.period_steps = round(ratio)
        if abs(ratio - self.period_steps) > 1e-6 or self.period_steps < 1:
            raise ValueError(f"lidar.period_s={config.period_s} must be a multiple of the control step {control_dt} s")
        self._sim, self.needs, self.sampler = sim, needs, sampler
        self.config, pattern = config, config.pattern()
        self.hidden = hidden_geoms(sim.world, config.exclude_geoms, field_of_view(config, pattern, noise))
        shapes = ray_shapes(sim.world, self.hidden)
        self._bodies, self.base = shapes.bodies, shapes.base
        self.scene = RayScene(
            shapes.shapes, sim.num_envs, len(shapes.bodies), device=str(sim.device), num_threads=num_threads
        )
        outputs = _outputs_read(needs, sampler is not None)
        self.lidar = Lidar(
            config,
            pattern,
            self.scene,
            mount_body=self.base,
            noise=tuple(noise),
            seed=seed,
            outputs=outputs,
            envs_at_once=None if needs.whole else envs_at_once(config, outputs),
        )
        self._time = torch.zeros(sim.num_envs, dtype=torch.float64, device=sim.device)
        self.tick, self._is_cast = 0, False
        self.frame_count = torch.zeros(sim.num_envs, 1, dtype=torch.int64, device=sim.device)
        self.frame_tick = torch.zeros(sim.num_envs, 1, dtype=torch.int64, device=sim.device)
        self.frames: torch.Tensor | None = None
        if sampler is not None:
            self._newest = torch.zeros(sim.num_envs, sampler.num_points + base_motion, 3, device=sim.device)
            self.frames = self._newest[:, None].repeat(1, history, 1, 1)
        self.odometry = Odometry(sim.num_envs, control_dt, sim.device) if base_motion else None
        self.sector_distance: torch.Tensor | None = None
        if needs.sectors:
            self.sector_distance = torch.empty(sim.num_envs, needs.sectors, device=sim.device)
            self._measure_sectors = self._record_sectors(num_threads)
        self._distal_range = {cap: torch.full((sim.num_envs,), cap, device=sim.device) for cap in needs.distal_caps}
        self.unseen: torch.Tensor | None = None
        if needs.obstacles:
            self._obstacle_of = torch.full((len(shapes.shapes) + 1,), len(needs.obstacles), device=sim.device)
            self._obstacle_of[1 + torch.tensor(shapes.indices(tuple(needs.obstacles)))] = torch.arange(
                len(needs.obstacles), device=sim.device
            )  # row 0 is a miss; all other shapes are one more obstacle, which is left out
            self.unseen = torch.full((sim.num_envs, len(needs.obstacles)), NEVER, device=sim.device)

    @property
    def frame(self) -> LidarFrame | None:
        """The newest clouds of all environments; None before the first.

        Raises:
            ValueError: they are cast in parts.
        """
        if len(self.lidar.env_slices) > 1:
            raise ValueError(
                f"the clouds of {self._sim.num_envs} environments take more than"
                f" lidar.cloud_mb={self.config.cloud_mb:g} MB and are never there at once; raise it, or lower num_envs"
            )
        return self.lidar.frame if self._is_cast else None

    def parts_of(self, num_envs: int) -> tuple[slice, ...]:
        """The parts in which the clouds of a run with so many environments are cast."""
        most = num_envs if self.needs.whole else envs_at_once(self.config, self.lidar.outputs)
        return env_slices(num_envs, most)

    def start(self, envs: torch.Tensor, sensed: Kinematics) -> None:
        """Notes where the base of some environments, see `rows`, starts; call after their reset."""
        if self.odometry is not None:
            self.odometry.start(envs, sensed)

    def follow(self, sensed: Kinematics) -> None:
        """Notes how the base moves; call at every control step."""
        if self.odometry is not None:
            self.odometry.advance(sensed)

    def due(self, step: int) -> bool:
        """Whether a frame ends with control step number `step`."""
        return step % self.period_steps == 0

    def take_frame(self, time_s: float, base_quat: torch.Tensor, timer: StageTimer) -> None:
        """Casts the frame that ends at simulation time `time_s` from the current poses, and takes what is read from it.

        Args:
            time_s: of all environments.
            base_quat: (num_envs, 4) as sensed; samplers need it.
            timer: of the stages "rays", "sampling" and "sectors".
        """
        with timer.stage("rays"):
            pos, quat = self._sim.body_poses(self._bodies)
            self.scene.body_pos.copy_(pos)
            self.scene.body_quat.copy_(quat)
        parts = self.lidar.cast_slices(self._time.fill_(time_s))
        for index in range(len(self.lidar.env_slices)):
            with timer.stage("rays"):
                part, frame = next(parts)
                if self.unseen is not None:
                    self._note_sightings(part, frame)
                for cap, mean in self._distal_range.items():
                    mean[part] = self._mean_distal_range(frame, cap)
            if self.frames is not None:
                with timer.stage("sampling"):
                    self._sample(part, frame, base_quat)
            if self.sector_distance is not None:
                with timer.stage("sectors"):
                    self._measure_sectors[index]()
        next(parts, None)  # the frame has been cast
        self.tick, self._is_cast = self.tick + 1, True
        self.frame_tick.fill_(self.tick)
        if self.frames is not None:
            self._append_newest()

    def _note_sightings(self, part: slice, frame: LidarFrame) -> None:
        hit = self._obstacle_of[frame.shape_id.long() + 1]
        seen = torch.zeros(len(hit), self.unseen.shape[1] + 1, dtype=torch.bool, device=hit.device)
        seen.scatter_(1, hit, True)
        self.unseen[part] = torch.where(seen[:, :-1], 0, self.unseen[part] + 1)

    def _sample(self, part: slice, frame: LidarFrame, base_quat: torch.Tensor) -> None:
        sensor, points = self.config, self._newest[part, : self.sampler.num_points]
        attitude = Attitude(base_quat[part].contiguous(), sensor.mount_pos, sensor.quat)
        self.sampler(frame.ranges, frame.directions_s, frame.elevation, frame.azimuth, points, attitude)

    def _append_newest(self) -> None:
        """Appends the sampled points to the history."""
        if self.odometry is not None:
            self._newest[:, -1] = self.odometry.since_last_frame()
        self.frames = torch.cat((self.frames[:, 1:], self._newest[:, None]), 1)
        self.frame_count.add_(1).clamp_(max=self.frames.shape[1])

    def mean_distal_range(self, max_distance: float) -> torch.Tensor:
        """(num_envs,) mean of the noise-free distal ranges (m), each capped at `max_distance`."""
        if max_distance not in self._distal_range:  # neither declared nor asked for before
            nothing = torch.full((self._sim.num_envs,), max_distance, device=self._sim.device)
            frame = self.frame
            self._distal_range[max_distance] = (
                nothing if frame is None else self._mean_distal_range(frame, max_distance)
            )
        return self._distal_range[max_distance]

    def _mean_distal_range(self, frame: LidarFrame, max_distance: float) -> torch.Tensor:
        distal = frame.elevation < torch.pi / 180 * self.config.distal_below_deg
        capped = frame.true_ranges.clamp(max=max_distance) * distal
        return capped.sum(1) / distal.sum(1).clamp(min=1)

    def state_dict(self) -> dict:
        return {
            "tick": self.tick,
            "lidar": self.lidar.state_dict(),
            "frame_count": self.frame_count,
            "frames": self.frames,
            "sector_distance": None if self.sector_distance is None else self.sector_distance.clone(),
            "distal_range": {str(key): value.clone() for key, value in self._distal_range.items()},
            "unseen": None if self.unseen is None else self.unseen.clone(),
            "odometry": self.odometry.state_dict() if self.odometry is not None else None,
        }

    def load_state_dict(self, state: dict) -> None:
        self.tick = state["tick"]
        self.frame_tick.fill_(self.tick)
        self.lidar.load_state_dict(state["lidar"])
        self.frame_count.copy_(state["frame_count"])
        if self.frames is not None:
            self.frames = state["frames"].clone()
        if self.sector_distance is not None:
            self.sector_distance.copy_(state["sector_distance"])
        if self.unseen is not None:
            self.unseen = state["unseen"].clone()
        if self.odometry is not None:
            self.odometry.load_state_dict(state["odometry"])
        self._distal_range = {float(key): value.clone() for key, value in state["distal_range"].items()}

    def reset(self, envs: torch.Tensor) -> None:
        """Forgets what some environments, see `rows`, have seen, and how their bodies moved."""
        self.lidar.forget_motion(envs)
        put(self.frame_count, envs, 0)
        if self.frames is not None:
            put(self.frames, envs, 0.0)
        if self.sector_distance is not None:
            put(self.sector_distance, envs, self.needs.sector_max)
        if self.unseen is not None:
            put(self.unseen, envs, NEVER)
        for max_distance, mean in self._distal_range.items():
            put(mean, envs, max_distance)

    def _record_sectors(self, num_threads: int | None) -> list[SectorDistances]:
        """A launch for each part."""
        sensor = self.config
        return [
            SectorDistances(
                frame.true_ranges,
                frame.directions_s,
                frame.class_id,
                self.scene.body_quat[part],
                self.base,
                sensor.mount_pos,
                sensor.quat,
                obstacle_class=int(HitClass.OBSTACLE),
                max_distance=self.needs.sector_max,
                num_sectors=self.needs.sectors,
                num_threads=num_threads,
                out=self.sector_distance[part],
            )
            for part, frame in zip(self.lidar.env_slices, self.lidar.slice_frames, strict=True)
        ]


def field_of_view(sensor: LidarConfig, pattern: ScanPattern, noise: Sequence[Noise]) -> FieldOfView:
    """Where the rays of a sensor go."""
    directions, origins = pattern.directions_s.numpy(), pattern.origins_s
    reach = 0.0 if origins is None else float(origins.double().norm(dim=1).max())
    return FieldOfView.of(sensor.mount_pos, sensor.quat, directions, max_deviation(noise), reach)


def _outputs_read(needs: SensingNeeds, sampled: bool) -> tuple[str, ...]:
    """The outputs of the LiDAR that the task reads."""
    outputs: set[str] = set()
    if sampled:
        outputs |= {"ranges", "directions_s", "elevation", "azimuth"}
    if needs.sectors:
        outputs |= {"true_ranges", "directions_s", "class_id"}
    if needs.obstacles:
        outputs |= {"shape_id"}
    if needs.rays:
        outputs |= {"true_ranges", "elevation"}
    return tuple(sorted(outputs))


def envs_at_once(config: SensorConfig, outputs: Sequence[str]) -> int:
    """Environments whose clouds fit into `cloud_mb`, at least one."""
    return max(int(min(1e6 * config.cloud_mb / (config.num_rays * ray_bytes(outputs)), 2**31)), 1)
