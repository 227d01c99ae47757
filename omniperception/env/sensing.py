"""The LiDAR of the task: casts at its own rate, samples each frame once, keeps the history of frames."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass

import torch

from omnilidar import (
    DEVICES,
    Lidar,
    LidarConfig,
    LidarFrame,
    Noise,
    RayScene,
    ScanPattern,
    SectorDistances,
    env_slices,
    ray_bytes,
)
from omnilidar.launch import constant
from omniperception.avoidance.coverage import Coverage, kept_to_covered, least_bins, levelled
from omniperception.common.rotations import multiply
from omniperception.common.timing import StageTimer
from omniperception.env.frame_delivery import FrameDelivery, PastPoses
from omniperception.env.kinematics import Kinematics
from omniperception.env.odometry import Odometry, TimedOdometry
from omniperception.perception import Attitude, Sampler
from omniperception.scene import RobotConfig
from omniperception.scene.rays import HitClass, ray_shapes
from omniperception.sim import Simulator

NEVER = 2**31
"""Frames since something was seen that has not been seen in this episode."""


@dataclass(frozen=True)
class SensorConfig(LidarConfig):
    """A LiDAR on the robot.

    Attributes:
        pattern: makes the scan pattern; None: the device's.
        exclude_geoms: geoms of the robot that its rays pass through: the housing around the sensor.
        mount_body: link that carries the sensor and moves against the base; None: the base.
        device: name in `omnilidar.DEVICES` of the sensor whose own noise `randomization.lidar_device` puts
            on, or None.
        distal_below_deg: rays whose elevation in the sensor frame is below this count for `capped_ray_distance`.
        cloud_mb: most memory (MB) for clouds that exist at the same time; where those of all environments take more,
            they are cast and sampled in slices of environments.
    """

    pattern: Callable[[], ScanPattern] | None = None
    exclude_geoms: Sequence[str] = ()
    mount_body: str | None = None
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

    def scan_pattern(self) -> ScanPattern:
        """The pattern, made."""
        assert self.pattern is not None  # by now the device's
        return self.pattern()


class LidarSensing:
    """Casts a frame every `period_steps` control steps, for all environments at the same moment.

    Clouds are reduced to what is read of them as soon as they are cast, in as many slices of environments as
    `cloud_mb` asks for: those of all environments never have to exist at the same time. A reset empties an
    environment's history; its next frame comes with the sensor's next tick.

    With a `FrameDelivery`, frames are lost and late. All environments tick together nevertheless:
    - Where a frame is lost, the history repeats the last one that came, with no motion of the base; the motion of the
      next one that comes is that since the last one that came. Before any has come `frame_count` stays 0.
    - A late frame is cast from where base and obstacles were when it was taken. It is levelled with the attitude of the
      moment at which it comes, and so does the odometry count, as on a robot whose frames bear no time. What rays say
      without noise (sector distances, distal ranges, sightings) is of the moment at which they were cast, and counts
      where the frame is lost, too, but for sightings; what is known of poses (true sectors, heights, targets of
      supervision by these) is of the moment of the tick, so that a network learns what is there now.

    A sensor on a link that moves against the base (`config.mount_body`): a sampler that levels points does so in the
    heading of that link and around its origin, with the attitude that the base's measured one and the joints give.
    Sector distances are the base's.

    Attributes:
        base: index of the robot's base among the bodies of the ray scene.
        carrier: index of the body that carries the sensor, usually the base.
        frames: (num_envs, history, num_points, 3) sampled points in the sensor frame divided by the maximum range,
            newest last, with `base_motion` one row more: how the base moved since the frame before, with
            `frame_times` three: when and from where they were taken; None without a sampler.
        frame_count: (num_envs, 1) int64 how many of the newest frames are valid.
        frame_tick: (num_envs, 1) int64 number of the newest frame, the same for all environments.
        coverage: directions that the newest frames cover; None where frames are always whole, or nobody looks.
        fresh: (num_envs,) bool whose frame came at the newest tick; clouds of the others are not to be looked at.
        unseen: (num_envs, O) int64 frames of the history since a ray last hit each of `obstacles`; None without any.
    """

    def __init__(
        self,
        config: SensorConfig,
        sim: Simulator,
        control_dt: float,
        noise: Sequence[Noise],
        seed: int,
        num_threads: int | None,
        sampler: Sampler | None,
        history: int,
        base_motion: bool,
        frame_times: bool,
        sector_distance: torch.Tensor | None,
        obstacles: Sequence[str],
        distal: bool,
        whole: bool,
        measured: bool,
        shown: bool,
        delivery: FrameDelivery | None,
    ) -> None:
        """
        Args:
            config: the sensor.
            sim: whose bodies the rays hit.
            control_dt: s.
            noise: models of its noise.
            seed: of the noise.
            num_threads: CPU threads; None for all cores.
            sampler: what a network sees of a cloud; None: nothing.
            history: frames kept for the network.
            base_motion: whether a frame's last row is the base's motion since the frame before.
            frame_times: whether frames bear the time at which they were taken; then their last three rows are those of
                `TimedOdometry`, and they are levelled with the attitude of that time.
            sector_distance: (num_envs, num_sectors) memory for the horizontal distance (m) from the base to the nearest
                obstacle hit by sector, without noise; None: not measured.
            obstacles: geoms whose sightings are noted.
            distal: whether `mean_distal_range` is read.
            whole: whether `frame` is read, the clouds of all environments.
            measured: likewise, as measured, with noise.
            shown: whether frames are sampled for the network; otherwise it never has one.
            delivery: which frames are lost and late; None: none.
        """
        ratio = config.period_s / control_dt
        self.period_steps = round(ratio)
        if abs(ratio - self.period_steps) > 1e-6 or self.period_steps < 1:
            raise ValueError(f"lidar.period_s={config.period_s} must be a multiple of the control step {control_dt} s")
        segments = max(config.motion_segments, 1)
        if self.period_steps % segments:
            raise ValueError(
                f"lidar.motion_segments={segments} must be 0 or divide the {self.period_steps} control steps"
                " of a frame evenly"
            )
        self._steps_per_segment = self.period_steps // segments
        late = 0 if delivery is None else delivery.max_late_steps
        if late and config.motion_segments:
            raise ValueError(
                f"lidar.motion_segments={config.motion_segments} casts along the way to the present, but"
                " randomization.frames_late_s asks for the past; use lidar.motion_segments=0"
            )
        self._sim, self.sampler, self.whole = sim, sampler, whole or measured
        self.config, pattern = config, config.scan_pattern()
        shapes = ray_shapes(sim.world, config.exclude_geoms, config.mount_body)
        self._bodies, self.base = shapes.bodies, shapes.base
        body = config.mount_body
        self.carrier = self.base if body is None else shapes.bodies.index(sim.world.model.body(body).id)
        self._shape_of = {name: k for k, name in enumerate(shapes.geom_names)}
        self.scene = RayScene(
            shapes.shapes, sim.num_envs, len(shapes.bodies), device=str(sim.device), num_threads=num_threads
        )
        sampled = self._shown = shown and sampler is not None
        outputs = _outputs(sampled, sector_distance is not None, bool(obstacles), distal, whole, measured)
        self.lidar = Lidar(
            config,
            pattern,
            self.scene,
            mount_body=self.carrier,
            noise=tuple(noise),
            seed=seed,
            outputs=outputs,
            envs_at_once=None if self.whole else envs_at_once(config, outputs),
        )
        n, device = sim.num_envs, sim.device
        self._time = torch.zeros(n, dtype=torch.float64, device=device)
        self._delivery = delivery
        self._past = PastPoses(late + 1, n, len(self._bodies), device) if late else None
        self.fresh = torch.ones(n, dtype=torch.bool, device=device) if delivery is None else delivery.fresh
        self.coverage: Coverage | None = None
        if delivery is not None and delivery.partial is not None and (sampled or measured):
            self.coverage = Coverage(n, least_bins_of(config, pattern, sim.world.robot).to(device))
        self.tick, self._is_cast = 0, False
        self.frame_count, self.frame_tick = torch.zeros(2, n, 1, dtype=torch.int64, device=device).unbind(0)
        self.frames: torch.Tensor | None = None
        if sampler is not None:
            rows = TimedOdometry.num_rows if frame_times else int(base_motion)
            self._newest = torch.zeros(n, sampler.num_points + rows, 3, device=device)
            self.frames = self._newest[:, None].repeat(1, history, 1, 1)
        self.odometry: Odometry | TimedOdometry | None = None
        if frame_times:
            self.odometry = TimedOdometry(n, control_dt, late, device)
        elif base_motion:
            self.odometry = Odometry(n, control_dt, device)
        self._sectors: list[SectorDistances] = []
        if sector_distance is not None:
            self._sectors = self._record_sectors(sector_distance, num_threads)
        self._distal_range: dict[float, torch.Tensor] = {}
        self.unseen: torch.Tensor | None = None
        if obstacles:
            count = len(obstacles)
            self._obstacle_of = torch.full((len(shapes.shapes) + 1,), count, device=device)
            index = 1 + torch.tensor(shapes.indices(tuple(obstacles)))  # 0 is a miss; all else is one obstacle more
            self._obstacle_of[index] = torch.arange(count, device=device)
            self.unseen = torch.full((n, count), NEVER, device=device)

    @property
    def sliced(self) -> bool:
        """Whether clouds are cast in slices of the environments, and never there at once."""
        return len(self.lidar.env_slices) > 1

    @property
    def frame(self) -> LidarFrame | None:
        """The newest clouds of all environments; None before the first.

        Raises:
            ValueError: they are cast in slices.
        """
        if self.sliced:
            raise ValueError(
                f"the clouds of {self._sim.num_envs} environments take more than"
                f" lidar.cloud_mb={self.config.cloud_mb:g} MB and are never there at once; raise it, or lower num_envs"
            )
        return self.lidar.frame if self._is_cast else None

    def slices_of(self, num_envs: int) -> tuple[slice, ...]:
        """The slices in which the clouds of `num_envs` environments are cast."""
        most = num_envs if self.whole else envs_at_once(self.config, self.lidar.outputs)
        return env_slices(num_envs, most)

    def resize(self, geoms: Sequence[str], env_ids: torch.Tensor, sizes: torch.Tensor) -> None:
        """Gives rays the sizes (n, k, 3) in m that k geoms have in environments (n,)."""
        shapes = tuple(self._shape_of[name] for name in geoms)
        self.scene.set_sizes(shapes, sizes, env_ids, check=False)

    def follow(self, measured: Kinematics) -> None:
        """Notes how the base moves, as measured, and where everything is; call at every control step."""
        if self.odometry is not None:
            self.odometry.advance(measured)
        if self._past is not None:
            self._past.record(*self._sim.body_poses(self._bodies))

    def seen_within(self, frames: int) -> torch.Tensor | None:
        """(num_envs, O) bool: which obstacles a ray has hit in the last `frames` frames; None without any."""
        return None if self.unseen is None else self.unseen < frames

    def due(self, step: int) -> bool:
        """Tell whether a frame ends with control step number `step`."""
        return step % self.period_steps == 0

    def record_motion(self, step: int) -> None:
        """Notes where the bodies are in control step number `step` within a frame, where a segment of motion ends."""
        if self._steps_per_segment < self.period_steps and step % self._steps_per_segment == 0:
            self.place_bodies()
            self.lidar.record_poses()

    def take_frame(self, time_s: float, base_quat: torch.Tensor, timer: StageTimer) -> None:
        """Casts the frame of simulation time `time_s`, from the current poses or late, and takes what is read from it.

        Args:
            time_s: of all environments.
            base_quat: (num_envs, 4) as measured; samplers need it.
            timer: of the stages "rays", "sampling" and "sectors".
        """
        with timer.stage("rays"):
            if self._delivery is not None:
                self._delivery.draw()
            self.place_bodies()
            if self.coverage is not None:
                self.coverage.begin_frame()
        if isinstance(self.odometry, TimedOdometry):
            base_quat = self.odometry.attitude(self.late_steps)
        attitude = self._attitude(base_quat)
        slices = self.lidar.cast_slices(self._time.fill_(time_s))
        for index in range(len(self.lidar.env_slices)):
            with timer.stage("rays"):
                envs, frame = next(slices)
                self._lose_points(envs, frame, attitude)
                if self.unseen is not None:
                    self._note_sightings(envs, frame)
                for cap, mean in self._distal_range.items():
                    mean[envs] = self._mean_distal_range(frame, cap)
            if self._shown:
                with timer.stage("sampling"):
                    self._sample(envs, frame, attitude)
            if self._sectors:
                with timer.stage("sectors"):
                    self._sectors[index]()
        next(slices, None)  # the frame has been cast
        self.tick, self._is_cast = self.tick + 1, True
        self._note_tick()
        if self._shown:
            self._append_newest()

    def _note_tick(self) -> None:
        self.frame_tick = torch.full_like(self.frame_tick, self.tick)  # observations keep the tensor of before

    def _attitude(self, base_quat: torch.Tensor) -> torch.Tensor:
        """(num_envs, 4) attitude of the body that carries the sensor, by the base's as measured and the joints."""
        if self.carrier == self.base:
            return base_quat
        quat = self.scene.body_quat.float()
        back = quat[:, self.base] * constant((1.0, -1.0, -1.0, -1.0), quat.device)
        return multiply(base_quat, multiply(back, quat[:, self.carrier]))

    def place_bodies(self) -> None:
        """Where they are now, or where they were when a late frame was taken."""
        if self._past is None or self._delivery is None:
            pos, quat = self._sim.body_poses(self._bodies)
        else:
            pos, quat = self._past.at(self._delivery.late_steps)
        self.scene.body_pos.copy_(pos)
        self.scene.body_quat.copy_(quat)

    def _lose_points(self, envs: slice, frame: LidarFrame, attitude: torch.Tensor) -> None:
        """Takes points away from frames that are partial, and notes which directions the rest covers."""
        if self.coverage is None:
            return
        assert self._delivery is not None and self._delivery.partial is not None
        assert frame.ranges is not None and frame.directions_s is not None
        self._delivery.partial.take_away(frame.ranges, frame.directions_s, envs)
        directions_l = levelled(frame.directions_s, attitude[envs], constant(self.config.quat, attitude.device))
        self.coverage.add_frame(frame.ranges, directions_l, self.fresh[envs], envs)

    def known_to_be_free(self, command: torch.Tensor) -> torch.Tensor:
        """(num_envs, 3) the commanded v_x, v_y (m/s) and yaw rate (rad/s), slowed down where nobody looked."""
        if self.coverage is None:
            return command
        return torch.cat((kept_to_covered(command[:, :2], self.coverage.covered), command[:, 2:]), 1)

    def _note_sightings(self, envs: slice, frame: LidarFrame) -> None:
        assert self.unseen is not None and frame.shape_id is not None
        hit = self._obstacle_of[frame.shape_id.long() + 1]
        seen = torch.zeros(len(hit), self.unseen.shape[1] + 1, dtype=torch.bool, device=hit.device)
        seen.scatter_(1, hit, True)
        seen, unseen = seen[:, :-1], self.unseen[envs]
        if self._delivery is not None:  # a frame that is repeated shows again what it has shown
            seen = torch.where(self.fresh[envs, None], seen, unseen == 0)
        self.unseen[envs] = torch.where(seen, 0, unseen + 1)

    def _sample(self, envs: slice, frame: LidarFrame, quat: torch.Tensor) -> None:
        assert self.sampler is not None and frame.ranges is not None and frame.directions_s is not None
        assert frame.elevation is not None and frame.azimuth is not None
        sensor, points = self.config, self._newest[envs, : self.sampler.num_points]
        attitude = Attitude(quat[envs].contiguous(), sensor.mount_pos, sensor.quat)
        self.sampler(frame.ranges, frame.directions_s, frame.elevation, frame.azimuth, points, attitude)

    def _append_newest(self) -> None:
        """Appends the sampled points to the history, or the last frame again where this one is lost."""
        assert self.frames is not None
        fresh = None if self._delivery is None else self.fresh[:, None]
        newest, counts = self._newest, 1 if fresh is None else fresh | (self.frame_count > 0)
        if fresh is not None:
            newest = torch.where(fresh[..., None], newest, self.frames[:, -1])
        if isinstance(self.odometry, TimedOdometry):
            newest[:, -TimedOdometry.num_rows :] = self.odometry.take(
                None if fresh is None else fresh[:, 0], self.late_steps
            )
        elif self.odometry is not None:
            newest[:, -1] = self.odometry.since_last_frame(fresh)
        self.frames = torch.cat((self.frames[:, 1:], newest[:, None]), 1)
        self.frame_count.add_(counts).clamp_(max=self.frames.shape[1])

    @property
    def late_steps(self) -> torch.Tensor | None:
        """(num_envs,) int64 control steps by which the newest frame is old; None: frames are not late."""
        return None if self._past is None or self._delivery is None else self._delivery.late_steps

    def mean_distal_range(self, max_distance: float) -> torch.Tensor:
        """(num_envs,) mean of the noise-free distal ranges (m) of the newest frame, each capped at `max_distance`; the
        cap before the first frame. A cap is averaged from the first frame on that follows its first read."""
        if max_distance not in self._distal_range:
            cap = torch.full((self._sim.num_envs,), max_distance, device=self._sim.device)
            self._distal_range[max_distance] = cap
        return self._distal_range[max_distance]

    def _mean_distal_range(self, frame: LidarFrame, max_distance: float) -> torch.Tensor:
        assert frame.elevation is not None and frame.true_ranges is not None
        distal = frame.elevation < torch.pi / 180 * self.config.distal_below_deg
        capped = frame.true_ranges.clamp(max=max_distance) * distal
        return capped.sum(1) / distal.sum(1).clamp(min=1)

    def state_dict(self) -> dict:
        clouds = self.lidar.frame
        read = self.lidar.outputs if self.whole and self._is_cast else ()
        return {
            "tick": self.tick,
            "lidar": self.lidar.state_dict(),
            "frame_count": self.frame_count.clone(),
            "frames": self.frames,
            "clouds": {name: getattr(clouds, name).clone() for name in sorted(read)},
            "distal_range": {str(key): value.clone() for key, value in self._distal_range.items()},
            "unseen": None if self.unseen is None else self.unseen.clone(),
            "odometry": self.odometry.state_dict() if self.odometry is not None else None,
            "delivery": self._delivery.state_dict() if self._delivery is not None else None,
            "past": self._past.state_dict() if self._past is not None else None,
            "coverage": self.coverage.state_dict() if self.coverage is not None else None,
        }

    def load_state_dict(self, state: dict) -> None:
        self.tick = state["tick"]
        clouds = state["clouds"]
        self._is_cast = bool(clouds)
        for name, values in clouds.items():
            getattr(self.lidar.frame, name).copy_(values)
        self._note_tick()
        self.lidar.load_state_dict(state["lidar"])
        self.frame_count.copy_(state["frame_count"])
        if self.frames is not None:
            self.frames = state["frames"].clone()
        if self.unseen is not None:
            self.unseen = state["unseen"].clone()
        if self.odometry is not None:
            self.odometry.load_state_dict(state["odometry"])
        if self._delivery is not None:
            self._delivery.load_state_dict(state["delivery"])
        if self._past is not None:
            self._past.load_state_dict(state["past"])
        if self.coverage is not None:
            self.coverage.load_state_dict(state["coverage"])
        self._distal_range = {float(key): value.clone() for key, value in state["distal_range"].items()}

    def reset(self, env_ids: torch.Tensor, measured: Kinematics, seeds: torch.Tensor | None = None) -> None:
        """Clears frames, sightings and recorded motion of environments (n,).

        Args:
            env_ids: which.
            measured: base of all environments as measured, where their episodes begin.
            seeds: (n,) int64, of noise and scan phase from now on; None: they go on.
        """
        if self.odometry is not None:
            self.odometry.start(env_ids, measured)
        if self._delivery is not None:
            self._delivery.reset(env_ids)
        if self._past is not None:
            self._past.reset(env_ids, *self._sim.body_poses(self._bodies))
        self.lidar.reset(env_ids, seeds)
        if self.coverage is not None:
            self.coverage.reset(env_ids)
        self.frame_count.index_fill_(0, env_ids, 0)
        if self.frames is not None:
            self.frames = self.frames.index_fill(0, env_ids, 0.0)  # observations keep the tensor of before
        if self.unseen is not None:
            self.unseen.index_fill_(0, env_ids, NEVER)
        for max_distance, mean in self._distal_range.items():
            mean.index_fill_(0, env_ids, max_distance)

    def _record_sectors(self, out: torch.Tensor, num_threads: int | None) -> list[SectorDistances]:
        """A launch for each slice of environments."""
        sensor, launches = self.config, []
        for envs, frame in zip(self.lidar.env_slices, self.lidar.slice_frames, strict=True):
            assert frame.true_ranges is not None and frame.directions_s is not None and frame.class_id is not None
            launch = SectorDistances(
                frame.true_ranges,
                frame.directions_s,
                frame.class_id,
                self.scene.body_pos[envs],
                self.scene.body_quat[envs],
                self.base,
                sensor.mount_pos,
                sensor.quat,
                obstacle_class=int(HitClass.OBSTACLE),
                max_distance=sensor.max_range,
                num_sectors=out.shape[1],
                num_threads=num_threads,
                out=out[envs],
                carrier=self.carrier,
            )
            launches.append(launch)
        return launches


