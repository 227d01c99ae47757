"""The LiDAR of the task: casts at its own rate, and hands each frame to its consumers."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TypeVar

import torch

from omnilidar import DEVICES, Lidar, LidarConfig, LidarFrame, Noise, RayScene, ScanPattern, ray_bytes
from omnilidar.launch import constant
from omniperception.avoidance.coverage import least_bins
from omniperception.common.rotations import multiply
from omniperception.common.stateful import Stateful
from omniperception.common.timing import StageTimer
from omniperception.env.consumers import CoveredSectors, DistalRange, FrameConsumer, FrameHistory, Sightings
from omniperception.env.frame_delivery import FrameDelivery, PastPoses
from omniperception.env.kinematics import Kinematics
from omniperception.env.odometry import Odometry, TimedOdometry
from omniperception.scene import RobotConfig
from omniperception.scene.rays import ray_shapes
from omniperception.sim import Simulator

Consumer = TypeVar("Consumer", bound=FrameConsumer)


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
        consumers: make, by name, what else takes something of each frame: see `FrameConsumer`.
    """

    pattern: Callable[[], ScanPattern] | None = None
    exclude_geoms: Sequence[str] = ()
    mount_body: str | None = None
    device: str | None = None
    distal_below_deg: float = 20.0
    cloud_mb: float = 1000.0
    consumers: Mapping[str, Callable[[], FrameConsumer]] = field(default_factory=dict)

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


class LidarSensing(Stateful):
    """Casts a frame every `period_steps` control steps, for all environments at the same moment.

    Consumers take what they want of a cloud as soon as it is cast, in as many slices of environments as `cloud_mb` asks
    for: the clouds of all environments never have to exist at the same time. What no consumer reads is not computed. A
    reset empties an environment's history; its next frame comes with the sensor's next tick.

    With a `FrameDelivery`, frames are lost and late. All environments tick together nevertheless:
    - Where a frame is lost, the history repeats the last one that came; before any has come it stays empty.
    - A late frame is cast from where base and obstacles were when it was taken. It is levelled with the attitude of the
      moment at which it comes, and so does the odometry count, as on a robot whose frames bear no time. What rays say
      without noise (sector distances, distal ranges, sightings) is of the moment at which they were cast, and counts
      where the frame is lost, too, but for sightings; what is known of poses (true sectors, heights, targets of
      supervision by these) is of the moment of the tick, so that a network learns what is there now.

    A sensor on a link that moves against the base (`config.mount_body`): a sampler that levels points does so in the
    heading of that link and around its origin, with the attitude that the base's measured one and the joints give.
    Sector distances are the base's.

    Attributes:
        consumers: by name, in the order in which they take a frame.
        shapes: what rays hit.
        base, carrier: indices of the robot's base and of the body that carries the sensor, usually the base, among the
            bodies of the ray scene.
        odometry: how the base moved between frames, as measured; None where nobody asks.
        tick: number of the newest frame, the same for all environments; 0 before the first.
        has_frame: whether there are clouds that `frame` gives.
        fresh: (num_envs,) bool whose frame came at the newest tick; clouds of the others are not to be looked at.
        attitude: (num_envs, 4) of the body that carries the sensor, when the newest frame came, as measured.
    """

    saved = ("tick", "lidar", "odometry", "_delivery", "_past", "consumers")

    def __init__(
        self,
        config: SensorConfig,
        sim: Simulator,
        control_dt: float,
        consumers: Mapping[str, FrameConsumer],
        noise: Sequence[Noise] = (),
        seed: int = 0,
        num_threads: int | None = None,
        delivery: FrameDelivery | None = None,
        odometry: Odometry | TimedOdometry | None = None,
    ) -> None:
        """
        Args:
            config: the sensor.
            sim: whose bodies the rays hit.
            control_dt: s.
            consumers: by name, in the order in which they take a frame.
            noise: models of its noise.
            seed: of the noise.
            num_threads: CPU threads; None for all cores.
            delivery: which frames are lost and late; None: none.
            odometry: of the base; with a `TimedOdometry` frames are levelled with the attitude of their own time.
        """
        self.period_steps, self._steps_per_segment = _steps(config, control_dt)
        late = 0 if delivery is None else delivery.max_late_steps
        if late and config.motion_segments:
            raise ValueError(
                f"lidar.motion_segments={config.motion_segments} casts along the way to the present, but"
                " randomization.frames_late_s asks for the past; use lidar.motion_segments=0"
            )
        self.config, self._sim, self.num_threads = config, sim, num_threads
        self.num_envs, self.device, self.consumers = sim.num_envs, sim.device, dict(consumers)
        self.shapes, body = ray_shapes(sim.world, config.exclude_geoms, config.mount_body), config.mount_body
        self._bodies, self.base = self.shapes.bodies, self.shapes.base
        self._shape_of = {name: k for k, name in enumerate(self.shapes.geom_names)}
        self.carrier = self.base if body is None else self._bodies.index(sim.world.model.body(body).id)
        self.scene = RayScene(
            self.shapes.shapes, self.num_envs, len(self._bodies), device=str(self.device), num_threads=num_threads
        )
        outputs = tuple(sorted({name for consumer in consumers.values() for name in consumer.outputs}))
        self.lidar = Lidar(
            config,
            config.scan_pattern(),
            self.scene,
            mount_body=self.carrier,
            noise=tuple(noise),
            seed=seed,
            outputs=outputs,
            envs_at_once=self._envs_at_once(outputs),
        )
        self._time = torch.zeros(self.num_envs, dtype=torch.float64, device=self.device)
        self._delivery, self.odometry = delivery, odometry
        self._past = PastPoses(late + 1, self.num_envs, len(self._bodies), self.device) if late else None
        everybody = torch.ones(self.num_envs, dtype=torch.bool, device=self.device)
        self.fresh = everybody if delivery is None else delivery.fresh
        self.tick, self.has_frame = 0, False
        self.attitude = torch.zeros(self.num_envs, 4, device=self.device)
        for consumer in self.consumers.values():
            consumer.attach(self)

    # ---- what there is to read ---------------------------------------------------------------------------------------

    def consumer(self, kind: type[Consumer]) -> Consumer | None:
        """The consumer of a kind; None where there is none."""
        return next((one for one in self.consumers.values() if isinstance(one, kind)), None)

    @property
    def history(self) -> FrameHistory | None:
        """What the network sees; None without a sampler."""
        return self.consumer(FrameHistory)

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
                f"the clouds of {self.num_envs} environments take more than lidar.cloud_mb={self.config.cloud_mb:g} MB"
                " and are never there at once; raise it, or lower num_envs"
            )
        return self.lidar.frame if self.has_frame else None

    @property
    def late_steps(self) -> torch.Tensor | None:
        """(num_envs,) int64 control steps by which the newest frame is old; None: frames are not late."""
        return None if self._past is None or self._delivery is None else self._delivery.late_steps

    def seen_within(self, frames: int) -> torch.Tensor | None:
        """(num_envs, O) bool: which obstacles a ray has hit in the last `frames` frames; None where nobody asks."""
        sightings = self.consumer(Sightings)
        return None if sightings is None else sightings.unseen < frames

    def mean_distal_range(self, max_distance: float) -> torch.Tensor:
        """(num_envs,) m; see `DistalRange.mean`."""
        distal = self.consumer(DistalRange)
        assert distal is not None  # it is required
        return distal.mean(max_distance)

    def known_to_be_free(self, command: torch.Tensor) -> torch.Tensor:
        """(num_envs, 3) the commanded v_x, v_y (m/s) and yaw rate (rad/s), slowed down where nobody looked."""
        covered = self.consumer(CoveredSectors)
        return command if covered is None else covered.known_to_be_free(command)

    def _envs_at_once(self, outputs: Collection[str]) -> int:
        """Environments whose clouds fit into `cloud_mb`, at least one; all where a consumer needs whole clouds."""
        if any(consumer.whole for consumer in self.consumers.values()):
            return self.num_envs
        cloud_bytes = self.config.num_rays * ray_bytes(outputs)
        return max(int(min(1e6 * self.config.cloud_mb / cloud_bytes, self.num_envs)), 1)

    # ---- followed by the environment ---------------------------------------------------------------------------------

    def resize(self, geoms: Sequence[str], env_ids: torch.Tensor, sizes: torch.Tensor) -> None:
        """Gives rays the sizes (n, k, 3) in m that k geoms have in environments (n,)."""
        self.scene.set_sizes(tuple(self._shape_of[name] for name in geoms), sizes, env_ids, check=False)

    def follow(self, measured: Kinematics) -> None:
        """Notes how the base moves, as measured, and where everything is; call at every control step."""
        if self.odometry is not None:
            self.odometry.advance(measured)
        if self._past is not None:
            self._past.record(*self._sim.body_poses(self._bodies))

    def due(self, step: int) -> bool:
        """Tell whether a frame ends with control step number `step`."""
        return step % self.period_steps == 0

    def record_motion(self, step: int) -> None:
        """Notes where the bodies are in control step number `step` within a frame, where a segment of motion ends."""
        if self._steps_per_segment < self.period_steps and step % self._steps_per_segment == 0:
            self.place_bodies()
            self.lidar.record_poses()

    def take_frame(self, time_s: float, base_quat: torch.Tensor, timer: StageTimer) -> None:
        """Casts the frame of simulation time `time_s`, from the current poses or late, and hands it to the consumers.

        Args:
            time_s: of all environments.
            base_quat: (num_envs, 4) as measured; samplers need it.
            timer: of the stage "rays" and those of the consumers.
        """
        with timer.stage("rays"):
            if self._delivery is not None:
                self._delivery.draw()
            self.place_bodies()
            self.attitude = self._attitude(base_quat)
        slices = self.lidar.cast_slices(self._time.fill_(time_s))
        for _ in self.lidar.env_slices:
            with timer.stage("rays"):
                envs, frame = next(slices)
            for consumer in self.consumers.values():
                with timer.stage(consumer.stage):
                    consumer.take(envs, frame)
        next(slices, None)  # the frame has been cast
        self.tick, self.has_frame = self.tick + 1, True
        for consumer in self.consumers.values():
            with timer.stage(consumer.stage):
                consumer.finish()

    def place_bodies(self) -> None:
        """Where they are now, or where they were when a late frame was taken."""
        if self._past is None or self._delivery is None:
            pos, quat = self._sim.body_poses(self._bodies)
        else:
            pos, quat = self._past.at(self._delivery.late_steps)
        self.scene.body_pos.copy_(pos)
        self.scene.body_quat.copy_(quat)

    def _attitude(self, base_quat: torch.Tensor) -> torch.Tensor:
        """(num_envs, 4) attitude of the body that carries the sensor, by the base's as measured and the joints."""
        if isinstance(self.odometry, TimedOdometry):
            base_quat = self.odometry.attitude(self.late_steps)
        if self.carrier == self.base:
            return base_quat
        quat = self.scene.body_quat.float()
        back = quat[:, self.base] * constant((1.0, -1.0, -1.0, -1.0), quat.device)
        return multiply(base_quat, multiply(back, quat[:, self.carrier]))

    def reset(self, env_ids: torch.Tensor, measured: Kinematics, seeds: torch.Tensor | None = None) -> None:
        """Clears frames, recorded motion and what consumers have of environments (n,).

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
        for consumer in self.consumers.values():
            consumer.reset(env_ids)


def _steps(config: SensorConfig, control_dt: float) -> tuple[int, int]:
    """Control steps of a frame, and of a segment of its motion."""
    ratio, segments = config.period_s / control_dt, max(config.motion_segments, 1)
    steps = round(ratio)
    if abs(ratio - steps) > 1e-6 or steps < 1:
        raise ValueError(f"lidar.period_s={config.period_s} must be a multiple of the control step {control_dt} s")
    if steps % segments:
        raise ValueError(
            f"lidar.motion_segments={segments} must be 0 or divide the {steps} control steps of a frame evenly"
        )
    return steps, steps // segments


def least_bins_of(config: SensorConfig, pattern: ScanPattern, robot: RobotConfig) -> torch.Tensor:
    """(NUM_SECTORS,) what covers each direction around a sensor, see `least_bins`."""
    height = robot.height_of(config.mount_body) + config.mount_pos[2]
    return least_bins(pattern.directions_s.cpu(), torch.tensor(config.quat), height, config.max_range)


def split_elevation(history: FrameHistory | None, config: SensorConfig) -> float:
    """Elevation (rad) in the sensor frame above which a point is proximal: where the sampler splits the cloud, or the
    sensor where it does not."""
    split = getattr(history and history.sampler, "split", None)
    return math.radians(config.distal_below_deg) if split is None else float(split)