def least_bins_of(config: SensorConfig, pattern: ScanPattern, robot: RobotConfig) -> torch.Tensor:
    """(NUM_SECTORS,) what covers each direction around a sensor, see `least_bins`."""
    height = robot.height_of(config.mount_body) + config.mount_pos[2]
    return least_bins(pattern.directions_s.cpu(), torch.tensor(config.quat), height, config.max_range)


def _outputs(
    sampled: bool, sectors: bool, sightings: bool, distal: bool, whole: bool, measured: bool
) -> tuple[str, ...]:
    """The outputs of the LiDAR that are read."""
    read = {
        ("ranges", "directions_s", "elevation", "azimuth"): sampled,
        ("true_ranges", "directions_s", "class_id"): sectors,
        ("shape_id",): sightings,
        ("true_ranges", "elevation"): distal,
        ("true_ranges", "directions_s", "elevation"): whole,
        ("ranges", "directions_s"): measured,
    }
    return tuple(sorted({name for names, is_read in read.items() if is_read for name in names}))


def envs_at_once(config: SensorConfig, outputs: Collection[str]) -> int:
    """Environments whose clouds fit into `cloud_mb`, at least one."""
    return max(int(min(1e6 * config.cloud_mb / (config.num_rays * ray_bytes(outputs)), 2**31)), 1)


def split_elevation(sampler: Sampler | None, config: SensorConfig) -> float:
    """Elevation (rad) in the sensor frame above which a point is proximal: where the sampler splits the cloud, or the
    sensor where it does not."""
    split = getattr(sampler, "split", None)
    return math.radians(config.distal_below_deg) if split is None else float(split)
